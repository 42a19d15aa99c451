"""`polhode fit RECORDING`: inertia from a CSV of times and rates, with a table and a figure."""

import argparse
import math
import sys
from pathlib import Path

_NAMES = ("t", "wx", "wy", "wz")


def register(commands) -> argparse.ArgumentParser:
    """Add the command to the parser."""
    command = commands.add_parser(
        "fit",
        help="inertia from a recording of body rates (CSV)",
        description="Fit the inertia of a tumbling body to a CSV file of times and gyroscope "
        "rates. Writes the numbers (JSON) and a figure (PNG) and prints a summary.",
        epilog="example: polhode fit toss.csv --columns t=time wx=gx wy=gy wz=gz -o toss",
    )
    command.add_argument("recording", metavar="RECORDING", type=Path, help="CSV with a header line")
    command.add_argument(
        "--columns", nargs="+", metavar="NAME=COLUMN", default=[],
        help="columns of t [s], wx, wy, wz and, if there is a wheel, wheel [rad/s]; the names "
        "themselves are taken for what is not given",
    )  # fmt: skip
    command.add_argument(
        "-o", "--output", metavar="RESULT", type=Path,
        help="write RESULT.json and RESULT.png (default: the name of the recording, here)",
    )  # fmt: skip
    command.add_argument("--degrees", action="store_true", help="rates are in deg/s")
    command.add_argument("--milliseconds", action="store_true", help="times are in ms")
    command.add_argument(
        "--noise", type=_positive, metavar="SIGMA",
        help="standard deviation of the rates, rad/s (default: from the residuals)",
    )  # fmt: skip
    command.add_argument(
        "--moments-only", action="store_true", help="the sensor axes are principal axes"
    )
    command.add_argument("--bias", action="store_true", help="fit a constant bias of the gyroscope")
    command.add_argument("--drag", action="store_true", help="fit a drag of the air")
    command.add_argument(
        "--robust", type=_positive, metavar="K",
        help="count residuals beyond K noises linearly (needs --noise)",
    )  # fmt: skip
    command.add_argument(
        "--wheel-inertia", type=_positive, metavar="J",
        help="spin inertia of the wheel, kg m^2: fixes the absolute scale",
    )  # fmt: skip
    command.add_argument(
        "--wheel-axis", nargs=3, type=float, metavar=("X", "Y", "Z"), default=(0.0, 0.0, 1.0),
        help="axis of the wheel (default: 0 0 1)",
    )  # fmt: skip
    command.add_argument("--no-figure", action="store_true", help="do not draw the figure")
    command.add_argument("-q", "--quiet", action="store_true", help="print errors only")
    command.set_defaults(command=fit)
    return command


def fit(arguments: argparse.Namespace) -> int:
    """Do the job; 0, 1 when the fit must not be used, 2 for options or files that do not fit."""
    try:
        columns = _columns(arguments)
    except ValueError as error:
        print(f"polhode: {error}", file=sys.stderr)
        return 2
    from polhode.cli._run import _require

    _require("rich", *(() if arguments.no_figure else ("matplotlib",)))
    _require("optimistix", extra="fit")
    from rich.console import Console

    messages = Console(stderr=True)
    messages.quiet = arguments.quiet or not messages.is_terminal
    with messages.status("reading ...") as status:
        import jax

        jax.config.update("jax_enable_x64", True)
        from polhode import fit as room

        try:
            recording = room.read_recording(
                arguments.recording,
                columns,
                scale=math.pi / 180 if arguments.degrees else 1.0,
                time_scale=1e-3 if arguments.milliseconds else 1.0,
                noise=arguments.noise or 1.0,
            )
            options = _options(arguments, room)
        except ValueError as error:
            units = "deg/s" in str(error) and not (arguments.degrees and arguments.milliseconds)
            hint = " See --degrees and --milliseconds." if units else ""
            print(f"polhode: {error}{hint}", file=sys.stderr)
            return 2
        output = arguments.output or Path(arguments.recording.stem)
        output.parent.mkdir(parents=True, exist_ok=True)
        status.update(f"fitting {recording.times.shape[-1]} samples (compiling first) ...")
        result = room.fit_recordings([recording], throw=False, **options)
        status.update("writing ...")
        written = [_write(output, arguments, recording, result)]
        if not arguments.no_figure and recording.omega is not None:
            written.append(_draw(output, arguments, recording, result))
    if not arguments.quiet:
        here = sys.stdout.isatty()
        out = Console(soft_wrap=not here, width=None if here else 110)
        out.print(_table(arguments, recording, result))
        for text in room.remarks(result):
            out.print(f"- {text}", highlight=False)
        out.print("written: " + ", ".join(map(str, written)), highlight=False)
    return 1 if room.is_unusable(result) else 0


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (value > 0 and math.isfinite(value)):
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive number")
    return value


def _columns(arguments) -> dict[str, str]:
    """What --columns says, the rest by its own name."""
    allowed = (*_NAMES, "wheel")
    found = {name: name for name in _NAMES}
    for text in arguments.columns:
        name, mark, column = text.partition("=")
        if not mark or name not in allowed or not column:
            raise ValueError(
                f"--columns takes NAME=COLUMN with NAME one of {', '.join(allowed)}, got {text!r}."
            )
        found[name] = column
    if arguments.wheel_inertia and "wheel" not in found:
        raise ValueError("--wheel-inertia needs the wheel's speed: add wheel=COLUMN to --columns.")
    if arguments.robust and not arguments.noise:
        raise ValueError("--robust counts in noises: give --noise SIGMA too.")
    return found


def _options(arguments, room) -> dict:
    """Keywords of ``fit_recordings``."""
    motion = room.FreeMotion()
    if arguments.drag or arguments.wheel_inertia:
        length = math.sqrt(sum(x * x for x in arguments.wheel_axis))
        if not length > 0:
            raise ValueError("--wheel-axis must have a direction, got 0 0 0.")
        motion = room.SteppedMotion(
            spin_inertia=arguments.wheel_inertia,
            axis=tuple(x / length for x in arguments.wheel_axis),
            drag=room.Drag() if arguments.drag else None,
            fit_drag=arguments.drag,
        )
    return {
        "motion": motion,
        "unknown": room.MomentsOnly() if arguments.moments_only else room.FullTensor(),
        "bias": arguments.bias,
        "robust": room.Huber(arguments.robust) if arguments.robust else None,
        "noise_known": arguments.noise is not None,
    }


def _write(output, arguments, recording, result) -> Path:
    import json

    import numpy as np

    import polhode
    from polhode.io import whole_file
    from polhode.rotation import to_matrix

    def plain(value):
        return np.where(np.isfinite(value), value, None).tolist()

    low, high = result.interval(0.95)
    document = {
        "recording": str(arguments.recording),
        "polhode": polhode.__version__,
        "samples": int(np.sum(recording.present)),
        "gaps": int(np.sum(np.asarray(recording.present) == 0)),
        "scale_known": result.scale_known,
        "moments": plain(result.moments),
        "moments_std": plain(result.moments_std),
        "ratios": plain(result.ratios),
        "ratios_std": plain(result.ratios_std),
        "interval_95": [plain(low), plain(high)],
        "tensor": plain(result.inertia.tensor),
        "principal_axes_as_columns": plain(to_matrix(result.axes)),
        "axes_std_rad": plain(result.axes_std),
        "mirrored_ratios": plain(np.sort(np.asarray(result.mirrored.moments))),
        "rms_rad_per_s": float(result.rms),
        "residual_over_noise": float(result.noise),
        "whiteness": float(result.whiteness),
        "steps": int(result.steps),
        "findings": result.findings(),
    }
    path = output.with_name(output.name + ".json")
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    return path


def _draw(output, arguments, recording, result) -> Path:
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    from polhode import plot
    from polhode.io import whole_file

    figure = plot.fit(result, recording, title=arguments.recording.name)
    path = output.with_name(output.name + ".png")
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=160)
    plt.close(figure)
    return path


def _table(arguments, recording, result):
    """The summary as a rich Table."""
    import numpy as np
    from rich.table import Table

    samples = int(np.sum(recording.present))
    grid = Table(
        title=f"{arguments.recording.name}: {samples} samples",
        title_justify="left",
        show_edge=False,
        pad_edge=False,
    )
    known = result.scale_known
    for name in ("", "moment [kg m^2]" if known else "ratio", "95 %", "axis in sensor axes", "+-"):
        grid.add_column(name, justify="left" if name == "" else "right")
    from polhode.rotation import to_matrix

    values = np.asarray(result.moments if known else result.ratios)
    low, high = (np.asarray(end) for end in result.interval(0.95))
    axes = np.asarray(to_matrix(result.axes))
    turn = np.degrees(np.asarray(result.axes_std))
    for k, name in enumerate(("smallest", "middle", "largest")):
        reach = "" if k == 2 and not known else f"{low[k]:.5g} to {high[k]:.5g}"
        grid.add_row(
            name,
            f"{values[k]:.6g}",
            reach if np.isfinite(high[k]) else "not determined",
            # without negative zeros
            "({:.3f}, {:.3f}, {:.3f})".format(*(np.round(axes[:, k], 3) + 0.0)),
            f"{turn[k]:.2g} deg" if turn[k] < 90 else "not determined",
        )
    grid.caption = (
        f"residual rms {float(result.rms):.3g} rad/s, {float(result.noise):.3g} of the noise"
        if arguments.noise
        else f"residual rms {float(result.rms):.3g} rad/s"
    )
    grid.caption_justify = "left"
    return grid
