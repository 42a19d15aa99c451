"""The one compiled program of an ensemble run, a block of bodies, and the chunks made of blocks.

Vectorised loops treat the last lanes of an array differently from the others, and adaptive
solvers share steps within a group of lanes. A body's result therefore depends on its place in
the compiled block. Blocks have a size that only the number of samples decides, and body i always
stands at place i modulo that size: chunk size, device count and process count change nothing.
"""

import collections
import concurrent.futures
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode._method import AbstractMethod, Record, check_inputs, check_method, check_rtol
from polhode._plan import choose
from polhode._simulate import run
from polhode.ensemble._ensemble import Ensemble, draw
from polhode.ensemble._statistics import Statistic, summarise
from polhode.ensemble._store import Field

_SAMPLES, _MIN_BODIES, _MAX_BODIES = 2**20, 2**4, 2**13


def block_size(samples: int) -> int:
    """Bodies of a block: a power of two from 16 to 8192 with about a million samples or fewer."""
    bodies = max(_MIN_BODIES, min(_MAX_BODIES, _SAMPLES // samples))
    return 1 << (bodies.bit_length() - 1)


class Block:
    """``Block(...)(first)`` computes the block that starts at the body ``first``, and returns
    device arrays by name. Blocks go to the devices in turn, each by the
    same program of one device: how many devices there are changes no bit.
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
        scene, _, ts, _ = check_inputs(ensemble.scene, ensemble.state, ts, Record())
        if ts.ndim != 1:
            raise ValueError(f"the bodies of an ensemble share their times (T,), got {ts.shape}.")
        self.ensemble, self.ts, self.devices = ensemble, ts, tuple(devices)
        self.size = block_size(ts.shape[0])
        if method is None:
            method, _ = choose(scene)
        self.method = method
        self.rtol = check_rtol(rtol, ts.dtype)
        self.settings = Settings(self.size, trajectories, statistics)
        self.counts = np.array([ensemble.seed, ensemble.bodies], np.uint32)
        self.compiled: list[Any] = []

    def inputs(self, first: int) -> tuple:
        """The arguments of ``program`` for the block from the body ``first``, on its device."""
        device = self.devices[first // self.size % len(self.devices)]
        indices = np.arange(first, first + self.size)
        each, shared = self.ensemble.lanes(np.minimum(indices, self.ensemble.bodies - 1))
        start = np.asarray(first, np.uint32)
        shared = (shared, self.ensemble.spreads, self.method, self.ts, self.rtol, self.counts)
        arrays, static = eqx.partition((start, each, shared), eqx.is_array_like)
        return *eqx.combine(jax.device_put(arrays, device), static), self.settings

    def __call__(self, first: int) -> dict[str, Array]:
        if not self.compiled:
            self.compile()
        return self.compiled[first // self.size % len(self.devices)](*self.inputs(first))

    def compile(self) -> None:
        """Compile the program for all devices at the same time. It is traced in the calling thread,
        whose settings (such as those of ``jax.enable_x64``) apply.
        """
        count = min(len(self.devices), -(-self.ensemble.bodies // self.size))
        lowered = [program.lower(*self.inputs(k * self.size)) for k in range(count)]
        with concurrent.futures.ThreadPoolExecutor(count) as threads:
            self.compiled = list(threads.map(lambda one: one.compile(), lowered))


class Settings(NamedTuple):
    """What the program is compiled for, beside the shapes."""

    size: int
    trajectories: bool
    statistics: tuple[Statistic, ...]


@eqx.filter_jit
def program(first: Array, each: Any, shared: Any, settings: Settings) -> dict[str, Array]:
    """One block on one device. Compiled once per kind of run and device."""
    shared, spreads, method, ts, rtol, (seed, bodies) = shared
    indices = first + jnp.arange(settings.size, dtype=jnp.uint32)
    scene, state = draw(each, shared, indices, spreads, seed)
    trajectory = run(method, scene, state, ts, rtol, Record())
    arrays = {"status": trajectory.status.astype(jnp.uint8)}
    if settings.trajectories:
        arrays |= {"wxyz": trajectory.wxyz, "omega_body": trajectory.omega_body}
    for statistic in settings.statistics:
        summary = summarise(statistic, trajectory, indices < bodies)
        arrays |= {f"{statistic.name}_{name}": x[None] for name, x in summary.items()}
    return arrays


def compute(block: Block, layout: Mapping[str, Field], chunk: int, k: int) -> dict[str, np.ndarray]:
    """The arrays of chunk ``k``, the bodies from ``k * chunk`` on, by name.

    Every device computes one block at a time. The result depends on ``k``, the seed and the scene
    alone: not on the size of the chunk, the number of devices or what was computed before.
    """
    first, last = k * chunk, min((k + 1) * chunk, block.ensemble.bodies)
    arrays = {}
    for name, field in layout.items():
        rows = field.region(k)
        arrays[name] = np.zeros((rows.stop - rows.start, *field.shape[1:]), field.dtype)
    pending: collections.deque = collections.deque()

    def collect() -> None:
        start, values = pending.popleft()
        for name, array in arrays.items():
            part = np.asarray(values[name])
            axis = layout[name].dimensions[0]
            if axis == "chunk":
                array[0] += part.sum(axis=0)
                continue
            row = (start - first) // (block.size if axis == "block" else 1)
            array[row : row + len(part)] = part[: len(array) - row]

    for start in range(first, last, block.size):
        if len(pending) == len(block.devices):
            collect()
        pending.append((start, block(start)))
    while pending:
        collect()
    return arrays
