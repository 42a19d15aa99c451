"""Free motion of bodies known to be symmetric: circular functions only, no elliptic one."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode import rotation


class SymmetricMotion(NamedTuple):
    """Attitude (..., 4) and rates (..., 3) of a symmetric free body; None where not asked for."""

    wxyz: Array | None
    omega_body: Array | None


def symmetric_motion(
    moments: Float[Array, "*#b 3"],
    wxyz: Float[Array, "*#b 4"],
    omega_body: Float[Array, "*#b 3"],
    t: Float[Array, "*#b"],
    *,
    attitude: bool = True,
    rates: bool = True,
) -> SymmetricMotion:
    """Steady precession of a body with equal moments about body x and y.

    ``moments`` (..., 3) [kg m^2], the first two taken as equal; ``t`` (...) [s] since the state
    ``wxyz``, ``omega_body`` held. The body turns about its axis at ``lambda = (1 - I3/I1) w3`` and
    with that about the constant momentum at ``|L|/I1``.
    """
    transverse, axial = moments[..., 0], moments[..., 2]
    slip = (transverse - axial) / transverse * omega_body[..., 2]
    turned = turned_rates = None
    if rates:
        # Here and below: once, and not anew for each component of what follows.
        cos, sin = jax.lax.optimization_barrier((jnp.cos(slip * t), jnp.sin(slip * t)))
        x, y = omega_body[..., 0], omega_body[..., 1]
        spin = jnp.broadcast_to(omega_body[..., 2], cos.shape)
        turned_rates = jnp.stack([x * cos + y * sin, y * cos - x * sin, spin], axis=-1)
    if attitude:
        own_momentum = jax.lax.optimization_barrier(omega_body * moments)
        momentum = rotation.rotate(wxyz, own_momentum) / transverse[..., None]
        angle = jax.lax.optimization_barrier(momentum * t[..., None])
        precession = rotation.rotation_vector_to_wxyz(angle)
        half = slip * t / 2
        zero = jnp.zeros_like(half)
        own = jnp.stack([jnp.cos(half), zero, zero, jnp.sin(half)], axis=-1)
        precession, own = jax.lax.optimization_barrier((precession, own))
        before = jax.lax.optimization_barrier(rotation.multiply(precession, wxyz))
        turned = rotation.multiply(before, own)
    return SymmetricMotion(turned, turned_rates)


def spherical_motion(
    wxyz: Float[Array, "*#b 4"],
    omega_body: Float[Array, "*#b 3"],
    t: Float[Array, "*#b"],
    *,
    attitude: bool = True,
    rates: bool = True,
) -> SymmetricMotion:
    """Constant rates of a body with three equal moments: one turn about a fixed axis."""
    shape = jnp.broadcast_shapes(omega_body.shape[:-1], t.shape)
    turned = None
    if attitude:
        turn = rotation.rotation_vector_to_wxyz(omega_body * t[..., None])
        turn = jax.lax.optimization_barrier(turn)
        turned = rotation.multiply(wxyz, turn)
    return SymmetricMotion(turned, jnp.broadcast_to(omega_body, (*shape, 3)) if rates else None)
