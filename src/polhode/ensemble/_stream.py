"""Simulation of an ensemble into a store, in this process or on a dask cluster; it can be resumed.

Bodies are computed in blocks, and chunks consist of blocks. Vectorised loops treat the last lanes
of an array differently from the others, and adaptive solvers share steps within a group of lanes.
The result of a body therefore depends on its place in the compiled block. The size of a block
depends on the number of samples alone, and body i is always at place i modulo that size, so that
chunk size, number of devices and number of processes do not change any bit of the results.
"""

import collections
import concurrent.futures
import contextlib
import dataclasses
import functools
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode._checks import ArrayLike
from polhode._extras import imported
from polhode._method import AbstractMethod, Record, check_inputs, check_method, check_rtol
from polhode._plan import choose
from polhode._policy import kind_of, platform_of
from polhode._simulate import run
from polhode.ensemble._ensemble import Ensemble, draw
from polhode.ensemble._statistics import Statistic, summarise, write_summaries
from polhode.ensemble._store import (
    Field,
    Store,
    StoreError,
    compare_identity,
    create,
    digest,
    has_user_code,
    make_layout,
    plain_number,
    versions,
)

_SAMPLES, _MIN_BODIES, _MAX_BODIES = 2**20, 2**4, 2**13


def block_size(samples: int) -> int:
    """Bodies of a block: a power of two from 16 to 8192 with about a million samples or fewer."""
    bodies = max(_MIN_BODIES, min(_MAX_BODIES, _SAMPLES // samples))
    return 1 << (bodies.bit_length() - 1)


class Block:
    """``Block(...)(first_body)`` computes the block that starts at this body, and returns device
    arrays by name. Blocks are assigned to the devices in turn, each computed by the same
    single-device program, so that the results do not depend on the number of devices.
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
        _, _, ts, _ = check_inputs(ensemble.scene, ensemble.state, ts, Record())
        if ts.ndim != 1:
            raise ValueError(f"the bodies of an ensemble share their times (T,), got {ts.shape}.")
        self.ensemble, self.ts, self.devices = ensemble, ts, tuple(devices)
        self.size = block_size(ts.shape[0])
        self.rtol = check_rtol(rtol, ts.dtype)
        if method is None:
            # The choice depends on drawn bodies, not on the nominal one: spreads may break its
            # symmetry. ``draw`` is a closure because NumPy reads its rows, which cannot be traced.
            drawn, _ = eqx.filter_eval_shape(lambda: ensemble.draw(np.zeros(1, int)))
            method, _ = choose(drawn, self.rtol)
        self.method = method
        self.settings = Settings(self.size, trajectories, statistics)
        self.counts = np.array([ensemble.seed, ensemble.bodies], np.uint32)
        self.compiled: list[Any] = []

    def inputs(self, first_body: int) -> tuple:
        """The arguments of ``program``, on its device, for the block starting at ``first_body``."""
        device = self.devices[first_body // self.size % len(self.devices)]
        indices = np.arange(first_body, first_body + self.size)
        lane_parts, shared = self.ensemble.lanes(np.minimum(indices, self.ensemble.bodies - 1))
        start = np.asarray(first_body, np.uint32)
        shared = (shared, self.ensemble.spreads, self.method, self.ts, self.rtol, self.counts)
        arrays, static = eqx.partition((start, lane_parts, shared), eqx.is_array_like)
        return *eqx.combine(jax.device_put(arrays, device), static), self.settings

    def __call__(self, first_body: int) -> dict[str, Array]:
        if not self.compiled:
            self.compile()
        return self.compiled[first_body // self.size % len(self.devices)](*self.inputs(first_body))

    def compile(self) -> None:
        """Compile the program for all devices in parallel. Tracing takes place in the calling
        thread, whose settings (such as ``jax.enable_x64``) apply.
        """
        count = min(len(self.devices), -(-self.ensemble.bodies // self.size))
        lowered = [program.lower(*self.inputs(k * self.size)) for k in range(count)]
        with concurrent.futures.ThreadPoolExecutor(count) as threads:
            self.compiled = list(
                threads.map(lambda lowered_program: lowered_program.compile(), lowered)
            )


class Settings(NamedTuple):
    """The static arguments of ``program``."""

    size: int
    trajectories: bool
    statistics: tuple[Statistic, ...]


@eqx.filter_jit
def program(
    first_body: Array, lane_parts: Any, shared: Any, settings: Settings
) -> dict[str, Array]:
    """One block on one device. Compiled once for each device and combination of static values."""
    shared, spreads, method, ts, rtol, (seed, bodies) = shared
    indices = first_body + jnp.arange(settings.size, dtype=jnp.uint32)
    scene, state = draw(lane_parts, shared, indices, spreads, seed)
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

    Every device computes one block at a time. The result of a body depends on its index, the seed
    and the scene alone: not on the size of the chunk, the number of devices or earlier results.
    """
    first_body, end_body = k * chunk, min((k + 1) * chunk, block.ensemble.bodies)
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
            row = (start - first_body) // (block.size if axis == "block" else 1)
            array[row : row + len(part)] = part[: len(array) - row]

    for start in range(first_body, end_body, block.size):
        if len(pending) == len(block.devices):
            collect()
        pending.append((start, block(start)))
    while pending:
        collect()
    return arrays


_CHUNK_BYTES = 2**26  # target size of a chunk with trajectories, if ``chunk`` is not given
_STATISTICS_BLOCKS = 64  # blocks of a chunk if only statistics are stored
_PROCESS_BYTES = 600_000_000  # memory of Python, JAX and the compiled program
_DEFAULT_MEMORY = 4_000_000_000
_COPIES = 4  # copies of a chunk in memory while it is computed, compressed and written


class Progress(NamedTuple):
    """Progress of a run: ``done`` of ``total`` bodies, ``reused`` of them computed earlier;
    ``rate`` [bodies/s] and ``remaining`` time [s], None before the first chunk is computed.
    """

    done: int
    total: int
    reused: int
    rate: float | None
    remaining: float | None


def stream(
    ensemble: Ensemble,
    ts: Float[ArrayLike, " t"],
    path: str | os.PathLike,
    *,
    name: str | None = None,
    method: AbstractMethod | None = None,
    rtol: float | None = None,
    trajectories: bool = True,
    statistics: Sequence[Statistic] = (),
    memory: int | None = None,
    chunk: int | None = None,
    devices: Sequence[Any] | None = None,
    part: tuple[int, int] | None = None,
    scheduler: Any = None,
    attributes: Mapping[str, str] | None = None,
    progress: Callable[[Progress], None] = lambda _: None,
) -> Path:
    """Simulate all bodies at the times ``ts`` (T,) [s] into the Zarr store ``path``; returns it.

    Repeating the call resumes an interrupted run: it verifies the existing chunks and computes
    those that are missing or damaged. The resulting store is bit-identical to that of an
    uninterrupted run. Chunks are separate files, each written atomically, so that any number of
    processes may write to one store.

    - ``name``: a name of the run, which is compared with that of an existing store. Required where
      the ensemble, the method or a statistic contains functions or classes of your own, because
      their code is not compared. Numbers, structure, seed, tolerance and versions always are.
    - ``method``, ``rtol``: as in ``ph.simulate``.
    - ``trajectories``, ``statistics``: what is stored in addition to the status of each body.
    - ``memory``: limit [bytes] that determines the size of a chunk; ``chunk``: bodies per chunk
      instead, a multiple of the block (docs/scale.md, Reproducibility). The chunk size of an
      existing store does not change.
    - ``devices``: local JAX devices among which the bodies are divided; None: the first one.
    - ``part``: (i, n) computes every n-th chunk starting with the i-th, i from 1 to n; the chunk
      size then allows n parts. The statistics are reduced by a call without ``part`` after all
      chunks are complete.
    - ``scheduler``: the address or the ``dask.distributed.Client`` of a cluster that computes the
      chunks; None: the active client of this process, or this process if there is none.
    - ``attributes``: texts to store, such as the scene file; they are compared as well.
    - ``progress``: called after each chunk.

    Raises ``polhode.ensemble.StoreError`` for a store of another run, damaged metadata or a full
    disk, and ValueError for invalid options.
    """
    path = Path(path).resolve()
    statistics, attributes = tuple(statistics), dict(attributes or {})
    _check(ensemble, method, name, trajectories, statistics, part)
    devices = [jax.local_devices()[0]] if devices is None else list(devices)
    job = Job(ensemble, ts, path, method, rtol, trajectories, statistics, devices)
    size = chunk_sizes(job, memory, chunk, 1 if part is None else part[1])
    identity = job.identity(name)
    with contextlib.ExitStack() as stack:
        client = None
        if part is None or scheduler is not None:
            client = stack.enter_context(_connection(scheduler))
        if not os.path.lexists(path):
            metadata = _title() | {"devices": device_names(devices)} | attributes
            full_identity = identity | {"chunk": size.chunk}
            create(path, job.times, job.layout(size.chunk), metadata, full_identity)
        store = job.open(compare_identity(path, identity, attributes)["chunk"])
        first_chunk, step = (0, 1) if part is None else (part[0] - 1, part[1])
        numbers = range(first_chunk, store.chunks, step)
        tally = _Tally(job, numbers, progress)
        if client is None:
            completed_chunks = _complete_here(job, numbers, size.concurrent)
        else:
            completed_chunks = _completed(client, job, numbers)
        stack.enter_context(contextlib.closing(completed_chunks))
        for k, computed in completed_chunks:
            tally.add(k, computed)
    if part is None:
        write_summaries(store, statistics)
        store.remove_partial()
    return path


def _check(ensemble, method, name, trajectories, statistics, part) -> None:
    if not trajectories and not statistics:
        raise ValueError("nothing to store: give statistics, or trajectories=True.")
    if len({s.name for s in statistics}) < len(statistics):
        raise ValueError("two statistics have the same name: give each its own.")
    if part is not None and not 1 <= part[0] <= part[1]:
        raise ValueError(f"part must be (i, n) with i from 1 to n, got {part}.")
    quantities = [s.quantity for s in statistics]
    if name is None and has_user_code((ensemble, method, quantities)):
        raise ValueError(
            "this ensemble contains functions or classes of your own, whose code a store cannot"
            ' compare: give name="...", and another one when you change them.'
        )


class Job:
    """An ensemble, its options and its store; ``complete(k)`` computes and writes chunk ``k``."""

    def __init__(
        self,
        ensemble: Ensemble,
        ts: Any,
        path: Path,
        method: AbstractMethod | None,
        rtol: float | None,
        trajectories: bool,
        statistics: tuple[Statistic, ...],
        devices: Sequence[Any],
    ):
        self.arguments = (ensemble, np.asarray(ts), path, method, rtol, trajectories, statistics)
        self.block = Block(ensemble, ts, method, rtol, trajectories, statistics, devices)
        self.times = np.asarray(self.block.ts)
        self.path, self.rtol = path, rtol
        self.trajectories, self.statistics = trajectories, statistics
        self.chunk = 0
        self.store: Store | None = None

    def layout(self, chunk: int) -> dict[str, Field]:
        bodies, block = self.block.ensemble.bodies, self.block.size
        return make_layout(bodies, chunk, block, self.times, self.trajectories, self.statistics)

    def identity(self, name: str | None) -> dict[str, Any]:
        """The JSON that must be equal for two runs to write to one store; without chunk size."""
        block, ensemble = self.block, self.block.ensemble
        parts = (ensemble.scene, ensemble.state, ensemble.spreads, ensemble.rows)
        return {
            "name": name,
            "bodies": ensemble.bodies,
            "seed": ensemble.seed,
            "times": self.times.size,
            "dtype": str(self.times.dtype),
            "rtol": plain_number(self.rtol),
            "block": block.size,
            "trajectories": self.trajectories,
            "statistics": [[s.name, s.low, s.high, s.bins] for s in self.statistics],
            "arrays": sorted(self.layout(block.size)),
            "numbers": digest(*parts, self.times, block.method, self.statistics),
            "platform": platform_of(block.devices[0]),
        } | versions()

    def open(self, chunk: int) -> Store:
        """Open the store, whose chunks have ``chunk`` bodies."""
        self.chunk = chunk
        self.store = Store(self.path, self.times, self.layout(chunk))
        return self.store

    def complete(self, k: int) -> bool:
        """Compute and write chunk ``k`` unless it is complete; returns whether it was computed."""
        assert self.store is not None
        if self.store.is_complete(k):
            return False
        self.store.write(k, compute(self.block, self.store.layout, self.chunk, k))
        return True


class Sizes(NamedTuple):
    """Bodies of a chunk, and the number of chunks that one process computes at a time."""

    chunk: int
    concurrent: int


def chunk_sizes(job: Job, memory: int | None, chunk: int | None, parts: int = 1) -> Sizes:
    """Sizes within ``memory`` bytes, with at least one chunk for each part if there are enough
    blocks. Raises ValueError for an impossible memory or chunk.
    """
    block, devices = job.block.size, len(job.block.devices)
    chunk = plain_number(chunk)
    if chunk is not None and (chunk < 1 or chunk % block):
        raise ValueError(
            f"chunk must be a positive multiple of the block of {block} bodies, got {chunk}: leave"
            f" it out, or give --chunk {max(1, round(chunk / block)) * block} or a multiple of"
            f" {block} (chunk= in Python)."
        )
    block_bytes = block * (7 * job.times.size * job.times.itemsize + 1)
    available = (_DEFAULT_MEMORY if memory is None else memory) - _PROCESS_BYTES

    def required(blocks: int) -> int:
        """Bytes for one chunk of ``blocks`` blocks."""
        return block_bytes * (_COPIES * (blocks if job.trajectories else 1) + 2 * devices)

    if memory is not None and required(1) > available:
        minimum = required(1) + _PROCESS_BYTES
        raise ValueError(
            f"a memory of {memory:,} bytes is too small: raise --memory to"
            f" {math.ceil(minimum / 1e7) / 100}GB or more (memory={minimum} in Python), the minimum"
            " for these times and devices, or save fewer times."
        )
    if chunk is not None:
        blocks = chunk // block
    else:
        target = _CHUNK_BYTES // block_bytes if job.trajectories else _STATISTICS_BLOCKS
        while target > 1 and required(target) > available:
            target //= 2
        # a multiple of the number of devices, since each computes one block at a time
        blocks = devices * -(-target // devices) if target > 0 else 1
        all_blocks = -(-job.block.ensemble.bodies // block)
        blocks = min(blocks, all_blocks, max(1, all_blocks // parts))
    threads = _cores() if platform_of(job.block.devices[0]) == "cpu" else 2
    concurrent = max(1, min(threads, available // required(blocks)))
    return Sizes(blocks * block, int(concurrent))


def _cores() -> int:
    """The processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _complete_here(job: Job, numbers: range, concurrent: int) -> Iterator[tuple[int, bool]]:
    """Complete the chunks in this process, ``concurrent`` at a time; yields (number, whether it was
    computed). Chunks are compressed and written while others are computed.
    """
    assert job.store is not None
    if concurrent == 1:
        yield from ((k, job.complete(k)) for k in numbers)
        return
    if set(numbers).intersection(job.store.missing()):
        job.block.compile()  # once, before the threads start
    x64 = bool(jax.config.jax_enable_x64)  # pyright: ignore[reportAttributeAccessIssue]

    def complete(k: int) -> tuple[int, bool]:
        with jax.enable_x64(x64):  # may be set in the calling thread only
            return k, job.complete(k)

    remaining, running = iter(numbers), set()
    pool = ThreadPoolExecutor(concurrent)
    try:
        while True:
            for k in remaining:
                running.add(pool.submit(complete, k))
                if len(running) == concurrent:
                    break
            if not running:
                return
            finished, running = wait(running, return_when=FIRST_COMPLETED)
            yield from (future.result() for future in finished)
    except Exception:
        pool.shutdown(cancel_futures=True)
        raise
    finally:  # an interrupt does not wait for the chunks that are being computed
        pool.shutdown(wait=False, cancel_futures=True)


class _Tally:
    """Counts finished bodies and reports progress. Chunks with existing files count as reused until
    they are found damaged and computed again.
    """

    def __init__(self, job: Job, numbers: range, progress: Callable[[Progress], None]):
        assert job.store is not None
        self.chunk, self.bodies, self.progress = job.chunk, job.block.ensemble.bodies, progress
        missing = set(job.store.missing())
        self.present = {k for k in numbers if k not in missing}
        self.total = sum(map(self.count, numbers))
        self.reused = sum(map(self.count, self.present))
        self.computed = 0
        self.start_time = time.perf_counter()
        self.report()

    def count(self, k: int) -> int:
        return min(self.chunk, self.bodies - k * self.chunk)

    def add(self, k: int, computed: bool) -> None:
        if computed:
            self.computed += self.count(k)
            self.reused -= self.count(k) if k in self.present else 0
        self.report()

    def report(self) -> None:
        count, rate, remaining = self.reused + self.computed, None, None
        if self.computed:
            rate = self.computed / (time.perf_counter() - self.start_time)
            remaining = (self.total - count) / rate
        self.progress(Progress(count, self.total, self.reused, rate, remaining))


def device_names(devices: Sequence[Any]) -> str:
    """Number and kind of the devices."""
    return f"{len(devices)} x {kind_of(devices[0])}"


def _title() -> dict[str, str]:
    """The attributes of every store."""
    from polhode import __version__
    from polhode.files._write import commit

    return {
        "title": "Ensemble of rotating rigid bodies",
        "source": f"polhode {__version__}",
        "polhode_commit": commit(),
        "convention": "wxyz scalar first, body -> space; R = Rz(phi) Ry(theta) Rz(psi)",
    }


# Chunks computed by the workers of a dask cluster, which need access to the store. dask distributes
# the chunk numbers and handles lost workers; each worker builds the job once, and completes chunks
# by the same function as a run without dask.

_RETRIES = 2
# JAX settings that workers copy from the process that starts the run; with the persistent cache,
# they share compiled programs.
_SETTINGS = (
    "jax_enable_x64",
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
)
_BUILD_LOCK = threading.Lock()


@contextlib.contextmanager
def _connection(scheduler: Any) -> Iterator[Any]:
    """The client for an address; a client unchanged; for None the active client, or None.

    Raises StoreError when no scheduler answers.
    """
    if scheduler is None:
        distributed, client = sys.modules.get("distributed"), None
        with contextlib.suppress(ValueError):  # no client is active
            client = None if distributed is None else distributed.default_client()
        yield client
        return
    if not isinstance(scheduler, str):
        yield scheduler
        return
    distributed = imported("a run on a dask cluster", "distributed", extra="dask")
    try:
        client = distributed.Client(scheduler, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise StoreError(f"no dask scheduler answers at {scheduler}: {error}") from error
    with client:
        yield client


def _completed(client: Any, job: Job, numbers: range) -> Iterator[tuple[int, bool]]:
    """Complete the chunks on the workers of a client; yields (number, whether it was computed)."""
    cloudpickle, distributed = (
        imported("a run on a dask cluster", name, extra="dask")
        for name in ("cloudpickle", "distributed")
    )
    settings = {name: getattr(jax.config, name) for name in _SETTINGS}
    ensemble, *arguments = job.arguments
    rows = {name: _reference(x) for name, x in ensemble.rows.items()}
    ensemble = dataclasses.replace(ensemble, rows={})
    message = cloudpickle.dumps((ensemble, rows, arguments, job.chunk, versions()))
    futures = client.map(
        _complete, list(numbers), settings=settings, message=message, pure=False, retries=_RETRIES
    )
    try:
        for _, result in distributed.as_completed(futures, with_results=True, loop=client.loop):
            yield result
    finally:
        client.cancel(futures)


def _complete(k: int, settings: dict[str, Any], message: bytes) -> tuple[int, bool]:
    """Complete chunk ``k``; runs on a worker."""
    with _BUILD_LOCK:
        for name, value in settings.items():  # before 64-bit arrays are unpickled
            if value is not None and getattr(jax.config, name) != value:
                jax.config.update(name, value)
        job = _build(message)
    return k, job.complete(k)


@functools.lru_cache(maxsize=2)
def _build(message: bytes) -> Job:
    import cloudpickle

    ensemble, rows, arguments, chunk, expected = cloudpickle.loads(message)
    if versions() != expected:
        raise StoreError(f"a worker has the versions {versions()}, this run {expected}.")
    rows = {name: _dereference(x) for name, x in rows.items()}
    ensemble = dataclasses.replace(ensemble, rows=rows)
    job = Job(ensemble, *arguments, devices=[jax.local_devices()[0]])
    job.open(chunk)
    job.block.compile()
    return job


def _reference(array: np.ndarray) -> Any:
    """A reference to the file of a memory-mapped array, so that its numbers are not sent; an array
    in memory, or a part of a mapped one, is returned as an array."""
    if not isinstance(array, np.memmap) or isinstance(array.base, np.ndarray):
        return np.asarray(array)
    if array.filename is None:
        return np.asarray(array)
    order = "C" if array.flags.c_contiguous else "F"
    return Path(array.filename).resolve(), array.dtype, array.offset, array.shape, order


def _dereference(reference: Any) -> np.ndarray:
    if isinstance(reference, np.ndarray):
        return reference
    filename, dtype, offset, shape, order = reference
    return np.memmap(filename, dtype, "r", offset, shape, order)
