"""The identity of a run: two runs may share a store when theirs are equal."""

import dataclasses
import hashlib
import re
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import numpy as np

LIBRARIES = ("polhode", "jax", "jaxlib", "equinox", "diffrax", "optimistix", "lineax", "numpy")
_BYTES = 2**24


def digest(*values: Any) -> str:
    """A SHA-256 of the structure, the static fields and the numbers of the values.

    Functions count by their name: their code and what it refers to do not.
    """
    structure = re.sub(" at 0x[0-9a-f]+", "", eqx.tree_pformat(values, short_arrays=True))
    sha = hashlib.sha256(structure.encode())
    for leaf in jax.tree.leaves(values):
        if not isinstance(leaf, np.ndarray | np.generic | jax.Array):
            continue
        if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            leaf = jax.random.key_data(leaf)
        array = leaf if isinstance(leaf, np.ndarray) else np.asarray(leaf)
        sha.update(f"{array.dtype} {array.shape}".encode())
        if array.ndim == 0:
            sha.update(array.tobytes())
            continue
        rows = max(1, _BYTES // max(1, array[:1].nbytes))  # an array on disk is read in parts
        for start in range(0, len(array), rows):
            sha.update(np.ascontiguousarray(array[start : start + rows]).data)
    return sha.hexdigest()


def has_user_code(x: Any) -> bool:
    """Whether a value contains a function or a class that is neither of polhode nor of a library
    it is built on, so that its structure and its numbers do not say what it computes.
    """
    if isinstance(x, tuple | list):
        return any(map(has_user_code, x))
    if isinstance(x, Mapping):
        return any(map(has_user_code, x.values()))
    if isinstance(x, np.ndarray | np.generic | jax.Array):
        return False
    if dataclasses.is_dataclass(x) and not isinstance(x, type):
        fields = [getattr(x, field.name, None) for field in dataclasses.fields(x)]
        return _is_foreign(type(x)) or has_user_code(fields)
    return callable(x) and _is_foreign(x)


def _is_foreign(x: Any) -> bool:
    module = getattr(x, "__module__", None) or ""
    # a lambda or an inner function of a library may contain anything
    inner = "<locals>" in getattr(x, "__qualname__", "<locals>")
    return module.partition(".")[0] not in LIBRARIES or (inner and module.startswith("polhode"))


def versions() -> dict[str, str]:
    """The versions that decide the bits of a result."""
    import diffrax

    from polhode import __version__

    return {
        "polhode": __version__,
        "jax": jax.__version__,
        "jaxlib": jax.lib.__version__,
        "diffrax": diffrax.__version__,
    }
