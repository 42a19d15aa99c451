"""The table that `polhode run` prints."""

from typing import NamedTuple

import numpy as np

import polhode
from polhode._closed_forms import Mode
from polhode.cli._job import Job, Outcome, Residuals
from polhode.files._error import visible
from polhode.plot._samples import Scale

MEANINGS = {
    "P_psi": "turn about long axis",
    "P_phi": "mean precession",
}


class Figures(NamedTuple):
    """Figures of merit of a run; `periods` name -> (bodies,) s, empty unless the body is free."""

    periods: dict[str, np.ndarray]
    modes: list[str]
    energy: float | None
    momentum: float | None


def measure(job: Job, outcome: Outcome) -> Figures:
    """Periods of every body; the largest change of energy and of angular momentum in space.

    Energy is given where no torque and no motor works on the body, momentum where nothing acts.
    """
    scene, trajectory = job.scene, outcome.trajectory
    energy = momentum = None
    periods, modes = {}, []
    if scene.torque is None and scene.rotors is None:
        energies = np.asarray(trajectory.energy, np.float64)
        rates, own = trajectory.omega_body, trajectory.momentum_body
        kinetic = np.sum(np.asarray(rates, float) * np.asarray(own, float), axis=-1) / 2
        scale = np.abs(kinetic).max(axis=-1, keepdims=True)
        energy = _largest((energies - energies[..., :1]) / np.where(scale > 0, scale, 1))
    if scene.is_free:
        vector = np.asarray(trajectory.momentum_space, np.float64)
        size = np.linalg.norm(vector[..., :1, :], axis=-1)
        change = np.linalg.norm(vector - vector[..., :1, :], axis=-1)
        momentum = _largest(change / np.where(size > 0, size, 1))
        found = polhode.periods(scene.inertia, job.state)
        periods = {name: np.atleast_1d(np.asarray(getattr(found, name))) for name in MEANINGS}
        modes = [Mode(int(code)).name for code in np.atleast_1d(np.asarray(found.mode))]
    return Figures(periods, modes, energy, momentum)


def _largest(relative: np.ndarray) -> float:
    return float(np.nanmax(np.abs(relative))) if np.isfinite(relative).any() else float("nan")


def table(job: Job, outcome: Outcome, figures: Figures):
    """The summary as a rich Table."""
    from rich.table import Table
    from rich.text import Text

    file, bodies = job.file, job.bodies
    unit, size = file.times.unit, file.times.unit_seconds
    clones = bodies - 1
    grid = Table(
        title=Text(visible(file.title), style="bold"),
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
        grid.add_row(*map(Text, cells))  # Text: brackets are units here, not markup

    if figures.periods:
        for name, meaning in MEANINGS.items():
            values = figures.periods[name] / size
            row(f"{name}  {meaning} [{unit}]", f"{values[0]:#.5g}", _spread(values[1:]),
                _published(file, name, size))  # fmt: skip
        row("mode", figures.modes[0], _count(figures.modes[1:]))
    for name, times in outcome.events.items():
        count, first = np.isfinite(times).sum(axis=1), times[:, 0] / size if times.size else times
        nominal = f"{first[0]:#.5g} ({count[0]})" if count[0] else "none"
        row(f"event {name}: first [{unit}] (number)", nominal, _reached(first[1:], count[1:]))
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


def _reached(first: np.ndarray, count: np.ndarray) -> str:
    """Mean and spread of the first times of the clones that have one."""
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
    found = [value for value in file.published if value.name == name]
    return "; ".join(
        _plus_minus(value.value / size, value.uncertainty and value.uncertainty / size)
        for value in found
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
    return Text("\n".join(map(visible, lines)))
