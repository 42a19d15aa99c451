"""Numerical integration: coordinates, solvers, step control and adjoints on diffrax.

The names are imported at first use, so that diffrax loads with the first integrated scene.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
