"""`polhode run SCENE`: simulate a scene file, write NetCDF and a figure, print a summary."""

import argparse
import importlib.util
import sys
from pathlib import Path

from polhode.cli import _ensemble
from polhode.cli._options import add_scene, read


def register(commands) -> argparse.ArgumentParser:
    """Add the command to the parser."""
    command = commands.add_parser(
        "run",
        help="simulate a scene; write a NetCDF file and a figure, print a summary",
        description="Simulate a scene file with its Monte Carlo clones. Writes NetCDF and a PNG "
        "figure beside it, each whole or not at all, and prints a summary table.",
        epilog="example: polhode run scenes/toutatis.toml -o toutatis.nc",
    )
    add_scene(command)
    command.add_argument(
        "-o", "--output", metavar="FILE", type=Path,
        help="NetCDF file to write (default: that of the scene's [output], or SCENE.nc here); its "
        "folder is made if need be",
    )  # fmt: skip
    command.add_argument("--no-figure", action="store_true", help="do not draw the figure")
    command.add_argument("-q", "--quiet", action="store_true", help="print errors only")
    _ensemble.add_options(command)
    command.set_defaults(command=run)
    return command


def run(arguments: argparse.Namespace) -> int:
    """Do the job; 0, or 1 when some clones did not finish."""
    file = read(arguments)
    if file.ensemble is not None:
        _require("rich", "zarr", extra="scale")
        return _ensemble.run(arguments, file, arguments.output)
    _ensemble.refuse_options(arguments, file)
    with_figure = file.output.figure and not arguments.no_figure
    _require("rich", "xarray", "h5netcdf", "h5py", *(("matplotlib",) if with_figure else ()))
    from rich.console import Console

    output = _target(arguments.output or file.output.file or Path(file.path.stem + ".nc"))
    messages = Console(stderr=True)
    # progress is for people who watch: nothing of it goes into a log file
    messages.quiet = arguments.quiet or not messages.is_terminal
    with messages.status("starting ..."):
        from polhode.cli import _job, _summary
        from polhode.io import write_netcdf

        job = _job.prepare(file, arguments.precision)
    outcome = _with_progress(messages, job)
    with messages.status("measuring and writing ..."):
        figures = _summary.measure(job, outcome)
        dataset = _dataset(job, outcome, figures)
        written = [write_netcdf(dataset, output)]
        if with_figure:
            written.append(_draw(job, outcome, output.with_suffix(".png")))
    if not arguments.quiet:
        out = Console(soft_wrap=not sys.stdout.isatty())
        out.print(_summary.table(job, outcome, figures))
        out.print("written: " + ", ".join(map(str, written)), highlight=False)
    return _failures(outcome.trajectory.status)


def _require(*packages: str, extra: str = "cli") -> None:
    """ImportError now, rather than after the work, when a package is missing."""
    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    if missing:
        raise ImportError(
            f"`polhode run` needs {', '.join(missing)}: pip install 'polhode[{extra}]'"
        )


def _target(path: Path | str) -> Path:
    """The output path, its folder made; OSError before the work rather than after it."""
    path = Path(path)
    if path.suffix != ".nc":
        path = path.with_name(path.name + ".nc")
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder: name a file to write, such as {path}/out.nc")
    probe = path.parent / f".{path.stem}.probe"
    probe.touch()
    probe.unlink()
    return path


def _with_progress(messages, job):
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from polhode.cli import _job

    columns = (
        TextColumn("simulating"), BarColumn(), MofNCompleteColumn(), TextColumn("bodies"),
        TimeElapsedColumn(),
    )  # fmt: skip
    with Progress(*columns, console=messages, transient=True) as progress:
        task = progress.add_task("", total=job.bodies)
        return _job.run(job, lambda done: progress.update(task, completed=done))


def _dataset(job, outcome, figures):
    """The trajectory's dataset with the clones numbered, their periods and the scene's text."""
    dataset = outcome.trajectory.to_xarray()
    file = job.file
    lead = ()
    if job.batch_shape:
        dataset = dataset.rename(body="clone")
        numbers = range(job.bodies)
        dataset = dataset.assign_coords(clone=("clone", list(numbers)))
        dataset["clone"].attrs["long_name"] = "number of the clone; 0 is the nominal body"
        lead = ("clone",)
    for name, values in figures.periods.items():
        values = values if lead else values[0]
        dataset[name] = (lead, values, {"units": "s", "long_name": f"period {name}"})
    dataset["moments"] = (
        (*(lead if job.scene.inertia.batch_shape else ()), "axis"),
        job.scene.inertia.moments,
        {
            "units": "1" if file.relative_moments else "kg m2",
            "long_name": "principal moments of inertia",
        },
    )
    text = file.path.read_text(encoding="utf-8")
    dataset.attrs.update(title=file.title, scene_source=file.source, frame=file.frame, scene=text)
    if file.epoch is not None:
        dataset.attrs["epoch"] = file.epoch.isoformat()
    return dataset


def _draw(job, outcome, path: Path) -> Path:
    """Write the overview figure, without a display."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    from polhode import plot
    from polhode.io import build_attitudes, whole_file

    file, seen = job.file, job.file.observations
    observed = None
    if seen is not None:
        observed = plot.motion(
            seen.seconds, seen.omega_body, build_attitudes(seen.attitudes, "float64")
        )
    figure = plot.overview(
        outcome.trajectory,
        observed=observed,
        axis_names=file.axis_names,
        title=file.title,
    )
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=160)
    pyplot.close(figure)
    return path


def _failures(status) -> int:
    import numpy as np

    from polhode import Status

    status = np.reshape(status, -1)
    failed = status != Status.SUCCESSFUL
    if not failed.any():
        return 0
    first = Status(int(status[failed][0]))
    print(
        f"polhode: {int(failed.sum())} of {status.size} bodies did not finish, the first being "
        f"clone {int(np.argmax(failed))}: {first.explanation}; see `status` in the file",
        file=sys.stderr,
    )
    return 1
