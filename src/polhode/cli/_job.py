"""What `polhode run` computes: the batch of a scene file, chunk by chunk."""

import dataclasses
import os
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

import polhode
from polhode import rotation
from polhode.files import (
    SceneFile,
    build_attitudes,
    build_events,
    build_method,
    build_scene,
    draw_clones,
)
from polhode.files._build import blamed

_CHUNKS, _LEAST_CHUNK = 20, 50  # pieces of progress, and bodies below which a piece does not pay


class Job(NamedTuple):
    """A scene ready to run: body 0 is the nominal one.

    `all_ts` are the sample times `ts` and those of the observations among them, in one row, so that
    one compiled program gives both.
    """

    file: SceneFile
    scene: polhode.Scene
    state: polhode.State
    ts: np.ndarray
    all_ts: np.ndarray
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
    """The trajectory of all bodies, the misfit of the nominal one, the times [s] of events by name
    (bodies, M), NaN where there are fewer than M, and the seconds that it took.
    """

    trajectory: polhode.Trajectory
    residuals: "Residuals | None"
    events: dict[str, np.ndarray]
    compile_seconds: float
    run_seconds: float


def prepare(file: SceneFile, precision: str) -> Job:
    """Build the scene in the precision asked for; switches 64-bit numbers on for this process."""
    jax.config.update("jax_enable_x64", True)
    dtype = np.dtype(precision)
    _require_memory(file, dtype.itemsize)
    clones = draw_clones(file, dtype)
    ts = file.times.seconds.astype(dtype)
    seen = () if file.observations is None else _within(file.observations.seconds, ts)
    all_ts = np.unique(np.concatenate([ts, np.asarray(seen, dtype)]))
    return Job(
        file,
        build_scene(file, dtype, clones.inertia),
        clones.state,
        ts,
        all_ts if ts[0] < ts[-1] else all_ts[::-1],
        build_method(file),
        file.method.rtol,
        clones.redrawn,
    )


def _require_memory(file: SceneFile, itemsize: int) -> None:
    """MemoryError now, rather than a process that the system ends, for what cannot fit."""
    bodies = 1 if file.monte_carlo is None else file.monte_carlo.clones + 1
    # attitude, rates, energy and momentum of every sample, and as much again to write them
    need = 2 * 11 * itemsize * bodies * len(file.times.seconds)
    try:
        have = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return
    if need > have:
        raise MemoryError(
            f"{bodies:,} bodies at {len(file.times.seconds):,} times take {need / 1e9:,.1f} GB,"
            f" this machine has {have / 1e9:,.1f} GB"
        )


def _within(seconds: np.ndarray, ts: np.ndarray) -> np.ndarray:
    """The observed times that lie in the simulated span, in the dtype of `ts`."""
    seconds = seconds.astype(ts.dtype)
    return seconds[(seconds >= ts.min()) & (seconds <= ts.max())]


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
    kept: dict[str, np.ndarray] = {}
    residuals = None
    sampled = _index(job, job.ts)
    events = build_events(job.file, job.ts.dtype)
    times: dict[str, list[np.ndarray]] = {name: [] for name in events}
    for start in range(0, total, size):
        first = min(start, total - size)  # the last chunk overlaps: all have one shape
        piece = _simulate(job, slice(first, first + size) if job.batch_shape else None)
        if start == 0:
            _require_nominal(np.asarray(piece.status))
            residuals = _residuals(job, piece)
        for name in ("wxyz", "omega_body", "status", "steps"):
            part = np.asarray(getattr(piece, name))
            if name in ("wxyz", "omega_body"):
                part = part[..., sampled, :]
            if not job.batch_shape:
                kept[name] = part
                continue
            whole = kept.setdefault(name, np.empty((total, *part.shape[1:]), part.dtype))
            whole[first : first + size] = part
        with blamed(job.file, "[[events]]"):
            for name, event in events.items():
                rows = np.atleast_2d(polhode.crossings(piece, event).times)
                times[name].extend(rows[start - first :])
        progress(min(start + size, total))
    seconds = time.perf_counter() - began
    compiling = _CLOCK.since(began)
    scene = job.scene.settled(job.state, job.ts[0])
    trajectory = polhode.Trajectory(ts=job.ts, scene=scene, propagator=piece.propagator, **kept)
    crossings = {name: _padded(rows) for name, rows in times.items()}
    return Outcome(trajectory, residuals, crossings, compiling, seconds - compiling)


def _padded(rows: list[np.ndarray]) -> np.ndarray:
    """Rows of times, infinite where there is none, as one array with NaN there."""
    width = max(int(np.isfinite(row).sum()) for row in rows)
    padded = np.full((len(rows), width), np.nan)
    for place, row in zip(padded, rows):
        row = row[np.isfinite(row)]
        place[: len(row)] = row
    return padded


def _index(job: Job, ts: np.ndarray) -> np.ndarray:
    """Where the times `ts` stand among all times."""
    if job.all_ts[0] < job.all_ts[-1]:
        return np.searchsorted(job.all_ts, ts)
    return len(job.all_ts) - 1 - np.searchsorted(job.all_ts[::-1], ts)


def _simulate(job: Job, part: slice | None) -> polhode.Trajectory:
    scene, state = job.scene, job.state
    if part is not None:
        if scene.inertia.batch_shape:
            inertia = jax.tree.map(lambda x: x[part], scene.inertia)
            scene = dataclasses.replace(scene, inertia=inertia)
        state = jax.tree.map(lambda x: x[part] if x.ndim > 1 else x, state)
    with blamed(job.file, ""):
        trajectory = polhode.simulate(
            scene, state, job.all_ts, job.method, rtol=job.rtol, throw=False
        )
    return jax.block_until_ready(trajectory)


def _require_nominal(status: np.ndarray) -> None:
    code = polhode.Status(int(np.reshape(status, -1)[0]))
    if code != polhode.Status.SUCCESSFUL:
        raise polhode.SimulationError(
            f"the nominal body did not finish: {code.explanation}", np.asarray(status)
        )


class Residuals(NamedTuple):
    """Observed against computed: rotation angle, rad (n,), and body rates, rad/s (n, 3)."""

    seconds: np.ndarray
    angle: np.ndarray
    rates: np.ndarray


def _residuals(job: Job, piece: polhode.Trajectory) -> Residuals | None:
    """The nominal body against the file's observations within the times; None without any."""
    seen = job.file.observations
    if seen is None:
        return None
    seconds = _within(seen.seconds, job.ts)
    rows = np.isin(seen.seconds.astype(seconds.dtype), seconds)
    at = _index(job, seconds)
    wxyz, omega = np.asarray(piece.wxyz), np.asarray(piece.omega_body)
    if job.batch_shape:
        wxyz, omega = wxyz[0], omega[0]
    observed = np.asarray(build_attitudes(seen.attitudes, job.ts.dtype))[rows]
    angle = np.asarray(rotation.angle_between(wxyz[at], observed))
    return Residuals(seconds, angle, seen.omega_body[rows] - omega[at])
