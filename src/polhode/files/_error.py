"""The error of a scene file, and how text from files is shown on a terminal."""

import contextlib
import difflib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from polhode.files._models import SceneFile


class SceneFileError(ValueError):
    """A scene file that cannot be used.

    `str(error)` is a readable block of a few lines: the file and key, the value, what is expected,
    and how to correct it. These are its attributes `file`, `key`, `problem`, `value`, `expected`,
    `fix` and `also` (further errors), all texts.
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
    """Turn the error of a constructor into one that names the place in the scene file."""
    try:
        yield
    except SceneFileError:
        raise
    except (ValueError, TypeError) as error:
        raise SceneFileError(file.path, where, str(error)[:500]) from error


def reason(error: Exception) -> str:
    """What went wrong, without the number that a system error begins with."""
    message = error.strerror if isinstance(error, OSError) else None
    return message or str(error) or type(error).__name__


class Verbatim(str):
    """Text that is shown without quotation marks."""

    def __repr__(self) -> str:
        return str(self)


def escape(text: str) -> str:
    """The text on one line, with every character that a terminal would obey (escapes, line ends,
    marks that reverse the direction) or cannot show written as \\x1b, \\u202e and the like.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def shorten(value: object, length: int = 80) -> str:
    """A value of the file as it is shown in a message, on one line and not too long."""
    try:
        text = " ".join(repr(value).split())
    except ValueError:  # an integer of more digits than Python writes out
        return "a number of thousands of digits"
    return text if len(text) <= length else text[: length - 4] + " ..."


def did_you_mean(word: object, choices: Iterable[str]) -> str:
    """A question with the choice that is close to another one, or nothing."""
    names = {name.lower(): name for name in choices}
    close = difflib.get_close_matches(str(word)[:100].lower(), names, 1, 0.6)
    return f'did you mean "{names[close[0]]}"?' if close else ""
