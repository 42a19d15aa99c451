"""Natural units of the states of a body: what errors of single steps are measured by."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class LiePoissonUnits(eqx.Module):
    """Of body momentum and quaternion; renewed with the state, as torques change the rates.

    ``size`` (N,): of each inertia [kg m^2]; ``least`` (N,): momentum [kg m^2/s] by which a body at
    rest is measured, which a torque may move later; ``wheels`` (static): how many have momenta that
    are part of the state.
    """

    size: Float[Array, "*n"]
    least: Float[Array, "*n"]
    wheels: int = eqx.field(static=True, default=0)

    def __call__(self, y: Sequence[Array], rates: Sequence[Array]) -> tuple[list[Array], Array]:
        """Weights of the components, their squares to be summed (rad), and the rate [rad/s]."""
        push = jnp.sqrt(sum(x * x for x in rates[:3]))
        carried = [*y[:3], *y[7 : 7 + self.wheels]]
        unit = jnp.sqrt(sum(x * x for x in carried) + self.least**2 + 3 * self.size * push)
        turning = 4 * sum(x * x for x in rates[3:7])  # the square of the body rates
        more = [jnp.zeros_like(unit)] * (len(y) - 7 - self.wheels)  # the work follows from the rest
        spins = [1 / unit] * self.wheels
        weights = [1 / unit] * 3 + [jnp.full_like(unit, 2)] * 4 + spins + more
        return weights, jnp.sqrt(turning + push / self.size)


class FixedUnits(eqx.Module):
    """Weights (N,) of the components that stay as they are."""

    weights: tuple[Array, ...]

    def __call__(self, y: Sequence[Array], rates: Sequence[Array]) -> tuple[list[Array], Array]:
        """As ``LiePoissonUnits``."""
        rate = jnp.sqrt(sum((w * x) ** 2 for w, x in zip(self.weights, rates)))
        more = [jnp.zeros_like(rate)] * (len(y) - len(self.weights))  # the work, if it is wanted
        return [*self.weights, *more], rate


def relative(
    weights: Sequence[Array], change: Sequence[Array], rates: Sequence[Array], rate: Array
) -> list[Array]:
    """Weights that measure a small change by its own size, and by what its rates make of it within
    one radian."""
    square = sum((w * x) ** 2 for w, x in zip(weights, change))
    pace = sum((w * x) ** 2 for w, x in zip(weights, rates))
    square = square + pace / jnp.where(rate > 0, rate, 1) ** 2
    size = jnp.sqrt(jnp.where(square > 0, square, 1))
    return [w / size for w in weights]
