"""The files that commands read: where they are, and what is wrong with them (exit code 2)."""

import contextlib
import csv
import difflib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from polhode.cli._targets import UsageError
from polhode.files import SceneFileError, shipped_scenes
from polhode.files._error import visible

READERS = {
    ".toml": "`polhode run` and `polhode explain` read scene files (TOML)",
    ".csv": "`polhode fit` and `polhode lightcurve` read CSV files",
    ".nc": "`polhode view` reads NetCDF files",
    ".zarr": "xarray.open_zarr reads the stores of ensembles",
}


def scene_file(text: str) -> Any:
    """The file of a scene: a path, or the name of a scene that comes with polhode.

    Raises SceneFileError for a missing file, with the nearest name that exists.
    """
    path = Path(text)
    if text == "-" or "\0" in text or os.path.lexists(path):
        return text
    shipped = shipped_scenes()
    if text in shipped:
        return shipped[text]
    hint = nearest(path, ".toml")
    if not hint and (close := _close(path.name.removesuffix(".toml"), shipped)):
        hint = f"`polhode run {close}` runs the scene {close} that comes with polhode"
    raise SceneFileError(
        path,
        "",
        "cannot be read: No such file or directory",
        mend=hint or "check the path; `polhode scenes` lists the scenes that come with polhode",
    )


def read_scene(text: str) -> Any:
    """The checked scene file; a file that another command reads is named as such."""
    from polhode.files import read_scene

    path = scene_file(text)
    try:
        return read_scene(path)
    except SceneFileError as error:
        hint = _other_command(Path(path), ".toml")
        if not hint:
            raise
        raise UsageError(f"{error}\n  {hint}") from error


def nearest(path: Path, suffix: str) -> str:
    """A question that names the file meant by a path without a file, or nothing."""
    try:
        names = {other.name for other in path.parent.iterdir() if other.suffix == suffix}
    except OSError:
        return ""
    name = path.name + suffix if path.name + suffix in names else _close(path.name, names)
    return f"did you mean {visible(str(path.with_name(name)))}?" if name else ""


def _close(name: str, names: Any) -> str:
    return next(iter(difflib.get_close_matches(name, names, 1, 0.75)), "")


def _other_command(path: Path, suffix: str) -> str:
    """Which command reads a file whose suffix is not the one expected, or nothing."""
    return "" if path.suffix == suffix else READERS.get(path.suffix, "")


@contextlib.contextmanager
def refused(path: Path, suffix: str, expected: str) -> Iterator[None]:
    """Turn what reading a file raises into UsageError: its name, what is wrong, what is expected.

    A file that is missing or no file at all is refused at once.
    """
    hint = _other_command(path, suffix)
    end = f"\n  {hint}" if hint else ""
    if "\0" in str(path):
        raise UsageError(f"the name of {expected} holds a NUL character.")
    try:
        if path.is_dir():
            raise UsageError(f"{path} is a folder: expected {expected}.{end}")
        with open(path, "rb") if path.is_file() else contextlib.nullcontext():
            path.stat()
        yield
    except FileNotFoundError as error:
        missing = Path(error.filename or path)
        question = nearest(missing, missing.suffix or suffix)
        raise UsageError(
            f"cannot read {missing}: no such file, expected {expected}"
            + (f"; {question}" if question else ".")
        ) from error
    except OSError as error:
        reason = error.strerror or str(error)
        raise UsageError(f"cannot read {path}: {reason}; expected {expected}.{end}") from error
    except UnicodeDecodeError as error:
        raise UsageError(f"{path} is not text in UTF-8: expected {expected}.{end}") from error
    except SceneFileError:
        raise
    except (ValueError, csv.Error) as error:
        lead = "" if str(path) in str(error) else f"{path}: "
        raise UsageError(f"{lead}{error}{end}") from error
