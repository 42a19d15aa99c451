"""The chunks of an ensemble computed by the workers of a dask cluster, which must see the store.

dask sends the numbers of chunks to its workers and handles those that are lost; each worker builds
the job once, and completes chunks by the same function as a run without dask.
"""

import contextlib
import dataclasses
import functools
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from polhode._extras import imported
from polhode.ensemble._store import StoreError, versions

if TYPE_CHECKING:
    from polhode.ensemble._stream import Job

_RETRIES = 2
# of the process that starts the run; a worker shares its cache of compiled programs
_SETTINGS = (
    "jax_enable_x64",
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
)
_BUILD_LOCK = threading.Lock()


@contextlib.contextmanager
def connection(scheduler: Any) -> Iterator[Any]:
    """The client of an address; a client as it is; for None the active client, or None.

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


def complete(client: Any, job: "Job", numbers: range) -> Iterator[tuple[int, bool]]:
    """Complete the chunks on the workers of a client: (number, whether it was computed) of each."""
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
        for name, value in settings.items():  # before arrays of 64 bits are unpickled
            if value is not None and getattr(jax.config, name) != value:
                jax.config.update(name, value)
        job = _build(message)
    return k, job.complete(k)


@functools.lru_cache(maxsize=2)
def _build(message: bytes) -> "Job":
    import cloudpickle

    from polhode.ensemble._stream import Job

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
    """A file instead of an array that is mapped from it as a whole."""
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
