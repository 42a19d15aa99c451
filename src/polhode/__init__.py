"""polhode: rotating rigid bodies in JAX (simulate, differentiate, identify).

The public names are listed in `__init__.pyi` and imported at first use, so that the command line
starts, and errors in scene files are reported, before JAX is loaded.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__version__ = "0.1.0"

del lazy_loader
