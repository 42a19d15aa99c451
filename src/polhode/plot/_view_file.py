"""Bodies of a NetCDF file, for the page that shows them."""

import os
from os.path import isfile

import numpy as np

from polhode._checks import imported
from polhode.files import build_inertia, parse_scene
from polhode.plot._view_data import Body

_NEEDED = ("wxyz", "omega_body", "momentum_space", "moments")


def read(path: str | os.PathLike) -> tuple[list[Body], str]:
    """The bodies of a file that ``polhode run`` wrote, and its title."""
    xarray = imported("reading NetCDF", "xarray", "h5netcdf")  # the engine asked for below
    if not isfile(path):
        raise FileNotFoundError(f"there is no file {path}.")
    with xarray.open_dataset(path, engine="h5netcdf", decode_times=False) as data:
        missing = [name for name in _NEEDED if name not in data]
        if missing or "scene" not in data.attrs:
            what = ", ".join(missing) or "the text of its scene"
            raise ValueError(f"{path} lacks {what}: show files that `polhode run` wrote.")
        many = data["wxyz"].ndim > 2
        parts = [np.asarray(data[name], np.float64) for name in _NEEDED]
        wxyz, omega, momentum, moments = parts
        ts = np.asarray(data["time" if "time" in data.coords else "ts"], np.float64)
        text, title = data.attrs["scene"], str(data.attrs.get("title", ""))
    if many and moments.ndim > 1:
        tensors = moments[:, :, None] * np.eye(3)  # clones differ in moments about the body axes
    else:
        tensors = np.asarray(build_inertia(parse_scene(text, path), "float64").tensor, np.float64)
    count = wxyz.shape[0] if many else 1
    ts = np.broadcast_to(ts, (count, ts.shape[-1]))
    tensors = np.broadcast_to(tensors, (count, 3, 3))
    arrays = [x.reshape(count, *x.shape[-2:]) for x in (wxyz, omega, momentum)]
    return [Body.sorted(*body) for body in zip(ts, *arrays, tensors, strict=True)], title
