"""`polhode view` and `polhode lightcurve`."""

from pathlib import Path
from typing import Annotated

import typer

from polhode.cli import _show
from polhode.cli._inputs import refused
from polhode.cli._options import (
    DebugOption,
    ForceOption,
    QuietOption,
    not_negative,
    positive,
    require,
    whole_number,
)
from polhode.cli._targets import UsageError, check_suffix, stem, target


def view(
    path: Annotated[Path, typer.Argument(metavar="FILE.nc", help="made by `polhode run`")],
    output: Annotated[
        str | None,
        typer.Option("-o", "--output", metavar="PAGE", help="the page; FILE.html if left out"),
    ] = None,
    force: ForceOption = False,
    debug: DebugOption = False,
) -> int:
    """Write one HTML page that shows the motion of a file: it needs no network."""
    from polhode.files._error import visible

    if output is not None:
        check_suffix(output, ".html", ".htm", what="a page")
    expected = "a NetCDF file (.nc) that `polhode run` wrote"
    with refused(path, ".nc", expected):
        pass  # before JAX is imported
    require("view", "xarray", "h5netcdf", "h5py")
    from polhode import plot

    with refused(path, ".nc", expected):
        page = plot.view_file(path)
    name = str(path.with_suffix(".html")) if output is None else output
    suffix = ".htm" if name.endswith(".htm") else ".html"
    goal = target(name, suffix, force=force)
    page.write(goal)
    print(f"written: {visible(str(goal))}")
    return 0


def lightcurve(
    path: Annotated[Path, typer.Argument(metavar="FILE", help="CSV, ALCDEF or DAMIT's lc.txt")],
    vectors: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="CSV of Sun and observer directions, if not in FILE"),
    ] = None,
    output: Annotated[
        str | None,
        typer.Option(
            "-o", "--output", metavar="OUTPUT", help="figure and numbers: OUTPUT.png, .json"
        ),
    ] = None,
    trials: Annotated[
        int,
        typer.Option(
            parser=whole_number(1), metavar="N", help="motions tried before the best are fitted"
        ),
    ] = 40_000,
    max_frequency: Annotated[
        float | None,
        typer.Option(
            parser=positive,
            metavar="F",
            help="end of the search [cycles/day]; beyond all strong lines if left out",
        ),
    ] = None,
    floor: Annotated[
        float, typer.Option(parser=not_negative, metavar="MAG", help="least error of a point [mag]")
    ] = 0.03,
    seed: Annotated[
        int, typer.Option(parser=whole_number(0), metavar="N", help="of the trials")
    ] = 0,
    searches: Annotated[
        int,
        typer.Option(parser=whole_number(1), metavar="N", help="searches at most, until two agree"),
    ] = 3,
    binned: Annotated[
        float | None,
        typer.Option(parser=positive, metavar="DAYS", help="width of normal points"),
    ] = None,
    calibrated: Annotated[
        bool, typer.Option("--calibrated", help="nights share a zero point, but for small errors")
    ] = False,
    reduced: Annotated[
        bool, typer.Option("--reduced", help="the brightness is reduced for distance already")
    ] = False,
    force: ForceOption = False,
    quiet: QuietOption = False,
    debug: DebugOption = False,
) -> int:
    """Spin and inertia of a tumbling body from its brightness."""
    expected = "a light curve: CSV with a header line, ALCDEF or DAMIT's lc.txt"
    if output is not None:
        output = stem(output, ".png", ".json", what="the figure and the numbers")
    directions = "a CSV of directions: jd, sun_x ... observer_z"
    for file, what in ((path, expected), (vectors, directions)):
        if file is not None:
            with refused(file, ".csv", what):
                pass
    require("lightcurve", "rich", "matplotlib")
    import jax

    jax.config.update("jax_enable_x64", True)
    from polhode.lightcurve._command import fitted, read

    with refused(path, ".csv", expected):
        curve = read(path, vectors, floor, binned=binned, calibrated=calibrated, reduced=reduced)
    name = output or path.stem
    goals = [target(name + end, end, force=force) for end in (".png", ".json")]
    lines: list[str] = []
    options = {
        "trials": trials, "floor": floor, "seed": seed, "say": lines.append,
        "max_frequency": max_frequency, "searches": searches,
    }  # fmt: skip
    words = f"searching {curve.t.size} points with {trials:,} trials (compiling first)"
    try:
        with _show.working(_show.messages(quiet), words):
            fitted(curve, path.name, *goals, **options)
    except ValueError as error:  # a brightness that does not vary
        raise UsageError(f"{path}: {error}") from error
    if not quiet:
        print("\n".join(lines))
    return 0
