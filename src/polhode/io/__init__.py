"""Scene files (TOML) and labelled output (NetCDF)."""

from polhode.io._atomic import whole_file as whole_file, write_netcdf as write_netcdf
from polhode.io._error import SceneFileError as SceneFileError
from polhode.io._schema import parse_scene as parse_scene, read_scene as read_scene
from polhode.io._specification import SceneFile as SceneFile
