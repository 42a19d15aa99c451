"""The short way of a call with known numbers into its compiled program.

Most of a small simulation's time is spent before anything is computed: on checks, on the choice of
the method, on taking the arguments apart. A scene and a state whose kinds passed the checks once
need only those checks that depend on numbers; where one of these is not surely passed, the long
way is taken, which has the messages.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from polhode._trajectory import Trajectory


class _Entry(NamedTuple):
    program: Callable
    dtype: np.dtype
    shape: Any  # of a trajectory, its scene being one leaf
    looks_long: bool  # whether the method depends on the angle turned through


_ENTRIES: dict[Any, _Entry] = {}
"""By the structure of scene, state and record, which holds all that is static in them."""

_FEW = 256
"""Numbers up to which lists are faster to look through than arrays."""


def learn(run: Callable, motion, scene, state, given, record, *, looks_long: bool) -> None:
    """Keep ``run(scene, state, ts, rtol, record)``, compiled, for calls of the same structure.

    ``motion``: that of the trajectory, without arrays. ``given``: the record as the caller gave it.
    """
    tree = jax.tree.structure((scene, state, given))
    leaf = 0
    bodies = jax.tree.structure((scene, state))
    if tree in _ENTRIES:
        return

    @jax.jit
    def program(ts, *leaves):
        scene, state = jax.tree.unflatten(bodies, leaves)
        found = run(scene, state, ts, None, record)
        return found.ts, found.wxyz, found.omega_body, found.status, found.steps

    kept = (leaf if wanted else None for wanted in (record.attitude, record.rates))
    shape = jax.tree.structure(Trajectory(leaf, *kept, leaf, leaf, leaf, motion=motion))
    _ENTRIES[tree] = _Entry(program, np.dtype(state.wxyz.dtype), shape, looks_long)


def shortcut(scene: Any, state: Any, ts: Any, rtol: Any, record: Any) -> Trajectory | None:
    """The trajectory, or None where the long way has to look at the input."""
    leaves, tree = jax.tree.flatten((scene, state, record))
    entry = _ENTRIES.get(tree)
    if entry is None:
        return None
    if type(ts) is list:
        ts = np.array(ts)
    for x in leaves:
        if not _is_local(x) or x.dtype != entry.dtype:
            return None
    if type(ts) is np.ndarray:
        if ts.dtype.kind != "f":
            return None
        ts = ts.astype(entry.dtype, copy=False)
    elif not _is_local(ts) or ts.dtype != entry.dtype:
        return None
    eps = float(np.finfo(entry.dtype).eps)
    if rtol is None:
        rtol = 1e-9 if eps < 1e-9 else 1e-5
    elif type(rtol) is not float or not 8 * eps <= rtol < 1:
        return None
    span = _span(ts)
    if span is None:
        return None
    if entry.looks_long:
        rates = state.omega_body
        if not 0 < rates.size <= _FEW:
            return None
        # More than the length of the fastest rate: what is not surely short takes the long way.
        fastest = max(map(abs, np.asarray(rates).ravel().tolist())) * 2
        if not eps * fastest * span <= 10 * rtol:
            return None
    kept, *parts = entry.program(ts, *leaves)
    wxyz, omega, status, steps = parts
    leaves = (x for x in (kept, wxyz, omega, status, steps, scene) if x is not None)
    return jax.tree.unflatten(entry.shape, leaves)


def _is_local(x: Any) -> bool:
    """Whether x is a JAX array of known numbers on one device."""
    if isinstance(x, jax.core.Tracer) or not isinstance(x, jax.Array):
        return False
    return jax.device_count() == 1 or len(x.sharding.device_set) == 1


def _span(ts: Any) -> float | None:
    """Time from first to last, if there are two at least and they are surely in order."""
    if ts.ndim != 1 or ts.size < 2:
        return None
    times = np.asarray(ts)
    first, last = float(times[0]), float(times[-1])
    span = abs(last - first)
    if not span < math.inf:
        return None
    if times.size > 2:
        steps = times[1:] - times[:-1]
        sound = steps.min() > 0 if last > first else steps.max() < 0
    else:
        sound = span > 0
    return span if sound else None
