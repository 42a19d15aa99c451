"""Magnitudes of a free ellipsoid from the unknowns of a fit, in batches, with exact derivatives."""

from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode import rotation
from polhode._closed_forms import free_motion, principal_periods
from polhode._closed_forms._free_motion import Triple
from polhode.lightcurve._phase import AbstractPhase
from polhode.lightcurve._scattering import _cross, seeliger_ellipsoid

Scalars = Float[Array, "*b"]

# Unknowns besides the attitude: logarithms of the second and third semi-axis over the first, of
# the homogeneous ellipsoid of the same inertia (2) and of the visible shape (2); body rates (3);
# coefficients of the phase function; offsets. A step turns the attitude by a rotation vector (3).
INERTIA, SHAPE, RATES, PHASE = slice(0, 2), slice(2, 4), slice(4, 7), 7


class Points(NamedTuple):
    """A light curve as the model needs it; rows (1, n), directions as component tuples."""

    t: Float[Array, "1 n"]
    sun: Triple
    observer: Triple
    alpha: Float[Array, "1 n"]
    sphere: Float[Array, "1 n"]  # magnitude that the law itself gives a sphere
    magnitude: Float[Array, "1 n"]
    weight: Float[Array, "1 n"]  # 1 / sigma^2; 0 pads
    columns: Float[Array, "c n"]  # of the offsets
    stiffness: Float[Array, " c"]  # 1 / sigma^2 of what is known of them


class Bodies(NamedTuple):
    """A batch of trial bodies: unknowns (b, u) and attitudes at t = 0 (b, 4)."""

    unknowns: Float[Array, "b u"]
    wxyz: Float[Array, "b 4"]


def moments_of(unknowns: Float[Array, "*b u"]) -> Triple:
    """Moments, up to scale: those of the homogeneous ellipsoid with axes 1, e^u0, e^u1."""
    y, z = jnp.exp(2 * unknowns[..., 0]), jnp.exp(2 * unknowns[..., 1])
    return y + z, 1 + z, 1 + y


def attitudes(unknowns: Float[Array, "b u"], wxyz: Float[Array, "b 4"], t: Float[Array, "1 n"]):
    """Quaternion components (b, n) of the exact motion."""
    omega = tuple(unknowns[:, k] for k in (4, 5, 6))
    start = tuple(wxyz[:, k] for k in range(4))
    return free_motion(moments_of(unknowns), start, omega, t, rates=False)[1]


def _to_body(q, vector: Triple) -> Triple:
    axis = tuple(-x for x in q[1:])
    twice = tuple(2 * x for x in _cross(axis, vector))
    again = _cross(axis, twice)
    return tuple(x + q[0] * y + z for x, y, z in zip(vector, twice, again, strict=True))


def _seen(phase: AbstractPhase, q, turn: Triple, shape, coefficients, points: Points) -> Scalars:
    """Magnitudes but for offsets; all arguments by sample. ``turn``: small, of space."""
    sun, observer = (
        tuple(a - b for a, b in zip(v, _cross(turn, v), strict=True))
        for v in (points.sun, points.observer)
    )
    b, c = jnp.exp(shape[0]), jnp.exp(shape[1])
    light = seeliger_ellipsoid((jnp.ones_like(b), b, c), _to_body(q, sun), _to_body(q, observer))
    # over the sphere of the same volume
    light = jnp.maximum(light, 1e-12) / (jnp.pi / 2 * (b * c) ** (2 / 3))
    return -2.5 * jnp.log10(light) - points.sphere + phase.magnitudes(points.alpha, coefficients)


def magnitudes(phase: AbstractPhase, bodies: Bodies, points: Points) -> Float[Array, "b n"]:
    """Reduced magnitudes, but for the offsets."""
    q = attitudes(*bodies, points.t)
    u, zero = bodies.unknowns[:, :, None], jnp.zeros(())
    many = len(phase.typical)
    coefficients = jnp.moveaxis(u[:, PHASE : PHASE + many], 1, -1)
    return _seen(phase, q, (zero, zero, zero), (u[:, 2], u[:, 3]), coefficients, points)


def magnitudes_and_slopes(phase: AbstractPhase, bodies: Bodies, points: Points):
    """Magnitudes (b, n) and their derivatives (b, 10 + c, n), the turn in space (3) last.

    The motion is differentiated by five numbers only, the light sample by sample in reverse.
    """
    u, wxyz = bodies
    count = u.shape[0]

    def moved(step):
        return attitudes(u.at[:, jnp.array([0, 1, 4, 5, 6])].add(step), wxyz, points.t)

    q, along = jax.linearize(moved, jnp.zeros(5, u.dtype))
    many = len(phase.typical)
    whole = (count, points.t.shape[1])

    def spread(x):
        return jnp.broadcast_to(x[:, None], whole)

    turn = tuple(jnp.zeros(whole, u.dtype) for _ in range(3))
    shape = tuple(spread(u[:, k]) for k in (2, 3))
    coefficients = jnp.broadcast_to(u[:, None, PHASE : PHASE + many], (*whole, many))

    def seen(q, turn, shape, coefficients):
        return _seen(phase, q, turn, shape, coefficients, points)

    value, pull = jax.vjp(seen, q, turn, shape, coefficients)
    by_q, by_turn, by_shape, by_coefficients = pull(jnp.ones(whole, u.dtype))
    # one at a time: rows of samples stay contiguous, a mapped axis would come between them
    motion = [
        cast(Array, sum(a * b for a, b in zip(by_q, along(e), strict=True)))
        for e in jnp.eye(5, dtype=u.dtype)
    ]
    known = [by_coefficients[..., k] for k in range(many)]
    return value, jnp.stack([*motion[:2], *by_shape, *motion[2:], *known, *by_turn], axis=1)


def _frequencies(unknowns):
    """Logarithms of f_phi and f_psi, and the mode, of one body."""
    found = principal_periods(moments_of(unknowns), unknowns[RATES])
    return -jnp.log(jnp.stack([found.P_phi, found.P_psi])), found.mode


def _kept(old, step):
    """``old + step`` of one body, its rates mended so that frequencies change as the step meant."""
    (before, mode), (change, _) = jax.jvp(_frequencies, (old,), (step,))
    plain = old + step
    rates, near = plain[RATES], True
    for _ in range(2):

        def left(x):
            now, mode = _frequencies(plain.at[RATES].set(x))
            return now - before - change, (now - before - change, mode)

        slopes, (rest, now) = jax.jacfwd(left, has_aux=True)(rates)
        # the least change of the rates; the matrix is 2 x 2
        a, b, c = (slopes[i] @ slopes[j] for i, j in ((0, 0), (0, 1), (1, 1)))
        weights = jnp.stack([c * rest[0] - b * rest[1], a * rest[1] - b * rest[0]]) / (
            a * c - b * b
        )
        rates, near = rates - weights @ slopes, near & (now == mode)
    change = rates - plain[RATES]
    near = near & (jnp.sum(change**2) < 0.1 * jnp.sum(plain[RATES] ** 2))  # false if not finite
    return plain.at[RATES].set(jnp.where(near, rates, plain[RATES]))


def stepped(bodies: Bodies, step: Float[Array, "b u+3"]) -> Bodies:
    """The bodies after a step of the unknowns and a turn in space.

    A step to first order: to second order its frequencies are kept to what they are to first,
    because the valleys of long light curves are narrow in the frequencies and curved in the rates.
    """
    turn = rotation.rotation_vector_to_wxyz(step[:, -3:])
    wxyz = rotation.normalise(rotation.multiply(turn, bodies.wxyz))
    return Bodies(jax.vmap(_kept)(bodies.unknowns, step[:, :-3]), wxyz)
