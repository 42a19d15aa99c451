"""`polhode run SCENE`: simulate a scene file, write NetCDF and a figure, print a summary."""

import datetime
import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from polhode.cli import _ensemble, _show
from polhode.cli._options import (
    ClonesOption,
    DebugOption,
    ForceOption,
    NoCacheOption,
    NoFigureOption,
    PrecisionOption,
    QuietOption,
    SceneName,
    SeedOption,
    read,
    require,
)
from polhode.cli._signals import heed
from polhode.cli._targets import check_suffix, target
from polhode.files._error import visible


def run(
    scene: SceneName,
    output: Annotated[
        str | None,
        typer.Option(
            "-o", "--output", metavar="FILE", show_default=False,
            help="NetCDF file to write (default: that of the scene's [output], or SCENE.nc here);"
            " its folder is made if need be",
        ),
    ] = None,
    clones: ClonesOption = None,
    seed: SeedOption = None,
    precision: PrecisionOption = "float64",
    no_figure: NoFigureOption = False,
    force: ForceOption = False,
    no_cache: NoCacheOption = False,
    quiet: QuietOption = False,
    debug: DebugOption = False,
    memory: _ensemble.MemoryOption = None,
    chunk: _ensemble.ChunkOption = None,
    devices: _ensemble.DevicesOption = None,
    part: _ensemble.PartOption = None,
    scheduler: _ensemble.SchedulerOption = None,
) -> int:  # fmt: skip
    """Simulate a scene with its Monte Carlo clones. Writes a NetCDF file and a PNG figure beside
    it, each whole or not at all, and prints a summary table. A scene with an [ensemble] goes into a
    Zarr store instead.
    """
    file = read(scene, clones, seed)
    options = {
        "memory": memory, "chunk": chunk, "devices": devices, "part": part,
        "scheduler": scheduler,
    }  # fmt: skip
    options = {name: value for name, value in options.items() if value is not None}
    if file.ensemble is not None:
        require("run", "rich", "zarr", extra="cli,scale")
        if scheduler is not None:
            require("run", "distributed", extra="cli,scale,dask")
        return _ensemble.run(file, output, precision, options, quiet=quiet, no_cache=no_cache)
    _ensemble.refuse(options, file)
    with_figure = file.output.figure and not no_figure
    require("run", "rich", "xarray", "h5netcdf", "h5py", *(("matplotlib",) if with_figure else ()))
    named = output or file.output.file
    name = named or ("stdin" if scene == "-" else file.path.stem) + ".nc"
    check_suffix(name, ".nc", what="a NetCDF file (the figure .png is written beside it)")
    goal = target(name, ".nc", force=force, confined=output is None and named is not None)
    picture = None
    if with_figure:
        picture = target(goal.with_suffix(".png"), ".png", force=force)
    return _simulate(file, goal, picture, precision, quiet=quiet, no_cache=no_cache)


def _simulate(
    file: Any, goal: Path, picture: Path | None, precision: str, *, quiet: bool, no_cache: bool
) -> int:
    from rich.console import Console

    messages = _show.messages(quiet)
    with _show.working(messages, "starting"):
        from polhode.cli import _cache, _job, _summary
        from polhode.files import write_netcdf

    with _cache.kept_programs(not no_cache):
        with _show.working(messages, "drawing the bodies"):
            job = _job.prepare(file, precision)
        outcome = _with_progress(messages, job)
        with _show.working(messages, "measuring and writing"):
            figures = _summary.measure(job, outcome)
            dataset = _dataset(job, outcome, figures, precision, picture is not None)
            heed()
            written = [write_netcdf(dataset, goal)]
            if picture is not None:
                heed()
                written.append(_draw(job, outcome, picture))
    if not quiet:
        out = Console(soft_wrap=not sys.stdout.isatty())
        out.print(_summary.table(job, outcome, figures))
        _show.tell_written(out, written)
    return _failures(outcome.trajectory.status)


def _with_progress(messages, job):
    from rich.progress import TimeElapsedColumn

    from polhode.cli import _job

    with _show.bar(messages, TimeElapsedColumn()) as progress:
        task = progress.add_task("", total=job.bodies)

        def advance(done: int) -> None:
            progress.update(task, completed=done)
            heed()

        return _job.run(job, advance)


# units of moments, and of what grows with them, where only ratios of moments are known
_RELATIVE = {"energy": "s-2", "momentum_space": "s-1", "work": "s-2"}


def _dataset(job, outcome, figures, precision: str, figure: bool):
    """The trajectory's dataset with the clones numbered, their periods and what was run."""
    from polhode.cli import _summary

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
        words = f"period {name}: {_summary.MEANINGS[name]}"
        dataset[name] = (lead, values, {"units": "s", "long_name": words})
    for name, times in outcome.events.items():
        words = f"times at which the event {name} occurs, NaN where there are no more"
        dimensions = (*lead, f"{name}_crossing")
        values = times if lead else times[0]
        dataset[f"{name}_times"] = (dimensions, values, {"units": "s", "long_name": words})
    dataset["moments"] = (
        (*(lead if job.scene.inertia.batch_shape else ()), "axis"),
        job.scene.inertia.moments,
        {
            "units": "1" if file.inertia.unit == "relative" else "kg m2",
            "long_name": "principal moments of inertia",
        },
    )
    if file.inertia.unit == "relative":
        for name in _RELATIVE.keys() & dataset.data_vars.keys():
            words = dataset[name].attrs["long_name"]
            dataset[name].attrs = {
                "units": _RELATIVE[name], "long_name": f"{words}, per unit of the relative moments",
            }  # fmt: skip
    dataset.attrs.update(provenance(job, precision, figure))
    return dataset


def provenance(job, precision: str, figure: bool) -> dict[str, Any]:
    """What was run, as attributes: the scene as read, options in force, seed, versions, commit."""
    import numpy as np

    import polhode
    from polhode.cli import _main
    from polhode.ensemble._stream import device_names
    from polhode.files._build import blamed
    from polhode.files._provenance import commit, versions

    file = job.file
    carlo = file.monte_carlo
    with blamed(file, ""):
        plan = polhode.explain(job.scene, job.state, job.ts, job.method, rtol=job.rtol)
    runs = next(line for line in str(plan).splitlines() if line.startswith("runs"))
    used: dict[str, Any] = {
        "precision": precision, "method": file.method.kind, "solver": file.method.solver,
        "step": file.method.step, "rtol": file.method.rtol, "figure": figure,
    }  # fmt: skip
    used |= {"clones": carlo.clones, "seed": carlo.seed} if carlo is not None else {"clones": 0}
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    command = visible(" ".join(["polhode", *_main.words()]))
    found: dict[str, Any] = texts(file) | {
        "history": f"{now} {command}",
        "options": json.dumps(used),
        "method": runs.removeprefix("runs").strip(),
        "precision": precision,
        "clones": np.int64(used["clones"]),
        "devices": device_names(_devices()),
        **versions(),
    }
    if commit():
        found["polhode_commit"] = commit()
    if carlo is not None:
        found["seed"] = np.int64(carlo.seed)
    if file.epoch is not None:
        found["epoch"] = file.epoch.isoformat()
    return found


def _devices() -> list[Any]:
    import jax

    return jax.local_devices()[:1]


def texts(file) -> dict[str, str]:
    """What the scene file says, as attributes."""
    return {
        "title": visible(file.title),
        "scene_source": visible(file.source),
        "frame": visible(file.frame),
        "scene": file.text.replace("\0", ""),
    }


def _draw(job, outcome, path: Path) -> Path:
    """Write the overview figure."""
    from polhode import plot
    from polhode.files import build_attitudes

    file, seen = job.file, job.file.observations
    observed = None
    if seen is not None:
        observed = plot.samples(
            seen.seconds, seen.omega_body, build_attitudes(seen.attitudes, "float64")
        )
    names = {"axis_names": file.axis_names, "title": file.title}
    return _show.write_figure(
        path, lambda: plot.overview(outcome.trajectory, observed=observed, **names)
    )


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
