"""Particles that move in a rotating frame under any force (docs/equations.md, 003: 20)."""

from collections.abc import Callable

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode._checks import (
    ArrayLike,
    as_float_array,
    is_concrete,
    require_positive,
    vectors_like,
)
from polhode._method import check_options, check_rtol, check_times
from polhode._parts import as_static, result_of, takes
from polhode.frames._frame import RotatingFrame, VariableRate
from polhode.rotation import conjugate, normalise, rotate
from polhode.rotation._quaternion import wxyz_rate

_ARGUMENTS = ("t", "position", "velocity")


def _force(name: str):
    def converted(function):
        takes(name, function, _ARGUMENTS)
        return as_static(function)

    return eqx.field(converter=converted)


class FrameForce(eqx.Module):
    """A force [N] in frame components, ``function(t, position, velocity)``, all (..., 3)."""

    function: Callable[[Array, Array, Array], Array] = _force("FrameForce")


class SpaceForce(eqx.Module):
    """A force [N] in space components, ``function(t, position_space, velocity_space)``.

    It needs the attitude of the frame at every step; a `FrameForce` does not.
    """

    function: Callable[[Array, Array, Array], Array] = _force("SpaceForce")


class ParticlePaths(eqx.Module):
    """Paths of particles in a rotating frame.

    **Fields:** ``ts`` (T,) [s]; ``position`` (..., T, 3) [m] and ``velocity`` (..., T, 3) [m/s] in
    frame components; ``frame``; ``successful``: whether the last time was reached; ``steps``.
    """

    ts: Float[Array, " t"]
    position: Float[Array, "*b t 3"]
    velocity: Float[Array, "*b t 3"]
    frame: RotatingFrame
    successful: Array
    steps: Array

    @property
    def position_space(self) -> Float[Array, "*b t 3"]:
        """Positions in space components [m]."""
        return self.frame.position_to_space(self.ts, self.position)

    @property
    def velocity_space(self) -> Float[Array, "*b t 3"]:
        """Velocities relative to space, in space components [m/s]."""
        return self.frame.velocity_to_space(self.ts, self.position, self.velocity)


def _pushed(force, t, position, velocity):
    """The force on all particles, checked to be one vector for each or one for all."""
    name, arguments = type(force).__name__, (t, position, velocity)

    def broadcast_force(*arguments):
        value = jnp.asarray(force.function(*arguments))
        return jnp.broadcast_to(value, position.shape) if value.shape == (3,) else value

    hint = "It receives all particles at one time."
    shape, dtype = position.shape, position.dtype
    return result_of(name, _ARGUMENTS, broadcast_force, shape, dtype, *arguments, hint=hint)


def _acceleration(frame, force, mass, t, position, velocity, wxyz):
    total = frame.apparent_acceleration(t, position, velocity, wxyz=wxyz)
    if force is None:
        return total
    if isinstance(force, FrameForce):
        return total + _pushed(force, t, position, velocity) / mass
    wxyz = frame.attitude(t) if wxyz is None else wxyz
    position_space = frame.position_to_space(t, position, wxyz=wxyz)
    velocity_space = frame.velocity_to_space(t, position, velocity, wxyz=wxyz)
    push = _pushed(force, t, position_space, velocity_space) / mass
    back = conjugate(wxyz).reshape((1,) * (push.ndim - 1) + (4,))
    return total + rotate(back, push)


def _size(vector: Array) -> Array:
    squared = jnp.sum(vector * vector, axis=-1, keepdims=True)
    positive = squared > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, squared, 1)), 0)


def _largest(tree) -> Array:
    """Error norm: the largest component of all particles."""
    return jnp.max(jnp.stack([jnp.max(jnp.abs(leaf)) for leaf in jax.tree.leaves(tree)]))


@eqx.filter_jit
def _solve(frame, force, mass, position, velocity, ts, rtol, solver, controller, adjoint, limit):
    turning = frame.turning
    needs_attitude = isinstance(force, SpaceForce) or frame.origin is not None
    # The attitude of a frame with a variable rate is integrated together with the particles.
    along = needs_attitude and isinstance(turning, VariableRate)
    start = turning.attitude(ts[0]) if along else None
    push = _acceleration(frame, force, mass, ts[0], position, velocity, start)
    # Units of length and speed of each particle: initial values plus the changes up to ``ts[1]``.
    step = jnp.abs(ts[1] - ts[0])
    length = _size(position) + step * _size(velocity) + step**2 * _size(push)
    length = jax.lax.stop_gradient(jnp.where(length > 0, length, jnp.ones_like(length)))
    speed = _size(velocity) + step * _size(push)
    speed = jax.lax.stop_gradient(jnp.where(speed > 0, speed, length / step))

    def field(t, y, _):
        at, speeds = y[0] * length, y[1] * speed
        wxyz = normalise(y[2]) if along else None
        pushed = _acceleration(frame, force, mass, t, at, speeds, wxyz)
        rates = (speeds / length, pushed / speed)
        return (*rates, wxyz_rate(wxyz, turning.omega_body(t))) if along else rates

    y0 = (position / length, velocity / speed)
    if controller is None:
        controller = diffrax.ClipStepSizeController(
            diffrax.PIDController(rtol=rtol, atol=rtol, norm=_largest), step_ts=ts
        )
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(field),
        solver,
        ts[0],
        ts[-1],
        None,
        (*y0, start) if along else y0,
        saveat=diffrax.SaveAt(ts=ts),
        stepsize_controller=controller,
        adjoint=adjoint,
        max_steps=limit,
        throw=False,
    )
    position, velocity = (jnp.moveaxis(x, 0, -2) for x in jax.tree.leaves(solution.ys)[:2])
    is_successful = solution.result == diffrax.RESULTS.successful
    position, velocity = position * length[..., None, :], velocity * speed[..., None, :]
    finite = jnp.isfinite(position).all() & jnp.isfinite(velocity).all()
    return position, velocity, is_successful & finite, solution.stats["num_steps"]


def simulate_particles(
    frame: RotatingFrame,
    position: Float[ArrayLike, "*#b 3"],
    velocity: Float[ArrayLike, "*#b 3"],
    ts: Float[ArrayLike, " t"],
    force: FrameForce | SpaceForce | None = None,
    mass: Float[ArrayLike, "*#b"] = 1.0,
    *,
    rtol: float | None = None,
    solver: diffrax.AbstractSolver | None = None,
    controller: diffrax.AbstractStepSizeController | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
    max_steps: int = 2**16,
    throw: bool = True,
) -> ParticlePaths:
    """Simulate particles in a rotating frame, with shared steps, by any diffrax solver.

    **Arguments:**

    - ``position`` [m], ``velocity`` [m/s]: at ``ts[0]``, frame components (..., 3).
    - ``ts``: (T,) [s], strictly increasing or strictly decreasing; each ends a step.
    - ``force``: None (a free particle), `FrameForce` or `SpaceForce` [N]; ``mass`` [kg], (...).
    - ``rtol``: error per step relative to each particle's own length and speed; None: 1e-9 in
      float64, 1e-5 in float32.
    - ``solver`` (Dopri8), ``controller``, ``adjoint``, ``max_steps``: as in diffrax.
    - ``throw``: raise RuntimeError when the last time was not reached. Nothing is raised under
      ``jit``, ``vmap`` or ``grad``: check ``ParticlePaths.successful``.

    Raises TypeError or ValueError for wrong kinds, shapes, dtypes, times or masses.
    """
    if not isinstance(frame, RotatingFrame):
        raise TypeError(f"frame must be a ph.RotatingFrame, got {type(frame).__name__}.")
    if not isinstance(force, FrameForce | SpaceForce | None):
        raise TypeError(
            f"force must be None, FrameForce(function) or SpaceForce(function), got"
            f" {type(force).__name__}: the class states the axes of the force."
        )
    solver = diffrax.Dopri8() if solver is None else solver
    check_options(solver, controller, adjoint, max_steps=max_steps)
    position = as_float_array("position", vectors_like(frame.turning, position, "position"), (3,))
    velocity = as_float_array("velocity", vectors_like(frame.turning, velocity, "velocity"), (3,))
    ts, mass = as_float_array("ts", ts, (None,)), as_float_array("mass", mass)
    leaves = (frame, position, velocity)
    dtypes = {x.dtype for x in jax.tree.leaves(eqx.filter(leaves, eqx.is_inexact_array))}
    if len(dtypes) != 1:
        raise TypeError(
            f"frame, position and velocity mix the dtypes {sorted(map(str, dtypes))}: make all of"
            " them one dtype."
        )
    dtype = position.dtype
    ts, mass = ts.astype(dtype), mass.astype(dtype)[..., None]
    if ts.ndim != 1:
        raise ValueError(f"ts must have shape (T,), got {ts.shape}: particles share their times.")
    check_times(ts)
    require_positive("mass", mass)
    batch = jnp.broadcast_shapes(position.shape, velocity.shape, (*mass.shape[:-1], 3))
    position, velocity = (jnp.broadcast_to(x, batch) for x in (position, velocity))
    mass = jnp.broadcast_to(mass, (*batch[:-1], 1))
    if 0 in batch:
        none = jnp.zeros((*batch[:-1], len(ts), 3), dtype)
        return ParticlePaths(ts, none, none, frame, jnp.ones((), bool), jnp.zeros((), int))
    *paths, steps = _solve(
        frame,
        force,
        mass,
        position,
        velocity,
        ts,
        check_rtol(rtol, dtype),
        solver,
        controller,
        diffrax.RecursiveCheckpointAdjoint() if adjoint is None else adjoint,
        max_steps,
    )
    paths_of_particles = ParticlePaths(ts, paths[0], paths[1], frame, paths[2], steps)
    if (
        throw
        and is_concrete(paths_of_particles.successful)
        and not bool(paths_of_particles.successful)
    ):
        raise RuntimeError(
            f"the last time was not reached in {int(steps)} steps or the path is not finite: look"
            " for a singular force, raise max_steps or rtol, or pass throw=False."
        )
    return paths_of_particles
