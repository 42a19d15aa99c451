"""Bodies of a NetCDF file, for the page that shows them."""

import os
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from polhode._extras import imported
from polhode.plot._view_data import Body

_EXPECTED = "expected a NetCDF file (.nc) that `polhode run` wrote"
_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_NEEDED = ("wxyz", "omega_body", "momentum_space", "moments")


def read(path: str | os.PathLike) -> tuple[list[Body], str]:
    """The bodies of a file that ``polhode run`` wrote, and its title."""
    # the engine h5netcdf needs h5py; scene files need pydantic
    xarray = imported("reading NetCDF", "xarray", "h5netcdf", "h5py", "pydantic")
    from polhode.files import build_inertia, parse_scene

    _require_hdf5(Path(path))
    _require_content(path)
    with xarray.open_dataset(path, engine="h5netcdf", decode_times=False) as data:
        many = data["wxyz"].ndim > 2
        parts = [np.asarray(data[name], np.float64) for name in _NEEDED]
        wxyz, omega, momentum, moments = parts
        ts = np.asarray(data["time" if "time" in data.coords else "ts"], np.float64)
        text, title = data.attrs["scene"], str(data.attrs.get("title", ""))
    if many and moments.ndim > 1:
        tensors = moments[:, :, None] * np.eye(3)  # clones differ in moments about the body axes
    else:
        inertia = build_inertia(parse_scene(text, path), jnp.result_type(float))
        tensors = np.asarray(inertia.tensor, np.float64)
    count = wxyz.shape[0] if many else 1
    ts = np.broadcast_to(ts, (count, ts.shape[-1]))
    tensors = np.broadcast_to(tensors, (count, 3, 3))
    arrays = [x.reshape(count, *x.shape[-2:]) for x in (wxyz, omega, momentum)]
    return [Body.sorted(*body) for body in zip(ts, *arrays, tensors, strict=True)], title


def _require_hdf5(path: Path) -> None:
    """Check that the path is a file in the format of NetCDF-4, which is HDF5.

    Raises FileNotFoundError for a missing file, ValueError for a folder and for other formats.
    """
    if path.is_dir():
        kind = "the Zarr store of an ensemble" if path.suffix == ".zarr" else "a folder"
        raise ValueError(f"{path} is {kind}: {_EXPECTED}.")
    if not path.exists():
        raise FileNotFoundError(f"there is no file {path}: {_EXPECTED}.")
    if not path.is_file():
        raise ValueError(f"{path} is not a regular file: {_EXPECTED}.")
    with open(path, "rb") as file:
        if file.read(len(_SIGNATURE)) != _SIGNATURE:
            raise ValueError(f"{path} is not NetCDF-4: {_EXPECTED}.")


def _require_content(path: str | os.PathLike) -> None:
    """Check that the variables are there, before xarray guesses what another file means."""
    h5py = imported("reading NetCDF", "h5py")
    try:
        with h5py.File(path, "r") as file:
            missing = [name for name in _NEEDED if name not in file]
            if "scene" not in file.attrs:
                missing.append("the text of its scene")
    except OSError as error:
        raise ValueError(f"{path} is damaged ({error}): {_EXPECTED}.") from error
    if missing:
        raise ValueError(f"{path} lacks {', '.join(missing)}: {_EXPECTED}.")
