"""The verdict on a light curve, its PAR rating, and the agreement of resampled light curves."""

import enum
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from polhode.lightcurve._brightness import AbstractPhase
from polhode.lightcurve._convex import rotating_body
from polhode.lightcurve._data import LightCurve
from polhode.lightcurve._frequencies import Pairs
from polhode.lightcurve._nulls import (
    Linear,
    Model,
    Residuals,
    compare_models,
    noise,
    one_period,
    rotators,
    round_rotators,
    tumbler,
    two_periods,
)
from polhode.lightcurve._solutions import (
    EXCLUDED,
    Linearised,
    Solution,
    effective_correlation,
    same_periods,
)

_DECISIVE = 5.0  # required difference of ln Z: odds of 150 to 1
_FEW_POINTS = 36  # independent points below which no body of ten parameters is claimed
_MISFIT = 2.0  # ratio of residuals to the errors of the points from which no solution is certain
_AGREEMENT = 0.95  # part of the resampled curves in which the best periods must remain the best
# Resampled light curves, and the number of nights below which runs of points are resampled instead.
_RESAMPLED, _BLOCKS = 400, 5
_ELLIPSOIDS = 4  # rotating ellipsoids that are refined with a convex shape
_CYCLES = 3.0  # observed cycles of a single period below which its PAR rating is 1 instead of 2


class Verdict(enum.Enum):
    """Conclusion from a light curve. Only ``TUMBLING`` claims the periods of the best solution."""

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
    nulls = [noise(linear)]
    end = pairs.max_frequency
    if not np.isfinite(end):
        end = 2 * max(pairs.f_phi.max(), pairs.f_psi.max())
    series = one_period(linear, end)
    nulls += series
    if series:
        # periods of the two best series, and of the first four (few harmonics)
        best = sorted(series, key=lambda r: float(np.sum((r.values * linear.root) ** 2)))
        periods = dict.fromkeys(round(r.periods[0], 12) for r in (*best[:2], *series[:4]))
        ellipsoids = rotators(linear, list(periods)[:4], end)
        log_trials = series[0].log_trials
        nulls += [
            Residuals("one period, rotating ellipsoid", e.values, 6, log_trials, (e.period,))
            for e in ellipsoids[:1]
        ]
        starts = [e.parameters for e in ellipsoids[:_ELLIPSOIDS]]
        models = compare_models(linear, nulls, effective_correlation)
        series_best = max(models[1 : 1 + len(series)], key=lambda m: m.log_evidence)
        # further poles are tried only if a series explains the points better than noise does
        if starts and series_best.log_evidence > models[0].log_evidence:
            # A series of few harmonics may be the even harmonics of twice its period.
            starts += round_rotators([series_best.periods[0], 2 * series_best.periods[0]])
        points = curve.points(0.0, offset_sigma)
        for start in starts:
            body = rotating_body(linear, start, points, phase, limit)
            if np.isfinite(body.cost):
                period = 2 * np.pi / float(body.body.unknowns[0, 6])
                name = "one period, rotating convex body"
                nulls += [Residuals(name, body.values, body.parameters, log_trials, (period,))]
    return linear, nulls


def judge(
    linear: Linear,
    nulls: list[Residuals],
    pairs: Pairs,
    solutions: tuple[Solution, ...],
    *,
    reproduced: bool,
    limit: float,
    others: tuple[Solution, ...] = (),
    refined: tuple[Solution, ...] = (),
    linearised: Sequence[Linearised] | None = None,
) -> Judgement:
    """The verdict, by comparison of the null hypotheses with the best tumbling body.

    ``others``: more bodies to compare, such as the best ellipsoid, which has fewer parameters;
    ``refined``: the same bodies after a fit of a convex shape, with odds relative to the best
    solution; ``linearised``: models of the solutions, for fits to resampled light curves.
    """
    curve = linear.curve
    best = solutions[0]
    everything = [*nulls, *two_periods(linear, pairs, solutions)]
    # The evidence penalises parameters, which the order of the solutions ignores.
    possible = [s for s in solutions[1:] if s.probability > EXCLUDED]
    everything += [tumbler(linear, pairs, body) for body in (best, *others, *possible)]
    models = compare_models(linear, everything, effective_correlation)
    classes = same_periods(solutions, pairs.resolution)
    agreement = bootstrap_agreement(curve, linear.root, solutions, classes, limit, linearised)
    silent, single, double, body = (
        _best_of(models, word) for word in ("noise", "one period", "two periods", "tumbling")
    )
    listed = tuple(m for m in (silent, single, double, body) if m is not None)
    assert silent is not None  # noise and a tumbling body are always fitted
    assert body is not None
    # the model of ``best``, even if another body has a higher evidence
    own = models[len(models) - 1 - len(others) - len(possible)]
    null = max(m.log_evidence for m in (silent, single) if m is not None)
    two = max(m.log_evidence for m in (double, body) if m is not None)
    more = two - null  # log-evidence of two periods over one or none
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
    elif double is not None and body.log_evidence - double.log_evidence < _DECISIVE:
        # only a body determines which sums of its frequencies the lines of the series are
        reasons.append(
            "No tumbling body explains the points decisively better than a series of two periods:"
            f" ln Z {body.log_evidence - double.log_evidence:+.1f}, {_DECISIVE:g} are needed."
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
    # An ellipsoid has too few parameters for other bodies; a convex shape has many, which can
    # compensate a wrong motion. Where the two disagree, the convex shape must be far more probable.
    if any(_odds_of(each, solutions, refined, pairs.resolution) > EXCLUDED**2 for each in others):
        reasons.append(
            "The best ellipsoid has other periods or another mode than the best convex body:"
            " the assumption on the shape decides."
        )
    if agreement < _AGREEMENT:
        reasons.append(
            f"The best periods stay the best in {agreement:.0%} of resampled light curves only;"
            f" {_AGREEMENT:.0%} are needed."
        )
    if not reproduced:
        reasons.append("No second search found the best body again.")
    reasons += pairs.warnings()
    if not reasons:
        poles = {s.mirror_of for s in solutions if s.probability > EXCLUDED}
        unique = len([s for s in solutions if s.probability > EXCLUDED]) == 1 and len(poles) == 1
        return result(Verdict.TUMBLING, -4 if unique else -3)
    return result(Verdict.AMBIGUOUS, -2 if single_rejected else -1)


def _odds_of(
    ellipsoid: Solution,
    solutions: tuple[Solution, ...],
    refined: tuple[Solution, ...],
    resolution: float,
) -> float:
    """Odds of convex bodies with the motion of an ellipsoid; 0 if that is the best motion.

    The list of solutions is limited and may lack such bodies. ``refined``, the ellipsoid after a
    fit of a convex shape, therefore counts as well, unless its fit reached the best motion. 1 if
    there is no such body.
    """

    def same_motion(one: Solution, other: Solution) -> bool:
        return same_periods((one, other), resolution) == [0, 0]

    if same_motion(ellipsoid, solutions[0]):
        return 0.0
    odds = [s.probability for s in solutions if same_motion(s, ellipsoid)]
    odds += [0.0 if same_motion(s, solutions[0]) else s.probability for s in refined]
    return max(odds, default=1.0)


def _best_of(models: tuple[Model, ...], word: str) -> Model | None:
    candidates = [m for m in models if m.name.startswith(word)]
    return max(candidates, key=lambda m: m.log_evidence) if candidates else None


def bootstrap_agreement(
    curve: LightCurve,
    root: np.ndarray,
    solutions: tuple[Solution, ...],
    classes: list[int],
    limit: float,
    linearised: Sequence[Linearised] | None = None,
    count: int = _RESAMPLED,
) -> float:
    """Part of ``count`` resampled light curves in which the best periods remain the best.

    Nights are drawn with replacement, or runs of points where there are few nights. First the
    points' contributions to the cost of every solution are summed, without new fits (RELL
    bootstrap: Kishino, Miyata & Hasegawa, J. Mol. Evol. 31 (1990) 151). With ``linearised`` the
    solutions with odds above 1 in a million are also fitted again to every resampled light curve,
    by one Gauss-Newton step. The smaller of the two parts is returned. The cost of the priors,
    which the order of the solutions includes, is the same in all light curves.
    """
    if len(set(classes)) < 2:
        return 1.0
    names, block = np.unique(curve.group, return_inverse=True)
    if len(names) < _BLOCKS:
        block = np.arange(curve.t.size) * 20 // curve.t.size
    many = int(block.max()) + 1
    rng = np.random.default_rng(0)
    weight = rng.multinomial(many, np.full(many, 1 / many), count).astype(float)
    number = np.array(classes)
    # residuals over the errors, scaled so that those of the best solution have a deviation of 1
    rest = np.array([(s.model - curve.magnitude) * root for s in solutions])
    rest = rest / _scale_of(rest[0])
    blocks = np.stack([np.bincount(block, c) for c in _robust_cost(rest, limit)])
    prior = np.zeros(len(solutions))
    if linearised is not None:
        scale = _scale_of(linearised[0].residuals)
        prior = np.array([each.prior_cost for each in linearised]) / scale**2
    cost = blocks @ weight.T + prior[:, None]
    agreement = float(np.mean(number[np.argmin(cost, axis=0)] == number[0]))
    # Less probable solutions have often not converged, and the linear model then overestimates the
    # gain of the step: one with odds of 1e-10 would win in most resampled light curves.
    possible = [k for k, s in enumerate(solutions) if s.probability > EXCLUDED**2]
    if linearised is None or len(set(number[possible])) < 2:
        return agreement
    cost = [_refitted_cost(linearised[k], block, weight, scale, limit) + prior[k] for k in possible]
    best = number[possible][np.argmin(cost, axis=0)]
    return min(agreement, float(np.mean(best == number[0])))


def _scale_of(residuals: np.ndarray) -> float:
    return max(1.4826 * float(np.median(np.abs(residuals))), 1e-12)


def _robust_cost(residuals: np.ndarray, limit: float) -> np.ndarray:
    squared = residuals**2
    return 2 * squared / (1 + np.sqrt(1 + squared / limit**2))


def _refitted_cost(
    solution: Linearised, block: np.ndarray, weight: np.ndarray, scale: float, limit: float
) -> np.ndarray:
    """Costs (r,) of a solution fitted again to blocks of points with ``weight`` (r, blocks)."""
    residuals, derivatives = solution.residuals / scale, solution.derivatives / scale
    prior, gradient = solution.prior / scale**2, solution.gradient / scale**2
    robust = 1 / np.sqrt(1 + (residuals / limit) ** 2)
    many = weight.shape[1]
    # The normal equations are computed for each block: those of a resampled light curve are then a
    # weighted sum of ``many`` matrices, not another pass over the points.
    rows = derivatives * robust[:, None]
    parts = [block == k for k in range(many)]
    matrices = np.array([rows[part].T @ derivatives[part] for part in parts])
    rights = np.array([rows[part].T @ residuals[part] for part in parts])
    # the diagonal term keeps the matrix regular: offsets of nights not drawn are undetermined
    size = np.diag(matrices.sum(0) + prior)
    jitter = np.diag(np.where(size > 0, 1e-9 * size, 1.0))
    weight = np.vstack([np.ones(many), weight])
    matrix = np.einsum("rb,bij->rij", weight, matrices) + prior + jitter
    step = -np.linalg.solve(matrix, (weight @ rights + gradient)[..., None])[..., 0]
    cost = np.array(
        [
            _robust_cost(residuals[part][:, None] + derivatives[part] @ step.T, limit).sum(0)
            for part in parts
        ]
    )
    cost = np.einsum("rb,br->r", weight, cost)
    cost += np.einsum("ri,ij,rj->r", step, prior, step) + 2 * step @ gradient
    # A solution that has not converged would gain by the step with the original weights as well,
    # but only by the linear model, which was not checked: this gain is subtracted.
    return cost[1:] - cost[0] + _robust_cost(residuals, limit).sum()
