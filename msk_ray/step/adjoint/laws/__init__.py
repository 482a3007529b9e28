"""The laws of physics of a step, one file each: what it adds to the score Φ, its derivative, and its launches."""
