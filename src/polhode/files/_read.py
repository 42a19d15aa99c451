"""From the text of a scene file to its checked model; errors in one readable block.

Needs neither numpy nor JAX: a mistake is told in a fraction of a second.
"""

import os
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from polhode._extras import imported
from polhode.files._error import SceneFileError, shorten, visible

if TYPE_CHECKING:
    from polhode.files._models import SceneFile

MOST_BYTES = 16 * 2**20
MOST_DEPTH = 16
MOST_DIGITS = 4000


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
            data = file.read(MOST_BYTES + 1)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise SceneFileError(
            path, "", f"cannot be read: {reason}", mend="check the path and its permissions"
        ) from None
    if len(data) > MOST_BYTES:
        raise SceneFileError(
            path, "", "too large", f"more than {MOST_BYTES:,} bytes", "a scene file of a few pages",
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
    _limit(text, path)
    try:
        data = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise SceneFileError(
            path, "", f"not valid TOML: {error}", mend="see https://toml.io for the syntax"
        ) from None
    pydantic = imported("a scene file", "pydantic")
    from polhode.files._models import SceneFile

    try:
        return SceneFile.model_validate(data)
    except pydantic.ValidationError as error:
        found = error.errors(include_url=False)
        # what is there and wrong comes before what is not there
        first = min(found, key=lambda e: e["type"] == "missing")
        raise _told(path, data, first) from None


# strings and comments of TOML, so that what is in them does not count
_QUOTED = re.compile(
    r'"""(?:\\.|[^\\])*?"{3,5}|'
    + r"'''.*?'{3,5}|"
    + r'"(?:\\.|[^"\\\n])*"|'
    + r"'[^'\n]*'|#[^\n]*",
    re.DOTALL,
)
_DOTTED = re.compile(rf"(?<![\w-])(?:[\w-]++[ \t]*+\.[ \t]*+){{{MOST_DEPTH},}}")
_LONG = re.compile(rf"(?<!\w)\w{{{MOST_DIGITS},}}")


def _limit(text: str, path: Path) -> None:
    """Refuse what would take the parser seconds, or more calls than Python allows."""
    bare = _QUOTED.sub(lambda found: "s" + "\n" * found[0].count("\n"), text)

    def refuse(problem: str, at: int, expected: str) -> SceneFileError:
        line = bare.count("\n", 0, at) + 1
        return SceneFileError(path, _key_at(bare, at), f"{problem} (line {line})",
                              expected=expected)  # fmt: skip

    if found := _DOTTED.search(bare):
        raise refuse("keys nested too deeply", found.start(), f"at most {MOST_DEPTH} levels")
    if found := _LONG.search(bare):
        raise refuse(f"a number or key of {len(found[0]):,} characters", found.start(),
                     f"fewer than {MOST_DIGITS:,}")  # fmt: skip
    depth = 0
    for found in re.finditer(r"[\[\]{}]", bare):
        depth += 1 if found[0] in "[{" else -1
        if depth > MOST_DEPTH:
            raise refuse("brackets nested too deeply", found.start(), f"at most {MOST_DEPTH}")


def _key_at(text: str, at: int) -> str:
    """The key and the table that a place in the text belongs to, as far as lines tell."""
    before = text[max(0, at - 100_000) : at + 200]
    keys = re.findall(r"^[ \t]*([\w-]{1,80})[ \t]*=", before, re.MULTILINE)
    tables = re.findall(r"^[ \t]*\[{1,2}([\w. -]{1,80})\]", before, re.MULTILINE)
    table = f"[{tables[-1]}] " if tables else ""
    return table + (keys[-1] if keys else "")


def _told(path: Path, data: Any, error: Any) -> SceneFileError:
    """pydantic's error in our words."""
    names, value = list(_walk(error["loc"], data)), error["input"]
    told = error.get("ctx", {})
    if error["type"] == "scene":
        key = told["key"]
        names += [] if key is None else key.split(".")
        name = _name(names if key is None or key else [*names, ""])
        words = (told["problem"], told["given"], told["expected"], told["mend"])
    elif error["type"] == "missing":
        key, have = str(error["loc"][-1]), "only " + ", ".join(value) if value else "nothing"
        name = _name([*names, key])
        words = ("missing key", have, _expected(key, value), f"add `{key} = ...`")
    elif error["type"].startswith("union_tag"):
        key, tags = told["discriminator"].strip("'"), told.get("expected_tags", "")
        words = _untagged(value, key, tags.replace("'", ""), names)
        name = _name([*names, key])
    else:
        told = _PLAIN.get(error["type"], (error["msg"].lower(), ""))
        name, words = _name(names), (told[0], shorten(value), told[1], "")
    return SceneFileError(path, name, *words)


_PLAIN = {
    "list_type": ("not a list of tables", "tables written as [[...]]"),
    "model_attributes_type": ("not a table", "a table"),
    "too_short": ("an empty list", "one row or more"),
}


def _expected(key: str, given: Any) -> str:
    """What the table with these keys and this one needs there, in words."""
    from polhode.files._table import Table

    kinds, found = [Table], []
    while kinds:
        kind = kinds.pop()
        kinds += kind.__subclasses__()
        field = kind.model_fields.get(key)
        if field is not None and field.is_required() and set(given) <= kind.model_fields.keys():
            found.append(kind.needs(key))
    return found[0] if found else "a value"


def _untagged(value: Any, key: str, tags: str, names: list[str]) -> tuple[str, str, str, str]:
    """A table whose kind is missing or unknown."""
    from polhode.files import _bodies
    from polhode.files._values import suggestion

    if not tags:
        unions = {"potential": _bodies.Potential, "torque": _bodies.Torque}
        tags = ", ".join(_tags(unions.get(names[0], _bodies.AnySolid), key))
    given = value.get(key) if isinstance(value, dict) else value
    if given is None:
        return "missing key", f"only {', '.join(value)}", f"one of {tags}", f"add `{key} = ...`"
    mend = suggestion(given, tags.split(", ")) if isinstance(given, str) else ""
    return "unknown choice", shorten(given), f"one of {tags}", mend


def _tags(union: Any, key: str) -> Iterator[str]:
    for model in union.__origin__.__args__:
        yield from model.model_fields[key].annotation.__args__


def _walk(place: tuple, data: Any) -> Iterator[str]:
    """The keys of a place in the file, rows counted from 1 (" 1"); without pydantic's own marks."""
    for step in place:
        if isinstance(step, int) and isinstance(data, list) and step < len(data):
            yield f" {step + 1}"
        elif isinstance(data, dict) and step in data:
            yield str(step)
        else:
            continue
        data = data[step]


def _name(names: list[str]) -> str:
    """ "[table.inner 2] key", as messages call a place; without a key for a table itself."""
    path: list[str] = []
    for name in names:
        if name.startswith(" ") and path:
            path[-1] += name
        else:
            path.append(name)
    *tables, key = path or [""]
    if not key or " " in key:
        tables, key = [*tables, key], ""
    where = ".".join(filter(None, tables)).replace("observations.rows ", "observations row ")
    return " ".join(filter(None, [f"[{where}]" if where else "", key]))
