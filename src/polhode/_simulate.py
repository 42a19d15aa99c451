"""The one entry point: a scene, a state and times give a trajectory."""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from polhode import rotation
from polhode._checks import as_float_array, describe, is_concrete, require
from polhode._closed_form import ClosedForm
from polhode._lanes import PARTS, common_batch, flatten
from polhode._mesh import Split, on_devices, place, split_of
from polhode._methods import AbstractMethod, Record, Samples
from polhode._plan import Plan, choose, plan
from polhode._scene import Scene
from polhode._shortcut import learn, shortcut
from polhode._state import State
from polhode._status import SimulationError, Status
from polhode._trajectory import Trajectory
from polhode.inertia import Symmetry


def simulate(
    scene: Scene,
    state: State,
    ts: Float[ArrayLike, "*#b t"],
    method: AbstractMethod | None = None,
    *,
    rtol: float | None = None,
    record: Record | None = None,
    throw: bool = True,
) -> Trajectory:
    """Move every body of the scene from ``state`` at ``ts[0]`` through the times ``ts``.

    **Arguments:**

    - ``scene``, ``state``: see ``ph.Scene``, ``ph.State``; batch axes broadcast together. A batch
      that is sharded over several devices (``NamedSharding``) stays so: each device moves its own
      bodies and the compiled program exchanges nothing (see docs/scale.md; under ``jit`` and
      ``grad`` for meshes of explicit axes).
    - ``ts``: (T,) or (..., T) [s], strictly increasing or strictly decreasing.
    - ``method``: None lets the library choose; or ``ph.LiePoisson(...)``, ``ph.EulerAngles(...)``.
    - ``rtol``: error asked for, attitude in radians and momenta relative to their size, at the
      last time when the library chooses the method, of each step where the method says so;
      None: 1e-9 in float64, 1e-5 in float32. Exact methods ignore it.
    - ``record``: what to keep; None: attitude and rates at all times.
    - ``throw``: raise ``ph.SimulationError`` when a body did not finish. Under ``jit``, ``vmap``
      or ``grad`` nothing is raised: look at ``Trajectory.status``.

    Raises ValueError or TypeError for bad input: wrong kinds or shapes, unsorted times, mixed
    dtypes, a tolerance that the dtype cannot reach.
    """
    if method is None:
        trajectory = shortcut(scene, state, ts, rtol, record)
        if trajectory is not None:
            return checked(trajectory, throw)
    given = record
    scene, state, ts, record = check_inputs(scene, state, ts, record)
    check_method(method)
    rtol = check_rtol(rtol, state.wxyz.dtype)
    split = split_of(scene, state, ts)
    if method is None:
        method, _ = choose(scene, state, record, rtol, ts)
        if split is None and _is_simple(method, scene, state, record):
            depends = scene.inertia.symmetry is Symmetry.NONE
            learn(partial(_trajectory, method), scene, state, given, record, looks_long=depends)
            trajectory = shortcut(scene, state, ts, None, given)
            if trajectory is not None:
                return checked(trajectory, throw)
    if split is not None and is_concrete(scene, state, ts):
        scene, state, ts = place(split, scene, state, ts)
    return checked(run(method, scene, state, ts, rtol, record, split), throw)


def checked(trajectory: Trajectory, throw: bool) -> Trajectory:
    """The trajectory; raises for bodies that did not finish where that is known."""
    if throw and not isinstance(trajectory.status, jax.core.Tracer):
        raise_on_failure(trajectory)
    return trajectory


def _is_simple(method, scene: Scene, state: State, record: Record) -> bool:
    """Whether calls of this structure may take the short way."""
    plain = isinstance(method, ClosedForm) and not (method.compensated or record.error)
    return plain and not record.work and is_concrete(scene, state)


def explain(
    scene: Scene,
    state: State,
    ts: Float[ArrayLike, "*#b t"],
    method: AbstractMethod | None = None,
    *,
    rtol: float | None = None,
    record: Record | None = None,
) -> Plan:
    """What ``simulate`` would run with the same arguments, what is skipped, and why: print it.

    Nothing is simulated. Raises as ``simulate`` does for bad input.
    """
    scene, state, ts, record = check_inputs(scene, state, ts, record)
    check_method(method)
    return plan(scene, state, ts, method, check_rtol(rtol, state.wxyz.dtype), record)


@eqx.filter_jit
def run(method, scene, state, ts, rtol, record, split: Split | None = None) -> Trajectory:
    """The compiled part: lanes out of batches, the method, and back."""
    return _trajectory(method, scene, state, ts, rtol, record, split)


def _trajectory(method, scene, state, ts, rtol, record, split=None) -> Trajectory:
    scene = scene.settled(state, ts[..., 0])
    if split is None:
        found = _moved(record, method, scene, state, ts, rtol)
    else:
        found = on_devices(split, partial(_moved, record), method, scene, state, ts, rtol)
    wxyz, omega, status, steps, work, error = found
    kept = ts[..., -1:] if record.final_only else ts
    trajectory = Trajectory(kept, wxyz, omega, status, steps, scene, work, error)
    if record.work and method.exact:
        work = _work_of_exact(trajectory, state, ts[..., :1])
        return eqx.tree_at(lambda t: t.work, trajectory, work, is_leaf=lambda x: x is None)
    return trajectory


def _moved(record, method, scene, state, ts, rtol) -> Samples:
    parts = (getattr(scene, name) for name in PARTS)
    batch = common_batch(*parts, state, extra=(ts.shape[:-1],))
    parts = {name: flatten(getattr(scene, name), batch) for name in PARTS}
    lanes = flatten(state, batch, shared=False)
    times = ts
    if ts.ndim > 1:
        times = jnp.broadcast_to(ts, (*batch, ts.shape[-1])).reshape(-1, ts.shape[-1])
    if record.error:
        samples = _with_error(method, Scene(**parts), lanes, times, rtol, record)
    else:
        samples = method.run(Scene(**parts), lanes, times, rtol, record)
    return jax.tree.map(lambda x: x.reshape(*batch, *x.shape[1:]), samples)


def _work_of_exact(trajectory: Trajectory, state: State, start: Array) -> Array:
    """Work of the torques in an exact motion: nothing, or what the rates gain (no potential)."""
    if trajectory.scene.torque is None:
        return jnp.zeros((*trajectory.batch_shape, trajectory.ts.shape[-1]), start.dtype)
    batch = trajectory.batch_shape
    wxyz, omega = (
        jnp.broadcast_to(x[..., None, :], (*batch, 1, x.shape[-1]))
        for x in (state.wxyz, state.omega_body)
    )
    first = Trajectory(start, wxyz, omega, trajectory.status, trajectory.steps, trajectory.scene)
    return trajectory.energy - first.energy


_COARSER = 30
"""How much looser the second run is that an error estimate comes from."""

_TRUSTED = 3
"""What the distance of the two runs is divided by; 29 if errors kept to the tolerances."""

_ROUNDING = (10, 1000)
"""Units in the last place of the angle turned: always added; below, two runs differ by rounding."""

_ALLOWED = 10
"""How often an error may exceed the tolerance before the body is called inaccurate."""


def _with_error(method, scene, lanes, times, rtol, record) -> Samples:
    """The samples, and for each body the estimated error of its attitude at the last time [rad]."""
    plain = Record(record.attitude, record.rates, record.final_only, record.work)
    size = jnp.linalg.norm(jax.lax.stop_gradient(lanes.omega_body), axis=-1)
    turned = jnp.maximum(1, size * jnp.abs(times[..., -1] - times[..., 0]))
    ulps = jnp.finfo(size.dtype).eps * turned
    if method.exact:
        return method.run(scene, lanes, times, rtol, plain)._replace(error=ulps)
    if method.asked_at_end is None:
        raise ValueError(
            "Record(error=True) compares two tolerances, and this method has a step-size controller"
            " of its own: leave it out, or drop error=True."
        )

    def at(rtol):
        return method.run(scene, lanes, times, rtol, plain)

    both = jax.lax.map(at, jnp.stack([rtol, _COARSER * rtol]))
    fine, coarse = (jax.tree.map(lambda x, i=i: x[i], both) for i in (0, 1))
    if record.attitude:
        gap = rotation.angle_between(fine.wxyz[:, -1], coarse.wxyz[:, -1])
    else:
        change = jnp.linalg.norm(fine.omega_body[:, -1] - coarse.omega_body[:, -1], axis=-1)
        gap = change / jnp.maximum(jnp.linalg.norm(fine.omega_body[:, -1], axis=-1), size)
    gap = jax.lax.stop_gradient(gap)
    always, below = (count * ulps for count in _ROUNDING)
    error = always + jnp.maximum(gap / _TRUSTED, jnp.minimum(gap, below))
    status = fine.status
    if method.asked_at_end:
        good = (status != Status.SUCCESSFUL) | (error <= _ALLOWED * rtol)
        status = jnp.where(good, status, Status.INACCURATE)
    return fine._replace(status=status, error=error)


def check_method(method: Any) -> None:
    """Methods are objects, never strings."""
    if method is not None and not isinstance(method, AbstractMethod):
        raise TypeError(
            "method must be None or an object such as ph.LiePoisson(), got"
            f" {type(method).__name__}."
        )


def check_inputs(
    scene: Any, state: Any, ts: Any, record: Any
) -> tuple[Scene, State, Array, Record]:
    """Kinds, dtypes and times, with messages that tell the mend."""
    for name, value, kind in (("scene", scene, Scene), ("state", state, State)):
        if not isinstance(value, kind):
            raise TypeError(f"{name} must be a ph.{kind.__name__}, got {type(value).__name__}.")
    record = Record() if record is None else record
    if not isinstance(record, Record):
        raise TypeError(f"record must be a ph.Record or None, got {type(record).__name__}.")
    dtypes = {x.dtype for x in jax.tree.leaves((scene, state)) if eqx.is_inexact_array(x)}
    if len(dtypes) != 1:
        raise TypeError(
            f"scene and state mix the dtypes {sorted(map(str, dtypes))}: make all arrays of one"
            " dtype, for example with jnp.asarray(x, jnp.float64)."
        )
    ts = as_float_array("ts", ts, (None,)).astype(dtypes.pop())
    if is_concrete(ts):
        check_times(np.asarray(ts))
    return scene, state, ts, record


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


def check_rtol(rtol: float | None, dtype) -> Array | np.ndarray:
    """The tolerance in the state's dtype; a number that is known stays known under ``jit``."""
    eps = float(jnp.finfo(dtype).eps)
    if rtol is None:
        rtol = 1e-9 if eps < 1e-9 else 1e-5
    if is_concrete(rtol):
        require(np.isfinite(rtol) and rtol > 0, f"rtol must be positive, got {rtol}.")
        require(
            float(rtol) >= 8 * eps,
            f"rtol={rtol:g} is below what {jnp.dtype(dtype).name} can reach (about {8 * eps:.0e}):"
            " raise rtol, or use float64 (jax.config.update('jax_enable_x64', True)).",
        )
        return np.asarray(rtol, dtype)
    return jnp.asarray(rtol, dtype)


def raise_on_failure(trajectory: Trajectory) -> None:
    """SimulationError naming what happened to how many bodies, and which came first."""
    status = np.asarray(trajectory.status)
    if not status.any():  # all Status.SUCCESSFUL
        return
    lines = []
    for code in np.unique(status[status != Status.SUCCESSFUL]):
        found = np.argwhere(status == code)
        first = tuple(int(i) for i in found[0])
        which = (
            f"{len(found)} of {status.size} bodies (first: index {first})" if first else "the body"
        )
        lines.append(f"{which}: {Status(int(code)).explanation}")
    raise SimulationError(
        "; ".join(lines) + ". Pass throw=False to get the trajectory with its status per body.",
        status,
    )
