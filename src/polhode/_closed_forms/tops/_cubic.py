"""The cubic of the nutation: (A dg/dt)^2 = f(g), g the cosine between axis and vertical."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array


class Cubic(NamedTuple):
    """f about the present g, turned over where needed, so that its third root lies alone.

    ``unit``: momentum [kg m^2/s] that is 1 below; ``live``: whether that and the frequency differ
    from 0; ``circular``: whether the motion runs between the first two roots (the lower pair of f),
    else it runs from the third to the second (the upper pair is the close one); ``sign``: whether g
    was reversed; ``momentum``: of the axis; ``across`` = A dg/dt; ``along``: product of the
    horizontal momentum and the vertical; ``above`` = 1 + g, ``below`` = 1 - g; ``amount``: size of
    the leading coefficient; ``total``, ``times``: sum and product of the first two roots counted
    from g; ``depth``: distance of the third root times ``amount``; ``middle``: geometric mean of
    that distance from the two others; ``width``: (sum of the roots of those distances)^2.
    """

    unit: Array
    live: Array
    circular: Array
    sign: Array
    momentum: Array
    across: Array
    along: Array
    above: Array
    below: Array
    amount: Array
    total: Array
    times: Array
    depth: Array
    middle: Array
    width: Array

    @property
    def reach(self) -> Array:
        """``amount / width``: differences of g in units of the curve."""
        return jnp.where(self.live, self.amount / self.width, 0)

    @property
    def square(self) -> Array:
        """The squared Landen modulus of the curve."""
        return self.reach**2 * jnp.maximum(self.total**2 - 4 * self.times, 0)


def safe(condition: Array, value: Array) -> Array:
    """The value where the condition holds, else 1: keeps unused branches finite."""
    return jnp.where(condition, value, 1)


def positive(x: Array) -> Array:
    """x, or the least positive number where rounding made it none."""
    return jnp.where(x > 0, x, jnp.finfo(x.dtype).tiny)


def _third_of_angle(x: Array) -> Array:
    """c in [sqrt(3)/2, 1] with 4 c^3 - 3 c = x in [0, 1]."""
    c = 0.866 + 0.134 * x
    for _ in range(4):
        c = (8 * c**3 + x) / (12 * c * c - 3)
    return c


@jax.custom_jvp
def _isolated_root(f2: Array, f1: Array, f0: Array) -> tuple[Array, Array, Array]:
    """Of y^3 + f2 y^2 + f1 y + f0 (three real roots): the root farther from the middle one,
    whether it is the greatest, and a third of the spread of the roots."""
    q = (f2 * f2 - 3 * f1) / 9
    r = (2 * f2**3 - 9 * f2 * f1 + 27 * f0) / 54
    greatest = r <= 0
    size = jnp.sqrt(jnp.maximum(q, 0))
    cube = size**3
    ratio = jnp.where(cube > 0, jnp.abs(r) / safe(cube > 0, cube), 1)
    part = 2 * size * _third_of_angle(jnp.minimum(ratio, 1))
    y = jnp.where(greatest, part, -part) - f2 / 3
    for _ in range(2):
        slope = (3 * y + 2 * f2) * y + f1
        y = y - jnp.where(slope > 0, (((y + f2) * y + f1) * y + f0) / safe(slope > 0, slope), 0)
    return y, greatest, size


@_isolated_root.defjvp
def _isolated_root_rule(primals, tangents):
    (f2, f1, _), (d2, d1, d0) = primals, tangents
    y, greatest, size = _isolated_root(*primals)
    slope = (3 * y + 2 * f2) * y + f1
    inverse = -jnp.where(slope > 0, 1 / safe(slope > 0, slope), 0)
    dy = inverse * d0 + (inverse * y) * d1 + (inverse * y * y) * d2
    # The others only choose between formulas.
    none = np.zeros(greatest.shape, jax.dtypes.float0)
    return (y, greatest, size), (dy, none, jnp.zeros_like(size))


def cubic(weight: Array, vertical: tuple[Array, ...], momentum: tuple[Array, ...]) -> Cubic:
    """The cubic of a state.

    ``weight`` N = 2 A M [(kg m^2/s)^2] of either sign; ``vertical``: body components of the
    vertical u1, u2, then 1 + g and 1 - g; ``momentum``: body components [kg m^2/s].
    """
    square = momentum[0] ** 2 + momentum[1] ** 2 + momentum[2] ** 2 + jnp.abs(weight)
    moving = square > 0
    unit = jnp.sqrt(safe(moving, square))
    l1, l2, b = (x / unit for x in momentum)
    n = weight / safe(moving, square)
    u1, u2, above, below = vertical
    g = (above - below) / 2
    along, across = u1 * l1 + u2 * l2, u1 * l2 - u2 * l1
    flat, lying = l1 * l1 + l2 * l2, u1 * u1 + u2 * u2
    # f0 + f1 x + f2 x^2 + n x^3 about g: f0 and f1 are small without cancellation near the poles
    f0 = across * across
    f1 = 2 * b * along - 2 * g * flat - n * lying
    f2 = 2 * n * g - flat - b * b
    y, circular, size = _isolated_root(f2, n * f1, n * n * f0)
    side = jnp.where(circular, 1, -1).astype(g.dtype)
    sign = jnp.where(n < 0, -side, side)
    amount = jnp.abs(n)
    n = side * amount
    across, along, f1 = sign * across, sign * along, sign * f1
    above, below = jnp.where(sign > 0, above, below), jnp.where(sign > 0, below, above)
    # The first form is accurate for a pair close to g, the second for a g close to the third root.
    near = (~circular) & (jnp.abs(y) < size)
    far = safe(~near & (y != 0), y)
    total = jnp.where(near, -(f2 + y) / safe(near, n), (f1 + n * f0 / far) / far)
    times = jnp.where(near, (f1 - total * y) / safe(near, n), -f0 / far)
    depths = side * (2 * y - n * total)
    middle = jnp.sqrt(positive(y * y - n * total * y + n * n * times))
    width = depths + 2 * middle
    live = moving & (width > 4 * jnp.finfo(g.dtype).tiny ** 0.5)
    return Cubic(
        unit,
        live,
        circular,
        sign,
        b,
        across,
        along,
        above,
        below,
        amount,
        total,
        times,
        side * y,
        middle,
        safe(live, width),
    )
