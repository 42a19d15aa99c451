"""Lagrange's top for any direction of gravity: the frame of the vertical, and back."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode.rotation import conjugate, multiply
from polhode.tops._complex import Complex
from polhode.tops._lagrange import at, orbit


def _upward(force: Float[Array, "*b 3"]) -> tuple[Array, Array]:
    """Unit quaternion turning space z to an axis along +-force (never downwards), and the signed
    size of the force along it.

    Without force the axis is z: the motion does not depend on it. Its derivative with respect to
    the horizontal force then does, and is left out.
    """
    x, y, z = (force[..., i] for i in range(3))
    square = x * x + y * y + z * z
    acting = square > 0
    size = jnp.sqrt(jnp.where(acting, square, 1))
    up = jnp.where(z < 0, -1, 1).astype(size.dtype)
    a, b, c = (
        jnp.where(acting, up * value / size, unit) for value, unit in zip((x, y, z), (0, 0, 1))
    )
    half = jnp.sqrt((1 + c) / 2)
    turn = jnp.stack([half, -b / (2 * half), a / (2 * half), jnp.zeros_like(half)], axis=-1)
    return turn, jnp.where(acting, up * size, z)


def lagrange_motion(
    transverse: Float[Array, "*b"],
    force_space: Float[Array, "*b 3"],
    distance: Float[Array, "*b"],
    wxyz: Float[Array, "*b 4"],
    omega: Float[Array, "*b 3"],
    axial_momentum: Float[Array, "*b"],
    elapsed: Float[Array, "*b t"],
) -> tuple[Float[Array, "*b t 4"], Float[Array, "*b t 3"]]:
    """Attitude and body rates after ``elapsed`` [s] of a symmetric body about a fixed point.

    ``transverse``: moment about any axis through the point and across body z [kg m^2];
    ``force_space``: weight [N], space axes, acting at ``distance`` [m] along body z; ``wxyz``,
    ``omega`` [rad/s]: initial state; ``axial_momentum`` along body z [kg m^2/s], that of wheels on
    the axis included. Klein & Sommerfeld, Theorie des Kreisels, VI; see ``_lagrange``.
    """
    turn, size = _upward(force_space)
    q = multiply(conjugate(turn), wxyz)
    alpha, beta = Complex(q[..., 0], q[..., 3]), Complex(q[..., 2], q[..., 1])
    spin = omega[..., 2]
    momentum = (transverse * omega[..., 0], transverse * omega[..., 1], axial_momentum)
    motion = orbit(transverse, spin, -size * distance, (alpha, beta), momentum)
    alpha, beta, across = at(motion.along_time(), elapsed)
    scale = 1 / jnp.sqrt(alpha.square + beta.square)
    q = jnp.stack([alpha.re, beta.im, beta.re, alpha.im], axis=-1) * scale[..., None]
    square = (scale * scale)[..., None]
    rates = jnp.stack([across.im, across.re], axis=-1) * square
    axial = jnp.broadcast_to(spin[..., None, None], (*rates.shape[:-1], 1))
    turn = jnp.broadcast_to(turn[..., None, :], q.shape)
    return multiply(turn, q), jnp.concatenate([rates, axial], axis=-1)
