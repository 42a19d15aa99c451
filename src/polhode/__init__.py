"""polhode: rotating rigid bodies in JAX (simulate, differentiate, identify)."""

__version__ = "0.1.0"
