"""Control laws: pointing and rate damping, and a magnetic dipole in a field."""

from collections.abc import Callable, Sequence
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode import rotation
from polhode._checks import ArrayLike, as_float_array, as_number, is_concrete, require
from polhode._hamiltonian import Attitude, components, cross, triple
from polhode._parts import AbstractPart, Signature, shaped
from polhode._scene._tables import Table
from polhode._scene._torques import AbstractTorque, coefficients, stacked, value_at, vector_of_time


class Pointing(AbstractTorque):
    """A PD control law for the attitude: N = -2 kp e - kd omega in body axes.

    e is the vector part of the quaternion from the attitude ``target`` to that of the body, of the
    sign of the shorter rotation: for small angles the torque is kp times the angle.

    **Arguments:** ``kp`` [N m/rad] and ``kd`` [N m s], (..., 3) or (...) for the same about every
    axis, not negative; ``target`` (..., 4): ``wxyz`` body -> space. At exactly half a revolution
    the direction is undefined.

        law = ph.Pointing(kp=0.3, kd=0.8)
        scene = ph.Scene(ph.Inertia.from_moments([1.0, 1.5, 2.0]), torque=law)

    Raises ValueError for negative gains or a zero quaternion.
    """

    smooth: ClassVar[bool] = False  # the shorter way to the target changes at half a turn

    kp: Float[Array, "*#b 3"] = shaped(3)
    kd: Float[Array, "*#b 3"] = shaped(3)
    target: Float[Array, "*#b 4"] = shaped(4)

    def __init__(self, kp: ArrayLike, kd: ArrayLike, target: ArrayLike = (1.0, 0.0, 0.0, 0.0)):
        self.kp, self.kd = coefficients("Pointing kp", kp), coefficients("Pointing kd", kd)
        wanted = as_float_array("Pointing target", target, (4,))
        if is_concrete(wanted):
            require(
                np.any(np.asarray(wanted) != 0, axis=-1),
                lambda: f"target must not be zero, got {target}.",
            )
        self.target = rotation.normalise(wanted)

    def body_components(
        self, t: Array | float, attitude: Attitude, omega: Sequence[Array]
    ) -> tuple[Array, Array, Array]:
        a, *b = (self.target[..., i] for i in range(4))
        w, *v = attitude.wxyz
        scalar = a * w + b[0] * v[0] + b[1] * v[1] + b[2] * v[2]
        turned = cross(b, v)
        sign = 2 * jnp.where(scalar < 0, -1, 1).astype(w.dtype)
        error = (sign * (a * y - w * x - z) for x, y, z in zip(b, v, turned))
        kp, kd = components(self.kp), components(self.kd)
        return triple(-p * e - d * rate for p, d, e, rate in zip(kp, kd, error, omega))


class RateDamping(AbstractTorque):
    """A control law for the body rates: N = -c (omega - rates) in body axes.

    ``c`` (..., 3), or (...) for the same about every axis [N m s], not negative; ``rates`` (..., 3)
    [rad/s]. Raises ValueError for a negative c.
    """

    c: Float[Array, "*#b 3"] = shaped(3)
    rates: Float[Array, "*#b 3"] = shaped(3)

    def __init__(self, c: ArrayLike, rates: ArrayLike = (0.0, 0.0, 0.0)):
        self.c = coefficients("RateDamping c", c)
        self.rates = as_float_array("RateDamping rates", rates, (3,))

    def body_components(
        self, t: Array | float, attitude: Attitude, omega: Sequence[Array]
    ) -> tuple[Array, Array, Array]:
        pairs = zip(components(self.c), omega, components(self.rates))
        return triple(-c * (rate - wanted) for c, rate, wanted in pairs)


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
    ``position``: where the body is [m], space axes, constant (..., 3), a function of time or an
    orbit such as ``ph.KeplerOrbit``, for a field that is a function.

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
        position: ArrayLike | Callable = (0.0, 0.0, 0.0),
    ):
        self.moment = (
            _MOMENT.checked(moment)
            if callable(moment)
            else as_float_array(_MOMENT.name, moment, (3,))
        )
        if isinstance(field, Table):
            self.field = field
        elif callable(field):
            self.field = _FIELD.checked(field)
        else:
            self.field = as_float_array(_FIELD.name, field, (3,))
        self.position = vector_of_time("MagneticDipole position", position)

    def body_components(
        self, t: Array | float, attitude: Attitude, omega: Sequence[Array]
    ) -> tuple[Array, Array, Array]:
        field, moment = self.field_body(t, attitude), self.moment
        if callable(moment):
            moment = _MOMENT.mapped(moment, t, stacked(omega), stacked(field))
        return cross(components(moment), field)

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
    """Magnetic moment that detumbles a body: m = k omega x B [A m^2], -k times the rate of B.

    In body axes a field that hardly changes in space changes by B x omega. ``k`` [A m^2 s/T] (a
    number, a leaf that gradients tune); ``max_moment`` [A m^2]: limit of each of
    three rods, or None.
    For ``ph.MagneticDipole``: the torque is -k |B|^2 times the part of omega normal to B.
    """

    k: Array
    max_moment: Array | None

    def __init__(self, k: ArrayLike, max_moment: ArrayLike | None = None):
        self.k = as_number("BDot k", k)
        self.max_moment = None if max_moment is None else as_number("BDot max_moment", max_moment)

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
        return 1e-7 * (3 * n * jnp.sum(n * self.moment) - self.moment) / size**3
