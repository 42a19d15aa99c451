"""Attitude control: pointing, rate damping, magnetic dipoles, gyros and clusters of wheels."""

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode import rotation
from polhode._checks import (
    ArrayLike,
    as_float_array,
    as_number,
    as_positive,
    default_array,
    is_concrete,
    require,
    require_positive,
)
from polhode._hamiltonian import Attitude, Vector, components, cross, dot, triple
from polhode._parts import AbstractPart, Signature, above_zero, shaped
from polhode._scene._tables import Table, check_kind
from polhode._scene._torques import AbstractTorque, coefficients, stacked, value_at, vector_of_time
from polhode._scene._wheels import AbstractCoupling, AbstractRotor, Rotor, RotorSum

_IDENTITY = (1.0, 0.0, 0.0, 0.0)
_ORIGIN = (0.0, 0.0, 0.0)


class Pointing(AbstractTorque):
    """A PD control law for the attitude: N = -2 kp e - kd omega in body axes.

    e is the vector part of the quaternion from the attitude ``target`` to that of the body, with
    the sign of the shorter rotation: for small angles the torque is kp times the angle.

    **Arguments:** ``kp`` [N m/rad] and ``kd`` [N m s], (..., 3) or one number for the same about
    every axis, not negative; ``target`` (..., 4): ``wxyz`` body -> space. At exactly half a
    revolution the direction is undefined.

        law = ph.Pointing(kp=0.3, kd=0.8)
        scene = ph.Scene(ph.Inertia.from_moments([1.0, 1.5, 2.0]), torque=law)

    Raises ValueError for negative gains or a zero quaternion.
    """

    smooth: ClassVar[bool] = False  # the torque changes sign at half a turn from the target

    kp: Float[Array, "*#b 3"] = shaped(3)
    kd: Float[Array, "*#b 3"] = shaped(3)
    target: Float[Array, "*#b 4"] = shaped(4)

    def __init__(self, kp: ArrayLike, kd: ArrayLike, target: ArrayLike = _IDENTITY):
        self.kp = coefficients("Pointing kp", kp, "a positive kp turns towards the target")
        self.kd = coefficients("Pointing kd", kd, "a positive kd takes energy away")
        target = default_array(_IDENTITY) if target is _IDENTITY else target
        quaternion = as_float_array("Pointing target", target, (4,))
        if is_concrete(quaternion):
            require(
                np.any(np.asarray(quaternion) != 0, axis=-1),
                lambda: f"target must not be zero, got {target}.",
            )
        self.target = rotation.normalise(quaternion)

    def body_components(
        self, t: Array | float, attitude: Attitude, omega: Sequence[Array]
    ) -> tuple[Array, Array, Array]:
        a, *b = jnp.unstack(self.target, axis=-1)
        w, *v = attitude.wxyz
        scalar = a * w + b[0] * v[0] + b[1] * v[1] + b[2] * v[2]
        b_cross_v = cross(b, v)
        sign = 2 * jnp.where(scalar < 0, -1, 1).astype(w.dtype)
        error = (sign * (a * y - w * x - z) for x, y, z in zip(b, v, b_cross_v))
        kp, kd = components(self.kp), components(self.kd)
        return triple(-p * e - d * rate for p, d, e, rate in zip(kp, kd, error, omega))


class RateDamping(AbstractTorque):
    """A control law for the body rates: N = -c (omega - rates) in body axes.

    ``c`` (..., 3), or one number for the same about every axis [N m s], not negative; ``rates``
    (..., 3) [rad/s]. Raises ValueError for a negative c.
    """

    c: Float[Array, "*#b 3"] = shaped(3)
    rates: Float[Array, "*#b 3"] = shaped(3)

    def __init__(self, c: ArrayLike, rates: ArrayLike = _ORIGIN):
        self.c = coefficients("RateDamping c", c)
        rates = default_array(_ORIGIN) if rates is _ORIGIN else rates
        self.rates = as_float_array("RateDamping rates", rates, (3,))

    def body_components(
        self, t: Array | float, attitude: Attitude, omega: Sequence[Array]
    ) -> tuple[Array, Array, Array]:
        pairs = zip(components(self.c), omega, components(self.rates))
        return triple(-c * (rate - target) for c, rate, target in pairs)


_FIELD = Signature("MagneticDipole field", {"position": (3,), "t": ()}, (3,))
_MOMENT = Signature(
    "MagneticDipole moment", {"t": (), "omega_body": (3,), "field_body": (3,)}, (3,)
)


class MagneticDipole(AbstractTorque):
    """A dipole in a magnetic field: N = m x B.

    **Arguments:** ``moment``: in body axes [A m^2], constant (..., 3) or a function ``fn(t,
    omega_body, field_body)`` -> (3,) of one body, such as ``ph.BDot``; ``field``: in space axes,
    [T], constant (..., 3), a function ``fn(position, t)`` -> (3,), such as ``ph.DipoleField``, or a
    ``ph.Table`` over time;
    ``position``: of the body [m], space axes, constant (..., 3), a function of time or an orbit
    such as ``ph.KeplerOrbit``, for a field that is a function.

        orbit = ph.KeplerOrbit(3.986e14, 6.9e6, inclination=1.7)
        field = ph.DipoleField([0, 0, -7.8e22])
        rods = ph.MagneticDipole(ph.BDot(4e4, max_moment=0.2), field, orbit)

    Raises TypeError or ValueError for functions that take or return something else.
    """

    moment: Float[Array, "*#b 3"] | Callable = shaped(3)
    field: Float[Array, "*#b 3"] | Callable = shaped(3)
    position: Float[Array, "*#b 3"] | Callable | AbstractPart = shaped(3)

    def __init__(
        self,
        moment: ArrayLike | Callable,
        field: ArrayLike | Callable,
        position: ArrayLike | Callable = _ORIGIN,
    ):
        self.moment = (
            _MOMENT.checked(moment)
            if callable(moment)
            else as_float_array(_MOMENT.name, moment, (3,))
        )
        if isinstance(field, Table):
            check_kind(_FIELD.name, field, 3)
            self.field = field
        elif callable(field):
            self.field = _FIELD.checked(field)
        else:
            self.field = as_float_array(_FIELD.name, field, (3,))
        position = default_array(_ORIGIN) if position is _ORIGIN else position
        self.position = vector_of_time("MagneticDipole position", position)

    def body_components(
        self, t: Array | float, attitude: Attitude, omega: Sequence[Array]
    ) -> tuple[Array, Array, Array]:
        field, moment = self.field_body(t, attitude), self.moment
        if callable(moment):
            moment = _MOMENT.mapped(moment, t, stacked(omega), stacked(field))
        return cross(components(moment), field)

    @property
    def input_conditions(self) -> tuple[Array, ...]:
        return above_zero(self.moment.max_moment) if isinstance(self.moment, BDot) else ()

    def field_body(self, t: Array | float, attitude: Attitude) -> tuple[Array, Array, Array]:
        """The field in body axes [T]."""
        field = self.field
        if isinstance(field, Table):
            field = field(t)
        elif callable(field):
            place = stacked(value_at("MagneticDipole position", self.position, t))
            field = _FIELD.mapped(field, place, jnp.asarray(t, place.dtype))
        return attitude.to_body(components(field))


class BDot(eqx.Module):
    """Magnetic moment that detumbles a body: m = k omega x B [A m^2].

    That is -k times the rate of change of B in body axes if B is nearly constant in space. The
    change of B along an orbit, which a magnetometer also measures, is not included: with it the
    body would come to rest relative to the field, at about twice the orbital rate, not in space.
    ``k`` [A m^2 s/T]: a number, a leaf for gradients; ``max_moment`` [A m^2]: limit of each of
    three rods, or None. For ``ph.MagneticDipole``: the torque is -k |B|^2 times the component of
    omega normal to B.
    """

    k: Array
    max_moment: Array | None

    def __init__(self, k: ArrayLike, max_moment: ArrayLike | None = None):
        self.k = as_number("BDot k", k)
        self.max_moment = None if max_moment is None else as_positive("BDot max_moment", max_moment)

    def __call__(self, t: Array | float, omega_body: Array, field_body: Array) -> Array:
        moment = self.k * jnp.cross(omega_body, field_body)
        if self.max_moment is None:
            return moment
        return jnp.clip(moment, -self.max_moment, self.max_moment)


class DipoleField(eqx.Module):
    """Field [T] of a dipole ``moment`` (3,) [A m^2] at the origin, in space axes.

    B(r) = 1e-7 (3 n (n . m) - m) / |r|^3, n = r/|r|; that of the Earth is about 7.8e22 A m^2 to the
    south. Called as ``field(position, t)``; for ``ph.MagneticDipole``.
    """

    moment: Array

    def __init__(self, moment: ArrayLike):
        self.moment = as_float_array("DipoleField moment", moment, (3,))

    def __call__(self, position: Array, t: Array | float) -> Array:
        size = jnp.sqrt(jnp.sum(position * position))
        n = position / size
        # separate factors: the derivative of x / size**3 contains size**-6, subnormal in float32
        inverse = 1 / size
        field = 1e-7 * (3 * n * jnp.sum(n * self.moment) - self.moment)
        return field * inverse * inverse * inverse


_MOTOR_COMMAND = Signature("Motor", {"t": (), "wxyz": (4,), "omega_body": (3,), "speed": ()})


class Motor(AbstractCoupling):
    """A motor between body and wheel, with limits of torque and speed.

    **Arguments:** ``command``: torque on the wheel about its axis [N m], a number (...) or a
    function ``fn(t, wxyz, omega_body, speed)`` of one body and the wheel's speed [rad/s] relative
    to it; ``max_torque`` (...) [N m], positive: limit of the torque; ``max_speed`` (...) [rad/s],
    positive: the accelerating torque falls linearly to zero at this speed (the characteristic of a
    DC motor), the braking torque does not. It needs ``max_torque``.

    A wheel that controls the attitude, with friction in its bearing:

        def hold(t, wxyz, omega_body, speed):       # the body takes the reaction
            return 0.4 * wxyz[1] * jnp.sign(wxyz[0]) + 0.5 * omega_body[0]

        motor = ph.Motor(hold, max_torque=0.1, max_speed=600.0) + ph.ViscousCoupling(1e-5)
        wheel = ph.Rotor([1.0, 0.0, 0.0], inertia=1e-3, speed=0.0, coupling=motor)

    Raises TypeError or ValueError for other numbers, or a function that takes or returns something
    else.
    """

    smooth: ClassVar[bool] = False  # the limits

    command: Float[Array, "*#b"] | Callable = shaped()
    max_torque: Float[Array, "*#b"] | None = shaped()
    max_speed: Float[Array, "*#b"] | None = shaped()

    def __init__(
        self,
        command: ArrayLike | Callable,
        max_torque: ArrayLike | None = None,
        max_speed: ArrayLike | None = None,
    ):
        if callable(command):
            self.command = _MOTOR_COMMAND.checked(command)
        else:
            self.command = as_number("Motor command", command)
        for name, value in (("max_torque", max_torque), ("max_speed", max_speed)):
            setattr(self, name, None if value is None else as_positive(f"Motor {name}", value))
        if max_speed is not None and max_torque is None:
            raise ValueError("Motor max_speed needs max_torque, the torque that falls with it.")

    @property
    def input_conditions(self) -> tuple[Array, ...]:
        return above_zero(self.max_torque, self.max_speed)

    def torque(
        self, t: Array | float, speed: Array, attitude: Attitude, omega: Sequence[Array]
    ) -> Array:
        torque = self.command
        if callable(torque):
            arguments = t, stacked(attitude.wxyz), stacked(omega), speed
            torque = _MOTOR_COMMAND.mapped(torque, *arguments)
        if self.max_torque is None:
            return torque
        low, high = -self.max_torque, self.max_torque
        if self.max_speed is not None:
            share = speed / self.max_speed
            high = self.max_torque * jnp.clip(1 - share, 0, 1)
            low = -self.max_torque * jnp.clip(1 + share, 0, 1)
        return jnp.clip(torque, low, high)


_CLUSTER_COMMAND = Signature(
    "wheel_cluster command", {"t": (), "wxyz": (4,), "omega_body": (3,)}, (3,)
)


class _ClusterMotor(AbstractCoupling):
    """Motor of wheel ``i`` of a cluster: its share of the commanded torque, and null motion."""

    smooth: ClassVar[bool] = False  # the limits

    command: Callable
    share: Array
    null: Array
    bias: Array
    first: int = eqx.field(static=True)
    max_torque: Float[Array, "*#b"] | None = shaped()

    @property
    def input_conditions(self) -> tuple[Array, ...]:
        return above_zero(self.max_torque)

    def torque(self, t, speed, attitude, omega):
        return self._limit(self._command_torque(t, attitude, omega))

    def torque_among(self, t, i, speed_of, attitude, omega):
        total = self._command_torque(t, attitude, omega)
        for j in range(self.null.shape[-1]):
            excess = speed_of(self.first + j) - self.bias[j]
            total = total - self.null[j] * excess
        return self._limit(total)

    def _command_torque(self, t, attitude: Attitude, omega: Sequence[Array]) -> Array:
        command = _CLUSTER_COMMAND.mapped(self.command, t, stacked(attitude.wxyz), stacked(omega))
        return -dot(components(self.share), components(command))

    def _limit(self, torque: Array) -> Array:
        if self.max_torque is None:
            return torque
        return jnp.clip(torque, -self.max_torque, self.max_torque)


def wheel_cluster(
    axes: ArrayLike,
    inertia: ArrayLike,
    command: Callable,
    *,
    speed: ArrayLike = 0.0,
    max_torque: ArrayLike | None = None,
    friction: AbstractCoupling | None = None,
    null_gain: ArrayLike = 0.0,
    bias: ArrayLike = 0.0,
    first: int = 0,
) -> AbstractRotor:
    """A cluster of reaction wheels that exerts a commanded torque on the body.

    **Arguments:** ``axes`` (n, 3): of n >= 3 wheels in body axes, which span space; ``inertia``:
    of each wheel about its axis [kg m^2], (n,) or one number; ``command``: a function
    ``fn(t, wxyz, omega_body)`` -> (3,), the torque on the body [N m]; ``speed``: initial speeds
    [rad/s], (n,) or one number; ``max_torque`` of each motor [N m], (n,) or one number, or None;
    ``friction`` of each bearing, such as ``ph.ViscousCoupling``; ``null_gain`` [1/s] and ``bias``
    [rad/s], (n,) or one number: null motion drives the speeds to the bias as far as that exerts no
    torque on the body; ``first``: the index of the first of these wheels among those of the scene.
    All bodies of a batch share these numbers.

    The wheels share the command by the pseudo-inverse of their axes, with the least sum of squares
    of the motor torques. The result is a sum of ``ph.Rotor`` for ``ph.Scene(rotors=...)``.

        corners = [[1, 1, 1], [-1, 1, 1], [-1, -1, 1], [1, -1, 1]]
        law = lambda t, wxyz, omega_body: -0.1 * omega_body
        wheels = ph.wheel_cluster(corners, 1e-3, law, max_torque=0.02)

    F. L. Markley and J. L. Crassidis, Fundamentals of Spacecraft Attitude Determination and
    Control, 2014, section 7.3.4. Raises ValueError for fewer than three wheels, axes in one plane
    or other shapes, TypeError or ValueError for a command that takes or returns something else.
    """
    directions = as_float_array("wheel_cluster axes", axes, (None, 3))
    if directions.ndim != 2:
        raise ValueError(
            f"wheel_cluster axes must have shape (n, 3), got {directions.shape}: all bodies of a"
            " batch share the cluster; for axes that differ add ph.Rotor objects."
        )
    directions = directions / jnp.sqrt(jnp.sum(directions**2, axis=-1, keepdims=True))
    n = directions.shape[0]
    if is_concrete(directions):
        require(
            np.linalg.matrix_rank(np.asarray(directions), tol=1e-6) == 3,
            f"wheel_cluster axes must be three or more that span space, got {axes}.",
        )
    moments, speeds, bias_speeds = (
        _for_each_wheel(f"wheel_cluster {name}", value, n)
        for name, value in (("inertia", inertia), ("speed", speed), ("bias", bias))
    )
    gain = as_number("wheel_cluster null_gain", null_gain)
    law = _CLUSTER_COMMAND.checked(command)
    # Motor torques u = -A^+ N exert N = -A u on the body; the rows of 1 - A^+ A are motor torques
    # without a torque on the body. The projector acts on the momenta J Omega, because these, not
    # the speeds, must cancel.
    inverse = jnp.linalg.solve(directions.T @ directions, directions.T).T
    projector = jnp.eye(n, dtype=directions.dtype) - inverse @ directions.T
    limits: Any = [None] * n
    if max_torque is not None:
        limits = _for_each_wheel("wheel_cluster max_torque", max_torque, n)
        require_positive("wheel_cluster max_torque", limits)
    rotors = []
    for i in range(n):
        null = gain * projector[i] * moments
        motor: Any = _ClusterMotor(law, inverse[i], null, bias_speeds, first, limits[i])
        coupling = motor if friction is None else motor + friction
        rotors.append(Rotor(directions[i], inertia=moments[i], speed=speeds[i], coupling=coupling))
    return RotorSum(tuple(rotors))


def _for_each_wheel(name: str, value: ArrayLike, n: int) -> Array:
    """Numbers (n,), from one number for all wheels or one for each."""
    array = as_float_array(name, value)
    if array.shape not in ((), (n,)):
        raise ValueError(
            f"{name} must be one number or one for each of {n} wheels, got shape {array.shape}."
        )
    return jnp.broadcast_to(array, (n,))


class MomentumDumping(AbstractTorque):
    """Magnetorquers that remove the momentum of the wheels: m = -k (B x h)/|B|^2, N = m x B.

    h is the momentum of the scene's wheels along their axes a: J Omega for a wheel of prescribed
    speed Omega relative to the body, and J (Omega + a . omega), including the rotation of the body,
    for a wheel with a motor, a torque or a coupling. The torque is -k times the component of h
    normal to the field. The wheels counteract it and thereby lose momentum.

    **Arguments:** ``k`` (...) [1/s], not negative; ``field`` and ``position``: as in
    ``ph.MagneticDipole``; ``max_moment`` (...) [A m^2]: limit of each of three rods, or None.

        unload = ph.MomentumDumping(1e-3, ph.DipoleField([0, 0, -7.8e22]), orbit, max_moment=0.5)

    F. L. Markley and J. L. Crassidis, Fundamentals of Spacecraft Attitude Determination and
    Control, 2014, section 7.5.2. Raises TypeError or ValueError for other arguments.
    """

    smooth: ClassVar[bool] = False  # the limit

    dipole: MagneticDipole = shaped()
    k: Float[Array, "*#b"] = shaped()
    max_moment: Float[Array, "*#b"] | None = shaped()
    momentum: Vector | None = None

    def __init__(
        self,
        k: ArrayLike,
        field: ArrayLike | Callable,
        position: ArrayLike | Callable = _ORIGIN,
        max_moment: ArrayLike | None = None,
    ):
        self.k = as_positive("MomentumDumping k", k, zero=True)
        self.dipole = MagneticDipole(default_array(_ORIGIN), field, position)
        self.max_moment = None
        if max_moment is not None:
            self.max_moment = as_positive("MomentumDumping max_moment", max_moment)
        self.momentum = None

    @property
    def input_conditions(self) -> tuple[Array, ...]:
        return above_zero(self.max_moment)

    def with_wheels(self, momentum: Sequence[Array]) -> AbstractTorque:
        return eqx.tree_at(
            lambda part: part.momentum, self, triple(momentum), is_leaf=lambda x: x is None
        )

    def body_components(
        self, t: Array | float, attitude: Attitude, omega: Sequence[Array]
    ) -> tuple[Array, Array, Array]:
        if self.momentum is None:
            return triple([jnp.zeros_like(omega[0])] * 3)
        field = self.dipole.field_body(t, attitude)
        square = dot(field, field)
        square = jnp.where(square > 0, square, 1)  # no field, no torque
        moment = triple(-self.k * x / square for x in cross(field, self.momentum))
        if self.max_moment is not None:
            moment = triple(jnp.clip(x, -self.max_moment, self.max_moment) for x in moment)
        return cross(moment, field)


class ControlMomentGyro(AbstractTorque):
    """A single-gimbal control moment gyroscope: a wheel of constant momentum on a rotating axis.

    h(t) = momentum (cos(angle) spin + sin(angle) gimbal x spin) in body axes, and the torque on the
    body is N = -dh/dt - omega x h. The momenta of a trajectory do not include h.

    **Arguments:** ``momentum`` (...) [kg m^2/s]: of the wheel; ``gimbal`` (..., 3): axis of the
    gimbal, body axes; ``spin`` (..., 3): axis of the wheel at the angle zero, normal to the gimbal;
    both are normalised; ``angle``: of the gimbal [rad], a function of time [s] that JAX can
    differentiate, or a ``ph.Table``. The inertia of the gimbal is part of that of the body and
    assumed to be constant.

        gyro = ph.ControlMomentGyro(2.0, [0, 0, 1.0], [1.0, 0, 0], lambda t: 0.3 * jnp.sin(t))

    B. Wie, Space Vehicle Dynamics and Control, 2008, section 7.4. Raises ValueError for a spin axis
    that is not normal to the gimbal, TypeError or ValueError for another function.
    """

    momentum: Float[Array, "*#b"] = shaped()
    gimbal: Float[Array, "*#b 3"] = shaped(3)
    spin: Float[Array, "*#b 3"] = shaped(3)
    angle: Callable = shaped()

    def __init__(self, momentum: ArrayLike, gimbal: ArrayLike, spin: ArrayLike, angle: Callable):
        self.momentum = as_number("ControlMomentGyro momentum", momentum)
        axes = []
        for name, value in (("gimbal", gimbal), ("spin", spin)):
            axis = as_float_array(f"ControlMomentGyro {name}", value, (3,))
            axes.append(axis / jnp.sqrt(jnp.sum(axis**2, axis=-1, keepdims=True)))
        self.gimbal, self.spin = axes
        if is_concrete(self.gimbal, self.spin):
            along = np.sum(np.asarray(self.gimbal) * np.asarray(self.spin), axis=-1)
            require(
                np.abs(along) < 1e-6,
                f"the spin axis must be normal to the gimbal, got {spin} and {gimbal}.",
            )
        if isinstance(angle, AbstractPart) and callable(angle):
            check_kind("ControlMomentGyro angle", angle, None)
            self.angle = angle
        else:
            self.angle = Signature("ControlMomentGyro angle", {"t": ()}).checked(angle)

    def momentum_body(self, t: Array | float) -> Vector:
        """h(t) as body components [kg m^2/s]."""
        angle: Any = self.angle
        if isinstance(angle, AbstractPart):
            value = self.angle(t)
        else:
            value = Signature("ControlMomentGyro angle", {"t": ()}).mapped(angle, t)
        spin, across = components(self.spin), cross(components(self.gimbal), components(self.spin))
        c, s = self.momentum * jnp.cos(value), self.momentum * jnp.sin(value)
        return triple(c * a + s * b for a, b in zip(spin, across))

    def body_components(
        self, t: Array | float, attitude: Attitude, omega: Sequence[Array]
    ) -> tuple[Array, Array, Array]:
        t = jnp.asarray(t, omega[0].dtype)
        h, change = jax.jvp(self.momentum_body, (t,), (jnp.ones_like(t),))
        return triple(-a - b for a, b in zip(change, cross(omega, h)))
