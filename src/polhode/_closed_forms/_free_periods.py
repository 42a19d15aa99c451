"""Periods of the free motion, by the mean rates (13) of docs/free_motion.md.

``periods`` are those of the long axis, in the convention of Samarasinha and A'Hearn.
"""

import enum
import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from polhode import rotation
from polhode._batch import common_batch
from polhode._checks import describe, is_concrete, require
from polhode._closed_forms._free_constants import (
    Polhode,
    as_components,
    assign_roles,
    descend,
    polhode_constants,
    precession_constants,
)
from polhode._closed_forms._free_derivatives import (
    along_rotating_axes,
    dense_or_none,
    start_variation,
)
from polhode._closed_forms._free_tangent import (
    Frame,
    apply_variation,
    complete,
    invariants_variation,
)
from polhode._hamiltonian import dot
from polhode._kernels import are_close, kernel, underivable
from polhode._method import of_one_dtype
from polhode._scene import State
from polhode.inertia import Inertia, principal

Scalars = Float[Array, "*b"]


class Mode(enum.IntEnum):
    """Mode of a free rotation; the values of ``Periods.mode``."""

    LAM = 0  # long-axis mode: L circles the axis of the least moment
    SAM = 1  # short-axis mode: L circles the axis of the greatest moment
    SEPARATRIX = 2
    PROLATE = 3  # two equal greater moments; the numbers are those of LAM
    OBLATE = 4  # two equal lesser moments; the numbers are those of SAM
    SPHERICAL = 5
    AT_REST = 6


class Periods(NamedTuple):
    """Periods and nutation limits; every field has the shape of the batch."""

    P_psi: Scalars
    """Period [s] of the rotation about the long axis (LAM) or the oscillation about it (SAM)."""
    P_phi: Scalars
    """Mean period [s] of the precession of the long axis about the angular momentum."""
    mode: Int[Array, "*b"]
    k2: Scalars
    """Elliptic parameter, 0 for a symmetric body and 1 on the separatrix."""
    theta_min: Scalars
    """Smallest angle between long axis and momentum [rad]; in LAM from the closer end of the
    axis."""
    theta_max: Scalars

    @property
    def P_phi_short_axis(self) -> Scalars:
        """Mean period [s] of the precession of the axis of greatest moment about the momentum.

        ``P_phi`` in the short-axis convention, the wobble of a plate or of a body in SAM:
        1 / (1 / P_phi + 1 / P_psi); P_psi is the same in both conventions (Samarasinha & A'Hearn,
        Icarus 93 (1991) 194).
        """
        return 1 / (1 / self.P_phi + 1 / self.P_psi)


def principal_periods(moments, omega, products=None) -> Periods:
    """Periods of bodies of principal ``moments`` (..., 3) and body rates ``omega`` (..., 3).

    Periods are infinite if there is no such motion: P_psi on the separatrix, for a sphere and for a
    symmetric body that rotates about a transverse axis; both for a body at rest (with nutation
    limits 0 and pi).
    ``products`` as in `prepare`. Formulas: Landau & Lifshitz, Mechanics, section 37, in the L
    convention of Samarasinha & A'Hearn, Icarus 93 (1991).
    """
    moments, omega = as_components(moments), as_components(omega)
    products = None if products is None else as_components(products)
    values, mode = _periods((moments, products, omega))
    P_psi, P_phi, k2, low, high = values
    return Periods(P_psi, P_phi, mode, k2, low, high)


def _mean_precession(polhode: Polhode, precession, rate_unit: Scalars) -> Scalars:
    """Mean rate of the long axis about L, in scaled time."""
    half_turns = math.pi * polhode.half_turn_rate / rate_unit
    about_L = 2 * math.pi * precession.half_turn_rate / rate_unit
    # The long axis makes one revolution less per period than the minimal rotation. For needles this
    # difference cancels, and the theta series of the axis itself is used instead.
    shift = descend(polhode, precession.length)
    growth = jnp.where(polhode.circular, shift + jnp.sqrt(1 + shift * shift), 1)
    decay = 1 / (growth * growth)
    q = polhode.nome
    first, second = (q * growth) ** 2, (q * q * (q * growth * growth)) ** 2
    # ``growth`` is less than 1/q, and q less than exp(-pi): the fifth terms, q^30 growth^10, are
    # below rounding
    third, fourth = (q**6 * growth**3) ** 2, (q**6 * (q * growth) ** 4) ** 2
    above = decay - first * (1 + 2 * decay**3) + second * (2 + 3 * decay**5)
    above = above - third * (3 + 4 * decay**7) + fourth * (4 + 5 * decay**9)
    below = (1 - decay) - first * (1 - decay**3) + second * (1 - decay**5)
    below = below - third * (1 - decay**7) + fourth * (1 - decay**9)
    level = precession.length * polhode.inverse_moments[0]
    series = level + polhode.rate * 2 * above / jnp.where(below > 0, below, 1)
    long = jnp.where(polhode.circular & (below > 0), series, about_L - half_turns)
    return jnp.where(polhode.sense < 0, long, about_L)


def _limits(A, B, r, s, m1):
    """Amplitudes of L1, L2, L3 and the least L3."""

    def root(value):
        return jnp.where(value > 0, jnp.sqrt(jnp.where(value > 0, value, 1)), 0)

    aspherical_s = jnp.where(s > 0, s, 1)
    first, third = root(A / aspherical_s), root(B / aspherical_s)
    second = root(jnp.where(r > 0, A / jnp.where(r > 0, r, 1), A / aspherical_s))
    return first, second, third, third * root(m1)


def _angles(sense, A, B, r, s, m1):
    first, second, third, L3_min = _limits(A, B, r, s, m1)
    limit = jnp.arctan2(third, first)
    low = jnp.where(sense < 0, jnp.arctan2(first, third), limit)
    high = jnp.where(sense < 0, jnp.arctan2(second, L3_min), math.pi - limit)
    return low, high


def _values_and_constants(arguments):
    moments, _, omega = arguments
    roles = assign_roles(moments, omega)
    polhode = polhode_constants(roles)
    one = jnp.ones_like(moments[0])
    precession = precession_constants(polhode, (one, 0 * one, 0 * one, 0 * one))
    at_rest, is_sphere = polhode.rate_unit == 0, polhode.s == 0
    rate_unit = jnp.where(at_rest, 1, polhode.rate_unit)
    on_separatrix = (roles.gap == 0) & (polhode.B * polhode.r > 0)
    level = (
        jnp.where(on_separatrix, polhode.inverse_moments[1], polhode.inverse_moments[2])
        * precession.length
    )
    permanent = on_separatrix | is_sphere | (polhode.half_turn_rate == 0)
    about = (
        jnp.where(permanent, level, _mean_precession(polhode, precession, rate_unit))
        * polhode.rate_unit
    )
    half_turn_rate = jnp.where(on_separatrix, 0, polhode.half_turn_rate)
    P_psi = jnp.where(
        half_turn_rate > 0, 2 / jnp.where(half_turn_rate > 0, half_turn_rate, 1), jnp.inf
    )
    P_phi = jnp.where(about > 0, 2 * math.pi / jnp.where(about > 0, about, 1), jnp.inf)
    low, high = _angles(polhode.sense, polhode.A, polhode.B, polhode.r, polhode.s, polhode.m1)
    low, high = jnp.where(at_rest, 0, low), jnp.where(at_rest, math.pi, high)
    mode = jnp.where(polhode.sense < 0, Mode.LAM, Mode.SAM)
    mode = jnp.where(on_separatrix, Mode.SEPARATRIX, mode)
    i1, i2, i3 = polhode.moments
    long_pair = jnp.where(polhode.sense < 0, i1 == i2, i2 == i3)
    short_pair = jnp.where(polhode.sense < 0, i2 == i3, i1 == i2)
    mode = jnp.where(long_pair, Mode.PROLATE, jnp.where(short_pair, Mode.OBLATE, mode))
    mode = jnp.where(is_sphere, Mode.SPHERICAL, mode)
    mode = jnp.where(at_rest, Mode.AT_REST, mode).astype(jnp.int32)
    return ((P_psi, P_phi, polhode.m, low, high), mode), (polhode, precession, permanent, about)


@jax.custom_jvp
def _periods(arguments):
    return _values_and_constants(arguments)[0]


def _periods_rule(primals, tangents):
    arguments = primals[0]
    dm, dp, dw = (dense_or_none(d, x) for d, x in zip(tangents[0], arguments, strict=True))
    # For symmetric bodies the derivatives of the constants below are not valid: they become NaN.
    a, b, c = arguments[0]
    symmetric = are_close(a, b) | are_close(b, c) | are_close(c, a)
    arguments = jax.tree.map(functools.partial(underivable, where=symmetric), arguments)
    if arguments[1] is not None:
        moments, products, omega = arguments
        arguments = moments, products, omega, None, None
        (*arguments, _, _), dm, dp, dw, _ = along_rotating_axes(arguments, dm, dp, dw)
    (values, mode), (polhode, precession, permanent, about) = _values_and_constants(arguments)
    P_psi, P_phi, k2, _, _ = values
    variation = start_variation(polhode, Frame(polhode), dm, dp, dw)
    dr, ds, dpp, dA, dB, dz = invariants_variation(polhode, variation)
    start = polhode.momentum
    spin = tuple(x * y for x, y in zip(start, polhode.inverse_moments, strict=True))
    energy = dot(spin, variation.momentum) + dot(start, apply_variation(variation, start)) / 2
    cross = 0.0
    if variation.off_diagonal is not None:
        l1, l2, l3 = start
        h12, h13, h23 = variation.off_diagonal
        cross = 2 * polhode.sense * (h12 * l1 * l2 + h13 * l1 * l3 + h23 * l2 * l3)
    dA, dB, dz = dA + cross, dB - cross, dz - polhode.s * cross
    x = polhode.B * polhode.r
    dx, dy = dB * polhode.r + polhode.B * dr, dA * polhode.p + polhode.A * dpp
    first, second = complete(polhode)
    quarter = P_psi * polhode.rate_unit / 4
    quarter = jnp.where(permanent, 1, quarter)
    divisor = jnp.where(x > 0, x, 1)
    # By dx and dz = dx - dy, which dominates close to the separatrix.
    relative = dx / divisor
    dquarter = (second * (polhode.m1 * dx - dz) - quarter * relative) / 2
    period = 4 * quarter
    square_2 = polhode.A * polhode.B * 4 * first
    difference = start[1] ** 2 * period - square_2
    s_divisor = jnp.where(polhode.s > 0, polhode.s, 1)
    squares = (
        start[0] ** 2 * period + polhode.r / s_divisor * difference,
        square_2,
        start[2] ** 2 * period + polhode.p / s_divisor * difference,
    )
    at_rest, is_sphere = polhode.rate_unit == 0, polhode.s == 0
    # finite in branches that are not selected: in reverse mode zero times infinity is NaN
    length = jnp.where(at_rest, 1, precession.length)
    dangle = period * energy + dot(variation.inverse_moments, squares) / 2
    dangle = (dangle + dot(spin, start) * 4 * dquarter) / length
    rate_unit = jnp.where(polhode.rate_unit > 0, polhode.rate_unit, 1)
    rate = about / rate_unit  # scaled
    # The rate of a permanent rotation about L is twice the energy over |L|.
    dlength = dot(start, variation.momentum) / length
    drate = jnp.where(
        permanent,
        (2 * energy - rate * dlength) / length,
        (dangle - rate * 4 * dquarter) / period,
    )
    is_moving = about > 0
    # zero, with the NaN derivatives of symmetric bodies
    unmoved = 0 * energy
    dP_psi = jnp.where(permanent, unmoved, 4 * dquarter / rate_unit)
    log_derivative = drate / jnp.where(is_moving, rate, 1)
    dP_phi = jnp.where(is_moving, -jnp.where(is_moving, P_phi, 1) * log_derivative, 0)
    dm1 = jnp.where(x > 0, (dz - polhode.m1 * dx) / divisor, unmoved)
    dk2 = jnp.where(x > 0, (dy - k2 * dx) / divisor, unmoved)
    dm1, dk2 = jnp.where(polhode.circular, -dk2, dm1), jnp.where(polhode.circular, dk2, -dm1)
    # the limits of a sphere and of a body at rest are constants, and their formula is 0/0
    is_fixed = at_rest | is_sphere
    amplitudes = polhode.A, polhode.B, polhode.r, polhode.s, polhode.m1
    angles = jax.jvp(
        lambda *a: _angles(polhode.sense, *a),
        tuple(jnp.where(is_fixed, 1, a) for a in amplitudes),
        (dA, dB, dr, ds, dm1),
    )[1]
    angles = tuple(jnp.where(is_fixed, unmoved, a) for a in angles)
    none = jnp.zeros(mode.shape, jax.dtypes.float0)
    return (values, mode), ((dP_psi, dP_phi, dk2, *angles), none)


_periods.defjvp(_periods_rule, symbolic_zeros=True)


def periods(inertia: Inertia, state: State) -> Periods:
    """P_psi, P_phi [s], mode and nutation limits [rad] of free bodies; fields (...).

    ``P_psi``: rotation about (LAM) or oscillation about (SAM) the long axis; ``P_phi``: mean
    precession of the long axis about the angular momentum; ``mode``: ``ph.Mode``; ``k2``: the
    elliptic parameter; ``theta_min``, ``theta_max``: angle between long axis and momentum.
    Periods are infinite if there is no such motion. Differentiable. Formulas: Landau & Lifshitz,
    Mechanics, section 37; Samarasinha & A'Hearn, Icarus 93 (1991).

    Raises TypeError for anything but a ``ph.Inertia`` and a ``ph.State`` of one dtype.
    """
    if not isinstance(inertia, Inertia) or not isinstance(state, State):
        raise TypeError(
            "periods takes a ph.Inertia and a ph.State, got"
            f" {type(inertia).__name__} and {type(state).__name__}."
        )
    if is_concrete(inertia):
        require(
            np.asarray(inertia.is_possible),
            f"periods needs moments that a body can have, got {describe(inertia.moments)}.",
        )
    (inertia, state), _ = of_one_dtype("inertia and state", (inertia, state))
    batch = common_batch(inertia, state)
    moments, products, omega = inertia.moments, None, _spread(state.omega_body, batch)
    if not inertia.is_principal:
        moments, axes, products = principal(inertia.full)
        products = _spread(products[..., ::-1], batch)  # (yz, zx, xy) -> (xy, xz, yz)
        omega = rotation.rotate(rotation.conjugate(_spread(axes, batch)), omega)
    return _compiled(_spread(moments, batch), omega, products)


def _spread(x, batch):
    x = x.reshape((1,) * (len(batch) + 1 - x.ndim) + x.shape)
    return jnp.broadcast_to(x, (*batch, x.shape[-1]))


# a kernel, because it compiles in a fifth of the time
_compiled = jax.jit(kernel(principal_periods))
