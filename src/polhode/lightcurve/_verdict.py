"""What may be claimed of a light curve: a verdict, the PAR rating, and agreement by resampling."""

import enum
from typing import NamedTuple

import numpy as np

from polhode.lightcurve._data import LightCurve
from polhode.lightcurve._frequencies import Pairs
from polhode.lightcurve._nulls import (
    Linear,
    Model,
    Residuals,
    compared,
    noise,
    one_period,
    rotator,
    tumbler,
    two_periods,
)
from polhode.lightcurve._phase import AbstractPhase
from polhode.lightcurve._refine import rotating_body
from polhode.lightcurve._solutions import EXCLUDED, Solution, likeness, same_periods

_DECISIVE = 5.0  # difference of ln Z: odds of 150 to 1
_FEW_POINTS = 36  # independent points below which no body of ten parameters is claimed
_MISFIT = 2.0  # residuals over the curve's own errors from which no solution is certain
_AGREEMENT = 0.9  # part of the resampled curves in which the best periods must stay the best
_RESAMPLED, _BLOCKS = 400, 5
_CYCLES = 3.0  # of one period, below which its rating is the lowest


class Verdict(enum.Enum):
    """What a light curve shows. Only ``TUMBLING`` claims the periods of the best solution."""

    TUMBLING = "tumbling"
    AMBIGUOUS = "ambiguous"
    ONE_PERIOD = "one period"
    NO_SIGNAL = "no signal"
    TOO_FEW_POINTS = "too few points"


class Judgement(NamedTuple):
    """The verdict, its reasons, and the numbers behind them."""

    verdict: Verdict
    reasons: tuple[str, ...]
    par: int
    models: tuple[Model, ...]
    misfit: float
    agreement: float


def null_models(
    curve: LightCurve, pairs: Pairs, offset_sigma, phase: AbstractPhase, limit: float = 3.0
) -> tuple[Linear, list[Residuals]]:
    """The null hypotheses, fitted: noise alone, and one period."""
    linear = Linear(curve, offset_sigma)
    found = [noise(linear)]
    end = pairs.max_frequency
    if not np.isfinite(end):
        end = 2 * max(pairs.f_phi.max(), pairs.f_psi.max())
    series = one_period(linear, end)
    found += series
    if series:
        # the periods of the best series of few and of many harmonics
        best = sorted(series, key=lambda r: float(np.sum((r.values * linear.root) ** 2)))
        periods = dict.fromkeys(round(r.periods[0], 12) for r in (*best[:2], *series[:4]))
        ellipsoid = rotator(linear, list(periods)[:4], end)
        if ellipsoid is not None:
            rest, chosen = ellipsoid
            points = curve.points(0.0, offset_sigma)
            body = rotating_body(linear, chosen, points, phase, limit)
            period = 2 * np.pi / float(body.body.unknowns[0, 6])
            convex = rest._replace(
                name="one period, rotating convex body", values=body.values,
                parameters=body.parameters, periods=(period,),
            )  # fmt: skip
            found += [rest] + ([convex] if np.isfinite(body.cost) else [])
    return linear, found


def judged(
    linear: Linear,
    nulls: list[Residuals],
    pairs: Pairs,
    solutions: tuple[Solution, ...],
    *,
    found_again: bool,
    limit: float,
    others: tuple[Solution, ...] = (),
) -> Judgement:
    """Compare the null hypotheses with the best tumbling body, and say what may be claimed.

    ``others``: more bodies to compare, such as the best ellipsoid, which has fewer parameters.
    """
    curve = linear.curve
    best = solutions[0]
    everything = [*nulls, *two_periods(linear, pairs, solutions)]
    everything += [tumbler(linear, pairs, body) for body in (best, *others)]
    models = compared(linear, everything, likeness)
    classes = same_periods(solutions, pairs.resolution)
    agreement = resampled(curve, linear.root, solutions, classes, limit)
    silent, single, double, body = (
        _best_of(models, word) for word in ("noise", "one period", "two periods", "tumbling")
    )
    listed = tuple(m for m in (silent, single, double, body) if m is not None)
    assert silent is not None  # both are always fitted
    assert body is not None
    own = models[len(models) - 1 - len(others)]  # the best of the list, whatever its evidence
    null = max(m.log_evidence for m in (silent, single) if m is not None)
    two = max(m.log_evidence for m in (double, body) if m is not None)
    more = two - null  # of two periods over one or none
    reasons: list[str] = []

    def result(verdict: Verdict, par: int) -> Judgement:
        return Judgement(verdict, tuple(reasons), par, listed, own.misfit, agreement)

    if linear.independent < _FEW_POINTS:
        reasons.append(
            f"{linear.independent} points besides the offsets are too few for a body of ten"
            f" parameters; {_FEW_POINTS} are needed."
        )
        return result(Verdict.TOO_FEW_POINTS, 0)
    other = max(m.log_evidence for m in (single, double, body) if m is not None)
    if silent.log_evidence > other - _DECISIVE and silent.misfit < _MISFIT:
        reasons.append(
            "No model explains the points decisively better than noise: ln Z"
            f" {other - silent.log_evidence:+.1f} over noise alone, {_DECISIVE:g} are needed."
        )
        return result(Verdict.NO_SIGNAL, 0)
    if single is not None and more < -_DECISIVE:
        if single.misfit < _MISFIT:
            period = single.periods[0]
            cycles = float(linear.t[-1]) / period
            reasons.append(
                f"One period, {period:.6g} d ({24 * period:.5g} h) or a multiple or alias of it,"
                f" explains the points: ln Z {-more:+.1f} over two periods."
            )
            return result(Verdict.ONE_PERIOD, 1 if cycles < _CYCLES else 2)
        reasons.append(
            f"One period is the best model, but leaves {single.misfit:.1f} times the errors of the"
            " points."
        )
    elif more < _DECISIVE:
        reasons.append(
            f"Two periods are not decisively better than one: ln Z {more:+.1f}, {_DECISIVE:g} are"
            " needed."
        )
    single_rejected = more >= _DECISIVE
    if single_rejected and body.log_evidence - null < _DECISIVE:
        reasons.append(
            "A series of two periods explains the points, but no tumbling body that was found does."
        )
    if own.misfit >= _MISFIT:
        reasons.append(
            f"The best body leaves {own.misfit:.1f} times the errors of the points; no solution"
            f" is certain from {_MISFIT:g} on."
        )
    rivals = len({c for c, s in zip(classes, solutions, strict=True) if s.probability > EXCLUDED})
    if rivals > 1:
        reasons.append(
            f"{rivals - 1} other pair(s) of periods cannot be excluded at 1 in"
            f" {round(1 / EXCLUDED)}."
        )
    if any(same_periods((best, other), pairs.resolution) != [0, 0] for other in others):
        reasons.append(
            "The best ellipsoid has other periods or another mode than the best convex body: the"
            " assumption on the shape decides."
        )
    if agreement < _AGREEMENT:
        reasons.append(
            f"The best periods stay the best in {agreement:.0%} of resampled light curves only;"
            f" {_AGREEMENT:.0%} are needed."
        )
    if not found_again:
        reasons.append("No second search found the best body again.")
    reasons += pairs.warnings()
    if not reasons:
        poles = {s.mirror_of for s in solutions if s.probability > EXCLUDED}
        unique = len([s for s in solutions if s.probability > EXCLUDED]) == 1 and len(poles) == 1
        return result(Verdict.TUMBLING, -4 if unique else -3)
    return result(Verdict.AMBIGUOUS, -2 if single_rejected else -1)


def _best_of(models: tuple[Model, ...], word: str) -> Model | None:
    kept = [m for m in models if m.name.startswith(word)]
    return max(kept, key=lambda m: m.log_evidence) if kept else None


def resampled(
    curve: LightCurve,
    root: np.ndarray,
    solutions: tuple[Solution, ...],
    classes: list[int],
    limit: float,
    count: int = _RESAMPLED,
) -> float:
    """Part of ``count`` resampled light curves in which the best periods stay the best.

    Nights are drawn with replacement, or runs of points where there are few nights, and the
    contributions of the points to the cost of every solution are added anew (RELL bootstrap:
    Kishino, Miyata & Hasegawa, J. Mol. Evol. 31 (1990) 151); the bodies are not fitted again.
    """
    if len(set(classes)) < 2:
        return 1.0
    # residuals over the errors that make the best solution fit
    rest = np.array([(s.model - curve.magnitude) * root for s in solutions])
    rest = rest / max(1.4826 * float(np.median(np.abs(rest[0]))), 1e-12)
    cost = 2 * limit**2 * (np.sqrt(1 + (rest / limit) ** 2) - 1)
    names, block = np.unique(curve.group, return_inverse=True)
    if len(names) < _BLOCKS:
        block = np.arange(curve.t.size) * 20 // curve.t.size
    blocks = np.stack([np.bincount(block, c) for c in cost])
    rng = np.random.default_rng(0)
    weight = rng.multinomial(blocks.shape[1], np.full(blocks.shape[1], 1 / blocks.shape[1]), count)
    best = np.argmin(blocks @ weight.T, axis=0)
    return float(np.mean(np.array(classes)[best] == classes[0]))
