"""Rates, attitude and conserved quantities against time."""

from typing import Any

import numpy as np

from polhode._trajectory import Trajectory
from polhode.plot._matplotlib import AXES, GREY, INK, new_figure, styled
from polhode.plot._samples import Samples, pick
from polhode.plot._scale import Scale


@styled
def history(
    what: Trajectory | Samples,
    *,
    body: int | None = None,
    scale: Scale | None = None,
    axis_names: tuple[str, str, str] = ("x", "y", "z"),
) -> Any:
    """Stacked panels of one body: rates, attitude, drift of energy and momentum; the Figure.

    The attitude is shown as the quaternion `wxyz`. The drift is |E/E0 - 1| and |L - L0|/|L0| with L
    in space axes: rounding and truncation of a free body; where torques act, real change.
    Panels whose data were not recorded are left out.
    """
    made, body = pick(what, body)
    scale = Scale.of(np.ptp(made.ts[body])) if scale is None else scale
    panels = [_rates]
    if made.wxyz is not None:
        panels.append(_attitude)
    if made.tensor is not None and made.energy is not None:
        panels.append(_drift)
    figure = new_figure(7.2, 2.1 * len(panels) + 0.4)
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    t = made.ts[body] / scale.seconds
    for panel, ax in zip(panels, axes, strict=True):
        panel(ax, t, made, body, scale, axis_names)
        # beside the panel, where it can hide nothing
        ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
        ax.margins(x=0.01)
    axes[-1].set_xlabel(f"time [{scale.time}]")
    return figure


def _rates(ax, t, made, body, scale, names):
    for k in range(3):
        rate = made.omega_body[body, :, k] / scale.radians_per_second
        ax.plot(t, rate, color=AXES[k], label=names[k])
    ax.set_ylabel(f"[{scale.rate}]")
    ax.set_title("Body rates")


def _attitude(ax, t, made, body, scale, names):
    for k, (name, color) in enumerate(zip("wxyz", (INK, *AXES), strict=True)):
        ax.plot(t, made.wxyz[body, :, k], color=color, label=name)
    ax.set_ylim(-1.08, 1.08)
    ax.set_title("Attitude quaternion, body to space")


def _drift(ax, t, made, body, scale, names):
    energy = made.energy[body]
    momentum = made.momentum_space[body] if made.wxyz is not None else None
    lines = {"energy": np.abs(energy / energy[0] - 1) if energy[0] else np.abs(energy)}
    if momentum is not None:
        size = np.linalg.norm(momentum[0])
        lines["momentum"] = np.linalg.norm(momentum - momentum[0], axis=-1) / (size or 1)
    for (name, line), color in zip(lines.items(), (INK, GREY), strict=False):
        ax.plot(t, np.where(line > 0, line, np.nan), color=color, label=name)
    ax.set_yscale("log")
    ax.set_title("Relative change of energy and of angular momentum in space")
