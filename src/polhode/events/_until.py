"""Motions that stop at an event."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp

from polhode._checks import is_concrete
from polhode._motion import moved_to
from polhode._trajectory import Trajectory
from polhode.events._crossings import crossings
from polhode.events._event import Event
from polhode.methods import Record


def check_until(until: Any, record: Any) -> None:
    """An event, with samples of both attitude and rates."""
    if not isinstance(until, Event):
        raise TypeError(
            f"until must be a ph.Event, got {type(until).__name__}: ph.Event(fn, direction)."
        )
    if record is not None and record != Record():
        raise ValueError(
            "until= needs attitude and rates at all times and knows no work and error: leave"
            " record= out."
        )


def stopped(trajectory: Trajectory, until: Event) -> Trajectory:
    """The trajectory, each body held from its first event on."""
    known = is_concrete(trajectory)
    found = crossings(trajectory, until, most=None if known else 1)
    none = jnp.full((*trajectory.batch_shape, 1), jnp.inf, trajectory.ts.dtype)
    return _held(trajectory, jnp.concatenate([found.times, none], axis=-1)[..., 0])


@eqx.filter_jit
def _held(trajectory: Trajectory, time) -> Trajectory:
    ts = jnp.broadcast_to(trajectory._t, (*trajectory.batch_shape, trajectory.ts.shape[-1]))
    back = ts[..., -1:] < ts[..., :1]
    event = time[..., None]
    past = jnp.where(back, ts <= event, ts >= event) & jnp.isfinite(event)
    held = moved_to(trajectory, jnp.where(past, event, ts))
    return eqx.tree_at(lambda t: t.event_time, held, time, is_leaf=lambda x: x is None)
