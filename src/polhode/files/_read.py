"""Reading and validation of scene files, with readable error messages.

Needs neither JAX nor NumPy (except for [ensemble.arrays]): a mistake is reported in a fraction of a
second.
"""

import contextlib
import difflib
import math
import os
import re
import stat
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from polhode._extras import imported

if TYPE_CHECKING:
    import numpy as np

    from polhode.files._models import SceneFile


class SceneFileError(ValueError):
    """Raised for a scene file that cannot be used.

    `str(error)` is a readable block of a few lines: the file and key, the value, the expected one,
    and how to correct it. Attributes, all texts: `file`, `key`, `problem`, `value`, `expected` and
    `fix`. The message also lists further errors.
    """

    def __init__(
        self,
        file: Path | str,
        key: str,
        problem: str,
        value: str = "",
        expected: str = "",
        fix: str = "",
        also: str = "",
    ):
        self.file, self.key, self.problem = str(file), key, problem
        self.value, self.expected, self.fix = value, expected, fix
        place = f"{self.file}: {key}: " if key else f"{self.file}: "
        rows = [("given", value), ("expected", expected), ("to fix", fix), ("also", also)]
        lines = [escape(f"  {name + ':':<10}{text}") for name, text in rows if text]
        super().__init__("\n".join([escape(place + problem), *lines]))


@contextlib.contextmanager
def scene_errors(file: "SceneFile", where: str) -> Iterator[None]:
    """Convert the error of a constructor to a SceneFileError with the place in the scene file."""
    try:
        yield
    except SceneFileError:
        raise
    except (ValueError, TypeError) as error:
        raise SceneFileError(file.path, where, str(error)[:500]) from error


def reason(error: Exception) -> str:
    """The message of an error, without the error number of a system error."""
    message = error.strerror if isinstance(error, OSError) else None
    return message or str(error) or type(error).__name__


class Verbatim(str):
    """Text that ``shorten`` shows without quotation marks."""

    def __repr__(self) -> str:
        return str(self)


def escape(text: str) -> str:
    """The text on one line, with control characters (escape sequences, line ends, marks that change
    the text direction) and unprintable ones written as \\x1b, \\u202e and so on.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def shorten(value: object, length: int = 80) -> str:
    """A value for a message, on one line of at most ``length`` characters."""
    try:
        text = " ".join(repr(value).split())
    except ValueError:  # an integer with more digits than Python converts to text
        return "a number of thousands of digits"
    return text if len(text) <= length else text[: length - 4] + " ..."


def did_you_mean(word: object, choices: Iterable[str]) -> str:
    """'did you mean "..."?' with the choice closest to a word, or an empty string."""
    names = {name.lower(): name for name in choices}
    close = difflib.get_close_matches(str(word)[:100].lower(), names, 1, 0.6)
    return f'did you mean "{names[close[0]]}"?' if close else ""


MAX_BYTES = 16 * 2**20
MAX_KEY_PARTS = 200


def read_scene(path: str | os.PathLike) -> "SceneFile":
    """Read and check a scene file (TOML, docs/scene_files.md); "-" reads standard input, and the
    files that the scene names from the current folder.

    Raises SceneFileError for a file that cannot be read, is larger than 16 MB, is not TOML, or
    breaks the schema: an unknown or missing key, a wrong type, shape or unit, a number that is not
    finite.
    """
    standard = os.fspath(path) == "-"
    path = Path("stdin" if standard else path)
    try:
        with open(0 if standard else path, "rb", closefd=not standard) as file:
            data = file.read(MAX_BYTES + 1)
    except (OSError, ValueError) as error:
        problem = f"cannot be read: {reason(error)}"
        raise SceneFileError(path, "", problem, fix="check the path and its permissions") from None
    if len(data) > MAX_BYTES:
        raise SceneFileError(
            path,
            "",
            "too large",
            value=f"more than {MAX_BYTES:,} bytes",
            expected="a scene file of a few pages",
            fix="keep rows of many bodies in .npy files: [ensemble.arrays]",
        )
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise SceneFileError(path, "", f"not a text file ({error})", expected="UTF-8") from None
    return parse_scene(text, path)


def parse_scene(
    text: str, path: str | os.PathLike = "<text>", *, files: bool = True
) -> "SceneFile":
    """`read_scene` for a text. `path`: its name in messages; files of [ensemble.arrays] and of
    tables over time are searched in its folder, or not read at all with `files=False`.
    """
    path = Path(path)
    file = _validate(text, path)
    file = file.model_copy(update={"title": file.title or escape(path.stem)})
    file._path, file._text = path, text
    if not files:
        return file
    plan = file.ensemble
    if plan is not None and plan.arrays is not None:
        file._rows = _read_arrays(dict(plan.arrays.entries()), plan.bodies, path)
    file._columns = _read_tables(file, path)
    _check_spans(file, path)
    return file


def shipped_scenes() -> dict[str, Path]:
    """The scene files that come with polhode, by name (``polhode run NAME`` runs one)."""
    folder = Path(__file__).with_name("scenes")
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def _validate(text: str, path: Path) -> "SceneFile":
    _limit_keys(text, path)
    try:
        data = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        words = "brackets nested too deeply" if isinstance(error, RecursionError) else str(error)
        problem = f"not valid TOML: {words[:200]}"
        raise SceneFileError(path, "", problem, fix="see https://toml.io for the syntax") from None
    pydantic = imported("a scene file", "pydantic")
    from polhode.files._models import SceneFile

    try:
        return SceneFile.model_validate(data)
    except pydantic.ValidationError as error:
        raise _scene_error(path, data, error.errors(include_url=False)) from None


_SPACE_BEFORE_DOT = re.compile(r"(?<![ \t])[ \t]++(?=\.)")
_SPACE_AFTER_DOT = re.compile(r"(?<=\.)[ \t]++")
_DOTTED = re.compile(rf"(?<![\w.\"'-])(?:[\w\"'-]++\.){{{MAX_KEY_PARTS},}}")


def _limit_keys(text: str, path: Path) -> None:
    """Reject dotted keys of hundreds of parts: ``tomllib`` needs quadratic time for them."""
    dense = _SPACE_AFTER_DOT.sub("", _SPACE_BEFORE_DOT.sub("", text))
    if match := _DOTTED.search(dense):
        line = dense.count("\n", 0, match.start()) + 1
        problem = f"keys nested too deeply (line {line})"
        raise SceneFileError(path, "", problem, expected=f"fewer than {MAX_KEY_PARTS} parts")


def _scene_error(path: Path, data: Any, errors: list[Any]) -> SceneFileError:
    """The errors of pydantic as one: the first with its value, and the places of the others."""
    # unknown keys first and missing ones last: a misspelt key is often the cause of a missing one
    errors = sorted(errors, key=lambda e: (e["type"] == "missing", e["type"] != "extra_forbidden"))
    first, *others = errors
    place = _place(first, data)
    value = "" if first["type"] == "missing" or not place else shorten(first["input"])
    others = dict.fromkeys(f"{_place(e, data)}: {_message(e)}" for e in others)
    others.pop(f"{place}: {_message(first)}", None)
    also = [shorten(Verbatim(words), 150) for words in list(others)[:2]]
    if len(others) > 2:
        also.append(f"{len(others) - 2} more")
    return SceneFileError(
        path, place, _message(first), value, fix=_suggestion(first, data), also="; ".join(also)
    )


def _message(error: Any) -> str:
    return error["msg"].removeprefix("Value error, ")


def _suggestion(error: Any, data: Any) -> str:
    """``did_you_mean`` for an unknown key or choice, or an empty string."""
    if error["type"] == "extra_forbidden":
        word, choices = str(error["loc"][-1]), _keys(error["loc"][:-1], data)
    elif error["type"] in ("literal_error", "union_tag_invalid"):
        context = error["ctx"]
        word = context.get("tag") or error["input"]
        choices = re.findall(r"'([^']*)'", context.get("expected") or context["expected_tags"])
    else:
        return ""
    return did_you_mean(word, (name for name in choices if name != word))


def _keys(place: Iterable[str | int], data: Any) -> set[str]:
    """The possible keys of the table at the place of an error, for all kinds it may be of."""
    from polhode.files._models import SceneFile

    tables: list[Any] = [SceneFile]
    for step in place:
        if isinstance(step, int):  # an entry of a list, or a single table in place of a list
            data = data[step] if isinstance(data, list) else data
        elif isinstance(data, dict) and step in data:
            data = data[step]
            fields = [table.model_fields[step] for table in tables if step in table.model_fields]
            tables = [table for field in fields for table in _tables(field.annotation)]
        else:  # a tag that pydantic adds: the kind of a table
            tables = [table for table in tables if step in _choices(table)] or tables
    return {key for table in tables for key in table.model_fields}


def _tables(annotation: Any) -> Iterator[Any]:
    """The table classes in an annotation."""
    from polhode.files._values import Table

    if isinstance(annotation, type) and issubclass(annotation, Table):
        yield annotation
    for part in get_args(annotation):
        yield from _tables(part)


def _choices(table: Any) -> set[Any]:
    """The values of the key ``kind`` or ``shape`` that select this class of table."""
    kinds = [table.model_fields.get(name) for name in ("kind", "shape")]
    return {word for field in kinds if field for word in get_args(field.annotation)}


def _place(error: Any, data: Any) -> str:
    """The place of an error in TOML notation, such as "[state.omega_body] unit". Entries of a list
    are numbered from 1.
    """
    path: list[str] = []
    for step in error["loc"]:
        if isinstance(step, int) and isinstance(data, list) and step < len(data):
            if path and isinstance(data[step], dict | list):
                path[-1] += f" {step + 1}"
        elif isinstance(data, dict) and step in data:
            path.append(shorten(Verbatim(step), 60))
        else:
            continue  # a tag that pydantic adds, such as the kind of a table
        data = data[step]
    if error["type"] == "missing":
        path.append(str(error["loc"][-1]))
    if isinstance(data, dict) and error["type"] != "extra_forbidden" and error["type"] != "missing":
        return f"[{'.'.join(path)}]" if path else ""
    *tables, key = path or [""]
    return " ".join(filter(None, [f"[{'.'.join(tables)}]" if tables else "", key]))


_WIDTHS = {"moments": 3, "wxyz": 4, "omega_body": 3, "momentum_body": 3, "torque": 3}
_VALID_ROWS = dict.fromkeys(_WIDTHS, "finite numbers") | {
    "moments": "positive moments of which none exceeds the sum of the others",
    "wxyz": "finite numbers, not all 0",
}


def _read_arrays(names: Mapping[str, str], bodies: int, scene: Path) -> "dict[str, np.ndarray]":
    """The memory-mapped arrays (bodies, width), validated. Raises SceneFileError."""
    return {name: _read_array(name, text, bodies, scene) for name, text in names.items()}


def _read_array(name: str, text: str, bodies: int, scene: Path) -> "np.ndarray":
    import numpy as np

    target = f"a file of NumPy (.npy) with {bodies} x {_WIDTHS[name]} numbers"

    def error_of(problem: str, value: str = text, expected: str = target) -> SceneFileError:
        return SceneFileError(scene, f"[ensemble.arrays] {name}", problem, value, expected)

    folder = scene.parent.resolve()
    path = (folder / text).resolve()
    if not path.is_relative_to(folder):
        raise error_of("a link that leaves the folder of the scene", text, f"a file in {folder}")
    try:
        if not stat.S_ISREG(path.stat().st_mode):  # reading a pipe might block for ever
            raise error_of("cannot be read: not a regular file")
        rows = np.load(path, mmap_mode="r", allow_pickle=False)
    except SceneFileError:
        raise
    except Exception as error:  # NumPy raises many types of errors for a damaged header
        raise error_of(f"cannot be read: {reason(error)[:200]}") from error
    if not isinstance(rows, np.ndarray):
        raise error_of("wrong shape or type", f"{text}: {type(rows).__name__}")
    if rows.shape != (bodies, _WIDTHS[name]) or rows.dtype.kind not in "fiu":
        raise error_of("wrong shape or type", f"{text}: {rows.shape} of {rows.dtype}")
    row = _first_invalid(name, rows)
    if row is not None:
        values = f"row {row}: {rows[row].tolist()}"
        raise error_of("impossible numbers", values, _VALID_ROWS[name])
    return rows


_MAX_TABLE_BYTES = 2**28


def _read_tables(file: "SceneFile", scene: Path) -> dict[str, list[list[float]]]:
    """The rows of the CSV files of tables over time, by name. Raises SceneFileError."""
    tables: dict[str, list[list[float]]] = {}
    for place, table in file.tables:
        if table.file is None:
            continue
        if table.file not in tables:
            tables[table.file] = _read_table(place, table.file, scene)
        file._columns = tables
        try:
            times, _ = file.columns(table)
            if len(times) < 2:
                raise ValueError("two or more rows are needed, got fewer")
        except ValueError as error:
            raise SceneFileError(scene, f"{place} file", str(error), table.file) from None
    return tables


def _check_spans(file: "SceneFile", scene: Path) -> None:
    """SceneFileError for a table over time that does not cover the simulated times."""
    unit = file.times.unit_seconds
    first, last = sorted((file.times.first * unit, file.times.last * unit))
    rounding = 1e-9 * (last - first)
    for place, table in file.tables:
        times, _ = file.columns(table)
        if not (times[0] <= first + rounding and last - rounding <= times[-1]):
            raise SceneFileError(
                scene,
                place,
                "a table that does not cover the simulated times",
                f"{times[0]:.10g} to {times[-1]:.10g} s",
                f"times from {first:.10g} to {last:.10g} s",
                "add rows, because the last polynomial would be continued; check the unit",
            )


def _read_table(place: str, text: str, scene: Path) -> list[list[float]]:
    """Rows of numbers separated by commas. A first row of names, empty lines and comments after
    ``#`` are skipped."""

    def error_of(problem: str, value: str = text) -> SceneFileError:
        expected = "a CSV file with the time and the values in its columns"
        return SceneFileError(scene, f"{place} file", problem, value, expected)

    folder = scene.parent.resolve()
    path = (folder / text).resolve()
    if not path.is_relative_to(folder):
        raise error_of("a link that leaves the folder of the scene")
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise error_of("cannot be read: not a regular file")
        if status.st_size > _MAX_TABLE_BYTES:
            raise error_of(f"too large: more than {_MAX_TABLE_BYTES:,} bytes")
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, ValueError) as error:
        raise error_of(f"cannot be read: {reason(error)}") from None
    rows: list[list[float]] = []
    for number, line in enumerate(lines, 1):
        cells = line.partition("#")[0].strip()
        if not cells:
            continue
        try:
            row = [float(cell) for cell in cells.split(",")]
        except ValueError:
            if number == next(i for i, x in enumerate(lines, 1) if x.partition("#")[0].strip()):
                continue  # the names of the columns
            raise error_of("not numbers separated by commas", f"line {number}: {line}") from None
        if not all(map(math.isfinite, row)):
            raise error_of("not finite", f"line {number}: {line}")
        rows.append(row)
    return rows


def possible_moments(moments: Any, rounded: bool = True) -> Any:
    """Which moments (..., 3), of NumPy or JAX, are positive and satisfy the triangle inequality.

    ``rounded``: with the tolerance of ``ph.Inertia``, for rounded numbers, such as of a flat body.
    """
    import numpy as np

    tolerance = float(np.sqrt(np.finfo(moments.dtype).eps)) if rounded else 0.0
    largest = (2 - tolerance) * moments.max(axis=-1)
    return (moments.min(axis=-1) > 0) & (largest <= moments.sum(axis=-1))


def _first_invalid(name: str, rows: "np.ndarray", step: int = 2**20) -> int | None:
    """The index of the first invalid row, or None. Reads ``step`` rows into memory at a time."""
    import numpy as np

    for start in range(0, len(rows), step):
        part = np.asarray(rows[start : start + step])
        part = part if np.issubdtype(part.dtype, np.floating) else part.astype(np.float64)
        valid = np.isfinite(part).all(axis=1)
        if name == "moments":
            valid &= possible_moments(part)
        elif name == "wxyz":
            valid &= part.any(axis=1)
        if not valid.all():
            return start + int(np.argmin(valid))
    return None
