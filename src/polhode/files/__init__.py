"""Scene files (TOML) and labelled output (NetCDF).

Reading and checking a file needs no JAX; the builders of scenes are imported on first use.
"""

import importlib
from typing import TYPE_CHECKING, Any

from polhode._extras import imported
from polhode.files._read import (
    SceneFileError as SceneFileError,
    parse_scene as parse_scene,
    read_scene as read_scene,
    shipped_scenes as shipped_scenes,
)

if TYPE_CHECKING:
    from polhode.files._build import (
        Clones as Clones,
        build_attitudes as build_attitudes,
        build_events as build_events,
        build_inertia as build_inertia,
        build_method as build_method,
        build_scene as build_scene,
        build_state as build_state,
        draw_clones as draw_clones,
    )
    from polhode.files._models import SceneFile as SceneFile
    from polhode.files._write import (
        reference_motions as reference_motions,
        write_netcdf as write_netcdf,
    )

_BUILDERS = (
    "Clones",
    "build_attitudes",
    "build_events",
    "build_inertia",
    "build_method",
    "build_scene",
    "build_state",
    "draw_clones",
)
# imported on first use, so that the command line starts quickly
_MODULES = dict.fromkeys(_BUILDERS, "_build") | {
    "SceneFile": "_models",
    "reference_motions": "_write",
    "write_netcdf": "_write",
}


def __getattr__(name: str) -> Any:
    module = _MODULES.get(name)
    if module is None:
        raise AttributeError(f"module 'polhode.files' has no attribute {name!r}")
    if module in ("_models", "_build"):
        imported("a scene file", "pydantic")
    return getattr(importlib.import_module(f"polhode.files.{module}"), name)
