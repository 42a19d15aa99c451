"""The public functions: prepare a motion, evaluate it, and the derivative of both."""

import functools

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from polhode.free._compensated import compensate
from polhode.free._flow import Moment, advance, attitude, rates
from polhode.free._frame import Frame, Quadruple, cross, dot, hamilton, matrix
from polhode.free._motion import FreeMotion, Swing, Turning, prepare_swing, prepare_turning
from polhode.free._roles import Triple, assign_roles, settle
from polhode.free._second import second_kind
from polhode.free._tangent import (
    Change,
    Setting,
    momentum_tangent,
    partials,
    products_of_momenta,
    squares_of_momenta,
)

Scalars = Float[Array, "*b"]

# States that a core keeps in its nearest caches through all stages.
_CHUNK = 8192


def components(values, count: int) -> tuple[Scalars, ...]:
    """A tuple of component arrays, from one or from an array with the components last."""
    if isinstance(values, tuple | list):
        return tuple(values)
    return tuple(values[..., k] for k in range(count))


def prepare(moments, wxyz, omega, products=None, *, compensated: bool = False) -> FreeMotion:
    """Constants of the exact motion of free bodies.

    **Arguments:** principal ``moments`` (..., 3), positive, in any order; initial attitude
    ``wxyz`` (..., 4), or None when only rates will be asked; initial body rates ``omega``
    (..., 3) along the principal axes; ``products`` (..., 3), the entries xy, xz, yz of the inertia
    tensor, of value zero: they only carry tangents. Each may be a tuple of component arrays; all
    components share one shape, the batch. ``compensated``: the frequencies in sums of two floats,
    for long horizons.
    """
    moments, omega = components(moments, 3), components(omega, 3)
    products = None if products is None else components(products, 3)
    wxyz = None if wxyz is None else components(wxyz, 4)
    # First derivatives do not pass through these constants (see _evaluate_rule), second ones do.
    roles = assign_roles(moments, omega)
    swing = prepare_swing(roles)
    turning = None if wxyz is None else prepare_turning(swing, wxyz)
    if compensated:
        swing, turning = compensate(swing, turning, roles)
    return FreeMotion(moments, products, omega, wxyz, swing, turning)


def evaluate(
    motion: FreeMotion, t: Float[Array, "..."], *, attitude: bool = True, rates: bool = True
) -> tuple[Triple | None, Quadruple | None]:
    """Body rates and attitude at times ``t`` from the start, as tuples of component arrays.

    ``t`` has the rank of the batch and broadcasts with it, or one trailing axis more: the times
    of each body. Times may be negative. What is not asked is None and costs nothing.
    """
    batch = motion.moments[0].ndim
    t = jnp.asarray(t)
    if t.ndim > batch + 1:
        raise ValueError(f"t has {t.ndim} axes, the motion {batch}: expected as many or one more")
    if attitude and motion.turning is None:
        raise ValueError("the motion was prepared without wxyz: give it, or ask attitude=False")
    many = t.ndim == batch + 1
    if many:
        motion = jax.tree.map(lambda x: x[..., None], motion)
    elif t.ndim < batch:
        t = t.reshape((1,) * (batch - t.ndim) + t.shape)
    turning = motion.turning if attitude else None
    given = (motion.moments, motion.products, motion.omega, motion.wxyz if attitude else None, t)
    return _evaluate((attitude, rates, many), (motion.swing, turning), given)


def free_motion(
    moments,
    wxyz,
    omega,
    t,
    products=None,
    *,
    attitude: bool = True,
    rates: bool = True,
    compensated: bool = False,
) -> tuple[Triple | None, Quadruple | None]:
    """The exact free motion: `prepare` and `evaluate` in one call.

    A long batch of one axis is worked off in chunks that fit the cache of a processor core.

    First derivatives, forward and reverse, are exact in every regime. Second derivatives come from
    differentiating those formulas, and hold for bodies of three distinct moments off the
    separatrix and off the principal axes; elsewhere they may be NaN or miss a term.
    """
    parts = (
        components(moments, 3),
        components(wxyz, 4) if attitude else None,
        components(omega, 3),
        None if products is None else components(products, 3),
    )

    def whole(given, t):
        motion = prepare(*given, compensated=compensated)
        return evaluate(motion, t, attitude=attitude, rates=rates)

    t = jnp.asarray(t)
    return _chunked(whole, parts, t)


def _chunked(fn, parts, t):
    """``fn(parts, t)``, a few thousand states at a time where a processor has many to do."""
    lanes = parts[0][0]
    times = t.shape[1] if t.ndim == 2 else 1
    rows = max(1, _CHUNK // max(times, 1))
    if jax.default_backend() != "cpu" or lanes.ndim != 1 or lanes.shape[0] < 2 * rows:
        return fn(parts, t)
    count = lanes.shape[0]
    # A divisor spares the copies that padding makes.
    even = [n for n in range(rows // 4, rows + 1) if n > 0 and count % n == 0]
    rows = max(even, default=rows)
    missing = -count % rows

    def cut(x):
        if missing == 0:
            return x.reshape(-1, rows, *x.shape[1:])
        last = jnp.broadcast_to(x[-1:], (missing, *x.shape[1:]))
        return jnp.concatenate([x, last]).reshape(-1, rows, *x.shape[1:])

    own = t.ndim > 0 and t.shape[0] == count
    pieces = jax.tree.map(cut, (parts, t) if own else (parts, None))
    out = jax.lax.map(lambda p: fn(p[0], p[1] if own else t), pieces)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:count], out)


def _results(asked, swing: Swing, turning: Turning | None, at: Moment):
    return (
        rates(swing, at) if asked[1] else None,
        attitude(swing, turning, at) if asked[0] else None,
    )


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _evaluate(asked, constants, given):
    swing, turning = constants
    return _results(asked, swing, turning, advance(swing, turning, given[-1], asked[2]))


def zero_where_symbolic(tangents, primals):
    """None where every tangent is zero, arrays otherwise."""
    if tangents is None or all(isinstance(x, SymbolicZero) for x in jax.tree.leaves(tangents)):
        return None
    return jax.tree.map(
        lambda d, x: jnp.zeros_like(x) if isinstance(d, SymbolicZero) else d, tangents, primals
    )


def change_of_start(swing: Swing, frame: Frame, dm, dp, dw) -> Change:
    """Variation of the initial momentum and of the inverse tensor, in roles and scaled units."""
    zero = (jnp.zeros_like(swing.heft),) * 3
    inverse_pulse = 1 / jnp.where(swing.pulse > 0, swing.pulse, 1)
    di = tuple(x / swing.heft for x in frame.to_roles(dm)) if dm is not None else zero
    dv = tuple(x * inverse_pulse for x in frame.to_roles(dw)) if dw is not None else zero
    d1, d2, d3 = d = swing.inverse
    w1, w2, w3 = w = tuple(x * y for x, y in zip(swing.momentum, d, strict=True))
    gain = tuple(i * v + e * u for i, v, e, u in zip(swing.moments, dv, di, w, strict=True))
    inverse = tuple(-k * k * e for k, e in zip(d, di, strict=True))
    if dp is None:
        return Change(gain, inverse, None)
    p12, p13, p23 = (x / swing.heft for x in frame.to_pairs(dp))
    gain = (
        gain[0] + p12 * w2 + p13 * w3,
        gain[1] + p12 * w1 + p23 * w3,
        gain[2] + p13 * w1 + p23 * w2,
    )
    return Change(gain, inverse, (-d1 * d2 * p12, -d1 * d3 * p13, -d2 * d3 * p23))


def _relative_turn(swing: Swing, turning: Turning, frame: Frame, at: Moment, step: Triple):
    """Quaternion from the attitude at t to that at the start, its vector part exact when small."""
    l1, l2, l3 = frame.turned(swing.momentum)
    s1, s2, s3 = frame.turned(step)
    c, s = at.half
    height = turning.length + l3
    tilt = jnp.sqrt(height * height + l1 * l1 + l2 * l2)
    c, s = c / tilt, s / tilt
    along = s * (tilt * tilt / turning.length)
    v0 = c * s3
    v = (c * s2 + s * s1, s * s2 - c * s1, s * s3)
    back = cross((l2, -l1, jnp.zeros_like(l1)), v)
    vector = (
        along * l1 + height * v[0] - v0 * l2 - back[0],
        along * l2 + height * v[1] + v0 * l1 - back[1],
        along * l3 + height * v[2] - back[2],
    )
    scalar = c * tilt * tilt + height * v0 + l2 * v[0] - l1 * v[1]
    return scalar, vector


def _turn_tangent(swing, turning, frame: Frame, at: Moment, change: Change, moved, first, t):
    """Variation of the attitude: a rotation vector along axes 1, 2, 3 at time t."""
    hand = swing.sense * swing.parity
    setting = Setting(swing.momentum, swing.p, swing.r, swing.s, swing.A, swing.B)
    j12, j13, j23 = products_of_momenta(setting, at.functions, hand)
    step = (-hand * swing.r * j23, hand * swing.s * j13, -hand * swing.p * j12)
    scalar, vector = _relative_turn(swing, turning, frame, at, step)
    gain = frame.turned(change.momentum)
    once = cross(vector, gain)
    twice = cross(vector, once)
    lag = tuple(
        2 * (b - scalar * a) - m for a, b, m in zip(once, twice, frame.turned(moved), strict=True)
    )
    squares = squares_of_momenta(swing, at.functions[0], at.momentum, first, t)
    start = swing.momentum
    spin = tuple(x * y for x, y in zip(start, swing.inverse, strict=True))
    energy = dot(spin, change.momentum) + dot(start, matrix(change, start)) / 2
    about = t * energy + dot(change.inverse, squares) / 2
    if change.crossed is not None:
        about = about + dot(change.crossed, (j12, j13, j23))
    now = frame.turned(at.momentum)
    inverse = 1 / (turning.length * turning.length)
    turn = tuple((a + about * b) * inverse for a, b in zip(cross(now, lag), now, strict=True))
    return frame.turned(turn)


def _for_tangent(swing: Swing, at: Moment, t: Scalars) -> Moment:
    """S, C, N as the tangent needs them; the momentum itself does not.

    Where omega_p is zero S is the time. On the separatrix derivatives grow without bound: they are
    held where their products would overflow.
    """
    still = swing.inverse_rate == 0
    least = 2.0 ** -{4: 17, 8: 140}[t.dtype.itemsize]

    def mend(functions: Triple) -> Triple:
        S, C, N = functions
        C, N = (jnp.where(swing.endless, jnp.maximum(x, least), x) for x in (C, N))
        return jnp.where(still, t, S), C, N

    return at._replace(folded=mend(at.folded), functions=mend(at.functions))


def _evaluate_rule(asked, primals, tangents):
    (swing, turning), given = primals
    dm, dp, dw, dq, dt = (
        zero_where_symbolic(d, x) for d, x in zip(tangents[1], given, strict=True)
    )
    t = given[-1]
    at = advance(swing, turning, t, asked[2])
    results = _results(asked, swing, turning, at)
    frame = Frame(swing)
    resting = swing.pulse == 0
    hand = swing.sense * swing.parity
    scaled = t * swing.pulse
    # The transpose of a stage is a stage: it keeps cotangents from being summed again and again.
    stage = (lambda x: x) if asked[2] else (lambda x: settle(x, swing.one))
    change = stage(change_of_start(swing, frame, dm, dp, dw))
    at = _for_tangent(swing, at, scaled)
    first, second = second_kind(swing, at.whole, at.folded, asked[2])
    first, second = stage((first, second))
    by = stage(partials(swing.B * swing.r, swing.A * swing.p, at.functions, first, second))
    moved = stage(momentum_tangent(swing, at.functions, at.momentum, by, change, stage))
    n1, n2, n3 = now = at.momentum
    held = (jnp.zeros_like(n1),) * 3 if dw is None else tuple(dw)
    d_omega = d_wxyz = None
    if asked[1]:
        total = tuple(g + m for g, m in zip(change.momentum, moved, strict=True))
        if dt is not None:
            late = hand * swing.pulse * dt
            total = (
                total[0] - swing.r * n2 * n3 * late,
                total[1] + swing.s * n1 * n3 * late,
                total[2] - swing.p * n1 * n2 * late,
            )
        spun = tuple(
            swing.pulse * (d * x + e)
            for d, x, e in zip(swing.inverse, total, matrix(change, now), strict=True)
        )
        d_omega = tuple(
            jnp.where(resting, h, x) for h, x in zip(held, frame.to_body(spun), strict=True)
        )
    if asked[0]:
        turn = _turn_tangent(swing, turning, frame, at, change, moved, first, scaled)
        if dt is not None:
            turn = tuple(
                e + n * d * (swing.pulse * dt)
                for e, n, d in zip(turn, now, swing.inverse, strict=True)
            )
        turn = tuple(
            jnp.where(resting, t * h, e) / 2 for h, e in zip(held, frame.to_body(turn), strict=True)
        )
        d_wxyz = hamilton(results[1], (jnp.zeros_like(n1), *turn))
        if dq is not None:
            d_wxyz = _start_tangent(given[3], dq, results[1], d_wxyz)
    return results, (d_omega, d_wxyz)


def _start_tangent(start: Quadruple, change: Quadruple, now: Quadruple, other: Quadruple):
    """Adds the answer to the initial attitude, which is normalised before use."""
    inverse = 1 / dot(start, start)
    along = dot(start, change)
    unit = tuple((d - along * inverse * q) * inverse for d, q in zip(change, start, strict=True))
    left = hamilton(unit, (start[0], -start[1], -start[2], -start[3]))
    return tuple(a + b for a, b in zip(other, hamilton(left, now), strict=True))


_evaluate.defjvp(_evaluate_rule, symbolic_zeros=True)
