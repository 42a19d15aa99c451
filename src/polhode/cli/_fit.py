"""`polhode fit RECORDING`: inertia from a CSV of times and rates, with a table and a figure."""

import functools
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

from polhode.cli import _process
from polhode.cli._options import (
    DebugOption,
    ForceOption,
    NoCacheOption,
    NoFigureOption,
    QuietOption,
    UsageError,
    not_negative,
    option,
    output_option,
    output_path,
    output_stem,
    positive,
    require,
    usage_errors,
    write_figure,
)
from polhode.cli._process import check_signals, program_cache

_ROLES = ("t", "wx", "wy", "wz", "wheel")
_EXPECTED = "a recording: CSV with a header line"


class _Options(NamedTuple):
    """Options of the fit from the command line, which are stored with the result."""

    degrees: bool
    milliseconds: bool
    noise: float | None
    moments_only: bool
    calibration: float
    max_rate: float | None
    bias: bool
    drag: bool
    robust: float | None
    wheel_inertia: float | None
    wheel_axis: tuple[float, float, float]


def _flag(name: str, words: str) -> Any:
    return typer.Option(name, help=words)


def fit(
    recording: Annotated[
        list[str],
        typer.Argument(metavar="RECORDING", show_default=False, help="CSV with a header line"),
    ],
    columns: Annotated[
        list[str],
        option(
            "--columns",
            "NAME=COLUMN ...",
            "columns of t [s], wx, wy, wz and, if there is a wheel, wheel [rad/s, or the unit of"
            " its name]; those left out are found by their usual names (t, time_s, wx, gyro_x,"
            " omega_x, ...)",
            show_default=False,
        ),
    ] = [],  # noqa: B006 - typer reads it
    output: Annotated[
        str | None,
        output_option(
            "RESULT", "write RESULT.json and RESULT.png (default: the name of the recording, here)"
        ),
    ] = None,
    degrees: Annotated[bool, _flag("--degrees", "rates are in deg/s")] = False,
    milliseconds: Annotated[bool, _flag("--milliseconds", "times are in ms")] = False,
    noise: Annotated[
        float | None,
        option(
            "--noise",
            "SIGMA",
            "standard deviation of the rates, rad/s (default: from the residuals)",
            positive,
        ),
    ] = None,
    moments_only: Annotated[
        bool, _flag("--moments-only", "the sensor axes are principal axes")
    ] = False,
    calibration: Annotated[
        float,
        option(
            "--calibration",
            "PART",
            "standard deviation of the gyroscope's scale factors and of its misalignment [rad]; 0:"
            " exact",
            not_negative,
        ),
    ] = 0.01,
    max_rate: Annotated[
        float | None,
        option(
            "--max-rate",
            "RATE",
            "rate at which the gyroscope saturates, rad/s (default: found in the readings)",
            positive,
        ),
    ] = None,
    bias: Annotated[bool, _flag("--bias", "fit a constant gyroscope bias")] = False,
    drag: Annotated[bool, _flag("--drag", "fit aerodynamic drag")] = False,
    robust: Annotated[
        float | None,
        option(
            "--robust",
            "K",
            "count residuals beyond K sigma of the noise linearly (needs --noise)",
            positive,
        ),
    ] = None,
    wheel_inertia: Annotated[
        float | None,
        option(
            "--wheel-inertia",
            "J",
            "spin inertia of the wheel, kg m^2: fixes the absolute scale",
            positive,
        ),
    ] = None,
    wheel_axis: Annotated[
        tuple[float, float, float], option("--wheel-axis", "X Y Z", "axis of the wheel")
    ] = (0.0, 0.0, 1.0),
    allow_undetermined: Annotated[
        bool,
        _flag(
            "--allow-undetermined",
            "exit with 0 although the recording does not show all ratios of moments",
        ),
    ] = False,
    no_figure: NoFigureOption = False,
    force: ForceOption = False,
    no_cache: NoCacheOption = False,
    quiet: QuietOption = False,
    debug: DebugOption = False,
) -> int:
    """Fit the inertia of a tumbling body to a CSV file of times and gyroscope rates. Writes the
    numbers (JSON) and a figure (PNG) and prints a summary. Exit code 1 if the fit is unusable or
    the recording does not determine all ratios of the moments.
    """
    path, names = _columns(recording, columns)
    with usage_errors(path, ".csv", _EXPECTED):
        pass
    options = _Options(
        degrees,
        milliseconds,
        noise,
        moments_only,
        calibration,
        max_rate,
        bias,
        drag,
        robust,
        wheel_inertia,
        wheel_axis,
    )
    if "wheel" in names and not wheel_inertia:
        raise UsageError("wheel=COLUMN needs --wheel-inertia, which makes its speed a momentum.")
    if wheel_inertia and "wheel" not in names:
        raise UsageError("--wheel-inertia needs the wheel's speed: add wheel=COLUMN to --columns.")
    if robust and not noise:
        raise UsageError("--robust counts in noises: give --noise SIGMA too.")
    if not math.hypot(*wheel_axis) > 0 or not math.isfinite(math.hypot(*wheel_axis)):
        raise UsageError(f"--wheel-axis must have a direction, got {wheel_axis}.")
    output = output and output_stem(output, ".json", ".png", what="the numbers and the figure")
    require("fit", "rich", *(() if no_figure else ("matplotlib",)))
    document = _output(path, output, ".json", force)
    picture = None if no_figure else _output(path, output, ".png", force)
    console = _process.progress_console(quiet)
    with _process.spinner(console, "reading") as show, program_cache(not no_cache):
        loaded, result = _fit(path, names, options, show)
        show("writing")
        written = [_write(document, path, options, loaded, result)]
        if picture is not None:
            check_signals()
            from polhode import plot

            figure = functools.partial(plot.fit, result, loaded.recording, title=path.name)
            written.append(write_figure(picture, figure))
    if not quiet:
        _print(path, options, loaded, result, written)
    return _exit_code(result, allow_undetermined)


def _columns(words: list[str], options: list[str]) -> tuple[Path, dict[str, str]]:
    """The path of the recording and the columns by role.

    ``--columns`` takes one value; further NAME=COLUMN items are among the arguments ``words``.
    """
    items = [word for word in words if word.partition("=")[0] in _ROLES and "=" in word]
    files = [word for word in words if word not in items]
    invalid = [x for x in options if x.partition("=")[0] not in _ROLES or not x.partition("=")[2]]
    invalid += [word for word in files[1:] if "=" in word or options]
    if invalid:
        raise UsageError(
            f"--columns takes NAME=COLUMN with NAME one of {', '.join(_ROLES)}, got {invalid[0]!r}."
        )
    if len(files) != 1:
        raise UsageError(f"expected one RECORDING, got {', '.join(files) or 'none'}.")
    if "\0" in files[0]:
        raise UsageError("the name of the recording holds a NUL character.")
    pairs = (item.partition("=") for item in (*options, *items))
    return Path(files[0]), {name: column for name, _, column in pairs}


def _output(recording: Path, output: str | None, suffix: str, force: bool) -> Path:
    name = output or recording.stem
    name += suffix if Path(name).name.strip(".") else ""
    return output_path(name, suffix, force=force)


def _fit(
    path: Path, names: dict[str, str], options: _Options, show: Callable[[str], None]
) -> tuple[Any, Any]:
    """The loaded recording and the result of the fit."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from polhode import fit as fits

    loaded = _read(path, names, options)
    show(f"fitting {loaded.recording.times.shape[-1]} samples (compiling first)")
    fit_options = _fit_options(options)
    try:
        result = fits.fit_recordings([loaded.recording], throw=False, options=fit_options)
    except ValueError as error:  # options that do not apply to the recording
        raise UsageError(f"{path}: {error}") from error
    check_signals()
    return loaded, result


def _exit_code(result: Any, allow_undetermined: bool) -> int:
    """0 if the result is usable; otherwise 1, with a message on stderr."""
    if not result.is_usable:
        findings = ", ".join(result.findings())
        print(f"polhode: the fit must not be used: {findings}", file=sys.stderr)
        return 1
    if _undetermined(result) and not allow_undetermined:
        print(
            "polhode: the recording does not show all ratios of the moments (too little motion, or"
            " about one axis only); --allow-undetermined takes what it shows",
            file=sys.stderr,
        )
        return 1
    return 0


def _read(path: Path, names: dict[str, str], options: _Options) -> Any:
    from polhode.fit._csv import MissingColumnsError, load_recording
    from polhode.fit._recording import RateUnitError

    try:
        with usage_errors(path, ".csv", _EXPECTED):
            return load_recording(
                path,
                names,
                scale=math.pi / 180 if options.degrees else None,
                time_scale=1e-3 if options.milliseconds else None,
                noise=options.noise or 1.0,
            )
    except UsageError as error:
        hint, cause = "", error.__cause__
        if isinstance(cause, RateUnitError) and not (options.degrees and options.milliseconds):
            hint = " See --degrees and --milliseconds."
        elif isinstance(cause, MissingColumnsError):
            hint = " Name them: --columns " + " ".join(f"{role}=COLUMN" for role in cause.roles)
        first, end, lines = str(error).partition("\n")
        raise UsageError(f"{first}{hint}{end}{lines}") from error


def _columns_read(loaded: Any) -> str:
    """A line with the columns that were read and their units."""
    from polhode.files._read import escape

    names = ", ".join(f"{role} = {escape(name)}" for role, name in loaded.columns.items())
    units = ", ".join(f"{role} in {unit}" for role, unit in loaded.units.items())
    return f"columns: {names}" + (f"; by their names {units}" if units else "")


def _fit_options(options: _Options) -> Any:
    """The options as ``FitOptions``."""
    from polhode import fit as fits

    motion = fits.FreeMotion()
    if options.drag or options.wheel_inertia:
        drag = fits.Drag() if options.drag else None
        length = math.hypot(*options.wheel_axis)
        axis = tuple(x / length for x in options.wheel_axis)
        motion = fits.SteppedMotion(options.wheel_inertia, axis, drag=drag, fit_drag=options.drag)
    gyroscope = fits.Gyroscope(
        scale_std=options.calibration,
        misalignment_std=options.calibration,
        max_rate=options.max_rate,
    )
    return fits.FitOptions(
        motion=motion,
        unknown=fits.MomentsOnly() if options.moments_only else fits.FullTensor(),
        gyroscope=gyroscope,
        bias=options.bias,
        robust=fits.Huber(options.robust) if options.robust else None,
        trust_noise=options.noise is not None,
    )


def _undetermined(result: Any) -> bool:
    """Whether the standard deviation of a ratio is infinite, or more than half of the ratio."""
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


def _drag(result: Any) -> dict[str, tuple[float, float]] | None:
    """Drag coefficients and their standard deviations by name, divided by the largest moment if the
    size of the inertia is not known; None if no drag was fitted."""
    import jax.numpy as jnp

    places = [k for k, name in enumerate(result.value_names) if name.startswith("drag.")]
    if not places:
        return None

    def coefficients(values):
        size = 1.0 if result.scale_known else jnp.linalg.eigvalsh(values[0])[-1]
        return jnp.stack([values[k] for k in places]) / size

    pairs = zip(*(x.tolist() for x in result.derived(coefficients)), strict=True)
    names = (result.value_names[k].removeprefix("drag.") for k in places)
    return dict(zip(names, pairs, strict=True))


def _write(path: Path, recording_path: Path, options: _Options, loaded: Any, result: Any) -> Path:
    import json

    import jax
    import jaxlib
    import numpy as np

    import polhode
    from polhode._atomic import atomic_write
    from polhode.fit._result import mirror_moments
    from polhode.rotation import wxyz_to_matrix

    def plain(value: Any) -> Any:
        value = np.asarray(value)
        return np.asarray(np.where(np.isfinite(value), value, None)).tolist()

    recording = loaded.recording
    low, high = result.interval(0.95)
    bias, drag = _bias(result), _drag(result)
    document = {
        "recording": str(recording_path),
        "columns": loaded.columns,
        "units": loaded.units,
        "options": options._asdict(),
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
        "axes_std_rad": [0.0] * 3 if options.moments_only else plain(result.axes_std),
        "bias_rad_per_s": None if bias is None else plain(bias[0]),
        "bias_std_rad_per_s": None if bias is None else plain(bias[1]),
        "drag": drag and {name: plain(value) for name, (value, _) in drag.items()},
        "drag_std": drag and {name: plain(std) for name, (_, std) in drag.items()},
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
        "limit": result.limit(),
    }
    text = json.dumps(document, indent=1, allow_nan=False)
    with atomic_write(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")
    return path


def _print(path: Path, options: _Options, loaded: Any, result: Any, written: list[Path]) -> None:
    from rich.console import Console

    is_terminal = sys.stdout.isatty()
    out = Console(soft_wrap=not is_terminal, width=None if is_terminal else 110)
    out.print(_table(path, options, loaded.recording, result))
    out.print(_observability(result))
    for text in (_columns_read(loaded), f"limited by {result.limit()}", *result.warnings()):
        out.print(f"- {text}", highlight=False, markup=False)
    _process.print_paths(out, written)


def _observability(result: Any) -> Any:
    """``Fit.observability`` as a rich Table."""
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


def _table(path: Path, options: _Options, recording: Any, result: Any) -> Any:
    """The summary as a rich Table."""
    import numpy as np
    from rich.table import Table
    from rich.text import Text

    from polhode.files._read import escape
    from polhode.rotation import wxyz_to_matrix

    samples = int(np.sum(np.asarray(recording.present)))
    grid = Table(
        title=Text(f"{escape(path.name)}: {samples} samples"),
        title_justify="left",
        show_edge=False,
        pad_edge=False,
    )
    is_absolute = result.scale_known
    for name in (
        "",
        "moment [kg m^2]" if is_absolute else "ratio",
        "95 %",
        "axis in sensor axes",
        "+-",
    ):
        grid.add_column(Text(name), justify="left" if name == "" else "right")
    values = np.asarray(result.principal_values[0])
    low, high = (np.asarray(end) for end in result.interval(0.95))
    axes = np.asarray(wxyz_to_matrix(result.axes))
    spread = np.degrees(np.asarray(result.axes_std))
    for k, name in enumerate(("smallest", "middle", "largest")):
        interval = "" if k == 2 and not is_absolute else f"{low[k]:.5g} to {high[k]:.5g}"
        angle = f"{spread[k]:.2g} deg" if spread[k] < 90 else "not determined"
        grid.add_row(
            name,
            f"{values[k]:.6g}",
            interval if high[k] - values[k] <= values[k] else "not determined",
            # + 0.0 removes negative zeros
            "({:.3f}, {:.3f}, {:.3f})".format(*(np.round(axes[:, k], 3) + 0.0)),
            "given" if options.moments_only else angle,
        )
    lines = [f"residual rms {float(result.rms):.3g} rad/s"]
    if options.noise:
        lines[0] += f", {float(result.noise):.3g} of the noise"
    if (bias := _bias(result)) is not None:
        parts = (f"{b:.3g} +- {s:.2g}" for b, s in zip(*bias, strict=True))
        lines.append(f"bias of the gyroscope, rad/s: {', '.join(parts)}")
    if drag := _drag(result):
        parts = (f"{name} {c:.3g} +- {s:.2g}" for name, (c, s) in drag.items())
        units = "N m s, N m s^2" if is_absolute else "over the largest moment, 1/s, 1"
        lines.append(f"drag, {units}: {', '.join(parts)}")
    grid.caption = Text("\n".join(lines))
    grid.caption_justify = "left"
    return grid
