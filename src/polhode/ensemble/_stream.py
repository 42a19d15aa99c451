"""Run an ensemble chunk by chunk into a store, and go on where an earlier run stopped."""

import collections
import concurrent.futures
import hashlib
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import ArrayLike, Float

from polhode._methods import AbstractMethod
from polhode.ensemble._ensemble import Ensemble
from polhode.ensemble._program import Block
from polhode.ensemble._statistics import Statistic
from polhode.ensemble._store import Store, create, locked
from polhode.ensemble._summary import write_summaries

_CHUNK_BYTES, _IN_FLIGHT = 2**27, 3  # one chunk being filled, one waiting, one being written
_OWN_MEMORY = 600_000_000  # Python, JAX and the compiled program


class Progress(NamedTuple):
    """Chunks and bodies finished by this process out of its share; ``rate`` bodies/s of this run,
    ``remaining`` seconds (None before the first chunk); ``reused`` bodies were there already.
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
    method: AbstractMethod | None = None,
    rtol: float | None = None,
    trajectories: bool = True,
    statistics: Sequence[Statistic] = (),
    memory: int | None = None,
    chunk: int | None = None,
    devices: Sequence[Any] | None = None,
    process: int = 0,
    processes: int = 1,
    attributes: dict[str, str] | None = None,
    progress: Callable[[Progress], None] = lambda _: None,
) -> Path:
    """Simulate all bodies at the times ``ts`` (T,) [s] into the Zarr store ``path``; returns it.

    The same call again finishes what an earlier one left: finished chunks are checked and kept,
    damaged ones computed again, and the result equals that of an undisturbed run to the bit.

    - ``method``, ``rtol``: as in ``ph.simulate``.
    - ``trajectories``, ``statistics``: what is kept; status and number of each body always are.
    - ``memory``: limit [bytes] from which the chunk size follows; ``chunk``: bodies per chunk
      instead, a multiple of the block (``block_size``). A store keeps the chunks it began with.
    - ``devices``: JAX devices to share the bodies among; None: the default one.
    - ``process``, ``processes``: this process takes the chunks whose number is ``process`` modulo
      ``processes``. The last to finish writes the summaries of the statistics.
    - ``attributes``: text to keep in the store, such as the scene file; part of its identity.

    Raises ``polhode.ensemble.StoreError`` for a store of another scene or version, in use, or on
    a full disk, and ValueError for a chunk or memory that does not fit.
    """
    path = Path(path).resolve()
    statistics = tuple(statistics)
    if not 0 <= process < processes:
        raise ValueError(f"process must be from 0 to {processes - 1}, got {process}.")
    if not trajectories and not statistics:
        raise ValueError("nothing to keep: give statistics, or trajectories=True.")
    if len({s.name for s in statistics}) < len(statistics):
        raise ValueError("two statistics have the same name: give each its own.")
    devices = [jax.devices()[0]] if devices is None else list(devices)
    block = Block(ensemble, ts, method, rtol, trajectories, statistics, devices)
    times = np.asarray(block.ts)
    body_bytes = 7 * times.size * times.itemsize * trajectories + 1
    size = _chunk(block.size, ensemble.bodies, body_bytes, len(devices), memory, chunk)
    identity = _identity(block, rtol, trajectories, statistics, attributes or {})
    with locked(path, process, processes):
        if not path.exists():
            layout = _layout(ensemble.bodies, size, block.size, times, trajectories, statistics)
            create(path, identity, size, times, layout, _words(attributes or {}))
        store = Store(path, identity)
        if processes == 1:
            store.sweep()
        _fill(store, block, statistics, range(process, store.marks.shape[0], processes), progress)
        if store.finished().all():
            write_summaries(store, statistics)
    return path


def _chunk(block, bodies, body_bytes, devices, memory, chunk) -> int:
    """Bodies of a chunk, a multiple of the block."""
    if chunk is not None:
        if chunk < 1 or chunk % block:
            raise ValueError(
                f"chunk must be a positive multiple of the block of {block} bodies, got {chunk}."
            )
        return chunk
    budget = _CHUNK_BYTES
    if memory is not None:
        budget = min(budget, (memory - _OWN_MEMORY) // (_IN_FLIGHT + 2 * devices))
        if budget < block * body_bytes:
            least = _OWN_MEMORY + block * body_bytes * (_IN_FLIGHT + 2 * devices)
            raise ValueError(
                f"a memory of {memory:,} bytes is too small: {least:,} are the least for these"
                " times; raise it, or save fewer times."
            )
    blocks = max(1, budget // (block * body_bytes))
    return min(blocks, -(-bodies // block)) * block


def _identity(block: Block, rtol, trajectories, statistics, attributes) -> dict[str, Any]:
    """What two runs must share for their chunks to belong together, as plain JSON."""
    from polhode import __version__

    ensemble = block.ensemble
    digest = hashlib.sha256()
    numbers, rest = eqx.partition((ensemble, block.ts, block.method), eqx.is_array)
    for leaf in jax.tree.leaves(numbers):
        digest.update(f"{leaf.dtype}{leaf.shape}".encode() + np.asarray(leaf).tobytes())
    # functions have no address in here that would change from run to run
    names = [getattr(x, "__qualname__", repr(x)) for x in jax.tree.leaves(rest)]
    kinds = [type(s).__name__ for s in ensemble.spreads]
    digest.update(repr((names, kinds, type(block.method).__name__, attributes)).encode())
    kept = [[s.name, s.low, s.high, s.bins] for s in statistics]
    return {
        "bodies": ensemble.bodies,
        "seed": ensemble.seed,
        "times": int(block.ts.size),
        "dtype": str(block.ts.dtype),
        "rtol": rtol,
        "block": block.size,
        "trajectories": trajectories,
        "statistics": kept,
        "scene": digest.hexdigest(),
        "polhode": __version__,
        "jax": jax.__version__,
        "platform": block.devices[0].platform,
    }


def _words(attributes: dict[str, str]) -> dict[str, str]:
    from polhode import __version__

    return {
        "title": "Ensemble of rotating rigid bodies",
        "source": f"polhode {__version__}",
        "convention": "wxyz scalar first, body -> space; R = Rz(phi) Ry(theta) Rz(psi)",
    } | attributes


def _layout(bodies, chunk, block, times, trajectories, statistics) -> dict[str, tuple]:
    """Arrays of the store: name -> (shape, rows per chunk, dtype, dimensions, attributes)."""
    t = times.size
    layout: dict[str, tuple] = {
        "status": ((bodies,), chunk, "int8", ("body",),
                   {"units": "1", "long_name": "outcome per body (0: finished, -1: not computed)"}),
    }  # fmt: skip
    if trajectories:
        wxyz = {"units": "1", "long_name": "attitude quaternion, scalar first, body to space"}
        omega = {"units": "rad s-1", "long_name": "angular velocity in body axes"}
        layout["wxyz"] = (
            (bodies, t, 4), chunk, times.dtype, ("body", "time", "quaternion"), wxyz,
        )  # fmt: skip
        layout["omega_body"] = ((bodies, t, 3), chunk, times.dtype, ("body", "time", "axis"), omega)
    blocks, chunks = -(-bodies // block), -(-bodies // chunk)
    for s in statistics:
        for name in ("count", "mean", "squares", "least", "greatest"):
            layout[f"{s.name}_{name}"] = (
                (blocks, t), chunk // block, "int32" if name == "count" else times.dtype,
                ("block", "time"), {"long_name": f"{name} of {s.name} in each block of {block}"},
            )  # fmt: skip
        if s.low is not None:
            layout[f"{s.name}_histogram"] = (
                (chunks, t, s.bins + 2), 1, "int64", ("chunk", "time", f"{s.name}_bin"),
                {"long_name": f"bodies per bin of {s.name}, those below and above included"},
            )  # fmt: skip
    return layout


def _fill(store: Store, block: Block, statistics, share: range, progress) -> None:
    """Compute the chunks of the share that are missing or damaged; one thread writes meanwhile."""
    bodies = block.ensemble.bodies
    marked = store.finished()

    def count(number: int) -> int:
        return min(store.chunk, bodies - number * store.chunk)

    todo = [n for n in share if not (marked[n] and store.valid(n))]
    total = sum(map(count, share))
    reused = total - sum(map(count, todo))
    done, began = 0, time.perf_counter()
    progress(Progress(reused, total, reused, None, None))
    waiting: collections.deque = collections.deque()

    def settle() -> None:
        nonlocal done
        number, written = waiting.popleft()
        written.result()
        done += count(number)
        rate = done / (time.perf_counter() - began)
        left = total - reused - done
        progress(Progress(reused + done, total, reused, rate, left / rate))

    with concurrent.futures.ThreadPoolExecutor(1) as writer:
        for number in todo:
            parts = _compute(store, block, number)
            while len(waiting) >= _IN_FLIGHT - 1:
                settle()
            waiting.append((number, writer.submit(store.write, number, parts)))
        while waiting:
            settle()


def _compute(store: Store, block: Block, number: int) -> dict[str, np.ndarray]:
    """All arrays of a chunk. The next group of blocks is on its way while one is copied."""
    rows = {name: store.rows(name, number) for name in store.arrays}
    parts = {
        name: np.zeros((r.stop - r.start, *store.arrays[name].shape[1:]), store.arrays[name].dtype)
        for name, r in rows.items()
    }
    step = block.size * len(block.devices)
    first = number * store.chunk
    last = min(first + store.chunk, block.ensemble.bodies)
    ahead: collections.deque = collections.deque()
    for start in [*range(first, last, step), None, None]:
        if start is not None:
            ahead.append((start - first, block(start)))
        if len(ahead) > 1 or (start is None and ahead):
            offset, found = ahead.popleft()
            _place(parts, offset, found, block.size, last - first)
    return parts


def _place(parts, offset: int, found: dict, size: int, bodies: int) -> None:
    real = -(-(bodies - offset) // size)  # blocks that hold bodies of this chunk
    for name, part in parts.items():
        values = np.asarray(found[name])
        if name.endswith("_histogram"):
            part[0] += values[:real].sum(axis=0)
            continue
        per_body = name in ("status", "wxyz", "omega_body")
        at = offset if per_body else offset // size
        count = min(len(values), len(part) - at)
        part[at : at + count] = values[:count]
