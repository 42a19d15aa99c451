"""Position and velocity on a Kepler orbit: gravity gradients and orbit frames follow it."""

import abc
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode._checks import (
    as_float_array,
    as_number,
    describe,
    is_concrete,
    require,
    require_positive,
)
from polhode._parts import AbstractPart, shaped


@jax.jit
def eccentric_anomaly(mean: Float[Array, "*b"], eccentricity: Float[Array, "*b"]) -> Array:
    """E in [-pi, pi] with E - e sin E = M [rad] for 0 <= e < 1, M within [-pi, pi]."""

    def above(m, e):
        # sin E <= 1; sin E <= E; and E - sin E >= 0.506 E^3/6 up to pi, where e < 1 only lowers E
        bounds = jnp.minimum(m + e, m / (1 - e))
        return jnp.minimum(bounds, jnp.cbrt(m * (6 / 0.506)))

    def step(x, m, e):
        half = jnp.sin(x / 2)
        return x - ((1 - e) * x + e * _lag(x) - m) / (1 - e + 2 * e * half * half)

    return _newton(step, above, mean, eccentricity)


@jax.jit
def hyperbolic_anomaly(mean: Float[Array, "*b"], eccentricity: Float[Array, "*b"]) -> Array:
    """F with e sinh F - F = M [rad] for e > 1."""

    def above(m, e):
        # sinh F >= F, sinh F - F >= F^3/6, and e sinh F = M + F with what bounds F
        most = jnp.minimum(m / (e - 1), jnp.cbrt(6 * m / e))
        return jnp.minimum(most, jnp.arcsinh((m + most) / e))

    def step(x, m, e):
        half = jnp.sinh(x / 2)
        return x - ((e - 1) * x + e * _lead(x) - m) / (e - 1 + 2 * e * half * half)

    return _newton(step, above, mean, eccentricity)


def _newton(step: Callable, above: Callable, mean: Array, eccentricity: Array) -> Array:
    """The root, which has the sign of ``mean``: by Newton's method from ``above`` it.

    From there it descends monotonically; the last two steps carry the derivatives.
    """
    sign = jnp.where(mean < 0, -1, 1).astype(mean.dtype)
    m, e = jax.lax.stop_gradient((jnp.abs(mean), eccentricity))
    root = jax.lax.fori_loop(0, 8, lambda _, x: step(x, m, e), above(m, e))
    root = jax.lax.stop_gradient(root)
    for _ in range(2):
        root = step(root, sign * mean, eccentricity)
    return sign * root


def _lag(x: Array) -> Array:
    """x - sin x, without cancellation at small x."""
    square = x * x
    return jnp.where(square < 0.25, x * square / 6 * _series(-square), x - jnp.sin(x))


def _lead(x: Array) -> Array:
    """sinh x - x, without cancellation at small x."""
    square = x * x
    return jnp.where(square < 1, x * square / 6 * _series(square), jnp.sinh(x) - x)


def _series(square: Array) -> Array:
    """6 (sinh x - x)/x^3 of x^2 up to 1: what is left out is under 1e-18."""
    total = jnp.ones_like(square)
    for k in range(8, 0, -1):
        total = 1 + square * total / ((2 * k + 2) * (2 * k + 3))
    return total


class AbstractOrbit(AbstractPart):
    """Base of the orbits: position ``orbit(t)`` and ``velocity_at(t)`` of a body about a centre."""

    @abc.abstractmethod
    def __call__(self, t: Array | float) -> Float[Array, "*b 3"]:
        """Position (..., 3) from the attracting centre, space axes [m], at the time t [s]."""

    def velocity_at(self, t: Array | float) -> Float[Array, "*b 3"]:
        """Velocity (..., 3) in space axes [m/s] at the time t [s]."""
        t = jnp.asarray(t, jnp.result_type(*jax.tree.leaves(self)))
        return jax.jvp(self, (t,), (jnp.ones_like(t),))[1]


@jax.jit  # one program, not one for each operation
def _place(conic: "AbstractConic", t: Array) -> Array:
    return conic._position(t)


class AbstractConic(AbstractOrbit):
    """Base of the orbits that keep their plane."""

    def __call__(self, t: Array | float) -> Float[Array, "*b 3"]:
        return _place(self, t)

    @abc.abstractmethod
    def _position(self, t: Array) -> Float[Array, "*b 3"]:
        """Position, as of every orbit."""

    @property
    @abc.abstractmethod
    def momentum(self) -> Float[Array, "*b 3"]:
        """Angular momentum r x v (..., 3) for a unit of mass, space axes [m^2/s]; constant."""


class KeplerOrbit(AbstractConic):
    """Position of a body on a conic about an attracting centre: ``orbit(t)`` (..., 3) [m].

    **Arguments** (each (...), a batch broadcasts): ``mu`` [m^3/s^2]; ``semi_major_axis`` [m], of a
    hyperbola negative; ``eccentricity``, in [0, 1) or of a hyperbola above 1; ``inclination``,
    ``node`` (longitude of the ascending node), ``periapsis`` (its argument), ``mean_anomaly`` at
    the time ``epoch`` [rad, s], counted from periapsis. Space axes: z is the pole that the
    inclination is counted from, x the direction that the node is counted from. All orbits of a
    batch are of one kind; ``hyperbolic`` (static) tells which where the numbers are traced.

    Hand it to ``ph.GravityGradient(mu, orbit)``; ``ph.StateOrbit`` takes place and velocity instead
    of elements. Raises ValueError for mu that is not positive, an axis of the wrong sign, or an
    eccentricity that is negative or 1.
    """

    mu: Float[Array, "*#b"] = shaped()
    semi_major_axis: Float[Array, "*#b"] = shaped()
    eccentricity: Float[Array, "*#b"] = shaped()
    inclination: Float[Array, "*#b"] = shaped()
    node: Float[Array, "*#b"] = shaped()
    periapsis: Float[Array, "*#b"] = shaped()
    mean_anomaly: Float[Array, "*#b"] = shaped()
    epoch: Float[Array, "*#b"] = shaped()
    hyperbolic: bool = eqx.field(static=True, default=False)

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
        hyperbolic=None,
    ):
        given = locals()
        numbers = {name: as_number(name, given[name]) for name in self.core_ranks}
        dtype = jnp.result_type(*(x for x in numbers.values()))
        for name, value in numbers.items():
            setattr(self, name, value.astype(dtype))
        require_positive("mu", self.mu)
        if is_concrete(self.eccentricity):
            e = np.asarray(self.eccentricity)
            if hyperbolic is None:
                hyperbolic = bool(np.all(e > 1))
            require(
                e > 1 if hyperbolic else (e >= 0) & (e < 1),
                lambda: (
                    "eccentricity must lie in [0, 1), or for a batch of hyperbolas above 1, got"
                    f" {eccentricity}."
                ),
            )
        self.hyperbolic = bool(hyperbolic)
        if is_concrete(self.semi_major_axis):
            axis = np.asarray(self.semi_major_axis)
            require(
                axis < 0 if self.hyperbolic else axis > 0,
                lambda: (
                    "semi_major_axis must be positive, of a hyperbola (eccentricity above 1)"
                    f" negative, got {semi_major_axis}."
                ),
            )

    @property
    def mean_motion(self) -> Array:
        """sqrt(mu/|a|^3) [rad/s]."""
        axis = jnp.abs(self.semi_major_axis)
        return jnp.sqrt(self.mu / axis) / axis

    @property
    def momentum(self) -> Float[Array, "*b 3"]:
        parameter = self.semi_major_axis * (1 - self.eccentricity) * (1 + self.eccentricity)
        cn, sn = jnp.cos(self.node), jnp.sin(self.node)
        ci, si = jnp.cos(self.inclination), jnp.sin(self.inclination)
        size = jnp.sqrt(self.mu * parameter)
        pole = jnp.broadcast_arrays(sn * si * size, -cn * si * size, ci * size)
        return jnp.stack(pole, axis=-1)

    def _position(self, t: Array) -> Float[Array, "*b 3"]:
        mean = self.mean_anomaly + self.mean_motion * (t - self.epoch)
        e = self.eccentricity
        if self.hyperbolic:
            anomaly = hyperbolic_anomaly(*jnp.broadcast_arrays(mean, e))
            along = self.semi_major_axis * (jnp.cosh(anomaly) - e)
            across = -self.semi_major_axis * jnp.sqrt(e * e - 1) * jnp.sinh(anomaly)
        else:
            mean = mean - 2 * jnp.pi * jnp.round(mean / (2 * jnp.pi))
            anomaly = eccentric_anomaly(*jnp.broadcast_arrays(mean, e))
            along = self.semi_major_axis * (jnp.cos(anomaly) - e)
            across = self.semi_major_axis * jnp.sqrt(1 - e * e) * jnp.sin(anomaly)
        cw, sw = jnp.cos(self.periapsis), jnp.sin(self.periapsis)
        u, v = cw * along - sw * across, sw * along + cw * across
        cn, sn = jnp.cos(self.node), jnp.sin(self.node)
        ci, si = jnp.cos(self.inclination), jnp.sin(self.inclination)
        place = (cn * u - sn * ci * v, sn * u + cn * ci * v, si * v)
        return jnp.stack(jnp.broadcast_arrays(*place), axis=-1)


class StateOrbit(AbstractConic):
    """Position on the conic through a given place and velocity: ``orbit(t)`` (..., 3) [m].

    **Arguments** (a batch broadcasts): ``mu`` (...) [m^3/s^2]; ``position`` (..., 3) [m] from the
    attracting centre and ``velocity`` (..., 3) [m/s] at the time ``epoch`` (...) [s], both in
    space axes. Derivatives are regular everywhere, also for circular and equatorial orbits, whose
    elements (``KeplerOrbit``) are not. All orbits of a batch are ellipses, or all are hyperbolas,
    for fly-bys; ``hyperbolic`` (static) tells which where the numbers are traced.

    Lagrange's f and g functions of the difference in eccentric or hyperbolic anomaly (R. H. Battin,
    An Introduction to the Mathematics and Methods of Astrodynamics, 1999).

    Hand it to ``ph.GravityGradient(mu, orbit)`` or ``ph.LVLH(orbit)``. Raises ValueError for mu
    that is not positive, or a state on neither: a parabola, ellipses among hyperbolas, or moving
    straight to or from the centre.

        flyby = ph.StateOrbit(3.986e14, position=[3.8e7, 0, 0], velocity=[0, 7.4e3, 0])
    """

    mu: Float[Array, "*#b"] = shaped()
    position: Float[Array, "*#b 3"] = shaped(3)
    velocity: Float[Array, "*#b 3"] = shaped(3)
    epoch: Float[Array, "*#b"] = shaped()
    hyperbolic: bool = eqx.field(static=True, default=False)

    def __init__(self, mu, position, velocity, epoch=0.0, hyperbolic=None):
        given = {
            "mu": as_number("mu", mu),
            "position": as_float_array("position", position, (3,)),
            "velocity": as_float_array("velocity", velocity, (3,)),
            "epoch": as_number("epoch", epoch),
        }
        dtype = jnp.result_type(*given.values())
        for name, value in given.items():
            setattr(self, name, value.astype(dtype))
        require_positive("mu", self.mu)
        if is_concrete(self.mu, self.position, self.velocity):
            place, speed = np.asarray(self.position), np.asarray(self.velocity)
            distance = np.linalg.norm(place, axis=-1)
            excess = distance * np.sum(speed * speed, axis=-1) / np.asarray(self.mu)
            if hyperbolic is None:
                hyperbolic = bool(np.all(excess > 2))
            require(
                (distance > 0) & ((excess > 2 + 1e-9) if hyperbolic else (excess < 2)),
                "position and velocity must lie on an ellipse, |v|^2 |r|/mu below 2, or for a"
                f" batch of hyperbolas above 2, got {describe(excess)}: check the units, or hand"
                " GravityGradient any function of time instead.",
            )
            moment = np.linalg.norm(np.cross(place, speed), axis=-1)
            require(
                moment
                > 1e-6 * distance * np.sqrt(np.asarray(self.mu) / np.maximum(distance, 1e-300)),
                "the velocity must not point straight to or from the attracting centre, got"
                f" {describe(speed)} at {describe(place)}.",
            )

        self.hyperbolic = bool(hyperbolic)

    @property
    def momentum(self) -> Float[Array, "*b 3"]:
        return jnp.cross(*jnp.broadcast_arrays(self.position, self.velocity))

    def _position(self, t: Array) -> Float[Array, "*b 3"]:
        r0 = jnp.linalg.norm(self.position, axis=-1)
        bound = 2 - r0 * jnp.sum(self.velocity * self.velocity, axis=-1) / self.mu
        axis = r0 / jnp.abs(bound)
        n = jnp.sqrt(self.mu / axis) / axis  # mean motion
        # e cos E and e sin E at the epoch
        a = 1 - bound
        b = jnp.sum(self.position * self.velocity, axis=-1) / jnp.sqrt(self.mu * axis)
        mean = n * (t - self.epoch)
        if self.hyperbolic:
            x = _hyperbolic_since(*jnp.broadcast_arrays(mean, a, b))
            half, sine = jnp.sinh(x / 2), jnp.sinh(x)
        else:
            mean = mean - 2 * jnp.pi * jnp.round(mean / (2 * jnp.pi))
            x = _anomaly_since(*jnp.broadcast_arrays(mean, a, b))
            half, sine = jnp.sin(x / 2), jnp.sin(x)
        turn = 2 * half * half  # 1 - cos x, or cosh x - 1
        bound = jnp.abs(bound)
        f = 1 - turn / bound
        g = (bound * sine + b * turn) / n
        place, velocity = (
            jnp.broadcast_to(x, (*f.shape, 3)) for x in (self.position, self.velocity)
        )
        return f[..., None] * place + g[..., None] * velocity


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


def _hyperbolic_since(mean: Array, a: Array, b: Array) -> Array:
    """x with a sinh x + b (cosh x - 1) - x = mean, where a = e cosh F0 and b = e sinh F0."""
    m, p, q = jax.lax.stop_gradient((mean, a, b))
    eccentricity = jnp.sqrt((p - q) * (p + q))
    at_epoch = jnp.arcsinh(q / eccentricity)
    x = hyperbolic_anomaly(q - at_epoch + m, eccentricity) - at_epoch
    x = jax.lax.stop_gradient(x)
    for _ in range(2):  # these carry the derivatives
        half, sine = jnp.sinh(x / 2), jnp.sinh(x)
        turn = 2 * half * half
        gap = (a - 1) * x + a * _lead(x) + b * turn - mean
        x = x - gap / (a - 1 + a * turn + b * sine)
    return x
