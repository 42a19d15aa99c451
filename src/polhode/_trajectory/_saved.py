"""Functions of the motion that a simulation saves in place of attitude and rates."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from polhode._batch import PARTS, flatten, is_lane_tree, lane_times
from polhode._method import Samples
from polhode._parts import call_traced
from polhode._scene import Scene
from polhode._trajectory._trajectory import Trajectory

_CALLED = "ph.Record(save=), called as fn(trajectory)"


def values_of(save: Callable, scene: Scene, ts: Array, samples: Samples) -> PyTree[Array]:
    """``save`` of each of N bodies at ``ts`` (T,) or (N, T): leaves (N, T, ...).

    Rows of floats are NaN where the samples of a body are not finite.
    """
    lanes, shared = eqx.partition((scene, None), is_lane_tree((scene, None)))
    times, own = (None, ts) if ts.ndim > 1 else (ts, None)
    samples = samples._replace(saved=None, final=None)

    def of_body(lanes, own, x: Samples):
        scene, _ = eqx.combine(lanes, shared)
        body = Trajectory(
            own if times is None else times,
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
        finite = jnp.ones(body.ts.shape, bool)
        for sample in body._samples:
            finite = finite & jnp.all(jnp.isfinite(sample), axis=-1)

        def masked(value):
            if not jnp.issubdtype(value.dtype, jnp.inexact):
                return value
            return jnp.where(finite.reshape(-1, *(1,) * (value.ndim - 1)), value, jnp.nan)

        return jax.tree.map(masked, values)

    return jax.vmap(of_body)(lanes, own, samples)


def with_saved(trajectory: Trajectory, save: Callable) -> Trajectory:
    """The trajectory with the values of ``save`` in place of its samples."""
    batch = trajectory.batch_shape

    def lanes(x):
        return None if x is None else x.reshape(-1, *x.shape[len(batch) :])

    t = trajectory
    parts = {name: flatten(getattr(t.scene, name), batch) for name in PARTS}
    state = (t._wxyz, t._omega_body, t.status, t.steps, t._work, t._error, t._motor_work, t._spins)
    samples = Samples(*map(lanes, state))
    values = values_of(save, Scene(**parts), lane_times(t.ts, batch), samples)
    return Trajectory(
        t.ts,
        None,
        None,
        t.status,
        t.steps,
        t.scene,
        t._work,
        t._error,
        t._motor_work,
        None,
        t.propagator,
        t._event_time,
        t._events,
        jax.tree.map(lambda x: x.reshape(*batch, *x.shape[1:]), values),
        final_of(t._wxyz, t._omega_body, t._spins),
    )


def final_of(*samples: Array | None) -> tuple[Array | None, ...]:
    """The last samples (..., n) of attitude, rates and momenta of coupled wheels (..., T, n)."""
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
