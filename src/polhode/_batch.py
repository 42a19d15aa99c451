"""Batches: the leading axes of all arrays are broadcast and flattened to one axis of N lanes; the
results get the batch axes again. Each device simulates its own part of a batch that is sharded over
several devices. Trajectories are indexed by keys for bodies and times.

``core_ranks`` of a part (inertia, state, potential, ...) contains the rank of each of its array
fields without batch axes; the ``terms`` of a sum are parts themselves.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array

from polhode._checks import is_concrete
from polhode._parts import AbstractPart, AbstractSum

PARTS = ("inertia", "potential", "torque", "rotors")
"""The parts of a scene that may carry batch axes."""


_ARRAYS = (jax.Array, np.ndarray)


def _fields(part: Any) -> list[tuple[str, int]]:
    ranks = part.core_ranks.items()
    return [(name, n) for name, n in ranks if isinstance(getattr(part, name), _ARRAYS)]


def _part_fields(part: Any) -> list[str]:
    """Fields that are parts themselves, such as an orbit."""
    return [name for name in part.core_ranks if isinstance(getattr(part, name), AbstractPart)]


def _lead(array, rank: int) -> tuple[int, ...]:
    return array.shape[: array.ndim - rank]


def map_arrays(part: Any, fn: Callable[[Any, int], Any]) -> Any:
    """The part with each of its array fields replaced by ``fn(array, core_rank)``."""
    if part is None:
        return None
    if isinstance(part, AbstractSum):
        return eqx.tree_at(lambda p: p.terms, part, tuple(map_arrays(t, fn) for t in part.terms))
    for name in _part_fields(part):
        mapped_part = map_arrays(getattr(part, name), fn)
        part = eqx.tree_at(lambda p, name=name: getattr(p, name), part, mapped_part)
    fields = _fields(part)
    if not fields:
        return part
    arrays = [fn(getattr(part, name), rank) for name, rank in fields]
    return eqx.tree_at(lambda p: [getattr(p, name) for name, _ in fields], part, arrays)


def batch_shapes(part: Any) -> list[tuple[int, ...]]:
    """Leading axes of every array of a part."""
    shapes: list[tuple[int, ...]] = []
    map_arrays(part, lambda x, rank: (shapes.append(_lead(x, rank)), x)[1])
    return shapes


def common_batch(*parts: Any, extra: tuple[tuple[int, ...], ...] = ()) -> tuple[int, ...]:
    """The batch shape to which all parts broadcast; raises ValueError with the shapes if there is
    none."""
    shapes = [shape for part in parts for shape in batch_shapes(part)] + list(extra)
    try:
        return np.broadcast_shapes(*shapes)
    except ValueError as error:
        description = ", ".join(
            f"{type(part).__name__}: {sorted(set(batch_shapes(part)))}"
            for part in parts
            if part is not None
        )
        raise ValueError(
            f"the batch axes do not broadcast together ({description}; ts: {list(extra)}): give"
            " every array the same leading axes, or 1 where it is shared."
        ) from error


def flatten(part: Any, batch: tuple[int, ...], *, shared: bool = True) -> Any:
    """Arrays as (N, ...) lanes; with ``shared``, arrays common to all bodies get no lane axis."""

    def to_lanes(x, rank):
        core = x.shape[x.ndim - rank :]
        if shared and x.size == int(np.prod(core, dtype=int)):
            return x if x.shape == core else x.reshape(core)
        return jnp.broadcast_to(x, batch + core).reshape(-1, *core)

    return map_arrays(part, to_lanes)


def lane_times(ts: Array, batch: tuple[int, ...]) -> Array:
    """Common times (T,) unchanged, times of each body (..., T) as (N, T)."""
    if ts.ndim == 1:
        return ts
    return jnp.broadcast_to(ts, (*batch, ts.shape[-1])).reshape(-1, ts.shape[-1])


def is_lane_tree(parts: Any) -> Any:
    """Mask of the leaves that carry the lane axis, for ``eqx.partition`` of (scene, state)."""
    lane = object()

    def mark(part):
        return map_arrays(part, lambda x, rank: lane if x.ndim > rank else x)

    scene, state = parts
    for name in PARTS:
        if (part := getattr(scene, name)) is not None:
            scene = eqx.tree_at(lambda s, name=name: getattr(s, name), scene, mark(part))
    return jax.tree.map(lambda x: x is lane, (scene, mark(state)))


def along_time(part: Any, batch_rank: int) -> Any:
    """Arrays as (batch..., 1, core...): ready to broadcast against samples (batch..., T, core)."""

    def expand(x, rank):
        lead, core = _lead(x, rank), x.shape[x.ndim - rank :]
        return x.reshape((1,) * (batch_rank - len(lead)) + lead + (1, *core))

    return map_arrays(part, expand)


# Several devices. The batch is divided explicitly by jax.shard_map: chunks of lanes are processed
# one after another, and XLA's automatic partitioning would gather the arrays for this.


class Split(NamedTuple):
    """A mesh, and for each batch axis the mesh axes over which it is sharded (None: not
    sharded)."""

    mesh: Mesh
    axes: tuple[Any, ...]

    def spec(self, array: Array, rank: int) -> PartitionSpec:
        """The ``PartitionSpec`` of an array of core rank ``rank`` whose batch axes are sharded."""
        lead = array.shape[: array.ndim - rank]
        axes = self.axes[len(self.axes) - len(lead) :]
        return PartitionSpec(*(a if size > 1 else None for a, size in zip(axes, lead)))


def split_of(scene: Any, state: Any, ts: Array) -> Split | None:
    """How the batch of the inputs is divided among devices; None if it is not.

    It follows from the ``NamedSharding`` of the arrays, or of their types while they are traced (a
    mesh with explicit axes). Raises ValueError if two arrays are divided differently.
    """
    if jax.device_count() == 1:
        return None
    shardings: list[tuple[NamedSharding, tuple[int, ...]]] = []

    def collect(x, rank):
        sharding = _sharding(x)
        if sharding is not None:
            shardings.append((sharding, x.shape[: x.ndim - rank]))
        return x

    parts = [getattr(scene, name) for name in PARTS]
    for part in (*parts, state):
        map_arrays(part, collect)
    collect(ts, 1)
    if not shardings:
        return None
    batch = common_batch(*parts, state, extra=(ts.shape[:-1],))
    axes: list[Any] = [None] * len(batch)
    mesh = None
    for sharding, lead in shardings:
        spec = (*sharding.spec, *[None] * len(lead))[: len(lead)]
        for k, (axis, size) in enumerate(zip(spec, lead), len(batch) - len(lead)):
            if axis is None or size == 1 or axis is PartitionSpec.UNCONSTRAINED:
                continue
            if mesh not in (None, sharding.mesh) or axes[k] not in (None, axis):
                raise ValueError(
                    f"the arrays of a batch are sharded in different ways: axis {k} by"
                    f" {axes[k] or axis} and by {axis}, on {mesh} and {sharding.mesh}; place them"
                    " alike with jax.device_put."
                )
            mesh, axes[k] = sharding.mesh, axis
    return None if mesh is None else Split(mesh, tuple(axes))


def _sharding(x: Any) -> NamedSharding | None:
    sharding = x.sharding if isinstance(x, jax.Array) and is_concrete(x) else _typed(x)
    if isinstance(sharding, NamedSharding) and sharding.mesh.size > 1:
        return sharding
    return None


def _typed(x: Any) -> Any:
    return getattr(jax.typeof(x), "sharding", None) if isinstance(x, jax.Array) else None


def place(split: Split, scene: Any, state: Any, ts: Array) -> tuple[Any, Any, Array]:
    """All arrays on the devices of the split; those that are there already are not moved."""

    def put(x, rank):
        return jax.device_put(x, NamedSharding(split.mesh, split.spec(x, rank)))

    parts = {name: map_arrays(getattr(scene, name), put) for name in PARTS}
    return type(scene)(**parts), map_arrays(state, put), put(ts, 1)


def on_devices(
    split: Split, fn: Callable, method: Any, scene: Any, state: Any, ts: Array, rtol: Array
) -> Any:
    """``fn(method, scene, state, ts, rtol)`` on every device for its part of the batch; all of its
    results have the batch axes first.
    """
    arrays, static = eqx.partition((method, scene, state, ts, rtol), eqx.is_array)
    specs = jax.tree.map(lambda _: PartitionSpec(), arrays)
    method_specs, scene_specs, *_ = specs
    for name in PARTS:
        if getattr(scene, name) is not None:
            part_specs = eqx.filter(map_arrays(getattr(scene, name), split.spec), _is_spec)
            part_specs = eqx.combine(part_specs, getattr(scene_specs, name), is_leaf=_is_spec)
            scene_specs = eqx.tree_at(
                lambda s, name=name: getattr(s, name), scene_specs, part_specs
            )
    state_specs = map_arrays(state, split.spec)
    in_specs = (method_specs, scene_specs, state_specs, split.spec(ts, 1), PartitionSpec())
    return jax.shard_map(
        lambda arrays: fn(*eqx.combine(arrays, static)),
        mesh=split.mesh,
        in_specs=(in_specs,),
        out_specs=PartitionSpec(*split.axes),
        check_vma=False,
    )(arrays)


def _is_spec(x: Any) -> bool:
    return isinstance(x, PartitionSpec)


# Keys: a trajectory is indexed like an array of samples, bodies first, then times.


def is_integer(key: Any) -> bool:
    """Whether a key is a single integer, which removes an axis."""
    if isinstance(key, bool | np.bool_):
        return False
    if hasattr(key, "shape"):
        return key.shape == () and np.issubdtype(key.dtype, np.integer)
    return isinstance(key, int | np.integer)


def _entry(key: Any) -> Any:
    """One entry of a key; lists are converted to arrays."""
    if key is Ellipsis or isinstance(key, slice) or is_integer(key):
        return key
    array = key if isinstance(key, jax.Array) else np.asarray(key)
    if array.ndim and (array.dtype == np.bool_ or np.issubdtype(array.dtype, np.integer)):
        return array
    raise IndexError(
        "a trajectory is indexed by integers, slices, ... and arrays of integers or truth values,"
        f" bodies first and then times, got {key!r:.60}; for the motion at a time in seconds use"
        " traj.at(t)."
    )


def _axes_of(key: Any) -> int:
    """Number of axes that an entry indexes."""
    return key.ndim if getattr(key, "dtype", None) == np.bool_ else 1


def split_key(key: Any, rank: int) -> tuple[tuple[Any, ...], Any]:
    """The entries for the ``rank`` axes of bodies, and the entry for the times."""
    entries = [_entry(k) for k in (key if isinstance(key, tuple) else (key,))]
    dots = [i for i, k in enumerate(entries) if k is Ellipsis]
    count = sum(_axes_of(k) for k in entries if k is not Ellipsis)
    if len(dots) > 1 or count > rank + 1:
        raise IndexError(
            f"this trajectory has {rank + 1} axes to index, {rank} of bodies and one of times, got"
            f" {len(entries)} entries."
        )
    place = dots[0] if dots else len(entries)
    full_key = entries[:place] + [slice(None)] * (rank + 1 - count) + entries[place + 1 :]
    *bodies, times = full_key
    if _axes_of(times) != 1:
        raise IndexError("truth values that choose samples must have one axis, that of the times.")
    return tuple(bodies), times


def ends_at_last(times: tuple[Any, ...]) -> bool:
    """Whether the entry for the times selects the last sample as its last one, for any T."""
    (key,) = times
    return isinstance(key, slice) and key.stop is None and key.step in (None, 1)


def check_key(key: Any, shape: tuple[int, ...], what: str) -> None:
    """IndexError for a concrete key outside of the shape; JAX would take the nearest entry."""
    if not is_concrete(key):
        return
    concrete = key if isinstance(key, tuple) else (key,)
    concrete = tuple(k if isinstance(k, slice) else np.asarray(k) for k in concrete)
    try:
        np.broadcast_to(np.int8(0), shape)[concrete]
    except IndexError as error:
        raise IndexError(f"there are {what} of shape {shape}, got {key!r:.60}: {error}.") from None
