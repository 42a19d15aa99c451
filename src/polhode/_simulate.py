"""``ph.simulate`` and ``ph.explain``: input checks, choice of the method, and the compiled call."""

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float

from polhode import _policy, rotation
from polhode._batch import (
    PARTS,
    Split,
    common_batch,
    flatten,
    is_lane_tree,
    lane_times,
    map_arrays,
    on_devices,
    place,
    split_of,
)
from polhode._checks import ArrayLike, is_concrete
from polhode._events import (
    Event,
    check_until,
    checked_events,
    events_by_search,
    events_by_steps,
    require_bodies,
    stop_at_event,
)
from polhode._failed import sound_state, with_gradients
from polhode._kernels import Distinct, is_differentiated, jit_distinct, kernel, map_chunks
from polhode._method import (
    AbstractMethod,
    Record,
    Samples,
    Status,
    StepCounts,
    check_inputs,
    check_method,
    check_rtol,
    raise_on_failure,
    status_with_input_errors,
)
from polhode._parts import all_input_conditions
from polhode._plan import Plan, choose, plan
from polhode._sampled import HeldPropagator, is_sampled, sampled_method
from polhode._scene import Scene, State
from polhode._trajectory import Propagator, Trajectory, final_of, values_of, with_saved


def simulate(
    scene: Scene,
    state: State,
    ts: Float[ArrayLike, "*#b t"],
    method: AbstractMethod | None = None,
    *,
    rtol: float | None = None,
    record: Record | None = None,
    until: Event | None = None,
    events: Event | Sequence[Event] | None = None,
    throw: bool | None = None,
) -> Trajectory:
    """Simulate the motion of a scene from ``state`` at ``ts[0]``, and save it at the times ``ts``.

    **Arguments:**

    - ``scene``, ``state``: see ``ph.Scene``, ``ph.State``; batch axes broadcast together. A batch
      that is sharded over several devices (``NamedSharding``) stays sharded: each device simulates
      its own bodies and nothing is exchanged (see docs/scale.md; under ``jit`` and
      ``grad`` for meshes of explicit axes).
    - ``ts``: (T,) or (..., T) [s], strictly increasing or strictly decreasing.
    - ``method``: None: chosen by polhode (docs/methods.md); or ``ph.LiePoisson(...)``,
      ``ph.EulerAngles(...)``.
    - ``rtol``: bound of the accumulated local error at the saved times, of the attitude in radians
      and of the momentum relative to its size; None: 1e-9 in float64, 1e-5 in float32. Closed
      forms ignore it. What it controls and what not: docs/methods.md, "What `rtol` means".
    - ``record``: what is saved; None: attitude and rates at all times. ``ph.Record(save=fn)`` saves
      a function of the motion instead.
    - ``until``: a ``ph.Event`` at which each body stops. Its times and samples from there on are
      those of the event, so that ``Trajectory.last`` is the state from which to continue;
      ``Trajectory.event_time`` is inf for a body without an event. The cost depends on the time
      of the last event of the batch, not on the last of ``ts``. Times and states have first and
      second derivatives; a third one raises NotImplementedError.
    - ``events``: one or several ``ph.Event``, searched for while the motion is integrated:
      ``Trajectory.events`` contains their times, states and indices, in the order of the motion. A
      body stops at an event with ``terminal=True`` as with ``until``. A body with more events than
      the sum of their ``capacity`` has the status ``TOO_MANY_EVENTS``. A motion in closed form is
      searched as by ``ph.crossings`` (under ``jit`` each event needs ``samples``).
    - ``throw``: whether an error is raised if a body did not finish. None: ``ph.SimulationError``
      if the status is concrete, as it is in ``jax.grad`` outside of ``jit``; under ``jit`` or
      ``vmap`` nothing is raised: check ``Trajectory.status``. True: under ``jit`` as well, when the
      compiled program runs (by ``equinox.error_if``: a RuntimeError under ``equinox.filter_jit``,
      an error of JAX under ``jax.jit``). False: never. The states of a failed body are NaN from its
      failure on; for a mean over the others see ``ph.successful_mean``.

    Raises ValueError or TypeError for bad input: wrong kinds or shapes, unsorted times, mixed
    dtypes, a tolerance that the dtype cannot reach.
    """
    if until is not None:
        check_until(until, record)
    _refuse_events_of_commands(scene, until, events)
    if events is not None:
        return _with_events(scene, state, ts, method, rtol, record, until, events, throw)
    scene, state, ts, record = check_inputs(scene, state, ts, record)
    check_method(method)
    checked_rtol = check_rtol(rtol, state.wxyz.dtype)
    split = split_of(scene, state, ts)
    if is_sampled(scene):
        method = sampled_method(method, scene, ts, checked_rtol, record)
    elif method is None:
        method, _ = choose(scene, checked_rtol)
    if split is not None and is_concrete(scene, state, ts):
        scene, state, ts = place(split, scene, state, ts)
    if until is not None:
        require_bodies(state.wxyz)
        trajectory = _stopped_at(until, method, scene, state, ts, checked_rtol)
        return checked(_reduced(trajectory, record), throw)
    return checked(run(method, scene, state, ts, checked_rtol, record, split), throw)


def _refuse_events_of_commands(scene: Scene, until, events) -> None:
    if (until is None and events is None) or not isinstance(scene, Scene) or not is_sampled(scene):
        return
    raise ValueError(
        "events are not searched for in a scene with a SampledTorque: save the motion at the ends"
        " of its periods and search the samples, or use ph.FeedbackTorque."
    )


def _with_events(scene, state, ts, method, rtol, record, until, events, throw) -> Trajectory:
    """``simulate`` with events."""
    events = checked_events(events, until, record)
    scene, state, ts, record = check_inputs(scene, state, ts, record)
    check_method(method)
    require_bodies(state.wxyz)
    checked_rtol = check_rtol(rtol, state.wxyz.dtype)
    if method is None:
        method, _ = choose(scene, checked_rtol)
    trajectory_with_events = _events_met(events, method, scene, state, ts, checked_rtol)
    if trajectory_with_events is None:
        trajectory = run(method, scene, state, ts, checked_rtol, record.of_states, None)
        trajectory_with_events = events_by_search(checked(trajectory, throw), events)
    return checked(_reduced(trajectory_with_events, record), throw)


def _reduced(trajectory: Trajectory, record: Record) -> Trajectory:
    """The trajectory with the values of ``Record(save=)`` instead of its states, if it is set."""
    return trajectory if record.save is None else _with_saved(trajectory, record.save)


_with_saved = jit_distinct(with_saved)


def checked(trajectory: Trajectory, throw: bool | None) -> Trajectory:
    """The trajectory; raises for bodies that did not finish, according to ``throw``."""
    if throw is False:
        return trajectory
    if not isinstance(trajectory.status, Tracer):
        raise_on_failure(trajectory.status)
        return trajectory
    # no check by default: it is a callback, and programs on accelerators wait for callbacks
    return _checked_at_run_time(trajectory) if throw else trajectory


def _checked_at_run_time(trajectory: Trajectory) -> Trajectory:
    """The trajectory, whose samples and status depend on a check in the compiled program."""
    failed = trajectory.status != Status.SUCCESSFUL
    worst = jnp.max(trajectory.status, initial=Status.SUCCESSFUL)
    messages = [f"a body did not finish: {status.explanation}" for status in Status]

    def samples(t):
        saved_values, final = jax.tree.leaves(t._saved), t._final or ()
        return [x for x in (t.ts, *t._samples, t._work, *final, *saved_values) if x is not None]

    # The check is a factor of one, so that derivatives depend on it as well, even in a program that
    # contains nothing else.
    one = eqx.branched_error_if(jnp.ones((), trajectory.ts.dtype), failed, worst, messages)
    bound = [x * one.astype(x.dtype) for x in samples(trajectory)]
    trajectory = eqx.tree_at(samples, trajectory, bound)
    status = trajectory.status * one.astype(trajectory.status.dtype)
    return eqx.tree_at(lambda t: t.status, trajectory, status)


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
    checked_rtol = check_rtol(rtol, state.wxyz.dtype)
    if is_sampled(scene):
        method = sampled_method(method, scene, ts, checked_rtol, record)
        return plan(scene, state, ts, method, checked_rtol, record, "the torque is sampled")
    return plan(scene, state, ts, method, checked_rtol, record)


@jit_distinct
def run(method, scene, state, ts, rtol, record, split: Split | None = None) -> Trajectory:
    """The compiled part: from batches to lanes, the method, and back to batches."""
    state, is_sound = _sound(method, scene, state, ts)
    scene, state = scene.settled(state, ts[..., 0]), state.without_wheels
    if split is None:
        samples = _motion_samples(record, method, scene, state, ts, rtol)
    else:
        samples = on_devices(
            split, partial(_motion_samples, record), method, scene, state, ts, rtol
        )
    wxyz, omega, status, steps, work, error, motors, spins, saved, final = samples
    saved_times = ts[..., -1:] if record.final_only else ts
    propagator = HeldPropagator() if is_sampled(scene) else Propagator.of(method, rtol)
    trajectory = Trajectory(
        saved_times,
        wxyz,
        omega,
        status,
        steps,
        scene,
        work,
        error,
        motors,
        spins,
        propagator,
        saved=saved,
        final=final,
    )
    return _with_failures(trajectory, is_sound)


@jit_distinct
def _stopped_at(until, method, scene, state, ts, rtol) -> Trajectory:
    state, is_sound = _sound(method, scene, state, ts)
    trajectory = stop_at_event(_begin(method, scene, state, ts, rtol), ts, until)
    return _with_failures(trajectory, is_sound)


@jit_distinct
def _events_met(events, method, scene, state, ts, rtol) -> Trajectory | None:
    state, is_sound = _sound(method, scene, state, ts)
    trajectory = events_by_steps(_begin(method, scene, state, ts, rtol), ts, events)
    return None if trajectory is None else _with_failures(trajectory, is_sound)


def _sound(method: AbstractMethod, scene: Scene, state: State, ts: Array) -> tuple[State, Array]:
    """The state and whether it is valid, by ``sound_state``.

    NaN is replaced in programs that compute derivatives; otherwise every method propagates NaN.
    Bodies with invalid limits or edges (see ``input_conditions``) are never valid. The replacement
    is a body at rest, which takes few steps to integrate; for closed forms it is a rotating body,
    because they have separate formulas for a body at rest.
    """
    inputs = jax.tree.leaves(eqx.filter((scene, state, ts), eqx.is_inexact_array))
    rate = 1.0 if method.exact else 0.0
    state, is_sound = sound_state(state, is_differentiated(inputs), rate)
    for name in PARTS:
        for condition in all_input_conditions(getattr(scene, name)):
            is_sound = jnp.logical_and(*jnp.broadcast_arrays(is_sound, condition))
    return state, is_sound


def _with_failures(trajectory: Trajectory, is_sound: Array) -> Trajectory:
    """The trajectory, NaN where the initial state was not ``is_sound``, with gradients of the
    bodies that finished: see ``_failed``."""
    is_sound = jnp.broadcast_to(is_sound, trajectory.batch_shape)
    status = jnp.where(is_sound, trajectory.status, Status.NOT_FINITE)
    finished = (status == Status.SUCCESSFUL) | (status == Status.TOO_MANY_EVENTS)
    any_finished = jnp.where(jnp.any(finished), 1.0, 0.0)
    computed = jax.tree.map(
        lambda x: (
            with_gradients(x, is_sound, any_finished) if jnp.issubdtype(x.dtype, jnp.inexact) else x
        ),
        _computed(trajectory),
    )
    trajectory = eqx.tree_at(_computed, trajectory, computed, is_leaf=lambda x: x is None)
    return eqx.tree_at(lambda t: t.status, trajectory, status)


def _computed(t: Trajectory) -> list[Any]:
    """The computed arrays of a trajectory, whose first axes are those of the batch."""
    samples = [t._wxyz, t._omega_body, t._spins, t._work, t._motor_work, t._saved, t._final]
    return [*samples, t._error, t._ending, t._events]


def _begin(method, scene, state, ts, rtol) -> Trajectory:
    """A trajectory whose only sample is the state at the first time."""
    state = state.as_unit()
    scene, state = scene.settled(state, ts[..., 0]), state.without_wheels
    parts = {name: getattr(scene, name) for name in PARTS}
    batch = common_batch(*parts.values(), state, extra=(ts.shape[:-1],))
    wxyz, omega = (
        jnp.broadcast_to(x, (*batch, x.shape[-1])) for x in (state.wxyz, state.omega_body)
    )
    spins = scene.dynamics.wheels.initial_spins(omega[..., 0]) if scene.dynamics.coupled else ()
    lanes = {name: flatten(part, batch) for name, part in parts.items()}
    times = lane_times(ts, batch)
    good = jnp.full(omega[..., 0].size, Status.SUCCESSFUL)
    status = status_with_input_errors(good, Scene(**lanes), times, rtol).reshape(batch)
    return Trajectory(
        ts[..., :1],
        wxyz[..., None, :],
        omega[..., None, :],
        status,
        StepCounts.of(jnp.zeros_like(status)),
        scene,
        spins=jnp.stack(spins, axis=-1)[..., None, :] if spins else None,
        propagator=Propagator.of(method, rtol),
    )


def _motion_samples(record, method, scene, state, ts, rtol) -> Samples:
    parts = (getattr(scene, name) for name in PARTS)
    batch = common_batch(*parts, state, extra=(ts.shape[:-1],))
    if 0 in batch:
        return _samples_of_no_body(batch, record, method, scene, state, ts, rtol)
    parts = {name: flatten(getattr(scene, name), batch) for name in PARTS}
    are_few = (
        state.wxyz.size <= 4 * _policy.KERNEL_BODIES
    )  # a task of XLA takes as long as to normalise a few states
    unit = (kernel(State.as_unit) if are_few else State.as_unit)(state)
    lanes = flatten(unit, batch, shared=False)
    times = lane_times(ts, batch)
    if record.save is None:
        samples = _samples(record, method, Scene(**parts), lanes, times, rtol)
    else:
        samples = _saved(record, method, Scene(**parts), lanes, times, rtol)
    return jax.tree.map(lambda x: x.reshape(*batch, *x.shape[1:]), samples)


def _samples_of_no_body(batch, record, method, scene, state, ts, rtol) -> Samples:
    """Samples of an empty batch: their shapes are inferred from those of one body."""

    def one(x, rank):
        lead = tuple(max(1, n) for n in x.shape[: x.ndim - rank])
        return jnp.ones((*lead, *x.shape[x.ndim - rank :]), x.dtype)

    parts = {name: map_arrays(getattr(scene, name), one) for name in PARTS}
    body = record, method, type(scene)(**parts), map_arrays(state, one), one(ts, 1), rtol
    shapes = eqx.filter_eval_shape(_motion_samples, *body)
    return jax.tree.map(lambda x: jnp.zeros((*batch, *x.shape[len(batch) :]), x.dtype), shapes)


def _samples(record: Record, method, scene: Scene, lanes: State, times, rtol) -> Samples:
    """Samples of N lanes."""
    run_record = record
    if record.work and method.exact:  # the work is computed from the rates
        run_record = dataclasses.replace(record, rates=True)
    if record.error:
        samples = _with_error(method, scene, lanes, times, rtol, run_record)
    else:
        samples = method.run(scene, lanes, times, rtol, run_record)._replace(error=None)
    samples = samples._replace(status=status_with_input_errors(samples.status, scene, times, rtol))
    if not (record.work and method.exact):
        return samples
    work = _work_of_exact(scene, lanes, times, samples, record)
    return samples._replace(work=work, omega_body=samples.omega_body if record.rates else None)


def _saved(record: Record, method, scene: Scene, lanes: State, times, rtol) -> Samples:
    """Values of ``Record(save=)`` for N lanes. The motion and its function are computed for one
    chunk of bodies at a time, so that only the states of a chunk are in memory."""
    lanes_of_batch, shared = eqx.partition((scene, lanes), is_lane_tree((scene, lanes)))
    n, body_times = lanes.wxyz.shape[0], times if times.ndim == 2 else None
    assert record.save is not None
    save = record.save

    def reduced(chunk):
        chunk_lanes, chunk_times = chunk.value()
        scene, lanes = eqx.combine(chunk_lanes, shared)
        rows = times if chunk_times is None else chunk_times
        samples = _samples(record.of_states, method, scene, lanes, rows, rtol)
        rows = rows[..., -1:] if record.final_only else rows
        values = values_of(save, scene, rows, samples)
        final = final_of(samples.wxyz, samples.omega_body, samples.spins)
        return samples._replace(wxyz=None, omega_body=None, spins=None, saved=values, final=final)

    size = _policy.bodies_to_save(1 if record.final_only else times.shape[-1])
    return map_chunks(reduced, Distinct((lanes_of_batch, body_times)), n, size)


def _work_of_exact(scene: Scene, state: State, ts: Array, samples: Samples, record: Record):
    """Work of the torques in a motion in closed form: zero, or the change of the energy (there is
    no potential)."""
    rows = ts[..., -1:] if record.final_only else ts
    if scene.torque is None:
        return jnp.zeros((state.wxyz.shape[0], rows.shape[-1]), ts.dtype)

    def energy(t, wxyz, omega):
        return Trajectory(t, wxyz, omega, samples.status, samples.steps, scene).energy

    start_energy = energy(ts[..., :1], state.wxyz[:, None], state.omega_body[:, None])
    return energy(rows, samples.wxyz, samples.omega_body) - start_energy


_COARSER = 30
"""Ratio of the tolerance of the second run, for the error estimate, to ``rtol``."""

_ROUNDING = 3
"""Units in the last place of the angle of rotation that are always added to an estimate."""

_ALLOWED = 10
"""Ratio of error to tolerance above which the status is ``INACCURATE``."""


def _with_error(method, scene, lanes, times, rtol, record) -> Samples:
    """The samples, and for each body the estimated error of its attitude at the last time [rad].

    The difference of two runs is about the error of the coarser one. The error of the finer one is
    smaller by the ratio of the sums of their estimated errors, since the motion amplifies errors in
    both runs by the same factor.
    """
    record_of_states = Record(record.attitude, record.rates, record.final_only, record.work)
    size = jnp.linalg.norm(jax.lax.stop_gradient(lanes.omega_body), axis=-1)
    angle = jnp.maximum(1, size * jnp.abs(times[..., -1] - times[..., 0]))
    ulps = jnp.finfo(size.dtype).eps * angle
    if method.exact:
        return method.run(scene, lanes, times, rtol, record_of_states)._replace(error=ulps)
    if not method.keeps_rtol:
        raise ValueError(
            "Record(error=True) compares two tolerances, and the steps of this method do not follow"
            " from rtol: leave its controller or dt0 out, or drop error=True."
        )

    def at(rtol):
        return method.run(scene, lanes, times, rtol, record_of_states)

    runs = jax.lax.map(at, jnp.stack([rtol, _COARSER * rtol]))
    fine, coarse = (jax.tree.map(lambda x, i=i: x[i], runs) for i in (0, 1))
    if record.attitude:
        gap = rotation.angle_between(fine.wxyz[:, -1], coarse.wxyz[:, -1])
    else:
        change = jnp.linalg.norm(fine.omega_body[:, -1] - coarse.omega_body[:, -1], axis=-1)
        gap = change / jnp.maximum(jnp.linalg.norm(fine.omega_body[:, -1], axis=-1), size)
    if fine.error is None:
        error = gap / _COARSER
    else:
        steps_differ = coarse.error > 2 * fine.error  # otherwise both took the same few short steps
        share = fine.error / jnp.where(steps_differ, coarse.error - fine.error, 1)
        error = jnp.where(steps_differ, gap * share, jnp.maximum(fine.error, gap))
    error = jax.lax.stop_gradient(error) + _ROUNDING * ulps
    good = (fine.status != Status.SUCCESSFUL) | (error <= _ALLOWED * rtol)
    status = jnp.where(good, fine.status, Status.INACCURATE)
    return fine._replace(status=status, error=error)
