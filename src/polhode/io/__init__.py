"""Scene files (TOML) and labelled output (NetCDF)."""

from polhode.io._atomic import whole_file as whole_file, write_netcdf as write_netcdf
from polhode.io._build import (
    blamed as blamed,
    build_attitudes as build_attitudes,
    build_inertia as build_inertia,
    build_scene as build_scene,
    build_state as build_state,
)
from polhode.io._clones import Clones as Clones, draw_clones as draw_clones
from polhode.io._error import SceneFileError as SceneFileError
from polhode.io._method import build_method as build_method
from polhode.io._schema import parse_scene as parse_scene, read_scene as read_scene
from polhode.io._specification import SceneFile as SceneFile
