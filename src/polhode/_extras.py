"""Optional dependencies, and the error if one is missing. Imports neither NumPy nor JAX."""

import importlib
import importlib.util
from typing import Any


def how_to_install(extra: str) -> str:
    """How to install an extra (or several, separated by commas), for error messages."""
    return f"pip install 'polhode[{extra}]' (from a checkout: pip install '.[{extra}]')"


def imported(what: str, *modules: str, extra: str = "cli") -> Any:
    """The first of the modules, all of which must be installed.

    Raises ImportError with the feature (``what``) that needs them and the extra that installs them.
    """
    try:
        module, *_ = map(importlib.import_module, modules)
        return module
    except ImportError as error:
        missing_modules = [name for name in modules if importlib.util.find_spec(name) is None]
        if not missing_modules:  # installed and broken: its own message is more useful
            raise
        missing_names = " and ".join(missing_modules)
        raise ImportError(f"{what} needs {missing_names}: {how_to_install(extra)}") from error
