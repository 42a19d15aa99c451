"""The one compiled program of an ensemble run: a block of bodies, always of the same shape.

Vectorised loops treat the last lanes of an array differently from the others, and adaptive
solvers share steps within a group of lanes. A body's result therefore depends on its place in
the compiled block. Blocks have a size that only the number of samples decides, and body i always
stands at place i modulo that size: chunk size, device count and process count change nothing.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float

from polhode._methods import AbstractMethod, Record
from polhode._plan import choose
from polhode._simulate import check_inputs, check_method, check_rtol, run
from polhode.ensemble._ensemble import Ensemble, draw
from polhode.ensemble._statistics import Statistic, summarise

_SAMPLES, _LEAST, _MOST = 2**20, 2**4, 2**13


def block_size(samples: int) -> int:
    """Bodies of a block: a power of two from 16 to 8192 with about a million samples or fewer."""
    wanted = max(_LEAST, min(_MOST, _SAMPLES // samples))
    return 1 << (wanted.bit_length() - 1)


class Block:
    """``Block(...)(first)`` computes the blocks that start at the bodies ``first`` (one for each
    device), and returns device arrays: the dictionary of what is kept.
    """

    def __init__(
        self,
        ensemble: Ensemble,
        ts: Float[Array, " t"],
        method: AbstractMethod | None,
        rtol: float | None,
        trajectories: bool,
        statistics: tuple[Statistic, ...],
        devices: Sequence[Any],
    ):
        check_method(method)
        scene, state, ts, record = check_inputs(ensemble.scene, ensemble.state, ts, Record())
        if ts.ndim != 1:
            raise ValueError(f"the bodies of an ensemble share their times (T,), got {ts.shape}.")
        self.ensemble, self.ts, self.devices = ensemble, ts, tuple(devices)
        self.size = block_size(ts.shape[0])
        if method is None:
            # by structure alone: the values differ from body to body
            method = eqx.filter_eval_shape(lambda s, x: _Chosen(choose(s, x, record)[0]), scene,
                                           state).method  # fmt: skip
        self.method = method
        self.rtol = check_rtol(rtol, ts.dtype)
        mesh = None
        self.place = None
        if len(self.devices) > 1:
            mesh = Mesh(np.array(self.devices), ("body",))
            self.place = NamedSharding(mesh, PartitionSpec("body"))
        self.settings = Settings(self.size, trajectories, statistics, mesh)
        self.counts = np.array([ensemble.seed, ensemble.bodies], np.uint32)

    def inputs(self, first: int) -> tuple:
        """The arguments of ``program`` for the group of blocks from the body ``first``."""
        count = len(self.devices)
        starts = np.asarray([first + i * self.size for i in range(count)], np.uint32)
        indices = np.arange(first, first + count * self.size)
        each, shared = self.ensemble.lanes(np.minimum(indices, self.ensemble.bodies - 1))
        place = self.devices[0] if self.place is None else self.place
        starts, each = jax.device_put((starts, each), place)
        shared = (shared, self.ensemble.spreads, self.method, self.ts, self.rtol, self.counts)
        return starts, each, shared, self.settings

    def __call__(self, first: int) -> dict[str, Array]:
        return program(*self.inputs(first))


class Settings(NamedTuple):
    """What the program is compiled for, beside the shapes."""

    size: int
    trajectories: bool
    statistics: tuple[Statistic, ...]
    mesh: Mesh | None


@eqx.filter_jit
def program(first: Array, each: Any, shared: Any, settings: Settings) -> dict[str, Array]:
    """One block on each device; nothing goes from one to another. Compiled once per kind of run."""
    if settings.mesh is None:
        return _block(first, each, shared, settings)
    arrays, rest = eqx.partition(shared, eqx.is_array_like)
    each_arrays, each_rest = eqx.partition(each, eqx.is_array)

    def local(first, each_arrays, arrays):
        return _block(
            first, eqx.combine(each_arrays, each_rest), eqx.combine(arrays, rest), settings
        )

    split = PartitionSpec("body")
    return jax.shard_map(
        local, mesh=settings.mesh, in_specs=(split, split, PartitionSpec()), out_specs=split,
        check_vma=False,
    )(first, each_arrays, arrays)  # fmt: skip


def _block(first, each, shared, settings: Settings) -> dict[str, Array]:
    shared, spreads, method, ts, rtol, (seed, bodies) = shared
    indices = first[0] + jnp.arange(settings.size, dtype=jnp.uint32)
    drawn = draw(each, shared, indices, spreads, seed)
    trajectory = run(method, *drawn, ts, rtol, Record())
    real = indices < bodies
    kept = {"status": trajectory.status.astype(jnp.int8)}
    if settings.trajectories:
        kept |= {"wxyz": trajectory.wxyz, "omega_body": trajectory.omega_body}
    for statistic in settings.statistics:
        found = summarise(statistic, trajectory, real)
        kept |= {f"{statistic.name}_{name}": x[None] for name, x in found.items()}
    return kept


class _Chosen(eqx.Module):
    method: AbstractMethod
