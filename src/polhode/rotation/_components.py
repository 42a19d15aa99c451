"""Kinematics of a unit quaternion, on component arrays: its matrix and its rate, written once."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float


def matrix_row(wxyz: Sequence[Any], i: int) -> tuple[Any, Any, Any]:
    """Row ``i`` of the rotation matrix: body components of space axis ``i`` (JAX or NumPy)."""
    w, x, y, z = wxyz
    if i == 0:
        return 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    if i == 1:
        return 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    return 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)


def quaternion_rate(wxyz: Sequence[Array], omega: Sequence[Array | float]) -> tuple[Array, ...]:
    """dq/dt = q (0, omega) / 2 for body rates omega [rad/s], four and three component arrays."""
    w, x, y, z = wxyz
    a, b, c = (rate / 2 for rate in omega)
    return (
        -x * a - y * b - z * c,
        w * a + y * c - z * b,
        w * b + z * a - x * c,
        w * c + x * b - y * a,
    )


def wxyz_rate(
    wxyz: Float[Array, "*#b 4"], omega_body: Float[Array, "*#b 3"]
) -> Float[Array, "*b 4"]:
    """dq/dt [1/s] of an attitude (..., 4) with body rates (..., 3) [rad/s]."""
    q, omega = (tuple(x[..., i] for i in range(x.shape[-1])) for x in (wxyz, omega_body))
    return jnp.stack(quaternion_rate(q, omega), axis=-1)
