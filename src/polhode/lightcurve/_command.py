"""What ``polhode lightcurve FILE`` does."""

import json
from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from polhode._extras import imported
from polhode.lightcurve._data import LightCurve
from polhode.lightcurve._fit import fit_light_curve
from polhode.lightcurve._frequencies import Pairs, fourier_lattices, fourier_pairs
from polhode.lightcurve._hypotheses import meaning
from polhode.lightcurve._read import read_light_curve
from polhode.lightcurve._solutions import Fit


def figure(fit: Fit, *, number: int = 0, title: str = "") -> Any:
    """Data over solution ``number``, residuals, map of poles: a matplotlib figure."""
    from polhode.lightcurve._figure import figure as draw

    return draw(fit, number=number, title=title)


def table(fit: Fit) -> str:
    """The solutions, one a line, and what the light curve cannot show."""
    unit, per = ("d", 1.0) if fit.best.P_phi > 0.3 else ("min", 1440.0)
    lines = [
        f"  #  rms [mag]  odds     P_phi [{unit}]          P_psi [{unit}]          mode"
        "        moments              pole (lon, lat) [deg]"
    ]
    for k, s in enumerate(fit.solutions):
        moments = " : ".join(f"{m:.3f}" for m in s.moments)
        mirror = "" if s.mirror_of is None else f"  mirror of {s.mirror_of}"
        lines.append(
            f"{k:3d}  {s.rms:.4f}    {s.probability:7.1e}"
            f"  {s.P_phi * per:9.5g} +- {s.P_phi_std * per:7.2g}"
            f"  {s.P_psi * per:9.5g} +- {s.P_psi_std * per:7.2g}"
            f"  {s.mode.name:<10s}  {moments}  {s.pole[0]:6.1f} {s.pole[1]:+6.1f}"
            f" +- {s.pole_std:.1f}{mirror}"
        )
    return "\n".join([*lines, *(f"note: {note}" for note in fit.notes)])


def frequency_table(pairs: Pairs, count: int = 6, *, lines: bool = False) -> str:
    """Candidate pairs of frequencies, and what each would mean; ``lines``: of two of their sums."""
    if lines:
        text = ["  explained  line 1 [1/d]  line 2 [1/d]"]
        for a, b, part in list(zip(pairs.f_phi, pairs.f_psi, pairs.explained))[:count]:
            text.append(f"  {part:8.1%}  {a:12.5g}  {b:12.5g}")
        return "\n".join(text)
    text = ["  explained  f_phi [1/d]  f_psi [1/d]  meaning"]
    for a, b, part in list(zip(pairs.f_phi, pairs.f_psi, pairs.explained))[:count]:
        text.append(f"  {part:8.1%}  {a:11.5g}  {b:11.5g}  {meaning(a, b)}")
    return "\n".join(text)


def run(
    path: str | PathLike[str],
    *,
    vectors: str | PathLike[str] | None = None,
    output: str | PathLike[str] | None = None,
    trials: int = 40_000,
    max_frequency: float | None = None,
    floor: float = 0.03,
    seed: int = 0,
    say: Callable = print,
) -> Fit | None:
    """Read, fit, say the table, and write the figure and a JSON file beside each other.

    ``output``: path of the files without suffix (default: that of ``path``, in the current folder).
    Without directions to Sun and observer only the frequencies are listed, and None is returned.
    Raises what `read_light_curve` raises, and ValueError for a floor of 0 where errors are missing.
    """
    path = Path(path)
    name = Path(path.stem if output is None else output)
    picture, document = (name.with_name(name.name + suffix) for suffix in (".png", ".json"))
    curve = read(path, vectors, floor)
    return fitted(
        curve,
        path.name,
        picture,
        document,
        trials=trials,
        max_frequency=max_frequency,
        floor=floor,
        seed=seed,
        say=say,
    )


def read(
    path: str | PathLike[str], vectors: str | PathLike[str] | None, floor: float
) -> LightCurve:
    """The light curve of a file; ValueError where neither it nor the floor gives an error."""
    curve = read_light_curve(path, vectors)
    if not floor > 0 and curve.sun is not None and not np.all(curve.sigma > 0):
        raise ValueError(
            f"{path}: a floor of {floor:g} needs a positive error of every point (sigma), which the"
            " file does not give."
        )
    return curve


def fitted(
    curve: LightCurve,
    title: str,
    picture: Path,
    document: Path,
    *,
    say=print,
    max_frequency: float | None = None,
    trials: int,
    floor: float,
    seed: int,
) -> Fit | None:
    """Fit, say the table, and write the figure and the numbers; see `run`."""
    say(f"{title}: {curve.t.size} points, {len(curve.names)} groups, {np.ptp(curve.t):.4g} d")
    if curve.sun is None:
        pairs = fourier_pairs(
            curve.t, curve.magnitude, columns=curve.columns(np.inf)[0], max_frequency=max_frequency
        )
        lines = pairs.is_cut
        if lines:  # the square of the grid is too small: pairs of lines reach further
            pairs = fourier_lattices(
                curve.t, curve.magnitude, columns=curve.columns(np.inf)[0],
                max_frequency=max_frequency,
            )  # fmt: skip
        say(frequency_table(pairs, lines=lines))
        missing = "without vectors to Sun and observer no body can be fitted."
        for note in (*curve.notes, *pairs.warnings(), missing):
            say(f"note: {note}")
        return None
    imported("the figure of a light curve", "matplotlib", extra="plot")  # before the search
    fit = fit_light_curve(curve, trials=trials, max_frequency=max_frequency, floor=floor, seed=seed)
    say(frequency_table(fit.pairs, lines=True))
    say(table(fit))
    _write(fit, title, picture, document, say)
    return fit


def _write(fit: Fit, name: str, picture: Path, document: Path, say) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    from polhode import __version__
    from polhode.files._atomic import whole_file

    page = figure(fit, title=name)
    with whole_file(picture) as temporary:
        page.savefig(temporary, dpi=160, metadata={"Software": f"polhode {__version__}"})
    plt.close(page)

    def plain(value):
        return value.tolist() if isinstance(value, np.ndarray) else value

    listed = []
    for solution in fit.solutions:
        kept = {k: plain(v) for k, v in solution._asdict().items() if k not in ("model", "weights")}
        listed.append(kept | {"mode": solution.mode.name})
    contents = {"file": name, "polhode": __version__, "solutions": listed, "notes": fit.notes}
    with whole_file(document) as temporary:
        temporary.write_text(json.dumps(contents, indent=1) + "\n", encoding="utf-8")
    say(f"wrote {picture} and {document}")
