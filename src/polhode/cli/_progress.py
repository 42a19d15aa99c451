"""What every command shows in the same way: progress, and the files written."""

import contextlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any


def progress_console(quiet: bool) -> Any:
    """The console for progress, which is for people who watch: nothing goes into a log file."""
    from rich.console import Console

    console = Console(stderr=True)
    console.quiet = quiet or not console.is_terminal
    return console


def progress_bar(console: Any, last: Any) -> Any:
    """A bar of bodies done, with the column ``last`` at its end."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

    columns = TextColumn("simulating"), BarColumn(), MofNCompleteColumn(), TextColumn("bodies")
    return Progress(*columns, last, console=console, transient=True)


@contextlib.contextmanager
def spinner(console: Any, words: str) -> Iterator[Callable[[str], None]]:
    """Show what is done and the time that it has taken; what is yielded changes the words."""
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = SpinnerColumn(), TextColumn("{task.description} ..."), TimeElapsedColumn()
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task(words, total=None)
        yield lambda words: progress.update(task, description=words)


def print_paths(console: Any, paths: Iterable[Path]) -> None:
    """Print the names of the files written."""
    from polhode.files._error import escape

    names = ", ".join(escape(str(path)) for path in paths)
    console.print(f"written: {names}", highlight=False, markup=False)
