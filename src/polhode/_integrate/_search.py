"""Events for which the integration loop searches."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from polhode._integrate._loop import AT_EVENT, Solved


class Search(NamedTuple):
    """Events to search for: functions ``(wxyz, omega_body, t)``, the direction of each and whether
    it ends the motion; ``capacity``: how many of a body are stored. All static."""

    fns: tuple[Callable[..., Array], ...] = ()
    directions: tuple[int, ...] = ()
    terminal: tuple[bool, ...] = ()
    capacity: int = 0

    @property
    def passing(self) -> "Search":
        """The same events, none of which is stored or ends the motion."""
        return Search(self.fns, self.directions, (False,) * len(self.fns), 0)


class Found(NamedTuple):
    """Events of N bodies in the order of the motion: ``times`` (N, E) [s], inf where there is none,
    ``which`` (N, E) event, ``count`` (N,) of those met; ``rows`` (N, T): times of the samples."""

    times: Array
    which: Array
    count: Array
    rows: Array


def with_events(search: Search, solved: Solved, times: Array, states: Array):
    """The events, and times (N, T + E) and states (N, T + E, D) of samples and events; samples
    beyond a terminal event are that event."""
    bodies, capacity = solved.steps.shape[0], search.capacity
    assert solved.times is not None
    assert solved.states is not None
    assert solved.which is not None
    assert solved.count is not None
    at = solved.times.reshape(bodies, capacity + 1)[:, :-1]
    there = solved.states.reshape(bodies, capacity + 1, -1)[:, :-1]
    which = solved.which.reshape(bodies, capacity + 1)[:, :-1].astype(jnp.int32)
    times = jnp.broadcast_to(jnp.atleast_2d(times), states.shape[:2])
    met = jnp.isfinite(at)
    if any(search.terminal):
        sign = jnp.where(times[:, -1:] < times[:, :1], -1, 1).astype(times.dtype)
        end = jnp.where(solved.outcome == AT_EVENT, solved.count, capacity + 1)
        stop = jnp.arange(1, capacity + 1, dtype=end.dtype)[None] == end[:, None]
        final = jnp.sum(jnp.where(stop, at, 0), axis=1, keepdims=True)
        state = jnp.sum(jnp.where(stop[..., None], there, 0), axis=1, keepdims=True)
        past = jnp.any(stop, axis=1, keepdims=True) & (sign * (times - final) >= 0)
        times = jnp.where(past, final, times)
        states = jnp.where(past[..., None], state, states)
    at_events = jnp.where(met, at, times[:, -1:])
    there = jnp.where(met[..., None], there, states[:, -1:])
    times = jnp.concatenate([times, at_events], axis=1)
    states = jnp.concatenate([states, there], axis=1)
    return Found(at, which, solved.count, times), times, states
