"""`polhode reference`: motions of free bodies to test other programs against."""

from pathlib import Path
from typing import Annotated

import typer

from polhode.cli import _targets
from polhode.cli._options import DebugOption, ForceOption


def reference(
    output: Annotated[
        str,
        typer.Option("-o", "--output", metavar="NAME", help="writes NAME.json and NAME.csv"),
    ] = "tumbling",
    force: ForceOption = False,
    debug: DebugOption = False,
) -> int:
    """Write motions of free rigid bodies that are correct to 17 digits, to test a program against.

    Attitudes, rates, flip times and their derivatives of 14 bodies at times up to 1e5 revolutions.
    """
    from polhode.files._atomic import whole_file
    from polhode.files._error import visible
    from polhode.files._reference import REFERENCE, reference_csv

    stem = _targets.stem(output, ".json", ".csv", what="the reference data")
    texts = {".json": REFERENCE.read_text(encoding="utf-8"), ".csv": reference_csv()}
    goals = {
        _targets.target(stem, suffix, force=force or _is_earlier(stem + suffix, text)): text
        for suffix, text in texts.items()
    }
    for goal, text in goals.items():
        with whole_file(goal) as temporary:
            temporary.write_text(text, encoding="utf-8", newline="\n")
        print(f"written: {visible(str(goal))}")
    return 0


def _is_earlier(name: str, text: str) -> bool:
    """Whether a file begins as the one to write: a table does not name its maker."""
    path, start = Path(name), text[:200].encode()
    if not path.is_file() or path.is_symlink():
        return False
    with path.open("rb") as file:
        return file.read(len(start)) == start
