"""Run an ensemble chunk by chunk into a store, and go on where an earlier run stopped."""

import os
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from polhode._checks import ArrayLike
from polhode._method import AbstractMethod
from polhode.ensemble import _layout
from polhode.ensemble._ensemble import Ensemble
from polhode.ensemble._fill import Progress, fill
from polhode.ensemble._identity import digest
from polhode.ensemble._processes import absent
from polhode.ensemble._program import Block
from polhode.ensemble._statistics import Statistic
from polhode.ensemble._store import Store, create, in_turn, locked
from polhode.ensemble._summary import write_summaries


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
    verify: bool = True,
    attributes: dict[str, str] | None = None,
    progress: Callable[[Progress], None] = lambda _: None,
    warn: Callable[[str], None] = warnings.warn,
) -> Path:
    """Simulate all bodies at the times ``ts`` (T,) [s] into the Zarr store ``path``; returns it.

    The same call again finishes what an earlier one left: finished chunks are checked and kept,
    damaged ones computed again, and the result equals that of an undisturbed run to the bit.
    Whatever ends the process costs it one chunk at most.

    - ``method``, ``rtol``: as in ``ph.simulate``.
    - ``trajectories``, ``statistics``: what is kept; status and number of each body always are.
    - ``memory``: limit [bytes] from which the chunk size follows; ``chunk``: bodies per chunk
      instead, a multiple of the block (``block_size``). A store keeps the chunks it began with.
    - ``devices``: local JAX devices to share the bodies among; None: the first one.
    - ``process``, ``processes``: this process takes the chunks whose number is ``process`` modulo
      ``processes``. The last to finish writes the summaries of the statistics; each one tells
      ``warn`` which others have ended and left chunks.
    - ``verify``: read finished chunks and check them while the missing ones are computed; False
      trusts the marks, which are written after the data are on the disk.
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
    devices = [jax.local_devices()[0]] if devices is None else list(devices)
    block = Block(ensemble, ts, method, rtol, trajectories, statistics, devices)
    times = np.asarray(block.ts)
    body_bytes = 7 * times.size * times.itemsize + 1  # to compute, if not to keep
    size = _layout.rows(
        ensemble.bodies, block.size, body_bytes, trajectories, len(devices), memory, chunk
    )
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    on_cores = cores if devices[0].platform == "cpu" else 1
    ahead = len(devices) * _layout.ahead(block.size * body_bytes, on_cores, len(devices), memory)
    identity = _identity(block, rtol, trajectories, statistics, attributes or {})

    def layout(size: _layout.Rows) -> dict[str, _layout.Field]:
        return _layout.fields(ensemble.bodies, size, block.size, times, trajectories, statistics)

    with locked(path, process, processes):
        words = _layout.title(attributes or {})
        if not os.path.lexists(path):
            create(path, identity, size, times, layout(size), words)
        store = Store(path, identity)
        begun = _layout.Rows(store.chunk, store.piece)
        with in_turn(path):
            store.mend(times, layout(begun), words, [device_names(devices)], warn)
        if processes == 1:
            store.sweep()
        fill(store, block, range(process, store.marks.shape[0], processes), verify, ahead, progress)
        if store.finished().all():
            with in_turn(path):
                write_summaries(store, statistics)
        else:
            for words in absent(store, process, processes):
                warn(words)
    return path


def device_names(devices: Sequence[Any]) -> str:
    """Number and kind of the devices, as a store remembers them."""
    return f"{len(devices)} x {devices[0].platform} ({devices[0].device_kind})"


def _identity(block: Block, rtol, trajectories, statistics, attributes) -> dict[str, Any]:
    """What two runs must share for their chunks to belong together, as plain JSON."""
    import diffrax

    from polhode import __version__

    ensemble = block.ensemble
    kept = [[s.name, s.low, s.high, s.bins] for s in statistics]
    parts = (ensemble.scene, ensemble.state, ensemble.spreads, ensemble.rows)
    return {
        "bodies": ensemble.bodies,
        "seed": ensemble.seed,
        "times": int(block.ts.size),
        "dtype": str(block.ts.dtype),
        "rtol": rtol,
        "block": block.size,
        "trajectories": trajectories,
        "statistics": kept,
        "scene": digest(*parts, block.ts, block.method, statistics, attributes),
        "polhode": __version__,
        "jax": jax.__version__,
        "diffrax": diffrax.__version__,
        "platform": block.devices[0].platform,
    }
