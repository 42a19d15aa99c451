"""Kepler orbits, the local frame along an orbit, and torques relative to it."""

import abc
import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode import rotation
from polhode._batch import along_time, common_batch
from polhode._checks import (
    ArrayLike,
    as_float_array,
    as_number,
    describe,
    is_concrete,
    require,
    require_positive,
)
from polhode._hamiltonian import Attitude, Vector, components
from polhode._kernels import smooth
from polhode._parts import AbstractPart, shaped
from polhode._scene._torques import AbstractTorque, stacked, vector_of_time


def anomaly_at_periapsis(mean: Array, gap: Array, eccentricity: Array, hyperbolic: bool) -> Array:
    """Eccentric (hyperbolic) anomaly for a mean anomaly, without loops and without derivatives.

    ``mean`` [rad], for an ellipse within [-pi, pi]; ``gap``: |1 - e|, computed without
    cancellation. The relative error is below 1e-13 (ellipses) or 1e-16 (hyperbolas) plus rounding.
    F. L. Markley, Celest. Mech. Dyn. Astr. 63 (1995) 101, for the starting value of ellipses.
    """
    sign = jnp.where(mean < 0, -1, 1).astype(mean.dtype)
    m = jnp.abs(mean)
    if hyperbolic:
        # e sinh F - F exceeds (e - 1) F + e F^3/6, so that the root of this cubic exceeds F;
        # asinh((M + root)/e) exceeds it by less than 2 per cent
        p, h = 2 * gap / eccentricity, 3 * m / eccentricity
        w = _power(h + jnp.sqrt(h * h + p * p * p), 1 / 3)
        x = jnp.arcsinh((m + 2 * h / (w * w + p + p * p / (w * w))) / eccentricity)
    else:
        alpha = 3 * jnp.pi**2 + 1.6 * jnp.pi * (jnp.pi - m) / (1 + eccentricity)
        alpha = alpha / (jnp.pi**2 - 6)
        d = 3 * gap + alpha * eccentricity
        q = 2 * alpha * d * gap - m * m
        r = (3 * alpha * d * (d - gap) + m * m) * m
        w = _power(r + jnp.sqrt(q * q * q + r * r), 2 / 3)
        x = (2 * r * w / (w * w + w * q + q * q) + m) / d
    zero = jnp.zeros_like(x)
    for _ in range(2 if hyperbolic else 1):
        x = x + _correction(_functions(x, hyperbolic), x, m, gap, eccentricity, zero, hyperbolic)
    return sign * x


def passed_anomaly(
    x: Array, mean: Array, gap: Array, a: Array, b: Array | float, hyperbolic: bool
) -> tuple[Array, Array]:
    """sin x and 1 - cos x for the root of x - a sin x + b (1 - cos x) = mean near ``x``.

    For hyperbolas sinh x and cosh x - 1 for the root of a sinh x + b (cosh x - 1) - x = mean.
    ``gap``: |1 - a|. ``x`` is a constant with a correction of fourth order, so that derivatives
    with respect to the other arguments are correct up to the third, and the rounding error of ``x``
    does not affect the results.
    """
    x = jax.lax.stop_gradient(x)
    sine, turn, lag = _functions(x, hyperbolic)
    change = _correction((sine, turn, lag), x, mean, gap, a, b, hyperbolic)
    curved = 1 if hyperbolic else -1
    cosine = 1 + curved * turn
    return (
        sine + change * (cosine + change * curved * (sine / 2 + change * cosine / 6)),
        turn + change * (sine + change * (cosine / 2 + change * curved * sine / 6)),
    )


def _correction(functions, x, mean, gap, a, b, hyperbolic: bool) -> Array:
    """Change from x to the root of the equations of ``passed_anomaly``, of fourth order.

    It is the Newton step u with the first terms of the inverse series, u - f2 u^2/(2 f1) + ...
    """
    sine, turn, lag = functions
    curved = 1 if hyperbolic else -1
    cosine = 1 + curved * turn
    slope = gap + a * turn + b * sine
    second = (a * sine + b * cosine) / (2 * slope)
    third = (a * cosine + curved * b * sine) / (6 * slope)
    u = (mean - (gap * x + a * lag + b * turn)) / slope
    return u * (1 - u * (second - u * (2 * second * second - third)))


def _functions(x: Array, hyperbolic: bool) -> tuple[Array, Array, Array]:
    """sin x, 1 - cos x and x - sin x without cancellation; for hyperbolas sinh x, cosh x - 1 and
    sinh x - x."""
    square = x * x
    if hyperbolic:
        # from expm1(|x|/2): JAX computes sinh with exp(x - log 2), which loses digits
        growth = jnp.expm1(jnp.abs(x) / 2)
        half = jnp.sign(x) * (growth + growth / (1 + growth)) / 2
        sine, series_bound = half * (1 + growth + 1 / (1 + growth)), 3
    else:
        half = jnp.sin(x / 2)
        sine, series_bound = 2 * half * jnp.cos(x / 2), 10
    series_argument = jnp.minimum(square, series_bound)
    series = x * square * _series(series_argument if hyperbolic else -series_argument)
    lag = sine - x if hyperbolic else x - sine
    return sine, 2 * half * half, jnp.where(square < series_bound, series, lag)


def _series(square: Array) -> Array:
    """(sinh x - x)/x^3 as a function of x^2 within [-10, 3]; truncation error below 1e-18."""
    total = jnp.zeros_like(square)
    for k in range(14, -1, -1):
        total = 1 / math.factorial(2 * k + 3) + square * total
    return total


def _power(x: Array, exponent: float) -> Array:
    """Power of a positive number: a few digits less accurate than ``jnp.power``, but faster."""
    return jnp.exp(exponent * jnp.log(x))


def _within_a_turn(angle: Array) -> Array:
    """The angle [rad] modulo whole turns, within [-pi, pi]."""
    for _ in range(2):  # twice, since for a large angle the first result may have turns left over
        angle = angle - 2 * jnp.pi * jnp.round(angle / (2 * jnp.pi))
    return angle


def _from_one(eccentricity: Array, hyperbolic: bool) -> Array:
    """|1 - e|, exact for e near one."""
    return eccentricity - 1 if hyperbolic else 1 - eccentricity


class AbstractOrbit(AbstractPart):
    """Base of the orbits: position ``orbit(t)`` and ``velocity_at(t)`` of a body about a centre."""

    @abc.abstractmethod
    def __call__(self, t: Array | float) -> Float[Array, "*b 3"]:
        """Position (..., 3) from the attracting centre, space axes [m], at the time t [s]."""

    def velocity_at(self, t: Array | float) -> Float[Array, "*b 3"]:
        """Velocity (..., 3) in space axes [m/s] at the time t [s]."""
        t = jnp.asarray(t, jnp.result_type(*jax.tree.leaves(self)))
        return jax.jvp(self, (t,), (jnp.ones_like(t),))[1]


@smooth
def _place(orbit: "KeplerOrbit", t: Array) -> Array:
    return _by_elements(orbit, t) if orbit.position is None else _by_state(orbit, t)


class KeplerOrbit(AbstractOrbit):
    """Position of a body on an ellipse about an attracting centre: ``orbit(t)`` (..., 3) [m].

    ``KeplerOrbit(...)`` takes orbital elements, ``KeplerOrbit.from_state(...)`` a position and a
    velocity. Use it in ``ph.GravityGradient(mu, orbit)``, ``ph.LVLH(orbit)`` and
    ``ph.MagneticDipole``; for other orbits these also accept a function of time [s].

    **Arguments** (each (...), a batch broadcasts): ``mu`` [m^3/s^2]; ``semi_major_axis`` [m];
    ``eccentricity`` in [0, 1) (hyperbolas: ``ph.HyperbolicOrbit``); ``inclination``,
    ``node`` (longitude of the ascending node), ``periapsis`` (its argument), ``mean_anomaly`` at
    the time ``epoch`` [rad, s], measured from periapsis. Space axes: the inclination is measured
    from z, the node from x.

    Without an ``eccentricity`` (None) the orbit is a circle by construction: Kepler's equation is
    not solved, and unlike with 0.0 there is no derivative with respect to the eccentricity. The
    argument of latitude is then ``periapsis`` plus the mean anomaly.

        orbit = ph.KeplerOrbit(3.986e14, 6.9e6, inclination=1.7)
        same = ph.KeplerOrbit.from_state(3.986e14, orbit(0.0), orbit.velocity_at(0.0))

    Raises ValueError for mu that is not positive, an axis of the wrong sign, or an eccentricity
    outside [0, 1).
    """

    mu: Float[Array, "*#b"] = shaped()
    semi_major_axis: Float[Array, "*#b"] | None = shaped()
    eccentricity: Float[Array, "*#b"] | None = shaped()
    inclination: Float[Array, "*#b"] | None = shaped()
    node: Float[Array, "*#b"] | None = shaped()
    periapsis: Float[Array, "*#b"] | None = shaped()
    mean_anomaly: Float[Array, "*#b"] | None = shaped()
    position: Float[Array, "*#b 3"] | None = shaped(3)
    velocity: Float[Array, "*#b 3"] | None = shaped(3)
    epoch: Float[Array, "*#b"] = shaped()
    hyperbolic: ClassVar[bool] = False

    def __init__(
        self,
        mu: ArrayLike,
        semi_major_axis: ArrayLike,
        eccentricity: ArrayLike | None = None,
        inclination: ArrayLike = 0.0,
        node: ArrayLike = 0.0,
        periapsis: ArrayLike = 0.0,
        mean_anomaly: ArrayLike = 0.0,
        epoch: ArrayLike = 0.0,
    ):
        arguments = locals()
        self.position = self.velocity = None
        if eccentricity is None:
            self.eccentricity = arguments.pop("eccentricity")
        numbers = {
            name: as_number(name, arguments[name]) for name in self.core_ranks if name in arguments
        }
        dtype = jnp.result_type(*(x for x in numbers.values()))
        for name, value in numbers.items():
            # a Python number remains weakly typed, so that it does not determine the precision
            setattr(self, name, value if value.weak_type else value.astype(dtype))
        require_positive("mu", self.mu)
        if self.eccentricity is None:
            require(not self.hyperbolic, "HyperbolicOrbit needs an eccentricity, which is above 1.")
        elif is_concrete(self.eccentricity):
            e = np.asarray(self.eccentricity)
            fits = e > 1 if self.hyperbolic else (e >= 0) & (e < 1)
            bounds = "be above 1" if self.hyperbolic else "lie in [0, 1)"
            other_class = "KeplerOrbit" if self.hyperbolic else "HyperbolicOrbit"
            require(
                fits,
                lambda: f"eccentricity must {bounds}, got {eccentricity}; see ph.{other_class}.",
            )
        if is_concrete(self.semi_major_axis):
            axis = np.asarray(self.semi_major_axis)
            require(
                axis < 0 if self.hyperbolic else axis > 0,
                lambda: (
                    "semi_major_axis must be positive, of a hyperbola (ph.HyperbolicOrbit)"
                    f" negative, got {semi_major_axis}."
                ),
            )

    @classmethod
    def from_state(
        cls,
        mu: ArrayLike,
        position: ArrayLike,
        velocity: ArrayLike,
        epoch: ArrayLike = 0.0,
    ) -> Self:
        """The conic through a position (..., 3) [m] with a velocity (..., 3) [m/s].

        ``mu`` (...) [m^3/s^2]; both from the attracting centre, in space axes, at the time
        ``epoch`` (...) [s]. They are stored in place of elements, so that derivatives are regular
        also for circular and equatorial orbits, for which elements are singular. The orbits of
        ``ph.KeplerOrbit`` are ellipses, those of ``ph.HyperbolicOrbit`` hyperbolas.

        Lagrange's f and g functions of the difference in eccentric or hyperbolic anomaly (R. H.
        Battin, An Introduction to the Mathematics and Methods of Astrodynamics, 1999).

        Raises ValueError for mu that is not positive, a state on another kind of orbit, or radial
        motion.
        """
        place = as_float_array("position", position, (3,))
        speed = as_float_array("velocity", velocity, (3,))
        number, start = as_number("mu", mu), as_number("epoch", epoch)
        dtype = jnp.result_type(place, speed, number, start)
        place, speed = place.astype(dtype), speed.astype(dtype)
        require_positive("mu", number)
        if is_concrete(number, place, speed):
            state = np.asarray(number), np.asarray(place), np.asarray(speed)
            _check_state(*state, cls.hyperbolic)
        one = jnp.ones((), dtype)
        elements = (-one, 2 * one) if cls.hyperbolic else (one,)
        orbit = cls(number, *elements, epoch=start.astype(dtype))
        return eqx.tree_at(
            lambda orbit: [getattr(orbit, name) for name in (*_ELEMENTS, "position", "velocity")],
            orbit,
            [None] * len(_ELEMENTS) + [place, speed],
            is_leaf=lambda x: x is None,
        )

    def __call__(self, t: Array | float) -> Float[Array, "*b 3"]:
        t = jnp.asarray(t) if isinstance(t, list | tuple) else t
        common_batch(self, extra=(jnp.shape(t),))  # raises where they do not broadcast
        return _place(self, t)

    @property
    def mean_motion(self) -> Array:
        """sqrt(mu/|a|^3) [rad/s]."""
        if self.position is None:
            axis = jnp.abs(self.semi_major_axis)
        else:
            axis = _axis_of_state(self)[0]
        return jnp.sqrt(self.mu / axis) / axis

    @property
    def period(self) -> Array:
        """Time of one revolution (...) [s]; inf for a hyperbola."""
        period = 2 * jnp.pi / self.mean_motion
        return jnp.full_like(period, jnp.inf) if self.hyperbolic else period

    @property
    def momentum(self) -> Float[Array, "*b 3"]:
        """Angular momentum r x v (..., 3) per unit of mass, space axes [m^2/s]; constant."""
        if self.position is not None:
            return jnp.cross(*jnp.broadcast_arrays(self.position, self.velocity))
        parameter = jnp.abs(self.semi_major_axis)
        if (e := self.eccentricity) is not None:
            parameter = parameter * _from_one(e, self.hyperbolic) * (1 + e)
        cn, sn = jnp.cos(self.node), jnp.sin(self.node)
        ci, si = jnp.cos(self.inclination), jnp.sin(self.inclination)
        size = jnp.sqrt(self.mu * parameter)
        pole = jnp.broadcast_arrays(sn * si * size, -cn * si * size, ci * size)
        return jnp.stack(pole, axis=-1)


class HyperbolicOrbit(KeplerOrbit):
    """Position of a body on a hyperbola about an attracting centre, for fly-bys.

    Arguments as for ``ph.KeplerOrbit``, with ``eccentricity`` > 1 and ``semi_major_axis`` < 0 [m].

        flyby = ph.HyperbolicOrbit.from_state(3.986e14, [3.8e7, 0, 0], [0, 7.4e3, 0])

    Raises ValueError for other numbers.
    """

    hyperbolic: ClassVar[bool] = True


_ELEMENTS = (
    "semi_major_axis",
    "eccentricity",
    "inclination",
    "node",
    "periapsis",
    "mean_anomaly",
)


def _by_elements(orbit: Any, t: Array) -> Float[Array, "*b 3"]:
    mean = orbit.mean_anomaly + orbit.mean_motion * (t - orbit.epoch)
    axis, e = jnp.abs(orbit.semi_major_axis), orbit.eccentricity
    if not orbit.hyperbolic:
        mean = _within_a_turn(mean)
    if e is None:
        angle = orbit.periapsis + mean
        u, v = axis * jnp.cos(angle), axis * jnp.sin(angle)
    else:
        mean, gap, e = jnp.broadcast_arrays(mean, _from_one(e, orbit.hyperbolic), e)
        x = anomaly_at_periapsis(*jax.lax.stop_gradient((mean, gap, e)), orbit.hyperbolic)
        sine, turn = passed_anomaly(x, mean, gap, e, 0.0, orbit.hyperbolic)
        along, across = axis * (gap - turn), axis * jnp.sqrt(gap * (1 + e)) * sine
        cw, sw = jnp.cos(orbit.periapsis), jnp.sin(orbit.periapsis)
        u, v = cw * along - sw * across, sw * along + cw * across
    cn, sn = jnp.cos(orbit.node), jnp.sin(orbit.node)
    ci, si = jnp.cos(orbit.inclination), jnp.sin(orbit.inclination)
    place = (cn * u - sn * ci * v, sn * u + cn * ci * v, si * v)
    return jnp.stack(jnp.broadcast_arrays(*place), axis=-1)


def _check_state(mu: np.ndarray, place: np.ndarray, speed: np.ndarray, hyperbolic: bool) -> None:
    """ValueError for states on another kind of orbit."""
    distance = np.linalg.norm(place, axis=-1)
    excess = distance * np.sum(speed * speed, axis=-1) / mu
    require(
        (distance > 0) & ((excess > 2 + 1e-9) if hyperbolic else (excess < 2)),
        f"position and velocity must lie on {'a hyperbola' if hyperbolic else 'an ellipse'},"
        f" |v|^2 |r|/mu {'above' if hyperbolic else 'below'} 2, got {describe(excess)}: check the"
        f" units, or use ph.{'KeplerOrbit' if hyperbolic else 'HyperbolicOrbit'}.",
    )
    moment = np.linalg.norm(np.cross(place, speed), axis=-1)
    require(
        moment > 1e-6 * distance * np.sqrt(mu / np.maximum(distance, 1e-300)),
        "the velocity must not point straight to or from the attracting centre, got"
        f" {describe(speed)} at {describe(place)}.",
    )


def _axis_of_state(orbit: Any) -> tuple[Array, Array]:
    """|a| [m], and 2 - |r| |v|^2 / mu, which is negative on a hyperbola."""
    distance = jnp.linalg.norm(orbit.position, axis=-1)
    bound = 2 - distance * jnp.sum(orbit.velocity * orbit.velocity, axis=-1) / orbit.mu
    return distance / jnp.abs(bound), bound


def _by_state(orbit: Any, t: Array) -> Float[Array, "*b 3"]:
    axis, bound = _axis_of_state(orbit)
    n = jnp.sqrt(orbit.mu / axis) / axis  # mean motion
    # e cos E and e sin E at the epoch
    a = 1 - bound
    b = jnp.sum(orbit.position * orbit.velocity, axis=-1) / jnp.sqrt(orbit.mu * axis)
    bound, mean = jnp.abs(bound), n * (t - orbit.epoch)
    if not orbit.hyperbolic:
        mean = _within_a_turn(mean)
    mean, bound, a, b = jnp.broadcast_arrays(mean, bound, a, b)
    shape = jnp.sum(orbit.momentum**2, axis=-1) / (orbit.mu * axis)  # |1 - e^2|
    nearly = _nearly_passed(orbit.hyperbolic, *jax.lax.stop_gradient((mean, a, b, shape)))
    sine, turn = passed_anomaly(nearly, mean, bound, a, b, orbit.hyperbolic)
    f = 1 - turn / bound
    g = (bound * sine + b * turn) / n
    place, velocity = (jnp.broadcast_to(x, (*f.shape, 3)) for x in (orbit.position, orbit.velocity))
    return f[..., None] * place + g[..., None] * velocity


def _nearly_passed(hyperbolic: bool, mean: Array, a: Array, b: Array, shape: Array) -> Array:
    """Approximate difference in anomaly since the epoch, without derivatives."""
    if hyperbolic:
        e = jnp.sqrt(1 + shape)
        at_epoch = jnp.arcsinh(b / e)
        total = mean + b - at_epoch
    else:
        e = jnp.sqrt(a * a + b * b)
        at_epoch = jnp.arctan2(b, a)
        total = _within_a_turn(mean + at_epoch - b)
    x = anomaly_at_periapsis(total, shape / (1 + e), e, hyperbolic) - at_epoch
    return x if hyperbolic else mean + _within_a_turn(x - mean)


# The frame along an orbit, and torques in it.


class LVLH(AbstractPart):
    """Local vertical, local horizontal: x forward, y against the orbit's momentum, z to the centre.

    z points to the attracting centre, y is opposite to r x v, and x, in the plane of the orbit,
    completes the right-handed frame: on a circular orbit it is the direction of flight. This is the
    convention of NASA's JEOD and the space shuttle; yaw, pitch and roll are the angles ZYX of the
    body in it.

    ``orbit``: ``ph.KeplerOrbit``, or a function of time [s] returning the position (3,) from the
    attracting centre [m], twice differentiable. Times are () or (..., T), with the axes of a batch
    of orbits first.

        frame = ph.LVLH(ph.KeplerOrbit(3.986004418e14, 6.8e6))
        state = ph.State(*frame.from_frame([1.0, 0, 0, 0], [0.0, 0, 0], 0.0))  # at rest in it
        roll = frame.yaw_pitch_roll(traj)[2]

    Conventions: NASA JSC, JEOD Dynamics: LVLH reference frame; D. A. Vallado, Fundamentals of
    Astrodynamics and Applications, section 3.3.
    """

    orbit: AbstractOrbit | Callable = shaped(3)

    def __init__(self, orbit: AbstractOrbit | Callable):
        if not callable(orbit):
            raise TypeError(
                "LVLH takes an orbit (ph.KeplerOrbit) or a function of time, got"
                f" {type(orbit).__name__}: a frame at rest needs none."
            )
        function: Any = vector_of_time("LVLH", orbit)
        self.orbit = function

    def axes(self, t: Array) -> tuple[Float[Array, "*b 3"], ...]:
        """Unit vectors x, y, z of the frame in space, and its rates [rad/s] along them."""
        t = jnp.asarray(t)
        if isinstance(self.orbit, KeplerOrbit):
            r = self.orbit(t)
            momentum, normal = jnp.broadcast_to(self.orbit.momentum, r.shape), None
        else:  # other orbits may leave their plane

            def place_and_velocity(t):
                return jax.jvp(place, (t,), (jnp.ones_like(t),))

            place = self.orbit
            if not isinstance(place, AbstractPart):  # a part handles batch axes itself
                place = jnp.vectorize(place, signature="()->(n)")
            (r, v), (_, force) = jax.jvp(place_and_velocity, (t,), (jnp.ones_like(t),))
            momentum = jnp.cross(r, v)
            normal = jnp.sum(force * momentum, axis=-1, keepdims=True)
        return _axes(r, momentum, normal)

    def attitude(self, t: ArrayLike) -> Float[Array, "*b 4"]:
        """Unit quaternion, frame -> space."""
        *axes, _ = self.axes(as_float_array("t", t))
        return rotation.matrix_to_wxyz(jnp.stack(axes, axis=-1))

    def omega(self, t: ArrayLike) -> Float[Array, "*b 3"]:
        """Angular velocity of the frame along its own axes [rad/s]."""
        return self.axes(as_float_array("t", t))[3]

    def to_frame(
        self, wxyz: ArrayLike, omega_body: ArrayLike, t: ArrayLike
    ) -> tuple[Float[Array, "*b 4"], Float[Array, "*b 3"]]:
        """Attitude body -> frame (..., 4), and rates relative to the frame in body axes.

        From attitude (..., 4) body -> space and body rates (..., 3) [rad/s] at times ``t``.
        """
        wxyz, omega, frame, rates = self._as_arrays(wxyz, omega_body, t)
        relative = rotation.multiply(rotation.conjugate(frame), wxyz)
        return relative, omega - rotation.rotate(rotation.conjugate(relative), rates)

    def from_frame(
        self, wxyz: ArrayLike, omega_body: ArrayLike, t: ArrayLike
    ) -> tuple[Float[Array, "*b 4"], Float[Array, "*b 3"]]:
        """Inverse of ``to_frame``: attitude body -> space and body rates, for ``ph.State``.

        From attitude (..., 4) body -> frame, and rates (..., 3) [rad/s] relative to the frame in
        body axes.
        """
        wxyz, omega, frame, rates = self._as_arrays(wxyz, omega_body, t)
        omega_space = omega + rotation.rotate(rotation.conjugate(wxyz), rates)
        return rotation.multiply(frame, wxyz), omega_space

    def yaw_pitch_roll(self, trajectory: Any) -> tuple[Array, Array, Array]:
        """Angles ZYX [rad] of a trajectory's body axes in the frame, each (..., T)."""
        frame = self
        if isinstance(self.orbit, AbstractPart):  # may have one orbit for each body
            frame = LVLH(along_time(self.orbit, len(trajectory.batch_shape)))
        wxyz, _ = frame.to_frame(trajectory.wxyz, trajectory.omega_body, trajectory._t)
        return rotation.wxyz_to_euler(wxyz, rotation.Sequence.ZYX)

    def _as_arrays(self, wxyz, omega_body, t):
        wxyz = rotation.normalise(as_float_array("wxyz", wxyz, (4,)))
        omega = as_float_array("omega_body", omega_body, (3,))
        t = as_float_array("t", t).astype(omega.dtype)
        frame, rates = self.attitude(t), self.omega(t)
        lead = jnp.broadcast_shapes(*(x.shape[:-1] for x in (wxyz, omega, frame, rates)))
        return tuple(jnp.broadcast_to(x, (*lead, x.shape[-1])) for x in (wxyz, omega, frame, rates))


@jax.jit  # outside jit too, one program for all operations
def _axes(r: Array, momentum: Array, normal: Array | None) -> tuple[Array, ...]:
    """``LVLH.axes`` from position, angular momentum, and ``normal``: acceleration . momentum."""
    size = jnp.linalg.norm(momentum, axis=-1, keepdims=True)
    distance = jnp.linalg.norm(r, axis=-1, keepdims=True)
    z, y = -r / distance, -momentum / size
    zero = jnp.zeros_like(distance)
    yawing = zero if normal is None else -distance * (normal / size) / size  # size**4 overflows
    rates = jnp.concatenate([zero, -size / distance**2, yawing], axis=-1)
    return jnp.cross(y, z), y, z, rates


class RelativeTorque(AbstractTorque):
    """A torque computed from attitude and rates relative to an orbit frame.

    ``RelativeTorque(ph.LinearDamping(c), frame)`` damps the rates relative to the frame;
    ``RelativeTorque(ph.FeedbackTorque(fn), frame)`` passes the attitude body -> frame and the rates
    relative to the frame to ``fn``. The components of a ``ph.SpaceTorque`` are those in the frame.

    Raises TypeError for another kind of torque or frame.
    """

    torque: AbstractTorque = shaped()
    frame: LVLH = shaped()

    def __init__(self, torque: AbstractTorque, frame: LVLH):
        if not isinstance(torque, AbstractTorque) or not isinstance(frame, LVLH):
            raise TypeError(
                "RelativeTorque takes a torque and a ph.LVLH frame, got"
                f" {type(torque).__name__} and {type(frame).__name__}."
            )
        self.torque, self.frame = torque, frame

    def body_components(
        self, t: Array | float, attitude: Attitude, omega: Sequence[Array]
    ) -> tuple[Array, Array, Array]:
        *axes, rates = self.frame.axes(jnp.asarray(t, omega[0].dtype))

        def quaternion():  # computed only if the torque needs it: most need rows of R alone
            frame = rotation.matrix_to_wxyz(jnp.stack(axes, axis=-1))
            body = stacked(attitude.wxyz)
            frame = jnp.broadcast_to(rotation.conjugate(frame), body.shape)
            relative = rotation.multiply(frame, body)
            return jnp.unstack(relative, axis=-1)

        relative = Attitude(lambda i: attitude.to_body(components(axes[i])), quaternion)
        turning = relative.to_body(components(rates))
        return self.torque.body_components(
            t, relative, tuple(w - f for w, f in zip(omega, turning))
        )

    @property
    def edges(self) -> Array | None:
        return self.torque.edges

    def during(self, t: Array | float) -> AbstractTorque:
        return RelativeTorque(self.torque.during(t), self.frame)

    def with_wheels(self, momentum: Sequence[Array]) -> AbstractTorque:
        return RelativeTorque(self.torque.with_wheels(momentum), self.frame)

    def slip(
        self, t: Array | float, momentum: Sequence[Array], omega: Sequence[Array]
    ) -> Vector | None:
        return self.torque.slip(t, momentum, omega)
