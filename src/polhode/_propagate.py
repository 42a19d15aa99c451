"""One step of a filter: a state carried on, with the Jacobian of the exact flow."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from polhode import rotation
from polhode._checks import ArrayLike
from polhode._method import (
    AbstractMethod,
    Status,
    check_inputs,
    check_kinds,
    check_rtol,
    raise_on_failure,
)
from polhode._scene import Scene, State
from polhode._scene._scene import places_of
from polhode._simulate import simulate

_NODES = 8
"""Gauss points that the effect of a disturbance is summed over; their error falls with the 16th
power of the angle turned in a step: 1e-12 of it for a third of a turn."""


class Propagation(NamedTuple):
    """A step: ``state`` at its end; ``jacobian`` (6 + p, 6 + p) of the tangent coordinates at the
    end by those at the start; ``noise`` (6 + p, 3): what a constant disturbance torque [N m] in
    body axes adds to them. See ``ph.propagate``."""

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
    """The state ``dt`` [s] after ``t``, the Jacobian of the flow, and the map of its noise.

    Tangent coordinates are (error rotation vector (3,) [rad] in body axes, error of the body rates
    (3,) [rad/s], p parameters): the true attitude is ``q * exp(error)``, with ``rotation.multiply``
    and ``rotation.rotation_vector_to_wxyz``. The Jacobian is that of the exact flow, by forward
    differentiation through ``ph.simulate``; ``noise`` is its integral over the step against the
    inverse inertia, so that a torque of spectral density s [N^2 m^2 s] held at random over each
    step adds ``noise @ noise.T * s / dt`` to the covariance.

    **Arguments:** ``scene``, ``state``: of one body; for several ``jax.vmap``. ``dt``: not zero.
    ``free``: None, or a function that picks leaves of the scene, ``lambda s: s.inertia.diagonal``:
    their entries are the parameters, which stay as they are. ``method``, ``rtol``: as for
    ``ph.simulate``, which raises; under ``jit`` all is NaN where the body did not arrive.

    Raises ValueError for a batch; TypeError for what is no scene or no state, or a ``free`` that
    picks what is no array of the scene.

        state, jacobian, noise = ph.propagate(scene, state, 0.1)
        covariance = jacobian @ covariance @ jacobian.T + noise @ noise.T * density / 0.1
    """
    check_kinds(scene, state)
    if state.wxyz.ndim > 1 or state.omega_body.ndim > 1:
        raise ValueError(
            "propagate takes one body, got a state of shapes"
            f" {state.wxyz.shape}, {state.omega_body.shape}: map it, jax.vmap(ph.propagate, ...)."
        )
    dtype = state.omega_body.dtype
    dt, t = jnp.asarray(dt, dtype), jnp.asarray(t, dtype)
    scene, state, _, _ = check_inputs(scene, state, jnp.stack([t, t + dt]), None)
    places = () if free is None else places_of(scene, free)
    wxyz, omega, jacobian, noise, status = _propagated(
        scene, state, dt, t, places, method, check_rtol(rtol, dtype)
    )
    if not isinstance(status, Tracer):
        raise_on_failure(status)
    return Propagation(State(wxyz, omega), jacobian, noise)


@eqx.filter_jit
def _propagated(scene, state, dt, t, places, method, rtol):
    dtype = dt.dtype
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    nodes, weights = (jnp.asarray(x, dtype) for x in ((1 + nodes) / 2, weights / 2))
    ts = t + dt * jnp.concatenate([jnp.zeros(1, dtype), nodes, jnp.ones(1, dtype)])
    leaves, tree = jax.tree.flatten(scene)
    sizes = [leaves[k].size for k in places]

    def moved(error):
        turn = jnp.concatenate([jnp.ones(1, dtype), error[:3] / 2])
        start = State(rotation.multiply(state.wxyz, turn), state.omega_body + error[3:6])
        changed, begin = list(leaves), 6
        for k, size in zip(places, sizes):
            change = error[begin : begin + size].reshape(leaves[k].shape)
            changed[k], begin = leaves[k] + change.astype(leaves[k].dtype), begin + size
        body = jax.tree.unflatten(tree, changed)
        traj = simulate(body, start, ts, method, rtol=rtol)
        good = traj.status == Status.SUCCESSFUL
        wxyz, omega = (jnp.where(good, x, jnp.nan) for x in (traj.wxyz, traj.omega_body))
        return (wxyz, omega), (wxyz, omega, traj.status)

    none = jnp.zeros(6 + sum(sizes), dtype)
    (turns, rates), (wxyz, omega, status) = jax.jacfwd(moved, has_aux=True)(none)
    back = rotation.conjugate(wxyz)
    turns = jnp.moveaxis(turns, -1, -2)  # (T, n, 4)
    along = jnp.broadcast_to(back[:, None], turns.shape)
    angles = 2 * rotation.multiply(along, turns)[..., 1:]
    flow = jnp.concatenate([jnp.moveaxis(angles, -1, -2), rates], axis=-2)  # (T, 6, n)
    still = jnp.eye(none.size, dtype=dtype)[6:]
    flow = jnp.concatenate([flow, jnp.broadcast_to(still, (ts.size, *still.shape))], axis=-2)
    end = flow[-1]
    inverse = scene.settled(state, t).carrier.rates(jnp.eye(3, dtype=dtype))  # symmetric
    push = jnp.zeros((none.size, 3), dtype).at[3:6].set(inverse)

    def carried(flow):
        """To the end, of what acts at a node."""
        return end @ jnp.linalg.solve(flow, push)

    noise = dt * jnp.tensordot(weights, jax.vmap(carried)(flow[1:-1]), 1)
    return wxyz[-1], omega[-1], end, noise, status
