"""Checks of what users hand to ``simulate``: kinds, dtypes, times and tolerances."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from polhode._checks import as_float_array, describe, is_concrete, require
from polhode._method._base import AbstractMethod, Record
from polhode._method._options import made
from polhode._method._status import SimulationError, Status
from polhode._parts import check_fields
from polhode._scene import Scene, State, check_scene


def check_method(method: Any) -> None:
    """Methods are objects, never strings."""
    if method is None or isinstance(method, AbstractMethod):
        return
    import diffrax  # here, so that closed forms do not wait for it

    kind = method if isinstance(method, type) else type(method)
    if isinstance(method, type) and issubclass(method, AbstractMethod):
        given, mend = f"the class {method.__name__}", f": make an object of it, {made(method)}"
    elif issubclass(kind, diffrax.AbstractSolver):
        given, mend = (
            f"the solver {kind.__name__}",
            f": hand it to a chart, ph.LiePoisson({made(method)})",
        )
    else:
        given, mend = type(method).__name__, ""
        if callable(method) and getattr(method, "__module__", "").startswith("polhode."):
            given, mend = f"the function {method.__name__}", f": call it, ph.{method.__name__}()"
    raise TypeError(f"method must be None or an object such as ph.LiePoisson(), got {given}{mend}.")


def check_kinds(scene: Any, state: Any) -> None:
    """A scene and a state."""
    for name, value, kind in (("scene", scene, Scene), ("state", state, State)):
        if not isinstance(value, kind):
            raise TypeError(f"{name} must be a ph.{kind.__name__}, got {type(value).__name__}.")


def check_inputs(
    scene: Any, state: Any, ts: Any, record: Any
) -> tuple[Scene, State, Array, Record]:
    """Kinds, dtypes and times, with messages that tell the mend."""
    check_kinds(scene, state)
    record = _DEFAULT if record is None else record
    if not isinstance(record, Record):
        raise TypeError(f"record must be a ph.Record or None, got {type(record).__name__}.")
    check_scene(scene)
    check_fields(state, "state")
    dtypes = {x.dtype for x in jax.tree.leaves((scene, state)) if isinstance(x, _ARRAYS)}
    dtypes = {x for x in dtypes if jnp.issubdtype(x, jnp.inexact)}
    if len(dtypes) != 1:
        raise TypeError(
            f"scene and state mix the dtypes {sorted(map(str, dtypes))}: make all arrays of one"
            " dtype, for example with jnp.asarray(x, jnp.float64)."
        )
    dtype = dtypes.pop()
    if dtype not in (jnp.float32, jnp.float64):
        raise TypeError(
            f"scene and state are of {dtype}, which is too coarse to move a body by: make all"
            " arrays float32 or float64, for example with jnp.asarray(x, jnp.float32)."
        )
    ts = _times(ts, dtype)
    if is_concrete(ts):
        check_times(np.asarray(ts))
    return scene, state, ts, record


_DEFAULT = Record()
_ARRAYS = (jax.Array, np.ndarray)


def _times(ts: Any, dtype: Any) -> Any:
    """Times (..., T) of the dtype; known ones in NumPy, which costs no dispatch."""
    if type(ts) is list and all(type(x) in (float, int) for x in ts):
        ts = np.asarray(ts, float)
    plain = isinstance(ts, np.ndarray) and ts.dtype.kind == "f" and ts.ndim > 0
    if plain and np.isfinite(ts).all():
        return np.asarray(ts, dtype)
    ts = as_float_array("ts", ts, (None,))
    return ts if ts.dtype == dtype else ts.astype(dtype)


def check_times(ts: np.ndarray) -> None:
    """At least two times, strictly monotonic."""
    if ts.shape[-1] < 2:  # the message costs more than a small simulation
        raise ValueError(
            f"ts must hold at least two times, got {describe(ts)}: the state holds at ts[0]."
        )
    steps = np.diff(ts, axis=-1)
    good = np.all(steps > 0, axis=-1) | np.all(steps < 0, axis=-1)
    if not np.all(good):
        turn = int(np.argwhere((steps <= 0) if steps.flat[0] > 0 else (steps >= 0))[0][-1])
        raise ValueError(
            "ts must be strictly increasing or strictly decreasing (in the dtype of the state,"
            f" {ts.dtype}); entries {turn} and {turn + 1} are {ts[..., turn].flat[0]!r} and"
            f" {ts[..., turn + 1].flat[0]!r}: sort them and drop repeated ones."
        )


def default_rtol(dtype: Any) -> float:
    """What ``rtol=None`` means: 1e-9 in float64, 1e-5 in float32."""
    return 1e-9 if float(jnp.finfo(dtype).eps) < 1e-9 else 1e-5


def check_rtol(rtol: float | None, dtype) -> Array | np.ndarray:
    """The tolerance in the state's dtype; a number that is known stays known under ``jit``."""
    eps = float(jnp.finfo(dtype).eps)
    if rtol is None:
        rtol = default_rtol(dtype)
    if isinstance(rtol, Tracer) and rtol.ndim == 0:
        return jnp.asarray(rtol, dtype)
    number = _number("rtol", rtol)
    require(np.isfinite(number) and number > 0, f"rtol must be positive, got {rtol}.")
    require(
        number >= 8 * eps,
        f"rtol={number:g} is below what {jnp.dtype(dtype).name} can reach (about {8 * eps:.0e}):"
        " raise rtol, or use float64 (jax.config.update('jax_enable_x64', True)).",
    )
    require(
        number < 1,
        f"rtol must be below 1, got {number:g}: it is the error of the attitude in radians, and"
        " that of the momentum relative to its size.",
    )
    return np.asarray(number, dtype)


def _number(name: str, value: Any) -> float:
    """One known real number; TypeError for strings, truth values, arrays and the rest."""
    try:
        if isinstance(value, str | bytes | bool) or np.ndim(value) != 0:
            raise TypeError("no number")
        return float(value)
    except (TypeError, ValueError) as error:
        raise TypeError(
            f"{name} must be one number, such as 1e-9, got {type(value).__name__}: {value!r:.60}."
        ) from error


def raise_on_failure(status: Array) -> None:
    """SimulationError naming what happened to how many bodies, and which came first."""
    ended = np.asarray(status)
    if not ended.any():  # all Status.SUCCESSFUL
        return
    lines = []
    for code in np.unique(ended[ended != Status.SUCCESSFUL]):
        found = np.argwhere(ended == code)
        first = tuple(int(i) for i in found[0])
        which = (
            f"{len(found)} of {ended.size} bodies (first: index {first})" if first else "the body"
        )
        lines.append(f"{which}: {Status(int(code)).explanation}")
    raise SimulationError(
        "; ".join(lines) + ". Pass throw=False to get the trajectory with its status per body.",
        ended,
    )


def judged(status: Array, scene: Scene, ts: Array, rtol: Array | float | None) -> Array:
    """The status (N,) of lanes, or what is wrong with the input of those that were given nonsense.

    What ``check_inputs`` refuses where numbers are known, found in the compiled program where they
    are traced; a few operations for each body. ``scene``: that of the lanes; ``ts`` (T,) or (N, T).
    """
    if rtol is not None:
        least = 8 * float(jnp.finfo(ts.dtype).eps)
        missed = (status == Status.SUCCESSFUL) & ~(rtol >= least * 0.99)
        status = jnp.where(missed, Status.INACCURATE, status)
    status = jnp.where(scene.is_possible, status, Status.NOT_PHYSICAL)
    steps = jax.lax.stop_gradient(ts[..., 1:] - ts[..., :-1])
    ordered = jnp.all(steps > 0, axis=-1) | jnp.all(steps < 0, axis=-1)
    return jnp.where(ordered, status, Status.BAD_TIMES)
