"""Common parts of the commands: options, scene files, and checks of input and output files.

File names are checked before the computation: whether a file exists, is readable, may be replaced.
"""

import contextlib
import csv
import difflib
import io
import math
import os
import re
import stat
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from polhode.files import SceneFileError, shipped_scenes
from polhode.files._read import escape, reason
from polhode.files._values import MAX_CLONES, MAX_SEED

_SIZES = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9, "t": 10**12}


def whole_number(minimum: int, maximum: int | None = None) -> Callable[[str], int]:
    """Parser of an integer from `minimum` to `maximum` (None: no maximum)."""
    bounds = f"from {minimum} up" if maximum is None else f"from {minimum} to {maximum}"

    def convert(text: str | int) -> int:
        try:
            value = int(str(text))
        except ValueError:
            value = minimum - 1
        if value < minimum or (maximum is not None and value > maximum):
            raise typer.BadParameter(f"{str(text)[:80]!r} is not a whole number {bounds}")
        return value

    return convert


def parse_part(text: str) -> str:
    """Parser of I/N with I from 1 to N."""
    first, _, last = text.partition("/")
    if not (first.isdecimal() and last.isdecimal() and 1 <= int(first[:9]) <= int(last[:9])):
        raise typer.BadParameter(f"{text[:80]!r} is not I/N with I from 1 to N, such as 3/8")
    return f"{int(first)}/{int(last)}"


def positive(text: str | float) -> float:
    """Parser of a finite number above 0."""
    value = _number(text)
    if not 0 < value < math.inf:
        raise typer.BadParameter(f"{str(text)[:80]!r} is not a positive number")
    return value


def not_negative(text: str | float) -> float:
    """Parser of a finite number, 0 or above."""
    value = _number(text)
    if not 0 <= value < math.inf:
        raise typer.BadParameter(f"{str(text)[:80]!r} is not a number from 0 up")
    return value


def _number(text: str | float) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def byte_count(text: str | int) -> int:
    """Parser of a size such as 4GB, 500MB or 2e9; at least one byte."""
    match = re.fullmatch(r"([0-9.]+(?:e[0-9]+)?)\s*([kmgt]?)b?", str(text).strip().lower())
    try:
        count = int(float(match[1]) * _SIZES[match[2]])  # type: ignore[index]
        if count < 1:
            raise ValueError
        return count
    except (TypeError, ValueError, OverflowError):
        raise typer.BadParameter(f"{str(text)[:80]!r} is not a size such as 4GB") from None


def device_count(text: str) -> str:
    """Parser of a number of devices, or "all"."""
    return text if text == "all" else str(whole_number(1)(text))


def _precision(text: str) -> str:
    if text not in ("float64", "float32"):
        raise typer.BadParameter(f"{text[:80]!r} is not float64 or float32")
    return text


def option(name: str, metavar: str, words: str, parser: Any = None, **settings: Any) -> Any:
    """An option with a value."""
    return typer.Option(name, metavar=metavar, help=words, parser=parser, **settings)


def output_option(metavar: str, words: str) -> Any:
    return typer.Option("-o", "--output", metavar=metavar, show_default=False, help=words)


SceneName = Annotated[
    str,
    typer.Argument(
        metavar="SCENE",
        show_default=False,
        help="scene file (TOML), - for standard input, or the name of one that comes with polhode"
        " (polhode scenes)",
    ),
]
ClonesOption = Annotated[
    int | None,
    option(
        "--clones",
        "N",
        "number of Monte Carlo clones, instead of the scene's; 0: the nominal body only",
        whole_number(0, MAX_CLONES),
    ),
]
SeedOption = Annotated[
    int | None,
    option("--seed", "N", "seed of the clones, instead of the scene's", whole_number(0, MAX_SEED)),
]
PrecisionOption = Annotated[
    str, option("--precision", "float64|float32", "numbers to compute with", _precision)
]
ForceOption = Annotated[
    bool, typer.Option("--force", help="replace a file that polhode did not write")
]
NoFigureOption = Annotated[bool, typer.Option("--no-figure", help="do not draw the figure")]
NoCacheOption = Annotated[
    bool,
    typer.Option("--no-cache", help="do not store compiled programs (or set POLHODE_CACHE=off)"),
]
QuietOption = Annotated[bool, typer.Option("-q", "--quiet", help="print errors only")]
DebugOption = Annotated[bool, typer.Option("--debug", help="show the full traceback of an error")]


def read_scene(scene: str, clones: int | None, seed: int | None) -> Any:
    """The scene file, with its number of clones and its seed replaced by the options."""
    from polhode.files import SceneFileError

    file = read_scene_file(scene)
    options = {"clones": clones, "seed": seed}
    options = {name: value for name, value in options.items() if value is not None}
    if not options:
        return file
    name = next(iter(options))
    if file.ensemble is not None:
        key = {"seed": "seed", "clones": "bodies"}[name]
        raise SceneFileError(
            file.path,
            f"[ensemble] {key}",
            "not replaced by an option",
            f"--{name} on the command line",
            "an [ensemble] that says what its store holds",
            f"write `{key} = {options[name]}` into [ensemble], and name another store",
        )
    if options.get("clones") == 0:
        return file.model_copy(update={"monte_carlo": None})
    if file.monte_carlo is None:
        raise SceneFileError(
            file.path,
            "[monte_carlo]",
            "missing table",
            f"--{name} on the command line",
            "a scene that states its uncertainties",
            "add [monte_carlo], or drop the option",
        )
    clones_table = file.monte_carlo.model_copy(update=options)
    return file.model_copy(update={"monte_carlo": clones_table})


def require(command: str, *packages: str, extra: str = "cli") -> None:
    """ImportError for a missing package, before the computation instead of after it."""
    import importlib.util

    from polhode._extras import how_to_install

    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    if missing:
        raise ImportError(
            f"`polhode {command}` needs {', '.join(missing)}: {how_to_install(extra)}"
        )


READERS = {
    ".toml": "`polhode run` and `polhode explain` read scene files (TOML)",
    ".csv": "`polhode fit` and `polhode lightcurve` read CSV files",
    ".nc": "`polhode view` reads NetCDF files",
    ".zarr": "xarray.open_zarr reads the stores of ensembles",
}
_outputs: dict[Path, tuple[int, int] | None] = {}  # output files with their previous identity
_stores: list[Path] = []


class UsageError(Exception):
    """Raised for options that do not fit each other or the file: exit code 2."""


def scene_path(text: str) -> Any:
    """The file of a scene: a path, or the name of a scene that comes with polhode.

    Raises SceneFileError for a missing file, with the nearest name that exists.
    """
    path = Path(text)
    if text == "-" or "\0" in text or os.path.lexists(path):
        return text
    shipped = shipped_scenes()
    if text in shipped:
        return shipped[text]
    hint = _suggestion(path, ".toml")
    if not hint and (close := _closest(path.name.removesuffix(".toml"), shipped)):
        hint = f"`polhode run {close}` runs the scene {close} that comes with polhode"
    raise SceneFileError(
        path,
        "",
        "cannot be read: No such file or directory",
        fix=hint or "check the path; `polhode scenes` lists the scenes that come with polhode",
    )


def read_scene_file(text: str) -> Any:
    """The validated scene file; the error for another kind of file names the command for it."""
    from polhode.files import read_scene

    path = scene_path(text)
    try:
        return read_scene(path)
    except SceneFileError as error:
        hint = _other_command(Path(path), ".toml")
        if not hint:
            raise
        raise UsageError(f"{error}\n  {hint}") from error


@contextlib.contextmanager
def usage_errors(path: Path, suffix: str, expected: str) -> Iterator[None]:
    """Convert errors of reading a file to UsageError with its name, the cause and what is expected.

    Missing files and folders are rejected before the block runs.
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
        question = _suggestion(missing, missing.suffix or suffix)
        raise UsageError(
            f"cannot read {missing}: no such file, expected {expected}"
            + (f"; {question}" if question else ".")
        ) from error
    except OSError as error:
        raise UsageError(
            f"cannot read {path}: {reason(error)}; expected {expected}.{end}"
        ) from error
    except UnicodeDecodeError as error:
        raise UsageError(f"{path} is not text in UTF-8: expected {expected}.{end}") from error
    except SceneFileError:
        raise
    except (ValueError, csv.Error) as error:
        lead = "" if str(path) in str(error) else f"{path}: "
        raise UsageError(f"{lead}{error}{end}") from error


def _suggestion(path: Path, suffix: str) -> str:
    """'did you mean ...?' with an existing file similar to a missing one, or an empty string."""
    try:
        names = {other.name for other in path.parent.iterdir() if other.suffix == suffix}
    except OSError:
        return ""
    name = path.name + suffix if path.name + suffix in names else _closest(path.name, names)
    return f"did you mean {escape(str(path.with_name(name)))}?" if name else ""


def _closest(name: str, names: Any) -> str:
    return next(iter(difflib.get_close_matches(name, names, 1, 0.75)), "")


def _other_command(path: Path, suffix: str) -> str:
    """The command that reads files with this suffix, or an empty string for the expected one."""
    return "" if path.suffix == suffix else READERS.get(path.suffix, "")


def reset_outputs() -> None:
    """Clear the list of output files, which are those of a previous command in this process."""
    _outputs.clear()
    _stores.clear()


def resumable_store(path: Path) -> None:
    """Register a store, to which chunks are written as they are computed."""
    _stores.append(path)


def check_suffix(text: str, *suffixes: str, what: str) -> None:
    """UsageError for a name with the suffix of a format that the command does not write.

    A suffix that does not begin with a letter (``run_0.5``) is part of the name.
    """
    suffix = Path(text).suffix
    if re.fullmatch(r"\.[A-Za-z]\w*", suffix) and suffix not in suffixes:
        raise UsageError(
            f"cannot write {escape(text)}: {what} has the suffix {' or '.join(suffixes)}, not"
            f" {escape(suffix)}; name such a file, or leave the suffix out"
        )


def output_stem(text: str, *suffixes: str, what: str) -> str:
    """The common name of files that differ in their ``suffixes``. Raises as ``check_suffix``."""
    check_suffix(text, *suffixes, what=what)
    return text.removesuffix(Path(text).suffix) if Path(text).suffix in suffixes else text


def output_path(path: Path | str, suffix: str, *, force: bool, confined: bool = False) -> Path:
    """The file to write, whose folder is created; raises OSError before the computation if needed.

    An existing file that polhode did not write, and a link, are replaced only with `force`.
    `confined`: a name from a scene file, which must not lead out of the current folder.
    """
    text = os.fspath(path)
    if "\0" in text:
        raise UsageError(f"the output {escape(text)} holds a NUL character: name a file")
    path = Path(text)
    if path.name in ("", "..") or path.is_dir():
        raise IsADirectoryError(
            f"{escape(text)} is a folder: name a file to write, such as"
            f" {escape(str(path / 'out'))}{suffix}"
        )
    if path.suffix != suffix:
        path = path.with_name(path.name + suffix)
    here = Path.cwd().resolve()
    if confined and not path.resolve().is_relative_to(here):
        raise UsageError(
            f"[output] file: {escape(text)} leads out of the folder {here} by a link; name a file"
            " below it, or any place by -o on the command line"
        )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            raise IsADirectoryError(f"{path} is a folder: name a file to write")
        if os.path.lexists(path) and not force and not _is_replaceable(path):
            kind = "is a link" if path.is_symlink() else "was not written by polhode"
            raise FileExistsError(
                f"{escape(str(path))} exists and {kind}: name another file, or give --force to"
                " replace it"
            )
        probe = path.parent / f".{path.stem}.probe"
        probe.touch()
        probe.unlink()
    except OSError as error:
        if error.strerror is None:
            raise
        raise OSError(
            f"cannot write {escape(path.name)} in the folder {escape(str(path.parent))}:"
            f" {error.strerror}"
        ) from error
    _outputs[path] = _identity(path)
    return path


def state_of_outputs() -> str:
    """A description of the files that an interrupted command has written."""
    if _stores:
        return "the same command finishes what is missing"
    written, unchanged = ([escape(str(path)) for path in paths] for paths in written_outputs())
    if not written:
        return "no file was changed"
    text = f"written: {', '.join(written)}"
    return text + (f"; not written: {', '.join(unchanged)}" if unchanged else "")


def written_outputs() -> tuple[list[Path], list[Path]]:
    """The output files that are new or replaced, and those that are unchanged."""
    new = [path for path, previous in _outputs.items() if _identity(path) != previous]
    return new, [path for path in _outputs if path not in new]


def write_figure(path: Path, draw: Callable[[], Any]) -> Path:
    """Draw a figure without a display and write it atomically as PNG."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    from polhode import __version__
    from polhode._atomic import atomic_write

    figure, data = draw(), io.BytesIO()
    figure.savefig(data, format="png", dpi=160, metadata={"Software": f"polhode {__version__}"})
    pyplot.close(figure)
    with atomic_write(path) as temporary:
        temporary.write_bytes(data.getvalue())
    return path


def _identity(path: Path) -> tuple[int, int] | None:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns


_MAKER = re.compile(rb'polhode(\W{1,5}\d+\.\d|">)')
"""Pattern by which files of polhode name it: with a version, or as the generator of a page."""


def _is_replaceable(path: Path) -> bool:
    """Whether a file is empty or names polhode as its maker."""
    status = path.lstat()
    if not stat.S_ISREG(status.st_mode):
        return False
    if status.st_size == 0:
        return True
    if path.suffix == ".nc":
        import h5py

        try:
            with h5py.File(path, "r") as file:
                maker = file.attrs.get("source", "")
        except OSError:
            return False
        maker = maker.decode(errors="replace") if isinstance(maker, bytes) else str(maker)
        return maker.startswith("polhode")
    with open(path, "rb") as file:
        return _MAKER.search(file.read(65536)) is not None
