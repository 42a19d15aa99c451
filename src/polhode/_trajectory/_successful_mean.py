"""Means over the bodies of a batch that finished."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from polhode._checks import require
from polhode._trajectory._trajectory import Trajectory


def successful_mean(trajectory: Trajectory, cost: Callable[[Trajectory], Array]) -> Array:
    """Mean of ``cost`` over the bodies of a batch that finished; others change no derivative.

    The states of a failed body are NaN, and so is a mean over all bodies. Masking the values alone
    would not do: a derivative of ``jnp.where(mask, cost, 0)`` multiplies zero by NaN where the cost
    has parameters of its own. ``cost`` therefore sees finite states in place of those of failed
    bodies.

    **Arguments:**

    - ``trajectory``: of ``ph.simulate``, or of ``jax.vmap`` of it, with batch axes (...); under
      ``jit`` and ``grad`` too.
    - ``cost``: a function of a trajectory; values (..., *k), one row for each body.

    **Returns:** the mean (*k) over the batch axes. If no body finished, it is NaN, and so are its
    derivatives with respect to the numbers of the scene.

    Raises ValueError if the values do not begin with the batch axes.

        def loss(controller):
            scene = ph.Scene(inertia, torque=ph.FeedbackTorque(controller))
            trajectory = ph.simulate(scene, states, [0.0, 10.0])
            return ph.successful_mean(trajectory, lambda t: jnp.sum(t.last.omega_body**2, axis=-1))
    """
    batch, good = trajectory.batch_shape, trajectory.successful

    def samples(t):
        saved, final = jax.tree.leaves(t._saved), t._final or ()
        return [x for x in (*t._samples, t._work, *final, *saved) if x is not None]

    def finite(x):
        if not jnp.issubdtype(x.dtype, jnp.inexact):  # a count that was saved
            return x
        # components of 0.5 are a unit quaternion, and rates whose norm has a derivative
        mask = good.reshape(*batch, *(1,) * (x.ndim - len(batch)))
        return jnp.where(mask, x, jnp.asarray(0.5, x.dtype))

    safe = eqx.tree_at(samples, trajectory, [finite(x) for x in samples(trajectory)])
    values = jnp.asarray(cost(safe))
    require(
        values.shape[: len(batch)] == batch,
        f"cost must return values of shape {(*batch, '...')}, one row for each body of the batch,"
        f" got {values.shape}.",
    )
    mask = good.reshape(*batch, *(1,) * (values.ndim - len(batch)))
    axes = tuple(range(len(batch)))
    count = jnp.sum(good).astype(values.dtype)
    mean = jnp.sum(jnp.where(mask, values, 0), axis=axes) / jnp.maximum(count, 1)
    return mean + _nothing(trajectory, count)


def _nothing(trajectory: Trajectory, count: Array) -> Array:
    """Zero; NaN if no body finished, with derivatives NaN by the numbers of the scene."""
    factor = jnp.where(count > 0, 0, jnp.nan).astype(count.dtype)
    total = jnp.zeros((), count.dtype)
    for x in jax.tree.leaves(eqx.filter(trajectory.scene, eqx.is_inexact_array)):
        total = total + jnp.sum(jnp.where(jnp.isfinite(x), x, 0)).astype(count.dtype)
    return factor * total + factor
