"""Ensembles: any number of bodies, each drawn from its own index, never all in memory."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from polhode._batch import PARTS, batch_shapes, is_lane_tree
from polhode._scene import Scene, State
from polhode.ensemble._spreads import constant_torque, stream_of, with_torque
from polhode.inertia import Inertia

MOST_BODIES = 2**32 - 1
"""Body indices are folded into the random key as 32-bit numbers."""

Spread = Callable[[Array, Scene, State], tuple[Scene, State]]

ROWS = {"moments": 3, "wxyz": 4, "omega_body": 3, "momentum_body": 3, "torque": 3}
"""What ``Ensemble.rows`` may give for each body, and how many numbers."""


class Ensemble(eqx.Module):
    """``bodies`` bodies around a nominal scene and state.

    **Arguments:** ``scene``, ``state``: the nominal body, or arrays with one leading axis of
    length ``bodies`` in any leaf (the others are shared); ``bodies``; ``spreads``: callables
    ``(key, scene, state) -> (scene, state)`` of one body, applied in order; ``seed``; ``rows``:
    NumPy arrays (bodies, ...) that stay where they are, for example on disk
    (``np.load(file, mmap_mode="r")``), of which each chunk reads its part: ``moments``, ``wxyz``,
    ``omega_body``, ``momentum_body`` or ``torque`` (of a constant torque) in place of the nominal
    ones, before the spreads; the momentum after them.

    Body i depends on the seed and on i alone (its key is the seed's with i folded in, and each
    kind of spread has its own stream), so that no result depends on how the bodies are grouped.

    Raises ValueError for axes of another length, unknown rows, or a number of bodies outside
    1 ... 2^32 - 1, and TypeError for parts of the wrong kind.
    """

    scene: Scene
    state: State
    bodies: int = eqx.field(static=True)
    spreads: tuple[Spread, ...] = ()
    seed: int = eqx.field(static=True, default=0)
    rows: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)

    def __check_init__(self):
        if not isinstance(self.scene, Scene) or not isinstance(self.state, State):
            raise TypeError(
                "Ensemble takes a ph.Scene and a ph.State, got"
                f" {type(self.scene).__name__} and {type(self.state).__name__}."
            )
        if not 0 <= self.seed < 2**32:
            raise ValueError(f"seed must be from 0 to {2**32 - 1}, got {self.seed}.")
        if not 1 <= self.bodies <= MOST_BODIES:
            raise ValueError(f"bodies must be from 1 to {MOST_BODIES}, got {self.bodies}.")
        parts = [getattr(self.scene, name) for name in PARTS]
        found = {shape for part in (*parts, self.state) for shape in batch_shapes(part)}
        if wrong := found - {(), (self.bodies,)}:
            raise ValueError(
                f"arrays of an ensemble of {self.bodies} bodies have no leading axis or one of that"
                f" length, got the leading axes {sorted(wrong)}."
            )
        for name, array in self.rows.items():
            if name not in ROWS:
                raise ValueError(f"rows may be {', '.join(ROWS)}, got {name!r}.")
            shape = (self.bodies, ROWS[name])
            if np.shape(array) != shape or np.dtype(array.dtype).kind not in "fiu":
                raise ValueError(
                    f"rows {name} must be real numbers of shape {shape}, got {np.shape(array)} of"
                    f" {array.dtype}."
                )
        if {"omega_body", "momentum_body"} <= set(self.rows):
            raise ValueError("rows give omega_body or momentum_body of a body, not both.")
        if "torque" in self.rows:
            constant_torque(self.scene)

    def lanes(self, indices: np.ndarray) -> tuple[Any, Any]:
        """What ``draw`` needs of the bodies ``indices``: (leaves cut to them, shared leaves)."""
        parts = (self.scene, self.state)
        each, shared = eqx.partition(parts, is_lane_tree(parts))
        dtype = self.state.wxyz.dtype
        rows = {name: np.asarray(x[indices], dtype) for name, x in sorted(self.rows.items())}
        return (jax.tree.map(lambda x: x[indices], each), rows), shared

    def draw(self, indices: Int[np.ndarray, " n"]) -> tuple[Scene, State]:
        """Scene and state of the bodies ``indices`` (n,), with the leading axis n."""
        each, shared = self.lanes(indices)
        seed = jnp.asarray(self.seed, jnp.uint32)
        return draw(each, shared, jnp.asarray(indices, jnp.uint32), self.spreads, seed)


def draw(each: Any, shared: Any, indices: Array, spreads: Any, seed: Array) -> tuple[Scene, State]:
    """The bodies of the indices (n,) of uint32 and a seed of uint32; traceable."""
    root = jax.random.key(seed, impl="threefry2x32")

    def one(index, own):
        own, rows = own
        scene, state = eqx.combine(own, shared)
        scene, state = _placed(scene, state, rows)
        key = jax.random.fold_in(root, index)
        streams: list[int] = []
        for spread in spreads:
            stream = stream_of(spread)
            own_key = jax.random.fold_in(key, stream)
            if stream in streams:  # spreads of one name draw independently
                own_key = jax.random.fold_in(own_key, streams.count(stream))
            streams.append(stream)
            scene, state = spread(own_key, scene, state)
        if "momentum_body" in rows:
            omega = scene.inertia.rates(rows["momentum_body"])
            state = State(state.wxyz, omega, state.wheel_speed)
        return scene, state

    return eqx.filter_vmap(one, in_axes=(0, eqx.if_array(0)), out_axes=eqx.if_array(0))(
        indices, each
    )


def _placed(scene: Scene, state: State, rows: Mapping[str, Array]) -> tuple[Scene, State]:
    """One body with its rows in place of the nominal numbers."""
    if "moments" in rows:
        scene = dataclasses.replace(scene, inertia=Inertia.from_moments(rows["moments"]))
    if "torque" in rows:
        scene = with_torque(scene, rows["torque"])
    wxyz, omega = rows.get("wxyz", state.wxyz), rows.get("omega_body", state.omega_body)
    if "wxyz" in rows or "omega_body" in rows:
        state = State(wxyz, omega, state.wheel_speed)
    return scene, state
