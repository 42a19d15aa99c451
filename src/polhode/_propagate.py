"""The prediction step of a filter: the next state, with the Jacobian of the exact flow."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from polhode import rotation
from polhode._checks import ArrayLike, as_float_array, is_concrete, numbers, require
from polhode._integrate._field import uses
from polhode._kernels import jit_distinct
from polhode._method import (
    AbstractMethod,
    Status,
    check_inputs,
    check_kinds,
    check_rtol,
    raise_on_failure,
)
from polhode._plan import choose
from polhode._sampled import is_sampled
from polhode._scene import BodyTorque, Scene, State, Wheels
from polhode._scene._scene import places_of
from polhode._simulate import simulate

_NODES = 8
"""Gauss points of each part of a step, for the integral of the effect of a disturbance on a motion
in closed form. The error falls with the 16th power of the angle of rotation in a part: for a third
of a revolution it is 1e-12 of the effect."""

_MOST_PARTS = 1024
"""Maximum number of parts of a step; the memory is proportional to it."""

_TURN = np.pi
"""Maximum angle [rad] of rotation in a part, by the largest body rate. With twice this angle the
relative error of the effect is up to 2e-7."""


_ROUNDED = 1e-2
"""Maximum relative change of the length of a step by rounding of the time."""


class Propagation(NamedTuple):
    """One step of ``ph.propagate``, with n = 6 + w + p tangent coordinates.

    ``state``: at the end of the step, the speeds of all wheels in its ``wheel_speed`` where w > 0,
    so that the next step continues from it; ``jacobian`` (n, n): derivatives of the tangent
    coordinates at the end with respect to those at the start; ``noise`` (n, 3): derivatives of the
    coordinates at the end with respect to a constant disturbance torque [N m] in body axes.
    """

    state: State
    jacobian: Float[Array, "n n"]
    noise: Float[Array, "n 3"]


def propagate(
    scene: Scene,
    state: State,
    dt: Float[ArrayLike, ""],
    *,
    t: Float[ArrayLike, ""] = 0.0,
    free: Callable[[Any], Any] | None = None,
    method: AbstractMethod | None = None,
    rtol: float | None = None,
) -> Propagation:
    """The state ``dt`` [s] after ``t``, the Jacobian of the flow, and the effect of disturbances.

    The n = 6 + w + p tangent coordinates are, in this order,

    - the error rotation vector (3,) [rad] in body axes: the true attitude is ``q * exp(error)``,
      with ``rotation.multiply`` and ``rotation.rotation_vector_to_wxyz``;
    - the errors of the body rates (3,) [rad/s];
    - the errors of the speeds relative to the body (w,) [rad/s] of the wheels without a prescribed
      speed (``ph.Rotor`` with ``torque``, ``impulse`` or ``coupling``), in the order of the rotors.
      Held wheels have no coordinate;
    - the errors of the p parameters, which do not change.

    The speeds are those of ``state.wheel_speed``, or of the rotors where that is None; the state
    returned has a ``wheel_speed`` (m,) [rad/s] of all m wheels if w > 0 (NaN for a wheel of
    prescribed momentum without an inertia), so that ``propagate(scene, step.state, dt, t=t + dt)``
    continues the motion.

    The Jacobian is that of the exact flow, by forward differentiation through ``ph.simulate``.
    ``noise`` is the derivative by a disturbance torque on the body [N m] that is constant over the
    step, in body axes: a torque of spectral density s [N^2 m^2 s] adds ``noise @ noise.T * s / dt``
    to the covariance. For a motion in closed form it is integrated over the step. It is then NaN if
    the body rotates by more than half a revolution in a step under ``jit`` or ``vmap``, or by more
    than 512 revolutions otherwise: use shorter steps, or ``method=ph.LiePoisson()``.

    **Arguments:** ``scene``, ``state``: of one body; for several use ``jax.vmap``. ``dt``: not
    zero. ``t``: has an effect only if the scene depends on time; the rounded difference ``(t + dt)
    - t`` must then equal ``dt`` to 1 %, which in single precision and for steps of 0.1 s is so up
    to about 16,000 s. ``free``: None, or a function that selects leaves of the scene, ``lambda s:
    s.inertia.diagonal``: their entries are the parameters. ``method``, ``rtol``: as for
    ``ph.simulate``, whose errors are raised; under ``jit`` the result is NaN if the body did not
    finish or ``t + dt`` is rounded too much.

    Raises ValueError for a batch, a ``dt`` that times close to ``t`` do not resolve, or a ``free``
    that selects the speed or momentum of a wheel that is a coordinate already; TypeError for a
    scene or state of another type, or a ``free`` that selects other objects than arrays of the
    scene.

        state, jacobian, noise = ph.propagate(scene, state, 0.1)
        covariance = jacobian @ covariance @ jacobian.T + noise @ noise.T * density / 0.1
    """
    check_kinds(scene, state)
    if is_sampled(scene):
        raise ValueError(
            "a SampledTorque holds a command that the state does not contain: propagate each period"
            " with its command as a ph.BodyTorque."
        )
    if state.wxyz.ndim > 1 or state.omega_body.ndim > 1:
        raise ValueError(
            "propagate takes one body, got a state of shapes"
            f" {state.wxyz.shape}, {state.omega_body.shape}: map it, jax.vmap(ph.propagate, ...)."
        )
    dtype = state.omega_body.dtype
    dt, t = _number("dt", dt, dtype), _number("t", t, dtype)
    if dt.ndim or t.ndim:
        raise ValueError(
            f"dt and t are one number each, got shapes {dt.shape}, {t.shape}: for several steps"
            " jax.vmap or jax.lax.scan."
        )
    require(
        not is_concrete(dt) or (np.isfinite(dt) and dt != 0),
        f"dt must be a number other than zero, got {dt}.",
    )
    lib: Any = numbers(dt)
    scene, state, _, _ = check_inputs(scene, state, lib.stack([lib.zeros_like(dt), dt]), None)
    places = () if free is None else places_of(scene, free)
    if not set(places).isdisjoint(_starts_of_loose(scene)):
        raise ValueError(
            "free picks the speed or momentum of a rotor that is not held at its speed: it is part"
            " of the state, and its error one of the tangent coordinates already. Leave it out."
        )
    tolerance = check_rtol(rtol, dtype)
    if method is None:  # here, where the tolerance is known
        method, _ = choose(scene, tolerance)
    arguments = scene, state, dt, t, places, method, tolerance
    start, (state, jacobian, noise, status, turned, is_resolved) = state, _propagated(*arguments, 1)
    if not isinstance(is_resolved, Tracer) and not is_resolved:
        raise ValueError(
            f"dt = {dt:g} s at t = {t:g} s, where numbers of {dtype} are {np.spacing(abs(t)):.2g} s"
            " apart, in a scene that depends on time: count t, and the times of the scene, from a"
            " later epoch, or enable float64 (jax.config.update('jax_enable_x64', True))."
        )
    if not isinstance(turned, Tracer) and _TURN < turned <= _MOST_PARTS * _TURN:
        parts = 2 ** math.ceil(math.log2(turned / _TURN))
        state, jacobian, noise, status, *_ = _propagated(scene, start, *arguments[2:], parts)
    if not isinstance(status, Tracer):
        raise_on_failure(status, "Under jax.jit nothing is raised, and the result is NaN.")
    return Propagation(state, jacobian, noise)


def _number(name: str, value: Any, dtype: Any) -> Array | np.ndarray:
    """``value`` in the dtype; a Python number in NumPy, since an operation of JAX takes 50 us."""
    if isinstance(value, float | int | np.floating | np.integer):
        return np.asarray(value, dtype)
    return as_float_array(name, value, (), finite=False).astype(dtype)


def _starts_of_loose(scene: Scene) -> tuple[int, ...]:
    """Indices of the leaves of the scene that are initial speeds or momenta of wheels that are not
    held."""

    def starts(scene):
        if isinstance(scene.rotors, Wheels):
            return [] if scene.rotors.is_constant else [scene.rotors.momentum]
        loose = [w for w in scene.rotors.wheels if not w.is_held]
        return [w.momentum if w.speed is None else w.speed for w in loose]

    if scene.rotors is None or not starts(scene):
        return ()
    return places_of(scene, starts)


@jit_distinct
def _propagated(scene, state, dt, t, places, method, rtol, parts: int):
    """State, Jacobian, effect of a disturbance (integrated in ``parts``), status, the angle of
    rotation by the largest body rate, and whether times close to ``t`` resolve ``dt``."""
    dtype = dt.dtype
    leaves, tree = jax.tree.flatten(scene)
    sizes = [leaves[k].size for k in places]
    initial_scene = scene.settled(state, t)
    wheels: Any = initial_scene.rotors
    loose = wheels.loose if isinstance(initial_scene.rotors, Wheels) else ()
    start_speeds: Any = _speeds(wheels, t, state.omega_body) if loose else None
    begin = 6 + len(loose)
    n = begin + sum(sizes)

    # If the scene does not depend on time, the step starts at t = 0: in single precision t + dt is
    # rounded, after a day by a fifth of a step of 10 ms.
    dynamics, like = initial_scene.dynamics, state.omega_body[..., 0]
    spins = dynamics.wheels.initial_spins(like) if dynamics.coupled else ()
    changes = initial_scene.with_spins(spins).changes
    program = jax.make_jaxpr(changes)(state.wxyz, state.omega_body, t)
    if not uses(program.jaxpr, 2):
        t = jnp.zeros_like(t)
    is_resolved = jnp.abs((t + dt) - t - dt) <= _ROUNDED * jnp.abs(dt)
    time_range = jnp.stack([t, t + dt])
    # A closed form does not permit a torque: its effect is integrated over the step.
    nodes, weights = _gauss_points(parts, dtype)
    node_times = t + dt * nodes if method.exact else time_range[:0]
    ts = jnp.concatenate([time_range[:1], node_times, time_range[1:]])

    def states_after(error, push):
        turn = jnp.concatenate([jnp.ones(1, dtype), error[:3] / 2])
        speeds = None
        if loose:
            speeds = start_speeds.at[np.array(loose)].add(error[6:begin])
        start = State(rotation.multiply(state.wxyz, turn), state.omega_body + error[3:6], speeds)
        perturbed_leaves, position = list(leaves), begin
        for k, size in zip(places, sizes):
            change = error[position : position + size].reshape(leaves[k].shape)
            perturbed_leaves[k], position = (
                leaves[k] + change.astype(leaves[k].dtype),
                position + size,
            )
        body = jax.tree.unflatten(tree, perturbed_leaves)
        if not method.exact:
            push = BodyTorque(push)
            torque = push if body.torque is None else body.torque + push
            body = Scene(body.inertia, body.potential, torque, body.rotors)
        traj = simulate(body, start, ts, method, rtol=rtol, throw=False)
        good = (traj.status == Status.SUCCESSFUL) & is_resolved
        speeds = traj.wheel_speed if loose else jnp.zeros((ts.size, 0), dtype)
        samples = traj.wxyz, traj.omega_body, speeds
        wxyz, omega, speeds = (jnp.where(good, x, jnp.nan) for x in samples)
        loose_speeds = speeds[:, np.array(loose, int)]
        fastest = jnp.sqrt(jnp.max(jnp.sum(jax.lax.stop_gradient(omega) ** 2, axis=-1)))
        turned = jnp.abs(dt) * fastest if method.exact else jnp.zeros((), dtype)
        others = wxyz, traj.status, good, turned
        return (wxyz, omega, loose_speeds), (wxyz[-1], omega[-1], speeds[-1], *others)

    zeros = jnp.zeros(n, dtype), jnp.zeros(3, dtype)
    derivatives, (*end_samples, wxyz, status, good, turned) = jax.jacfwd(
        lambda inputs: states_after(inputs[:n], inputs[n:]), has_aux=True
    )(jnp.concatenate(zeros))
    flow = _tangents(derivatives, wxyz, n)
    end, noise = flow[-1, :, :n], flow[-1, :, n:]
    if method.exact:
        inverse = initial_scene.carrier.rates(jnp.eye(3, dtype=dtype))  # symmetric
        push = jnp.zeros((n, 3), dtype).at[3:6].set(inverse)
        if loose:  # a torque on the body leaves the absolute momenta of its wheels as they are
            axes = wheels.axes[np.array(loose)]
            push = push.at[6:begin].set(-axes @ inverse)

        def carried(flow):
            """Effect at the end of a unit impulse at a node."""
            return end @ jnp.linalg.solve(flow, push)

        noise = dt * jnp.tensordot(weights, jax.vmap(carried)(flow[1:-1, :, :n]), 1)
        noise = jnp.where(turned <= parts * _TURN, noise, jnp.nan)
    end, noise = (jnp.where(good, x, jnp.nan) for x in (end, noise))
    wxyz, omega, speeds = end_samples
    state = State.of_samples(wxyz, omega, speeds if loose else None)
    return state, end, noise, status, turned, is_resolved


def _gauss_points(parts: int, dtype: Any) -> tuple[Array, Array]:
    """Gauss points of all ``parts`` of a step, as fractions of the step, and their weights."""
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    nodes = ((1 + nodes) / 2 + np.arange(parts)[:, None]).reshape(-1) / parts
    weights = np.tile(weights / 2, parts) / parts
    return jnp.asarray(nodes, dtype), jnp.asarray(weights, dtype)


def _tangents(derivatives: tuple[Array, ...], wxyz: Array, n: int) -> Array:
    """Derivatives (T, n, n + 3) of the tangent coordinates, from those of attitude (T, 4, n + 3),
    rates (T, 3, n + 3) and speeds (T, w, n + 3); the parameters do not change."""
    turns, *rates = derivatives
    turns = jnp.moveaxis(turns, -1, -2)
    back = jnp.broadcast_to(rotation.conjugate(wxyz)[:, None], turns.shape)
    angles = 2 * rotation.multiply(back, turns)[..., 1:]
    flow = jnp.concatenate([jnp.moveaxis(angles, -1, -2), *rates], axis=-2)
    parameter_rows = jnp.eye(n, n + 3, dtype=flow.dtype)[flow.shape[-2] :]
    rows = jnp.broadcast_to(parameter_rows, (len(wxyz), *parameter_rows.shape))
    return jnp.concatenate([flow, rows], axis=-2)


def _speeds(wheels: Wheels, t: Array, omega: Array) -> Array:
    """Speeds (m,) [rad/s] of the wheels of one body relative to it."""
    rates = tuple(omega[i] for i in range(3))
    return jnp.stack([wheels.speed(i, t, rates) for i in range(len(wheels.is_held))])
