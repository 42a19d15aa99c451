"""Position on a Kepler orbit, for the gravity gradient."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode._checks import as_number, is_concrete, require


def eccentric_anomaly(mean: Float[Array, "*b"], eccentricity: Float[Array, "*b"]) -> Array:
    """E in [-pi, pi] with E - e sin E = M [rad] for 0 <= e < 1, M within [-pi, pi].

    Newton's method from an upper bound of the root, whence it descends monotonically; the last two
    steps carry the derivatives.
    """
    sign = jnp.where(mean < 0, -1, 1).astype(mean.dtype)
    m, e = jax.lax.stop_gradient((jnp.abs(mean), eccentricity))
    # sin E <= 1; sin E <= E; and E - sin E >= 0.506 E^3/6 up to pi, where e < 1 only lowers E
    bounds = jnp.minimum(m + e, m / (1 - e))
    root = jnp.minimum(bounds, jnp.cbrt(m * (6 / 0.506)))

    def step(x, m, e):
        half = jnp.sin(x / 2)
        return x - ((1 - e) * x + e * _lag(x) - m) / (1 - e + 2 * e * half * half)

    root = jax.lax.fori_loop(0, 8, lambda _, x: step(x, m, e), root)
    root = jax.lax.stop_gradient(root)
    for _ in range(2):
        root = step(root, sign * mean, eccentricity)
    return sign * root


def _lag(x: Array) -> Array:
    """x - sin x, without cancellation at small x."""
    square = x * x
    total = jnp.ones_like(x)
    for k in range(8, 0, -1):  # below 1/2 the last term is under 1e-20
        total = 1 - square * total / ((2 * k + 2) * (2 * k + 3))
    return jnp.where(square < 0.25, x * square / 6 * total, x - jnp.sin(x))


class KeplerOrbit(eqx.Module):
    """Position of a body on an ellipse about an attracting centre: ``orbit(t)`` (..., 3) [m].

    **Arguments** (each (...), a batch broadcasts): ``mu`` [m^3/s^2]; ``semi_major_axis`` [m];
    ``eccentricity`` in [0, 1); ``inclination``, ``node`` (longitude of the ascending node),
    ``periapsis`` (its argument), ``mean_anomaly`` at the time ``epoch`` [rad, s]. Space axes: z is
    the pole that the inclination is counted from, x the direction that the node is counted from.

    Hand it to ``ph.GravityGradient(mu, orbit)``. Raises ValueError for mu or an axis that is not
    positive, or an eccentricity outside [0, 1).
    """

    mu: Float[Array, "*#b"]
    semi_major_axis: Float[Array, "*#b"]
    eccentricity: Float[Array, "*#b"]
    inclination: Float[Array, "*#b"]
    node: Float[Array, "*#b"]
    periapsis: Float[Array, "*#b"]
    mean_anomaly: Float[Array, "*#b"]
    epoch: Float[Array, "*#b"]

    core_ranks = dict.fromkeys(
        (
            "mu", "semi_major_axis", "eccentricity", "inclination", "node", "periapsis",
            "mean_anomaly", "epoch",
        ),
        0,
    )  # fmt: skip

    def __init__(
        self,
        mu,
        semi_major_axis,
        eccentricity=0.0,
        inclination=0.0,
        node=0.0,
        periapsis=0.0,
        mean_anomaly=0.0,
        epoch=0.0,
    ):
        given = locals()
        numbers = {name: as_number(name, given[name]) for name in self.core_ranks}
        dtype = jnp.result_type(*(x for x in numbers.values()))
        for name, value in numbers.items():
            setattr(self, name, value.astype(dtype))
        for name in ("mu", "semi_major_axis"):
            value = getattr(self, name)
            if is_concrete(value):
                require(np.asarray(value) > 0, f"{name} must be positive, got {given[name]}.")
        if is_concrete(self.eccentricity):
            given = np.asarray(self.eccentricity)
            require(
                (given >= 0) & (given < 1),
                f"eccentricity must lie in [0, 1), got {eccentricity}: other conics are not"
                " supported; hand GravityGradient any function of time instead.",
            )

    @property
    def mean_motion(self) -> Array:
        """sqrt(mu/a^3) [rad/s]."""
        return jnp.sqrt(self.mu / self.semi_major_axis) / self.semi_major_axis

    def __call__(self, t: Array | float) -> Float[Array, "*b 3"]:
        mean = self.mean_anomaly + self.mean_motion * (t - self.epoch)
        mean = mean - 2 * jnp.pi * jnp.round(mean / (2 * jnp.pi))
        e = self.eccentricity
        anomaly = eccentric_anomaly(*jnp.broadcast_arrays(mean, e))
        along = self.semi_major_axis * (jnp.cos(anomaly) - e)
        across = self.semi_major_axis * jnp.sqrt(1 - e * e) * jnp.sin(anomaly)
        cw, sw = jnp.cos(self.periapsis), jnp.sin(self.periapsis)
        u, v = cw * along - sw * across, sw * along + cw * across
        cn, sn = jnp.cos(self.node), jnp.sin(self.node)
        ci, si = jnp.cos(self.inclination), jnp.sin(self.inclination)
        place = (cn * u - sn * ci * v, sn * u + cn * ci * v, si * v)
        return jnp.stack(jnp.broadcast_arrays(*place), axis=-1)
