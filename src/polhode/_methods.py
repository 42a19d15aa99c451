"""Ways to move the bodies of a scene. Options are objects: a method is handed over whole."""

import abc
from functools import partial
from typing import ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from polhode._equal_steps import check_split, equally
from polhode._lanes import PARTS, along_time, is_lane_tree, map_chunks
from polhode._scene import Scene
from polhode._state import State
from polhode._status import Status
from polhode._stepping import followed, sampled, through
from polhode._tolerance import EndTolerance, controlled, momentum_scale, slow_momentum
from polhode.hamiltonian import (
    Attitude,
    Dynamics,
    LiePoissonCostate,
    Vector,
    canonical_from_momentum,
    components,
    euler_angle_field,
    external_power,
    from_euler_angles,
    from_quaternion,
    lie_poisson_field,
    momentum_from_canonical,
)
from polhode.rotation import euler_to_wxyz, normalise, wxyz_to_euler
from polhode.solvers import Extrapolation, Splitting


class Record(eqx.Module):
    """What to keep: attitude, rates, and whether only the last time (all static).

    ``work``: also integrate the work [J] that the external torques do. ``error``: also estimate
    the error of each body at the last time, by a second, coarser run that costs about as much
    again, and mark bodies that miss the tolerance by more than ten times ``Status.INACCURATE``.
    """

    attitude: bool = eqx.field(static=True, default=True)
    rates: bool = eqx.field(static=True, default=True)
    final_only: bool = eqx.field(static=True, default=False)
    work: bool = eqx.field(static=True, default=False)
    error: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        if not (self.attitude or self.rates):
            raise ValueError("Record keeps nothing: switch on attitude, rates or both.")


class Samples(NamedTuple):
    """What a method returns for N lanes: (N, T, 4), (N, T, 3), (N,), (N,), (N, T), (N,)."""

    wxyz: Array | None
    omega_body: Array | None
    status: Array
    steps: Array
    work: Array | None = None
    error: Array | None = None


class AbstractMethod(eqx.Module):
    """Base of all methods. ``run`` moves N lanes; ``simulate`` does the checks and the batching.

    ``exact``: whether nothing is stepped; such a method is not asked for the work.
    """

    exact: ClassVar[bool] = False

    @property
    def asked_at_end(self) -> bool | None:
        """Whether ``rtol`` is the error at the last time, else of each step; None: not used."""
        return True

    @abc.abstractmethod
    def run(self, scene: Scene, state: State, ts: Array, rtol: float, record: Record) -> Samples:
        """Samples at ``ts`` (T,) or (N, T) of lanes whose state holds at the first time."""


class AbstractDiffraxMethod(AbstractMethod):
    """Base of the two charts that diffrax integrates in chunks of lanes sharing their steps."""

    solver: eqx.AbstractVar[diffrax.AbstractSolver]
    controller: eqx.AbstractVar[diffrax.AbstractStepSizeController | None]
    dt0: eqx.AbstractVar[float | None]
    max_steps: eqx.AbstractVar[int]
    adjoint: eqx.AbstractVar[diffrax.AbstractAdjoint | None]
    progress_meter: eqx.AbstractVar[diffrax.AbstractProgressMeter]
    chunk: eqx.AbstractVar[int]
    at_end: eqx.AbstractVar[bool]
    momenta: eqx.AbstractClassVar[tuple[bool, bool]]

    @abc.abstractmethod
    def field(self, t, y, dynamics: Dynamics):
        """Vector field on the chart's component arrays."""

    @property
    def _by_components(self) -> bool:
        """Whether the state stays in components, from each time to the next."""
        return isinstance(self.solver, Extrapolation) and self.controller is None

    @property
    def _splits(self) -> bool:
        """Whether the flows of a split Hamiltonian move the bodies, in equal steps."""
        return isinstance(self.solver, Splitting)

    @property
    def asked_at_end(self) -> bool | None:
        return self.at_end if self.controller is None and not self._splits else None

    @abc.abstractmethod
    def seen(self, y: PyTree[Array]) -> tuple[Vector, Attitude]:
        """Body momentum and attitude of the chart's component arrays."""

    @abc.abstractmethod
    def start(self, scene: Scene, state: State, t: Array) -> tuple[PyTree[Array], Array]:
        """Initial chart state of lanes, and which of them the chart can hold.

        A lane that it cannot hold starts from some sound state instead, so that it does not hold
        up the others; its samples are NaN and its status says why.
        """

    @abc.abstractmethod
    def finish(self, scene: Scene, y: PyTree[Array], t: Array) -> tuple[Array, Array, Array]:
        """wxyz, omega_body and whether the chart is still sound, of sampled components (N, T)."""

    def run(self, scene: Scene, state: State, ts: Array, rtol: float, record: Record) -> Samples:
        if self._splits:
            check_split(self, scene, record)
        if self.adjoint is None and not self._by_components:
            raise ValueError(
                f"ph.{type(self).__name__}(adjoint=None) needs a solver ph.solvers.Extrapolation"
                f" and no controller, got {type(self.solver).__name__} and"
                f" {type(self.controller).__name__}: hand in a diffrax adjoint."
            )
        size = 1 if ts.ndim == 2 else self.chunk
        lanes, shared = eqx.partition((scene, state), is_lane_tree((scene, state)))

        def one(chunk):
            lanes, times = chunk
            scene, state = eqx.combine(lanes, shared)
            times = ts if times is None else times[0]
            return self._solve(scene, state, times, rtol, record)

        n, times = state.wxyz.shape[0], ts if ts.ndim == 2 else None
        if not self.at_end or n <= size:
            return map_chunks(one, (lanes, times), n, size)
        order = jnp.argsort(self._rates(scene, state, ts))  # who shares steps is of like rate
        found = map_chunks(one, jax.tree.map(lambda x: x[order], (lanes, times)), n, size)
        return jax.tree.map(lambda x: x[jnp.argsort(order)], found)

    def _stacked_field(self, t, y, dynamics):
        """The field on one array (components, N): for a diffrax solver far faster than leaves."""
        return _stack(self.field(t, _groups(y), dynamics))

    def costate(self, dynamics, y, t):
        """Equations for the slopes of a motion, where better ones than the usual are known."""
        return None

    def _field_and_power(self, t, y, dynamics):
        """The same with the work of the external torques as one more component."""
        momentum, attitude = self.seen(_groups(y[:-1]))
        power = external_power(t, momentum, attitude, dynamics)
        return jnp.concatenate([self._stacked_field(t, y[:-1], dynamics), power[None]])

    def _components_and_power(self, t, y, dynamics):
        power = external_power(t, *self.seen(y[:2]), dynamics)
        return *self.field(t, y[:2], dynamics), power

    def _weights(self, scene, state, ts, groups) -> Array:
        ones = jnp.ones_like(groups[0][0])
        momenta = ones / momentum_scale(scene, state, ts)
        return _stack(
            tuple(momenta if is_momentum else ones for _ in group)
            for group, is_momentum in zip(groups, self.momenta)
        )

    def _solve(self, scene, state, ts, rtol, record) -> Samples:
        """One chunk of lanes in one diffrax solve."""
        dynamics = Dynamics(scene.hamiltonian, scene.torque)
        groups, sound = self.start(scene, state, ts[0])
        weights = self._weights(scene, state, ts, groups)
        if record.work:  # follows from the rest: it does not decide the step
            weights = jnp.concatenate([weights, jnp.zeros_like(weights[:1])])
        if self._by_components or self._splits:
            y0, field = groups, self.field
            if record.work:
                y0, field = (*groups, jnp.zeros_like(groups[0][0])), self._components_and_power
        else:
            y0, field = _stack(groups), self._stacked_field
            if record.work:
                y0 = jnp.concatenate([y0, jnp.zeros_like(y0[:1])])
                field = self._field_and_power
        controller = self.controller
        if controller is None and not self._splits:
            controller = self._tolerance(scene, state, ts, rtol, weights)
        solve = partial(
            diffrax.diffeqsolve,
            solver=self.solver,
            adjoint=diffrax.ForwardMode() if self.adjoint is None else self.adjoint,
            max_steps=self.max_steps,
            progress_meter=self.progress_meter,
            throw=False,
        )
        if self._by_components:
            width = self._first_width(scene, state, ts) if self.dt0 is None else self.dt0
            move = through
            if self.adjoint is None:
                costate = None if record.work else self.costate(dynamics, groups, ts[0])
                move = partial(followed, costate=costate)
            found = move(solve, field, dynamics, controller, ts, y0, width, record.final_only)
        elif self._splits:
            found = equally(solve, field, dynamics, self.dt0, ts, y0, record.final_only)
        else:
            solve = partial(solve, diffrax.ODETerm(field), args=dynamics)
            if self.controller is None and not record.final_only:
                # samples as accurate as steps, not as the interpolant
                controller = diffrax.ClipStepSizeController(controller, step_ts=ts)
            found = sampled(solve, controller, ts, y0, self.dt0, record.final_only)
        samples, last, result, steps = found
        work = samples[-1] if record.work else None
        if record.work:
            samples, last = samples[:-1], last[:-1]
        samples, last = _groups(samples), _groups(last)
        later = Scene(**{name: along_time(getattr(scene, name), 1) for name in PARTS})
        kept = ts[-1:] if record.final_only else ts
        wxyz, omega, _ = self.finish(later, samples, kept[None])
        *_, sound_at_end = self.finish(later, last, ts[None, -1:])
        n = sound.shape[0]
        wxyz, omega = (jnp.where(sound[:, None, None], x, jnp.nan) for x in (wxyz, omega))
        status = _status(result, wxyz, omega, sound, sound_at_end[:, -1])
        return Samples(
            wxyz if record.attitude else None,
            omega if record.rates else None,
            status,
            jnp.broadcast_to(steps, (n,)),
            work,
        )

    def _tolerance(self, scene, state, ts, rtol, weights):
        """What keeps the error of each step, or at the last time, to ``rtol``."""
        if not self.at_end:
            return controlled(rtol, weights)
        if self._by_components and self.momenta[0]:
            size = jnp.trace(scene.inertia.tensor, axis1=-2, axis2=-1) / 3
            sizes = jnp.broadcast_arrays(size, slow_momentum(scene, ts), weights[0])[:2]
            return EndTolerance(rtol, *jax.lax.stop_gradient(sizes), ts[-1], _may_jump(scene))
        rate = jnp.max(jnp.linalg.norm(state.omega_body, axis=-1))
        turned = jnp.maximum(1, rate * jnp.abs(ts[-1] - ts[0]))
        return controlled(rtol / jax.lax.stop_gradient(2 * turned), weights)

    def _first_width(self, scene, state, ts) -> Array:
        """A first step well within what the fastest body of the chunk allows [s]."""
        rate = jnp.max(self._rates(scene, state, ts))
        return jax.lax.stop_gradient(jnp.sign(ts[-1] - ts[0]) * 0.3 / rate)

    def _rates(self, scene, state, ts) -> Array:
        """Natural rates of lanes [rad/s], from above."""
        slowest = jnp.min(jnp.broadcast_to(scene.carrier.moments, (state.wxyz.shape[0], 3)), -1)
        return jax.lax.stop_gradient(momentum_scale(scene, state, ts) / slowest)


def _may_jump(scene: Scene) -> bool:
    """Whether a function of the user's acts on the body: orbits of this package are smooth."""
    parts = (scene.potential, scene.torque, scene.rotors)
    found = (x for x in jax.tree.leaves(parts, is_leaf=callable) if callable(x))
    return not all(hasattr(x, "core_ranks") for x in found)


def _stack(groups) -> Array:
    return jnp.stack([x for group in groups for x in group])


def _groups(y: Array):
    return tuple(y[:3]), tuple(y[3:])


def _status(result, wxyz, omega, sound, sound_at_end) -> Array:
    """Status per lane of one diffrax solve shared by all lanes."""
    finite = jnp.all(jnp.isfinite(wxyz), axis=(-1, -2)) & jnp.all(
        jnp.isfinite(omega), axis=(-1, -2)
    )
    reached = result == diffrax.RESULTS.successful
    limit = result == diffrax.RESULTS.max_steps_reached
    shared = jnp.where(
        reached, Status.SUCCESSFUL, jnp.where(limit, Status.MAX_STEPS, Status.STEP_FAILED)
    )
    status = jnp.where(reached & ~finite, Status.NOT_FINITE, shared)
    lost = ~sound | (~sound_at_end & (status != Status.SUCCESSFUL))
    return jnp.where(lost, Status.CHART_SINGULAR, status)


class LiePoisson(AbstractDiffraxMethod):
    """Unit quaternion and body momentum, free of singularities, with any diffrax solver.

    **Arguments:**

    - ``solver``: any ``diffrax.AbstractSolver`` for ODEs.
    - ``controller``: a diffrax step-size controller; None: error control by the ``rtol`` of
      ``simulate``, the attitude in radians and the momentum relative to each body's own scale, at
      least that of one radian in the whole time; the worst body of a chunk decides the step.
    - ``dt0``: first (or constant) step [s], negative backwards; None: chosen. For ``Splitting``,
      which has no error estimate, the longest step: equal ones lead from each time to the next.
    - ``max_steps``, ``adjoint``, ``progress_meter``: as in diffrax. The default adjoint gives
      reverse mode; hand in ``diffrax.ForwardMode()`` for ``jax.jvp``. None, for ``Extrapolation``
      without a ``controller`` only: both, as derivatives of the exact flow, by the variational or
      the adjoint equations integrated in as many steps (see ``ph.Extrapolated``).
    - ``chunk``: bodies that share their steps; chunks follow one another, so memory stays bounded.
    - ``at_end``: hold the error at the last time to ``rtol``, not that of each step: the steps'
      tolerance follows from the angle that the fastest body of the chunk turns through, or what
      rounding allows; for ``Extrapolation`` it is renewed at every step, as torques change the
      rates, and torques that jump are looked for at its ends.
    """

    solver: diffrax.AbstractSolver = diffrax.Dopri8()
    controller: diffrax.AbstractStepSizeController | None = None
    dt0: float | None = None
    max_steps: int = eqx.field(static=True, default=2**16)
    adjoint: diffrax.AbstractAdjoint | None = diffrax.RecursiveCheckpointAdjoint()
    progress_meter: diffrax.AbstractProgressMeter = diffrax.NoProgressMeter()
    chunk: int = eqx.field(static=True, default=200)
    at_end: bool = eqx.field(static=True, default=False)

    momenta = (True, False)

    def field(self, t, y, dynamics):
        return lie_poisson_field(t, y, dynamics)

    def costate(self, dynamics, y, t):
        return LiePoissonCostate.of(dynamics, y, t)

    def seen(self, y):
        return y[0], from_quaternion(y[1])

    def start(self, scene, state, t):
        momentum = scene.momentum(state.omega_body, t)
        wxyz = tuple(state.wxyz[..., i] for i in range(4))
        return (components(momentum), wxyz), jnp.ones(state.wxyz.shape[0], bool)

    def finish(self, scene, y, t):
        momentum, wxyz = (jnp.stack(group, axis=-1) for group in y)
        omega = scene.rates(momentum, t)
        return normalise(wxyz), omega, jnp.ones(momentum.shape[:-1], bool)


class EulerAngles(AbstractDiffraxMethod):
    """Canonical ZYZ Euler angles of document 000 by Hamilton's equations, with any diffrax solver.

    A reference path: the chart breaks down where theta is 0 or pi, which is reported as
    ``Status.CHART_SINGULAR``; passing near costs many steps. Arguments as ``ph.LiePoisson``;
    one body at a time by default, for the worst body of a chunk would hold up the others.
    """

    solver: diffrax.AbstractSolver = diffrax.Dopri8()
    controller: diffrax.AbstractStepSizeController | None = None
    dt0: float | None = None
    max_steps: int = eqx.field(static=True, default=2**16)
    adjoint: diffrax.AbstractAdjoint | None = diffrax.RecursiveCheckpointAdjoint()
    progress_meter: diffrax.AbstractProgressMeter = diffrax.NoProgressMeter()
    chunk: int = eqx.field(static=True, default=1)
    at_end: bool = eqx.field(static=True, default=False)

    momenta = (False, True)

    def field(self, t, y, dynamics):
        return euler_angle_field(t, y, dynamics)

    def seen(self, y):
        return momentum_from_canonical(*y), from_euler_angles(*y[0])

    def start(self, scene, state, t):
        phi, theta, psi = q = wxyz_to_euler(state.wxyz)
        sound = _away_from_poles(q)
        q = (phi, jnp.where(sound, theta, jnp.pi / 2), psi)
        momentum = components(scene.momentum(state.omega_body, t))
        p = canonical_from_momentum(q, momentum)
        return (q, tuple(jnp.where(sound, x, 0) for x in p)), sound

    def finish(self, scene, y, t):
        q, p = y
        momentum = jnp.stack(momentum_from_canonical(q, p), axis=-1)
        omega = scene.rates(momentum, t)
        return euler_to_wxyz(*q), omega, _away_from_poles(q)


def _away_from_poles(q) -> Array:
    """Whether the chart keeps at least half of the digits (its error grows like 1/sin theta)."""
    theta = q[1]
    return jnp.abs(jnp.sin(theta)) > jnp.sqrt(jnp.finfo(theta.dtype).eps)
