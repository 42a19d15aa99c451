"""Torqued bodies by extrapolation: order and steps chosen before the first step is taken."""

import math

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from polhode import rotation, tops
from polhode._lanes import PARTS, along_time, is_lane_tree, map_chunks
from polhode._methods import AbstractMethod, Record, Samples
from polhode._scene import Scene
from polhode._state import State
from polhode._status import Status
from polhode.hamiltonian import (
    Dynamics,
    LiePoissonCostate,
    components,
    external_power,
    from_quaternion,
    lie_poisson_field,
)
from polhode.solvers import Extrapolation, flow, natural_rate, steps_for
from polhode.torques import GravityGradient, UniformGravity

_HALF = math.sqrt(0.5)
_TURNS = (
    (1.0, 0.0, 0.0, 0.0),
    (_HALF, _HALF, 0.0, 0.0),
    (0.0, 1.0, 0.0, 0.0),
    (_HALF, 0.0, _HALF, 0.0),
    (0.0, 0.0, 1.0, 0.0),
    (_HALF, 0.0, 0.0, _HALF),
    (0.0, 0.0, 0.0, 1.0),
)


class Extrapolated(AbstractMethod):
    """Quaternion and body momentum by the extrapolated midpoint rule in equal steps.

    For bodies under potentials, whose rates stay of one size: the number of steps follows from
    ``rtol``, the time to go and each body's natural rate (its angular velocity and what the torque
    can add to it), so that no body waits for another: bodies of like rates share a chunk. The
    error at the last time is about ``rtol`` radians for the median body; chaotic bodies exceed it.

    **Arguments:** ``order``: even, 8 to 20 (low for loose tolerances); ``chunk``: bodies at once;
    ``max_steps``; ``adjoint``: None for the derivatives of the exact flow, forward mode by the
    variational equations, reverse mode by the adjoint equations integrated back in as many steps
    (as accurate as the solution, without its path in memory), or a diffrax adjoint for the
    derivative of the steps, for bodies that drag stops within the time simulated;
    ``upright``: work in a space frame whose z axis is along the scene's ``UniformGravity`` or the
    constant position of its ``GravityGradient``, which must not vanish (a third of the work; other
    potentials and torques must be absent);
    ``on_axis``: with ``upright``, take the centre of mass to lie on body z;
    ``compensated``: sum changes within a step and carry what rounding takes along (three to twenty
    times less rounding, a third more work).
    """

    order: int = eqx.field(static=True, default=12)
    chunk: int = eqx.field(static=True, default=64)
    max_steps: int = eqx.field(static=True, default=2**20)
    adjoint: diffrax.AbstractAdjoint | None = None
    upright: bool = eqx.field(static=True, default=False)
    on_axis: bool = eqx.field(static=True, default=False)
    compensated: bool = eqx.field(static=True, default=False)

    def run(self, scene: Scene, state: State, ts: Array, rtol: Array, record: Record) -> Samples:
        n = state.wxyz.shape[0]
        turn = None
        if self.upright:
            scene, state, turn = _upright(scene, state, self.on_axis)
        rate = jax.lax.stop_gradient(lane_rates(scene, state, ts))
        order = jnp.argsort(rate) if n > self.chunk else jnp.arange(n)
        lanes, shared = eqx.partition((scene, state), is_lane_tree((scene, state)))
        times = ts if ts.ndim == 2 else None
        sorted_lanes = jax.tree.map(lambda x: x[order], (lanes, times, rate))

        def one(chunk):
            lanes, times, rate = chunk
            scene, state = eqx.combine(lanes, shared)
            return self._solve(scene, state, ts if times is None else times[0], rate, rtol, record)

        size = 1 if ts.ndim == 2 else self.chunk
        found = map_chunks(one, sorted_lanes, n, size)
        path, status, steps = jax.tree.map(lambda x: x[jnp.argsort(order)], found)
        momentum, wxyz, *work = path
        momentum, wxyz = (jnp.stack(x, axis=-1) for x in (momentum, wxyz))
        later = Scene(**{name: along_time(getattr(scene, name), 1) for name in PARTS})
        if turn is not None:
            wxyz = rotation.multiply(turn[:, None], wxyz)
        kept = ts[..., -1:] if record.final_only else ts
        omega = later.rates(momentum, kept if kept.ndim == 2 else kept[None])
        return Samples(
            rotation.normalise(wxyz) if record.attitude else None,
            omega if record.rates else None,
            status,
            steps,
            work[0] if record.work else None,
        )

    def _solve(self, scene, state, ts, rate, rtol, record):
        """One chunk: components (n, T) of momentum and attitude, status and steps of each lane."""
        substeps = _SUBSTEPS if record.final_only and self.adjoint is not None else 1
        solver = Extrapolation(self.order, substeps=substeps)
        dynamics = Dynamics(scene.hamiltonian, scene.torque)
        momentum = scene.momentum(state.omega_body, ts[0])
        y0 = (components(momentum), tuple(state.wxyz[..., i] for i in range(4)))
        field = lie_poisson_field
        costate = LiePoissonCostate.of(dynamics, y0, ts[0])
        if record.work:
            y0, field, costate = (*y0, jnp.zeros_like(y0[0][0])), _field_and_power, None
        horizon = jnp.abs(ts[-1] - ts[0])
        total = steps_for(self.order, rtol, jnp.max(rate, initial=0), horizon)

        # the way back from states that a torque has drawn together starts anew from kept ones
        intervals = 1 if record.final_only else ts.shape[0] - 1
        restarts = 1 if scene.torque is None else -(-_RESTARTS // intervals)

        def across(y, interval):
            start, end = interval
            share = jnp.ceil(total * jnp.abs(end - start) / (horizon * substeps))
            count = jax.lax.stop_gradient(jnp.maximum(share, 1))
            if self.adjoint is None:
                taken = jnp.minimum(count, self.max_steps)
                reached = taken == count
                end = jnp.where(reached, end, start + (end - start) * (taken / count))
                each = jnp.ceil(taken / restarts)
                nodes = start + (end - start) * jnp.arange(restarts + 1, dtype=ts.dtype) / restarts

                def onward(y, span):
                    options = self.order, self.compensated, costate
                    return flow(field, scene, y, span, each, *options), None

                y, _ = jax.lax.scan(onward, y, (nodes[:-1], nodes[1:].at[-1].set(end)))
                return y, (y, reached, taken.astype(jnp.int32))
            solution = diffrax.diffeqsolve(
                diffrax.ODETerm(field),
                solver,
                start,
                end,
                jax.lax.stop_gradient(end - start) / count,
                y,
                dynamics,
                stepsize_controller=diffrax.ConstantStepSize(),
                adjoint=self.adjoint,
                max_steps=self.max_steps,
                throw=False,
            )
            y = jax.tree.map(lambda x: x[-1], solution.ys)
            reached = solution.result == diffrax.RESULTS.successful
            return y, (y, reached, solution.stats["num_steps"])

        if record.final_only:
            _, (last, reached, steps) = across(y0, (ts[0], ts[-1]))
            path = jax.tree.map(lambda x: x[None], last)
        else:
            _, (path, reached, steps) = jax.lax.scan(across, y0, (ts[:-1], ts[1:]))
            path = jax.tree.map(lambda first, x: jnp.concatenate([first[None], x]), y0, path)
        path = jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), path)
        finite = jnp.array(True)
        for x in jax.tree.leaves(path):
            finite = finite & jnp.all(jnp.isfinite(x), axis=-1)
        status = jnp.where(finite, Status.SUCCESSFUL, Status.NOT_FINITE)
        status = jnp.where(jnp.all(reached), status, Status.MAX_STEPS)
        return path, status, jnp.broadcast_to(substeps * jnp.sum(steps), status.shape)


def _field_and_power(t, y, dynamics):
    """The Lie-Poisson field with the work of the external torques as one more component."""
    power = external_power(t, y[0], from_quaternion(y[1]), dynamics)
    return *lie_poisson_field(t, y[:2], dynamics), power


_RESTARTS = 8
"""Parts of the time simulated whose starts are kept for a gradient where a torque acts."""

_SUBSTEPS = 5
"""Steps of the method inside one diffrax step, whose own cost they share."""


def lane_rates(scene: Scene, state: State, ts: Array) -> Array:
    """Natural rate [rad/s] of every lane: |omega| and the largest torque met in any attitude.

    The torque is looked at in the initial attitude and in six turned ones, at three times.
    """
    n = state.wxyz.shape[0]
    first, last = ts[..., 0], ts[..., -1]
    momentum = components(scene.momentum(state.omega_body, first))
    acting = Dynamics(scene.hamiltonian, scene.torque)
    alone = Dynamics(Scene(scene.inertia, rotors=scene.rotors).hamiltonian)
    turns = jnp.array(_TURNS, state.wxyz.dtype)
    largest = jnp.zeros(n, state.wxyz.dtype)
    for share in (0.0, 0.5, 1.0):
        t = first + share * (last - first)

        def square(turn, t=t):
            turned = rotation.multiply(state.wxyz, jnp.broadcast_to(turn, (n, 4)))
            y = (momentum, tuple(turned[..., i] for i in range(4)))
            push, own = (lie_poisson_field(t, y, system)[0] for system in (acting, alone))
            return sum((a - b) ** 2 for a, b in zip(push, own))

        largest = jnp.maximum(largest, jnp.sqrt(jnp.max(jax.vmap(square)(turns), axis=0)))
    moments = jnp.broadcast_to(scene.carrier.moments, (n, 3))
    axial = components(moments * state.omega_body)
    rate = natural_rate(axial, tuple(1 / m for m in components(moments)), largest)
    if isinstance(scene.potential, UniformGravity):
        return rate
    turned = rate * jnp.abs(last - first)
    return _FINER * jnp.maximum(turned / _SHORT, 1) ** _DRIFT * rate


_FINER = 1.35
"""The steps were fitted to heavy tops; other potentials vary faster with the attitude, such as a
gravity gradient, whose torque returns after half a turn."""

_SHORT, _DRIFT = 500, 1 / 24
"""Over more radians than these the phases of librations drift apart faster than those of tops."""


def _upright(scene: Scene, state: State, on_axis: bool) -> tuple[Scene, State, Array]:
    """Scene and lanes seen from a frame with z along the field, and the turn (N, 4) back."""
    field = scene.potential
    if isinstance(field, GravityGradient):
        force = field.position_space
    else:
        force = jnp.asarray(field.mass)[..., None] * field.gravity_space
    (w, x, y), size = tops.upward(components(force))
    zero = jnp.zeros_like(size)
    along = jnp.stack([zero, zero, size], axis=-1)
    if isinstance(field, GravityGradient):
        field = GravityGradient(field.mu, along, vertical=True)
    else:
        axial, one = field.on_axis or on_axis, jnp.ones((), size.dtype)
        field = UniformGravity(one, field.centre_body, along, axial, vertical=True)
    turn = jnp.broadcast_to(jnp.stack([w, x, y, zero], axis=-1), state.wxyz.shape)
    turned = rotation.multiply(rotation.conjugate(turn), state.wxyz)
    lanes = eqx.tree_at(lambda s: s.wxyz, state, turned)
    return Scene(scene.inertia, field, None, scene.rotors), lanes, turn
