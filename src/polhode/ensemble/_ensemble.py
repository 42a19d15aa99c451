"""Ensembles: any number of bodies, each drawn from its own index, never all in memory."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from polhode._lanes import PARTS, batch_shapes, is_lane_tree
from polhode._scene import Scene
from polhode._state import State
from polhode.ensemble._spreads import stream_of

MOST_BODIES = 2**32 - 1
"""Body indices are folded into the random key as 32-bit numbers."""

Spread = Callable[[Array, Scene, State], tuple[Scene, State]]


class Ensemble(eqx.Module):
    """``bodies`` bodies around a nominal scene and state.

    **Arguments:** ``scene``, ``state``: the nominal body, or arrays with one leading axis of
    length ``bodies`` in any leaf (the others are shared); ``bodies``; ``spreads``: callables
    ``(key, scene, state) -> (scene, state)`` of one body, applied in order; ``seed``.

    Body i depends on the seed and on i alone (its key is the seed's with i folded in, and each
    kind of spread has its own stream), so that no result depends on how the bodies are grouped.

    Raises ValueError for axes of another length, or a number of bodies outside 1 ... 2^32 - 1.
    """

    scene: Scene
    state: State
    bodies: int = eqx.field(static=True)
    spreads: tuple[Spread, ...] = ()
    seed: int = eqx.field(static=True, default=0)

    def __check_init__(self):
        if not isinstance(self.scene, Scene) or not isinstance(self.state, State):
            raise TypeError(
                "Ensemble takes a ph.Scene and a ph.State, got"
                f" {type(self.scene).__name__} and {type(self.state).__name__}."
            )
        if not 1 <= self.bodies <= MOST_BODIES:
            raise ValueError(f"bodies must be from 1 to {MOST_BODIES}, got {self.bodies}.")
        parts = [getattr(self.scene, name) for name in PARTS]
        found = {shape for part in (*parts, self.state) for shape in batch_shapes(part)}
        if wrong := found - {(), (self.bodies,)}:
            raise ValueError(
                f"arrays of an ensemble of {self.bodies} bodies have no leading axis or one of that"
                f" length, got the leading axes {sorted(wrong)}."
            )

    def lanes(self, indices: np.ndarray) -> tuple[Any, Any]:
        """What ``draw`` needs of the bodies ``indices``: (leaves cut to them, shared leaves)."""
        parts = (self.scene, self.state)
        each, shared = eqx.partition(parts, is_lane_tree(parts))
        return jax.tree.map(lambda x: x[indices], each), shared

    def draw(self, indices: Int[np.ndarray, " n"]) -> tuple[Scene, State]:
        """Scene and state of the bodies ``indices`` (n,), with the leading axis n."""
        each, shared = self.lanes(indices)
        return draw(each, shared, jnp.asarray(indices, jnp.uint32), self.spreads, self.seed)


def draw(each: Any, shared: Any, indices: Array, spreads: Any, seed: int) -> tuple[Scene, State]:
    """The bodies of the indices (n,) of uint32; traceable."""
    root = jax.random.key(seed, impl="threefry2x32")

    def one(index, own):
        scene, state = eqx.combine(own, shared)
        key = jax.random.fold_in(root, index)
        streams: list[int] = []
        for spread in spreads:
            stream = stream_of(spread)
            own_key = jax.random.fold_in(key, stream)
            if stream in streams:  # spreads of one name draw independently
                own_key = jax.random.fold_in(own_key, streams.count(stream))
            streams.append(stream)
            scene, state = spread(own_key, scene, state)
        return scene, state

    return eqx.filter_vmap(one, in_axes=(0, eqx.if_array(0)), out_axes=eqx.if_array(0))(
        indices, each
    )
