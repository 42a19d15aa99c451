"""Phase functions: the brightness of a sphere over that at opposition, by phase angle."""

import math
from functools import partial
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode.lightcurve._scattering import seeliger_sphere

Scalars = Float[Array, "*b"]


class AbstractPhase(eqx.Module):
    """A phase function; ``typical``: its coefficients where nothing is known."""

    typical: eqx.AbstractClassVar[tuple[float, ...]]

    def magnitudes(self, alpha: Scalars, coefficients: Float[Array, "*#b c"]) -> Scalars:
        """Magnitudes above opposition at phase angles ``alpha`` [rad]."""
        raise NotImplementedError


class SeeligerPhase(AbstractPhase):
    """What the law of Lommel and Seeliger gives by itself; no coefficients."""

    typical: ClassVar[tuple[float, ...]] = ()

    def magnitudes(self, alpha: Array, coefficients: Array) -> Array:
        return -2.5 * jnp.log10(seeliger_sphere(alpha))


class LinearPhase(AbstractPhase):
    """``beta alpha``, beta in magnitudes per degree; fair between about 5 and 70 degrees."""

    typical: ClassVar[tuple[float, ...]] = (0.033,)

    def magnitudes(self, alpha: Array, coefficients: Array) -> Array:
        return coefficients[..., 0] * alpha * (180 / math.pi)


class HG(AbstractPhase):
    """The H, G system of 1985; coefficient G. Bowell et al. 1989, Asteroids II, p. 524, eq. A4."""

    typical: ClassVar[tuple[float, ...]] = (0.15,)

    def magnitudes(self, alpha: Array, coefficients: Array) -> Array:
        slope = coefficients[..., 0]
        first, second = (_bowell(alpha, *k) for k in _BOWELL)
        return -2.5 * jnp.log10((1 - slope) * first + slope * second)


class HG1G2(AbstractPhase):
    """The H, G1, G2 system; coefficients G1, G2. Muinonen et al. 2010, Icarus 209, 542.

    Beyond 150 degrees, where the system is not defined, its splines are continued as a decreasing
    exponential with their last value and derivative.
    """

    typical: ClassVar[tuple[float, ...]] = (0.26, 0.38)

    def magnitudes(self, alpha: Array, coefficients: Array) -> Array:
        first, second = coefficients[..., 0], coefficients[..., 1]
        a, b, c = hg1g2_basis(alpha)
        return -2.5 * jnp.log10(first * a + second * b + (1 - first - second) * c)


_BOWELL = ((3.332, 0.631, 0.986), (1.862, 1.218, 0.238))


@partial(jax.jit, static_argnums=(1, 2, 3))  # one program, not one for each operation
def _bowell(alpha, a, b, c):
    sine, tangent = jnp.sin(alpha), jnp.tan(alpha / 2)
    far = jnp.exp(-a * jnp.where(tangent > 0, tangent, 1) ** b)
    far = jnp.where(tangent > 0, far, 1)
    near = 1 - c * sine / (0.119 + 1.341 * sine - 0.754 * sine * sine)
    weight = jnp.exp(-90.56 * tangent * tangent)
    return weight * near + (1 - weight) * far


# Values and slopes (per radian) at the knots: Muinonen et al. 2010, tables 3 and 4; the slopes are
# those of the cubic splines with the printed end slopes (Penttila et al. 2016, PSS 123, 117).
_KNOTS = np.radians([7.5, 30.0, 60.0, 90.0, 120.0, 150.0])
_FIRST = (
    (0.75, 0.33486016, 0.13410560, 0.051104756, 0.021465687, 0.0036396989),
    (-1.9098593, -0.55463432, -0.24404599, -0.094980438, -0.021411424, -0.091328612),
)
_SECOND = (
    (0.925, 0.62884169, 0.31755495, 0.12716367, 0.022373903, 0.00016505689),
    (-0.57295780, -0.76705367, -0.45665789, -0.28071809, -0.11173257, -8.6573138e-8),
)
_NEAR = np.radians([0.0, 0.3, 1.0, 2.0, 4.0, 8.0, 12.0, 20.0, 30.0])
_THIRD = (
    (1.0, 0.83381185, 0.57735424, 0.42144772, 0.23174230, 0.10348178, 0.061733473, 0.016107006,
     0.0),
    (-0.10630097, -41.180439, -10.366915, -7.5784615, -3.6960950, -0.78605652, -0.46527012,
     -0.20459545, 0.0),
)  # fmt: skip


def _spline(knots, table, alpha):
    """The cubic of given values and slopes at its ends, between the knots."""
    dtype = alpha.dtype
    knots, values, slopes = (jnp.asarray(x, dtype) for x in (knots, *table))
    k = jnp.clip(jnp.searchsorted(knots, alpha, side="right") - 1, 0, knots.size - 2)
    width = knots[k + 1] - knots[k]
    t = jnp.clip((alpha - knots[k]) / width, 0, 1)
    rise = values[k + 1] - values[k]
    left, right = slopes[k] * width - rise, rise - slopes[k + 1] * width
    return values[k] + t * rise + t * (1 - t) * ((1 - t) * left + t * right)


@jax.jit
def hg1g2_basis(alpha: Scalars) -> tuple[Scalars, Scalars, Scalars]:
    """The three functions of the H, G1, G2 system at ``alpha`` [rad]."""
    out = []
    for table, slope in ((_FIRST, -6 / math.pi), (_SECOND, -9 / (5 * math.pi))):
        value = _spline(_KNOTS, table, alpha)
        last = table[0][-1]
        tail = last * jnp.exp(jnp.minimum(table[1][-1] / last * (alpha - _KNOTS[-1]), 0))
        value = jnp.where(alpha > _KNOTS[-1], tail, value)
        out.append(jnp.where(alpha < _KNOTS[0], 1 + slope * alpha, value))
    third = jnp.where(alpha < _NEAR[-1], _spline(_NEAR, _THIRD, alpha), 0)
    return out[0], out[1], third
