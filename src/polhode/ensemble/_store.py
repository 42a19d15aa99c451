"""The Zarr store of an ensemble: one file per chunk and array, written atomically by Zarr.

A chunk is complete when the file of every array exists and can be decoded; crc32c detects files
that were altered or truncated. Nothing else is recorded, so that any number of processes can write
to a store without locks: they write different files, or the same bytes.
"""

import contextlib
import dataclasses
import errno
import glob
import hashlib
import itertools
import json
import os
import re
import secrets
import shutil
import time
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from polhode._extras import imported
from polhode.files._read import reason, shorten

if TYPE_CHECKING:
    import xarray


_LIBRARIES = ("polhode", "jax", "jaxlib", "equinox", "diffrax", "optimistix", "lineax", "numpy")
_DIGEST_BYTES = 2**24  # bytes of an array that ``digest`` reads at a time


class StoreError(RuntimeError):
    """Raised for an unusable store: of another run, damaged, incomplete, or on a full disk."""


def open_store(path: str | os.PathLike) -> "xarray.Dataset":
    """The stored ensemble at ``path`` as an xarray dataset, which is read lazily.

    Raises StoreError for a store whose chunks or statistics are not complete; the message names the
    missing chunks. ``xarray.open_zarr`` reads such a store, with NaN and status 255 in their place.
    """
    path = Path(path)
    if words := missing_chunks(path):
        raise StoreError(f"{path} is not complete: {words}.")
    for name, *_ in _read_identity(path)["statistics"]:
        if not (path / f"{name}_summary_mean" / "zarr.json").is_file():
            raise StoreError(
                f"{path} is not complete: the statistics of its chunks are not reduced yet; run it"
                " once without --part."
            )
    xarray = imported("an ensemble on disk", "xarray", "zarr", extra="scale")
    return xarray.open_zarr(path)


class Field(NamedTuple):
    """One array of a store. ``rows`` rows form a chunk, which is one file."""

    shape: tuple[int, ...]
    rows: int
    dtype: Any
    dimensions: tuple[str, ...]
    attributes: dict[str, Any]

    @property
    def fill_value(self) -> Any:
        """A value that no result can have; it stands for chunks not yet written."""
        if self.dtype == np.uint8:
            return 255
        return np.nan if np.issubdtype(self.dtype, np.floating) else -1

    def region(self, k: int) -> slice:
        """The rows of chunk ``k``."""
        return slice(k * self.rows, min((k + 1) * self.rows, self.shape[0]))


def make_layout(
    bodies: int, chunk: int, block: int, times: np.ndarray, trajectories: bool, statistics: tuple
) -> dict[str, Field]:
    """Arrays of the store by name."""
    from polhode._method import Status

    t = times.size
    status = {
        "units": "1",
        "long_name": "outcome of each body; 255: not computed",
        "flag_values": [int(code) for code in Status],
        "flag_meanings": " ".join(code.name.lower() for code in Status),
    }
    arrays = {"status": Field((bodies,), chunk, np.dtype("uint8"), ("body",), status)}
    if trajectories:
        wxyz = {"units": "1", "long_name": "attitude quaternion, scalar first, body to space"}
        omega = {"units": "rad s-1", "long_name": "angular velocity in body axes"}
        for name, width, axis, words in (
            ("wxyz", 4, "quaternion", wxyz),
            ("omega_body", 3, "axis", omega),
        ):
            dimensions = ("body", "time", axis)
            arrays[name] = Field((bodies, t, width), chunk, times.dtype, dimensions, words)
    blocks, chunks = -(-bodies // block), -(-bodies // chunk)
    for s in statistics:
        for name in ("count", "mean", "squares", "least", "greatest"):
            dtype = np.dtype("int32") if name == "count" else times.dtype
            words = {"long_name": f"{name} of {s.name} in each block of {block}"}
            dimensions = ("block", "time")
            arrays[f"{s.name}_{name}"] = Field(
                (blocks, t), chunk // block, dtype, dimensions, words
            )
        if s.low is not None:
            words = {"long_name": f"bodies per bin of {s.name}, those below and above included"}
            dimensions = ("chunk", "time", f"{s.name}_bin")
            arrays[f"{s.name}_histogram"] = Field(
                (chunks, t, s.bins + 2), 1, np.dtype("int64"), dimensions, words
            )
    return arrays


def create(
    path: Path,
    ts: np.ndarray,
    layout: Mapping[str, Field],
    attributes: Mapping[str, Any],
    identity: Mapping[str, Any],
) -> None:
    """Create an empty store in a temporary folder and rename it. If another process has created the
    store in the meantime, that one is used.
    """
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(6)}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        metadata = dict(attributes) | {"polhode": json.dumps(dict(identity))}
        _write_empty(temporary, ts, layout, metadata)
        try:
            os.rename(temporary, path)
        except OSError as error:  # ``rename`` does not replace a folder that is not empty
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise
    except OSError as error:
        raise StoreError(
            f"cannot make the store {path}: {reason(error)}; name a place that you can write to."
        ) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def compare_identity(
    path: Path, identity: Mapping[str, Any], attributes: Mapping[str, str]
) -> dict[str, Any]:
    """The identity of a store that belongs to this run. Raises StoreError with the differences for
    a store of another run, and for a folder that is not a store.
    """
    stored = _read_identity(path)
    texts = _read_json(path, "zarr.json")["attributes"]
    different = [
        f"  {key}: the store has {shorten(stored.get(key))}, this run {shorten(value)}"
        for key, value in identity.items()
        if stored.get(key) != value
    ]
    for key, text in attributes.items():
        if texts.get(key) != text:
            different.append(f"  {key}: {_first_difference(str(texts.get(key)), text)}")
    if different:
        raise StoreError(
            f"{path} belongs to another run and was left as it is:\n" + "\n".join(different) + "\n"
            "  use the scene, options and versions of the store, or name another path."
        )
    return stored


def _first_difference(stored: str, text: str) -> str:
    """The first line in which two texts differ."""
    lines = itertools.zip_longest(stored.splitlines(), text.splitlines())
    for number, (a, b) in enumerate(lines, 1):
        if a != b:
            return f"line {number} of the store is {shorten(a)}, of this run {shorten(b)}"
    return "the line ends differ"


class Store:
    """The store of a run, opened for writing. Raises StoreError, without changing the folder, if
    its metadata differ from those at its creation.
    """

    def __init__(self, path: Path, ts: np.ndarray, layout: Mapping[str, Field]):
        self.path, self.layout = path, layout
        self.chunks = -(-layout["status"].shape[0] // layout["status"].rows)
        self._compare_metadata(ts)
        zarr = _zarr()
        # Zarr must write chunks that equal the fill value too: without a file a chunk is missing.
        with zarr.config.set({"array.write_empty_chunks": True}):
            self.group = zarr.open_group(path, mode="r+", use_consolidated=False)
            self.arrays = {name: self.group[name] for name in layout}
        self._check_times(ts)

    def _compare_metadata(self, ts: np.ndarray) -> None:
        """Compare every zarr.json with the one that a new store of this run would have."""
        files: dict[str, Any] = {}
        _write_empty(_zarr().storage.MemoryStore(files), ts, self.layout, {})
        root = json.loads(files.pop("zarr.json").to_bytes())
        documents = {
            key: json.loads(buffer.to_bytes())
            for key, buffer in sorted(files.items())
            if key.endswith("zarr.json")
        }
        for key, document in documents.items():
            _require_equal(self.path, key, _read_json(self.path, key), document)
        # only the arrays of the layout are compared: those of ``put`` are added later
        stored = _dictionary(_read_json(self.path, "zarr.json")).get("consolidated_metadata")
        consolidated = _dictionary(_dictionary(stored).get("metadata"))
        for name, document in root["consolidated_metadata"]["metadata"].items():
            key = f"zarr.json (consolidated metadata of {name})"
            _require_equal(self.path, key, consolidated.get(name), document)

    def _check_times(self, ts: np.ndarray) -> None:
        """Write the times again if they are missing or damaged."""
        try:
            same = np.array_equal(self.group["time"][:], ts)
        except Exception:  # the type of the error depends on the codec that fails first
            same = False
        if not same:
            shutil.rmtree(self.path / "time" / "c", ignore_errors=True)
            with self._write_errors():
                self.group["time"][:] = ts

    def file(self, name: str, k: int) -> Path:
        """The file of an array that contains chunk ``k``."""
        return _chunk_file(self.path, name, k, len(self.layout[name].shape))

    def missing(self) -> list[int]:
        """The chunks of which a file is missing; the files are not read."""
        dimensions = {name: len(field.shape) for name, field in self.layout.items()}
        return _missing(self.path, dimensions, self.chunks)

    def read(self, name: str, k: int) -> np.ndarray:
        """The rows of an array in chunk ``k``."""
        return self.arrays[name][self.layout[name].region(k)]

    def is_complete(self, k: int) -> bool:
        """Whether the files of chunk ``k`` exist and can be decoded."""
        try:
            if not all(self.file(name, k).is_file() for name in self.layout):
                return False
            for name in self.layout:
                self.read(name, k)
            return True
        except Exception:  # the type of the error depends on the codec that fails first
            return False

    def write(self, k: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Write chunk ``k``, one file of each array, replacing any existing files."""
        with self._write_errors():
            for name, field in self.layout.items():
                # Zarr would decode the file of a last chunk that is not full, which may be damaged.
                self.file(name, k).unlink(missing_ok=True)
                self.arrays[name][field.region(k)] = arrays[name]

    def remove_partial(self) -> None:
        """Remove partial files of killed processes, but not those that others may still write."""
        for file in self.path.rglob("*.partial"):
            if _is_abandoned(file):
                file.unlink(missing_ok=True)
        for folder in self.path.parent.glob(f".{glob.escape(self.path.name)}.*.partial"):
            if _is_abandoned(folder):
                shutil.rmtree(folder, ignore_errors=True)

    @contextlib.contextmanager
    def _write_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                raise StoreError(
                    f"the disk of {self.path} is full: {self.chunks - len(self.missing())} of"
                    f" {self.chunks} chunks are complete and remain; free some space and run the"
                    " same command again."
                ) from error
            raise StoreError(f"cannot write to {self.path}: {reason(error)}.") from error

    def put(self, name: str, values: np.ndarray, dimensions: tuple, units: str) -> None:
        """Write a small array in one chunk."""
        zarr = _zarr()

        def make(group, overwrite=False):
            return group.create_array(
                name,
                shape=values.shape,
                chunks=values.shape,
                dtype=values.dtype,
                dimension_names=dimensions,
                attributes={"units": units},
                compressors=_codecs(),
                overwrite=overwrite,
            )

        # The metadata of an undamaged array are not rewritten, only the file of its single chunk:
        # another process may write the same values to it at the same time.
        expected = make(zarr.create_group(zarr.storage.MemoryStore())).metadata
        with self._write_errors():
            if not (self.path / name / "zarr.json").exists():
                with contextlib.suppress(zarr.errors.ContainsArrayError):
                    make(self.group)
            try:
                array = self.group[name]
                is_sound = array.metadata == expected
            except Exception:  # damaged metadata: the type of the error depends on the library
                is_sound = False
            if not is_sound:
                array = make(self.group, overwrite=True)
            array[...] = values

    def consolidate(self) -> None:
        """Consolidate the metadata of all arrays in one file, which xarray reads first."""
        with self._write_errors():
            _consolidate(self.path)


_ABANDONED = 600.0
"""Time without change [s] after which a partial file is regarded as abandoned by its process."""


def _is_abandoned(path: Path) -> bool:
    try:
        return time.time() - path.stat().st_mtime > _ABANDONED
    except OSError:  # renamed or removed in the meantime
        return False


def plain_number(x: Any) -> Any:
    """A scalar of NumPy or JAX as a Python number, which JSON supports; other values unchanged."""
    return x.item() if getattr(x, "shape", None) == () else x


def digest(*values: Any) -> str:
    """A SHA-256 of the structure, the static fields and the numbers of the values.

    Functions are represented by their names, not by their code or the objects it refers to.
    """
    structure = re.sub(" at 0x[0-9a-f]+", "", eqx.tree_pformat(values, short_arrays=True))
    sha = hashlib.sha256(structure.encode())
    for leaf in jax.tree.leaves(values):
        if not isinstance(leaf, np.ndarray | np.generic | jax.Array):
            continue
        if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            leaf = jax.random.key_data(leaf)
        array = leaf if isinstance(leaf, np.ndarray) else np.asarray(leaf)
        sha.update(f"{array.dtype} {array.shape}".encode())
        if array.ndim == 0:
            sha.update(array.tobytes())
            continue
        rows = max(
            1, _DIGEST_BYTES // max(1, array[:1].nbytes)
        )  # an array on disk is read in parts
        for start in range(0, len(array), rows):
            sha.update(np.ascontiguousarray(array[start : start + rows]).data)
    return sha.hexdigest()


def has_user_code(x: Any) -> bool:
    """Whether a value contains a function or a class from outside polhode and its libraries, so
    that ``digest`` does not determine what it computes.
    """
    if isinstance(x, tuple | list):
        return any(map(has_user_code, x))
    if isinstance(x, Mapping):
        return any(map(has_user_code, x.values()))
    if isinstance(x, np.ndarray | np.generic | jax.Array):
        return False
    if dataclasses.is_dataclass(x) and not isinstance(x, type):
        fields = [getattr(x, field.name, None) for field in dataclasses.fields(x)]
        return _is_foreign(type(x)) or has_user_code(fields)
    return callable(x) and _is_foreign(x)


def _is_foreign(x: Any) -> bool:
    module = getattr(x, "__module__", None) or ""
    # a lambda or inner function of polhode may refer to objects of the user
    inner = "<locals>" in getattr(x, "__qualname__", "<locals>")
    return module.partition(".")[0] not in _LIBRARIES or (inner and module.startswith("polhode"))


def versions() -> dict[str, str]:
    """The versions on which the bits of a result depend."""
    import diffrax

    from polhode import __version__

    return {
        "polhode": __version__,
        "jax": jax.__version__,
        "jaxlib": jax.lib.__version__,
        "diffrax": diffrax.__version__,
    }


def missing_chunks(path: Path) -> str:
    """A description of the missing chunks of a store; empty when none is missing."""
    identity = _read_identity(path)
    dimensions = {}
    for name in identity["arrays"]:
        shape = _dictionary(_read_json(path, f"{name}/zarr.json")).get("shape")
        if not isinstance(shape, list):
            raise _unreadable(path, f"{name}/zarr.json", "its shape is no list")
        dimensions[name] = len(shape)
    chunks = -(-identity["bodies"] // identity["chunk"])
    missing = _missing(path, dimensions, chunks)
    if not missing:
        return ""
    numbers = ", ".join(map(str, missing[:10])) + (", ..." if len(missing) > 10 else "")
    verb = "is" if len(missing) == 1 else "are"
    return (
        f"{len(missing)} of {chunks} chunks {verb} missing ({numbers}): run the parts that are"
        " missing, or once without --part"
    )


def _missing(path: Path, dimensions: Mapping[str, int], chunks: int) -> list[int]:
    """The chunks for which the file of at least one array is missing."""
    return [
        k
        for k in range(chunks)
        if not all(_chunk_file(path, name, k, n).is_file() for name, n in dimensions.items())
    ]


def _chunk_file(path: Path, name: str, k: int, dimensions: int) -> Path:
    return path.joinpath(name, "c", str(k), *["0"] * (dimensions - 1))


def _codecs() -> list[Any]:
    codecs = _zarr().codecs
    return [codecs.ZstdCodec(level=1), codecs.Crc32cCodec()]


def _write_empty(
    store: Any, ts: np.ndarray, layout: Mapping[str, Field], metadata: Mapping[str, Any]
) -> None:
    """Write the metadata of a store, and its times."""
    group = _zarr().create_group(store, zarr_format=3, attributes=dict(metadata))
    words = {"units": "s", "long_name": "time"}
    time = Field(ts.shape, ts.size, ts.dtype, ("time",), words)
    for name, field in {"time": time, **layout}.items():
        group.create_array(
            name,
            shape=field.shape,
            chunks=(field.rows, *field.shape[1:]),
            dtype=field.dtype,
            dimension_names=field.dimensions,
            attributes=field.attributes,
            compressors=_codecs(),
            fill_value=field.fill_value,
        )
    group["time"][:] = ts
    _consolidate(store)


def _consolidate(store: Any) -> None:
    with warnings.catch_warnings():
        # Zarr warns that consolidated metadata are not yet part of specification version 3
        warnings.simplefilter("ignore", UserWarning)
        _zarr().consolidate_metadata(store, zarr_format=3)


def _read_json(path: Path, key: str) -> Any:
    try:
        return json.loads((path / key).read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise _unreadable(path, key, reason(error)) from error


def _unreadable(path: Path, key: str, problem: str) -> StoreError:
    return StoreError(
        f"{path} is no store of an ensemble, or damaged: {key} cannot be read ({problem[:200]}). It"
        " was left as it is; name another path, or remove it."
    )


def _dictionary(x: Any) -> dict:
    return x if isinstance(x, dict) else {}


def _require_equal(path: Path, key: str, stored: Any, expected: Any) -> None:
    """Raise StoreError with the first entry that differs."""
    if stored == expected:
        return
    stored, name = _dictionary(stored), "its content"
    for name, value in expected.items():
        if stored.get(name) != value:
            break
    raise StoreError(
        f"{path} is damaged: {key} was altered ({name} is {shorten(stored.get(name))}, expected"
        f" {shorten(expected.get(name))}). It was left as it is; name another path, or remove it."
    )


def _read_identity(path: Path) -> dict[str, Any]:
    """The identity of the run to which a store belongs, from its metadata. Raises StoreError."""
    text = _dictionary(_dictionary(_read_json(path, "zarr.json")).get("attributes")).get("polhode")
    try:
        identity = json.loads(text)
        sizes = [identity["bodies"], identity["chunk"], identity["block"]]
        names = [*identity["arrays"], *(name for name, *_ in identity["statistics"])]
        if not all(type(size) is int and size > 0 for size in sizes) or sizes[1] % sizes[2]:
            raise ValueError(f"bodies, chunk and block are {shorten(sizes)}")
        if not all(isinstance(name, str) and name.isidentifier() for name in names):
            raise ValueError(f"the names of its arrays are {shorten(names)}")
        return identity
    except (TypeError, ValueError, KeyError, RecursionError) as error:
        problem = f"{type(error).__name__}: {error}"
        raise _unreadable(path, "zarr.json (attribute polhode)", problem) from error


def _zarr() -> Any:
    return imported("an ensemble on disk", "zarr", extra="scale")
