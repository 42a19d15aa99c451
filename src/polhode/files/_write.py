"""Writing files: atomically (beside the target, synced, then renamed), and where they come from."""

import contextlib
import functools
import importlib.metadata
import json
import os
import platform
import secrets
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from polhode._extras import imported

if TYPE_CHECKING:
    import xarray


LIBRARIES = ("jax", "jaxlib", "diffrax", "equinox", "numpy")


@contextlib.contextmanager
def atomic_write(target: str | os.PathLike) -> Iterator[Path]:
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
            error.errno,
            f"{error.strerror}: cannot write {target.name} in the folder {target.parent}; nothing"
            " was changed there",
        ) from error
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
    compression = {"zlib": True, "complevel": 4, "shuffle": True}
    variables = dataset.variables.items()
    arrays = [name for name, array in variables if array.ndim and array.dtype.kind in "fiu"]
    data = dataset.to_netcdf(engine="h5netcdf", encoding=dict.fromkeys(arrays, compression))
    with atomic_write(target) as temporary:
        temporary.write_bytes(data)
    return Path(target)


def versions() -> dict[str, str]:
    """NAME_version of polhode, Python and the libraries that compute; a note where fused kernels
    and the other optimisations for CPUs are off, since results differ by rounding.
    """
    import polhode
    from polhode._policy import plain_reason

    numbers = {name: importlib.metadata.version(name) for name in LIBRARIES}
    numbers = {"python": platform.python_version(), "polhode": polhode.__version__} | numbers
    provenance = {f"{name}_version": number for name, number in numbers.items()}
    reason = plain_reason()
    if reason is not None:
        provenance["cpu_optimisations"] = f"off: {reason}"
    return provenance


@functools.cache
def commit() -> str:
    """The commit that polhode was installed from or is run from; empty where that is not known.

    "+changes" follows that of a checkout with uncommitted changes.
    """
    folder = Path(__file__).resolve().parents[3]
    if (folder / ".git").exists():
        head = _git(folder, "rev-parse", "HEAD")
        changes = _git(folder, "status", "--porcelain", "--untracked-files=no", "--", "src")
        return head + ("+changes" if head and changes else "")
    try:
        source = importlib.metadata.distribution("polhode").read_text("direct_url.json")
        return str(json.loads(source or "{}").get("vcs_info", {}).get("commit_id", ""))
    except (importlib.metadata.PackageNotFoundError, ValueError, AttributeError):
        return ""


def _git(folder: Path, *words: str) -> str:
    try:
        result = subprocess.run(
            ["git", "-C", str(folder), *words], capture_output=True, text=True, timeout=10
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    return result.stdout.strip() if result.returncode == 0 else ""
