"""Derivatives of the motion of a symmetric body without weight by the weight.

The closed form of Lagrange's top needs the direction of the weight, which a body without any has
not; the motion is analytic in its three components all the same. Less its turn about its own axis
the body turns as a sphere of moment A, R(t) = exp(t [w]x) R(0), at the constant rate w = L/A in
space axes. A small weight F at r e, e the axis, changes its momentum and attitude by

    dL(t) = r I(t) x F,    I(t) = integral of e from 0 to t,
    dtheta(t) = r / A  integral from 0 to t of exp((t - s) [w]x) (I(s) x F) ds,

dtheta a rotation vector in space axes. With n = w/|w| and x = |w| t both are sums of powers of [n]x
times functions of x.
"""

import jax.numpy as jnp
from jaxtyping import Array

from polhode import rotation
from polhode._kernels import derivable_once


def with_weight(
    transverse: Array,
    force: Array,
    distance: Array,
    wxyz: Array,
    omega: Array,
    axial: Array,
    elapsed: Array,
    motion: tuple[Array, Array],
    where: Array,
) -> tuple[Array, Array]:
    """The ``motion`` without weight, with the derivatives by ``force``, which is zero.

    Second derivatives by it are NaN. ``where`` (N, 1): bodies that turn and have no weight; of
    others the result is finite and of no use. Other arguments as for ``lagrange_motion``.
    """
    moment = transverse[:, None]
    momentum = jnp.concatenate([moment * omega[:, :2], axial[:, None]], axis=-1)
    rate = jnp.where(where, rotation.rotate(wxyz, momentum) / moment, 1)
    size = jnp.sqrt(jnp.sum(rate * rate, axis=-1, keepdims=True))
    n = rate / size
    axis = rotation.rotate(wxyz, jnp.broadcast_to(jnp.array([0, 0, 1], n.dtype), n.shape))
    weight = derivable_once(force, jnp.ones_like(force, bool)) * distance[:, None]
    turned = jnp.cross(n, axis)
    a, b, c = (jnp.cross(v, weight)[:, None] for v in (axis, turned, jnp.cross(n, turned)))

    # functions of x whose derivative is the one before; p: convolutions of them with sin and x
    x = (size * elapsed)[..., None]
    sine, cosine = jnp.sin(x), jnp.cos(x)
    second = 2 * jnp.sin(x / 2) ** 2
    third, fourth = x - sine, x * x / 2 - second
    p1, p2 = second - x * sine / 2, third - (sine - x * cosine) / 2
    p3 = fourth - p1
    n = jnp.broadcast_to(n[:, None], (*elapsed.shape, 3))
    once = a * third + b * p1 + c * p2
    twice = jnp.cross(n, a * fourth + b * p2 + c * p3)
    angle = a * (x * x / 2) + b * third + c * fourth + jnp.cross(n, once + twice)
    angle = angle / (size * size * moment)[:, None]
    push = (a * x + b * second + c * third) / size[:, None]

    q, rates = motion
    turn = jnp.concatenate([jnp.zeros_like(x), angle / 2], axis=-1)
    push = push / moment[:, None] + jnp.cross(jnp.broadcast_to(rate[:, None], n.shape), angle)
    push = rotation.rotate(rotation.conjugate(q), push)
    push = jnp.concatenate([push[..., :2], jnp.zeros_like(x)], axis=-1)
    return q + rotation.multiply(turn, q), rates + push
