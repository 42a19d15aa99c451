"""From the text of a scene file to its checked model; errors in one readable block.

Needs neither numpy nor JAX: a mistake is reported in a fraction of a second.
"""

import os
import re
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from polhode._extras import imported
from polhode.files._error import SceneFileError, Verbatim, did_you_mean, shorten, visible

if TYPE_CHECKING:
    from polhode.files._models import SceneFile

MAX_BYTES = 16 * 2**20
MAX_KEY_PARTS = 200


def read_scene(path: str | os.PathLike) -> "SceneFile":
    """Read and check a scene file (TOML, docs/scene_files.md); "-" reads standard input.

    Raises SceneFileError for a file that cannot be read, is larger than 16 MB, is not TOML, or
    breaks the schema: an unknown or missing key, a wrong type, shape or unit, a number that is not
    finite.
    """
    standard = os.fspath(path) == "-"
    path = Path("/dev/stdin" if standard else path)
    try:
        with open(0 if standard else path, "rb", closefd=not standard) as file:
            data = file.read(MAX_BYTES + 1)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise SceneFileError(
            path, "", f"cannot be read: {reason}", mend="check the path and its permissions"
        ) from None
    if len(data) > MAX_BYTES:
        raise SceneFileError(
            path, "", "too large", f"more than {MAX_BYTES:,} bytes", "a scene file of a few pages",
            "keep rows of many bodies in .npy files: [ensemble.arrays]",
        )  # fmt: skip
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise SceneFileError(path, "", f"not a text file ({error})", expected="UTF-8") from None
    return parse_scene(text, path)


def parse_scene(text: str, path: str | os.PathLike = "<text>") -> "SceneFile":
    """`read_scene` of a text; `path` is the name used in messages, and its folder that of the files
    of [ensemble.arrays].
    """
    path = Path(path)
    file = _checked(text, path)
    file = file.model_copy(update={"title": file.title or visible(path.stem)})
    file._path, file._text = path, text
    plan = file.ensemble
    if plan is not None and plan.arrays is not None:
        from polhode.files._arrays import read_arrays

        file._rows = read_arrays(dict(plan.arrays.given()), plan.bodies, path)
    return file


def _checked(text: str, path: Path) -> "SceneFile":
    _limit_keys(text, path)
    try:
        data = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        words = "brackets nested too deeply" if isinstance(error, RecursionError) else str(error)
        raise SceneFileError(
            path, "", f"not valid TOML: {words[:200]}", mend="see https://toml.io for the syntax"
        ) from None
    pydantic = imported("a scene file", "pydantic")
    from polhode.files._models import SceneFile

    try:
        return SceneFile.model_validate(data)
    except pydantic.ValidationError as error:
        raise _readable(path, data, error.errors(include_url=False)) from None


_SPACE_BEFORE_DOT = re.compile(r"(?<![ \t])[ \t]++(?=\.)")
_SPACE_AFTER_DOT = re.compile(r"(?<=\.)[ \t]++")
_DOTTED = re.compile(rf"(?<![\w.\"'-])(?:[\w\"'-]++\.){{{MAX_KEY_PARTS},}}")


def _limit_keys(text: str, path: Path) -> None:
    """Refuse dotted keys of hundreds of parts: their time grows as the square of the number."""
    dense = _SPACE_AFTER_DOT.sub("", _SPACE_BEFORE_DOT.sub("", text))
    if found := _DOTTED.search(dense):
        line = dense.count("\n", 0, found.start()) + 1
        raise SceneFileError(
            path, "", f"keys nested too deeply (line {line})",
            expected=f"fewer than {MAX_KEY_PARTS} parts",
        )  # fmt: skip


def _readable(path: Path, data: Any, errors: list[Any]) -> SceneFileError:
    """What pydantic found wrong: the first error with its value, and the places of the others."""
    # a key that is there and unknown explains one that is missing
    errors = sorted(errors, key=lambda e: (e["type"] == "missing", e["type"] != "extra_forbidden"))
    first, *others = errors
    place = _place(first, data)
    given = "" if first["type"] == "missing" or not place else shorten(first["input"])
    others = dict.fromkeys(f"{_place(e, data)}: {_message(e)}" for e in others)
    others.pop(f"{place}: {_message(first)}", None)
    also = [shorten(Verbatim(words), 150) for words in list(others)[:2]]
    if len(others) > 2:
        also.append(f"{len(others) - 2} more")
    return SceneFileError(
        path, place, _message(first), given, mend=_suggestion(first), also="; ".join(also)
    )


def _message(error: Any) -> str:
    return error["msg"].removeprefix("Value error, ")


def _suggestion(error: Any) -> str:
    """The key or the choice that was probably meant, or nothing."""
    if error["type"] == "extra_forbidden":
        word, known = str(error["loc"][-1]), _keys()
    elif error["type"] in ("literal_error", "union_tag_invalid"):
        context = error["ctx"]
        word = context.get("tag") or error["input"]
        known = re.findall(r"'([^']*)'", context.get("expected") or context["expected_tags"])
    else:
        return ""
    return did_you_mean(word, (name for name in known if name != word))


def _keys() -> set[str]:
    """The keys of all tables."""
    from polhode.files._table import Table

    tables, keys = [Table], set()
    while tables:
        table = tables.pop()
        tables += table.__subclasses__()
        keys |= table.model_fields.keys()
    return keys


def _place(error: Any, data: Any) -> str:
    """The place of an error as TOML calls it, such as "[state.omega_body] unit". Rows of a list
    are counted from 1.
    """
    path: list[str] = []
    for step in error["loc"]:
        if isinstance(step, int) and isinstance(data, list) and step < len(data):
            if path and isinstance(data[step], dict | list):
                path[-1] += f" {step + 1}"
        elif isinstance(data, dict) and step in data:
            path.append(shorten(Verbatim(step), 60))
        else:
            continue  # a mark of pydantic's own, such as the kind of a table
        data = data[step]
    if error["type"] == "missing":
        path.append(str(error["loc"][-1]))
    if isinstance(data, dict) and error["type"] != "extra_forbidden" and error["type"] != "missing":
        return f"[{'.'.join(path)}]" if path else ""
    *tables, key = path or [""]
    return " ".join(filter(None, [f"[{'.'.join(tables)}]" if tables else "", key]))
