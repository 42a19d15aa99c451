"""What exact laws have in common as methods: the scenes that they hold for, and chunks of lanes."""

import abc
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from polhode._batch import is_lane_tree, map_chunks
from polhode._method._base import AbstractMethod, Record, Samples
from polhode._method._status import Status
from polhode._scene import Scene, State


class AbstractExact(AbstractMethod):
    """Base of the exact laws: nothing is stepped."""

    exact: ClassVar[bool] = True

    @abc.abstractmethod
    def objection(self, scene: Scene) -> str | None:
        """What is wrong with the parts of the scene, whatever their values; None: nothing."""

    @abc.abstractmethod
    def why_not(self, scene: Scene, state: State, record: Record) -> str | None:
        """Why the law does not hold for the scene, in words; None where it is known to hold.

        Values are looked at where they are known; while they are traced only what is static counts.
        """

    def refuse(self, scene: Scene) -> None:
        """ValueError where the parts of the scene are not those of the law."""
        objection = self.objection(scene)
        if objection is not None:
            raise ValueError(f"ph.{type(self).__name__}: {objection}; leave method=None.")


class AbstractTopMethod(AbstractExact):
    """Base of the exact tops: chunks of lanes."""

    chunk: eqx.AbstractVar[int | None]

    @abc.abstractmethod
    def _motion(
        self, scene: Scene, state: State, elapsed: Array
    ) -> tuple[Array | None, Array, Array]:
        """wxyz (N, T, 4), omega (N, T, 3) and which lanes obey the law, of one chunk."""

    def run(self, scene: Scene, state: State, ts: Array, rtol: Array, record: Record) -> Samples:
        del rtol
        self.refuse(scene)
        count = 1 if record.final_only else ts.shape[-1] - 1
        lanes, shared = eqx.partition((scene, state), is_lane_tree((scene, state)))

        def one(chunk):
            lanes, times = chunk
            scene, state = eqx.combine(lanes, shared)
            times = ts if times is None else times
            kept = times[..., -1:] if record.final_only else times[..., 1:]  # the first is given
            elapsed = kept - times[..., :1]
            n = state.wxyz.shape[0]
            elapsed = jnp.broadcast_to(elapsed if elapsed.ndim == 2 else elapsed[None], (n, count))
            wxyz, omega, lawful = self._motion(scene, state, elapsed)
            if not record.final_only:
                wxyz, omega = with_first(state, wxyz, omega)
            return _samples(wxyz, omega, lawful, record)

        n, times = state.wxyz.shape[0], ts if ts.ndim == 2 else None
        return map_chunks(one, (lanes, times), n, self._size(n, count))

    def _size(self, n: int, count: int) -> int:
        """Lanes of a chunk; without ``chunk`` all of them."""
        return n if self.chunk is None else max(1, self.chunk // count)


def with_first(
    state: State, wxyz: Array | None, omega: Array | None
) -> tuple[Array | None, Array | None]:
    """Samples (N, T, ...) with the given state before them."""
    both = ((state.wxyz, wxyz), (state.omega_body, omega))
    wxyz, omega = (
        None if x is None else jnp.concatenate([first[:, None], x], axis=1) for first, x in both
    )
    return wxyz, omega


def _samples(wxyz, omega, lawful, record: Record) -> Samples:
    finite = jnp.all(jnp.isfinite(omega), axis=(-1, -2))
    if record.attitude:
        finite = finite & jnp.all(jnp.isfinite(wxyz), axis=(-1, -2))
    status = jnp.where(finite, Status.SUCCESSFUL, Status.NOT_FINITE)
    status = jnp.where(lawful, status, Status.WRONG_LAW)
    return Samples(
        wxyz if record.attitude else None,
        omega if record.rates else None,
        status,
        jnp.zeros(status.shape, status.dtype),
    )
