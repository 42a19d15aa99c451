"""Tolerances of single steps for an error that is asked for at the last time."""

from collections.abc import Callable
from functools import partial

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from polhode._kernel import kernel
from polhode._scene import Scene
from polhode._state import State
from polhode.hamiltonian import Dynamics, components, lie_poisson_field


def momentum_scale(scene: Scene, state: State, ts: Array) -> Array:
    """Natural unit of momentum of each lane: |L|, what the torques can add to it, what is slow."""
    t = ts[..., 0]
    momentum = scene.momentum(state.omega_body, t)
    y = (components(momentum), tuple(state.wxyz[..., i] for i in range(4)))
    (push, _) = lie_poisson_field(t, y, Dynamics(scene.hamiltonian, scene.torque))
    size = jnp.trace(scene.inertia.tensor, axis1=-2, axis2=-1)
    square = jnp.sum(momentum**2, axis=-1) + size * jnp.sqrt(sum(x * x for x in push))
    square = square + slow_momentum(scene, ts) ** 2
    resting = square == 0
    return jax.lax.stop_gradient(jnp.where(resting, 1, jnp.sqrt(jnp.where(resting, 1, square))))


def slow_momentum(scene: Scene, ts: Array) -> Array:
    """Momentum of a body that turns through one radian in the time simulated: a unit for one at
    rest, which a torque may move later. Zero if no time passes."""
    span = jnp.abs(ts[..., -1] - ts[..., 0])
    size = jnp.trace(scene.inertia.tensor, axis1=-2, axis2=-1) / 3
    return jax.lax.stop_gradient(jnp.where(span > 0, size / jnp.where(span > 0, span, 1), 0))


class LaneNorm(eqx.Module):
    """Error of the worst lane: root mean square over its components, each times its weight.

    A batch that shares its steps so keeps every body's own tolerance.
    """

    weights: Array

    def __call__(self, y: PyTree[Array]) -> Array:
        y = jnp.stack(y) if len(y := jax.tree.leaves(y)) > 1 else y[0]
        worst = jnp.max(jnp.mean((y * self.weights) ** 2, axis=0))
        positive = worst > 0  # the root's slope at zero is infinite: keep it out of gradients
        return jnp.where(positive, jnp.sqrt(jnp.where(positive, worst, 1)), 0)


def controlled(rtol: Array, weights: Array) -> diffrax.PIDController:
    """Steps whose weighted error is ``rtol``, or what rounding allows."""
    rtol = jnp.maximum(rtol, finest(rtol.dtype))
    return diffrax.PIDController(rtol=0.0, atol=rtol, norm=LaneNorm(weights))


def finest(dtype) -> float:
    """Least tolerance of a step: below four roundings the error estimate is rounding alone."""
    return 4 * float(jnp.finfo(dtype).eps)


class EndTolerance(eqx.Module):
    """Tolerances for an error of ``rtol`` [rad] at the time ``last``, renewed at every step.

    The states are Lie-Poisson components. How much is still to turn through is judged from each
    lane's rate now, and momentum in units of what it has now: what torques add and drag takes off
    shows as it happens. ``size`` (N,): of each lane's inertia [kg m^2]; ``least`` (N,): a unit of
    momentum for bodies at rest. ``jumps`` (static): whether a torque may jump, being a function
    that the user wrote.
    """

    rtol: Array
    size: Array
    least: Array
    last: Array
    jumps: bool = eqx.field(static=True)

    def following(self, slope: Callable) -> "Renewed":
        """Controller of solves whose states have the slope ``slope(t, y)``, a pytree as well."""
        inner = diffrax.PIDController(rtol=0.0, atol=1.0, norm=jnp.max)
        return Renewed(self, slope, jnp.zeros_like(self.size), inner)

    def begun(self, slope: Callable, t, y) -> "Pace":
        """Pace at the start of a solve."""
        y = jax.tree.leaves(y)
        rates = jax.tree.leaves(slope(t, y))
        push = jnp.sqrt(sum(x * x for x in rates[:3]))
        turning = 4 * sum(x * x for x in rates[3:7])  # the square of the rates
        square = sum(x * x for x in (*y[:3], self.least))
        unit = jnp.sqrt(square + 3 * self.size * push)
        return Pace(rates, jnp.sqrt(turning + push / self.size), unit)

    def judged(self, slope, t0, t1, y0, y1, error, before: "Pace", turned):
        """Error of a step in each lane over what it may be, that of rounding; pace and angle then.

        A step is judged by the faster and the larger of its two ends, so that a body that a torque
        sets in motion is not held to digits of what it had at rest.
        """
        after = self.begun(slope, t1, y1)
        error = [jnp.abs(x) for x in error]
        if self.jumps:
            gap = _GAP * (t1 - t0)
            ahead = [gap * x for x in before.slope]
            back = [_GAP * (a - b) for a, b in zip(y0, y1)]
            for missed in (
                _missed(slope, t0, y0, before.slope, gap, ahead),
                _missed(slope, t1, y1, after.slope, -gap, back),
            ):
                error[:3] = [x + jump for x, jump in zip(error, missed)]
        rate = _larger(before.rate, after.rate)
        unit = _larger(before.unit, after.unit)
        whole = turned + rate * jnp.abs(self.last - t0)
        whole = jnp.where(whole > 1, whole, 1)
        least = finest(self.rtol.dtype)
        rtol = self.rtol * (_SHARE / whole**_GROWTH)
        rtol = jnp.where(rtol > least, rtol, least)
        # work, where it is integrated too, follows from the rest: it does not decide the step
        parts = [x / unit for x in error[:3]] + error[3:7]
        size = jnp.sqrt(sum((x / rtol) ** 2 for x in parts) / len(parts))
        return size, _NOISE * least / rtol, after, turned + rate * jnp.abs(t1 - t0)


_SHARE, _GROWTH = 1, 2
"""Tolerance of a step over that of the end: ``share / angle^growth``. Errors of the rates turn the
body on, so that the error at the end grows between like the angle and like its square; fitted to
spins of 1 to 1e5 rad (``benchmarks/torqued.py``)."""


class Pace(eqx.Module):
    """Slope of a state, its natural rate [rad/s] and its unit of momentum, by lanes."""

    slope: list[Array]
    rate: Array
    unit: Array


class Renewed(diffrax.AbstractStepSizeController):
    """Steps under tolerances that ``EndTolerance`` renews: a PID controller on judged errors."""

    tolerance: EndTolerance
    slope: Callable
    turned: Array
    inner: diffrax.PIDController

    def after(self, turned: Array) -> "Renewed":
        """The same of a solve before which the lanes have turned through ``turned`` [rad]."""
        return Renewed(self.tolerance, self.slope, turned, self.inner)

    def wrap(self, direction):
        return Renewed(self.tolerance, self.slope, self.turned, self.inner.wrap(direction))

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        end, inner = self.inner.init(terms, t0, t1, y0, dt0, args, func, error_order)
        begun = kernel(lambda tolerance, *given: tolerance.begun(*given))
        y0 = jax.lax.stop_gradient(jax.tree.leaves(y0))
        first = begun(self.tolerance, self.slope, t0, y0)
        return end, (inner, self.turned, first, (jnp.zeros_like(first.rate), jnp.zeros_like(t0)))

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, state):
        inner, turned, before, refused = state
        states = [jax.tree.leaves(x) for x in (y0, y1_candidate, y_error)]
        judged = kernel(lambda tolerance, *given: tolerance.judged(*given))
        error, noise, *new = judged(
            self.tolerance, self.slope, t0, t1, *jax.lax.stop_gradient(states), before, turned
        )
        unscaled = error
        if self.tolerance.jumps:
            was, width = refused
            fall = (jnp.abs(t1 - t0) / jnp.where(width > 0, width, 1)) ** error_order
            rough = (width > 0) & (error > 2 * fall * was) & (error > noise)
            error = jnp.where(rough, _ROUGH * error, error)
        nothing = jnp.zeros_like(error)  # in place of states: not to scale by
        keep, start, end, jump, inner, result = self.inner.adapt_step_size(
            t0, t1, nothing, nothing, args, error, error_order, inner
        )
        before, turned = jax.tree.map(partial(jnp.where, keep), tuple(new), (before, turned))
        refused = unscaled, jnp.where(keep, 0, jnp.abs(t1 - t0))
        return keep, start, end, jump, (inner, turned, before, refused), result


def _missed(slope, t, y, there, gap, part) -> list[Array]:
    """Momentum by a torque that jumps beside the end ``t`` of a step, unseen by its estimate.

    No column of the midpoint rule looks between either end of a step and its first or last
    substep but at the end itself, and steps that are refused again and again near a jump end up
    with it there. Along a straight line, the tangent at the start or the chord at the end,
    differences of a smooth torque fall with their order; those of one that jumps do not. ``gap``
    and ``part``: inwards from the end, in time and of the state.
    """

    def torque(s):
        return jax.tree.leaves(slope(t + s * gap, [a + s * b for a, b in zip(y, part)]))[:3]

    inward = jax.lax.map(torque, jnp.arange(1, 4, dtype=jnp.result_type(gap)))
    rows = [jnp.concatenate([a[None], b]) for a, b in zip(there, inward)]
    sizes = []
    for _ in range(3):
        rows = [a[1:] - a[:-1] for a in rows]
        sizes.append(jnp.sqrt(sum(a[0] * a[0] for a in rows)))
    rounding = 64 * float(jnp.finfo(y[0].dtype).eps) * jnp.sqrt(sum(a * a for a in there[:3]))
    first, second, third = sizes
    jumps = third > _larger(0.5 * _larger(second, 0.5 * first), rounding)
    return [jnp.where(jumps, jnp.abs(a[0] * (4 * gap)), 0) for a in rows]


_ROUGH = 32
"""How much the estimate may be too small where a torque jumps amid a step: the last two values of
the table differ by less than their errors. Seen from errors that do not fall with the order of the
method when a refused step is cut."""

_NOISE = 16
"""Errors above so many of the least tolerances are not rounding."""

_GAP = 1 / 16
"""Part of a step beside its ends, three times which is searched for jumps."""


def _larger(a: Array, b: Array) -> Array:
    """The larger, or ``a`` where ``b`` is no number."""
    return jnp.where(b > a, b, a)
