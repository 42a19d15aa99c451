"""Functions of the motion: saved in place of attitude and rates, or averaged over bodies."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from polhode._batch import PARTS, flatten, is_lane_tree, lane_times
from polhode._checks import require
from polhode._failed import where_lost
from polhode._kernels import is_differentiated
from polhode._method import Samples
from polhode._parts import call_traced
from polhode._scene import Scene
from polhode._trajectory._trajectory import Trajectory

_CALLED = "ph.Record(save=), called as fn(trajectory)"


def values_of(save: Callable, scene: Scene, ts: Array, samples: Samples) -> PyTree[Array]:
    """Values of ``save`` for each of N bodies at ``ts`` (T,) or (N, T): leaves (N, T, ...).

    Rows of floats are NaN where the samples of a body are not finite. When derivatives are
    computed, all rows of such a body are NaN, because ``save`` is then called with finite numbers
    in place of NaN: see ``_failed``.
    """
    lanes, shared = eqx.partition((scene, None), is_lane_tree((scene, None)))
    times, body_times = (None, ts) if ts.ndim > 1 else (ts, None)
    samples = samples._replace(saved=None, final=None)

    def of_body(lanes, own_times, x: Samples):
        scene, _ = eqx.combine(lanes, shared)
        states = [y for y in (x.wxyz, x.omega_body, x.spins) if y is not None]
        finite = jnp.isfinite(sum(y.sum(-1) for y in states))
        needs_numbers = is_differentiated(states) & ~finite.all()
        x = x._replace(
            **{
                name: where_lost(y, finite | ~needs_numbers, 0.5)
                for name, y in x._asdict().items()
                if name in ("wxyz", "omega_body", "spins") and y is not None
            }
        )
        finite = finite & ~needs_numbers
        body = Trajectory(
            own_times if times is None else times,
            x.wxyz,
            x.omega_body,
            x.status,
            x.steps,
            scene,
            x.work,
            x.error,
            x.motor_work,
            x.spins,
        )
        values = _checked(call_traced(_CALLED, "", save, body), body.ts.shape[-1])

        def masked(value):
            if not jnp.issubdtype(value.dtype, jnp.inexact):
                return value
            return where_lost(value, finite)

        return jax.tree.map(masked, values)

    return jax.vmap(of_body)(lanes, body_times, samples)


def with_saved(trajectory: Trajectory, save: Callable) -> Trajectory:
    """The trajectory with the values of ``save`` in place of its samples."""
    batch = trajectory.batch_shape

    def lanes(x):
        return None if x is None else x.reshape(-1, *x.shape[len(batch) :])

    t = trajectory
    parts = {name: flatten(getattr(t.scene, name), batch) for name in PARTS}
    state = (t._wxyz, t._omega_body, t.status, t._steps, t._work, t._error, t._motor_work, t._spins)
    samples = Samples(*jax.tree.map(lanes, state))
    values = values_of(save, Scene(**parts), lane_times(t.ts, batch), samples)
    return Trajectory(
        t.ts,
        None,
        None,
        t.status,
        t._steps,
        t.scene,
        t._work,
        t._error,
        t._motor_work,
        None,
        t.propagator,
        t._ending,
        t._events,
        jax.tree.map(lambda x: x.reshape(*batch, *x.shape[1:]), values),
        final_of(t._wxyz, t._omega_body, t._spins),
    )


def final_of(*samples: Array | None) -> tuple[Array | None, ...]:
    """The last of the samples (..., T, n) of attitude, rates and momenta of coupled wheels."""
    return tuple(None if x is None else x[..., -1, :] for x in samples)


def _checked(values: Any, count: int) -> PyTree[Array]:
    """The values of one body as arrays (T, ...); TypeError or ValueError for anything else."""
    leaves = jax.tree_util.tree_leaves_with_path(values, is_leaf=lambda x: x is None)
    expected = f"an array of shape ({count}, ...), or a pytree of such, is expected"
    if not leaves or all(leaf is None for _, leaf in leaves):
        raise TypeError(
            f"the function given to {_CALLED}, returned nothing ({values!r:.60}): {expected}."
        )

    def checked(path, leaf):
        name = f"the function given to {_CALLED}, returned{_at(path)}"
        if leaf is None:
            return None
        try:
            array = jnp.asarray(leaf)
        except (TypeError, ValueError) as error:
            raise TypeError(f"{name} {type(leaf).__name__}: {leaf!r:.60}; {expected}.") from error
        if array.shape[:1] != (count,):
            raise ValueError(
                f"{name} shape {array.shape}; {expected}: one row for each of the {count} samples"
                " of one body. Batches are mapped over the function, which does not see other"
                " bodies: reduce over bodies or times afterwards, from traj.saved."
            )
        return array

    return jax.tree_util.tree_map_with_path(checked, values, is_leaf=lambda x: x is None)


def _at(path: Any) -> str:
    return f" at {jax.tree_util.keystr(path)}" if path else ""


def successful_mean(trajectory: Trajectory, cost: Callable[[Trajectory], Array]) -> Array:
    """Mean of ``cost`` over the bodies of a batch that finished, with finite derivatives.

    The states of a failed body are NaN, and so is a mean over all bodies. Masking the values is not
    sufficient: a derivative of ``jnp.where(mask, cost, 0)`` multiplies zero by NaN if the cost has
    parameters of its own. ``cost`` is therefore called with finite states in place of those of
    failed bodies.

    **Arguments:**

    - ``trajectory``: of ``ph.simulate``, or of ``jax.vmap`` of it, with batch axes (...); under
      ``jit`` and ``grad`` too.
    - ``cost``: a function of a trajectory; values (..., *k), one row for each body.

    **Returns:** the mean (*k) over the batch axes. If no body finished, it is NaN, and so are its
    derivatives with respect to the numbers of the scene and of ``cost``.

    Raises ValueError if the values do not begin with the batch axes.

        def loss(controller):
            scene = ph.Scene(inertia, torque=ph.FeedbackTorque(controller))
            trajectory = ph.simulate(scene, states, [0.0, 10.0])
            return ph.successful_mean(trajectory, lambda t: jnp.sum(t.last.omega_body**2, axis=-1))
    """
    batch, good = trajectory.batch_shape, trajectory.successful

    def samples(t):
        values, final = jax.tree.leaves(t._saved), t._final or ()
        return [x for x in (*t._samples, t._work, *final, *values) if x is not None]

    def finite(x):
        if not jnp.issubdtype(x.dtype, jnp.inexact):  # for example saved integers
            return x
        # 0.5 in all components: a unit quaternion, and rates whose norm is differentiable
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
    dtype = values.dtype if jnp.issubdtype(values.dtype, jnp.inexact) else trajectory.ts.dtype
    count = jnp.sum(good).astype(dtype)
    # if no body finished, all values are divided by NaN: derivatives of the cost are NaN, not zero
    counted = jnp.where(mask | (count == 0), values, 0)
    total = jnp.sum(counted, axis=tuple(range(len(batch))), dtype=dtype)
    mean = total / jnp.where(count > 0, count, jnp.nan)
    return mean + _nothing(trajectory, count)


def _nothing(trajectory: Trajectory, count: Array) -> Array:
    """Zero; if no body finished, NaN with NaN derivatives with respect to the scene's numbers."""
    factor = jnp.where(count > 0, 0, jnp.nan).astype(count.dtype)
    total = jnp.zeros((), count.dtype)
    for x in jax.tree.leaves(eqx.filter(trajectory.scene, eqx.is_inexact_array)):
        total = total + jnp.sum(jnp.where(jnp.isfinite(x), x, 0)).astype(count.dtype)
    return factor * total + factor
