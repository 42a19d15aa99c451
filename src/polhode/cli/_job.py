"""The computation of `polhode run`: the bodies of a scene file in chunks, and the summary."""

import dataclasses
import os
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

import polhode
from polhode import rotation
from polhode._closed_forms import Mode
from polhode.files import (
    SceneFile,
    build_attitudes,
    build_events,
    build_method,
    build_scene,
    draw_clones,
)
from polhode.files._read import escape, scene_errors
from polhode.inertia import Inertia, VariableInertia
from polhode.inertia._inertia import inertia_at
from polhode.plot._samples import Scale

MEANINGS = {
    "P_psi": "turn about long axis",
    "P_phi": "mean precession",
}
_CHUNKS, _MIN_CHUNK = 20, 50  # number of chunks, for progress, and least bodies of a chunk


class Job(NamedTuple):
    """A scene ready to run; body 0 is the nominal one.

    `all_ts` merges the sample times `ts` and the times of the observations within their span, so
    that one compiled program computes both.
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
        return np.broadcast_shapes(lead, self.inertia.batch_shape)

    @property
    def inertia(self) -> Inertia:
        """The inertia at the first time."""
        return inertia_at(self.scene.inertia, self.ts[0])


class Outcome(NamedTuple):
    """The trajectory of all bodies, the residuals of the nominal one, the event times [s] by name
    (bodies, M), padded with NaN, and the durations of compilation and simulation [s].
    """

    trajectory: polhode.Trajectory
    residuals: "Residuals | None"
    events: dict[str, np.ndarray]
    compile_seconds: float
    run_seconds: float


def prepare(file: SceneFile, precision: str) -> Job:
    """Build the scene in this precision. Enables ``jax_enable_x64`` for the process."""
    jax.config.update("jax_enable_x64", True)
    dtype = np.dtype(precision)
    _require_memory(file, dtype.itemsize)
    clones = draw_clones(file, dtype)
    ts = file.times.seconds.astype(dtype)
    observed = ()
    if file.observations is not None:
        observed = _within(file.observations.seconds, ts)
    all_ts = np.unique(np.concatenate([ts, np.asarray(observed, dtype)]))
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
    """MemoryError for a scene that exceeds the memory, before the system kills the process."""
    bodies = 1 if file.monte_carlo is None else file.monte_carlo.clones + 1
    # attitude, rates, energy and momentum of every sample (11 numbers), twice: a copy for writing
    required = 2 * 11 * itemsize * bodies * len(file.times.seconds)
    try:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return
    if required > memory:
        raise MemoryError(
            f"{bodies:,} bodies at {len(file.times.seconds):,} times take {required / 1e9:,.1f} GB,"
            f" this machine has {memory / 1e9:,.1f} GB"
        )


def _within(seconds: np.ndarray, ts: np.ndarray) -> np.ndarray:
    """The observation times within the simulated span, in the dtype of `ts`."""
    seconds = seconds.astype(ts.dtype)
    return seconds[(seconds >= ts.min()) & (seconds <= ts.max())]


class _CompileClock:
    """The time during which JAX was tracing or compiling: the union of the reported intervals,
    because the interval of a nested function is contained in that of the outer one.
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
    """Simulate all bodies in chunks; `progress` is called with the number of finished bodies.

    Raises SimulationError if the nominal body does not finish; the trajectory's `status` reports
    clones that do not.
    """
    start_time = time.perf_counter()
    total = job.bodies
    size = min(total, max(_MIN_CHUNK, -(-total // _CHUNKS)))
    arrays: dict[str, np.ndarray] = {}
    residuals = None
    sample_of_times = _index(job, job.ts)
    events = build_events(job.file, job.ts.dtype)
    times: dict[str, list[np.ndarray]] = {name: [] for name in events}
    for start in range(0, total, size):
        # the last chunk overlaps the one before, so that all have one shape
        first = min(start, total - size)
        piece = _simulate(job, slice(first, first + size) if job.batch_shape else None)
        if start == 0:
            _require_nominal(np.asarray(piece.status))
            residuals = _residuals(job, piece)
        recorded = ("wxyz", "omega_body", *(() if piece._spins is None else ("spins",)))
        for name in (*recorded, "status", "steps"):
            part = np.asarray(getattr(piece, name))
            if name in recorded:
                part = part[..., sample_of_times, :]
            if not job.batch_shape:
                arrays[name] = part
                continue
            rows = arrays.setdefault(name, np.empty((total, *part.shape[1:]), part.dtype))
            rows[first : first + size] = part
        with scene_errors(job.file, "[[events]]"):
            for name, event in events.items():
                rows = np.atleast_2d(polhode.crossings(piece, event).times)
                times[name].extend(rows[start - first :])
        progress(min(start + size, total))
    seconds = time.perf_counter() - start_time
    compiling = _CLOCK.since(start_time)
    scene = job.scene.settled(job.state, job.ts[0])
    trajectory = polhode.Trajectory(ts=job.ts, scene=scene, propagator=piece.propagator, **arrays)
    crossings = {name: _pad(rows) for name, rows in times.items()}
    return Outcome(trajectory, residuals, crossings, compiling, seconds - compiling)


def _pad(rows: list[np.ndarray]) -> np.ndarray:
    """Rows of event times, padded with infinity, as one array padded with NaN."""
    width = max(int(np.isfinite(row).sum()) for row in rows)
    padded = np.full((len(rows), width), np.nan)
    for place, row in zip(padded, rows):
        row = row[np.isfinite(row)]
        place[: len(row)] = row
    return padded


def _index(job: Job, ts: np.ndarray) -> np.ndarray:
    """Indices of the times `ts` in `job.all_ts`."""
    if job.all_ts[0] < job.all_ts[-1]:
        return np.searchsorted(job.all_ts, ts)
    return len(job.all_ts) - 1 - np.searchsorted(job.all_ts[::-1], ts)


def _simulate(job: Job, part: slice | None) -> polhode.Trajectory:
    scene, state = job.scene, job.state
    if part is not None:
        if job.inertia.batch_shape:
            inertia = jax.tree.map(lambda x: x[part], scene.inertia)
            scene = dataclasses.replace(scene, inertia=inertia)
        state = jax.tree.map(lambda x: x[part] if x.ndim > 1 else x, state)
    with scene_errors(job.file, ""):
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
    """Differences between observation and simulation at `seconds`: rotation angle [rad] (n,), and
    body rates [rad/s] (n, 3)."""

    seconds: np.ndarray
    angle: np.ndarray
    rates: np.ndarray


def _residuals(job: Job, piece: polhode.Trajectory) -> Residuals | None:
    """Residuals of the nominal body at the observations within the span; None without any."""
    observations = job.file.observations
    if observations is None:
        return None
    seconds = _within(observations.seconds, job.ts)
    rows = np.isin(observations.seconds.astype(seconds.dtype), seconds)
    at = _index(job, seconds)
    wxyz, omega = np.asarray(piece.wxyz), np.asarray(piece.omega_body)
    if job.batch_shape:
        wxyz, omega = wxyz[0], omega[0]
    observed = np.asarray(build_attitudes(observations.attitudes, job.ts.dtype))[rows]
    angle = np.asarray(rotation.angle_between(wxyz[at], observed))
    return Residuals(seconds, angle, observations.omega_body[rows] - omega[at])


class Figures(NamedTuple):
    """Figures of merit of a run; `periods`: name -> (bodies,) [s], empty unless torque-free."""

    periods: dict[str, np.ndarray]
    modes: list[str]
    energy: float | None
    momentum: float | None


def _has_orbit(scene: polhode.Scene) -> bool:
    def is_orbit(x):
        return isinstance(x, polhode.AbstractOrbit)

    return any(map(is_orbit, jax.tree.leaves(scene.potential, is_leaf=is_orbit)))


def measure(job: Job, outcome: Outcome) -> Figures:
    """Periods of every body; the largest relative changes of energy and momentum in space.

    These only for conserved quantities: energy without torques, rotors, a variable inertia and an
    orbit, momentum of torque-free bodies.
    """
    scene, trajectory = job.scene, outcome.trajectory
    energy = momentum = None
    periods, modes = {}, []
    constant = not isinstance(scene.inertia, VariableInertia)
    if scene.torque is None and scene.rotors is None and constant and not _has_orbit(scene):
        energies = np.asarray(trajectory.energy, np.float64)
        rates, momenta = trajectory.omega_body, trajectory.momentum_body
        kinetic = np.sum(np.asarray(rates, float) * np.asarray(momenta, float), axis=-1) / 2
        scale = np.abs(kinetic).max(axis=-1, keepdims=True)
        energy = _largest((energies - energies[..., :1]) / np.where(scale > 0, scale, 1))
    if scene.is_free:
        vector = np.asarray(trajectory.momentum_space, np.float64)
        size = np.linalg.norm(vector[..., :1, :], axis=-1)
        change = np.linalg.norm(vector - vector[..., :1, :], axis=-1)
        momentum = _largest(change / np.where(size > 0, size, 1))
        values = polhode.periods(scene.inertia, job.state)
        periods = {name: np.atleast_1d(np.asarray(getattr(values, name))) for name in MEANINGS}
        modes = [Mode(int(code)).name for code in np.atleast_1d(np.asarray(values.mode))]
    return Figures(periods, modes, energy, momentum)


def _largest(relative: np.ndarray) -> float:
    return float(np.nanmax(np.abs(relative))) if np.isfinite(relative).any() else float("nan")


def summary_table(job: Job, outcome: Outcome, figures: Figures):
    """The summary as a rich Table."""
    from rich.table import Table
    from rich.text import Text

    file, bodies = job.file, job.bodies
    unit, size = file.times.unit, file.times.unit_seconds
    clones = bodies - 1
    grid = Table(
        title=Text(escape(file.title), style="bold"),
        title_justify="left",
        caption=_caption(job),
        caption_justify="left",
        show_edge=False,
        pad_edge=False,
    )
    grid.add_column("")
    grid.add_column("nominal", justify="right")
    if clones:
        grid.add_column(f"{clones:,} clones", justify="right")
    if file.published:
        grid.add_column("published", justify="right")

    def row(name, nominal, spread="", published=""):
        cells = [name, nominal]
        cells += [spread] if clones else []
        cells += [published] if file.published else []
        grid.add_row(*map(Text, cells))  # Text: the brackets of units are not markup

    if figures.periods:
        for name, meaning in MEANINGS.items():
            values = figures.periods[name] / size
            published = _published(file, name, size)
            nominal = f"{values[0]:#.5g}"
            row(f"{name}  {meaning} [{unit}]", nominal, _spread(values[1:]), published)
        row("mode", figures.modes[0], _count(figures.modes[1:]))
    for name, times in outcome.events.items():
        count, first = np.isfinite(times).sum(axis=1), times[:, 0] / size if times.size else times
        nominal = f"{first[0]:#.5g} ({count[0]})" if count[0] else "none"
        row(f"event {name}: first [{unit}] (number)", nominal, _first_times(first[1:], count[1:]))
    if figures.energy is not None:
        row("largest relative change of energy", f"{figures.energy:.1e}")
    if figures.momentum is not None:
        row("largest relative change of momentum", f"{figures.momentum:.1e}")
    for name, value in _misfits(outcome.residuals, Scale.of(np.ptp(file.times.seconds))):
        row(name, value)
    row("compilation [s]", f"{outcome.compile_seconds:.2f}")
    row("simulation [s]", f"{outcome.run_seconds:.2f}")
    return grid


def _spread(values: np.ndarray) -> str:
    finite = values[np.isfinite(values)]
    if not finite.size:
        return "infinite" if len(values) else ""
    text = _plus_minus(float(finite.mean()), float(finite.std()))
    endless = len(values) - finite.size
    return f"{text}, {endless:,} infinite" if endless else text


def _first_times(first: np.ndarray, count: np.ndarray) -> str:
    """Mean and standard deviation of the first event times of the clones with an event."""
    if not count.any():
        return "none"
    first = first[count > 0]
    text = _plus_minus(float(first.mean()), float(first.std()))
    return text if count.all() else f"{text}, {int((count == 0).sum()):,} none"


def _plus_minus(value: float, width: float | None) -> str:
    """Value ± width, the width with two digits and the value with as many decimals."""
    if not width:
        return f"{value:.5g}"
    text = f"{width:.2g}"
    if "e" in text:
        return f"{value:.8g} ± {text}"
    decimals = len(text.partition(".")[2])
    return f"{value:.{decimals}f} ± {text}"


def _count(modes: list[str]) -> str:
    return ", ".join(f"{modes.count(name):,} {name}" for name in sorted(set(modes)))


def _published(file, name: str, size: float) -> str:
    return "; ".join(
        _plus_minus(value.value / size, value.uncertainty and value.uncertainty / size)
        for value in file.published
        if value.name == name
    )


def _misfits(residuals: Residuals | None, scale: Scale):
    if residuals is None:
        return
    angle = np.degrees(residuals.angle[np.isfinite(residuals.angle)])
    if angle.size:
        yield f"median misfit, {angle.size} attitudes [deg]", f"{np.median(angle):.3g}"
    rates = np.linalg.norm(residuals.rates, axis=-1) / scale.radians_per_second
    rates = rates[np.isfinite(rates)]
    if rates.size:
        yield f"median misfit, {rates.size} rates [{scale.rate}]", f"{np.median(rates):.3g}"


def _caption(job: Job):
    from rich.text import Text

    file = job.file
    count = "1 body" if job.bodies == 1 else f"{job.bodies:,} bodies"
    lines = [f"{count}, {len(job.ts):,} samples, {job.ts.dtype}"]
    if file.published:
        sources = dict.fromkeys(value.source for value in file.published)
        lines.append(f"published: {'; '.join(sources)}")
    if file.monte_carlo is not None:
        lines.append("clones: mean ± standard deviation, drawn from the spread of")
        spreads = file.monte_carlo.spreads.items()
        lines += [f"  {quantity}: {spread.source}" for quantity, spread in spreads]
    if job.redrawn:
        lines.append(f"  {job.redrawn:,} draws had moments that no body has, and were drawn again")
    return Text("\n".join(map(escape, lines)))
