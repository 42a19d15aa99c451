"""`polhode run` of a scene with an [ensemble]: into a Zarr store, chunk by chunk."""

import math
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from polhode.cli import _show
from polhode.cli._options import address, byte_count, device_count, positive, whole_number
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
ProcessOption = Annotated[
    int | None, _option("--process", "number of this process, from 0", whole_number(0), "I")
]
ProcessesOption = Annotated[
    int | None,
    _option("--processes", "number of processes that share the store", whole_number(1), "N"),
]
CoordinatorOption = Annotated[
    str | None,
    _option(
        "--coordinator",
        "where process 0 waits for the others (jax.distributed); needs --processes and --process",
        address,
        "HOST:PORT",
    ),
]
ClusterOption = Annotated[
    bool,
    _option(
        "--cluster",
        "let JAX find coordinator and numbers: SLURM, Open MPI, Kubernetes, or"
        " JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES, JAX_PROCESS_ID",
    ),
]
PatienceOption = Annotated[
    float | None,
    _option("--patience", "seconds to wait for the others (default: 300)", positive, "S"),
]
NoVerifyOption = Annotated[
    bool, _option("--no-verify", "take finished chunks for good without reading them")
]


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
    """Stream the ensemble into its store; 0, or 1 when some bodies did not finish."""
    messages = _show.messages(quiet)
    path = _store_path(file, output)
    with messages.status("starting ..."):
        import jax

        jax.config.update("jax_enable_x64", True)
        from polhode.cli import _cache
        from polhode.ensemble import StoreError, build_ensemble
        from polhode.files._error import visible

        _meet(path, options)
        ensemble, statistics = build_ensemble(file, precision)
    options["verify"] = not options.pop("no_verify", False)
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
    except ValueError as error:  # of sizes and numbers of processes, which options gave
        raise UsageError(str(error)) from error
    if not quiet:
        rate = "nothing was missing" if last.rate is None else f"{last.rate:,.0f} bodies/s"
        print(f"{last.done:,} bodies ({last.reused:,} from before), {rate}")
        print(f"written: {visible(str(path))}")
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
    from polhode.cli._run import provenance
    from polhode.ensemble import stream
    from polhode.files import build_method

    words = provenance(file, precision)
    kept = ("title", "scene", "scene_source", "frame", "precision")
    stream(
        ensemble, file.times.seconds, path,
        method=build_method(file), rtol=file.method.rtol,
        trajectories=file.ensemble.trajectories, statistics=statistics,
        attributes={name: words[name] for name in kept}, progress=meter, warn=_warn, **options,
    )  # fmt: skip
    return meter.last


def _meet(path: Path, options: dict[str, Any]) -> None:
    """Find the number of this process and of all, with the others where they are to meet; before
    anything is computed. The options of that go out of ``options``.
    """
    from polhode.ensemble import join
    from polhode.ensemble._processes import claimed

    cluster, coordinator = options.pop("cluster", False), options.pop("coordinator", None)
    patience = {"patience": options.pop("patience")} if "patience" in options else {}
    known = options.get("processes"), options.get("process")
    processes, process = known
    if processes is not None and process is not None and process >= processes:
        raise UsageError(f"--process must be from 0 to {processes - 1}, got {process}.")
    if coordinator is None and not cluster:
        if known[0] is None and known[1] is not None:
            raise UsageError("--process needs --processes, the number of all of them.")
        if (known[0] or 1) > 1 and known[1] is None:
            raise UsageError("--processes needs --process, the number of this one, from 0.")
        if patience:
            raise UsageError("--patience needs --coordinator or --cluster.")
        return
    if coordinator is not None and not cluster and None in known:
        raise UsageError("--coordinator needs --processes and --process.")
    # two processes of one number on this machine are told apart before they disturb the others
    with claimed(path, *known):
        options["process"], options["processes"] = join(coordinator, *known, **patience)[:2]


def _warn(words: str) -> None:
    print(f"polhode: {words}", file=sys.stderr)


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
