"""Plain calls again: what was found out about a scene is kept for as long as the scene lives.

Most of a small simulation's time is spent before anything is computed: on checks, on the choice of
the method, on taking the arguments apart. What depends on the scene and the record alone is done
once for each scene; of the state and the times only what depends on numbers is looked at again.
Where something is not surely in order, the long way is taken, which has the messages.

Compiled programs are kept apart from scenes, by what is static in their arguments, so that scenes
that differ in numbers share them.
"""

import math
import weakref
from collections import OrderedDict
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer

from polhode._kernels import Distinct
from polhode._method import AbstractMethod, Record
from polhode._plan import Ways
from polhode._scene import Scene, State
from polhode._trajectory import Trajectory

_KEPT = 128
"""Programs that are kept, those used last."""

_FEW = 256
"""Numbers up to which lists are faster to look through than arrays."""

_SIZES = (8, 64, 512, 4096)
"""Numbers of times that programs are compiled for: fewer times repeat the first."""

_SPARE = {True: 2**11, False: 2**16}
"""Samples up to which that is done, of exact laws and of stepped bodies: they cost less than a
program."""


_TIMED = (
    ("ts", -1),
    ("_wxyz", -2),
    ("_omega_body", -2),
    ("_work", -1),
    ("_motor_work", -2),
    ("_spins", -2),
)
"""Fields of a trajectory with samples, the times first, and the axis of time."""


class _Program(NamedTuple):
    """``run(method, ...)`` compiled, its result taken apart: the structure stands in ``shape``
    from the first call on, with the scene a leaf at ``place`` where it is as it was given;
    ``timed``: see ``_shortened``."""

    call: Callable
    shape: list[Any]
    place: list[int | None]
    timed: list[tuple[int, int]]


class _Known(NamedTuple):
    """What was found out about one scene and record."""

    leaves: list[Any]
    dtype: np.dtype
    ways: Ways
    programs: tuple[_Program, ...]  # of the ways


_SCENES: dict[int, tuple[weakref.ref, dict[Any, _Known]]] = {}
_PROGRAMS: OrderedDict[Any, _Program] = OrderedDict()


def learn(run: Callable, scene: Scene, given: Any, record: Record, ways: Ways) -> None:
    """Keep what ``ways`` there are to move this scene by ``run(method, scene, state, ts, rtol,
    record)``. ``given``: the record as the caller gave it. All has passed the checks."""
    leaves, tree = jax.tree.flatten(Distinct(scene))
    if not leaves or not all(map(_is_local, leaves)):
        return
    if ways.of_state and ways.methods[0].exact:  # the law of this state, not of the scene
        return
    number = id(scene)
    if number not in _SCENES:
        gone = weakref.ref(scene, lambda _: _SCENES.pop(number, None))
        _SCENES[number] = gone, {}
    programs = tuple(_program(run, method, tree, record) for method in ways.methods)
    known = _Known(leaves, np.dtype(leaves[0].dtype), ways, programs)
    _SCENES[number][1][_key(given)] = known


def _key(record: Any) -> Any:
    if record is None:
        return None
    return record.attitude, record.rates, record.final_only, record.work, record.error


def _program(run: Callable, method: AbstractMethod, tree: Any, record: Record) -> _Program:
    key = tree, jax.tree.structure((method, record))
    if key in _PROGRAMS:
        _PROGRAMS.move_to_end(key)
        return _PROGRAMS[key]
    shape: list[Any] = []
    place: list[int | None] = []
    timed: list[tuple[int, int]] = []

    @jax.jit
    def call(ts, rtol, wxyz, omega, speeds, *leaves):
        scene = jax.tree.unflatten(tree, leaves).value()
        found = run(method, scene, State(wxyz, omega, speeds), ts, rtol, record)
        if scene.rotors is None:  # whose motion the initial state decides
            found = eqx.tree_at(lambda t: t.scene, found, _HERE)
        flat, structure = jax.tree.flatten(found)
        shape[:] = [structure]
        place[:] = [next((i for i, x in enumerate(flat) if x is _HERE), None)]
        flat = [x for x in flat if x is not _HERE]
        of_times = ((getattr(found, name), axis) for name, axis in _TIMED)
        timed[:] = [(i, axis) for x, axis in of_times for i, y in enumerate(flat) if y is x]
        return flat

    made = _PROGRAMS[key] = _Program(call, shape, place, timed)
    if len(_PROGRAMS) > _KEPT:
        _PROGRAMS.popitem(last=False)
    return made


_HERE: Any = object()
"""Where the scene goes."""


def again(scene: Any, state: Any, ts: Any, rtol: Any, record: Any) -> Trajectory | None:
    """The trajectory, or None where the long way has to look at the input."""
    found = _SCENES.get(id(scene))
    if found is None or found[0]() is not scene:
        return None
    if type(state) is not State or not (record is None or type(record) is Record):
        return None
    known = found[1].get(_key(record))
    if known is None:
        return None
    wxyz, omega, speeds = state.wxyz, state.omega_body, state.wheel_speed
    for x, size in ((wxyz, 4), (omega, 3)):
        if not _is_local(x) or x.dtype != known.dtype or x.ndim == 0 or x.shape[-1] != size:
            return None
    if speeds is not None and not (_is_local(speeds) and speeds.dtype == known.dtype):
        return None
    times = _times(ts, known.dtype)
    if times is None:
        return None
    ts, span = times
    whole = ts
    eps = float(np.finfo(known.dtype).eps)
    if rtol is None:
        rtol = 1e-9 if eps < 1e-9 else 1e-5
    elif type(rtol) is not float or not 8 * eps <= rtol < 1:
        return None
    if known.ways.of_state and np.count_nonzero(_first(omega)) < 2:
        return None  # a body that turns about one axis may turn about it for ever
    # More than the angle of the fastest body: what is not surely short takes the long way.
    reach = known.ways.reach(rtol, eps)
    if 0 < reach < math.inf and not 2 * _fastest(omega) * span <= reach:
        return None
    number = 0 if reach > 0 else 1
    program, size = known.programs[number], ts.size
    if record is not None and record.final_only:
        ts = np.asarray(ts)[[0, -1]]
    elif size > 2:
        bodies = max(wxyz.size // 4, omega.size // 3, 1)
        most = _SPARE[known.ways.methods[number].exact] // bodies
        size = min((n for n in _SIZES if size <= n <= most), default=size)
        if size != ts.size:
            ts = np.asarray(ts)
            ts = np.concatenate([np.full(size - ts.size, ts[0]), ts])
    leaves = program.call(ts, np.asarray(rtol, known.dtype), wxyz, omega, speeds, *known.leaves)
    if size != whole.size:
        _shortened(leaves, program.timed, whole, size)
    if program.place[0] is not None:
        leaves.insert(program.place[0], scene)
    return jax.tree.unflatten(program.shape[0], leaves)


def _shortened(leaves: list[Any], timed: list[tuple[int, int]], ts: Any, size: int) -> None:
    """Only the samples at ``ts`` of ``size`` samples; nothing is compiled for it. ``timed``: places
    of the leaves that have some, the times first, and on which axis."""
    kept = np.r_[0, np.arange(size - ts.size + 1, size)]
    for place, axis in timed[1:]:
        leaves[place] = jax.numpy.asarray(np.asarray(leaves[place]).take(kept, axis))
    leaves[timed[0][0]] = jax.numpy.asarray(ts)


def _is_local(x: Any) -> bool:
    """Whether x is a JAX array of known numbers on one device."""
    if isinstance(x, Tracer) or not isinstance(x, jax.Array):
        return False
    return jax.device_count() == 1 or len(x.sharding.device_set) == 1


def _fastest(omega: jax.Array) -> float:
    """The largest component of all rates; NaN or infinity if there is one."""
    if omega.size <= _FEW:
        return max(map(abs, np.asarray(omega).ravel().tolist()), default=0.0)
    if jax.default_backend() == "cpu":  # where reading costs nothing
        rates = np.asarray(omega)
        return float(max(rates.max(), -rates.min()))
    return float(jax.numpy.max(jax.numpy.abs(omega)))


def _first(omega: jax.Array) -> np.ndarray:
    """Rates of the first body."""
    whole = omega if jax.default_backend() != "cpu" else np.asarray(omega)
    return np.asarray(whole.reshape(-1, 3)[:1])


def _times(ts: Any, dtype: np.dtype) -> tuple[Any, float] | None:
    """Times in the dtype, and from first to last, if there are two at least, surely in order."""
    if type(ts) is list:
        ts = np.array(ts)
    if type(ts) is np.ndarray:
        if ts.dtype.kind != "f":
            return None
        ts = ts.astype(dtype, copy=False)
    elif not _is_local(ts) or ts.dtype != dtype:
        return None
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
    return (ts, span) if sound else None
