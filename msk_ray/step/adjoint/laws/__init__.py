"""The laws of physics of a step, one file each: its potential, its derivative, and its launches.

The *potential* of a law is its share of −Φ (docs/step/differentiation.md), with λ, μ, a and â held fixed: gradients of
the state, the controls and the parameters are its derivatives.
"""
