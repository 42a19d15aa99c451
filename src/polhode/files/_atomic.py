"""Files that appear whole or not at all: written beside the target, synced, then renamed."""

import contextlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from polhode._extras import imported

if TYPE_CHECKING:
    import xarray


@contextlib.contextmanager
def whole_file(target: str | os.PathLike) -> Iterator[Path]:
    """A temporary path in the folder of `target` that replaces `target` when the block succeeds.

    When the block raises anything, KeyboardInterrupt included, the temporary file is removed and an
    existing `target` is left as it was. The folder must exist. An OSError of the system names the
    target and its folder.
    """
    target = Path(target).resolve()
    # the suffix stays last: writers of figures choose the format by it
    temporary = target.with_name(f".{target.stem}.{secrets.token_hex(6)}.part{target.suffix}")
    try:
        yield temporary
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except OSError as error:
        if error.errno is None or error.strerror is None:
            raise
        raise OSError(
            error.errno, f"{error.strerror}: cannot write {target.name} in the folder"
            f" {target.parent}; nothing was changed there",
        ) from error  # fmt: skip
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
    if hasattr(os, "O_DIRECTORY"):  # Windows cannot open folders
        sync(target.parent)


def sync(path: Path) -> None:
    """Have a file, or the names in a folder, on the disk, also when the power goes."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_netcdf(dataset: "xarray.Dataset", target: str | os.PathLike) -> Path:
    """Write a dataset (`Trajectory.to_xarray()`) as compressed NetCDF-4, whole or not at all.

    The file is made in memory first: HDF5 ends the process when the disk is full. Needs xarray,
    h5netcdf and h5py (the extra `cli`). Returns the path. Raises OSError when the
    folder is missing, full or not writable; an existing file is then unchanged.
    """
    imported("writing NetCDF", "h5netcdf", "h5py")  # the one does not install the other
    packed = {"zlib": True, "complevel": 4, "shuffle": True}
    large = {name: packed for name, array in dataset.variables.items()
             if array.ndim and array.dtype.kind in "fiu"}  # fmt: skip
    data = dataset.to_netcdf(engine="h5netcdf", encoding=large)
    with whole_file(target) as temporary:
        temporary.write_bytes(data)
    return Path(target)
