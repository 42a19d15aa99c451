"""Tolerances of single steps for an error that is asked for at the last time."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree


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
    rtol = jnp.maximum(rtol, _FINEST * jnp.finfo(rtol.dtype).eps)
    return diffrax.PIDController(rtol=0.0, atol=rtol, norm=LaneNorm(weights))


_FINEST = 4
"""Least tolerance of a step in units of rounding: below, the error estimate is rounding alone."""


class EndTolerance(eqx.Module):
    """Tolerances for an error of ``rtol`` [rad] at the time ``last``, renewed on the way.

    The states are Lie-Poisson components. How much is still to turn through is judged from the
    fastest lane's rate now: what torques add and drag takes off shows as it happens. ``size``
    (N,): of each lane's inertia [kg m^2].
    """

    rtol: Array
    size: Array
    last: Array

    def rates(self, y: PyTree[Array], slope: PyTree[Array]) -> tuple[Array, Array]:
        """Natural rate [rad/s] of the fastest lane, and each lane's unit of momentum."""
        y, slope = (jax.tree.leaves(jax.lax.stop_gradient(x)) for x in (y, slope))
        push = jnp.sqrt(sum(x * x for x in slope[:3]))
        turning = 4 * sum(x * x for x in slope[3:7])  # the square of the rates
        unit = jnp.sqrt(sum(x * x for x in y[:3]) + 3 * self.size * push)
        rate = jnp.sqrt(jnp.max(turning + push / self.size))
        return rate, jnp.where(unit == 0, 1, unit)

    def at(self, t, y, slope, turned) -> tuple[diffrax.PIDController, Array]:
        """Controller from the time ``t`` on, ``turned`` [rad] since the start, and the rate."""
        rate, unit = self.rates(y, slope)
        whole = jnp.maximum(turned + rate * jnp.abs(self.last - t), 1)
        one = jnp.ones_like(unit)
        work = len(jax.tree.leaves(y)) - 7  # follows from the rest: it does not decide the step
        weights = jnp.stack([one / unit] * 3 + [one] * 4 + [0 * one] * work)
        return controlled(self.rtol * (_SHARE / whole**_GROWTH), weights), rate

    def nodes(self, ts: Array, rate: Array) -> tuple[Array, int]:
        """The times with more in between, where tolerances are renewed; how many per interval.

        Where little turns, all but one of an interval's parts have no length.
        """
        parts = -(-_PARTS // (ts.shape[0] - 1))
        span = ts[1:] - ts[:-1]
        far = rate * jnp.abs(span) > _WORTH * parts
        share = jnp.arange(1, parts, dtype=ts.dtype)[None] / parts
        inner = jnp.where(far[:, None], ts[:-1, None] + share * span[:, None], ts[1:, None])
        return jnp.append(jnp.concatenate([ts[:-1, None], inner], axis=1), ts[-1]), parts


_SHARE, _GROWTH = 1, 2
"""Tolerance of a step over that of the end: ``share / angle^growth``. Errors of the rates turn the
body on, so that the error at the end grows between like the angle and like its square; fitted to
spins of 1 to 1e5 rad (``benchmarks/torqued.py``)."""

_PARTS, _WORTH = 8, 8
"""Parts of the time simulated with a tolerance of their own, if they are as many radians long."""
