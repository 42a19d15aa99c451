"""Document 002 as printed: the matrix K and the axis-angle formulas, equations 1 to 12.

An independent reference for the tests, not what users should call: arccos and the quotients below
lose accuracy near the identity and near half turns. `euler_to_axis_angle` is
the robust form. The document's K is the attitude R of the same angles seen in axes with y and z
reversed, ``K = D R D`` with ``D = diag(1, -1, -1)``; so K turns by the same angle as R about
``(l, -m, -n)`` when R turns about ``(l, m, n)``.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

_Angle = Float[Array, "*b"]
_Triple = tuple[_Angle, _Angle, _Angle]


def _matrix(rows: list[list[Array]]) -> Float[Array, "*b 3 3"]:
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def matrix_k(phi: _Angle, theta: _Angle, psi: _Angle) -> Float[Array, "*b 3 3"]:
    """K, product of three passive turns, ``Rz(phi)^T Ry(theta)^T Rz(psi)^T`` (eq. 1)."""
    cp, sp, ct, st = jnp.cos(phi), jnp.sin(phi), jnp.cos(theta), jnp.sin(theta)
    c, s = jnp.cos(psi), jnp.sin(psi)
    return _matrix(
        [
            [ct * c * cp - s * sp, ct * s * cp + c * sp, -st * cp],
            [-ct * c * sp - s * cp, -ct * s * sp + c * cp, st * sp],
            [st * c, st * s, ct],
        ]
    )


def axis_angle_matrix(axis: _Triple, angle: _Angle) -> Float[Array, "*b 3 3"]:
    """Active turn by ``angle`` about the unit axis (l, m, n) (eq. 2)."""
    l, m, n = axis
    c, s = jnp.cos(angle), jnp.sin(angle)
    return _matrix(
        [
            [l * l + c * (m * m + n * n), l * m * (1 - c) - n * s, l * n * (1 - c) + m * s],
            [l * m * (1 - c) + n * s, m * m + c * (n * n + l * l), m * n * (1 - c) - l * s],
            [l * n * (1 - c) - m * s, m * n * (1 - c) + l * s, n * n + c * (l * l + m * m)],
        ]
    )


def trace_k(phi: _Angle, theta: _Angle, psi: _Angle) -> _Angle:
    """Trace of K (eq. 3)."""
    return (1 + jnp.cos(theta)) * (1 + jnp.cos(psi + phi)) - 1


def cos_angle(phi: _Angle, theta: _Angle, psi: _Angle) -> _Angle:
    """Cosine of the rotation angle, from the trace (eq. 4, first form)."""
    return (1 + jnp.cos(theta)) * (1 + jnp.cos(psi + phi)) / 2 - 1


def _half_cosine(phi: _Angle, theta: _Angle, psi: _Angle) -> _Angle:
    return jnp.cos(theta / 2) * jnp.cos((psi + phi) / 2)


def cos_angle_half(phi: _Angle, theta: _Angle, psi: _Angle) -> _Angle:
    """Cosine of the rotation angle, half-angle form (eq. 4, second form)."""
    return 2 * _half_cosine(phi, theta, psi) ** 2 - 1


def branch(phi: _Angle, psi: _Angle) -> _Angle:
    """+1 for ``|psi + phi| <= pi`` (upper signs of eqs. 9-12), -1 beyond (lower signs)."""
    total = psi + phi
    return jnp.where(jnp.abs(total) <= jnp.pi, jnp.ones_like(total), -jnp.ones_like(total))


def sin_angle(phi: _Angle, theta: _Angle, psi: _Angle) -> _Angle:
    """Sine of the rotation angle, not negative (eq. 9)."""
    half = _half_cosine(phi, theta, psi)
    return branch(phi, psi) * 2 * half * jnp.sqrt(1 - half * half)


def axis_by_sine(phi: _Angle, theta: _Angle, psi: _Angle) -> _Triple:
    """Axis of K from its antisymmetric part (eqs. 5-8); 0/0 at the identity and at half turns."""
    twice = 2 * sin_angle(phi, theta, psi)
    return (
        jnp.sin(theta) * (jnp.sin(psi) - jnp.sin(phi)) / twice,
        -jnp.sin(theta) * (jnp.cos(psi) + jnp.cos(phi)) / twice,
        -(1 + jnp.cos(theta)) * jnp.sin(psi + phi) / twice,
    )


def axis_by_half_angles(phi: _Angle, theta: _Angle, psi: _Angle) -> _Triple:
    """Axis of K from half angles (eqs. 10-12), half turns included; 0/0 at the identity."""
    half = _half_cosine(phi, theta, psi)
    scale = branch(phi, psi) / jnp.sqrt(1 - half * half)
    return (
        scale * jnp.sin(theta / 2) * jnp.sin((psi - phi) / 2),
        -scale * jnp.sin(theta / 2) * jnp.cos((psi - phi) / 2),
        -scale * jnp.cos(theta / 2) * jnp.sin((psi + phi) / 2),
    )
