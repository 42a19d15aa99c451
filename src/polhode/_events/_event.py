"""The event: a zero crossing of a function of attitude, rates and time."""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polhode._kernels import with_derivatives_of
from polhode._parts import Signature
from polhode._trajectory import Trajectory, shortly_after
from polhode.rotation._quaternion import wxyz_rate

_FUNCTION = Signature("Event", {"wxyz": (4,), "omega_body": (3,), "t": ()})


class Event(eqx.Module):
    """A zero crossing of ``fn(wxyz, omega_body, t)``, a number of one body at one time.

    **Arguments:** ``fn``: of the unit quaternion (4,) body -> space (of either sign), the body
    rates (3,) [rad/s] and the time () [s], smooth; it is mapped over batches. ``direction``: 1
    where fn rises through zero in time, -1 where it falls, 0 for both. ``samples``: number of
    equally spaced times at which a motion in closed form is sampled; None: 32 per revolution of the
    fastest natural rate (see ``ph.crossings``). Under ``jit``, ``crossings`` of a motion in closed
    form needs it. In a simulation (``simulate(..., events=)``): ``terminal``: whether a body stops
    at the event; ``capacity``: number of events of a body that are stored.

    Raises TypeError or ValueError for a function with other arguments or results, another
    direction, fewer than two samples, or a capacity below one.

        horizontal = ph.Event(lambda wxyz, omega_body, t: ph.rotation.rotate(wxyz, z)[2])
    """

    fn: Callable
    direction: int = eqx.field(static=True)
    samples: int | None = eqx.field(static=True)
    terminal: bool = eqx.field(static=True)
    capacity: int = eqx.field(static=True)

    def __init__(
        self,
        fn: Callable,
        direction: int = 0,
        samples: int | None = None,
        *,
        terminal: bool = False,
        capacity: int = 64,
    ):
        self.fn = _FUNCTION.checked(fn)
        if isinstance(direction, bool) or direction not in (-1, 0, 1):
            raise ValueError(f"direction must be 1 (rising), -1 (falling) or 0, got {direction!r}.")
        self.direction = int(direction)
        self.samples = at_least("samples", samples, 2)
        if not isinstance(terminal, bool):
            raise TypeError(f"terminal must be True or False, got {terminal!r}.")
        self.terminal = terminal
        self.capacity = at_least("capacity", capacity, 1) or 1

    def values(
        self, trajectory: Trajectory, rates: list[Array] | None = None
    ) -> tuple[Array, Array]:
        """The function and its rate of change [1/s] at every sample (..., T); ``rates``: rates of
        the samples, if they have been computed."""
        wxyz, omega = trajectory.wxyz, trajectory.omega_body
        t = jnp.broadcast_to(trajectory._t, omega.shape[:-1])
        if rates is None:
            acceleration = trajectory._scene.acceleration(wxyz, omega, trajectory._t)
            rates = [wxyz_rate(wxyz, omega), acceleration]
        tangents = (*rates[:2], jnp.ones_like(t))
        return jax.jvp(partial(_FUNCTION.mapped, self.fn), (wxyz, omega, t), tangents)

    def differentiable_at(
        self, approximate: Trajectory, limit: Array, side: Array
    ) -> tuple[Array, Trajectory]:
        """``refined`` for samples at which the function is zero to rounding: the same derivatives,
        computed only if derivatives are requested. ``side`` (..., T): sign of the function
        before."""
        arrays, static = eqx.partition(approximate, eqx.is_inexact_array)

        def values_of(arrays, limit, side):
            delay, at_events = self.refined(eqx.combine(arrays, static), limit, side)
            return [delay, *at_events._samples]

        values = [jnp.zeros_like(approximate._t), *approximate._samples]
        delay, *states = with_derivatives_of(values_of, (arrays, limit, side), values)
        at_events = approximate._with_samples(
            approximate._t + delay, states, approximate.status, approximate._steps, None
        )
        return delay, at_events

    def refined(
        self, approximate: Trajectory, limit: Array, side: Array | None = None
    ) -> tuple[Array, Trajectory]:
        """Samples moved to the events next to them.

        ``approximate``: samples (..., T) near events; ``limit`` [s]: the longest move. Returns the
        moves (..., T) [s], and the samples at the events. ``side``: the sign of the function before
        the event, if the rates may jump there: the rates of that side are used.

        Two steps t - g(t)/s of Newton's method with the same constant s, the rate of change of g.
        Where g(t) is zero they do not change t, but after two of them t has the first and second
        derivatives of the root.
        """
        stop_gradient = jax.lax.stop_gradient
        shift = None if side is None else self._towards(approximate, side)
        rates, moved_by = shortly_after(approximate, shift)
        value, rate = self.values(approximate, rates)
        is_tangent, nonzero_rate = rate == 0, stop_gradient(jnp.where(rate == 0, 1, rate))
        delay = jnp.where(is_tangent, 0, -value / nonzero_rate)
        delay = delay - stop_gradient(delay) + stop_gradient(jnp.clip(delay, -limit, limit))
        at_delay = moved_by(delay)
        value = _FUNCTION.mapped(self.fn, at_delay.wxyz, at_delay.omega_body, at_delay._t)
        change = jnp.where(is_tangent, 0, -value / nonzero_rate)
        delay = _differentiable(delay + (change - stop_gradient(change)), 2)
        return delay, moved_by(delay)

    def _towards(self, trajectory: Trajectory, side: Array) -> list[Array]:
        """Changes of attitude, rates and time by some units in the last place, from the surface
        where the function is zero to the side where it has the sign ``side``."""
        wxyz, omega, t = jax.lax.stop_gradient(
            (trajectory.wxyz, trajectory.omega_body, jnp.asarray(trajectory._t))
        )
        t = jnp.broadcast_to(t, omega.shape[:-1])
        units = [
            jnp.ones_like(wxyz),
            jnp.broadcast_to(jnp.linalg.norm(omega, axis=-1, keepdims=True), omega.shape),
            jnp.maximum(jnp.abs(t), jnp.finfo(t.dtype).tiny),
        ]

        def total(*point):
            return jnp.sum(_FUNCTION.mapped(self.fn, *point))

        gradient = jax.grad(total, argnums=(0, 1, 2))(wxyz, omega, t)
        gradient = [x * unit for x, unit in zip(gradient, units, strict=True)]
        square = gradient[2] ** 2 + sum(jnp.sum(x * x, axis=-1) for x in gradient[:2])
        distance = _TOWARDS * jnp.finfo(t.dtype).eps * side
        distance = distance * jax.lax.rsqrt(jnp.where(square > 0, square, 1))
        *vectors, change = (x * unit for x, unit in zip(gradient, units, strict=True))
        displacements = [distance[..., None] * x for x in vectors] + [distance * change]
        return [jax.lax.stop_gradient(x) for x in displacements]


_TOWARDS = 256
"""[eps] Distance from the surface of an event at which rates are evaluated, since a torque may jump
at the surface. The event itself is located to a few eps."""


def _differentiable(x: Array, order: int) -> Array:
    """``x``, whose derivatives beyond ``order`` raise NotImplementedError while they are traced.

    Each nested differentiation applies the rule below once, in either mode, because reverse mode
    transposes the result of the rule.
    """

    @jax.custom_jvp
    def identity(x):
        return x

    @identity.defjvp
    def derivative(primals, tangents):
        if order == 0:
            raise NotImplementedError(
                "event times and states at events have first and second derivatives only: a third"
                " derivative needs finite differences of the second."
            )
        return _differentiable(primals[0], order - 1), tangents[0]

    return identity(x)


def at_least(name: str, value: Any, minimum: int) -> int | None:
    """A concrete integer not below ``minimum``, or None."""
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < minimum:
        raise ValueError(f"{name} must be an integer, at least {minimum}, got {value!r:.40}.")
    return int(value)


def require_bodies(wxyz: Array) -> None:
    """ValueError for an empty batch."""
    if wxyz.size == 0:
        raise ValueError(
            f"events are searched for in one body at least, got attitudes of shape {wxyz.shape}:"
            " leave the search out where there is no body."
        )
