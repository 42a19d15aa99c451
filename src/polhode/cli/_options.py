"""Kinds of options, those that several commands share, and what follows from them."""

import math
import re
from collections.abc import Callable
from typing import Annotated, Any

import typer

_SIZES = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9, "t": 10**12}


def whole_number(minimum: int) -> Callable[[str], int]:
    """A whole number not below `minimum`."""

    def convert(text: str | int) -> int:
        try:
            value = int(str(text))
        except ValueError:
            value = minimum - 1
        if value < minimum:
            raise typer.BadParameter(f"{str(text)[:80]!r} is not a whole number from {minimum} up")
        return value

    return convert


def parse_part(text: str) -> str:
    """I/N with I from 1 to N."""
    first, _, last = text.partition("/")
    if not (first.isdecimal() and last.isdecimal() and 1 <= int(first[:9]) <= int(last[:9])):
        raise typer.BadParameter(f"{text[:80]!r} is not I/N with I from 1 to N, such as 3/8")
    return f"{int(first)}/{int(last)}"


def positive(text: str | float) -> float:
    """A finite number above 0."""
    value = _number(text)
    if not 0 < value < math.inf:
        raise typer.BadParameter(f"{str(text)[:80]!r} is not a positive number")
    return value


def not_negative(text: str | float) -> float:
    """A finite number, 0 or above."""
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
    """4GB, 500MB, 2e9: a byte or more."""
    match = re.fullmatch(r"([0-9.]+(?:e[0-9]+)?)\s*([kmgt]?)b?", str(text).strip().lower())
    try:
        count = int(float(match[1]) * _SIZES[match[2]])  # type: ignore[index]
        if count < 1:
            raise ValueError
        return count
    except (TypeError, ValueError, OverflowError):
        raise typer.BadParameter(f"{str(text)[:80]!r} is not a size such as 4GB") from None


def device_count(text: str) -> str:
    """A number of devices, or all."""
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
        whole_number(0),
    ),
]
SeedOption = Annotated[
    int | None,
    option("--seed", "N", "seed of the clones, instead of the scene's", whole_number(0)),
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
    typer.Option("--no-cache", help="do not keep compiled programs (or set POLHODE_CACHE=off)"),
]
QuietOption = Annotated[bool, typer.Option("-q", "--quiet", help="print errors only")]
DebugOption = Annotated[bool, typer.Option("--debug", help="show the full traceback of an error")]


def read_scene(scene: str, clones: int | None, seed: int | None) -> Any:
    """The scene file with the options put in place of its own entries."""
    from polhode.cli import _files
    from polhode.files import SceneFileError

    file = _files.read_scene(scene)
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
    """ImportError now, rather than after the work, when a package is missing."""
    import importlib.util

    from polhode._extras import how_to_install

    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    if missing:
        raise ImportError(
            f"`polhode {command}` needs {', '.join(missing)}: {how_to_install(extra)}"
        )
