"""The Zarr store of an ensemble run: finished chunks stay valid whatever happens to the writer.

A chunk of bodies is one file, or a few, of each array. They are written and synced first, then its
cell of ``checksum``, a file of its own: a chunk counts as finished only when the checksum of what
can be read equals that cell. Nothing else needs to be kept for resuming.
"""

import contextlib
import errno
import json
import os
import secrets
import shutil
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from polhode._extras import imported
from polhode.ensemble._layout import Field, Rows
from polhode.files._atomic import sync
from polhode.files._error import shorten

_MARK = 1 << 32  # above every 32-bit checksum: an empty cell is 0


class StoreError(RuntimeError):
    """A store that cannot be used as asked: of another run, in use, not ours, or a full disk."""


def _zarr() -> Any:
    return imported("an ensemble on disk", "zarr", extra="scale")


@contextlib.contextmanager
def locked(path: Path, process: int, processes: int) -> Iterator[None]:
    """Hold the store for this process; the system lets go when the process ends, however it ends.

    One process holds it alone; of several, each holds its own number and all share the store.
    """
    try:
        import fcntl
    except ImportError as error:  # Windows
        raise StoreError("stores of ensembles need the file locks of Unix") from error

    with contextlib.ExitStack() as stack:

        def hold(name: str, kind: int, who: str) -> None:
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                file = stack.enter_context(open(path.with_name(name), "a"))
            except OSError as error:
                raise StoreError(
                    f"cannot write beside {path}: {error.strerror}; name a place that you can"
                    " write to."
                ) from error
            failure = None
            for trial in range(3):  # others look at a lock for an instant
                try:
                    fcntl.flock(file, kind | fcntl.LOCK_NB)
                    return
                except OSError as error:
                    failure = error
                    time.sleep(0.05 * trial)
            raise StoreError(
                f"{path} is in use by {who}: wait until it ends, or write to another store."
            ) from failure

        alone = processes == 1
        hold(f".{path.name}.lock", fcntl.LOCK_EX if alone else fcntl.LOCK_SH, "another run")
        if not alone:
            hold(f".{path.name}.lock{process}", fcntl.LOCK_EX, f"another process {process}")
        yield


@contextlib.contextmanager
def in_turn(path: Path) -> Iterator[None]:
    """One process after the other: wait for the turn."""
    import fcntl

    with open(path.with_name(f".{path.name}.turn"), "a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def running(path: Path, process: int) -> bool:
    """Whether another process holds the store under this number now."""
    import fcntl

    try:
        with open(path.with_name(f".{path.name}.lock{process}")) as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    return False


class Store:
    """An opened store; ``identity`` is what must agree for a run to go on with it.

    Raises StoreError, and leaves the folder as it is, when it is no store of an ensemble run, its
    settings are damaged, or they are those of another run.
    """

    def __init__(self, path: Path, identity: dict[str, Any]):
        zarr = _zarr()
        self.path = path
        try:
            self.group = zarr.open_group(path, mode="r+", zarr_format=3, use_consolidated=False)
            found = json.loads(self.group.attrs["polhode"])
            if not isinstance(found, dict):
                raise ValueError(f"the attribute polhode is a {type(found).__name__}")
        except Exception as error:  # damaged metadata fail in whichever part reads them first
            raise StoreError(
                f"{path} exists and is no store of an ensemble run ({type(error).__name__}:"
                f" {str(error)[:200]}): it was left as it is; name another path."
            ) from error
        different = [
            f"  {key}: the store has {shorten(found.get(key))}, this run {shorten(value)}"
            for key, value in identity.items()
            if found.get(key) != value
        ]
        if different:
            raise StoreError(
                f"{path} holds another run and was left as it is:\n" + "\n".join(different) + "\n"
                "  to mend: use the scene and versions of the store, or name another path."
            )
        self.chunk: int = found.get("chunk", 0)  # what is missing or no number is refused below
        self.piece: int = found.get("piece", 0)
        unit = identity["block"]
        for name in ("chunk", "piece"):
            value = found.get(name)
            if type(value) is not int or value < 1 or value % unit or self.chunk % value:
                raise StoreError(
                    f"{path}: its setting {name} is {shorten(value)}, expected a multiple of {unit}"
                    " bodies that fits: the store is damaged and was left as it is; name another"
                    " path."
                )

    def mend(
        self, ts: np.ndarray, layout: Mapping[str, Field], attributes: dict[str, Any],
        layouts: Sequence[str], warn: Callable[[str], None],
    ) -> None:  # fmt: skip
        """Compare the arrays with the layout; what is lost or altered is made anew, and where that
        held results, all chunks count as missing. ``layouts``: devices of the runs so far.
        """
        zarr = _zarr()
        self.group = zarr.open_group(self.path, mode="r+", zarr_format=3, use_consolidated=False)
        expected = zarr.create_group(zarr.storage.MemoryStore(), zarr_format=3)
        make = _arrays(expected, ts, layout, -(-layout["status"].shape[0] // self.chunk))
        lost = [name for name in make if not self._is_like(name, expected[name])]
        if lost:
            for name in lost:
                _remove(self.path / name)
                make[name](self.group)
            told = f"{', '.join(lost)} of {self.path} were lost or altered and are made anew"
            if lost != ["time"]:
                _remove(self.path / "checksum")
                make["checksum"](self.group)
                told += "; every chunk is computed again"
            warn(told + ".")
        wanted = attributes | {"devices": sorted({*layouts, *self._devices()})}
        altered = any(self.group.attrs.get(key) != value for key, value in wanted.items())
        if altered:
            self.group.attrs.update(wanted)
        if altered or lost:
            consolidate(self.path)
        # values that equal the fill value are written too: every finished chunk has its files
        with zarr.config.set({"array.write_empty_chunks": True}):
            arrays = {name: self.group[name] for name in make}
        self.marks = arrays["checksum"]
        self.arrays = {name: arrays[name] for name in layout}
        # arrays that may have several files in a chunk
        self.split = sorted({"wxyz", "omega_body"} & layout.keys())

    def _devices(self) -> list[str]:
        found = self.group.attrs.get("devices")
        return [x for x in found if isinstance(x, str)] if isinstance(found, list) else []

    def _is_like(self, name: str, expected: Any) -> bool:
        """Whether an array is there with the metadata, and for times with the values, it began
        with.
        """
        try:
            found = self.group[name]
            same, wanted = (
                json.dumps(array.metadata.to_dict(), sort_keys=True, default=str)
                for array in (found, expected)
            )
            return same == wanted and (name != "time" or np.array_equal(found[...], expected[...]))
        except Exception:  # whatever cannot be read is not like it
            return False

    def sweep(self) -> None:
        """Remove half-written files of a writer that was killed."""
        for file in self.path.rglob("*.partial"):
            file.unlink(missing_ok=True)

    def finished(self) -> np.ndarray:
        """(chunks,) whether a chunk was marked as finished; the data are not looked at."""

        def marked(chunk: int) -> bool:
            try:
                return self.marks[chunk] != 0
            except Exception:
                return False

        try:
            return self.marks[:] != 0
        except Exception:  # one of them is damaged: as if it were not there
            return np.array([marked(chunk) for chunk in range(self.marks.shape[0])])

    def rows(self, name: str, chunk: int) -> slice:
        """The rows of an array that belong to a chunk."""
        step = int(self.arrays[name].attrs["rows_per_chunk"])
        return slice(chunk * step, min((chunk + 1) * step, self.arrays[name].shape[0]))

    def pieces(self, chunk: int) -> Iterator[tuple[str, slice]]:
        """Arrays and rows of the files of a chunk in the order of its checksum: first those of
        the trajectories, piece by piece, then the arrays that have one file in a chunk.
        """
        rest = [n for n in sorted(self.arrays) if n not in self.split]
        for names in (self.split, rest):
            steps = {n: self.arrays[n].chunks[0] for n in names}
            begin = {n: self.rows(n, chunk).start for n in names}
            end = {n: self.rows(n, chunk).stop for n in names}
            while any(begin[n] < end[n] for n in names):
                for n in names:
                    stop = min(begin[n] + steps[n], end[n])
                    yield n, slice(begin[n], stop)
                    begin[n] = stop

    def valid(self, chunk: int) -> bool:
        """Whether the chunk can be read and has the checksum it was given."""
        try:
            found = 0
            for name, rows in self.pieces(chunk):
                found = _extended(found, self.arrays[name][rows])
            return int(self.marks[chunk]) == _MARK | found
        except Exception:  # a damaged file fails in whichever codec meets it first
            return False

    def write(self, name: str, rows: slice, values: np.ndarray, checksum: int) -> int:
        """Write one file of a chunk, on the disk when this returns; the checksum with it."""
        with self._blame():
            self.arrays[name][rows] = values
            self._sync(name, self.arrays[name], rows.start // self.arrays[name].chunks[0])
        return _extended(checksum, values)

    def finish(self, chunk: int, checksum: int) -> None:
        """Mark a chunk, all of whose files are written, as finished."""
        with self._blame():
            self.marks[chunk] = np.uint64(_MARK | checksum)
            self._sync("checksum", self.marks, chunk)

    @contextlib.contextmanager
    def _blame(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                raise StoreError(
                    f"the disk of {self.path} is full: {int(self.finished().sum())} of"
                    f" {self.marks.shape[0]} chunks are finished and kept; make room and give the"
                    " same command again."
                ) from error
            raise

    def _sync(self, name: str, array: Any, piece: int) -> None:
        """Have a file and its name in the folder on the disk."""
        key = array.metadata.encode_chunk_key((piece,) + (0,) * (array.ndim - 1))
        file = self.path / name / key
        sync(file)
        sync(file.parent)


def _remove(path: Path) -> None:
    """What lies in the place of an array, whatever it is."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def consolidate(path: Path) -> None:
    """Gather the metadata of all arrays in one file, which xarray looks for first."""
    with warnings.catch_warnings():
        # Zarr points out that version 3 of its specification does not have this yet
        warnings.simplefilter("ignore", UserWarning)
        _zarr().consolidate_metadata(path, zarr_format=3)


def _extended(checksum: int, values: np.ndarray) -> int:
    """CRC-32C of what came before and of the bytes of an array."""
    crc32c = imported("an ensemble on disk", "google_crc32c", extra="scale")
    view = np.ascontiguousarray(values).view()
    view.setflags(write=False)  # google_crc32c takes nothing that could change meanwhile
    return crc32c.extend(checksum, view)


def _arrays(
    group: Any, ts: np.ndarray, layout: Mapping[str, Field], chunks: int
) -> dict[str, Callable[[Any], None]]:
    """Make the empty arrays of a store in a group; how to make each of them in another one."""
    checked = [_zarr().codecs.Crc32cCodec()]

    def time(group: Any) -> None:
        made = group.create_array(
            "time", shape=ts.shape, chunks=ts.shape, dtype=ts.dtype, dimension_names=("time",),
            attributes={"units": "s", "long_name": "time"},
        )  # fmt: skip
        made[:] = ts

    def one(name: str, field: Field) -> Callable[[Any], None]:
        return lambda group: group.create_array(
            name, shape=field.shape, chunks=(field.piece, *field.shape[1:]), dtype=field.dtype,
            dimension_names=field.dimensions,
            attributes=field.attributes | {"rows_per_chunk": field.rows},
            compressors=checked,
            # what readers see where a chunk is not finished
            fill_value=np.nan if np.issubdtype(field.dtype, np.floating) else -1,
        )  # fmt: skip

    def checksum(group: Any) -> None:
        group.create_array(
            "checksum", shape=(chunks,), chunks=(1,), dtype="uint64", dimension_names=("chunk",),
            attributes={"long_name": "CRC-32C of each finished chunk plus 2^32; 0: not finished"},
            compressors=checked,
        )  # fmt: skip

    make = {"time": time, **{n: one(n, field) for n, field in layout.items()}, "checksum": checksum}
    for fill in make.values():
        fill(group)
    return make


def create(
    path: Path,
    identity: dict[str, Any],
    size: Rows,
    ts: np.ndarray,
    layout: Mapping[str, Field],
    attributes: dict[str, Any],
) -> None:
    """Make an empty store, whole or not at all; nothing happens when another process was faster."""
    zarr = _zarr()
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(6)}.part")
    try:
        settings = json.dumps(identity | {"chunk": size.chunk, "piece": size.piece})
        group = zarr.create_group(
            temporary, zarr_format=3, attributes=attributes | {"polhode": settings}
        )
        _arrays(group, ts, layout, -(-identity["bodies"] // size.chunk))
        consolidate(temporary)
        # a rename does not replace a folder that holds something
        with contextlib.suppress(FileExistsError):
            os.rename(temporary, path)
    except OSError as error:
        if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
            raise StoreError(f"cannot make the store {path}: {error.strerror or error}") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
