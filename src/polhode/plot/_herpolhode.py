"""The herpolhode: the curve of the angular velocity in the invariable plane of space."""

from typing import Any

import numpy as np

from polhode._trajectory import Trajectory
from polhode.plot._matplotlib import ACCENT, GREY, INK, new_figure, styled
from polhode.plot._samples import Samples, pick
from polhode.plot._scale import Scale


@styled
def herpolhode(
    what: Trajectory | Samples,
    *,
    body: int | None = None,
    ax: Any = None,
    scale: Scale | None = None,
) -> Any:
    """Draw the angular velocity's trace in the plane normal to the angular momentum; Axes.

    The plane is normal to the angular momentum at the first time, its first direction that of the
    rates' part in the plane then. Dashed circles are the least and the greatest distance reached.
    A dot marks the first time.
    """
    made, body = pick(what, body)
    scale = Scale.of(np.ptp(made.ts[body])) if scale is None else scale
    omega = np.einsum("tij,tj->ti", made.matrices[body], made.omega_body[body])
    momentum = made.momentum_space[body, 0]
    if not np.linalg.norm(momentum) > 0:
        raise ValueError("the body is at rest at the first time: it has no invariable plane.")
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
        ax.plot(limit * np.cos(angle), limit * np.sin(angle), color=GREY, linewidth=0.8,
                linestyle=(0, (4, 3)))  # fmt: skip
    ax.plot(x, y, color=ACCENT, linewidth=1.1)
    ax.plot(x[0], y[0], "o", color=ACCENT, markeredgecolor="white", markersize=7)
    ax.plot(0, 0, "+", color=INK, markersize=9)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel(f"rate in the invariable plane [{scale.rate}]")
    ax.set_ylabel(f"[{scale.rate}]")
    ax.set_title("Herpolhode")
    return ax
