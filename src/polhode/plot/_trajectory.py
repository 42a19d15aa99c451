"""Figures of trajectories: histories, polhode and herpolhode, an overview, and animations."""

import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from polhode._atomic import atomic_write
from polhode._trajectory import Trajectory
from polhode.plot._samples import (
    ACCENT,
    AXES,
    GREY,
    INK,
    Samples,
    Scale,
    as_samples,
    box_sides,
    matrices,
    new_figure,
    pick,
    plain,
    styled,
)


@styled
def history(
    what: Trajectory | Samples,
    *,
    body: int | None = None,
    scale: Scale | None = None,
    axis_names: tuple[str, str, str] = ("x", "y", "z"),
) -> Any:
    """Stacked panels of one body: rates, attitude, drifts. Returns the Figure.

    The attitude is shown as the quaternion `wxyz`. The drifts are |E/E0 - 1| and |L - L0|/|L0| with
    L in space axes: numerical errors for a torque-free body, physical changes where torques act.
    Panels whose data were not recorded are left out.
    """
    data, body = pick(what, body)
    scale = Scale.of(np.ptp(data.ts[body])) if scale is None else scale
    panels = [_rates]
    if data.wxyz is not None:
        panels.append(_attitude)
    if data.tensor is not None and data.energy is not None:
        panels.append(_drift)
    figure = new_figure(7.2, 2.1 * len(panels) + 0.4)
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    t = data.ts[body] / scale.seconds
    for panel, ax in zip(panels, axes, strict=True):
        panel(ax, t, data, body, scale, axis_names)
        # beside the panel, where the legend hides no data
        ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
        ax.margins(x=0.01)
    axes[-1].set_xlabel(f"time [{scale.time}]")
    return figure


def _rates(ax, t, data, body, scale, names):
    for k in range(3):
        rate = data.omega_body[body, :, k] / scale.radians_per_second
        ax.plot(t, rate, color=AXES[k], label=names[k])
    ax.set_ylabel(f"[{scale.rate}]")
    ax.set_title("Body rates")


def _attitude(ax, t, data, body, scale, names):
    for k, (name, color) in enumerate(zip("wxyz", (INK, *AXES), strict=True)):
        ax.plot(t, data.wxyz[body, :, k], color=color, label=name)
    ax.set_ylim(-1.08, 1.08)
    ax.set_title("Attitude quaternion, body to space")


def _drift(ax, t, data, body, scale, names):
    energy = data.energy[body]
    momentum = data.momentum_space[body] if data.wxyz is not None else None
    lines = {"energy": np.abs(energy / energy[0] - 1) if energy[0] else np.abs(energy)}
    if momentum is not None:
        size = np.linalg.norm(momentum[0])
        lines["momentum"] = np.linalg.norm(momentum - momentum[0], axis=-1) / (size or 1)
    for (name, line), color in zip(lines.items(), (INK, GREY), strict=False):
        ax.plot(t, np.where(line > 0, line, np.nan), color=color, label=name)
    ax.set_yscale("log")
    ax.set_title("Relative change of energy and of angular momentum in space")


_LIGHT = np.array([0.25, -0.35, 0.9]) / np.linalg.norm([0.25, -0.35, 0.9])


@styled
def polhode(
    what: Trajectory | Samples,
    *,
    body: int | None = None,
    ax: Any = None,
    family: int = 8,
    axis_names: tuple[str, str, str] = ("x", "y", "z"),
    view: tuple[float, float] | None = None,
) -> Any:
    """Draw the polhode of one body on its inertia ellipsoid; returns the 3-D Axes.

    The ellipsoid is that of constant kinetic energy at the first time, in the space of body rates,
    scaled so that its largest semi-axis is 1. Thin lines are polhodes of the same energy for
    `family` other magnitudes of the momentum, two curves each, half of them on either side of the
    separatrix (dashed), which passes through the intermediate axis; 0: none.
    Parts of a curve behind the ellipsoid are faint; a dot marks the first time. `view` is
    (elevation, azimuth) in degrees; None: facing the curve.
    """
    data, body = pick(what, body)
    tensor = data.need("tensor", "the polhode")[body]
    moments, turn = np.linalg.eigh(tensor)
    turn[:, 0] *= np.linalg.det(turn)  # right-handed
    omega = data.omega_body[body] @ turn
    twice_energy = omega[0] ** 2 @ moments
    _require_motion(twice_energy, "inertia ellipsoid")
    semi = np.sqrt(twice_energy / moments)
    size = semi.max()
    if ax is None:
        ax = new_figure(5.4, 5.2).add_subplot(projection="3d")
    ax.view_init(*(_towards(data.omega_body[body]) if view is None else view))
    ax.computed_zorder = False
    elevation, azimuth = np.deg2rad([ax.elev, ax.azim])
    flat = np.cos(elevation)
    eye = np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])

    def draw(points, **style):
        _line(ax, points @ turn.T / size, (points / semi**2) @ turn.T @ eye, **style)

    _surface(ax, semi / size, turn, eye)
    for curve in _family(moments, twice_energy, family):
        draw(curve, color=GREY, linewidth=0.7)
    for curve in _separatrix(moments, twice_energy):
        draw(curve, color=INK, linewidth=1.0, linestyle=(0, (4, 2)))
    draw(omega, color=ACCENT, linewidth=2.4)
    start, visible = turn @ omega[0] / size, eye @ turn @ (omega[0] / semi**2) >= 0
    ax.scatter(
        *start,
        color=ACCENT,
        s=42,
        edgecolor="white",
        linewidth=0.8,
        alpha=1.0 if visible else 0.35,
        zorder=7,
    )
    _body_axes(ax, tensor, twice_energy, size, axis_names)
    _tidy(ax)
    return ax


def _require_motion(size: float, name: str) -> None:
    """ValueError for a body whose energy or momentum ``size`` is zero or not finite."""
    if not np.isfinite(size):
        raise ValueError(
            f"the body did not finish, it has no {name}: its samples at the first time are not"
            " finite. Choose another one with body=."
        )
    if not size > 0:
        raise ValueError(f"the body is at rest at the first time: it has no {name}.")


def _towards(omega) -> tuple[float, float]:
    """Elevation and azimuth from which most of the curve is in front."""
    mean = np.mean(omega, axis=0)
    flat = np.hypot(mean[0], mean[1])
    azimuth = 32.0
    if flat > 0.3 * np.linalg.norm(omega, axis=-1).mean():
        azimuth = np.degrees(np.arctan2(mean[1], mean[0])) + 25
    return (-24.0 if mean[2] < -flat else 24.0), azimuth


def _line(ax, points, facing, **style):
    """A curve whose parts with `facing` < 0 are faint."""
    for front in (False, True):
        visible = points.copy()
        hide = (facing >= 0) != front
        # draw the neighbours of a change of side too, so that the two parts join
        hide[1:-1] &= hide[:-2] & hide[2:]
        visible[hide] = np.nan
        alpha = 1.0 if front else 0.22
        ax.plot(*visible.T, alpha=alpha, zorder=4 if front else 2, **style)


def _surface(ax, semi, turn, eye):
    longitude, latitude = np.meshgrid(np.linspace(0, 2 * np.pi, 121), np.linspace(0, np.pi, 61))
    ball = np.stack(
        [
            np.sin(latitude) * np.cos(longitude),
            np.sin(latitude) * np.sin(longitude),
            np.cos(latitude),
        ]
    )
    points = np.einsum("ij,j...->i...", turn, ball * semi[:, None, None])
    normal = np.einsum("ij,j...->i...", turn, ball / semi[:, None, None])
    normal /= np.linalg.norm(normal, axis=0)
    lit = np.clip(np.einsum("i,i...->...", _LIGHT, normal), 0, 1)
    rim = np.clip(np.einsum("i,i...->...", eye, normal), 0, 1)
    brightness = (0.80 + 0.14 * lit + 0.06 * rim)[..., None]
    colors = np.clip(np.array([0.95, 0.98, 1.02]) * brightness, 0, 1)
    ax.plot_surface(
        *points,
        facecolors=colors,
        linewidth=0,
        antialiased=False,
        shade=False,
        rcount=61,
        ccount=121,
        zorder=1,
    )


def _family(moments, twice_energy, count):
    """Polhodes of the same energy for `count` magnitudes of the momentum: half of them (rounded up)
    around the first principal axis, the others around the last one."""
    low, middle, high = moments
    halves = (0, (low, middle), count - count // 2), (2, (middle, high), count // 2)
    for axis, (start, stop), levels in halves:
        # equidistant in the height above the separatrix instead of in |L|^2
        for fraction in (np.arange(levels) + 0.5) / levels:
            inertia = start + (stop - start) * (fraction**2 if axis == 0 else 1 - fraction**2)
            yield from _level(moments, twice_energy, inertia, axis)


def _separatrix(moments, twice_energy):
    if moments[0] < moments[1] < moments[2]:
        yield from _level(moments, twice_energy, moments[1], 2)


def _level(moments, twice_energy, inertia, axis):
    """The two curves |L|^2 = `inertia` 2T on the ellipsoid that enclose principal axis `axis`."""
    others = [k for k in range(3) if k != axis]
    # with w_k^2 = 2T s_k: sum I_k s_k = 1 and sum I_k^2 s_k = inertia; eliminate s_axis
    weights = [
        moments[k] * (moments[k] - moments[axis]) / (inertia - moments[axis])
        if inertia != moments[axis]
        else np.inf
        for k in others
    ]
    if not all(0 < w < np.inf for w in weights):
        return
    angle = np.linspace(0, 2 * np.pi, 361)
    curve = np.zeros((angle.size, 3))
    for k, weight, wave in zip(others, weights, (np.cos(angle), np.sin(angle)), strict=True):
        curve[:, k] = wave / np.sqrt(weight)
    remainder = 1 - sum(moments[k] * curve[:, k] ** 2 for k in others)
    height = np.sqrt(np.clip(remainder, 0, None) / moments[axis])
    for side in (1, -1):
        curve[:, axis] = side * height
        yield curve * np.sqrt(twice_energy)


def _body_axes(ax, tensor, twice_energy, size, names):
    for k, (name, color) in enumerate(zip(names, AXES, strict=True)):
        direction = np.eye(3)[k]
        surface = np.sqrt(twice_energy / tensor[k, k]) / size
        inner_end, outer_end = direction * surface, direction * (surface + 0.28)
        ax.plot(*np.stack([inner_end, outer_end]).T, color=color, linewidth=1.6, zorder=5)
        ax.text(
            *(direction * (surface + 0.36)), name, color=color, ha="center", va="center", zorder=8
        )


def _tidy(ax):
    ax.set_axis_off()
    ax.set_box_aspect((1, 1, 1), zoom=1.2)
    ax.set_xlim(-1, 1)
    ax.set_ylim(-1, 1)
    ax.set_zlim(-1, 1)
    ax.set_proj_type("ortho")


@styled
def herpolhode(
    what: Trajectory | Samples,
    *,
    body: int | None = None,
    ax: Any = None,
    scale: Scale | None = None,
) -> Any:
    """Draw the trace of the angular velocity in the invariable plane. Returns the Axes.

    The plane is normal to the angular momentum at the first time; its first axis is along the
    projection of the angular velocity at that time. Dashed circles show the smallest and the
    largest distance from the centre. A dot marks the first time.
    """
    data, body = pick(what, body)
    scale = Scale.of(np.ptp(data.ts[body])) if scale is None else scale
    omega = np.einsum("tij,tj->ti", data.matrices[body], data.omega_body[body])
    momentum = data.momentum_space[body, 0]
    _require_motion(np.linalg.norm(momentum), "invariable plane")
    normal = momentum / np.linalg.norm(momentum)
    first = omega[0] - normal * (normal @ omega[0])
    if np.linalg.norm(first) <= 1e-12 * np.linalg.norm(omega[0]):
        first = np.eye(3)[np.argmin(np.abs(normal))]
        first = first - normal * (normal @ first)
    first /= np.linalg.norm(first)
    second = np.cross(normal, first)
    x, y = omega @ first / scale.radians_per_second, omega @ second / scale.radians_per_second
    if ax is None:
        ax = new_figure(5.0, 5.0).add_subplot()
    radius = np.hypot(x, y)
    angle = np.linspace(0, 2 * np.pi, 361)
    for limit in (radius.min(), radius.max()):
        ax.plot(
            limit * np.cos(angle),
            limit * np.sin(angle),
            color=GREY,
            linewidth=0.8,
            linestyle=(0, (4, 3)),
        )
    ax.plot(x, y, color=ACCENT, linewidth=1.1)
    ax.plot(x[0], y[0], "o", color=ACCENT, markeredgecolor="white", markersize=7)
    ax.plot(0, 0, "+", color=INK, markersize=9)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel(f"rate in the invariable plane [{scale.rate}]")
    ax.set_ylabel(f"[{scale.rate}]")
    ax.set_title("Herpolhode")
    return ax


_BAND = (5, 95)


@styled
def overview(
    what: Trajectory | Samples,
    *,
    observed: Samples | None = None,
    scale: Scale | None = None,
    axis_names: tuple[str, str, str] = ("x", "y", "z"),
    title: str = "",
) -> Any:
    """A figure of the first body, with the distribution of the others, and observations.

    Left: the three body axes as directions in space (components along space x, y, z) and the body
    rates, with lines for body 0 and, for at least two others, bands from their 5th to their 95th
    percentile, or thin lines of up to 64 of them if the bodies have different times; dots are
    `observed` (`plot.samples` of one body; NaN where nothing was observed). Right: the polhode, or
    the energy of a body that starts at rest, did not finish, or has a variable inertia.
    """
    data = as_samples(what)
    names = tuple(plain(name, 30) for name in axis_names)
    scale = Scale.of(np.ptp(data.ts[0])) if scale is None else scale
    figure = new_figure(11.0, 7.6)
    grid = figure.add_gridspec(4, 2, width_ratios=(1.75, 1.0))
    rows = [figure.add_subplot(grid[0, 0])]
    rows += [figure.add_subplot(grid[k, 0], sharex=rows[0]) for k in (1, 2, 3)]
    t = data.ts[0] / scale.seconds
    times, direction = data.ts / scale.seconds, data.matrices
    is_shared = bool(np.all(data.ts == data.ts[0]))
    observed_times = None if observed is None else observed.ts[0] / scale.seconds
    for k, ax in enumerate(rows[:3]):
        for i, color in enumerate(AXES):
            _curve(ax, times, direction[:, :, i, k], color, f"space {'xyz'[i]}", is_shared)
            if observed is not None and observed.wxyz is not None:
                _dots(ax, observed_times, observed.matrices[0, :, i, k], color)
        ax.set_ylim(-1.1, 1.1)
        letter = "xyz"[k]
        name = "" if names[k] == letter else f" ({names[k]})"
        ax.set_title(f"Body {letter} axis{name}: direction in space")
    for k, color in enumerate(AXES):
        unit = scale.radians_per_second
        _curve(rows[3], times, data.omega_body[:, :, k] / unit, color, names[k], is_shared)
        if observed is not None:
            _dots(rows[3], observed_times, observed.omega_body[0, :, k] / unit, color)
    rows[3].set_title("Body rates")
    rows[3].set_ylabel(f"[{scale.rate}]")
    rows[3].set_xlabel(f"time [{scale.time}]")
    for ax in rows:
        ax.margins(x=0.01)
        ax.label_outer()
    for ax in (rows[0], rows[3]):
        ax.legend(
            loc="lower right",
            bbox_to_anchor=(1.0, 0.98),
            ncols=3,
            borderpad=0,
            handlelength=1.4,
            columnspacing=1.2,
        )
    size = np.linalg.norm(data.omega_body[0, 0])
    if data.energy is not None and (data.tensor is None or not 0 < size < np.inf):
        ax = figure.add_subplot(grid[:3, 1])
        ax.plot(t, data.energy[0], color=INK, linewidth=1.3)
        ax.set_title("Energy [J]")
        ax.set_xlabel(f"time [{scale.time}]")
    else:
        ax = figure.add_subplot(grid[:3, 1], projection="3d")
        polhode(data, ax=ax, axis_names=names)
        ax.set_title("Polhode on the inertia ellipsoid", loc="center")
    _key(figure.add_subplot(grid[3, 1]), observed is not None, data.count - 1, is_shared)
    if title:
        figure.suptitle(plain(title), x=0.01, ha="left", fontsize=13, fontweight="bold", color=INK)
    return figure


def _curve(ax, times, values, color, label, is_shared):
    """Body 0 as a line; with three or more bodies the others as a band, or as thin lines if their
    times differ."""
    t = times[0]
    if len(values) > 2 and not is_shared:
        others = slice(1, 1 + _MOST_BODIES)
        ax.plot(times[others].T, values[others].T, color=color, alpha=0.3, linewidth=0.6, zorder=2)
    elif len(values) > 2:
        with np.errstate(invalid="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # of times that no clone reached
            low, high = np.nanpercentile(values[1:], _BAND, axis=0)
        ax.fill_between(t, low, high, color=color, alpha=0.22, linewidth=0, zorder=2)
    ax.plot(t, values[0], color=color, label=label, linewidth=1.3, zorder=3)


def _dots(ax, t, values, color):
    ax.plot(
        t,
        values,
        "o",
        color=color,
        markersize=4.2,
        markeredgecolor="white",
        markeredgewidth=0.6,
        zorder=4,
    )


def _key(ax, observed, clones, is_shared):
    """The legend of lines, bands and dots."""
    from matplotlib.artist import Artist
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    entries: list[tuple[Artist, str]] = [(Line2D([], [], color=INK, linewidth=1.3), "nominal body")]
    if clones > 1 and not is_shared:
        line = Line2D([], [], color=INK, alpha=0.3, linewidth=0.6)
        entries.append((line, f"{min(clones, _MOST_BODIES)} of {clones:,} other bodies"))
    elif clones > 1:
        entries.append((Patch(color=INK, alpha=0.22), f"5 % to 95 % of {clones:,} clones"))
    if observed:
        dot = Line2D([], [], color=INK, marker="o", linestyle="", markersize=4.2)
        entries.append((dot, "published values"))
    ax.set_axis_off()
    ax.legend(*zip(*entries, strict=True), loc="center")


_FACES = np.array(
    [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]]
)
_MOST_BODIES = 64
_WRITERS = {".gif": "pillow", ".mp4": "ffmpeg", ".html": None, ".htm": None}


@styled
def animate(
    what: Trajectory | Samples,
    path: str | os.PathLike | None = None,
    *,
    bodies: list[int] | None = None,
    fps: int = 25,
    seconds: float = 8.0,
    dpi: int = 100,
    scale: Scale | None = None,
) -> Any:
    """Animate bodies as boxes with the same inertia; returns matplotlib's `FuncAnimation`.

    Every body is drawn as the homogeneous box with its moments, each in its own panel (up to 64
    bodies; `bodies` selects them). The motion from first to last time is shown in `seconds`, with
    attitudes interpolated between samples; all panels show the same time, and a body stands still
    before its first and after its last sample. `path` ending in .gif, .mp4 or .html: the file to
    write, atomically; gif needs pillow, mp4 the program ffmpeg. Raises ValueError for another
    ending, RuntimeError if the writer is missing.
    """
    from matplotlib.animation import FuncAnimation
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    data = as_samples(what)
    numbers = list(range(min(data.count, _MOST_BODIES))) if bodies is None else list(bodies)
    if not 1 <= len(numbers) <= _MOST_BODIES:
        raise ValueError(f"animate shows 1 to {_MOST_BODIES} bodies, got {len(numbers)}.")
    numbers = [pick(data, number)[1] for number in numbers]
    if path is not None:
        _check_writer(Path(path))
    ts = data.ts[numbers]
    scale = Scale.of(np.ptp(ts)) if scale is None else scale
    wxyz = data.need("wxyz", "an animation")
    boxes = [_box(tensor) for tensor in data.need("tensor", "an animation")[numbers]]
    frames = max(2, round(fps * seconds))
    times = np.linspace(ts.min(), ts.max(), frames)
    times = times[::-1] if (ts[:, 0] > ts[:, -1]).all() else times
    turns = [_interpolate(times, data.ts[b], wxyz[b]) for b in numbers]

    columns = int(np.ceil(np.sqrt(len(numbers))))
    rows = -(-len(numbers) // columns)
    side = 5.0 if len(numbers) == 1 else max(1.6, 7.0 / columns)
    figure = new_figure(columns * side, rows * side + 0.4)
    title = figure.suptitle("", fontsize=10, color=INK)
    solids = []
    for index in range(len(numbers)):
        ax = figure.add_subplot(rows, columns, index + 1, projection="3d")
        solid = Poly3DCollection(boxes[index][_FACES], edgecolor="white", linewidth=0.8)
        ax.add_collection3d(solid)
        solids.append(solid)
        ax.set_axis_off()
        ax.set_proj_type("ortho")
        ax.set(xlim=(-0.62, 0.62), ylim=(-0.62, 0.62), zlim=(-0.62, 0.62))
        ax.set_box_aspect((1, 1, 1), zoom=1.35)

    def draw(frame):
        for index, solid in enumerate(solids):
            turn = turns[index][frame]
            solid.set_verts((boxes[index] @ turn.T)[_FACES])
            solid.set_facecolor(_shade(turn, boxes[index]))
        title.set_text(f"t = {times[frame] / scale.seconds:.2f} {scale.time}")
        return [*solids, title]

    draw(0)
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # the layout is computed once, not in every frame
    animation = FuncAnimation(figure, draw, frames=frames, interval=1000 / fps, blit=False)
    if path is not None:
        _save(animation, Path(path), fps, dpi)
    return animation


def _box(tensor: np.ndarray) -> np.ndarray:
    """Corners (8, 3) in body axes of the box with this inertia, its diagonal of length 1."""
    moments, axes = np.linalg.eigh(tensor)
    signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    return (signs * box_sides(moments) / 2) @ axes.T


def _shade(turn: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Face colours: one hue per body axis, paler on its negative side, lit from above."""
    from matplotlib.colors import to_rgb

    light = np.array([0.35, -0.5, 0.8])
    light /= np.linalg.norm(light)
    colors = []
    for face in _FACES:
        centre = corners[face].mean(axis=0)
        normal = turn @ (centre / np.linalg.norm(centre))
        # the hue of the body axis nearest to the face's normal
        axis = int(np.argmax(np.abs(centre)))
        hue = np.array(to_rgb(AXES[axis]))
        if centre[axis] < 0:  # so that an inverted body looks different
            hue = 0.35 * hue + 0.65
        colors.append(np.clip(hue * 0.55 + 0.25 + 0.25 * (normal @ light), 0, 1))
    return np.array(colors)


def _interpolate(times, ts, wxyz):
    """Rotation matrices at `times`, by normalised linear interpolation between samples."""
    # signs that make neighbouring quaternions close, for the shorter rotation between them
    flips = np.sign(np.sum(wxyz[1:] * wxyz[:-1], axis=-1))
    flips = np.concatenate([[1.0], np.cumprod(np.where(flips == 0, 1.0, flips))])
    continuous = wxyz * flips[:, None]
    order = np.argsort(ts)
    mean = np.stack([np.interp(times, ts[order], continuous[order, k]) for k in range(4)], axis=-1)
    return matrices(mean / np.linalg.norm(mean, axis=-1, keepdims=True))


def _check_writer(path: Path) -> None:
    from matplotlib.animation import writers

    if path.suffix.lower() not in _WRITERS:
        raise ValueError(f"animate writes .gif, .mp4 or .html, got {path.name!r}.")
    writer = _WRITERS[path.suffix.lower()]
    if writer is not None and not writers.is_available(writer):
        raise RuntimeError(
            f"writing {path.suffix} needs {writer}, which is not installed; write .html instead, "
            f"or install {writer}."
        )


def _save(animation, path: Path, fps: int, dpi: int) -> None:
    with atomic_write(path) as temporary:
        writer = _WRITERS[path.suffix.lower()]
        if writer is None:
            from matplotlib import rc_context

            with rc_context({"animation.embed_limit": 200.0, "savefig.dpi": dpi}):
                temporary.write_text(animation.to_jshtml(fps=fps), encoding="utf-8")
        else:
            animation.save(temporary, writer=writer, fps=fps, dpi=dpi)
