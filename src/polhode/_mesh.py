"""Batches that lie on several devices: each device moves the bodies it has.

Chunks of lanes are worked on one after the other, which a compiler that splits arrays by itself
could only do by gathering them. The batch is therefore split by hand, with ``jax.shard_map``.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array

from polhode._checks import is_concrete
from polhode._lanes import PARTS, common_batch, map_arrays
from polhode._scene import Scene
from polhode._state import State


class Split(NamedTuple):
    """A mesh, and the mesh axes (None: whole) that each batch axis is divided among."""

    mesh: Mesh
    axes: tuple[Any, ...]

    def spec(self, array: Array, rank: int) -> PartitionSpec:
        """How an array of core rank ``rank`` lies when its batch axes follow the split."""
        lead = array.shape[: array.ndim - rank]
        axes = self.axes[len(self.axes) - len(lead) :]
        return PartitionSpec(*(a if size > 1 else None for a, size in zip(axes, lead)))


def split_of(scene: Scene, state: State, ts: Array) -> Split | None:
    """How the batch of the inputs is divided among devices; None where it is not.

    Looks at the ``NamedSharding`` of the arrays, or while they are traced, of their types (a mesh
    with explicit axes). Raises ValueError when two arrays are divided differently.
    """
    if jax.device_count() == 1:
        return None
    found: list[tuple[NamedSharding, tuple[int, ...]]] = []

    def look(x, rank):
        sharding = _sharding(x)
        if sharding is not None:
            found.append((sharding, x.shape[: x.ndim - rank]))
        return x

    parts = [getattr(scene, name) for name in PARTS]
    for part in (*parts, state):
        map_arrays(part, look)
    look(ts, 1)
    if not found:
        return None
    batch = common_batch(*parts, state, extra=(ts.shape[:-1],))
    axes: list[Any] = [None] * len(batch)
    mesh = None
    for sharding, lead in found:
        spec = (*sharding.spec, *[None] * len(lead))[: len(lead)]
        for k, (axis, size) in enumerate(zip(spec, lead), len(batch) - len(lead)):
            if axis is None or size == 1 or axis is PartitionSpec.UNCONSTRAINED:
                continue
            if mesh not in (None, sharding.mesh) or axes[k] not in (None, axis):
                raise ValueError(
                    f"the arrays of a batch lie on their devices in different ways: axis {k} by"
                    f" {axes[k] or axis} and by {axis}, on {mesh} and {sharding.mesh}; place them"
                    " alike with jax.device_put."
                )
            mesh, axes[k] = sharding.mesh, axis
    return None if mesh is None else Split(mesh, tuple(axes))


def _sharding(x: Any) -> NamedSharding | None:
    sharding = x.sharding if isinstance(x, jax.Array) and is_concrete(x) else _typed(x)
    named = isinstance(sharding, NamedSharding) and sharding.mesh.size > 1
    return sharding if named else None


def _typed(x: Any) -> Any:
    return getattr(jax.typeof(x), "sharding", None) if isinstance(x, jax.Array) else None


def place(split: Split, scene: Scene, state: State, ts: Array) -> tuple[Scene, State, Array]:
    """All arrays where the split wants them; nothing moves that lies there already."""

    def put(x, rank):
        return jax.device_put(x, NamedSharding(split.mesh, split.spec(x, rank)))

    parts = {name: map_arrays(getattr(scene, name), put) for name in PARTS}
    return Scene(**parts), map_arrays(state, put), put(ts, 1)


def on_devices(
    split: Split, fn: Callable, method: Any, scene: Scene, state: State, ts: Array, rtol: Array
) -> Any:
    """``fn(method, scene, state, ts, rtol)`` by every device for its part of the batch; what it
    returns has the batch axes in front.
    """
    arrays, rest = eqx.partition((method, scene, state, ts, rtol), eqx.is_array)
    specs = jax.tree.map(lambda _: PartitionSpec(), arrays)
    method_specs, scene_specs, *_ = specs
    for name in PARTS:
        if getattr(scene, name) is not None:
            own = eqx.filter(map_arrays(getattr(scene, name), split.spec), _is_spec)
            own = eqx.combine(own, getattr(scene_specs, name), is_leaf=_is_spec)
            scene_specs = eqx.tree_at(lambda s, name=name: getattr(s, name), scene_specs, own)
    state_specs = map_arrays(state, split.spec)
    in_specs = (method_specs, scene_specs, state_specs, split.spec(ts, 1), PartitionSpec())
    return jax.shard_map(
        lambda arrays: fn(*eqx.combine(arrays, rest)),
        mesh=split.mesh, in_specs=(in_specs,), out_specs=PartitionSpec(*split.axes),
        check_vma=False,
    )(arrays)  # fmt: skip


def _is_spec(x: Any) -> bool:
    return isinstance(x, PartitionSpec)
