"""`polhode run` of a scene with an [ensemble]: into a Zarr store, chunk by chunk."""

import math
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from polhode.cli import _show
from polhode.cli._options import byte_count, device_count, part, whole_number
from polhode.cli._signals import heed
from polhode.cli._targets import UsageError, check_suffix

_PANEL = "for a scene with an [ensemble]: "


def _option(name: str, words: str, parser: Any = None, metavar: str | None = None) -> Any:
    return typer.Option(name, parser=parser, metavar=metavar, help=_PANEL + words)


MemoryOption = Annotated[
    int | None, _option("--memory", "memory to stay within, such as 2GB", byte_count, "SIZE")
]
ChunkOption = Annotated[
    int | None,
    _option("--chunk", "bodies per chunk, instead of the library's choice", whole_number(1), "N"),
]
DevicesOption = Annotated[
    str | None, _option("--devices", "devices to use (default: 1)", device_count, "N|all")
]
PartOption = Annotated[
    str | None,
    _option(
        "--part", "compute part I of N, every N-th chunk; run once without it at the end",
        part, "I/N",
    ),
]  # fmt: skip
SchedulerOption = Annotated[
    str | None,
    _option(
        "--scheduler", "address of a dask scheduler whose workers compute the chunks",
        metavar="ADDRESS",
    ),
]  # fmt: skip


def refuse(options: dict[str, Any], file: Any) -> None:
    """SceneFileError for an option that needs an [ensemble] which the scene does not have."""
    from polhode.files import SceneFileError

    for name in options:
        raise SceneFileError(
            file.path, "[ensemble]", "missing table",
            f"--{name.replace('_', '-')} on the command line",
            "a scene with an [ensemble]", "add [ensemble], or drop the option",
        )  # fmt: skip


def run(
    file: Any, output: str | None, precision: str, options: dict[str, Any], *, quiet: bool,
    no_cache: bool,
) -> int:  # fmt: skip
    """Compute the ensemble into its store; 0, or 1 when some bodies did not finish."""
    messages = _show.messages(quiet)
    path = _store_path(file, output)
    with _show.working(messages, "starting"):
        import jax

        jax.config.update("jax_enable_x64", True)
        from polhode.cli import _cache
        from polhode.ensemble import StoreError, build_ensemble
        from polhode.ensemble._store import missing_chunks
        from polhode.files._error import visible

        ensemble, statistics = build_ensemble(file, precision)
    if "part" in options:
        options["part"] = tuple(map(int, options["part"].split("/")))
    if "devices" in options:
        options["devices"] = _devices(options["devices"])
    try:
        with _cache.kept_programs(not no_cache), _Meter(messages) as meter:
            last = _stream(file, ensemble, statistics, path, precision, meter, options)
    except KeyboardInterrupt:
        print("\npolhode: interrupted; the same command finishes what is missing", file=sys.stderr)
        return 130
    except StoreError:
        raise
    except ValueError as error:  # of sizes, which options gave
        raise UsageError(str(error)) from error
    if not quiet:
        rate = "nothing was missing" if last.rate is None else f"{last.rate:,.0f} bodies/s"
        print(f"{last.done:,} bodies ({last.reused:,} from before), {rate}")
        print(f"written: {visible(str(path))}")
    if "part" in options:
        missing = missing_chunks(path) or "no chunk is missing: run once without --part"
        if not quiet:
            print(f"part {options['part'][0]} of {options['part'][1]} is complete; {missing}")
        return 0
    return _failures(path)


def _store_path(file: Any, output: str | None) -> Path:
    from polhode.files._error import visible

    text = output or file.output.file or f"{file.path.stem}.zarr"
    path = Path(text)
    if "\0" in text or path.name in ("", ".."):
        raise UsageError(f"the output {visible(text)} names no store: give a name such as big.zarr")
    check_suffix(text, ".zarr", what="a Zarr store")
    if path.suffix != ".zarr":
        path = path.with_name(path.name + ".zarr")
    here = Path.cwd().resolve()
    if output is None and not path.resolve().is_relative_to(here):
        raise UsageError(f"[output] file: {visible(text)} leads out of the folder {here} by a link")
    if path.is_symlink() and output is None:
        raise UsageError(f"[output] file: {visible(text)} is a link: name a store")
    return path


def _stream(file, ensemble, statistics, path, precision, meter, options):
    from polhode.cli._run import texts
    from polhode.ensemble import stream
    from polhode.files import build_method

    stream(
        ensemble, file.times.seconds, path,
        method=build_method(file), rtol=file.method.rtol,
        trajectories=file.ensemble.trajectories, statistics=statistics,
        attributes=texts(file) | {"precision": precision}, progress=meter, **options,
    )  # fmt: skip
    return meter.last


def _devices(count: str) -> list[Any]:
    import jax

    found = jax.local_devices()
    wanted = len(found) if count == "all" else int(count)
    if wanted > len(found):
        raise UsageError(f"--devices {count}: this machine has {len(found)} (use fewer, or all)")
    return found[:wanted]


class _Meter:
    """Progress with rate and remaining time, for people who watch; remembers the last report."""

    def __init__(self, messages):
        from rich.progress import TextColumn

        self.last: Any = None
        self.bar = _show.bar(messages, TextColumn("{task.fields[rest]}"))
        self.task = self.bar.add_task("", total=None, rest="compiling ...")

    def __enter__(self):
        self.bar.start()
        return self

    def __exit__(self, *_):
        self.bar.stop()

    def __call__(self, report: Any) -> None:
        heed()
        self.last = report
        rest = "compiling ..."
        if report.rate is not None:
            seconds = math.ceil(report.remaining)
            rest = f"{report.rate:,.0f} bodies/s, {seconds // 60}:{seconds % 60:02d} left"
        self.bar.update(self.task, completed=report.done, total=report.total, rest=rest)


def _failures(path: Path) -> int:
    import numpy as np
    import zarr

    status = zarr.open_array(path / "status", mode="r")
    failed, step = 0, status.chunks[0]
    for start in range(0, status.shape[0], step):
        failed += int((np.asarray(status[start : start + step]) > 0).sum())
    if failed:
        print(f"polhode: {failed:,} bodies did not finish; see `status` in {path}", file=sys.stderr)
    return 1 if failed else 0
