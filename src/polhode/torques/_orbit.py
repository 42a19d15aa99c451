"""Position on a Kepler orbit, for the gravity gradient."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode._checks import as_float_array, as_number, describe, is_concrete, require
from polhode.parts import AbstractPart, shaped


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


class KeplerOrbit(AbstractPart):
    """Position of a body on an ellipse about an attracting centre: ``orbit(t)`` (..., 3) [m].

    **Arguments** (each (...), a batch broadcasts): ``mu`` [m^3/s^2]; ``semi_major_axis`` [m];
    ``eccentricity`` in [0, 1); ``inclination``, ``node`` (longitude of the ascending node),
    ``periapsis`` (its argument), ``mean_anomaly`` at the time ``epoch`` [rad, s]. Space axes: z is
    the pole that the inclination is counted from, x the direction that the node is counted from.

    Hand it to ``ph.GravityGradient(mu, orbit)``; ``ph.StateOrbit`` takes place and velocity instead
    of elements. Raises ValueError for mu or an axis that is not positive, or an eccentricity
    outside [0, 1).
    """

    mu: Float[Array, "*#b"] = shaped()
    semi_major_axis: Float[Array, "*#b"] = shaped()
    eccentricity: Float[Array, "*#b"] = shaped()
    inclination: Float[Array, "*#b"] = shaped()
    node: Float[Array, "*#b"] = shaped()
    periapsis: Float[Array, "*#b"] = shaped()
    mean_anomaly: Float[Array, "*#b"] = shaped()
    epoch: Float[Array, "*#b"] = shaped()

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


class StateOrbit(AbstractPart):
    """Position on the ellipse through a given place and velocity: ``orbit(t)`` (..., 3) [m].

    **Arguments** (a batch broadcasts): ``mu`` (...) [m^3/s^2]; ``position`` (..., 3) [m] from the
    attracting centre and ``velocity`` (..., 3) [m/s] at the time ``epoch`` (...) [s], both in
    space axes. Derivatives are regular everywhere, also for circular and equatorial orbits, whose
    elements (``KeplerOrbit``) are not.

    Lagrange's f and g functions of the difference in eccentric anomaly (R. H. Battin, An
    Introduction to the Mathematics and Methods of Astrodynamics, 1999).

    Hand it to ``ph.GravityGradient(mu, orbit)``. Raises ValueError for mu that is not positive, or
    a state that is not on an ellipse: too fast to be bound, or moving straight to or from the
    centre.
    """

    mu: Float[Array, "*#b"] = shaped()
    position: Float[Array, "*#b 3"] = shaped(3)
    velocity: Float[Array, "*#b 3"] = shaped(3)
    epoch: Float[Array, "*#b"] = shaped()

    def __init__(self, mu, position, velocity, epoch=0.0):
        given = {
            "mu": as_number("mu", mu),
            "position": as_float_array("position", position, (3,)),
            "velocity": as_float_array("velocity", velocity, (3,)),
            "epoch": as_number("epoch", epoch),
        }
        dtype = jnp.result_type(*given.values())
        for name, value in given.items():
            setattr(self, name, value.astype(dtype))
        if is_concrete(self.mu):
            require(np.asarray(self.mu) > 0, f"mu must be positive, got {mu}.")
        if is_concrete(self.mu, self.position, self.velocity):
            place, speed = np.asarray(self.position), np.asarray(self.velocity)
            distance = np.linalg.norm(place, axis=-1)
            excess = distance * np.sum(speed * speed, axis=-1) / np.asarray(self.mu)
            require(
                (distance > 0) & (excess < 2),
                f"position and velocity must lie on an ellipse, |v|^2 |r|/mu below 2, got"
                f" {describe(excess)}: check the units, or hand GravityGradient any function of"
                " time instead.",
            )
            moment = np.linalg.norm(np.cross(place, speed), axis=-1)
            require(
                moment
                > 1e-6 * distance * np.sqrt(np.asarray(self.mu) / np.maximum(distance, 1e-300)),
                "the velocity must not point straight to or from the attracting centre, got"
                f" {describe(speed)} at {describe(place)}.",
            )

    def __call__(self, t: Array | float) -> Float[Array, "*b 3"]:
        r0 = jnp.linalg.norm(self.position, axis=-1)
        bound = 2 - r0 * jnp.sum(self.velocity * self.velocity, axis=-1) / self.mu
        axis = r0 / bound
        n = jnp.sqrt(self.mu / axis) / axis  # mean motion
        # e cos E and e sin E at the epoch
        a = 1 - bound
        b = jnp.sum(self.position * self.velocity, axis=-1) / jnp.sqrt(self.mu * axis)
        mean = n * (t - self.epoch)
        mean = mean - 2 * jnp.pi * jnp.round(mean / (2 * jnp.pi))
        x = _anomaly_since(*jnp.broadcast_arrays(mean, a, b))
        half, sine = jnp.sin(x / 2), jnp.sin(x)
        turn = 2 * half * half  # 1 - cos x
        f = 1 - turn / bound
        g = (bound * sine + b * turn) / n
        return f[..., None] * self.position + g[..., None] * self.velocity


def _anomaly_since(mean: Array, a: Array, b: Array) -> Array:
    """x with x - a sin x + b (1 - cos x) = mean, where a = e cos E0 and b = e sin E0."""

    m, p, q = jax.lax.stop_gradient((mean, a, b))
    at_epoch = jnp.arctan2(q, p)
    total = at_epoch - q + m
    total = total - 2 * jnp.pi * jnp.round(total / (2 * jnp.pi))
    x = eccentric_anomaly(total, jnp.sqrt(p * p + q * q)) - at_epoch
    x = jax.lax.stop_gradient(x - 2 * jnp.pi * jnp.round((x - m) / (2 * jnp.pi)))
    for _ in range(2):  # these carry the derivatives
        half, sine = jnp.sin(x / 2), jnp.sin(x)
        turn = 2 * half * half
        x = x - (x - a * sine + b * turn - mean) / (1 - a * (1 - turn) + b * sine)
    return x
