"""Animations of one or many turning bodies."""

import os
from pathlib import Path
from typing import Any

import numpy as np

from polhode._trajectory import Trajectory
from polhode.files._write import atomic_write
from polhode.plot._matplotlib import AXES, INK, new_figure, styled
from polhode.plot._samples import Samples, Scale, as_samples, box_sides, matrices

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
    """Animate bodies as the boxes of the same inertia; returns matplotlib's `FuncAnimation`.

    Every body is drawn as the homogeneous box with its moments, each in its own panel (up to 64
    bodies; `bodies` picks some). The motion from first to last time is shown in `seconds`, with
    attitudes interpolated between samples. `path` ending in .gif, .mp4 or .html writes a file,
    whole or not at all: gif needs pillow, mp4 the program ffmpeg. Raises ValueError for another
    ending, RuntimeError when the writer is missing.
    """
    from matplotlib.animation import FuncAnimation
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    made = as_samples(what)
    chosen = list(range(min(made.count, _MOST_BODIES))) if bodies is None else list(bodies)
    if not 1 <= len(chosen) <= _MOST_BODIES:
        raise ValueError(f"animate shows 1 to {_MOST_BODIES} bodies, got {len(chosen)}.")
    if path is not None:
        _check_writer(Path(path))
    scale = Scale.of(np.ptp(made.ts)) if scale is None else scale
    wxyz = made.need("wxyz", "an animation")
    boxes = [_box(tensor) for tensor in made.need("tensor", "an animation")[chosen]]
    frames = max(2, round(fps * seconds))
    times = np.linspace(made.ts[chosen, 0], made.ts[chosen, -1], frames, axis=-1)
    turns = [_interpolate(times[i], made.ts[b], wxyz[b]) for i, b in enumerate(chosen)]

    columns = int(np.ceil(np.sqrt(len(chosen))))
    rows = -(-len(chosen) // columns)
    side = 5.0 if len(chosen) == 1 else max(1.6, 7.0 / columns)
    figure = new_figure(columns * side, rows * side + 0.4)
    title = figure.suptitle("", fontsize=10, color=INK)
    solids = []
    for index in range(len(chosen)):
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
        title.set_text(f"t = {times[0][frame] / scale.seconds:.2f} {scale.time}")
        return [*solids, title]

    draw(0)
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # laid out once, not in every frame
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
        if centre[axis] < 0:  # a body that has turned over must look different
            hue = 0.35 * hue + 0.65
        colors.append(np.clip(hue * 0.55 + 0.25 + 0.25 * (normal @ light), 0, 1))
    return np.array(colors)


def _interpolate(times, ts, wxyz):
    """Rotation matrices at `times`, by normalised linear interpolation between samples."""
    # neighbouring quaternions on the same side, so that the short way is taken
    flips = np.sign(np.sum(wxyz[1:] * wxyz[:-1], axis=-1))
    flips = np.concatenate([[1.0], np.cumprod(np.where(flips == 0, 1.0, flips))])
    signed = wxyz * flips[:, None]
    order = np.argsort(ts)
    mixed = np.stack([np.interp(times, ts[order], signed[order, k]) for k in range(4)], axis=-1)
    return matrices(mixed / np.linalg.norm(mixed, axis=-1, keepdims=True))


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
