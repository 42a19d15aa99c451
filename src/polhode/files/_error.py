"""The error of a scene file, and how text from files is shown on a terminal."""

import difflib
from collections.abc import Iterable
from pathlib import Path


class SceneFileError(ValueError):
    """A scene file that cannot be used.

    `str(error)` is a readable block of a few lines: the file and key, the value, what is expected,
    and how to correct it.
    """

    def __init__(
        self, file: Path | str, key: str, problem: str, given: str = "", expected: str = "",
        mend: str = "", also: str = "",
    ):  # fmt: skip
        self.file, self.key, self.problem = str(file), key, problem
        self.given, self.expected, self.mend = given, expected, mend
        place = f"{self.file}: {key}: " if key else f"{self.file}: "
        rows = [("given", given), ("expected", expected), ("to mend", mend), ("also", also)]
        lines = [visible(f"  {name + ':':<10}{text}") for name, text in rows if text]
        super().__init__("\n".join([visible(place + problem), *lines]))


class Verbatim(str):
    """Text that is shown without quotation marks."""

    def __repr__(self) -> str:
        return str(self)


def visible(text: str) -> str:
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


def did_you_mean(word: object, known: Iterable[str]) -> str:
    """A question with the known word that is close to another one, or nothing."""
    names = {name.lower(): name for name in known}
    close = difflib.get_close_matches(str(word)[:100].lower(), names, 1, 0.6)
    return f'did you mean "{names[close[0]]}"?' if close else ""
