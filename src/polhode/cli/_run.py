"""`polhode run SCENE`: simulate a scene file, write NetCDF and a figure, print a summary.

A scene with an [ensemble] is written to a Zarr store in chunks.
"""

import datetime
import json
import math
import sys
from pathlib import Path
from typing import Annotated, Any

from polhode.cli import _process
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
    UsageError,
    byte_count,
    check_suffix,
    device_count,
    option,
    output_option,
    output_path,
    parse_part,
    read_scene,
    require,
    resumable_store,
    whole_number,
    write_figure,
)
from polhode.cli._process import check_signals, program_cache
from polhode.files import SceneFileError
from polhode.files._read import escape


def _ensemble_option(name: str, metavar: str, words: str, parser: Any = None) -> Any:
    return option(name, metavar, f"for a scene with an [ensemble]: {words}", parser)


MemoryOption = Annotated[
    int | None,
    _ensemble_option("--memory", "SIZE", "limit of memory, such as 2GB", byte_count),
]
ChunkOption = Annotated[
    int | None,
    _ensemble_option(
        "--chunk", "N", "bodies per chunk, instead of the library's choice", whole_number(1)
    ),
]
DevicesOption = Annotated[
    str | None,
    _ensemble_option("--devices", "N|all", "devices to use (default: 1)", device_count),
]
PartOption = Annotated[
    str | None,
    _ensemble_option(
        "--part",
        "I/N",
        "compute part I of N, every N-th chunk; run once without it at the end",
        parse_part,
    ),
]
SchedulerOption = Annotated[
    str | None,
    _ensemble_option(
        "--scheduler",
        "ADDRESS",
        "address of a dask scheduler whose workers compute the chunks",
    ),
]


def run(
    scene: SceneName,
    output: Annotated[
        str | None,
        output_option(
            "FILE",
            "NetCDF file to write (default: that of the scene's [output], or SCENE.nc here); its"
            " folder is made if need be",
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
    memory: MemoryOption = None,
    chunk: ChunkOption = None,
    devices: DevicesOption = None,
    part: PartOption = None,
    scheduler: SchedulerOption = None,
) -> int:
    """Simulate a scene with its Monte Carlo clones. Writes a NetCDF file and a PNG figure beside
    it, each atomically, and prints a summary table. A scene with an [ensemble] is written to a Zarr
    store instead.
    """
    file = read_scene(scene, clones, seed)
    options = dict(memory=memory, chunk=chunk, devices=devices, part=part, scheduler=scheduler)  # noqa: C408
    options = {name: value for name, value in options.items() if value is not None}
    if file.ensemble is not None:
        require("run", "rich", "zarr", extra="cli,scale")
        if scheduler is not None:
            require("run", "distributed", extra="cli,scale,dask")
        return _run_ensemble(file, output, precision, options, quiet=quiet, no_cache=no_cache)
    _refuse(options, file)
    with_figure = file.output.figure and not no_figure
    require("run", "rich", "xarray", "h5netcdf", "h5py", *(("matplotlib",) if with_figure else ()))
    stated = output or file.output.file
    name = stated or ("stdin" if scene == "-" else file.path.stem) + ".nc"
    check_suffix(name, ".nc", what="a NetCDF file (the figure .png is written beside it)")
    path = output_path(name, ".nc", force=force, confined=output is None and stated is not None)
    picture = None
    if with_figure:
        picture = output_path(path.with_suffix(".png"), ".png", force=force)
    return _simulate(file, path, picture, precision, quiet=quiet, no_cache=no_cache)


def _simulate(
    file: Any, path: Path, picture: Path | None, precision: str, *, quiet: bool, no_cache: bool
) -> int:
    from rich.console import Console

    console = _process.progress_console(quiet)
    with _process.spinner(console, "starting"):
        from polhode.cli import _job
        from polhode.files import write_netcdf

    with program_cache(not no_cache):
        with _process.spinner(console, "drawing the bodies"):
            job = _job.prepare(file, precision)
        outcome = _with_progress(console, job)
        with _process.spinner(console, "measuring and writing"):
            figures = _job.measure(job, outcome)
            dataset = _dataset(job, outcome, figures, precision, picture is not None)
            check_signals()
            written = [write_netcdf(dataset, path)]
            if picture is not None:
                check_signals()
                written.append(_draw(job, outcome, picture))
    if not quiet:
        out = Console(soft_wrap=not sys.stdout.isatty())
        out.print(_job.summary_table(job, outcome, figures))
        _process.print_paths(out, written)
    return _failures(outcome.trajectory.status)


def _with_progress(console, job):
    from rich.progress import TimeElapsedColumn

    from polhode.cli import _job

    with _process.progress_bar(console, TimeElapsedColumn()) as progress:
        task = progress.add_task("", total=job.bodies)

        def advance(count: int) -> None:
            progress.update(task, completed=count)
            check_signals()

        return _job.run(job, advance)


# units of quantities proportional to the moments if these are relative
_RELATIVE = {"energy": "s-2", "momentum_space": "s-1", "work": "s-2"}


def _dataset(job, outcome, figures, precision: str, figure: bool):
    """The trajectory's dataset with clone numbers, periods, event times, moments and provenance."""
    from polhode.cli import _job

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
        words = f"period {name}: {_job.MEANINGS[name]}"
        dataset[name] = (lead, values, {"units": "s", "long_name": words})
    for name, times in outcome.events.items():
        words = f"times at which the event {name} occurs, NaN where there are no more"
        dimensions = (*lead, f"{name}_crossing")
        values = times if lead else times[0]
        dataset[f"{name}_times"] = (dimensions, values, {"units": "s", "long_name": words})
    dataset["moments"] = (
        (*(lead if job.inertia.batch_shape else ()), "axis"),
        job.inertia.moments,
        {
            "units": "1" if file.inertia.unit == "relative" else "kg m2",
            "long_name": "principal moments of inertia"
            + (" at the first time" if file.inertia.table is not None else ""),
        },
    )
    if file.inertia.unit == "relative":
        for name in _RELATIVE.keys() & dataset.data_vars.keys():
            words = dataset[name].attrs["long_name"]
            words += ", per unit of the relative moments"
            dataset[name].attrs = {"units": _RELATIVE[name], "long_name": words}
    dataset.attrs.update(_provenance(job, precision, figure))
    return dataset


def _provenance(job, precision: str, figure: bool) -> dict[str, Any]:
    """Attributes that document the run: scene text, effective options, seed, versions, commit."""
    import jax
    import numpy as np

    import polhode
    from polhode.cli import _main
    from polhode.ensemble._stream import device_names
    from polhode.files._read import scene_errors
    from polhode.files._write import commit, versions

    file = job.file
    clones = file.monte_carlo
    with scene_errors(file, ""):
        plan = polhode.explain(job.scene, job.state, job.ts, job.method, rtol=job.rtol)
    method = next(line for line in str(plan).splitlines() if line.startswith("runs"))
    options: dict[str, Any] = {"precision": precision, "method": file.method.kind}
    options |= {name: getattr(file.method, name) for name in ("solver", "step", "rtol")}
    options |= {"figure": figure, "clones": 0 if clones is None else clones.clones}
    if clones is not None:
        options["seed"] = clones.seed
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    command = escape(" ".join(["polhode", *_main.arguments()]))
    attributes: dict[str, Any] = _texts(file) | {
        "history": f"{now} {command}",
        "options": json.dumps(options),
        "method": method.removeprefix("runs").strip(),
        "precision": precision,
        "clones": np.int64(options["clones"]),
        "devices": device_names(jax.local_devices()[:1]),
        **versions(),
    }
    if commit():
        attributes["polhode_commit"] = commit()
    if clones is not None:
        attributes["seed"] = np.int64(clones.seed)
    if file.epoch is not None:
        attributes["epoch"] = file.epoch.isoformat()
    return attributes


def _texts(file) -> dict[str, str]:
    """Attributes from the scene file."""
    return {
        "title": escape(file.title),
        "scene_source": escape(file.source),
        "frame": escape(file.frame),
        "scene": file.text.replace("\0", ""),
    }


def _draw(job, outcome, path: Path) -> Path:
    """Write the overview figure."""
    from polhode import plot
    from polhode.files import build_attitudes

    file, observations = job.file, job.file.observations
    observed = None
    if observations is not None:
        wxyz = build_attitudes(observations.attitudes, "float64")
        observed = plot.samples(observations.seconds, observations.omega_body, wxyz)
    names = {"axis_names": file.axis_names, "title": file.title}
    return write_figure(path, lambda: plot.overview(outcome.trajectory, observed=observed, **names))


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


def _refuse(options: dict[str, Any], file: Any) -> None:
    """Raise SceneFileError for an option that needs an [ensemble], which the scene lacks."""
    for name in options:
        raise SceneFileError(
            file.path,
            "[ensemble]",
            "missing table",
            f"--{name.replace('_', '-')} on the command line",
            "a scene with an [ensemble]",
            "add [ensemble], or drop the option",
        )


def _run_ensemble(
    file: Any,
    output: str | None,
    precision: str,
    options: dict[str, Any],
    *,
    quiet: bool,
    no_cache: bool,
) -> int:
    """Compute the ensemble into its store. Returns 0, or 1 if some bodies did not finish."""
    console = _process.progress_console(quiet)
    path = _store_path(file, output)
    with _process.spinner(console, "starting"):
        import jax

        jax.config.update("jax_enable_x64", True)
        from polhode.ensemble import StoreError, build_ensemble
        from polhode.ensemble._store import missing_chunks
        from polhode.files._read import escape

        ensemble, statistics = build_ensemble(file, precision)
    if "part" in options:
        options["part"] = tuple(map(int, options["part"].split("/")))
    if "devices" in options:
        options["devices"] = _devices(options["devices"])
    try:
        with program_cache(not no_cache), _Meter(console) as meter:
            last = _stream(file, ensemble, statistics, path, precision, meter, options)
    except StoreError:
        raise
    except ValueError as error:  # for example of sizes from options
        raise UsageError(str(error)) from error
    if not quiet:
        rate = "nothing was missing" if last.rate is None else f"{last.rate:,.0f} bodies/s"
        print(f"{last.done:,} bodies ({last.reused:,} from before), {rate}")
        print(f"written: {escape(str(path))}")
    if "part" in options:
        missing = missing_chunks(path) or "no chunk is missing: run once without --part"
        if not quiet:
            print(f"part {options['part'][0]} of {options['part'][1]} is complete; {missing}")
        return 0
    return _ensemble_failures(path)


def _store_path(file: Any, output: str | None) -> Path:
    from polhode.files._read import escape

    text = output or file.output.file or f"{file.path.stem}.zarr"
    path = Path(text)
    if "\0" in text or path.name in ("", ".."):
        raise UsageError(f"the output {escape(text)} names no store: give a name such as big.zarr")
    check_suffix(text, ".zarr", what="a Zarr store")
    if path.suffix != ".zarr":
        path = path.with_name(path.name + ".zarr")
    here = Path.cwd().resolve()
    if output is None and not path.resolve().is_relative_to(here):
        raise UsageError(f"[output] file: {escape(text)} leads out of the folder {here} by a link")
    if path.is_symlink() and output is None:
        raise UsageError(f"[output] file: {escape(text)} is a link: name a store")
    return path


def _stream(file, ensemble, statistics, path, precision, meter, options):
    from polhode.ensemble import stream
    from polhode.files import build_method

    resumable_store(path)
    stream(
        ensemble,
        file.times.seconds,
        path,
        method=build_method(file),
        rtol=file.method.rtol,
        trajectories=file.ensemble.trajectories,
        statistics=statistics,
        attributes=_texts(file) | {"precision": precision},
        progress=meter,
        **options,
    )
    return meter.last


def _devices(count: str) -> list[Any]:
    import jax

    devices = jax.local_devices()
    number = len(devices) if count == "all" else int(count)
    if number > len(devices):
        raise UsageError(f"--devices {count}: this machine has {len(devices)} (use fewer, or all)")
    return devices[:number]


class _Meter:
    """Progress display with rate and remaining time; ``last`` is the last report."""

    def __init__(self, console):
        from rich.progress import TextColumn

        self.last: Any = None
        self.bar = _process.progress_bar(console, TextColumn("{task.fields[remaining]}"))
        self.task = self.bar.add_task("", total=None, remaining="compiling ...")

    def __enter__(self):
        self.bar.start()
        return self

    def __exit__(self, *_):
        self.bar.stop()

    def __call__(self, report: Any) -> None:
        check_signals()
        self.last = report
        remaining = "compiling ..."
        if report.rate is not None:
            seconds = math.ceil(report.remaining)
            remaining = f"{report.rate:,.0f} bodies/s, {seconds // 60}:{seconds % 60:02d} left"
        self.bar.update(self.task, completed=report.done, total=report.total, remaining=remaining)


def _ensemble_failures(path: Path) -> int:
    import numpy as np
    import zarr

    status = zarr.open_array(path / "status", mode="r")
    failed, step = 0, status.chunks[0]
    for start in range(0, status.shape[0], step):
        failed += int((np.asarray(status[start : start + step]) > 0).sum())
    if failed:
        print(f"polhode: {failed:,} bodies did not finish; see `status` in {path}", file=sys.stderr)
    return 1 if failed else 0
