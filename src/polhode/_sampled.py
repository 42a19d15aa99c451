"""Motion under sampled commands (zero-order hold): one integration for each interval between
periods and saved times."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polhode._checks import ArrayLike, is_concrete, require_digits
from polhode._failed import sound_state, where_lost
from polhode._kernels import is_differentiated
from polhode._method import AbstractMethod, Record, Samples, Status, StepCounts
from polhode._parts import summands
from polhode._plan import choose
from polhode._scene import BodyTorque, SampledTorque, Scene, State, TorqueSum
from polhode._trajectory import Trajectory, with_initial_spins
from polhode._trajectory._trajectory import AbstractPropagator

_COINCIDENT = 1e-9
"""[periods] Distance below which a saved time and the start of a period are the same time; or eight
units in the last place of the times, if these are larger, as in single precision, but at most
``_FARTHEST``."""

_FARTHEST = 0.1
"""[periods] Upper bound of that distance: times that are rounded more coarsely stay apart."""


def is_sampled(scene: Scene) -> bool:
    """Whether a term of the torque is a ``SampledTorque``."""
    return any(isinstance(term, SampledTorque) for term in summands(scene.torque))


def sampled_method(
    method: AbstractMethod | None, scene: Scene, ts: Any, rtol: Array | float, record: Record
) -> "HeldCommands":
    """The method for a scene with a ``SampledTorque``; ``method``: that of each segment, or None.

    Raises ValueError for different periods, for ``Record(work=True)``, and for times that are not
    one row of concrete numbers or do not resolve the period.
    """
    sampled_torques = [term for term in summands(scene.torque) if isinstance(term, SampledTorque)]
    periods = {term.period for term in sampled_torques}
    if len(periods) > 1:
        raise ValueError(
            f"all SampledTorques of a scene must have one period, got {sorted(periods)}: join them"
            " in one function."
        )
    if record.work:
        raise ValueError("Record(work=True) is not available with SampledTorque: drop work=True.")
    if not is_concrete(ts) or np.ndim(ts) != 1:
        raise ValueError(
            "the times of a scene with a SampledTorque must be one row of known numbers: under"
            " jax.jit pass a list or a NumPy array, not a jax.numpy array."
        )
    if method is None:
        method, _ = choose(_with_commands(scene, [jnp.zeros(3, scene.inertia.dtype)]), rtol)
    return HeldCommands.of(method, np.asarray(ts), *periods)


class HeldCommands(AbstractMethod):
    """Commands that are constant from edge to edge; ``method`` integrates each segment.

    An *edge* is the start of a period, at which new commands are computed. ``times`` (M + 1,):
    edges and saved times in order; ``edges`` (M,): whether a segment starts at an edge; ``places``
    (T,): indices of the saved times in ``times``.
    """

    method: AbstractMethod
    times: Array
    edges: Array
    places: Array
    period: float = eqx.field(static=True)

    @classmethod
    def of(cls, method: AbstractMethod, ts: np.ndarray, period: float) -> "HeldCommands":
        """For saved times ``ts`` (T,), and an edge every ``period`` from the first of them on."""
        dtype = ts.dtype
        rounding = 8 * float(np.finfo(dtype).eps) * float(np.max(np.abs(ts))) / period
        ts = ts.astype(float)
        sign, start = np.sign(ts[-1] - ts[0]), ts[0]
        phase = sign * (ts - start) / period
        coincident = max(_COINCIDENT, min(rounding, _FARTHEST))
        is_near_edge = np.abs(phase - np.round(phase)) < coincident
        phase = np.where(is_near_edge, np.round(phase), phase)
        edges = np.arange(np.ceil(phase[-1]))
        edge_times = start + sign * period * edges
        require_digits("times of periods", edge_times, edge_times.astype(dtype))
        all_phases = np.union1d(edges, phase)
        # saved times exactly as passed, edges between them
        times = start + sign * period * all_phases
        places = np.searchsorted(all_phases, phase)
        times[places] = ts
        return cls(method, times, np.isin(all_phases[:-1], edges), places, period)

    @property
    def keeps_rtol(self) -> bool:
        """Whether the method of the segments does."""
        return self.method.exact or self.method.keeps_rtol

    @property
    def name(self) -> str:
        """The name, with that of the segments' method."""
        return f"HeldCommands({self.method.name})"

    def steps_of(self, scene: Scene, state: State, ts: Array, record: Record) -> str:
        """Number and length of the segments."""
        return f"{len(self.edges):,} segments, with a command held over every {self.period:g} s"

    def run(self, scene: Scene, state: State, ts: Array, rtol: Array, record: Record) -> Samples:
        bodies = state.wxyz.shape[0]
        times = jnp.asarray(self.times, state.wxyz.dtype)
        share = _share(state, times, rtol)
        coupled = bool(scene.dynamics.coupled)
        spins = ()
        if coupled:
            like = state.omega_body[..., 0]
            spins = (jnp.stack(scene.dynamics.wheels.initial_spins(like), axis=-1),)
        laws = [x for x in summands(scene.torque) if isinstance(x, SampledTorque)]
        final = Record(final_only=True)

        def commanded(t, state):
            return [law.command(t, state.wxyz, state.omega_body) for law in laws]

        def segment(carry, edge_and_span):
            samples, commands, status, steps = carry
            is_edge, span = edge_and_span
            wxyz, omega, *spins = samples
            state, is_sound = _commandable(commanded, span[0], wxyz, omega)
            fresh = commanded(span[0], state)
            commands = [jnp.where(is_edge, a, b) for a, b in zip(fresh, commands)]
            spins = [jnp.where(is_sound[:, None], x, 0) for x in spins]
            segment_scene = with_initial_spins(_with_commands(scene, commands), spins)
            result = self.method.run(segment_scene, state, span, share, final)
            states = [
                where_lost(x[:, 0], is_sound)
                for x in (result.wxyz, result.omega_body, result.spins)
                if x is not None
            ]
            ended = jnp.where(is_sound, result.status, Status.NOT_FINITE).astype(jnp.int32)
            status = jnp.where(status == Status.SUCCESSFUL, ended, status)
            steps = jax.tree.map(lambda a, b: a + b.astype(a.dtype), steps, result.steps)
            return (states, commands, status, steps), states

        begin = [state.wxyz, state.omega_body, *spins]
        zero = jnp.zeros(bodies, jnp.int32)
        commands = [jnp.zeros((bodies, 3), times.dtype) for _ in laws]
        spans = jnp.stack([times[:-1], times[1:]], axis=-1)
        (_, _, status, steps), segment_ends = jax.lax.scan(
            segment, (begin, commands, zero, StepCounts.of(zero)), (jnp.asarray(self.edges), spans)
        )
        places = self.places[-1:] if record.final_only else self.places
        wxyz, omega, *spins = (
            jnp.moveaxis(jnp.concatenate([x[None], y])[places], 0, 1)
            for x, y in zip(begin, segment_ends)
        )
        return Samples(
            wxyz if record.attitude else None,
            omega if record.rates else None,
            status,
            steps,
            spins=spins[0] if spins else None,
        )


def _commandable(commanded, t: Array, wxyz: Array, omega: Array) -> tuple[State, Array]:
    """``sound_state`` of the samples. In programs that compute derivatives, a body with a command
    that is not finite counts as failed, because zero times its derivative is NaN and would be added
    to the cotangents of the law's parameters."""
    state, _ = sound_state(State.of_samples(wxyz, omega))
    commands = jax.lax.stop_gradient(commanded(t, state))
    is_defined = jnp.isfinite(sum(x.sum(-1, keepdims=True) for x in commands))
    is_used = is_defined | ~is_differentiated([wxyz, omega])
    return sound_state(State.of_samples(*(jnp.where(is_used, x, jnp.nan) for x in (wxyz, omega))))


class HeldPropagator(AbstractPropagator):
    """The propagator of a trajectory under commands, which its samples do not contain."""

    def at(self, trajectory: Trajectory, t: ArrayLike) -> Trajectory:
        raise ValueError(
            "a SampledTorque holds a command that the samples do not contain: pass all times to"
            " ph.simulate."
        )


def _share(state: State, times: Array, rtol: Array) -> Array:
    """Tolerance of a segment: ``rtol`` divided by the total angle [rad], because the errors of the
    segments add up, or by the root of the number of segments if that is larger."""
    rates = jnp.linalg.norm(jax.lax.stop_gradient(state.omega_body), axis=-1)
    rates = jnp.where(jnp.isfinite(rates), rates, 0)  # of a body that failed
    angle = jnp.max(rates, initial=0) * jnp.abs(times[-1] - times[0])
    share = rtol / jnp.maximum(jnp.maximum(angle, 1), len(times) ** 0.5)
    return jnp.maximum(share, 8 * jnp.finfo(times.dtype).eps)


def _with_commands(scene: Scene, commands: list[Array]) -> Scene:
    """The scene with a constant torque in place of each ``SampledTorque``."""
    commands_in_order = iter(
        commands if len(commands) > 1 else commands * len(summands(scene.torque))
    )
    terms = [
        BodyTorque(next(commands_in_order)) if isinstance(x, SampledTorque) else x
        for x in summands(scene.torque)
    ]
    torque = terms[0] if len(terms) == 1 else TorqueSum(tuple(terms))
    return dataclasses.replace(scene, torque=torque)
