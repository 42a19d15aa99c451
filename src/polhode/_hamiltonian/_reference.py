"""Closed forms to compare with: the ZYZ Euler-angle Hamiltonian and the axis-angle conversion.

Independent references for results of ``jax.grad`` and ``polhode.rotation``; they are not used in
simulations. Equation numbers are those of docs/equations.md; misprints are corrected there.

The Euler-angle Hamiltonian (000). Arrays: ``moments`` (..., 3) principal moments [kg m^2],
``q`` (..., 3) = (phi, theta, psi) [rad], ``p`` (..., 3) momenta, ``qd`` (..., 3) angle rates;
all broadcast.

The matrix K and the axis-angle formulas (002), as printed: arccos and the quotients lose accuracy
near the identity and near half turns; ``ph.rotation.euler_to_axis_angle`` is the robust form. K is
the attitude R of the same angles in axes with y and z reversed, ``K = D R D`` with ``D = diag(1,
-1, -1)``: if R is a rotation about ``(l, m, n)``, K is one by the same angle about ``(l, -m, -n)``.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode._checks import ArrayLike, as_float_array
from polhode.inertia import Inertia

Vector3 = Float[Array, "*#b 3"]
Matrix3 = Float[Array, "*b 3 3"]


def _parts(moments, q):
    ix, iy, iz = jnp.unstack(moments, axis=-1)
    theta, psi = q[..., 1], q[..., 2]
    return ix, iy, iz, jnp.sin(theta), jnp.cos(theta), jnp.sin(psi), jnp.cos(psi)


def _symmetric(a, b, c, d, e, f):
    a, b, c, d, e, f = jnp.broadcast_arrays(a, b, c, d, e, f)
    rows = [[a, b, c], [b, d, e], [c, e, f]]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def quadratic(form: Matrix3, vector: Vector3) -> Float[Array, "*b"]:
    """v . M v."""
    return jnp.einsum("...i,...ij,...j->...", vector, form, vector)


def alpha(moments: Vector3, q: Vector3) -> Float[Array, "*b"]:
    """Eq. 5: cos^2(psi)/Ix + sin^2(psi)/Iy [1/(kg m^2)]."""
    ix, iy, _, _, _, s, c = _parts(moments, q)
    return c**2 / ix + s**2 / iy


def beta(moments: Vector3) -> Float[Array, "*b"]:
    """Eq. 6: 1/Iy - 1/Ix [1/(kg m^2)]."""
    return 1 / moments[..., 1] - 1 / moments[..., 0]


def gamma(moments: Vector3, q: Vector3) -> Float[Array, "*b"]:
    """Eq. 7: sin^2(psi)/Ix + cos^2(psi)/Iy [1/(kg m^2)]."""
    ix, iy, _, _, _, s, c = _parts(moments, q)
    return s**2 / ix + c**2 / iy


def energy(moments: Vector3, q: Vector3, p: Vector3) -> Float[Array, "*b"]:
    """Eq. 1 in the form of eq. 11: p . V p / 2 [J]."""
    return quadratic(inverse_mass_matrix(moments, q), p) / 2


def inverse_mass_matrix(moments: Vector3, q: Vector3) -> Matrix3:
    """Eq. 11: V, dq/dt = V p."""
    _, _, iz, st, ct, s, c = _parts(moments, q)
    al, be, ga = alpha(moments, q), beta(moments), gamma(moments, q)
    return _symmetric(
        al / st**2,
        s * c * be / st,
        -ct * al / st**2,
        ga,
        -s * c * ct * be / st,
        1 / iz + ct**2 * al / st**2,
    )


def theta_form(moments: Vector3, q: Vector3) -> Matrix3:
    """Eq. 14 (entry (3,2) without the stray p_theta): dp_theta/dt = p . Theta p."""
    _, _, _, st, ct, s, c = _parts(moments, q)
    al, be = alpha(moments, q), beta(moments)
    corner = ct * al / st**3
    return _symmetric(
        corner,
        s * c * ct * be / (2 * st**2),
        -(1 + ct**2) * al / (2 * st**3),
        jnp.zeros_like(corner),
        -s * c * be / (2 * st**2),
        corner,
    )


def psi_form(moments: Vector3, q: Vector3) -> Matrix3:
    """Eq. 15: dp_psi/dt = p . Psi p."""
    _, _, _, st, ct, s, c = _parts(moments, q)
    al, be, ga = alpha(moments, q), beta(moments), gamma(moments, q)
    return _symmetric(
        -s * c * be / st**2,
        (al - ga) / (2 * st),
        ct * s * c * be / st**2,
        s * c * be,
        ct * (ga - al) / (2 * st),
        -(ct**2) * s * c * be / st**2,
    )


def mass_matrix(moments: Vector3, q: Vector3) -> Matrix3:
    """Eqs. 24, 28: V^-1, p = V^-1 dq/dt."""
    ix, iy, iz, st, ct, s, c = _parts(moments, q)
    al, be, ga = alpha(moments, q), beta(moments), gamma(moments, q)
    return _symmetric(
        ix * iy * st**2 * ga + iz * ct**2,
        -ix * iy * s * c * st * be,
        iz * ct,
        ix * iy * al,
        jnp.zeros_like(al),
        iz * jnp.ones_like(al),
    )


def theta_velocity_form(moments: Vector3, q: Vector3) -> Matrix3:
    """Eq. 25: V^-1 Theta V^-1."""
    ix, iy, iz, st, ct, s, c = _parts(moments, q)
    be, ga = beta(moments), gamma(moments, q)
    zero = jnp.zeros_like(ga)
    return _symmetric(
        (ix * iy * ga - iz) * st * ct,
        -ix * iy * s * c * ct * be / 2,
        -iz * st / 2,
        zero,
        zero,
        zero,
    )


def psi_velocity_form(moments: Vector3, q: Vector3) -> Matrix3:
    """Eq. 26: V^-1 Psi V^-1."""
    ix, iy, _, st, _, s, c = _parts(moments, q)
    be = beta(moments)
    turn = -ix * iy * (c**2 - s**2) * st * be / 2
    zero = jnp.zeros_like(turn)
    return _symmetric(-ix * iy * s * c * st**2 * be, turn, zero, ix * iy * s * c * be, zero, zero)


def mass_matrix_rate(moments: Vector3, q: Vector3, qd: Vector3) -> Matrix3:
    """Eqs. 27, 31-35: T = d(V^-1)/dt along the motion."""
    ix, iy, iz, st, ct, s, c = _parts(moments, q)
    be, ga = beta(moments), gamma(moments, q)
    theta_dot, psi_dot = qd[..., 1], qd[..., 2]
    t22 = 2 * ix * iy * s * c * be * psi_dot
    zero = jnp.zeros_like(t22)
    return _symmetric(
        2 * (ix * iy * ga - iz) * st * ct * theta_dot - t22 * st**2,
        -ix * iy * be * ((c**2 - s**2) * st * psi_dot + s * c * ct * theta_dot),
        -iz * st * theta_dot,
        t22,
        zero,
        zero,
    )


def generalised_force(moments: Vector3, q: Vector3, qd: Vector3) -> Float[Array, "*b 3"]:
    """The unnumbered x after eq. 36: x = V^-1 d2q/dt2 [N m]."""
    ix, iy, iz, st, ct, s, c = _parts(moments, q)
    be, ga = beta(moments), gamma(moments, q)
    f, h, g = jnp.unstack(qd, axis=-1)
    cos2, k = c**2 - s**2, ix * iy * be
    x1 = (
        (2 * iz - 2 * ix * iy * ga) * st * ct * f * h
        + 2 * k * st**2 * s * c * f * g
        + k * s * c * ct * h**2
        + (k * cos2 + iz) * st * h * g
    )
    x2 = (ix * iy * ga - iz) * st * ct * f**2 + (k * cos2 - iz) * st * f * g - 2 * k * s * c * h * g
    x3 = -k * s * c * st**2 * f**2 + (iz - k * cos2) * st * f * h + k * s * c * h**2
    return jnp.stack(jnp.broadcast_arrays(x1, x2, x3), axis=-1)


def accelerations(moments: Vector3, q: Vector3, qd: Vector3) -> Float[Array, "*b 3"]:
    """Eqs. 37-39 with eq. 39 corrected: d2(phi, theta, psi)/dt2 of the free body [rad/s^2]."""
    ix, iy, iz, st, ct, s, c = _parts(moments, q)
    al, be, ga = alpha(moments, q), beta(moments), gamma(moments, q)
    f, h, g = jnp.unstack(qd, axis=-1)
    sin2, k = 2 * s * c, ix * iy
    e1, e2 = k * (c**2 / ix**2 + s**2 / iy**2), k * (s**2 / ix**2 + c**2 / iy**2)
    skew = k * be * (al + ga) - iz * be
    lift = 1 - e1 + iz * al
    phi = (
        sin2 * ct / 2 * skew * f**2
        + ct / st * (iz * al - k * al * (al + ga)) * f * h
        + sin2 / 2 * skew * f * g
        + lift / st * h * g
    )
    theta = (
        st * ct * (e2 - iz * ga) * f**2
        - s * c * ct * skew * f * h
        + st * (-1 + e2 - iz * ga) * f * g
        - sin2 / 2 * skew * h * g
    )
    psi = (
        sin2 / 2 * (-(ct**2) * skew - k / iz * be * st**2) * f**2
        + (ct**2 / st * (k * al * (al + ga) - iz * al) + st * (k / iz * (al - ga) + 1)) * f * h
        - sin2 * ct / 2 * skew * f * g
        + k / (2 * iz) * sin2 * be * h**2
        - ct / st * lift * h * g
    )
    return jnp.stack(jnp.broadcast_arrays(phi, theta, psi), axis=-1)


class HamiltonianMatrices(NamedTuple):
    """The matrices of the ZYZ Euler-angle Hamiltonian, each (..., 3, 3) and symmetric.

    With momenta p = (p_phi, p_theta, p_psi): H = p . V p / 2, dq/dt = V p,
    dp_theta/dt = p . Theta p, dp_psi/dt = p . Psi p, and p_phi is constant.
    """

    V: Float[Array, "*b 3 3"]
    Theta: Float[Array, "*b 3 3"]
    Psi: Float[Array, "*b 3 3"]


def hamiltonian_matrices(inertia: Inertia, q: ArrayLike) -> HamiltonianMatrices:
    """Closed forms of the matrices V, Theta and Psi of the free body in ZYZ Euler angles.

    They are an independent reference: polhode integrates the derivatives of ``ph.hamiltonian`` by
    ``jax.grad`` instead, and the tests compare the two.

    **Arguments:** ``inertia`` (...): about principal axes; ``q`` (..., 3): phi, theta, psi [rad].
    Entries are infinite or NaN where sin(theta) is 0. V and its derivatives are in 1/(kg m^2).

    Raises TypeError for another kind of inertia, ValueError for one with products of inertia.
    Reference: docs/equations.md, equations 11, 14 and 15 of the ZYZ Euler-angle Hamiltonian.

        V, Theta, Psi = ph.hamiltonian_matrices(ph.Inertia.from_moments([1, 2, 3]), [0.1, 0.8, 0.3])
    """
    if not isinstance(inertia, Inertia):
        raise TypeError(
            f"inertia must be a ph.Inertia, got {type(inertia).__name__}: for principal moments,"
            " ph.Inertia.from_moments([...])."
        )
    if not inertia.is_principal:
        raise ValueError(
            "the closed forms hold about principal axes, and this inertia has products of inertia:"
            " use ph.Inertia.from_moments of its principal moments."
        )
    moments, q = inertia.moments, as_float_array("q", q, (3,)).astype(inertia.dtype)
    return HamiltonianMatrices(
        inverse_mass_matrix(moments, q), theta_form(moments, q), psi_form(moments, q)
    )


_Angle = Float[Array, "*b"]
_Triple = tuple[_Angle, _Angle, _Angle]


def _matrix(rows: list[list[Array]]) -> Float[Array, "*b 3 3"]:
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def matrix_k(phi: _Angle, theta: _Angle, psi: _Angle) -> Float[Array, "*b 3 3"]:
    """K, product of three passive rotations, ``Rz(phi)^T Ry(theta)^T Rz(psi)^T`` (eq. 1)."""
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
    """Active rotation by ``angle`` about the unit axis (l, m, n) (eq. 2)."""
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
