"""Complete elliptic integrals of the first and second kind, and the associates B and D."""

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from polhode._checks import ArrayLike
from polhode._closed_forms.elliptic._argument import as_floats, parameter_pair
from polhode._closed_forms.elliptic._nome import HALF_PI, Nome, nome, period_parts

# (2 theta4''(q) / 16 - theta4(q) theta2(q)^4 / 16) / q^2, highest power first.
_S_NUMERATOR = (-40, 32, -28, 28, -16, 16, -16, 12, -8, 4, -4, 2)


def _smaller_first_kind(parameter: Nome) -> Array:
    return HALF_PI * (1 + parameter.excess)


@jax.custom_jvp
def first_kind(m: Array, m1: Array) -> Array:
    """K for a pair already made by `parameter_pair`."""
    p = nome(m, m1)
    logarithmic = jnp.where(p.q > 0, 0.5 * period_parts(p)[0], jnp.inf)
    # The inequality also lets NaN through: it is False on both sides.
    value = jnp.where(p.circular, _smaller_first_kind(p), logarithmic)
    return jnp.where(jnp.isnan(m), jnp.nan, value)


@first_kind.defjvp
def _first_kind_rule(primals, tangents):
    m, m1 = primals
    return first_kind(m, m1), associate_b_of(m, m1) / (2 * m1) * tangents[0]


@jax.custom_jvp
def second_kind(m: Array, m1: Array) -> Array:
    """E for a pair already made by `parameter_pair`."""
    p = nome(m, m1)
    smaller = _smaller_first_kind(p)
    deficit = p.x * p.deficit_per_x
    # m > 1/2: Legendre's relation E = (pi/2) / K' + K (1 - E'/K'), all terms positive.
    legendre = HALF_PI / smaller + 0.5 * period_parts(p)[0] * deficit
    return jnp.where(p.circular, smaller * (1 - deficit), legendre)


@second_kind.defjvp
def _second_kind_rule(primals, tangents):
    m, m1 = primals
    return second_kind(m, m1), -0.5 * associate_d_of(m, m1) * tangents[0]


@jax.custom_jvp
def associate_d_of(m: Array, m1: Array) -> Array:
    """D = (K - E) / m for a pair already made by `parameter_pair`."""
    p = nome(m, m1)
    series = _smaller_first_kind(p) * p.deficit_per_x
    larger = jnp.where(p.circular, 1, m)
    return jnp.where(p.circular, series, (first_kind(m, m1) - second_kind(m, m1)) / larger)


@associate_d_of.defjvp
def _associate_d_rule(primals, tangents):
    m, m1 = primals
    value = associate_d_of(m, m1)
    return value, (value - associate_s(m, m1)) / (2 * m1) * tangents[0]


@jax.custom_jvp
def associate_b_of(m: Array, m1: Array) -> Array:
    """B = (E - m1 K) / m = K - D for a pair already made by `parameter_pair`."""
    p = nome(m, m1)
    series = _smaller_first_kind(p) * (1 - p.deficit_per_x)
    larger = jnp.where(p.circular, 1, m)
    return jnp.where(
        p.circular, series, (second_kind(m, m1) - m1 * 0.5 * period_parts(p)[0]) / larger
    )


@associate_b_of.defjvp
def _associate_b_rule(primals, tangents):
    m, m1 = primals
    return associate_b_of(m, m1), 0.5 * associate_s(m, m1) * tangents[0]


def associate_s(m: Array, m1: Array) -> Array:
    """S = (D - B) / m, without cancellation at m = 0."""
    p = nome(m, m1)
    q = p.q
    # 2 D/K - 1 = (2 theta4'' - theta4 theta2^4) / (theta4 theta2^4): the numerator is expanded.
    power = p.theta2**4
    numerator = jnp.polyval(jnp.asarray(_S_NUMERATOR, q.dtype), q, unroll=16)
    series = _smaller_first_kind(p) * p.per_x * numerator / (p.theta4 * power)
    larger = jnp.where(p.circular, 1, m)
    return jnp.where(p.circular, series, (associate_d_of(m, m1) - associate_b_of(m, m1)) / larger)


@jax.jit
def ellipk(
    m: Float[ArrayLike, "..."], *, m1: Float[ArrayLike, "..."] | None = None
) -> Float[Array, "..."]:
    """Complete elliptic integral of the first kind, K(m) = integral of 1/sqrt(1 - m sin^2).

    `m` in [0, 1] is the parameter (the square of the modulus); `m1` = 1 - m may be handed in
    beside it when m is close to 1 (below 16 times the smallest normal number it counts as 0).
    K(1) is inf, an m outside [0, 1] gives NaN.
    Source: DLMF 19.8, 22.2 (theta constants of the nome).
    """
    return first_kind(*_pair(m, m1))


@jax.jit
def ellipe(
    m: Float[ArrayLike, "..."], *, m1: Float[ArrayLike, "..."] | None = None
) -> Float[Array, "..."]:
    """Complete elliptic integral of the second kind, E(m) = integral of sqrt(1 - m sin^2).

    Arguments and domain as in `ellipk`. Source: DLMF 19.7.1 (Legendre's relation).
    """
    return second_kind(*_pair(m, m1))


@jax.jit
def associate_b(
    m: Float[ArrayLike, "..."], *, m1: Float[ArrayLike, "..."] | None = None
) -> Float[Array, "..."]:
    """Associate complete integral B(m) = integral of cos^2/sqrt(1 - m sin^2) = K - D.

    Free of the cancellation in (E - (1 - m) K) / m. Arguments and domain as in `ellipk`.
    Source: Fukushima (2011), J. Comput. Appl. Math. 235, 4140.
    """
    return associate_b_of(*_pair(m, m1))


@jax.jit
def associate_d(
    m: Float[ArrayLike, "..."], *, m1: Float[ArrayLike, "..."] | None = None
) -> Float[Array, "..."]:
    """Associate complete integral D(m) = integral of sin^2/sqrt(1 - m sin^2) = (K - E)/m.

    Free of the cancellation in (K - E) / m; D(1) is inf. Arguments and domain as in `ellipk`.
    Source: Fukushima (2011), J. Comput. Appl. Math. 235, 4140.
    """
    return associate_d_of(*_pair(m, m1))


def _pair(m: ArrayLike, m1: ArrayLike | None) -> tuple[Array, Array]:
    if m1 is None:
        (m,) = as_floats(m)
        return parameter_pair(m, None)
    m, m1 = as_floats(m, m1)
    return parameter_pair(m, m1)
