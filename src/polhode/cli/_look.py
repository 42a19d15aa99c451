"""`polhode view` and `polhode lightcurve`."""

from pathlib import Path
from typing import Annotated

import typer

from polhode.cli._options import DebugOption


def view(
    path: Annotated[Path, typer.Argument(metavar="FILE.nc", help="made by `polhode run`")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="the page; FILE.html if left out")
    ] = None,
    debug: DebugOption = False,
) -> int:
    """Write one HTML page that shows the motion of a file: it needs no network."""
    from polhode import plot

    target = path.with_suffix(".html") if output is None else output
    plot.view_file(path, target)
    print(f"written: {target}")
    return 0


def lightcurve(
    path: Annotated[Path, typer.Argument(metavar="FILE", help="CSV, ALCDEF or DAMIT's lc.txt")],
    vectors: Annotated[
        Path | None, typer.Option(help="CSV of Sun and observer directions, if not in FILE")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="figure and numbers: OUTPUT.png, .json")
    ] = None,
    trials: Annotated[int, typer.Option(help="motions tried before the best are fitted")] = 40_000,
    floor: Annotated[float, typer.Option(help="least error of a point [mag]")] = 0.03,
    seed: Annotated[int, typer.Option(help="of the trials")] = 0,
    debug: DebugOption = False,
) -> int:
    """Spin and inertia of a tumbling body from its brightness."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from polhode.lightcurve import run

    run(path, vectors=vectors, output=output, trials=trials, floor=floor, seed=seed)
    return 0
