"""What two runs must share for their chunks to belong together."""

import dataclasses
import enum
import functools
import hashlib
import inspect
import sys
import sysconfig
import types
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

_BYTES = 2**24


def digest(*values: Any) -> str:
    """A SHA-256 over everything that the values hold: numbers of arrays, static fields, and of
    functions the code, defaults, closures and the globals that they name.

    Equal values give equal digests in every process. Functions of this package and of installed
    libraries count by name: the versions are part of the identity already.
    """
    walk = _Walk()
    walk.value(values)
    return walk.sha.hexdigest()


class _Walk:
    def __init__(self):
        self.sha = hashlib.sha256()
        self.seen: dict[int, int] = {}  # a function may name itself
        self.kept: list[Any] = []

    def text(self, *words: Any) -> None:
        self.sha.update(repr(words).encode())

    def value(self, x: Any) -> None:
        if x is None or isinstance(x, bool | int | float | complex | str | bytes | enum.Enum):
            self.text(type(x).__qualname__, x)
        elif isinstance(x, np.ndarray | np.generic | jax.Array):
            self.array(x)
        elif isinstance(x, tuple | list):
            self.text(type(x).__qualname__, len(x))
            for item in x:
                self.value(item)
        elif isinstance(x, Mapping):
            self.text(type(x).__qualname__, len(x))
            for key in sorted(x, key=repr):
                self.value(key)
                self.value(x[key])
        elif isinstance(x, set | frozenset):
            self.text(type(x).__qualname__, sorted(map(repr, x)))
        elif id(x) in self.seen:
            self.text("again", self.seen[id(x)])
        else:
            self.seen[id(x)] = len(self.seen)
            self.kept.append(x)  # an id is that of one thing only while the thing lives
            self.thing(x)

    def array(self, x: Any) -> None:
        if isinstance(x, jax.Array) and jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
            x = jax.random.key_data(x)
        self.text("array", str(x.dtype), x.shape)
        flat = np.asarray(x) if isinstance(x, jax.Array | np.generic) else x
        if flat.ndim == 0:
            self.sha.update(flat.tobytes())
            return
        rows = max(1, _BYTES // max(1, flat[:1].nbytes))  # an array on disk is read bit by bit
        for start in range(0, len(flat), rows):
            self.sha.update(np.ascontiguousarray(flat[start : start + rows]).data)

    def thing(self, x: Any) -> None:
        if isinstance(x, type):
            self.kind(x)
        elif isinstance(x, types.FunctionType):
            self.function(x)
        elif isinstance(x, types.MethodType):
            self.value((x.__func__, x.__self__))
        elif isinstance(x, functools.partial):
            self.value(("partial", x.func, x.args, x.keywords))
        elif isinstance(x, types.ModuleType):
            self.text("module", x.__name__)
        elif isinstance(inner := getattr(x, "__wrapped__", None), types.FunctionType):
            self.value(("wrapped", inner))
        elif dataclasses.is_dataclass(x):
            self.value(type(x))
            for field in dataclasses.fields(x):
                self.text(field.name)
                self.value(getattr(x, field.name, None))
        else:
            self.value(type(x))
            state = {**_slots(x), **getattr(x, "__dict__", {})}
            if state:
                self.value(state)
            elif " at 0x" not in repr(x):
                self.text(repr(x))
            else:
                self.text(getattr(x, "__qualname__", ""))

    def kind(self, x: type) -> None:
        self.text("class", x.__module__, x.__qualname__)
        if _installed(x.__module__):
            return
        for base in x.__bases__:
            self.value(base)
        for name, member in sorted(vars(x).items()):
            member = inspect.unwrap(getattr(member, "method", member))
            hidden = name.startswith("__") and name != "__call__"
            if isinstance(member, types.FunctionType) and not hidden:
                self.value(member)

    def function(self, f: types.FunctionType) -> None:
        self.text("function", f.__module__, f.__qualname__)
        if _installed(f.__module__):
            if "<locals>" in f.__qualname__:  # what an inner function was given still counts
                self.cells(f)
            return
        self.code(f.__code__)
        self.value((f.__defaults__, f.__kwdefaults__))
        self.cells(f)
        for name in sorted(_names(f.__code__)):
            if name in f.__globals__:
                self.text(name)
                self.value(f.__globals__[name])

    def cells(self, f: types.FunctionType) -> None:
        found = inspect.getclosurevars(f).nonlocals if f.__closure__ else {}
        self.value(dict(found))

    def code(self, code: types.CodeType) -> None:
        self.text(code.co_name, code.co_code, code.co_names, code.co_varnames)
        for constant in code.co_consts:
            if isinstance(constant, types.CodeType):
                self.code(constant)
            elif isinstance(constant, frozenset):
                self.text(sorted(map(repr, constant)))
            else:
                self.text(repr(constant))


def _names(code: types.CodeType) -> set[str]:
    found = set(code.co_names)
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            found |= _names(constant)
    return found


def _slots(x: Any) -> dict[str, Any]:
    names = [n for kind in type(x).__mro__ for n in getattr(kind, "__slots__", ())]
    return {n: getattr(x, n) for n in names if not n.startswith("__") and hasattr(x, n)}


@functools.cache
def _installed(module: str | None) -> bool:
    """Whether a module belongs to this package, the standard library or an installed library."""
    if module in (None, "__main__"):
        return False
    top = module.split(".")[0]
    if top in ("polhode", "builtins"):
        return True
    if top in sys.stdlib_module_names:
        return True
    place = getattr(sys.modules.get(top), "__file__", None) or ""
    return place.startswith((sysconfig.get_path("purelib"), sysconfig.get_path("platlib")))
