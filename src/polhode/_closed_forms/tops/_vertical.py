"""Lagrange's top for any direction of gravity: the frame of the vertical, and back."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode._closed_forms.tops._complex import Complex
from polhode._closed_forms.tops._lagrange import at, orbit
from polhode._closed_forms.tops._pochhammer import Series
from polhode._closed_forms.tops._short import frequency, reach, short_motion
from polhode._closed_forms.tops._weightless import with_weight
from polhode._hamiltonian import components
from polhode._kernels import any_of, kernel, opaque_ones, spread, staged


def upward(force: tuple[Array, Array, Array]) -> tuple[tuple[Array, Array, Array], Array]:
    """Turn (w, x, y; z = 0) of space z to an axis along +-force (never downwards), and the signed
    size of the force along it.

    Without force the axis is z: the motion does not depend on it. The derivatives by the force are
    then those of ``_weightless``.
    """
    square = sum(x * x for x in force)
    acting = square > 0
    size = jnp.sqrt(jnp.where(acting, square, 1))
    up = jnp.where(force[2] < 0, -1, 1).astype(size.dtype)
    a, b, c = (jnp.where(acting, up * v / size, w) for v, w in zip(force, (0, 0, 1)))
    half = jnp.sqrt((1 + c) / 2)
    return (half, -b / (2 * half), a / (2 * half)), jnp.where(acting, up * size, force[2])


def _turned(turn: tuple[Array, Array, Array], q: tuple[Array, ...]) -> tuple[Array, ...]:
    """Quaternion product (w, x, y, 0) q on components."""
    a, b, c = turn
    w, x, y, z = q
    return (
        a * w - b * x - c * y,
        a * x + b * w + c * z,
        a * y - b * z + c * w,
        a * z + b * y - c * x,
    )


def lagrange_motion(
    transverse: Float[Array, " n"],
    force_space: Float[Array, "n 3"],
    distance: Float[Array, " n"],
    wxyz: Float[Array, "n 4"],
    omega: Float[Array, "n 3"],
    axial_momentum: Float[Array, " n"],
    elapsed: Float[Array, "n t"],
) -> tuple[Float[Array, "n t 4"], Float[Array, "n t 3"]]:
    """Attitude and body rates after ``elapsed`` [s] of a symmetric body about a fixed point.

    ``transverse``: moment about any axis through the point and across body z [kg m^2];
    ``force_space``: weight [N], space axes, acting at ``distance`` [m] along body z; ``wxyz``,
    ``omega`` [rad/s]: initial state; ``axial_momentum`` along body z [kg m^2/s], that of wheels on
    the axis included. Klein & Sommerfeld, Theorie des Kreisels, VI; see ``_lagrange``, where
    the body hardly moves in that time ``_short``, and without force ``_weightless``.
    """
    given: tuple[Any, ...] = transverse, force_space, distance, wxyz, omega, axial_momentum
    fixed = jax.lax.stop_gradient((transverse, force_space, distance, omega, axial_momentum))
    angle = frequency(*fixed)[:, None] * jnp.abs(jax.lax.stop_gradient(elapsed))
    short = angle < reach(elapsed.dtype)
    # Derivatives of the closed form would be NaN there: it is evaluated for another motion.
    still = jnp.all(short, axis=-1)[:, None]
    weightless = jnp.all(force_space == 0, axis=-1, keepdims=True)
    force = jnp.where(still | weightless, 0, force_space)
    start = jnp.where(still, 1, omega)
    other = transverse, force, distance, wxyz, start, axial_momentum, jnp.where(short, 0, elapsed)
    closed_form: Any = kernel(_long_motion, repeated=True)
    motion = closed_form(*other)

    def special(motion, given, elapsed):
        corrected: Any = kernel(_corrected, repeated=True)
        return corrected(motion, given, elapsed, short, weightless, still)

    def general(motion, given, elapsed):
        return list(motion)

    which = any_of(jnp.where(short | weightless, 1, 0))
    wxyz, omega = jax.lax.cond(which, special, general, motion, given, elapsed)
    return wxyz, omega


def _corrected(motion, given: Any, elapsed, short, weightless, still) -> Any:
    """The motion with what the closed form does not have: see ``lagrange_motion``."""
    transverse, force, distance, wxyz, omega, axial = given
    small = short_motion(
        transverse, force, distance, wxyz, omega, axial, jnp.where(short, elapsed, 0)
    )
    weighted = with_weight(
        transverse, force, distance, wxyz, omega, axial, elapsed, motion, weightless & ~still
    )
    motion = [jnp.where(weightless[..., None], x, y) for x, y in zip(weighted, motion)]
    return [jnp.where(short[..., None], x, y) for x, y in zip(small, motion)]


def _long_motion(transverse, force_space, distance, wxyz, omega, axial_momentum, elapsed):
    """The closed form, arguments and results as of ``lagrange_motion``."""
    # The compiler makes a loop of every axis, be it of length one, and vectors of the last axis
    # only: axes of length one are left out, and the longer one comes last.
    lanes, count = elapsed.shape
    times, axis = elapsed, -1
    given = transverse, force_space, distance, wxyz, omega, axial_momentum
    if lanes == 1:
        times, given = jax.tree.map(lambda x: x[0], (times, given))
    elif count < lanes:
        times, axis = times.T, -2
    if count == 1:
        times = jnp.squeeze(times, axis)
    transverse, force_space, distance, wxyz, omega, axial_momentum = given
    one = opaque_ones(transverse)
    wxyz, omega = staged((tuple(wxyz[..., i] for i in range(4)), components(omega)), one)
    turn, size = staged(upward(components(force_space)), one)
    back = (turn[0], -turn[1], -turn[2])
    q, spin = staged(_turned(back, wxyz), one), omega[2]
    momentum = (transverse * omega[0], transverse * omega[1], axial_momentum)
    spinor = Complex(q[0], q[3]), Complex(q[2], q[1])
    motion = orbit(transverse, spin, -size * distance, spinor, momentum)
    if count > 1:
        series = motion.series
        motion, h, turn, spin = spread(
            (motion._replace(series=None), series.h, turn, spin), axis, count
        )
        # apart, for no cotangents but that of h need be summed
        weights = spread((series.weights, series.slopes), axis, count)
        motion = motion._replace(series=Series(h, *weights))
    alpha, beta, across = at(motion, times)
    square = 1 / (alpha.square + beta.square)
    scale = jnp.sqrt(square)
    q = _turned(tuple(x * scale for x in turn), (alpha.re, beta.im, beta.re, alpha.im))
    rates = (across.im * square, across.re * square, spin)

    def together(parts):
        return jnp.stack([x.T if count < lanes else x for x in parts], axis=-1).reshape(
            lanes, count, -1
        )

    return together(q), together(rates)
