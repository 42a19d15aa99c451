"""Unconstrained parameters of physical bodies: log-Cholesky factors of mass distributions.

A tensor is the inertia of some body exactly when its second moments ``Sigma = integral x x^T dm =
tr(I)/2 - I`` are positive semidefinite (which is the triangle inequality of its moments). Writing
``Sigma`` by a triangular factor with exponentials on its diagonal makes every real vector a
physical body. With mass and centre of mass the same holds for the 4x4 pseudo-inertia
``J = [[Sigma, m c], [m c^T, m]]`` (Rucker and Wensing, IEEE Robotics and Automation Letters 7(2),
2022, eqs. 8-13).
"""

import jax.numpy as jnp
from jaxtyping import Array, Float


def symmetric(diagonal, off):
    """Matrix (..., 3, 3) of its diagonal and the entries (y, z), (z, x), (x, y)."""
    (a, b, c), (p, q, r) = diagonal, off
    rows = [[a, r, q], [r, b, p], [q, p, c]]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def second_moments(tensor: Float[Array, "*b 3 3"]) -> Float[Array, "*b 3 3"]:
    """Second moments ``Sigma = tr(I)/2 - I`` (..., 3, 3), kg m^2, of inertia tensors."""
    a, b, c = (tensor[..., i, i] for i in range(3))
    off = (-tensor[..., 1, 2], -tensor[..., 0, 2], -tensor[..., 0, 1])
    return symmetric(((b + c - a) / 2, (c + a - b) / 2, (a + b - c) / 2), off)


def inertia_of_second_moments(sigma: Float[Array, "*b 3 3"]) -> Float[Array, "*b 3 3"]:
    """Inertia tensors ``I = tr(Sigma) - Sigma`` (..., 3, 3), kg m^2, of second moments."""
    a, b, c = (sigma[..., i, i] for i in range(3))
    off = (-sigma[..., 1, 2], -sigma[..., 0, 2], -sigma[..., 0, 1])
    return symmetric((b + c, c + a, a + b), off)


def _upper_product(d1, d2, d3, s12, s13, s23):
    """``S S^T`` of the upper triangle ``S = [[d1, s12, s13], [0, d2, s23], [0, 0, d3]]``."""
    return symmetric(
        (d1 * d1 + s12 * s12 + s13 * s13, d2 * d2 + s23 * s23, d3 * d3),
        (s23 * d3, s13 * d3, s12 * d2 + s13 * s23),
    )


def _upper_factor(sigma):
    """The upper triangle S with positive diagonal of ``sigma = S S^T``."""
    d3 = jnp.sqrt(sigma[..., 2, 2])
    s23, s13 = sigma[..., 1, 2] / d3, sigma[..., 0, 2] / d3
    d2 = jnp.sqrt(sigma[..., 1, 1] - s23 * s23)
    s12 = (sigma[..., 0, 1] - s13 * s23) / d2
    d1 = jnp.sqrt(sigma[..., 0, 0] - s13 * s13 - s12 * s12)
    return d1, d2, d3, s12, s13, s23


def inertia_from_log_cholesky(parameters: Float[Array, "*b 6"]) -> Float[Array, "*b 3 3"]:
    """Inertia tensor (..., 3, 3) of ``(d1, d2, d3, n12, n13, n23)``, any real numbers.

    ``Sigma = S S^T`` with ``S = N diag(exp d)`` and N unit upper triangular: adding a constant
    to the three d scales the body and changes nothing else. d in log of sqrt(kg) m, n without unit.
    """
    d1, d2, d3 = (jnp.exp(parameters[..., i]) for i in range(3))
    n12, n13, n23 = (parameters[..., i] for i in range(3, 6))
    sigma = _upper_product(d1, d2, d3, n12 * d2, n13 * d3, n23 * d3)
    return inertia_of_second_moments(sigma)


def inertia_to_log_cholesky(tensor: Float[Array, "*b 3 3"]) -> Float[Array, "*b 6"]:
    """Inverse of ``inertia_from_log_cholesky``; a flat body (on the boundary) has infinite ones."""
    d1, d2, d3, s12, s13, s23 = _upper_factor(second_moments(tensor))
    logs = [jnp.log(d1), jnp.log(d2), jnp.log(d3)]
    return jnp.stack([*logs, s12 / d2, s13 / d3, s23 / d3], axis=-1)


def pseudo_from_log_cholesky(
    parameters: Float[Array, "*b 10"],
) -> tuple[Float[Array, "*b"], Float[Array, "*b 3"], Float[Array, "*b 3 3"]]:
    """Mass, centre of mass and inertia about it of the ten parameters of Rucker and Wensing.

    ``(alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3)``; ``J = U U^T`` with
    ``U = exp(alpha) [[exp d1, s12, s13, t1], [0, exp d2, s23, t2], [0, 0, exp d3, t3],
    [0, 0, 0, 1]]`` (their eqs. 11 and 12). Lengths in m, mass ``exp(2 alpha)`` in kg.
    """
    alpha, s12, s23, s13 = (parameters[..., i] for i in (0, 4, 5, 6))
    d1, d2, d3 = (jnp.exp(parameters[..., i]) for i in (1, 2, 3))
    mass = jnp.exp(2 * alpha)
    sigma = mass[..., None, None] * _upper_product(d1, d2, d3, s12, s13, s23)
    return mass, parameters[..., 7:], inertia_of_second_moments(sigma)


def pseudo_to_log_cholesky(
    mass: Float[Array, "*b"], centre: Float[Array, "*b 3"], tensor: Float[Array, "*b 3 3"]
) -> Float[Array, "*b 10"]:
    """Inverse of ``pseudo_from_log_cholesky``; ``tensor`` is about the centre of mass."""
    sigma = second_moments(tensor) / mass[..., None, None]
    d1, d2, d3, s12, s13, s23 = _upper_factor(sigma)
    head = [jnp.log(mass) / 2, jnp.log(d1), jnp.log(d2), jnp.log(d3), s12, s23, s13]
    return jnp.concatenate([jnp.stack(head, axis=-1), centre], axis=-1)
