"""What `polhode run` computes: the batch of a scene file, chunk by chunk."""

import dataclasses
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

import polhode
from polhode import rotation
from polhode.inertia import Inertia
from polhode.io import (
    SceneFile,
    blamed,
    build_attitudes,
    build_method,
    build_scene,
    build_state,
    draw_clones,
)

_CHUNKS, _LEAST_CHUNK = 20, 50  # pieces of progress, and bodies below which a piece does not pay


class Job(NamedTuple):
    """A scene ready to run: body 0 is the nominal one."""

    file: SceneFile
    scene: polhode.Scene
    state: polhode.State
    ts: np.ndarray
    method: Any
    rtol: float | None
    redrawn: int

    @property
    def bodies(self) -> int:
        return int(np.prod(self.batch_shape, dtype=int))

    @property
    def batch_shape(self) -> tuple[int, ...]:
        lead = self.state.omega_body.shape[:-1]
        return np.broadcast_shapes(lead, self.scene.inertia.batch_shape)


class Outcome(NamedTuple):
    """The trajectory of all bodies and what it took."""

    trajectory: polhode.Trajectory
    compile_seconds: float
    run_seconds: float


def prepare(file: SceneFile, precision: str) -> Job:
    """Build the scene in the precision asked for; switches 64-bit numbers on for this process."""
    jax.config.update("jax_enable_x64", True)
    dtype = np.dtype(precision)
    clones = draw_clones(file, dtype)
    return Job(
        file,
        build_scene(file, dtype, clones.inertia),
        clones.state,
        file.times.seconds.astype(dtype),
        build_method(file),
        file.method.rtol,
        clones.redrawn,
    )


class _CompileClock:
    """Seconds in which JAX was tracing or compiling: the union of what it reports, for a function
    traced inside another one is reported with both.
    """

    def __init__(self):
        self.spans: list[tuple[float, float]] = []

    def listen(self, event: str, duration_secs: float, **kwargs) -> None:
        if event.startswith("/jax/core/compile/"):
            now = time.perf_counter()
            self.spans.append((now - duration_secs, now))

    def since(self, start: float) -> float:
        total, reached = 0.0, start
        for begin, end in sorted(self.spans):
            total += max(0.0, end - max(begin, reached))
            reached = max(reached, end)
        return total


_CLOCK = _CompileClock()
jax.monitoring.register_event_duration_secs_listener(_CLOCK.listen)


def run(job: Job, progress: Callable[[int], None]) -> Outcome:
    """Simulate all bodies in chunks, telling `progress` how many are done after each.

    Raises SimulationError when the nominal body does not finish; clones that do not are found in
    the trajectory's `status`.
    """
    began = time.perf_counter()
    total = job.bodies
    size = min(total, max(_LEAST_CHUNK, -(-total // _CHUNKS)))
    fields = ("wxyz", "omega_body", "status", "steps")
    kept: dict[str, np.ndarray] = {}
    for start in range(0, total, size):
        first = min(start, total - size)  # the last chunk overlaps: all have one shape
        piece = _simulate(job, slice(first, first + size) if job.batch_shape else None)
        for name in fields:
            part = np.asarray(getattr(piece, name))
            if not job.batch_shape:
                kept[name] = part
                continue
            whole = kept.setdefault(name, np.empty((total, *part.shape[1:]), part.dtype))
            whole[first : first + size] = part
        if start == 0:
            _require_nominal(kept["status"])
        progress(min(start + size, total))
    seconds = time.perf_counter() - began
    compiling = _CLOCK.since(began)
    trajectory = dataclasses.replace(piece, scene=job.scene, **kept)
    return Outcome(trajectory, compiling, seconds - compiling)


def _simulate(job: Job, part: slice | None) -> polhode.Trajectory:
    scene, state = job.scene, job.state
    if part is not None:
        scene = dataclasses.replace(scene, inertia=_cut(scene.inertia, part))
        state = jax.tree.map(lambda x: x[part] if x.ndim > 1 else x, state)
    with blamed(job.file, ""):
        trajectory = polhode.simulate(scene, state, job.ts, job.method, rtol=job.rtol, throw=False)
    return jax.block_until_ready(trajectory)


def _cut(inertia: Inertia, part: slice) -> Inertia:
    return jax.tree.map(lambda x: x[part], inertia) if inertia.batch_shape else inertia


def _require_nominal(status: np.ndarray) -> None:
    code = polhode.Status(int(np.reshape(status, -1)[0]))
    if code != polhode.Status.SUCCESSFUL:
        raise polhode.SimulationError(
            f"the nominal body did not finish: {code.explanation}", np.asarray(status)
        )


class Residuals(NamedTuple):
    """Observed minus computed: rotation angle, rad (n,), and body rates, rad/s (n, 3)."""

    seconds: np.ndarray
    angle: np.ndarray
    rates: np.ndarray


def compare(job: Job) -> Residuals | None:
    """The nominal body against the file's observations after the first time; None without any."""
    seen = job.file.observations
    if seen is None:
        return None
    start, stop = job.file.times.seconds[[0, -1]]
    later = (seen.seconds - start) * np.sign(stop - start) > 0
    if not later.any():
        return None
    dtype = job.ts.dtype
    order = slice(None) if stop > start else slice(None, None, -1)
    ts = np.concatenate([[start], seen.seconds[later][order]]).astype(dtype)
    scene = build_scene(job.file, dtype)
    state = build_state(job.file, dtype, scene.inertia)
    nominal = job._replace(scene=scene, state=state, ts=ts)
    there = _simulate(nominal, None)
    attitudes = build_attitudes(seen.attitudes, dtype)[later][order]
    angle = rotation.angle_between(there.wxyz[1:], attitudes)
    rates = seen.omega_body[later][order] - np.asarray(there.omega_body[1:])
    return Residuals(np.asarray(ts[1:]), np.asarray(angle), rates)
