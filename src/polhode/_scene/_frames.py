"""The frame that goes along with an orbit, and torques in it."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode import rotation
from polhode._batch import along_time
from polhode._checks import ArrayLike, as_float_array
from polhode._hamiltonian import Attitude, Vector, components
from polhode._parts import AbstractPart, shaped
from polhode._scene._orbit import AbstractOrbit, KeplerOrbit
from polhode._scene._torques import AbstractTorque, stacked, vector_of_time


class LVLH(AbstractPart):
    """Local vertical, local horizontal: x forward, y against the orbit's momentum, z to the centre.

    z points to the attracting centre, y is opposite to r x v, and x, in the plane of the orbit,
    completes them: on a circular orbit it is the direction of flight. As NASA's JEOD and the
    space shuttle used it; yaw, pitch and roll are the angles ZYX of the body in it.

    ``orbit``: ``ph.KeplerOrbit``, or a function of time [s] returning the position (3,) from the
    attracting centre [m], twice differentiable. Times are () or (..., T), with the axes of a batch
    of orbits first.

        frame = ph.LVLH(ph.KeplerOrbit(3.986004418e14, 6.8e6))
        state = ph.State(*frame.from_frame([1.0, 0, 0, 0], [0.0, 0, 0], 0.0))  # held in the frame
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
        found: Any = vector_of_time("LVLH", orbit)
        self.orbit = found

    def axes(self, t: Array) -> tuple[Float[Array, "*b 3"], ...]:
        """Unit vectors x, y, z of the frame in space, and its rates [rad/s] along them."""
        t = jnp.asarray(t)
        if isinstance(self.orbit, KeplerOrbit):
            r = self.orbit(t)
            momentum, normal = jnp.broadcast_to(self.orbit.momentum, r.shape), None
        else:  # what is no conic may leave its plane

            def moving(t):
                return jax.jvp(place, (t,), (jnp.ones_like(t),))

            place = self.orbit
            if not isinstance(place, AbstractOrbit):
                place = jnp.vectorize(place, signature="()->(n)")
            (r, v), (_, force) = jax.jvp(moving, (t,), (jnp.ones_like(t),))
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
        """Attitude body -> frame (..., 4), and rates of the body against the frame in body axes.

        From attitude (..., 4) body -> space and body rates (..., 3) [rad/s] at times ``t``.
        """
        wxyz, omega, frame, rates = self._given(wxyz, omega_body, t)
        relative = rotation.multiply(rotation.conjugate(frame), wxyz)
        return relative, omega - rotation.rotate(rotation.conjugate(relative), rates)

    def from_frame(
        self, wxyz: ArrayLike, omega_body: ArrayLike, t: ArrayLike
    ) -> tuple[Float[Array, "*b 4"], Float[Array, "*b 3"]]:
        """The inverse: attitude body -> space and body rates, ``ph.State(*frame.from_frame(...))``.

        From attitude (..., 4) body -> frame, and rates (..., 3) [rad/s] against the frame in body
        axes.
        """
        wxyz, omega, frame, rates = self._given(wxyz, omega_body, t)
        turned = omega + rotation.rotate(rotation.conjugate(wxyz), rates)
        return rotation.multiply(frame, wxyz), turned

    def yaw_pitch_roll(self, trajectory: Any) -> tuple[Array, Array, Array]:
        """Angles ZYX [rad] of a trajectory's body axes in the frame, each (..., T)."""
        frame = self
        if isinstance(self.orbit, AbstractOrbit):  # which may be one for each body
            frame = LVLH(along_time(self.orbit, len(trajectory.batch_shape)))
        wxyz, _ = frame.to_frame(trajectory.wxyz, trajectory.omega_body, trajectory._t)
        return rotation.wxyz_to_euler(wxyz, rotation.Sequence.ZYX)

    def _given(self, wxyz, omega_body, t):
        wxyz = rotation.normalise(as_float_array("wxyz", wxyz, (4,)))
        omega = as_float_array("omega_body", omega_body, (3,))
        t = as_float_array("t", t).astype(omega.dtype)
        frame, rates = self.attitude(t), self.omega(t)
        lead = jnp.broadcast_shapes(*(x.shape[:-1] for x in (wxyz, omega, frame, rates)))
        return tuple(jnp.broadcast_to(x, (*lead, x.shape[-1])) for x in (wxyz, omega, frame, rates))


@jax.jit  # one program, not one for each operation
def _axes(r: Array, momentum: Array, normal: Array | None) -> tuple[Array, ...]:
    """``LVLH.axes`` by the place, the angular momentum, and the force along that, if any."""
    size = jnp.linalg.norm(momentum, axis=-1, keepdims=True)
    distance = jnp.linalg.norm(r, axis=-1, keepdims=True)
    z, y = -r / distance, -momentum / size
    zero = jnp.zeros_like(distance)
    yawing = zero if normal is None else -distance * normal / size**2
    rates = jnp.concatenate([zero, -size / distance**2, yawing], axis=-1)
    return jnp.cross(y, z), y, z, rates


class RelativeTorque(AbstractTorque):
    """A torque computed from attitude and rates relative to an orbit frame.

    ``RelativeTorque(ph.LinearDamping(c), frame)`` damps the rates relative to the frame;
    ``RelativeTorque(ph.FeedbackTorque(fn), frame)`` passes the attitude body -> frame and the rates
    relative to the frame to ``fn``. A ``ph.SpaceTorque`` is then along the axes of the frame.

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

        def quaternion():  # dear, and asked for by few
            frame = rotation.matrix_to_wxyz(jnp.stack(axes, axis=-1))
            body = stacked(attitude.wxyz)
            frame = jnp.broadcast_to(rotation.conjugate(frame), body.shape)
            relative = rotation.multiply(frame, body)
            return tuple(relative[..., i] for i in range(4))

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

    def slip(
        self, t: Array | float, momentum: Sequence[Array], omega: Sequence[Array]
    ) -> Vector | None:
        return self.torque.slip(t, momentum, omega)
