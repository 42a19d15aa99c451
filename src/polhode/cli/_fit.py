"""`polhode fit RECORDING`: inertia from a CSV of times and rates, with a table and a figure."""

import functools
import math
import sys
import types
from pathlib import Path
from typing import Annotated, Any

import typer

from polhode.cli import _show
from polhode.cli._inputs import refused
from polhode.cli._options import (
    DebugOption,
    ForceOption,
    NoCacheOption,
    NoFigureOption,
    QuietOption,
    positive,
    require,
)
from polhode.cli._signals import heed
from polhode.cli._targets import UsageError, stem, target

_ROLES = ("t", "wx", "wy", "wz", "wheel")
_EXPECTED = "a recording: CSV with a header line"
_Asked = types.SimpleNamespace  # the options of `fit` as they were given


def fit(
    recording: Annotated[
        list[str],
        typer.Argument(metavar="RECORDING", show_default=False, help="CSV with a header line"),
    ],
    columns: Annotated[
        list[str],
        typer.Option(
            metavar="NAME=COLUMN ...", show_default=False,
            help="columns of t [s], wx, wy, wz and, if there is a wheel, wheel [rad/s]; those left"
            " out are found by their usual names (t, time_s, wx, gyro_x, omega_x, ...)",
        ),
    ] = [],  # noqa: B006 - typer reads it
    output: Annotated[
        str | None,
        typer.Option(
            "-o", "--output", metavar="RESULT", show_default=False,
            help="write RESULT.json and RESULT.png (default: the name of the recording, here)",
        ),
    ] = None,
    degrees: Annotated[bool, typer.Option("--degrees", help="rates are in deg/s")] = False,
    milliseconds: Annotated[bool, typer.Option("--milliseconds", help="times are in ms")] = False,
    noise: Annotated[
        float | None,
        typer.Option(
            parser=positive, metavar="SIGMA",
            help="standard deviation of the rates, rad/s (default: from the residuals)",
        ),
    ] = None,
    moments_only: Annotated[
        bool, typer.Option("--moments-only", help="the sensor axes are principal axes")
    ] = False,
    calibration: Annotated[
        float,
        typer.Option(
            min=0.0, metavar="PART",
            help="standard deviation of the gyroscope's scale factors and of its misalignment"
            " [rad]; 0: exact",
        ),
    ] = 0.01,
    max_rate: Annotated[
        float | None,
        typer.Option(
            parser=positive, metavar="RATE",
            help="rate at which the gyroscope saturates, rad/s (default: found in the readings)",
        ),
    ] = None,
    bias: Annotated[bool, typer.Option("--bias", help="fit a constant gyroscope bias")] = False,
    drag: Annotated[bool, typer.Option("--drag", help="fit a drag of the air")] = False,
    robust: Annotated[
        float | None,
        typer.Option(
            parser=positive, metavar="K",
            help="count residuals beyond K noises linearly (needs --noise)",
        ),
    ] = None,
    wheel_inertia: Annotated[
        float | None,
        typer.Option(
            parser=positive, metavar="J",
            help="spin inertia of the wheel, kg m^2: fixes the absolute scale",
        ),
    ] = None,
    wheel_axis: Annotated[
        tuple[float, float, float],
        typer.Option(metavar="X Y Z", help="axis of the wheel"),
    ] = (0.0, 0.0, 1.0),
    allow_undetermined: Annotated[
        bool,
        typer.Option(
            "--allow-undetermined",
            help="exit with 0 although the recording does not show all ratios of moments",
        ),
    ] = False,
    no_figure: NoFigureOption = False,
    force: ForceOption = False,
    no_cache: NoCacheOption = False,
    quiet: QuietOption = False,
    debug: DebugOption = False,
) -> int:  # fmt: skip
    """Fit the inertia of a tumbling body to a CSV file of times and gyroscope rates. Writes the
    numbers (JSON) and a figure (PNG) and prints a summary. Exit code 1 when the fit must not be
    used, or when the recording does not show all ratios of the moments.
    """
    path, named = _columns(recording, columns)
    with refused(path, ".csv", _EXPECTED):
        pass
    asked = _Asked(
        path=path, columns=named, degrees=degrees, milliseconds=milliseconds, noise=noise,
        moments_only=moments_only, calibration=calibration, max_rate=max_rate,
        bias=bias, drag=drag, robust=robust,
        wheel_inertia=wheel_inertia, wheel_axis=wheel_axis,
    )  # fmt: skip
    if wheel_inertia and "wheel" not in named:
        raise UsageError("--wheel-inertia needs the wheel's speed: add wheel=COLUMN to --columns.")
    if robust and not noise:
        raise UsageError("--robust counts in noises: give --noise SIGMA too.")
    if not math.hypot(*wheel_axis) > 0 or not math.isfinite(math.hypot(*wheel_axis)):
        raise UsageError(f"--wheel-axis must have a direction, got {wheel_axis}.")
    output = output and stem(output, ".json", ".png", what="the numbers and the figure")
    require("fit", "rich", *(() if no_figure else ("matplotlib",)))
    goals = [_goal(asked, output, ".json", force)]
    if not no_figure:
        goals.append(_goal(asked, output, ".png", force))
    return _fit(asked, goals, quiet=quiet, no_cache=no_cache, allowed=allow_undetermined)


def _columns(words: list[str], given: list[str]) -> tuple[Path, dict[str, str]]:
    """The recording and what --columns says, whose later items stand among the arguments."""
    items = [word for word in words if word.partition("=")[0] in _ROLES and "=" in word]
    files = [word for word in words if word not in items]
    wrong = [x for x in given if x.partition("=")[0] not in _ROLES or not x.partition("=")[2]]
    wrong += [word for word in files[1:] if "=" in word or given]
    if wrong:
        raise UsageError(
            f"--columns takes NAME=COLUMN with NAME one of {', '.join(_ROLES)}, got {wrong[0]!r}."
        )
    if len(files) != 1:
        raise UsageError(f"expected one RECORDING, got {', '.join(files) or 'none'}.")
    if "\0" in files[0]:
        raise UsageError("the name of the recording holds a NUL character.")
    pairs = (item.partition("=") for item in (*given, *items))
    return Path(files[0]), {name: column for name, _, column in pairs}


def _goal(asked: _Asked, output: str | None, suffix: str, force: bool) -> Path:
    name = output or asked.path.stem
    return target(name + ("" if not Path(name).name.strip(".") else suffix), suffix, force=force)


def _fit(asked: _Asked, goals: list[Path], *, quiet: bool, no_cache: bool, allowed: bool) -> int:
    from rich.console import Console

    with _show.working(_show.messages(quiet), "reading") as show:
        import jax

        jax.config.update("jax_enable_x64", True)
        from polhode import fit as room, plot
        from polhode.cli import _cache

        loaded = _read(asked)
        recording = loaded.recording
        with _cache.kept_programs(not no_cache):
            show(f"fitting {recording.times.shape[-1]} samples (compiling first)")
            try:
                result = room.fit_recordings([recording], throw=False, **_keywords(asked, room))
            except ValueError as error:  # the recording does not suit the options
                raise UsageError(f"{asked.path}: {error}") from error
            heed()
            show("writing")
            written = [_write(goals[0], asked, loaded, result)]
            for picture in goals[1:]:
                heed()
                figure = functools.partial(plot.fit, result, recording, title=asked.path.name)
                written.append(_show.write_figure(picture, figure))
    undetermined = _undetermined(result)
    if not quiet:
        here = sys.stdout.isatty()
        out = Console(soft_wrap=not here, width=None if here else 110)
        out.print(_table(asked, recording, result))
        out.print(_observability(result))
        for text in (_said(loaded), *result.warnings()):
            out.print(f"- {text}", highlight=False, markup=False)
        _show.tell_written(out, written)
    if not result.is_usable:
        print(f"polhode: the fit must not be used: {', '.join(result.findings())}",
              file=sys.stderr)  # fmt: skip
        return 1
    if undetermined and not allowed:
        print(
            "polhode: the recording does not show all ratios of the moments (too little motion, or"
            " about one axis only); --allow-undetermined takes what it shows",
            file=sys.stderr,
        )
        return 1
    return 0


def _read(asked: _Asked) -> Any:
    from polhode.fit._recording import load_recording

    try:
        with refused(asked.path, ".csv", _EXPECTED):
            return load_recording(
                asked.path,
                asked.columns,
                scale=math.pi / 180 if asked.degrees else None,
                time_scale=1e-3 if asked.milliseconds else None,
                noise=asked.noise or 1.0,
            )
    except UsageError as error:
        hint = ""
        if "deg/s" in str(error) and not (asked.degrees and asked.milliseconds):
            hint = " See --degrees and --milliseconds."
        elif "must have the columns" in str(error):
            missing = [role for role in _ROLES if f"{role} -> " in str(error)]
            hint = " Name them: --columns " + " ".join(f"{role}=COLUMN" for role in missing)
        first, end, rest = str(error).partition("\n")
        raise UsageError(f"{first}{hint}{end}{rest}") from error


def _said(loaded: Any) -> str:
    """Which columns were read, in which units."""
    from polhode.files._error import visible

    names = ", ".join(f"{role} = {visible(name)}" for role, name in loaded.columns.items())
    units = ", ".join(f"{role} in {unit}" for role, unit in loaded.units.items())
    return f"columns: {names}" + (f"; by their names {units}" if units else "")


def _keywords(asked: _Asked, room: Any) -> dict[str, Any]:
    """Keywords of ``fit_recordings``."""
    motion = room.FreeMotion()
    if asked.drag or asked.wheel_inertia:
        drag = room.Drag() if asked.drag else None
        axis = tuple(x / math.hypot(*asked.wheel_axis) for x in asked.wheel_axis)
        motion = room.SteppedMotion(asked.wheel_inertia, axis, drag=drag, fit_drag=asked.drag)
    options = room.FitOptions(
        motion=motion,
        unknown=room.MomentsOnly() if asked.moments_only else room.FullTensor(),
        gyroscope=room.Gyroscope(
            scale_std=asked.calibration,
            misalignment_std=asked.calibration,
            max_rate=asked.max_rate,
        ),
        bias=asked.bias,
        robust=room.Huber(asked.robust) if asked.robust else None,
        trust_noise=asked.noise is not None,
    )
    return {"options": options}


def _undetermined(result: Any) -> bool:
    """Whether a ratio of the moments is not shown at all, or to no better than its own size."""
    import numpy as np

    spread = np.asarray(result.ratios_std)[..., :2]
    ratios = np.asarray(result.ratios)[..., :2]
    return bool(np.any(~np.isfinite(spread) | (2 * spread > ratios)))


def _bias(result: Any) -> tuple[Any, Any] | None:
    """The gyroscope's bias, rad/s, and its standard deviation (3,); None where none was fitted."""
    import numpy as np

    if "bias" not in result.sensor:
        return None
    return np.asarray(result.sensor["bias"]), np.asarray(result.sensor_std["bias"])


def _write(path: Path, asked: _Asked, loaded: Any, result: Any) -> Path:
    import json

    import jax
    import jaxlib
    import numpy as np

    import polhode
    from polhode.files._atomic import whole_file
    from polhode.fit._result import mirror_moments
    from polhode.rotation import wxyz_to_matrix

    def plain(value: Any) -> Any:
        value = np.asarray(value)
        return np.asarray(np.where(np.isfinite(value), value, None)).tolist()

    recording = loaded.recording
    low, high = result.interval(0.95)
    found = _bias(result)
    options = {name: value for name, value in vars(asked).items()
               if name not in ("path", "columns")}  # fmt: skip
    document = {
        "recording": str(asked.path),
        "columns": loaded.columns,
        "units": loaded.units,
        "options": options,
        "polhode": polhode.__version__,
        "jax": jax.__version__,
        "jaxlib": jaxlib.__version__,
        "samples": int(np.sum(np.asarray(recording.present))),
        "gaps": int(np.sum(np.asarray(recording.present) == 0)),
        "scale_known": result.scale_known,
        "moments": plain(result.moments),
        "moments_std": plain(result.moments_std),
        "ratios": plain(result.ratios),
        "ratios_std": plain(result.ratios_std),
        "interval_95": [plain(low), plain(high)],
        "tensor": plain(result.inertia.tensor),
        "principal_axes_as_columns": plain(wxyz_to_matrix(result.axes)),
        "axes_std_rad": [0.0] * 3 if asked.moments_only else plain(result.axes_std),
        "bias_rad_per_s": None if found is None else plain(found[0]),
        "bias_std_rad_per_s": None if found is None else plain(found[1]),
        "gyroscope_gain": plain(result.sensor["gain"]) if "gain" in result.sensor else None,
        "gyroscope_gain_std": (
            plain(result.sensor_std["gain"]) if "gain" in result.sensor else None
        ),
        "observability": [row._asdict() for row in result.observability()],
        "mirrored_ratios": plain(np.sort(mirror_moments(np.asarray(result.moments)))),
        "rms_rad_per_s": plain(result.rms),
        "residual_over_noise": plain(result.noise),
        "whiteness": plain(result.whiteness),
        "steps": int(result.steps),
        "undetermined": _undetermined(result),
        "findings": result.findings(),
    }
    text = json.dumps(document, indent=1, allow_nan=False)
    with whole_file(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")
    return path


def _observability(result: Any) -> Any:
    """What this recording can show, as a rich Table."""
    from rich.table import Table
    from rich.text import Text

    grid = Table(
        title=Text("what this recording can show"),
        title_justify="left",
        show_edge=False,
        pad_edge=False,
    )
    for name in ("", "estimated from", "would be shown by"):
        grid.add_column(Text(name))
    for row in result.observability():
        grid.add_row(row.quantity, row.source, row.remedy)
    return grid


def _table(asked: _Asked, recording: Any, result: Any) -> Any:
    """The summary as a rich Table."""
    import numpy as np
    from rich.table import Table
    from rich.text import Text

    from polhode.files._error import visible
    from polhode.rotation import wxyz_to_matrix

    samples = int(np.sum(np.asarray(recording.present)))
    grid = Table(
        title=Text(f"{visible(asked.path.name)}: {samples} samples"),
        title_justify="left",
        show_edge=False,
        pad_edge=False,
    )
    known = result.scale_known
    for name in ("", "moment [kg m^2]" if known else "ratio", "95 %", "axis in sensor axes", "+-"):
        grid.add_column(Text(name), justify="left" if name == "" else "right")
    values = np.asarray(result.principal_values[0])
    low, high = (np.asarray(end) for end in result.interval(0.95))
    axes = np.asarray(wxyz_to_matrix(result.axes))
    turn = np.degrees(np.asarray(result.axes_std))
    for k, name in enumerate(("smallest", "middle", "largest")):
        reach = "" if k == 2 and not known else f"{low[k]:.5g} to {high[k]:.5g}"
        shown = f"{turn[k]:.2g} deg" if turn[k] < 90 else "not determined"
        grid.add_row(
            name,
            f"{values[k]:.6g}",
            reach if high[k] - values[k] <= values[k] else "not determined",
            # without negative zeros
            "({:.3f}, {:.3f}, {:.3f})".format(*(np.round(axes[:, k], 3) + 0.0)),
            "given" if asked.moments_only else shown,
        )
    lines = [f"residual rms {float(result.rms):.3g} rad/s"]
    if asked.noise:
        lines[0] += f", {float(result.noise):.3g} of the noise"
    if (found := _bias(result)) is not None:
        parts = (f"{b:.3g} +- {s:.2g}" for b, s in zip(*found, strict=True))
        lines.append(f"bias of the gyroscope, rad/s: {', '.join(parts)}")
    grid.caption = Text("\n".join(lines))
    grid.caption_justify = "left"
    return grid
