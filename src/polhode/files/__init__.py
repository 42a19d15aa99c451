"""Scene files (TOML) and labelled output (NetCDF).

Reading and checking a file needs no JAX; the builders of scenes are imported on first use.
"""

import importlib
from typing import TYPE_CHECKING, Any

from polhode._extras import imported
from polhode.files._atomic import write_netcdf as write_netcdf
from polhode.files._error import SceneFileError as SceneFileError
from polhode.files._read import parse_scene as parse_scene, read_scene as read_scene
from polhode.files._reference import reference_motions as reference_motions
from polhode.files._shipped import shipped_scenes as shipped_scenes

if TYPE_CHECKING:
    from polhode.files._build import (
        build_attitudes as build_attitudes,
        build_events as build_events,
        build_inertia as build_inertia,
        build_scene as build_scene,
        build_state as build_state,
    )
    from polhode.files._clones import Clones as Clones, draw_clones as draw_clones
    from polhode.files._method import build_method as build_method
    from polhode.files._models import SceneFile as SceneFile

_MODULES = {
    "_build": (
        "blamed",
        "build_attitudes",
        "build_events",
        "build_inertia",
        "build_scene",
        "build_state",
    ),
    "_clones": ("Clones", "draw_clones"),
    "_method": ("build_method",),
    "_models": ("SceneFile",),
}


def __getattr__(name: str) -> Any:
    for module, names in _MODULES.items():
        if name in names:
            imported("a scene file", "pydantic")
            return getattr(importlib.import_module(f"polhode.files.{module}"), name)
    raise AttributeError(f"module 'polhode.files' has no attribute {name!r}")
