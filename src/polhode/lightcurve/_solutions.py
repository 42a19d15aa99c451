"""Solutions of a light curve, their uncertainties, and notes on what it cannot determine."""

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from polhode import rotation
from polhode._closed_forms import Mode, free_motion, principal_periods
from polhode.lightcurve._brightness import (
    AbstractPhase,
    Bodies,
    moments_of,
)
from polhode.lightcurve._data import LightCurve
from polhode.lightcurve._frequencies import LAM, SAM, Hypotheses, Pairs, sum_name
from polhode.lightcurve._least_squares import (
    BATCH,
    Problem,
    State,
    in_parts,
    light_and_derivatives,
    robust_equations,
    select,
)
from polhode.lightcurve._nulls import Model

if TYPE_CHECKING:
    from polhode.lightcurve._verdict import Verdict

# Chi-square per degree of freedom up to which a body explains a light curve.
REACHED = 1.3
_PART = 256  # bodies per call of the program that computes their periods
FIXED = 5.0  # deg: directions that change by less count as constant
EXCLUDED = 1e-3  # odds below which a solution is excluded


# Quantities of ``Solution.covariance``, in its order.
COVARIANCE_OF = (
    "P_phi",
    "P_psi",
    *(f"moments[{k}]" for k in range(3)),
    *(f"momentum_{x}" for x in "xyz"),
)


class Solution(NamedTuple):
    """A body that explains a light curve. Body axes: those of its shape and inertia."""

    P_phi: float  # time unit of the light curve [day]
    P_psi: float
    P_phi_std: float
    P_psi_std: float
    mode: Mode
    rms: float  # weighted, of the residuals [mag]
    cost: float  # robust chi-square, priors included
    probability: float  # odds exp(-(cost - best) / 2 / scale^2 / alike): 1 for the best
    moments: np.ndarray  # (3,) over the largest
    moments_std: np.ndarray  # (3,)
    axes: np.ndarray  # (3,) semi-axes over the longest
    pole: np.ndarray  # (2,) longitude and latitude of the angular momentum [deg]
    pole_std: float  # [deg], at most 98.2: that of a pole of which nothing is known
    wxyz: np.ndarray  # (4,) at t = 0, the first time
    omega_body: np.ndarray  # (3,) [rad / time unit]
    coefficients: np.ndarray  # of the phase function
    offsets: np.ndarray  # coefficients of ``LightCurve.columns`` [mag]
    model: np.ndarray  # (n,) magnitudes, offsets included
    weights: np.ndarray  # (n,) in [0, 1]: robust weight of each point
    mirror_of: int | None  # number of the solution whose mirror image this is
    # (k,) coefficients of the logarithm of the surface density over that of the ellipsoid; None: an
    # ellipsoid
    harmonics: np.ndarray | None = None
    # effective number that the points determine, not counting offsets and phase function
    parameters: float = 10.0
    epoch: float = 0.0  # time of ``wxyz`` and ``omega_body``, the first of the light curve
    covariance: np.ndarray | None = None  # (8, 8) in the order of ``COVARIANCE_OF``

    @property
    def P_phi_short_axis(self) -> float:
        """Precession period of the short axis: ``P_phi`` in the short-axis convention.

        1 / (1 / P_phi + 1 / P_psi), where P_phi and P_psi are those of the long-axis convention, as
        everywhere else; P_psi is the same in both (Samarasinha & A'Hearn, Icarus 93 (1991) 194).
        """
        return 1 / (1 / self.P_phi + 1 / self.P_psi)

    def to_damit(self, folder: str | PathLike[str], *, jd_of_zero: float = 0.0) -> Path:
        """Write ``tumbler.csv`` and ``shape.txt`` into a folder, as DAMIT describes a tumbler.

        The columns are those of the table of tumblers of DAMIT (astro.troja.mff.cuni.cz/projects/
        damit): lambda, beta, P_psi, P_phi, I1, I2, phi0, psi0, JD0, in degrees, hours and days;
        moments, angles and periods in the convention of Kaasalainen, Astron. Astrophys. 376 (2001)
        302, which the file states. The times of the light curve must be days since the Julian date
        ``jd_of_zero``, its directions ecliptic (J2000). ``shape.txt``: vertices and triangles of
        the ellipsoid. Returns the folder.

        Raises ValueError for a solution with a convex shape, or one that does not tumble,
        FileNotFoundError for a folder that does not exist.
        """
        from polhode.lightcurve._files import write_damit

        return write_damit(self, folder, jd_of_zero=jd_of_zero)

    def lines(self, count: int = 3) -> tuple[tuple[str, float], ...]:
        """Main spectral lines of this mode, with their periods: ``("2 f_phi", period)``."""
        sums = LAM if self.mode == Mode.LAM else SAM
        return tuple(
            (sum_name(i, j), 1 / (i / self.P_phi + j / self.P_psi)) for i, j in list(sums)[:count]
        )


class LightCurveFit(NamedTuple):
    """Result of ``fit_light_curve``: all distinct solutions, the best first, and a verdict."""

    solutions: tuple[Solution, ...]
    curve: LightCurve
    pairs: Pairs
    hypotheses: Hypotheses
    scale: float  # residuals of the best solution over the assumed errors
    alike: float  # number of correlated residuals that count as one; 1: independent
    # standard deviation of the groups' offsets [mag], requested or estimated; None: default
    offset_sigma: float | None
    notes: tuple[str, ...]  # limitations of this light curve
    verdict: "Verdict"
    reasons: tuple[str, ...]  # of the verdict
    # Principal-axis rotation rating in the manner of Pravec et al., Icarus 173 (2005) 108: from -4
    # (tumbling, with one physical model) through 0 (undecided) to 2 (one period explains all)
    par: int
    models: tuple[Model, ...]  # the best of each kind with its evidence, null hypotheses first
    misfit: float  # residuals of the best solution over the errors of the points, without floor
    agreement: float  # part of resampled light curves in which the best periods remain the best
    phase: AbstractPhase | None = None  # phase function of the ellipsoids

    @property
    def best(self) -> Solution:
        return self.solutions[0]


def frequencies(bodies: Bodies):
    """f_phi, f_psi and mode (b,) of bodies."""
    return in_parts(_periods, _PART, bodies)


def momentum(bodies: Bodies) -> np.ndarray:
    """Unit vectors of the angular momentum in space (b, 3)."""
    return in_parts(_momentum, _PART, bodies)


@jax.jit
def _periods(bodies: Bodies):
    periods = principal_periods(moments_of(bodies.unknowns), bodies.unknowns[:, 4:7])
    return 1 / periods.P_phi, 1 / periods.P_psi, periods.mode


@jax.jit
def _momentum(bodies: Bodies):
    body = jnp.stack(moments_of(bodies.unknowns), -1) * bodies.unknowns[:, 4:7]
    space = rotation.rotate(bodies.wxyz, body)
    return space / jnp.sqrt(jnp.sum(space**2, axis=-1, keepdims=True))


def _derived_quantities(x, wxyz):
    """ln P_phi, ln P_psi, moments over the largest, direction of the momentum in space: (8,)."""
    unknowns, turn = x[:-3], x[-3:]
    moments = moments_of(unknowns)
    omega = unknowns[4:7]
    periods = principal_periods(moments, tuple(omega))
    moments = jnp.stack(moments)
    attitude = rotation.multiply(rotation.rotation_vector_to_wxyz(turn), wxyz)
    momentum = rotation.rotate(attitude, moments * omega)
    return jnp.concatenate(
        [
            jnp.log(jnp.stack([periods.P_phi, periods.P_psi])),
            moments / jnp.max(moments),
            momentum / jnp.sqrt(jnp.sum(momentum**2)),
        ]
    )


@jax.jit
def _derivatives_of_derived(bodies: Bodies):
    no_turn = jnp.zeros((len(bodies.wxyz), 3))
    x = jnp.concatenate([bodies.unknowns, no_turn], axis=1)
    return jax.vmap(jax.jacfwd(_derived_quantities))(x, bodies.wxyz)


def derivatives_of_derived(bodies: Bodies) -> np.ndarray:
    """Derivatives (b, 8, u + 3) of ln P_phi, ln P_psi, moments and momentum's direction."""
    return in_parts(_derivatives_of_derived, BATCH, bodies)


class Linearised(NamedTuple):
    """Linear model of the residuals of a solution over their errors; offsets are unknowns too.

    The cost after a step x of the unknowns is the robust cost of ``residuals + derivatives @ x``
    plus that of the priors, ``x @ prior @ x + 2 gradient @ x + prior_cost``.
    """

    residuals: np.ndarray  # (n,)
    derivatives: np.ndarray  # (n, u)
    prior: np.ndarray  # (u, u)
    gradient: np.ndarray  # (u,)
    prior_cost: float = 0.0  # of the solution itself


class Described(NamedTuple):
    """Solutions, the best first, and statistics of their residuals."""

    solutions: tuple[Solution, ...]
    scale: float  # residuals of the best solution over the assumed errors
    alike: float  # number of correlated residuals that count as one
    linearised: tuple[Linearised, ...]  # of each solution
    # the best ellipsoid after a fit of a convex shape, even if it is not in the list
    refined_ellipsoid: Solution | None = None


def describe_solutions(
    problem: Problem, state: State, order, curve: LightCurve, normals, limit: float
) -> Described:
    """The bodies ``order`` of a state as solutions with errors."""
    n = curve.t.size
    index = np.pad(order, (0, -len(order) % BATCH), mode="edge")
    best = select(state, index)
    bodies = jax.tree.map(jnp.asarray, best.bodies)
    light, slopes = light_and_derivatives(problem.phase, bodies, problem.blocks)
    _, _, _, _, (value, robust, derivatives) = robust_equations(
        light,
        slopes,
        jnp.asarray(best.offsets),
        problem.points,
        # an array without a weak type, as in the search, so that no second program is compiled
        jnp.asarray(np.full(len(index), limit)),
    )
    model = np.asarray(value + best.offsets @ problem.points.columns)[:, :n]
    robust, weight = np.asarray(robust)[:, :n], np.asarray(problem.points.weight)[:, :n]
    rest = model - curve.magnitude
    root = np.sqrt(weight[0])
    prior_cost, prior, gradient = problem.prior(best.bodies, best.offsets)
    derivatives = np.asarray(derivatives)[: len(order), :, :n]
    linearised = tuple(
        Linearised(
            rest[k] * root, (derivatives[k] * root).T, prior, gradient[k], float(prior_cost[k])
        )
        for k in range(len(order))
    )
    freedom = max(n - best.matrix.shape[1] + int((problem.stiffness > 0).sum()), 1)
    scale = float(np.sqrt((robust[0] * weight[0] * rest[0] ** 2).sum() / freedom))
    alike = effective_correlation(curve, np.sqrt(robust[0] * weight[0]) * rest[0])
    f_phi, f_psi, mode = frequencies(best.bodies)
    pole = momentum(best.bodies)
    unknowns, wxyz = best.bodies
    slopes = derivatives_of_derived(best.bodies)
    count = slopes.shape[2]
    out = []
    for k in range(len(order)):
        covariance = np.linalg.pinv(best.matrix[k], hermitian=True)[:count, :count]
        spread = scale**2 * alike * slopes[k] @ covariance @ slopes[k].T
        std = np.sqrt(np.maximum(np.diag(spread), 0))
        images = 2 * normals * (normals @ pole[k])[:, None] - pole[k]
        mirror = [
            j
            for j in range(k)
            if mode[j] == mode[k]
            and out[j].mirror_of is None
            and abs(f_phi[j] / f_phi[k] - 1) + abs(f_psi[j] / f_psi[k] - 1) < 0.02
            and (images @ pole[j]).max() > np.cos(np.radians(20))
        ]
        moments = np.array(moments_of(unknowns[k]))
        axes = np.exp(np.r_[0.0, unknowns[k, 2:4]])
        out.append(
            Solution(
                1 / f_phi[k],
                1 / f_psi[k],
                std[0] / f_phi[k],
                std[1] / f_psi[k],
                Mode(int(mode[k])),
                float(np.sqrt(np.average(rest[k] ** 2, weights=weight[0]))),
                float(best.cost[k]),
                float(np.exp((best.cost[0] - best.cost[k]) / 2 / scale**2 / alike)),
                moments / moments.max(),
                std[2:5],
                axes / axes.max(),
                np.degrees(
                    [
                        np.arctan2(pole[k, 1], pole[k, 0]) % (2 * np.pi),
                        np.arcsin(np.clip(pole[k, 2], -1, 1)),
                    ]
                ),
                pole_std_of(std[5:]),
                wxyz[k],
                unknowns[k, 4:7],
                unknowns[k, 7:],
                best.offsets[k],
                model[k],
                robust[k],
                mirror[0] if mirror else None,
                epoch=float(curve.t[0]),
                covariance=covariance_of_periods(spread, f_phi[k], f_psi[k]),
            )
        )
    return Described(tuple(out), scale, alike, linearised)


def pole_std_of(std: np.ndarray) -> float:
    """Standard deviation of a pole [deg] from those of its unit vector (3,), by linear theory.

    At most the root mean square of the angle to a random direction, ``sqrt(pi^2 / 2 - 2)`` rad.
    """
    return float(np.degrees(min(np.linalg.norm(std), np.sqrt(np.pi**2 / 2 - 2))))


def covariance_of_periods(covariance: np.ndarray, f_phi: float, f_psi: float) -> np.ndarray:
    """The covariance of P_phi, P_psi, ... from that of ln P_phi, ln P_psi, ..."""
    size = np.r_[1 / f_phi, 1 / f_psi, np.ones(len(covariance) - 2)]
    return covariance * size * size[:, None]


def effective_correlation(curve: LightCurve, residuals: np.ndarray) -> float:
    """Number of correlated residuals (n,), over their errors, that count as one.

    It is the variance of their sum over that of independent ones, with the correlation rho^k of
    residuals k points apart within a run (one group, no gap over half a day). rho is the measured
    correlation of neighbours.
    """
    together = (np.diff(curve.group) == 0) & (np.diff(curve.t) < 0.5)
    a, b = residuals[:-1][together], residuals[1:][together]
    rho = (a @ b) / max(np.sqrt((a @ a) * (b @ b)), 1e-300)
    # less than two standard deviations above zero: treated as independent
    if rho < 2 / np.sqrt(max(a.size, 1)):
        return 1.0
    run = np.cumsum(np.r_[0, ~together])
    sizes = np.bincount(run)
    lags = np.arange(1, sizes.max())
    pairs = np.maximum(sizes[:, None] - lags, 0).sum(0)
    return float(1 + 2 * (pairs * rho**lags).sum() / residuals.size)


def same_periods(solutions, resolution: float) -> list[int]:
    """For each solution the index of the first one with its mode and periods.

    Frequencies agree if they differ by less than half of ``resolution`` (1/span).
    """
    out: list[int] = []
    for k, s in enumerate(solutions):
        first = k
        for j in range(k):
            other = solutions[j]
            off = max(abs(1 / s.P_phi - 1 / other.P_phi), abs(1 / s.P_psi - 1 / other.P_psi))
            if out[j] == j and s.mode == other.mode and off < 0.5 * resolution:
                first = j
                break
        out.append(first)
    return out


def change_of_directions(curve: LightCurve) -> float:
    """Greatest angle [deg] of the directions to Sun or observer from their means."""
    return max(
        np.degrees(np.arccos(np.clip((v @ v.mean(0) / np.linalg.norm(v.mean(0))).min(), -1, 1)))
        for v in curve._known_directions()
    )


def notes_on(curve: LightCurve, solutions, scale: float, alike: float) -> tuple[str, ...]:
    """Sentences on what this light curve cannot determine."""
    notes = list(curve.notes)
    sun, observer = curve._known_directions()
    directions = np.vstack([sun, observer])
    change = change_of_directions(curve)
    if change < FIXED:
        notes.append(
            f"Sun and observer keep their directions within {change:.1f} deg: every pole has a"
            " mirror image in their plane that fits as well, and the absolute size of the shape's"
            " axes along the momentum is hardly seen."
        )
    elif np.degrees(np.arcsin(np.linalg.svd(directions)[1][-1] / np.sqrt(len(directions)))) < 5:
        notes.append(
            "Sun and observer stay near one plane: poles mirrored in it fit nearly as well."
        )
    if np.degrees(curve.alpha.max()) < 3:
        notes.append(
            "All phase angles are below 3 deg: poles are known only up to a rotation"
            " about the line of sight."
        )
    span = np.ptp(curve.t)
    best = solutions[0]
    for name, period in (("P_phi", best.P_phi), ("P_psi", best.P_psi)):
        if span < 3 * period:
            notes.append(f"Fewer than three {name} were seen: it is uncertain beyond its error.")
    # If the last solution of the limited list is possible, further ones may be as well.
    least = "at least " if solutions[-1].probability > EXCLUDED else ""
    classes = same_periods(solutions, 1 / span)
    possible = [k for k, s in enumerate(solutions) if s.probability > EXCLUDED]
    others = len({classes[k] for k in possible} - {0})
    if others:
        notes.append(
            f"Ambiguous: {least}{others} other pair(s) of periods than the best cannot be excluded"
            " at 1 in 1000."
        )
    poles = sum(classes[k] == 0 and solutions[k].mirror_of is None for k in possible) - 1
    if poles:
        notes.append(
            f"The pole is ambiguous: {least}{poles} other body(ies) of the best periods, mirrors"
            " apart, cannot be excluded at 1 in 1000."
        )
    if scale**2 > REACHED:
        notes.append(
            f"Residuals are {scale:.1f} times the errors assumed: the model is incomplete, and"
            " errors follow from the residuals: they are uncertain by a factor of two."
        )
    if alike > 1:
        notes.append(
            f"Neighbouring residuals are alike: {alike:.1f} count as one in errors and odds."
        )
    return tuple(notes)


# Nights with a variable comparison star, or with errors that are too small, from their residuals.

_TREND = 5.0  # least trend of a night's residuals, in standard deviations, that is reported
_NOISY = 2.0  # least ratio of a night's scatter to that of the others that is reported
_NIGHT_POINTS = 8  # least number of points of a night for these tests


def notes_on_groups(curve: LightCurve, residuals: np.ndarray, alike: float) -> tuple[str, ...]:
    """Notes on groups whose residuals (n,) [mag] have a trend, or scatter too much.

    The residuals are those of the best body. The standard deviation of a trend follows from the
    scatter of all groups and from ``alike``, the number of residuals that count as one.
    """
    weighted = residuals / curve.sigma
    scale = 1.4826 * max(float(np.median(np.abs(weighted))), 1e-12)
    trends, noisy = [], []
    for k, name in enumerate(curve.names):
        own = curve.group == k
        if own.sum() < _NIGHT_POINTS or np.ptp(curve.t[own]) == 0:
            continue
        weight = curve.sigma[own] ** -2.0
        t, value = curve.t[own], residuals[own]
        t = t - np.average(t, weights=weight)
        value = value - np.average(value, weights=weight)
        slope = np.sum(weight * t * value) / np.sum(weight * t**2)
        error = scale * np.sqrt(alike / np.sum(weight * t**2))
        if abs(slope) > _TREND * error:
            trends.append(f"{name} ({slope * np.ptp(t):+.2f} mag)")
        trend_free = (value - slope * t) / curve.sigma[own]
        if 1.4826 * np.median(np.abs(trend_free - np.median(trend_free))) > _NOISY * scale:
            noisy.append(name)
    notes = []
    if trends:
        notes.append(
            f"The residuals of group(s) {', '.join(trends[:5])} have a trend from the first point"
            " to the last: a comparison star may vary, or the extinction is not corrected."
        )
    if noisy:
        notes.append(
            f"The residuals of group(s) {', '.join(noisy[:5])} scatter by more than"
            f" {_NOISY:g} times those of the others: give these points larger errors."
        )
    return tuple(notes)


def ellipsoid_of(solution: Solution) -> Bodies:
    """The ellipsoid and the motion of a solution, as unknowns of the model."""
    square = np.log(solution.moments.sum() / 2 - solution.moments) / 2
    axes = np.log(solution.axes)
    unknowns = np.r_[
        square[1:] - square[0], axes[1:] - axes[0], solution.omega_body, solution.coefficients
    ]
    return Bodies(unknowns[None], solution.wxyz[None])


def bodies_of(solutions: Sequence[Solution], epoch: float, phase: AbstractPhase) -> Bodies:
    """Bodies of earlier solutions, propagated to ``epoch``, with coefficients of ``phase``."""
    many, parts = len(phase.typical), []
    for each in solutions:
        unknowns, wxyz = ellipsoid_of(each)
        coefficients = each.coefficients if len(each.coefficients) == many else phase.typical
        rates, attitude = free_motion(
            moments_of(jnp.asarray(unknowns)),
            tuple(jnp.asarray(wxyz[:, k]) for k in range(4)),
            tuple(jnp.asarray(unknowns[:, k]) for k in (4, 5, 6)),
            jnp.full((1, 1), epoch - each.epoch),
        )
        assert rates is not None  # for the type checker: both are requested
        assert attitude is not None
        unknowns = np.r_[unknowns[0, :4], [float(x[0, 0]) for x in rates], coefficients]
        parts.append(Bodies(unknowns[None], np.array([[float(x[0, 0]) for x in attitude]])))
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)
