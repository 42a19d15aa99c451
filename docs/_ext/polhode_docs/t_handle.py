"""The animation on the front page: a T-handle spun about its intermediate axis."""

import jax
import numpy as np

import polhode as ph
from polhode import plot


def t_handle() -> str:
    """A self-contained HTML page with the simulated motion, which turns over periodically."""
    jax.config.update("jax_enable_x64", True)
    bar = _cylinder(0.006, 0.10, axis=1, centre=[0.0, 0.0, 0.0])
    stem = _cylinder(0.005, 0.05, axis=0, centre=[0.031, 0.0, 0.0])
    handle = ph.MassProperties.from_mesh(*bar, density=2700.0)
    handle = handle + ph.MassProperties.from_mesh(*stem, density=2700.0)
    vertices = np.concatenate([bar[0], stem[0]]) - np.asarray(handle.centre)
    faces = np.concatenate([bar[1], stem[1] + len(bar[0])])
    state = ph.State(wxyz=[1.0, 0.0, 0.0, 0.0], omega_body=[8.0, 0.03, 0.03])
    motion = ph.simulate(ph.Scene(handle.inertia), state, np.linspace(0.0, 12.0, 1201))
    title = "A T-handle, spun about its intermediate axis"
    return plot.view(motion, mesh=(vertices, faces), title=title).html


def _cylinder(radius: float, length: float, axis: int, centre) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a cylinder along a body axis."""
    count = 48
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    ring = radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    end = np.array([0.0, 0.0, length / 2])
    vertices = np.concatenate([ring - end, ring + end, [-end, end]])
    vertices = np.roll(vertices, axis + 1, axis=1)  # from z to the axis
    i, j = np.arange(count), (np.arange(count) + 1) % count
    faces = [
        np.stack([i, j, i + count], axis=-1),
        np.stack([j, j + count, i + count], axis=-1),
        np.stack([j, i, np.full(count, 2 * count)], axis=-1),
        np.stack([i + count, j + count, np.full(count, 2 * count + 1)], axis=-1),
    ]
    return vertices + np.asarray(centre), np.concatenate(faces)
