"""Rotating frames: attitude in time, transformations, apparent forces, and sensors fixed in a body.

Equations: docs/equations.md, 003.
"""

import abc
import functools
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode._checks import ArrayLike, as_float_array, batch_of, is_concrete, require, vectors_like
from polhode._parts import Signature, as_static, takes
from polhode._trajectory import Trajectory
from polhode.frames._sampled_attitude import SampledAttitude, motion_of_axes, rates_of_axes
from polhode.rotation import (
    conjugate,
    identity,
    matrix_to_wxyz,
    multiply,
    normalise,
    rotate,
    rotation_vector_to_wxyz,
)
from polhode.rotation._quaternion import wxyz_rate

Rates = tuple[Float[Array, "3"], Float[Array, "3"] | None]


def rate_of_change(function: Callable, t: Array) -> tuple[Array, Array]:
    """A function of time and its time derivative, by forward-mode differentiation."""
    return jax.jvp(function, (t,), (jnp.ones_like(t),))


class AbstractTurning(eqx.Module):
    """Attitude and angular velocity of a frame at one time ``t`` (a scalar)."""

    @property
    def dtype(self) -> Any:
        """Floating dtype of the frame's numbers; JAX's default for functions of time alone."""
        leaves = [x for x in jax.tree.leaves(self) if eqx.is_inexact_array(x)]
        return jnp.result_type(*leaves) if leaves else jnp.result_type(float)

    @abc.abstractmethod
    def rates(self, t: Array) -> Rates:
        """Angular velocity and its derivative [rad/s, rad/s^2]; None where it is always zero."""

    @abc.abstractmethod
    def attitude(self, t: Array) -> Float[Array, "4"]:
        """Unit quaternion, rotating axes -> space axes."""


class ConstantRate(AbstractTurning):
    """Constant angular velocity; attitude ``start`` at time ``t0``, in closed form."""

    omega_body: Float[Array, "3"]
    start: Float[Array, "4"]
    t0: Float[Array, ""]

    def rates(self, t):
        return self.omega_body, None

    def attitude(self, t):
        return multiply(self.start, rotation_vector_to_wxyz(self.omega_body * (t - self.t0)))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _turning(
    omega_body: Callable, t: Array, t0: Array, start: Array, wxyz: Array, *hoisted: Array
) -> Array:
    """The attitude ``wxyz`` at ``t``, with analytic derivatives by ``t`` and by the time ``t0`` of
    the attitude ``start``, from the angular velocity."""
    return wxyz


@_turning.defjvp
def _turning_rule(omega_body, primals, tangents):
    # Differentiated through the steps of the integration, they would be zero at t = t0, where there
    # is no step.
    t, t0, start, _, *hoisted = primals
    value = _turning(omega_body, *primals)
    rate = wxyz_rate(value, omega_body(t, *hoisted))
    # a later t0 omits the rotation between the earlier and the later one
    start_rate = wxyz_rate(start, omega_body(t0, *hoisted))
    rate_by_t0 = -multiply(multiply(start_rate, conjugate(start)), value)
    return value, tangents[3] + rate * tangents[0] + rate_by_t0 * tangents[1]


class VariableRate(AbstractTurning):
    """Angular velocity as a function of time; attitude ``start`` at ``t0``, by integration."""

    omega_body: Callable[[Array], Float[Array, "3"]]
    start: Float[Array, "4"]
    t0: Float[Array, ""]

    def rates(self, t):
        return rate_of_change(self.omega_body, t)

    def attitude(self, t):
        """One adaptive integration from ``t0``, with a tolerance of 50 rounding errors per step."""
        if t.weak_type:
            t = t.astype(self.t0.dtype)
        omega_body, hoisted = jax.closure_convert(self.omega_body, t)
        t0 = self.t0.astype(t.dtype)
        fixed = eqx.tree_at(lambda x: x.t0, self, jax.lax.stop_gradient(self.t0))
        integrated = _integrated(fixed, jax.lax.stop_gradient(t))
        return _turning(omega_body, t, t0, self.start, integrated, *hoisted)


@eqx.filter_jit  # compiled once per frame: outside jit diffrax would compile its loop at every call
def _integrated(turning: VariableRate, t: Array) -> Array:
    accuracy = 50 * float(jnp.finfo(turning.start.dtype).eps)
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda s, wxyz, _: wxyz_rate(wxyz, turning.omega_body(s))),
        diffrax.Dopri8(),
        turning.t0,
        t,
        None,
        turning.start,
        stepsize_controller=diffrax.PIDController(rtol=0.0, atol=accuracy),
        max_steps=2**14,
        adjoint=diffrax.RecursiveCheckpointAdjoint(),
    )
    (path,) = jax.tree.leaves(solution.ys)
    return normalise(path[-1])


class PrescribedAttitude(AbstractTurning):
    """Attitude as a function of time, a matrix (3, 3) or a quaternion (4,) of any scale."""

    function: Callable[[Array], Array]

    def rates(self, t):
        return rate_of_change(self._omega, t)

    def _omega(self, t):
        value, slope = rate_of_change(self.function, t)
        if value.ndim == 2:
            turn = value.T @ slope
            return (
                jnp.stack(
                    [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
                )
                / 2
            )
        return 2 * multiply(conjugate(value), slope)[1:] / jnp.sum(value * value)

    def attitude(self, t):
        value = self.function(t)
        return matrix_to_wxyz(value) if value.ndim == 2 else normalise(value)


Time = Float[ArrayLike, "*#b"]
Vector = Float[Array, "*#b 3"]


def _at_times(function: Callable, t: Time, dtype: Any):
    """A function of one time, evaluated at every entry of an array of times.

    Lists and integers are converted to ``dtype``.
    """
    times = as_float_array("t", t, finite=False)
    if not (isinstance(t, float) or jnp.issubdtype(getattr(t, "dtype", int), jnp.floating)):
        times = times.astype(dtype)
    if times.size == 0:  # an integration does not support empty batches
        like = jax.eval_shape(function, jax.ShapeDtypeStruct((), times.dtype))
        return jax.tree.map(lambda x: jnp.zeros((*times.shape, *x.shape), x.dtype), like)
    for _ in range(times.ndim):
        function = jax.vmap(function)
    return function(times)


def _cross(left: Array, right: ArrayLike) -> Array:
    return jnp.cross(*_aligned(left, vectors_like(left, right)))


def _aligned(*arrays: Array) -> list[Array]:
    """The arrays with leading axes of length one added, so that all have the same rank."""
    rank = max(array.ndim for array in arrays)
    return [array.reshape((1,) * (rank - array.ndim) + array.shape) for array in arrays]


def _sum(left: ArrayLike, right: Array) -> Array:
    return jnp.add(*_aligned(vectors_like(right, left), right))


def _origin(function):
    if function is None:
        return None
    return Signature("RotatingFrame origin", {"t": ()}, (3,)).checked(function)


class RotatingFrame(eqx.Module):
    """A rotating frame, ``x_space = origin + R x_frame`` (docs/equations.md, 003: 3).

    Built by `from_rate`, `from_attitude` or `from_trajectory`. Vectors have shape (..., 3), times
    are scalars or arrays that broadcast against the leading axes; "frame" components are along the
    rotating axes, "space" components along inertial ones. An object is a single frame: for a batch
    of frames use ``jax.vmap``. Terms that a frame lacks are not computed: a constant angular
    velocity has no Euler force, an origin at rest no origin force.

    ``turning`` gives attitude and rates; ``origin`` is None or a function of time that returns the
    position of the origin in space components [m], which is differentiated automatically.

    Methods of an ``eqx.Module`` contain its arrays, which ``jax.jit`` does not accept as constants:
    use ``eqx.filter_jit(frame.omega_body)(t)``, or pass the frame as an argument.
    """

    turning: AbstractTurning
    origin: Callable[[Array], Float[Array, "3"]] | None = eqx.field(default=None, converter=_origin)

    @classmethod
    def from_rate(
        cls,
        omega_body: Float[ArrayLike, "3"] | Callable[[Array], Float[Array, "3"]],
        origin: Callable[[Array], Float[Array, "3"]] | None = None,
        *,
        wxyz: Float[ArrayLike, "4"] | None = None,
        t0: float | Array = 0.0,
    ) -> "RotatingFrame":
        """From an angular velocity along the rotating axes [rad/s]: constant, or a function of t.

        ``wxyz`` is the attitude at ``t0``, by default the identity. With a function of time the
        attitude is integrated from ``t0`` at each evaluation.
        """
        varies = callable(omega_body)
        omega = None if varies else as_float_array("omega_body", omega_body, (3,))
        if omega is not None and omega.ndim != 1:
            raise ValueError(
                f"omega_body must have shape (3,), got {omega.shape}: a RotatingFrame is one"
                " frame; build a batch with jax.vmap(ph.RotatingFrame.from_rate)."
            )
        dtype = None if omega is None else omega.dtype
        if wxyz is None:
            start = identity((), dtype)
        else:
            start = normalise(as_float_array("wxyz", wxyz, (4,)))
        t0 = jnp.asarray(t0, start.dtype)
        if varies:
            omega_body = Signature("RotatingFrame.from_rate", {"t": ()}, (3,)).checked(omega_body)
            return cls(VariableRate(omega_body, start, t0), origin)
        return cls(ConstantRate(omega, start, t0), origin)

    @classmethod
    def from_attitude(
        cls,
        attitude: Callable[[Array], Array],
        origin: Callable[[Array], Float[Array, "3"]] | None = None,
    ) -> "RotatingFrame":
        """From the attitude as a function of time: a matrix R(t) (3, 3) or a quaternion (4,).

        Angular velocity and acceleration are computed from it by forward-mode differentiation.
        """
        if not callable(attitude):
            raise TypeError(
                f"attitude must be a function of time, got {type(attitude).__name__}: for a frame"
                " of constant angular velocity use RotatingFrame.from_rate."
            )
        name = "RotatingFrame.from_attitude"
        takes(name, attitude, ("t",))
        attitude = as_static(attitude)
        t = jax.ShapeDtypeStruct((), jnp.result_type(float), weak_type=True)
        shapes: list[tuple[int, ...]] = []

        def record_shape(t):
            value = attitude(t)
            shapes.append(() if value is None else jnp.shape(value))

        jax.eval_shape(record_shape, t)
        shape = (3, 3) if shapes == [(3, 3)] else (4,)
        return cls(PrescribedAttitude(Signature(name, {"t": ()}, shape).checked(attitude)), origin)

    @classmethod
    def from_trajectory(
        cls,
        trajectory: Trajectory,
        origin: Callable[[Array], Float[Array, "3"]] | None = None,
    ) -> "RotatingFrame":
        """The body axes of one simulated body.

        Attitude, rate and angular acceleration are exact at the samples and interpolated between
        them with errors O(h^6), O(h^5), O(h^4) for samples h apart (`SampledAttitude`). Of a body
        with a ``ph.EnergySink`` the rates are those at which its axes rotate, slip included.
        Raises ValueError for a batch of bodies, missing attitudes or rates, or samples half a
        revolution or more apart.
        """
        wxyz = trajectory.wxyz
        if wxyz.ndim != 2:
            raise ValueError(
                f"the trajectory holds a batch of bodies of shape {wxyz.shape[:-2]}: choose one"
                " body, or build the frames under jax.vmap."
            )
        ts = trajectory.ts
        if ts.shape[0] < 2:
            raise ValueError(
                f"the trajectory has {ts.shape[0]} sample: two at least are needed to interpolate."
            )
        omega, acceleration = motion_of_axes(trajectory)
        if is_concrete(ts, omega):
            speed = np.linalg.norm(np.asarray(omega), axis=-1)
            turn = np.abs(np.diff(np.asarray(ts))) * np.maximum(speed[1:], speed[:-1])
            require(
                np.all(turn < np.pi),
                f"the body turns by up to {turn.max():.3g} rad between samples; less than pi is"
                " needed to interpolate: pass more times to ph.simulate.",
            )
        return cls(PrescribedAttitude(SampledAttitude(ts, wxyz, omega, acceleration)), origin)

    # --- the frame itself -------------------------------------------------------------------------

    @property
    def is_uniform(self) -> bool:
        """Whether the angular velocity is constant (static), so that there is no Euler force."""
        return isinstance(self.turning, ConstantRate)

    def attitude(self, t: Time) -> Float[Array, "*b 4"]:
        """Unit quaternion, frame -> space."""
        return _at_times(self.turning.attitude, t, self.turning.dtype)

    def omega_body(self, t: Time) -> Float[Array, "*b 3"]:
        """Angular velocity in frame components [rad/s]."""
        return self._rates(t)[0]

    def angular_acceleration(self, t: Time) -> Float[Array, "*b 3"]:
        """Derivative of the angular velocity in frame components [rad/s^2]."""
        omega, slope = self._rates(t)
        return jnp.zeros_like(omega) if slope is None else slope

    def _rates(self, t: Time) -> tuple[Array, Array | None]:
        if self.is_uniform:
            omega, slope = self.turning.rates(t)
            return jnp.broadcast_to(omega, (*jnp.shape(t), 3)), slope
        return _at_times(self.turning.rates, t, self.turning.dtype)

    def _origin(self, t: Time) -> tuple[Array, Array, Array]:
        """Position, velocity and acceleration of the origin in space components."""
        origin = self.origin
        if origin is None:
            raise ValueError("the origin of this frame does not move: it was given none.")

        def motion_at(time):
            def velocity(s):
                return rate_of_change(origin, s)[1]

            return origin(time), *rate_of_change(velocity, time)

        return _at_times(motion_at, t, self.turning.dtype)

    def _rotate_to_space(self, t: Time, vector: Array, wxyz: Array | None = None) -> Array:
        wxyz = self.attitude(t) if wxyz is None else wxyz
        return rotate(*_aligned(wxyz, vectors_like(wxyz, vector)))

    def _rotate_to_frame(self, t: Time, vector: Array, wxyz: Array | None = None) -> Array:
        wxyz = self.attitude(t) if wxyz is None else wxyz
        return rotate(*_aligned(conjugate(wxyz), vectors_like(wxyz, vector)))

    # --- transformations, both ways (docs/equations.md, 003: 4-19) -----------------------

    def position_to_space(self, t: Time, position: Vector, *, wxyz: ArrayLike = None) -> Vector:
        """Space position [m] of a point at frame ``position``. ``wxyz``: the attitude if known."""
        space_vector = self._rotate_to_space(t, position, wxyz)
        return space_vector if self.origin is None else _sum(space_vector, self._origin(t)[0])

    def position_to_frame(self, t: Time, position_space: Vector) -> Vector:
        """Frame position [m] of a point in space."""
        if self.origin is not None:
            position_space = _sum(position_space, -self._origin(t)[0])
        return self._rotate_to_frame(t, position_space)

    def velocity_to_space(
        self, t: Time, position: Vector, velocity: Vector, *, wxyz: ArrayLike = None
    ) -> Vector:
        """Space velocity [m/s] of a point with frame position and velocity (003: 8)."""
        carried = _sum(velocity, _cross(self.omega_body(t), position))
        space_vector = self._rotate_to_space(t, carried, wxyz)
        return space_vector if self.origin is None else _sum(space_vector, self._origin(t)[1])

    def velocity_to_frame(self, t: Time, position_space: Vector, velocity_space: Vector) -> Vector:
        """Frame velocity [m/s] of a point with space position and velocity."""
        position = self.position_to_frame(t, position_space)
        if self.origin is not None:
            velocity_space = _sum(velocity_space, -self._origin(t)[1])
        relative = self._rotate_to_frame(t, velocity_space)
        return _sum(relative, -_cross(self.omega_body(t), position))

    def acceleration_to_space(
        self, t: Time, position: Vector, velocity: Vector, acceleration: Vector
    ) -> Vector:
        """Space acceleration [m/s^2] of a point with this motion in the frame (003: 19)."""
        apparent = self._without_origin(t, position, velocity)
        space_vector = self._rotate_to_space(t, _sum(acceleration, -apparent))
        return space_vector if self.origin is None else _sum(space_vector, self._origin(t)[2])

    def acceleration_to_frame(
        self, t: Time, position_space: Vector, velocity_space: Vector, acceleration_space: Vector
    ) -> Vector:
        """Frame acceleration [m/s^2] of a point with this motion in space."""
        position = self.position_to_frame(t, position_space)
        velocity = self.velocity_to_frame(t, position_space, velocity_space)
        if self.origin is not None:
            acceleration_space = _sum(acceleration_space, -self._origin(t)[2])
        relative = self._rotate_to_frame(t, acceleration_space)
        return _sum(relative, self._without_origin(t, position, velocity))

    # --- forces by name (docs/equations.md, 003: 20, 21) ---------------------------------

    def centrifugal(self, t: Time, position: Vector, mass: Float[ArrayLike, "*#b"] = 1.0) -> Vector:
        """Centrifugal force [N], ``-mass omega x (omega x r)``; zero on the rotation axis."""
        omega = self.omega_body(t)
        return _times(mass, -_cross(omega, _cross(omega, position)))

    def coriolis(self, t: Time, velocity: Vector, mass: Float[ArrayLike, "*#b"] = 1.0) -> Vector:
        """Coriolis force [N], ``-2 mass omega x v``."""
        return _times(mass, -2 * _cross(self.omega_body(t), velocity))

    def euler(self, t: Time, position: Vector, mass: Float[ArrayLike, "*#b"] = 1.0) -> Vector:
        """Euler force [N], ``-mass d(omega)/dt x r``; zero for a constant rate."""
        omega, slope = self._rates(t)
        if slope is None:
            return _no_force(mass, omega, vectors_like(omega, position))
        return _times(mass, -_cross(slope, position))

    def origin_force(self, t: Time, mass: Float[ArrayLike, "*#b"] = 1.0) -> Vector:
        """Apparent force of an accelerated origin [N], ``-mass R^T d2(origin)/dt2``."""
        if self.origin is None:
            return _no_force(mass, self.omega_body(t))
        return _times(mass, -self._rotate_to_frame(t, self._origin(t)[2]))

    def _without_origin(self, t: Time, position: Vector, velocity: Vector | None) -> Vector:
        omega, slope = self._rates(t)
        carried = _cross(omega, position)
        if velocity is not None:
            carried = _sum(2 * vectors_like(carried, velocity), carried)
        turning = -_cross(omega, carried)
        return turning if slope is None else _sum(turning, -_cross(slope, position))

    def apparent_acceleration(
        self, t: Time, position: Vector, velocity: Vector | None = None, *, wxyz: ArrayLike = None
    ) -> Vector:
        """Sum of the apparent forces per unit mass [m/s^2]; ``velocity`` None: at rest in it.

        Only the terms that this frame has are computed. ``wxyz``: the attitude at ``t``, if known.
        """
        apparent = self._without_origin(t, position, velocity)
        if self.origin is None:
            return apparent
        return _sum(apparent, -self._rotate_to_frame(t, self._origin(t)[2], wxyz))


def _no_force(mass: ArrayLike, *vectors: Array) -> Array:
    """Zeros of the shape of a force that depends on these vectors."""
    masses = as_float_array("mass", mass)
    shape = np.broadcast_shapes((*masses.shape, 3), *(x.shape for x in vectors))
    return jnp.zeros(shape, vectors[-1].dtype)


def _times(mass: ArrayLike, vector: Array) -> Array:
    return jnp.multiply(*_aligned(jnp.asarray(mass, vector.dtype)[..., None], vector))


@eqx.filter_jit
def angular_acceleration(trajectory: Trajectory) -> Float[Array, "*b t 3"]:
    """Derivative (..., T, 3) of the body rates [rad/s^2] by the equations of motion.

    The body rates are ``Trajectory.omega_body``, without the slip of a ``ph.EnergySink``.
    """
    scene, t = trajectory._scene, trajectory._t
    omega = trajectory.omega_body
    wxyz = None if trajectory.scene.is_free else trajectory.wxyz
    return scene.acceleration(wxyz, omega, t)


def gyroscope(trajectory: Trajectory) -> Float[Array, "*b t 3"]:
    """Reading (..., T, 3) of a gyroscope along the body axes [rad/s], wherever it is mounted.

    These are the body rates, and with a ``ph.EnergySink`` the slip as well.
    """
    if trajectory.scene.torque is None:
        return trajectory.omega_body
    return rates_of_axes(trajectory)


def accelerometer(
    trajectory: Trajectory,
    position_body: Float[ArrayLike, "*#b 3"],
    gravity_space: Float[ArrayLike, "3"] | None = None,
) -> Float[Array, "*b t 3"]:
    """Reading (..., T, 3) of an accelerometer along body axes [m/s^2], at ``position_body`` [m].

    The reading is acceleration minus gravity:
    ``omega x (omega x r) + d(omega)/dt x r - R^T gravity`` (docs/equations.md, 003: 17-21), with
    the lever arm r from the point about which the body rotates. ``gravity_space`` (3,) [m/s^2] is
    for a body that rotates about a point fixed in space; leave it None for a body in free fall,
    where gravity and the acceleration of the mass centre cancel. Leading axes of positions
    broadcast against the bodies: (n, 3) are n positions on one body. The rates are those of
    ``gyroscope``.

    Raises ValueError if the trajectory has no rates (or no attitude where it is needed), or for
    positions whose leading axes do not broadcast against the bodies.
    """
    omega, acceleration = motion_of_axes(trajectory)
    lever = as_float_array("position_body", position_body, (3,)).astype(omega.dtype)
    batch = batch_of(position_body=(lever, 1), omega_body=(omega, 2))

    def of_batch(samples):
        return jnp.broadcast_to(samples, (*batch, *omega.shape[-2:]))

    lever, omega_of_batch = of_batch(lever[..., None, :]), of_batch(omega)
    acceleration = of_batch(acceleration)
    reading = jnp.cross(omega_of_batch, jnp.cross(omega_of_batch, lever))
    reading = reading + jnp.cross(acceleration, lever)
    if gravity_space is None:
        return reading
    gravity = as_float_array("gravity_space", gravity_space, (3,)).astype(omega.dtype)
    down = jnp.broadcast_to(gravity, omega.shape)
    return reading - of_batch(rotate(conjugate(trajectory.wxyz), down))
