"""The two frequencies of the free motion to half a significand more than the dtype holds.

Over a long horizon the error of the exact motion is that of its phases, one unit in the last place
of the frequencies times the time. Here both are worked out in unevaluated sums of two floats, from
the arithmetic-geometric mean: with circled axis 3, p = |1/I1 - 1/I2|, r = |1/I2 - 1/I3|, s = p + r,
the momentum's half period is 2 K(m) / omega_p, and the mean rate of the Euler angle about L is
|L| (1/I3 +- s Pi(-p/r, m) / K(m)), (13) of docs/free_motion.md. Pi/K by DLMF 19.8.6.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode._closed_forms.free._exact import (
    Pair,
    add_pairs,
    divide_pairs,
    multiply_pairs,
    product_of,
    root_of,
    scale_pair,
    subtract_pairs,
    sum_of,
)
from polhode._closed_forms.free._motion import Swing, Turning
from polhode._closed_forms.free._roles import Roles
from polhode._kernels import staged

Scalars = Float[Array, "*b"]

# Enough for 1 - m down to 1e-20 and moments that differ by a millionth: then one more bit each.
_STEPS = 8
_INVERSE_PI = {
    4: (0.31830987334251404, 1.2841276633452237e-08),
    8: (0.3183098861837907, -1.9678676675182486e-17),
}


def _pick(condition, x: Pair, y: Pair) -> Pair:
    return Pair(*(jnp.where(condition, a, b) for a, b in zip(x, y, strict=True)))


def _positive(x: Pair) -> Pair:
    sign = jnp.where(x.high < 0, -1, 1).astype(x.high.dtype)
    return Pair(sign * x.high, sign * x.low)


def _half(x: Pair) -> Pair:
    return Pair(x.high / 2, x.low / 2)


def _means(complement: Pair, pole: Pair) -> tuple[Pair, Pair, Scalars]:
    """agm(1, complement), the sum of Q (DLMF 19.8.6; ``pole``: root of 1 - n), the last step."""
    one = Pair(jnp.ones_like(pole.high), jnp.zeros_like(pole.high))

    def step(_, state):
        a, b, p, weight, total = state
        product, square = multiply_pairs(a, b), multiply_pairs(p, p)
        both = add_pairs(square, product)
        weight = _half(multiply_pairs(weight, divide_pairs(subtract_pairs(square, product), both)))
        p = _half(divide_pairs(both, p))
        return _half(add_pairs(a, b)), root_of(product), p, weight, add_pairs(total, weight)

    # A loop and not an unrolled formula: it compiles in a tenth of the time.
    a, b, _, weight, total = jax.lax.fori_loop(0, _STEPS, step, (one, complement, pole, one, one))
    return a, total, jnp.abs(weight.high) + jnp.abs(subtract_pairs(a, b).high)


def frequencies(roles: Roles) -> tuple[Pair, Pair, Scalars]:
    """Paces of ``Swing`` and ``Turning`` per scaled time, and the size of the last step.

    Of the two characteristics -p/r and that of DLMF 19.7.9 the one near zero is taken: with the
    latter Pi stands for the angle counted with the momentum's own turns in the body.
    """
    i1, i2, i3 = roles.moments
    d12, d23, d13 = (_positive(sum_of(a, -b)) for a, b in ((i2, i1), (i3, i2), (i3, i1)))
    x1, x2, x3 = (
        scale_pair(product_of(w, w), i) for w, i in zip(roles.rates, roles.moments, strict=True)
    )
    above = add_pairs(multiply_pairs(x2, d12), multiply_pairs(x3, d13))
    below = add_pairs(multiply_pairs(x1, d13), multiply_pairs(x2, d23))
    gap = _positive(subtract_pairs(multiply_pairs(x3, d23), multiply_pairs(x1, d12)))
    square = multiply_pairs(above, d23)
    length2 = add_pairs(add_pairs(scale_pair(x1, i1), scale_pair(x2, i2)), scale_pair(x3, i3))
    length = root_of(length2)
    complement = root_of(divide_pairs(multiply_pairs(d13, gap), square))
    near = divide_pairs(scale_pair(d13, i2), scale_pair(d23, i1))
    far = divide_pairs(multiply_pairs(length2, d13), scale_pair(above, i3))
    first = near.high < far.high
    pole = root_of(_pick(first, near, far))
    mean, total, left = _means(complement, pole)
    inverse_pi = Pair(*(jnp.full_like(i1, x) for x in _INVERSE_PI[i1.dtype.itemsize]))
    volume = scale_pair(product_of(i1, i2), i3)
    pace = multiply_pairs(multiply_pairs(root_of(divide_pairs(square, volume)), mean), inverse_pi)
    # |L|/I1 (1 -+ (I2 - I1) total / (2 I2)) less a turn per period, or |L|/I3 +- A total / (2 |L|).
    parts = _pick(first, multiply_pairs(length, d12), divide_pairs(below, length))
    share = multiply_pairs(_half(parts), total)
    span = scale_pair(_pick(first, product_of(i1, i2), Pair(i3, jnp.zeros_like(i3))), roles.sense)
    share = divide_pairs(share, span)
    whole = divide_pairs(length, Pair(jnp.where(first, i1, i3), jnp.zeros_like(i1)))
    share = Pair(jnp.where(first, -share.high, share.high), jnp.where(first, -share.low, share.low))
    angle = _half(multiply_pairs(add_pairs(whole, share), inverse_pi))
    turn = scale_pair(_half(pace), jnp.where(first, -roles.sense, 0))
    return pace, add_pairs(angle, turn), left


def compensate(swing: Swing, turning: Turning | None, roles: Roles) -> tuple[Swing, Turning | None]:
    """Both motions with low parts of their paces, where the means have converged."""
    # Staged: the two parts of a pair must come out of one and the same sum.
    pace, angle, left = staged(frequencies(roles), roles.one)
    # Convergence is quadratic: what is left is the square of the last step.
    sound = (left < jnp.finfo(left.dtype).eps / 64) & ~swing.endless
    high, low = _beside(swing.pace, pace, sound, roles.pulse)
    swing = swing._replace(pace=high, pace_low=low)
    if turning is not None:
        high, low = _beside(turning.pace, angle, sound, roles.pulse)
        turning = turning._replace(pace=high, pace_low=low)
    return swing, turning


def _beside(plain: Scalars, found: Pair, sound, pulse: Scalars) -> tuple[Scalars, Scalars]:
    """The pair that replaces a plain pace, unless it is NaN or disagrees with it."""
    high, low = found.high * pulse, found.low * pulse
    near = {4: 2.0**-13, 8: 2.0**-30}[plain.dtype.itemsize]
    sound = sound & (jnp.abs(high - plain) <= near * jnp.abs(plain))
    return jnp.where(sound, high, plain), jnp.where(sound, low, 0)
