"""Which features of a model the adjoint differentiates, and which contacts it approximates."""
