"""The short commands: `explain`, `schema`, `scenes`, `reference`, `view`, `lightcurve`."""

import difflib
import os
from pathlib import Path
from typing import Annotated

import typer

from polhode.cli import _process
from polhode.cli._options import (
    ClonesOption,
    DebugOption,
    ForceOption,
    PrecisionOption,
    QuietOption,
    SceneName,
    SeedOption,
    UsageError,
    check_suffix,
    not_negative,
    option,
    output_option,
    output_path,
    output_stem,
    positive,
    read_scene,
    require,
    usage_errors,
    whole_number,
)
from polhode.files import shipped_scenes
from polhode.files._read import escape, scene_errors


def explain(
    scene: SceneName,
    clones: ClonesOption = None,
    seed: SeedOption = None,
    precision: PrecisionOption = "float64",
    debug: DebugOption = False,
) -> int:
    """Explain which method would simulate a scene, and why, without running it."""
    file = read_scene(scene, clones, seed)
    import polhode
    from polhode.cli._job import prepare

    job = prepare(file, precision)
    times, monte_carlo, ensemble = file.times, file.monte_carlo, file.ensemble
    parts, state = job.scene, job.state
    if ensemble is not None:  # the method depends on the drawn bodies, and on their number
        import numpy as np

        from polhode.ensemble import build_ensemble
        from polhode.ensemble._stream import block_size

        block = block_size(len(job.ts))
        indices = np.minimum(np.arange(block), ensemble.bodies - 1)
        parts, state = build_ensemble(file, precision)[0].draw(indices)
    with scene_errors(file, ""):
        plan = polhode.explain(parts, state, job.ts, job.method, rtol=job.rtol)
    first, last = (times.seconds[k] / times.unit_seconds for k in (0, -1))
    print(f"{escape(file.title)}\n  source: {escape(file.source) or 'not stated'}")
    print(f"  {len(times.seconds)} samples from {first:g} to {last:g} {times.unit}, {precision}")
    if monte_carlo is not None:
        print(f"  {monte_carlo.clones} clones, seed {monte_carlo.seed}, drawn from the spread of:")
        for quantity, spread in monte_carlo.spreads.items():
            print(f"    {quantity}: {escape(spread.source)}")
    if ensemble is not None:
        print(f"  an ensemble of {ensemble.bodies:,} bodies, seed {ensemble.seed}, in blocks:")
    print(f"\n{plan}")
    return 0


def schema(debug: DebugOption = False) -> int:
    """Print the JSON Schema of scene files, for editors."""
    import json

    from polhode.files import SceneFile

    print(json.dumps(SceneFile.model_json_schema(), indent=1))
    return 0


def scenes(
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="the scene to copy", show_default=False)
    ] = None,
    output: Annotated[
        str | None,
        output_option("FILE", "where to copy it (default: NAME.toml here)"),
    ] = None,
    force: ForceOption = False,
    debug: DebugOption = False,
) -> int:
    """List the scenes that come with polhode, or copy one. `polhode run NAME` runs a scene."""
    import tomllib

    from polhode._atomic import atomic_write

    shipped = shipped_scenes()
    if name is None:
        if output is not None:
            raise UsageError("-o needs the NAME of the scene to copy.")
        for key, file in shipped.items():
            title = tomllib.loads(file.read_text(encoding="utf-8")).get("title", "")
            print(f"{key:<16}{escape(title)}")
        print("\npolhode run NAME runs a scene, polhode scenes NAME copies it into this folder")
        return 0
    if name not in shipped:
        close = difflib.get_close_matches(name.removesuffix(".toml"), shipped, 1)
        hint = f"; did you mean {close[0]}?" if close else "."
        raise UsageError(f"there is no scene {name!r}: there are {', '.join(shipped)}{hint}")
    check_suffix(output or "", ".toml", what="a scene file")
    path = output_path(output or name, ".toml", force=True)
    # not left to ``output_path``: an edited copy also names polhode as its maker
    if os.path.lexists(path) and not force:
        raise FileExistsError(
            f"{path} exists: name another file with -o, or give --force to replace it"
        )
    with atomic_write(path) as temporary:
        temporary.write_bytes(shipped[name].read_bytes())
    print(f"written: {escape(str(path))}")
    return 0


def reference(
    output: Annotated[
        str,
        typer.Option("-o", "--output", metavar="NAME", help="writes NAME.json and NAME.csv"),
    ] = "tumbling",
    force: ForceOption = False,
    debug: DebugOption = False,
) -> int:
    """Write reference motions of torque-free bodies, correct to 17 digits, to test other programs.

    Attitudes and rates of 14 bodies with their derivatives, up to 1e5 revolutions, and flip times.
    """
    from polhode._atomic import atomic_write
    from polhode.files._write import REFERENCE, reference_csv

    stem = output_stem(output, ".json", ".csv", what="the reference data")
    texts = {".json": REFERENCE.read_text(encoding="utf-8"), ".csv": reference_csv()}
    paths = {
        output_path(stem, suffix, force=force or _is_earlier(stem + suffix, text)): text
        for suffix, text in texts.items()
    }
    for path, text in paths.items():
        with atomic_write(path) as temporary:
            temporary.write_text(text, encoding="utf-8", newline="\n")
        print(f"written: {escape(str(path))}")
    return 0


def _is_earlier(name: str, text: str) -> bool:
    """Whether a file begins like the one to write, because a CSV table does not name its maker."""
    path, start = Path(name), text[:200].encode()
    if not path.is_file() or path.is_symlink():
        return False
    with path.open("rb") as file:
        return file.read(len(start)) == start


def view(
    path: Annotated[Path, typer.Argument(metavar="FILE.nc", help="made by `polhode run`")],
    output: Annotated[
        str | None,
        output_option("PAGE", "the page; FILE.html if left out"),
    ] = None,
    force: ForceOption = False,
    debug: DebugOption = False,
) -> int:
    """Write an HTML page that animates the motion in a NetCDF file. The page works offline."""
    if output is not None:
        check_suffix(output, ".html", ".htm", what="a page")
    expected = "a NetCDF file (.nc) that `polhode run` wrote"
    with usage_errors(path, ".nc", expected):
        pass  # checks the file before the slow import of JAX
    require("view", "xarray", "h5netcdf", "h5py")
    from polhode import plot

    with usage_errors(path, ".nc", expected):
        page = plot.view_file(path)
    name = str(path.with_suffix(".html")) if output is None else output
    suffix = ".htm" if name.endswith(".htm") else ".html"
    target = output_path(name, suffix, force=force)
    page.write(target)
    print(f"written: {escape(str(target))}")
    return 0


_PHASES = ("seeliger", "linear", "hg", "hg1g2")  # the keys of ``PHASES``, without importing JAX


def _phase(text: str) -> str:
    """A name of a phase function."""
    if text.lower() not in _PHASES:
        raise typer.BadParameter(f"{text[:80]!r} is not one of {', '.join(_PHASES)}")
    return text.lower()


def lightcurve(
    path: Annotated[Path, typer.Argument(metavar="FILE", help="CSV, ALCDEF or DAMIT's lc.txt")],
    vectors: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="CSV of Sun and observer directions, if not in FILE"),
    ] = None,
    output: Annotated[
        str | None,
        output_option("OUTPUT", "figure and numbers: OUTPUT.png, .json"),
    ] = None,
    trials: Annotated[
        int,
        option("--trials", "N", "motions tried before the best are fitted", whole_number(1)),
    ] = 40_000,
    max_frequency: Annotated[
        float | None,
        option(
            "--max-frequency",
            "F",
            "end of the search [cycles/day]; beyond all strong lines if left out",
            positive,
        ),
    ] = None,
    floor: Annotated[
        float, option("--floor", "MAG", "least error of a point [mag]", not_negative)
    ] = 0.03,
    seed: Annotated[int, option("--seed", "N", "seed of the trials", whole_number(0))] = 0,
    searches: Annotated[
        int,
        option(
            "--searches",
            "N",
            "searches at most, until two agree; 0: only those of --start",
            whole_number(0),
        ),
    ] = 3,
    binned: Annotated[
        float | None, option("--binned", "DAYS", "width of normal points", positive)
    ] = None,
    phase: Annotated[
        str | None,
        option(
            "--phase",
            "NAME",
            "phase function: seeliger, linear, hg or hg1g2 (default: hg1g2 where the phase angle"
            " changes by more than 5 deg, else seeliger)",
            _phase,
        ),
    ] = None,
    start: Annotated[
        Path | None,
        typer.Option(
            metavar="JSON",
            help="result of an earlier fit, such as one of fewer nights: its solutions are tried"
            " first",
        ),
    ] = None,
    calibrated: Annotated[
        bool, typer.Option("--calibrated", help="nights share a zero point up to small errors")
    ] = False,
    reduced: Annotated[
        bool, typer.Option("--reduced", help="the brightness is reduced for distance already")
    ] = False,
    force: ForceOption = False,
    quiet: QuietOption = False,
    debug: DebugOption = False,
) -> int:
    """Estimate spin and inertia of a tumbling body from its light curve."""
    expected = "a light curve: CSV with a header line, ALCDEF or DAMIT's lc.txt"
    if output is not None:
        output = output_stem(output, ".png", ".json", what="the figure and the numbers")
    directions = "a CSV of directions: jd, sun_x ... observer_z"
    for file, what in ((path, expected), (vectors, directions)):
        if file is not None:
            with usage_errors(file, ".csv", what):
                pass
    earlier = "the JSON file of an earlier polhode lightcurve"
    if start is not None:
        with usage_errors(start, ".json", earlier):
            pass
    elif searches < 1:
        raise UsageError("--searches 0 needs the solutions of an earlier fit: --start JSON.")
    require("lightcurve", "rich", "matplotlib")
    import jax

    jax.config.update("jax_enable_x64", True)
    from polhode.lightcurve._command import fit_file, read, read_solutions

    reading = {"binned": binned, "calibrated": calibrated, "reduced": reduced}
    with usage_errors(path, ".csv", expected):
        curve = read(path, vectors, floor, **reading)
    solutions = None
    if start is not None:
        with usage_errors(start, ".json", earlier):
            solutions = read_solutions(start)
    reading["vectors"] = None if vectors is None else vectors.name
    reading["start"] = None if start is None else start.name
    name = output or path.stem
    paths = [output_path(name + end, end, force=force) for end in (".png", ".json")]
    lines: list[str] = []
    options = {"trials": trials, "searches": searches, "seed": seed, "phase": phase}
    options |= {"floor": floor, "max_frequency": max_frequency, "say": lines.append}
    words = f"searching {curve.t.size} points with {trials:,} trials (compiling first)"
    try:
        with _process.spinner(_process.progress_console(quiet), words) as show:
            fit_file(
                curve,
                path.name,
                *paths,
                **options,
                start=solutions,
                progress=show,
                reading=reading,
            )
    except ValueError as error:  # for example of a constant brightness
        raise UsageError(f"{path}: {error}") from error
    if not quiet:
        print("\n".join(lines))
    return 0
