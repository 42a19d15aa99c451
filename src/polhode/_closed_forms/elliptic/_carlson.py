"""Carlson's symmetric integrals by the duplication theorem, for any spread of the arguments.

Source: Carlson (1995), Numer. Algorithms 10, 13; NIST DLMF 19.16, 19.20, 19.26, 19.36.
"""

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from polhode._checks import ArrayLike
from polhode._closed_forms.elliptic._argument import as_floats, broadcast
from polhode._closed_forms.elliptic._partials import with_forward_partials

# A spread of s to s/4 costs one duplication; 1e300 between x = 0 and z takes ten more, and p larger
# than the others by a factor 4^k takes k. NaN ends the loop at once.
_MOST_STEPS = 120


def _spread(dtype) -> float:
    """Largest relative spread at which the series, and two derivatives of it, reach eps."""
    return 4e-3 if dtype == jnp.float64 else 0.05


def _series(e2: Array, e3: Array, e4: Array, e5: Array) -> Array:
    """The common factor of RD and RJ, up to degree 7: DLMF 19.36.2."""
    return (
        1
        - 3 * e2 / 14
        + e3 / 6
        + 9 * e2 * e2 / 88
        - 3 * e4 / 22
        - 9 * e2 * e3 / 52
        + 3 * e5 / 26
        - e2 * e2 * e2 / 16
        + 3 * e3 * e3 / 40
        + 3 * e2 * e4 / 20
        + 45 * e2 * e2 * e3 / 272
        - 9 * (e3 * e4 + e2 * e5) / 68
    )


@jax.custom_jvp
def _root(x: Array) -> Array:
    return jnp.sqrt(x)


@_root.defjvp
def _root_rule(primals, tangents):
    (x,), (dx,) = primals, tangents
    value = _root(x)
    # At x = 0 an argument that does not move contributes 0, not 0 * inf.
    still = (x == 0) & (dx == 0)
    return value, jnp.where(still, 0, dx / (2 * jnp.where(still, 1, value)))


def _rf_series(x: Array, y: Array, z: Array) -> Array:
    """RF of arguments within the spread: DLMF 19.36.1."""
    mean = (x + y + z) / 3
    x, y = 1 - x / mean, 1 - y / mean
    z = -(x + y)
    e2, e3 = x * y - z * z, x * y * z
    series = 1 - e2 / 10 + e3 / 14 + e2 * e2 / 24 - 3 * e2 * e3 / 44
    series = series - 5 * e2**3 / 208 + 3 * e3 * e3 / 104 + e2 * e2 * e3 / 16
    return series / jnp.sqrt(mean)


def _rf_core(x: Array, y: Array, z: Array) -> Array:
    def wide(state):
        steps, x, y, z = state
        mean = (x + y + z) / 3
        spread = jnp.maximum(jnp.maximum(jnp.abs(mean - x), jnp.abs(mean - y)), jnp.abs(mean - z))
        return (steps < _MOST_STEPS) & jnp.any(spread > _spread(x.dtype) * mean)

    def duplicate(state):
        steps, x, y, z = state
        a, b, c = _root(x), _root(y), _root(z)
        add = a * b + b * c + c * a
        return steps + 1, (x + add) / 4, (y + add) / 4, (z + add) / 4

    _, x, y, z = jax.lax.while_loop(wide, duplicate, (0, x, y, z))
    return _rf_series(x, y, z)


def rd_series(x: Array, y: Array, z: Array) -> Array:
    """RD of arguments within the spread: DLMF 19.36.2."""
    mean = (x + y + 3 * z) / 5
    x, y = 1 - x / mean, 1 - y / mean
    z = -(x + y) / 3
    xy, z2 = x * y, z * z
    e2, e3 = xy - 6 * z2, (3 * xy - 8 * z2) * z
    e4, e5 = 3 * (xy - z2) * z2, xy * z2 * z
    return _series(e2, e3, e4, e5) / (mean * jnp.sqrt(mean))


def _rd_core(x: Array, y: Array, z: Array) -> Array:
    def wide(state):
        steps, x, y, z, *_ = state
        mean = (x + y + 3 * z) / 5
        spread = jnp.maximum(jnp.maximum(jnp.abs(mean - x), jnp.abs(mean - y)), jnp.abs(mean - z))
        return (steps < _MOST_STEPS) & jnp.any(spread > _spread(x.dtype) * mean)

    def duplicate(state):
        steps, x, y, z, total, weight = state
        a, b, c = _root(x), _root(y), _root(z)
        add = a * b + b * c + c * a
        total = total + weight / (c * (z + add))
        return steps + 1, (x + add) / 4, (y + add) / 4, (z + add) / 4, total, weight / 4

    start = (0, x, y, z, jnp.zeros_like(x), jnp.ones((), x.dtype))
    _, x, y, z, total, weight = jax.lax.while_loop(wide, duplicate, start)
    return 3 * total + weight * rd_series(x, y, z)


def _rc_of_one(e: Array, one_plus_e: Array) -> Array:
    """RC(1, 1 + e), with 1 + e handed in separately."""
    near = jnp.abs(e) < (0.02 if e.dtype == jnp.float64 else 0.1)
    small = jnp.where(near, e, 0)
    terms = 9 if e.dtype == jnp.float64 else 7
    series = jnp.zeros_like(e)
    for k in reversed(range(terms)):
        series = 1 / (2 * k + 1) - small * series
    above, below = e > 0, e < 0
    root = jnp.sqrt(jnp.where(near, 1, jnp.abs(e)))
    circular = jnp.arctan(root) / root
    rest = jnp.sqrt(jnp.where(below & ~near, one_plus_e, 1))
    logarithm = jnp.log1p(root * (1 + root / (1 + rest)) / rest) / root
    return jnp.where(near, series, jnp.where(above, circular, logarithm))


def rf_rj_core(x: Array, y: Array, z: Array, p: Array) -> tuple[Array, Array]:
    """RF(x, y, z) and RJ(x, y, z, p), which share their duplications."""

    def wide(state):
        steps, x, y, z, p, *_ = state
        mean = (x + y + z + 2 * p) / 5
        spread = jnp.maximum(
            jnp.maximum(jnp.abs(mean - x), jnp.abs(mean - y)),
            jnp.maximum(jnp.abs(mean - z), jnp.abs(mean - p)),
        )
        return (steps < _MOST_STEPS) & jnp.any(spread > _spread(x.dtype) * mean)

    def duplicate(state):
        steps, x, y, z, p, total, weight = state
        a, b, c, r = _root(x), _root(y), _root(z), _root(p)
        add = a * b + b * c + c * a
        ra, rb, rc = r + a, r + b, r + c
        d = ra * rb * rc
        # Each factor (p - x)/(sqrt p + sqrt x)^2 lies in [-1, 1]: nothing overflows.
        e = ((p - x) / (ra * ra)) * ((p - y) / (rb * rb)) * ((p - z) / (rc * rc))
        one_plus_e = 2 * (r / ra) * ((p + add) / (rb * rc))
        total = total + weight / d * _rc_of_one(e, one_plus_e)
        four = ((x + add) / 4, (y + add) / 4, (z + add) / 4, (p + add) / 4)
        return steps + 1, *four, total, weight / 4

    start = (0, x, y, z, p, jnp.zeros_like(x), jnp.ones((), x.dtype))
    _, x, y, z, p, total, weight = jax.lax.while_loop(wide, duplicate, start)
    first = _rf_series(x, y, z)
    mean = (x + y + z + 2 * p) / 5
    x, y, z = 1 - x / mean, 1 - y / mean, 1 - z / mean
    p = -(x + y + z) / 2
    xyz, pair = x * y * z, x * y + x * z + y * z
    p2 = p * p
    e2 = pair - 3 * p2
    e3 = xyz + 2 * e2 * p + 4 * p2 * p
    e4 = (2 * xyz + e2 * p + 3 * p2 * p) * p
    e5 = xyz * p2
    third = 6 * total + weight * _series(e2, e3, e4, e5) / (mean * jnp.sqrt(mean))
    return first, third


def _rj_core(x: Array, y: Array, z: Array, p: Array) -> Array:
    return rf_rj_core(x, y, z, p)[1]


def rc_core(x: Array, y: Array) -> Array:
    # y < 0: Cauchy's principal value, RC(x, y) = sqrt(x/(x - y)) RC(x - y, -y), DLMF 19.2.20.
    negative = y < 0
    factor = jnp.where(negative, jnp.sqrt(x / jnp.where(negative, x - y, 1)), 1)
    x, y = jnp.where(negative, x - y, x), jnp.abs(y)
    nothing = x == 0
    safe = jnp.where(nothing, 1, x)
    value = _rc_of_one((y - x) / safe, y / safe) / jnp.sqrt(safe)
    return factor * jnp.where(nothing, 0.5 * jnp.pi / jnp.sqrt(y), value)


def _each(count: int):
    return tuple(((i, 1.0),) for i in range(count))


rd = with_forward_partials(_rd_core, _each(3))
rj = with_forward_partials(_rj_core, _each(4))
rc = with_forward_partials(rc_core, _each(2))


@jax.custom_jvp
def rf(x: Array, y: Array, z: Array) -> Array:
    """RF of arrays of one shape."""
    return _rf_core(x, y, z)


rf.defjvps(
    lambda d, value, x, y, z: -rd(y, z, x) / 6 * d,
    lambda d, value, x, y, z: -rd(z, x, y) / 6 * d,
    lambda d, value, x, y, z: -rd(x, y, z) / 6 * d,
)


def _checked(valid: Array, value: Array) -> Array:
    return jnp.where(valid, value, jnp.nan)


@jax.jit
def carlson_rf(
    x: Float[ArrayLike, "..."], y: Float[ArrayLike, "..."], z: Float[ArrayLike, "..."]
) -> Float[Array, "..."]:
    """RF(x, y, z) = 1/2 integral over t > 0 of ((t + x)(t + y)(t + z))^(-1/2): DLMF 19.16.1.

    Domain: all at least 0 and at most one of them 0, else NaN.
    """
    x, y, z = broadcast(*as_floats(x, y, z))
    valid = (x >= 0) & (y >= 0) & (z >= 0) & (x + y > 0) & (y + z > 0) & (z + x > 0)
    return _checked(valid, rf(x, y, z))


@jax.jit
def carlson_rc(x: Float[ArrayLike, "..."], y: Float[ArrayLike, "..."]) -> Float[Array, "..."]:
    """RC(x, y) = RF(x, y, y); Cauchy's principal value for y < 0: DLMF 19.2.17-20.

    Domain: x at least 0, y not 0, else NaN.
    """
    x, y = broadcast(*as_floats(x, y))
    return _checked((x >= 0) & (y != 0), rc(x, y))


@jax.jit
def carlson_rd(
    x: Float[ArrayLike, "..."], y: Float[ArrayLike, "..."], z: Float[ArrayLike, "..."]
) -> Float[Array, "..."]:
    """RD(x, y, z) = RJ(x, y, z, z): DLMF 19.16.5.

    Domain: x and y at least 0 and not both 0, z > 0, else NaN.
    """
    x, y, z = broadcast(*as_floats(x, y, z))
    return _checked((x >= 0) & (y >= 0) & (x + y > 0) & (z > 0), rd(x, y, z))


@jax.jit
def carlson_rj(
    x: Float[ArrayLike, "..."],
    y: Float[ArrayLike, "..."],
    z: Float[ArrayLike, "..."],
    p: Float[ArrayLike, "..."],
) -> Float[Array, "..."]:
    """RJ(x, y, z, p) = 3/2 integral over t > 0 of ((t + x)(t + y)(t + z))^(-1/2)/(t + p).

    Domain: x, y, z at least 0 and at most one of them 0, p > 0, else NaN. The four may differ by
    any factor: the number of duplications follows the spread (at most 120). Source: DLMF 19.16.2.
    """
    x, y, z, p = broadcast(*as_floats(x, y, z, p))
    valid = (x >= 0) & (y >= 0) & (z >= 0) & (x + y > 0) & (y + z > 0) & (z + x > 0) & (p > 0)
    return _checked(valid, rj(x, y, z, p))
