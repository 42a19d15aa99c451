"""The public functions: prepare a motion, evaluate it, and the derivative of both."""

import functools

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from polhode.free._flow import Moment, advance, attitude, rates
from polhode.free._motion import FreeMotion, Swing, Turning, prepare_swing, prepare_turning
from polhode.free._roles import Triple, assign_roles, pick, restore
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
Quadruple = tuple[Scalars, Scalars, Scalars, Scalars]


def components(values, count: int) -> tuple[Scalars, ...]:
    """A tuple of component arrays, from one or from an array with the components last."""
    if isinstance(values, tuple | list):
        return tuple(values)
    return tuple(values[..., k] for k in range(count))


def prepare(moments, wxyz, omega, products=None) -> FreeMotion:
    """Constants of the exact motion of free bodies.

    **Arguments:** principal ``moments`` (..., 3), positive, in any order; initial attitude
    ``wxyz`` (..., 4), or None when only rates will be asked; initial body rates ``omega``
    (..., 3) along the principal axes; ``products`` (..., 3), the entries xy, xz, yz of the inertia
    tensor, of value zero: they only carry tangents. Each may be a tuple of component arrays; all
    components share one shape, the batch.
    """
    moments, omega = components(moments, 3), components(omega, 3)
    products = None if products is None else components(products, 3)
    wxyz = None if wxyz is None else components(wxyz, 4)
    still = jax.lax.stop_gradient((moments, omega, wxyz))
    swing = prepare_swing(assign_roles(*still[:2]))
    turning = None if wxyz is None else prepare_turning(swing, still[2])
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
    moments, wxyz, omega, t, products=None, *, attitude: bool = True, rates: bool = True
) -> tuple[Triple | None, Quadruple | None]:
    """The exact free motion: `prepare` and `evaluate` in one call."""
    motion = prepare(moments, wxyz if attitude else None, omega, products)
    return evaluate(motion, t, attitude=attitude, rates=rates)


def _results(asked, swing: Swing, turning: Turning | None, at: Moment):
    return (
        rates(swing, at) if asked[1] else None,
        attitude(swing, turning, at) if asked[0] else None,
    )


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _evaluate(asked, constants, given):
    swing, turning = constants
    return _results(asked, swing, turning, advance(swing, turning, given[-1], asked[2]))


def _tangent_or_zero(tangents, primals):
    """None where every tangent is zero, arrays otherwise."""
    if tangents is None or all(isinstance(x, SymbolicZero) for x in jax.tree.leaves(tangents)):
        return None
    return jax.tree.map(
        lambda d, x: jnp.zeros_like(x) if isinstance(d, SymbolicZero) else d, tangents, primals
    )


class _Frame:
    """Passage between x, y, z and the right-handed axes 1, 2, 3 on which L3 is positive."""

    def __init__(self, swing: Swing):
        self.swing = swing
        facing = jnp.copysign(1, swing.momentum[2])
        self.signs = (jnp.ones_like(facing), swing.parity * facing, facing)
        self.index = (3 - swing.middle - swing.circled, swing.middle, swing.circled)

    def to_roles(self, values: Triple) -> Triple:
        return tuple(pick(values, k) for k in self.index)

    def to_pairs(self, values: Triple) -> Triple:
        """Entries xy, xz, yz as entries 12, 13, 23."""
        i, j, k = self.index
        return tuple(pick(values, n - 1) for n in (i + j, i + k, j + k))

    def to_body(self, values: Triple) -> Triple:
        return restore(values, self.swing.middle, self.swing.circled)

    def turned(self, values: Triple) -> Triple:
        return tuple(e * x for e, x in zip(self.signs, values, strict=True))


def _cross(a: Triple, b: Triple) -> Triple:
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


def _dot(a, b) -> Scalars:
    return sum(x * y for x, y in zip(a, b, strict=True))


def _hamilton(a: Quadruple, b: Quadruple) -> Quadruple:
    v = _cross(a[1:], b[1:])
    return (
        a[0] * b[0] - _dot(a[1:], b[1:]),
        *(a[0] * b[k + 1] + a[k + 1] * b[0] + v[k] for k in range(3)),
    )


def _start_change(swing: Swing, frame: _Frame, dm, dp, dw) -> Change:
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


def _matrix(change: Change, vector: Triple) -> Triple:
    """The variation of the inverse tensor, applied."""
    a, b, c = vector
    plain = tuple(e * x for e, x in zip(change.inverse, vector, strict=True))
    if change.crossed is None:
        return plain
    h12, h13, h23 = change.crossed
    return (
        plain[0] + h12 * b + h13 * c,
        plain[1] + h12 * a + h23 * c,
        plain[2] + h13 * a + h23 * b,
    )


def _relative_turn(swing: Swing, turning: Turning, frame: _Frame, at: Moment, step: Triple):
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
    back = _cross((l2, -l1, jnp.zeros_like(l1)), v)
    vector = (
        along * l1 + height * v[0] - v0 * l2 - back[0],
        along * l2 + height * v[1] + v0 * l1 - back[1],
        along * l3 + height * v[2] - back[2],
    )
    scalar = c * tilt * tilt + height * v0 + l2 * v[0] - l1 * v[1]
    return scalar, vector


def _turn_tangent(swing, turning, frame: _Frame, at: Moment, change: Change, moved, first, t):
    """Variation of the attitude: a rotation vector along axes 1, 2, 3 at time t."""
    hand = swing.sense * swing.parity
    setting = Setting(swing.momentum, swing.p, swing.r, swing.s, swing.A, swing.B)
    j12, j13, j23 = products_of_momenta(setting, at.functions, hand)
    step = (-hand * swing.r * j23, hand * swing.s * j13, -hand * swing.p * j12)
    scalar, vector = _relative_turn(swing, turning, frame, at, step)
    gain = frame.turned(change.momentum)
    once = _cross(vector, gain)
    twice = _cross(vector, once)
    lag = tuple(
        2 * (b - scalar * a) - m for a, b, m in zip(once, twice, frame.turned(moved), strict=True)
    )
    squares = squares_of_momenta(swing, at.functions[0], at.momentum, first, t)
    start = swing.momentum
    spin = tuple(x * y for x, y in zip(start, swing.inverse, strict=True))
    energy = _dot(spin, change.momentum) + _dot(start, _matrix(change, start)) / 2
    about = t * energy + _dot(change.inverse, squares) / 2
    if change.crossed is not None:
        about = about + _dot(change.crossed, (j12, j13, j23))
    now = frame.turned(at.momentum)
    inverse = 1 / (turning.length * turning.length)
    turn = tuple((a + about * b) * inverse for a, b in zip(_cross(now, lag), now, strict=True))
    return frame.turned(turn)


def _evaluate_rule(asked, primals, tangents):
    (swing, turning), given = primals
    dm, dp, dw, dq, dt = (_tangent_or_zero(d, x) for d, x in zip(tangents[1], given, strict=True))
    t = given[-1]
    at = advance(swing, turning, t, asked[2])
    omega, wxyz = results = _results(asked, swing, turning, at)
    frame = _Frame(swing)
    resting = swing.pulse == 0
    hand = swing.sense * swing.parity
    scaled = t * swing.pulse
    change = _start_change(swing, frame, dm, dp, dw)
    first, second = second_kind(swing, at.whole, at.folded)
    by = partials(swing.B * swing.r, swing.A * swing.p, at.functions, first, second)
    moved = momentum_tangent(swing, at.functions, at.momentum, by, change)
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
            for d, x, e in zip(swing.inverse, total, _matrix(change, now), strict=True)
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
        d_wxyz = _hamilton(wxyz, (jnp.zeros_like(n1), *turn))
        if dq is not None:
            d_wxyz = _start_tangent(given[3], dq, wxyz, d_wxyz)
    return results, (d_omega, d_wxyz)


def _start_tangent(start: Quadruple, change: Quadruple, now: Quadruple, other: Quadruple):
    """Adds the answer to the initial attitude, which is normalised before use."""
    inverse = 1 / _dot(start, start)
    along = _dot(start, change)
    unit = tuple((d - along * inverse * q) * inverse for d, q in zip(change, start, strict=True))
    left = _hamilton(unit, (start[0], -start[1], -start[2], -start[3]))
    return tuple(a + b for a, b in zip(other, _hamilton(left, now), strict=True))


_evaluate.defjvp(_evaluate_rule, symbolic_zeros=True)
