"""What every command shows and writes in the same way: progress, the files written, figures."""

import contextlib
import io
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any


def messages(quiet: bool) -> Any:
    """The console for progress, which is for people who watch: nothing goes into a log file."""
    from rich.console import Console

    console = Console(stderr=True)
    console.quiet = quiet or not console.is_terminal
    return console


def bar(console: Any, last: Any) -> Any:
    """A bar of bodies done, with the column ``last`` at its end."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

    columns = TextColumn("simulating"), BarColumn(), MofNCompleteColumn(), TextColumn("bodies")
    return Progress(*columns, last, console=console, transient=True)


@contextlib.contextmanager
def working(console: Any, words: str) -> Iterator[Callable[[str], None]]:
    """Show what is done and the time that it has taken; what is yielded changes the words."""
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = SpinnerColumn(), TextColumn("{task.description} ..."), TimeElapsedColumn()
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task(words, total=None)
        yield lambda words: progress.update(task, description=words)


def tell_written(console: Any, paths: Iterable[Path]) -> None:
    """Print the names of the files written."""
    from polhode.files._error import visible

    names = ", ".join(visible(str(path)) for path in paths)
    console.print(f"written: {names}", highlight=False, markup=False)


def write_figure(path: Path, draw: Callable[[], Any]) -> Path:
    """Draw without a display and write a PNG, whole or not at all."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    from polhode import __version__
    from polhode.files._atomic import whole_file

    figure, drawn = draw(), io.BytesIO()
    figure.savefig(drawn, format="png", dpi=160, metadata={"Software": f"polhode {__version__}"})
    pyplot.close(figure)
    with whole_file(path) as temporary:
        temporary.write_bytes(drawn.getvalue())
    return path
