"""NetCDF output, versions of the libraries for its metadata, and reference motions of torque-free
bodies."""

import csv
import functools
import importlib.metadata
import io
import json
import os
import platform
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from polhode._atomic import atomic_write
from polhode._extras import imported

if TYPE_CHECKING:
    import xarray


LIBRARIES = ("jax", "jaxlib", "diffrax", "equinox", "numpy")


def write_netcdf(dataset: "xarray.Dataset", target: str | os.PathLike) -> Path:
    """Write a dataset (`Trajectory.to_xarray()`) atomically as compressed NetCDF-4.

    The file is made in memory first, because HDF5 aborts the process when the disk is full. Needs
    xarray, h5netcdf and h5py (the extra `cli`). Returns the path. Raises OSError when the
    folder is missing, full or not writable; an existing file is then unchanged.
    """
    imported("writing NetCDF", "h5netcdf", "h5py")  # h5netcdf does not depend on h5py
    compression = {"zlib": True, "complevel": 4, "shuffle": True}
    variables = dataset.variables.items()
    arrays = [name for name, array in variables if array.ndim and array.dtype.kind in "fiu"]
    data = dataset.to_netcdf(engine="h5netcdf", encoding=dict.fromkeys(arrays, compression))
    with atomic_write(target) as temporary:
        temporary.write_bytes(data)
    return Path(target)


def versions() -> dict[str, str]:
    """NAME_version of polhode, Python and the numerical libraries; also an entry if fused kernels
    and the other CPU optimisations are off, because results then differ by rounding.
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
    """The commit from which polhode was installed or is run; empty if it is not known.

    "+changes" is appended for a checkout with uncommitted changes.
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


REFERENCE = Path(__file__).with_name("reference") / "tumbling.json"
_PARAMETERS = ("I1", "I2", "I3", "wx0", "wy0", "wz0")
_COMPONENTS = ("qw", "qx", "qy", "qz", "wx", "wy", "wz")


def reference_motions() -> dict[str, Any]:
    """Motions of torque-free rigid bodies, correct to 17 significant digits, for tests of programs.

    The contents of the file that ``polhode reference`` writes: under ``"bodies"`` a list of bodies
    in every regime, each with ``name``, ``title``, ``moments`` (3) [kg m^2], ``wxyz`` (4) and
    ``omega_body`` (3) [rad/s] at t = 0, ``flip_times`` (3 or none) [s] and ``samples`` up to 1e5
    revolutions: ``t`` [s], ``wxyz`` (4), ``omega_body`` (3) and their derivatives (4, 6) and (3, 6)
    with respect to the three moments and the three initial rates. The other entries state units
    and conventions.

        bodies = ph.files.reference_motions()["bodies"]

    Source: closed forms in arithmetic of 150 digits, checked by Taylor series
    (``tests/free/make_tumbling.py``); the numbers are CC0-1.0.
    """
    return json.loads(REFERENCE.read_text(encoding="utf-8"))


def reference_csv() -> str:
    """The same motions as a table, one row for each body and time, without the flip times."""
    text = io.StringIO()
    derivatives = [f"d{y}_d{x}" for y in _COMPONENTS for x in _PARAMETERS]
    starts = [f"{y}0" for y in _COMPONENTS[:4]]
    table = csv.writer(text, lineterminator="\n")
    table.writerow(
        ["body", *_PARAMETERS[:3], *starts, *_PARAMETERS[3:], "t", *_COMPONENTS, *derivatives]
    )
    table.writerows(_rows())
    return text.getvalue()


def _rows() -> Iterator[list[Any]]:
    # parsed as text, so that the numbers retain the digits of the file
    bodies = json.loads(REFERENCE.read_text(encoding="utf-8"), parse_float=str)["bodies"]
    for body in bodies:
        start = [body["name"], *body["moments"], *body["wxyz"], *body["omega_body"]]
        for sample in body["samples"]:
            changes = sample["wxyz_derivative"] + sample["omega_body_derivative"]
            row = [*start, sample["t"], *sample["wxyz"], *sample["omega_body"]]
            yield row + [x for component in changes for x in component]
