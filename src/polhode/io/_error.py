"""The error of a scene file: file, key, what was given, what is expected, how to mend it."""

from pathlib import Path


class SceneFileError(ValueError):
    """A scene file that cannot be used.

    `str(error)` is a readable block of a few lines: the file and key, what was given, what is
    expected, and how to mend it.
    """

    def __init__(
        self, file: Path | str, key: str, problem: str, given: str = "", expected: str = "",
        mend: str = "",
    ):  # fmt: skip
        self.file, self.key, self.problem = str(file), key, problem
        self.given, self.expected, self.mend = given, expected, mend
        place = f"{self.file}: {key}: " if key else f"{self.file}: "
        rows = [("given", given), ("expected", expected), ("to mend", mend)]
        lines = [f"  {name + ':':<10}{text}" for name, text in rows if text]
        super().__init__("\n".join([place + problem, *lines]))


def shorten(value: object, length: int = 80) -> str:
    """A value of the file as it is shown in a message, on one line and not too long."""
    text = " ".join(repr(value).split())
    return text if len(text) <= length else text[: length - 4] + " ..."
