"""polhode: rotating rigid bodies in JAX (simulate, differentiate, identify).

The names of `_public` are here, imported when the first of them is asked for: `polhode --help` and
mistakes in a scene file are told before JAX is loaded.
"""

import importlib.util
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from polhode._public import *  # noqa: F403 - the names, for type checkers


def __getattr__(name: str) -> Any:
    if name.startswith("_") and name != "__all__":
        raise AttributeError(f"module 'polhode' has no attribute {name!r}")
    if importlib.util.find_spec(f"polhode.{name}") is not None:  # a room, not yet imported
        return importlib.import_module(f"polhode.{name}")
    public = importlib.import_module("polhode._public")
    names = {key: value for key, value in vars(public).items() if not key.startswith("_")}
    if name == "__all__":
        return sorted(names)
    globals().update(names)
    if name in names:
        return names[name]
    raise AttributeError(f"module 'polhode' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__getattr__("__all__")})
