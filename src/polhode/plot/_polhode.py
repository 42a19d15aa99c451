"""The polhode: the curve of the angular velocity on the inertia ellipsoid."""

from typing import Any

import numpy as np

from polhode._trajectory import Trajectory
from polhode.plot._matplotlib import ACCENT, AXES, GREY, INK, new_figure, styled
from polhode.plot._samples import Samples, pick

_LIGHT = np.array([0.25, -0.35, 0.9]) / np.linalg.norm([0.25, -0.35, 0.9])


@styled
def polhode(
    what: Trajectory | Samples,
    *,
    body: int | None = None,
    ax: Any = None,
    family: int = 7,
    axis_names: tuple[str, str, str] = ("x", "y", "z"),
    view: tuple[float, float] | None = None,
) -> Any:
    """Draw the polhode of one body on its inertia ellipsoid; returns the 3-D Axes.

    The ellipsoid is that of constant kinetic energy at the first time, in the space of body rates,
    scaled so that its largest semi-axis is 1. Thin lines are `family` other polhodes of the same
    energy on either side of the separatrix (dashed), which passes through the intermediate axis.
    Parts of a curve behind the ellipsoid are faint; a dot marks the first time. `view` is
    (elevation, azimuth) in degrees; None: towards the curve.
    """
    made, body = pick(what, body)
    tensor = made.need("tensor", "the polhode")[body]
    moments, turn = np.linalg.eigh(tensor)
    turn[:, 0] *= np.linalg.det(turn)  # right-handed
    omega = made.omega_body[body] @ turn
    twice_energy = omega[0] ** 2 @ moments
    if not twice_energy > 0:
        raise ValueError("the body is at rest at the first time: it has no inertia ellipsoid.")
    semi = np.sqrt(twice_energy / moments)
    size = semi.max()
    if ax is None:
        ax = new_figure(5.4, 5.2).add_subplot(projection="3d")
    ax.view_init(*(_towards(made.omega_body[body]) if view is None else view))
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
    ax.scatter(*start, color=ACCENT, s=42, edgecolor="white", linewidth=0.8,
               alpha=1.0 if visible else 0.35, zorder=7)  # fmt: skip
    _body_axes(ax, tensor, twice_energy, size, axis_names)
    _tidy(ax)
    return ax


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
        shown = points.copy()
        hide = (facing >= 0) != front
        # keep the neighbours of a change of side, so that the two parts meet
        hide[1:-1] &= hide[:-2] & hide[2:]
        shown[hide] = np.nan
        alpha = 1.0 if front else 0.22
        ax.plot(*shown.T, alpha=alpha, zorder=4 if front else 2, **style)


def _surface(ax, semi, turn, eye):
    longitude, latitude = np.meshgrid(np.linspace(0, 2 * np.pi, 121), np.linspace(0, np.pi, 61))
    ball = np.stack([np.sin(latitude) * np.cos(longitude),
                     np.sin(latitude) * np.sin(longitude), np.cos(latitude)])  # fmt: skip
    points = np.einsum("ij,j...->i...", turn, ball * semi[:, None, None])
    normal = np.einsum("ij,j...->i...", turn, ball / semi[:, None, None])
    normal /= np.linalg.norm(normal, axis=0)
    lit = np.clip(np.einsum("i,i...->...", _LIGHT, normal), 0, 1)
    rim = np.clip(np.einsum("i,i...->...", eye, normal), 0, 1)
    brightness = (0.80 + 0.14 * lit + 0.06 * rim)[..., None]
    colors = np.clip(np.array([0.95, 0.98, 1.02]) * brightness, 0, 1)
    ax.plot_surface(*points, facecolors=colors, linewidth=0, antialiased=False, shade=False,
                    rcount=61, ccount=121, zorder=1)  # fmt: skip


def _family(moments, twice_energy, count):
    """Polhodes of the same energy: closed curves around the first and the last principal axis."""
    low, middle, high = moments
    for axis, (start, stop) in ((0, (low, middle)), (2, (middle, high))):
        # at equal gaps of the height above the separatrix plane rather than of |L|^2
        for fraction in (np.arange(count // 2 + 1) + 0.5) / (count // 2 + 1):
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
    rest = 1 - sum(moments[k] * curve[:, k] ** 2 for k in others)
    height = np.sqrt(np.clip(rest, 0, None) / moments[axis])
    for side in (1, -1):
        curve[:, axis] = side * height
        yield curve * np.sqrt(twice_energy)


def _body_axes(ax, tensor, twice_energy, size, names):
    for k, (name, color) in enumerate(zip(names, AXES, strict=True)):
        direction = np.eye(3)[k]
        surface = np.sqrt(twice_energy / tensor[k, k]) / size
        near, far = direction * surface, direction * (surface + 0.28)
        ax.plot(*np.stack([near, far]).T, color=color, linewidth=1.6, zorder=5)
        ax.text(*(direction * (surface + 0.36)), name, color=color, ha="center", va="center",
                zorder=8)  # fmt: skip


def _tidy(ax):
    ax.set_axis_off()
    ax.set_box_aspect((1, 1, 1), zoom=1.2)
    ax.set_xlim(-1, 1)
    ax.set_ylim(-1, 1)
    ax.set_zlim(-1, 1)
    ax.set_proj_type("ortho")
