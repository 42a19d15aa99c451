"""The two coordinate systems (*charts*) of the equations of motion: Lie-Poisson and Euler angles.

A chart defines the state and its vector field, which is derived from the same Hamiltonian. The
field is that of one body, written in components; bodies are the entries of these arrays.
"""

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from polhode import rotation
from polhode._closed_forms._lagrange_top import upward
from polhode._failed import numbers
from polhode._hamiltonian import (
    Attitude,
    Dynamics,
    FixedUnits,
    LiePoissonCostate,
    LiePoissonUnits,
    Vector,
    canonical_from_momentum,
    components,
    euler_angle_field,
    external_power,
    from_euler_angles,
    from_quaternion,
    lie_poisson_field,
    momentum_from_canonical,
    motor_powers,
)
from polhode._kernels import underivable
from polhode._scene import (
    AbstractPotential,
    AlongZ,
    GravityGradient,
    Scene,
    State,
    UniformGravity,
)
from polhode.inertia import Inertia
from polhode.inertia._inertia import inertia_at
from polhode.rotation import euler_to_wxyz, wxyz_to_euler


class AbstractChart(eqx.Module):
    """Base of the charts. A state is two groups of component arrays (N,); with coupled wheels a
    third group contains the momenta of the wheels.

    ``canonical``: whether the two groups are coordinates and their conjugate momenta.
    """

    canonical: ClassVar[bool] = False

    @abc.abstractmethod
    def field(self, t, y, dynamics: Dynamics) -> PyTree[Array]:
        """Rates of the state."""

    @abc.abstractmethod
    def momentum_and_attitude(self, y: PyTree[Array]) -> tuple[Vector, Attitude]:
        """Body momentum [kg m^2/s] and attitude."""

    @abc.abstractmethod
    def dynamics(self, scene: Scene, state: State, ts: Array) -> Dynamics:
        """Hamiltonian, torques and wheels of the lanes, with the natural units of their states."""

    @abc.abstractmethod
    def start(self, scene: Scene, state: State, t: Array) -> tuple[PyTree[Array], Array]:
        """Initial state of lanes, and which of them the chart can represent.

        A lane that it cannot represent starts from a regular state instead, so that it does not
        delay the others; its samples are NaN and its status is ``CHART_SINGULAR``.
        """

    @abc.abstractmethod
    def finish(self, scene: Scene, y: PyTree[Array], t: Array) -> tuple[Array, Array, Array]:
        """wxyz, omega_body and whether the chart is regular there, of sampled components (N, T)."""

    def field_and_power(self, t, y, dynamics: Dynamics):
        """The field, and as an additional group the power [W] of the forces that are not
        conservative: the total, then that of every wheel whose speed is not prescribed."""
        *state, _ = y
        instant_dynamics, pose = dynamics.at(*state[2:]), self.momentum_and_attitude(state[:2])
        powers = (external_power(t, *pose, instant_dynamics),)
        if instant_dynamics.wheels is not None:
            powers += tuple(motor_powers(t, *pose, instant_dynamics, instant_dynamics.wheels.loose))
        return *self.field(t, tuple(state), dynamics), powers


class LiePoissonChart(AbstractChart):
    """Body momentum and unit quaternion: free of singularities.

    ``upright``: in a space frame whose z axis is along the scene's ``UniformGravity`` or the
    constant position of its ``GravityGradient``, which must not vanish. The field then depends on
    one row of R only, a third of the work.
    """

    upright: bool = eqx.field(static=True, default=False)

    def field(self, t, y, dynamics):
        return lie_poisson_field(t, y, dynamics)

    def momentum_and_attitude(self, y):
        return y[0], from_quaternion(y[1])

    def dynamics(self, scene, state, ts):
        lane = state.wxyz[..., 0]
        size = jnp.trace(_first_inertia(scene, ts).tensor, axis1=-2, axis2=-1) / 3
        min_momentum = slow_momentum(scene, ts)
        size, min_momentum, _ = jax.lax.stop_gradient(
            jnp.broadcast_arrays(size, min_momentum, lane)
        )
        scene_dynamics = scene.dynamics
        units = LiePoissonUnits(size, min_momentum, len(scene_dynamics.coupled))
        if self.upright:
            _, potential = _upright(scene.potential)
            scene = Scene(scene.inertia, potential, scene.torque, scene.rotors)
        costate = None if scene_dynamics.coupled else LiePoissonCostate.of
        return Dynamics(scene.hamiltonian, scene.torque, units, costate, scene_dynamics.wheels)

    def start(self, scene, state, t):
        momentum = scene.momentum(state.omega_body, t)
        wxyz = state.wxyz
        if self.upright:
            frame_rotation, _ = _upright(scene.potential)
            frame_rotation = jnp.broadcast_to(rotation.conjugate(frame_rotation), wxyz.shape)
            wxyz = rotation.multiply(frame_rotation, wxyz)
        y = components(momentum), jnp.unstack(wxyz, axis=-1), *_spins(scene, state)
        return y, jnp.ones(wxyz.shape[0], bool)

    def finish(self, scene, y, t):
        momentum, wxyz, *spins = _as_numbers(y)
        omega = scene.with_spins(*(jnp.unstack(x, axis=-1) for x in spins)).rates(momentum, t)
        if self.upright:
            frame_rotation, _ = _upright(scene.potential)
            wxyz = _rotate(frame_rotation, wxyz)
        return rotation.normalise(wxyz), omega, jnp.ones(momentum.shape[:-1], bool)


def _as_numbers(y: PyTree[Array]) -> list[Array]:
    """The groups of a state as arrays (..., n). In programs of derivatives, NaN is replaced by
    numbers: see ``_failed``."""
    return [numbers(jnp.stack(group, axis=-1), 1.0) for group in y]


def _rotate(frame_rotation: Array, wxyz: Array) -> Array:
    """Product of one quaternion (..., 1, 4) with many (..., T, 4), as a matrix product by columns:
    for many times this takes half as long as ``rotation.multiply``."""
    a, b, c, d = jnp.unstack(frame_rotation, axis=-1)
    columns = ((a, b, c, d), (-b, a, d, -c), (-c, -d, a, b), (-d, c, -b, a))
    w, x, y, z = (
        jnp.stack(column, axis=-1) * wxyz[..., i, None] for i, column in enumerate(columns)
    )
    return w + x + y + z


def _spins(scene: Scene, state: State) -> tuple[tuple[Array, ...], ...]:
    """Momenta of the coupled wheels as an additional group of the state; () if there are none."""
    wheels = scene.dynamics.wheels
    if wheels is None or not wheels.coupled:
        return ()
    return (wheels.initial_spins(state.wxyz[..., 0]),)


def _upright(field: UniformGravity | GravityGradient) -> tuple[Array, AbstractPotential]:
    """Rotation (..., 4) from a frame with z along the field to space, and the field in that
    frame."""
    if isinstance(field, GravityGradient):
        (w, x, y), size = upward(components(field.position_space))
    else:
        gravity = components(field.gravity_space)
        (w, x, y), size = upward(gravity)
        # If gravity is zero any axis is valid, but derivatives by components perpendicular to the
        # chosen one are then not defined by these formulas: they become NaN.
        is_zero = jnp.all(field.gravity_space == 0, axis=-1)
        size = size + sum(underivable(g, is_zero) - g for g in gravity[:2])
        size = jnp.multiply(*jnp.broadcast_arrays(field.mass, size))
    frame_rotation = jnp.stack([w, x, y, jnp.zeros_like(w)], axis=-1)
    return frame_rotation, AlongZ(field, size)


class EulerChart(AbstractChart):
    """ZYZ Euler angles and their momenta, canonical; singular where theta is 0 or pi."""

    canonical: ClassVar[bool] = True

    def field(self, t, y, dynamics):
        return euler_angle_field(t, y, dynamics)

    def momentum_and_attitude(self, y):
        return momentum_from_canonical(*y), from_euler_angles(*y[0])

    def dynamics(self, scene, state, ts):
        momenta = 1 / momentum_scale(scene, state, ts)
        ones, scene_dynamics = jnp.ones_like(momenta), scene.dynamics
        units = FixedUnits((ones,) * 3 + (momenta,) * (3 + len(scene_dynamics.coupled)))
        return Dynamics(scene.hamiltonian, scene.torque, units, wheels=scene_dynamics.wheels)

    def start(self, scene, state, t):
        phi, theta, psi = q = wxyz_to_euler(state.wxyz)
        is_regular = _away_from_poles(q)
        q = (phi, jnp.where(is_regular, theta, jnp.pi / 2), psi)
        momentum = components(scene.momentum(state.omega_body, t))
        p = canonical_from_momentum(q, momentum)
        return (q, tuple(jnp.where(is_regular, x, 0) for x in p), *_spins(scene, state)), is_regular

    def finish(self, scene, y, t):
        q, p, *spins = (jnp.unstack(x, axis=-1) for x in _as_numbers(y))
        momentum = jnp.stack(momentum_from_canonical(q, p), axis=-1)
        omega = scene.with_spins(*spins).rates(momentum, t)
        return euler_to_wxyz(*q), omega, _away_from_poles(q)


def _away_from_poles(q) -> Array:
    """Whether at least half of the digits are correct (rounding errors grow like 1/sin theta)."""
    theta = q[1]
    return jnp.abs(jnp.sin(theta)) > jnp.sqrt(jnp.finfo(theta.dtype).eps)


def momentum_scale(scene: Scene, state: State, ts: Array) -> Array:
    """Natural unit of momentum of each lane: the root of the sum of the squares of |L|, of the
    momenta of coupled wheels, of the momentum that the initial torque produces within about one
    radian, and of ``slow_momentum``."""
    t = ts[..., 0]
    momentum, spins = scene.momentum(state.omega_body, t), _spins(scene, state)
    y = (components(momentum), jnp.unstack(state.wxyz, axis=-1), *spins)
    momentum_rates, *_ = lie_poisson_field(t, y, scene.dynamics)
    size = jnp.trace(_first_inertia(scene, ts).tensor, axis1=-2, axis2=-1)
    square = jnp.sum(momentum**2, axis=-1) + sum((x * x for group in spins for x in group), start=0)
    square = square + size * jnp.sqrt(sum(x * x for x in momentum_rates))
    square = square + slow_momentum(scene, ts) ** 2
    is_resting = square == 0
    return jax.lax.stop_gradient(
        jnp.where(is_resting, 1, jnp.sqrt(jnp.where(is_resting, 1, square)))
    )


def _first_inertia(scene: Scene, ts: Array) -> Inertia:
    """The inertia of lanes at their first time."""
    return inertia_at(scene.inertia, ts[..., 0])


def slow_momentum(scene: Scene, ts: Array) -> Array:
    """Momentum of a body that rotates by one radian in the time simulated: a unit for a body at
    rest, which a torque may accelerate later. Zero if the time span is zero."""
    span = jnp.abs(ts[..., -1] - ts[..., 0])
    size = jnp.trace(_first_inertia(scene, ts).tensor, axis1=-2, axis2=-1) / 3
    return jax.lax.stop_gradient(jnp.where(span > 0, size / jnp.where(span > 0, span, 1), 0))


def natural_rates(scene: Scene, state: State, ts: Array) -> Array:
    """Rates [rad/s] of lanes, by which they are sorted so that similar steps are in one chunk."""
    carrier = scene.carrier_at(ts[..., 0])
    slowest = jnp.min(jnp.broadcast_to(carrier.moments, (state.wxyz.shape[0], 3)), -1)
    size = jnp.linalg.norm(state.omega_body, axis=-1)
    return jax.lax.stop_gradient(jnp.maximum(momentum_scale(scene, state, ts) / slowest, size))
