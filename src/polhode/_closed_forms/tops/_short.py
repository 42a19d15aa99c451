"""Lagrange's top over times so short that one step of Runge and Kutta is exact to rounding.

The closed form measures momenta in units of (L^2 + 2 A |M|)^(1/2), M the moment of the weight. At
rest without weight there is no such unit, and with little weight the derivatives by it are the
difference of large numbers. The equations of motion are regular there: a body at rest stays at
rest. A step of fourth order has all terms of first and second derivatives by state and weight.

Less its turn about its own axis at omega_z - L_z/A, the body moves as a sphere of moment A does:
with q its attitude, e = R z the axis and r e the place where the weight F acts, in space axes,

    dL/dt = r e x F,    dq/dt = (0, L) q / (2 A).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array

from polhode import rotation
from polhode._closed_forms.tops._elementary import turn


def frequency(transverse: Array, force: Array, distance: Array, omega: Array, axial: Array):
    """(L^2 + 2 A |M|)^(1/2) / A (N,) [rad/s]; 0 for a body that stays at rest."""
    weight = jnp.sqrt(jnp.sum(force * force, axis=-1)) * jnp.abs(distance)
    across = jnp.sum(omega[:, :2] ** 2, axis=-1)
    return jnp.sqrt(across + (axial / transverse) ** 2 + 2 * weight / transverse)


def reach(dtype) -> float:
    """The angle ``frequency`` times the time [rad] up to which the step is exact to rounding."""
    return (100 * float(jnp.finfo(dtype).eps)) ** (1 / 5)


def short_motion(
    transverse: Array,
    force: Array,
    distance: Array,
    wxyz: Array,
    omega: Array,
    axial: Array,
    elapsed: Array,
) -> tuple[Array, Array]:
    """Attitude (N, T, 4) and body rates (N, T, 3); arguments as for ``lagrange_motion``."""
    momentum = transverse[:, None] * omega[:, :2]
    momentum = jnp.concatenate([momentum, axial[:, None]], axis=-1)
    pull = (distance / transverse)[:, None, None] * force[:, None]
    zero, one = jnp.zeros_like(elapsed), jnp.ones_like(elapsed)
    step = elapsed[..., None]
    start = (
        jnp.broadcast_to(wxyz[:, None], (*elapsed.shape, 4)),
        jnp.broadcast_to(
            (rotation.rotate(wxyz, momentum) / transverse[:, None])[:, None], (*elapsed.shape, 3)
        ),
    )

    def field(q, rate):
        w, x, y, z = (q[..., i] for i in range(4))
        a, b, c = (rate[..., i] for i in range(3))
        turned = [-a * x - b * y - c * z, a * w + b * z - c * y, b * w + c * x - a * z]
        axis = [2 * (x * z + w * y), 2 * (y * z - w * x), w * w - x * x - y * y + z * z]
        turned = jnp.stack([*turned, c * w + a * y - b * x], axis=-1) / 2
        return turned, jnp.cross(jnp.stack(axis, axis=-1), jnp.broadcast_to(pull, rate.shape))

    def stage(carry, shares):
        slope, total = carry
        slope = field(*(x + shares[0] * step * k for x, k in zip(start, slope)))
        return (slope, tuple(x + shares[1] * k for x, k in zip(total, slope))), None

    shares = jnp.array([[0, 1 / 6], [1 / 2, 1 / 3], [1 / 2, 1 / 3], [1, 1 / 6]], elapsed.dtype)
    none = tuple(map(jnp.zeros_like, start))
    (_, total), _ = jax.lax.scan(stage, (none, none), shares)
    q, rate = (x + step * k for x, k in zip(start, total))
    about = turn((zero, zero, one), (omega[:, 2] - axial / transverse)[:, None] * elapsed)
    q = rotation.normalise(rotation.multiply(q, about))
    rate = rotation.rotate(rotation.conjugate(q), rate)
    spin = jnp.broadcast_to(omega[:, None, 2:], (*elapsed.shape, 1))
    return q, jnp.concatenate([rate[..., :2], spin], axis=-1)
