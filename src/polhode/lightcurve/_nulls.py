"""Null hypotheses of a light curve: noise alone, and one period (a principal-axis rotator).

They are compared with tumbling bodies by an approximation of the logarithm of the evidence,

    ln Z = -N/2 ln(RSS / N) - k/2 ln N - ln M,

with N the number of independent points (minus the offsets), RSS the sum of squares of the weighted
residuals, k the number of parameters and M that of the independent frequencies tried (Schwarz, Ann.
Statist. 6 (1978) 461, with the noise level unknown).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from polhode.lightcurve._brightness import seeliger_ellipsoid
from polhode.lightcurve._data import BLOCK, LightCurve
from polhode.lightcurve._frequencies import LINES, Pairs, Scan, _maxima, terms
from polhode.lightcurve._least_squares import damped_steps, next_damping

_CLIP = 4.0  # residuals are clipped at this multiple of the best model's scale
_CANDIDATES = 10  # peaks of the spectrum of one period that are refined
_SCAN_ORDERS, _ORDERS = (2, 4), (1, 2, 3, 4, 6, 8)  # numbers of harmonics
_MODULATED = 4  # harmonics whose amplitude may change linearly with time
_BATCH = 32  # rotators per call of their compiled program
# Rotating ellipsoids returned for each frequency, and the least angle between their poles.
_POLES, _APART = 2, np.radians(20)
_ROUND = 8  # poles, per period, of nearly round bodies from which a convex shape is fitted
_JOINED = 0.25  # frequencies of rotating ellipsoids that are closer, in 1/span, count as one


class Model(NamedTuple):
    """One explanation of a light curve, and its evidence."""

    name: str
    log_evidence: float  # natural logarithm, up to a constant that all models share
    parameters: float  # not counting offsets and phase function
    rms: float  # weighted, of the residuals [mag]
    misfit: float  # residuals over the errors of the light curve itself, without any floor
    periods: tuple[float, ...]  # time unit of the light curve [day]


class Residuals(NamedTuple):
    """Residuals (n,) [mag] of a model with a number of ``parameters``; exp(``log_trials``):
    independent frequencies (or pairs) tried."""

    name: str
    values: np.ndarray
    parameters: float
    log_trials: float
    periods: tuple[float, ...] = ()


class Linear:
    """Weighted least squares with offsets, a phase function, and any other columns."""

    def __init__(self, curve: LightCurve, offset_sigma: float | None = None):
        self.curve, self.t = curve, curve.t - curve.t[0]
        columns, stiffness = curve.columns(offset_sigma)
        self.offset_count = len(columns)
        if curve.sun is not None and np.ptp(curve.alpha) > np.radians(1):
            columns = np.vstack([columns, curve.alpha, curve.alpha**2])
            stiffness = np.r_[stiffness, 0.0, 0.0]
        self.columns, self.stiffness = columns, stiffness
        self.root = 1 / curve.sigma
        # the rows of the priors follow those of the points
        prior = np.diag(np.sqrt(stiffness))[stiffness > 0]
        self.rows = np.vstack([columns.T * self.root[:, None], prior])
        basis, size, _ = np.linalg.svd(self.rows, full_matrices=False)
        self.basis = basis[:, size > 1e-10 * size[0]]
        self.data = self.projected(curve.magnitude)

    @property
    def independent(self) -> int:
        """Number of points minus the number of free columns (offsets, phase function)."""
        return max(self.t.size - (self.basis.shape[1] - (len(self.rows) - self.t.size)), 1)

    def projected(self, values: np.ndarray) -> np.ndarray:
        """Values (n, ...) over the errors, with the columns (such as offsets) projected out."""
        rows = (values.T * self.root).T
        whole = np.concatenate([rows, np.zeros((len(self.rows) - self.t.size, *values.shape[1:]))])
        return whole - self.basis @ (self.basis.T @ whole)

    def residuals(self, waves: np.ndarray) -> np.ndarray:
        """Residuals (n,) [mag] of the data after a fit of the columns ``waves`` (n, c)."""
        rest = self.data
        if waves.shape[1]:
            matrix = self.projected(waves)
            rest = rest - matrix @ np.linalg.lstsq(matrix, rest, rcond=1e-9)[0]
        return rest[: self.t.size] / self.root

    def offsets(self, residuals: np.ndarray, model) -> np.ndarray:
        """Offsets, and coefficients of the further columns, of a model with these ``residuals``.

        ``model``: a solution with nearby offsets, to which the least-squares change is added.
        """
        change = self.curve.magnitude + residuals - model.model
        count = self.offset_count
        own = self.columns[:count].T
        matrix, data = own * self.root[:, None], change * self.root
        out = np.array(model.offsets, float)
        out[:count] += np.linalg.lstsq(matrix, data, rcond=1e-9)[0]
        return out

    def chi2(self, waves: np.ndarray) -> float:
        """Sum of squares of the ``residuals`` over the errors."""
        return float(np.sum((self.residuals(waves) * self.root) ** 2))


def waves(t: np.ndarray, frequencies: np.ndarray, modulated: int = 0) -> np.ndarray:
    """Cosines and sines (n, 2 k); those of the first ``modulated`` frequencies also times time."""
    angle = 2 * np.pi * np.outer(t, frequencies)
    both = np.hstack([np.cos(angle), np.sin(angle)])
    if not modulated:
        return both
    slow = (2 * t / t[-1] - 1)[:, None]
    angle = angle[:, :modulated]
    return np.hstack([both, slow * np.cos(angle), slow * np.sin(angle)])


def noise(linear: Linear) -> Residuals:
    """The model of offsets and a phase function alone."""
    return Residuals("noise only", linear.residuals(np.empty((linear.t.size, 0))), 0, 0.0)


def one_period(linear: Linear, max_frequency: float) -> list[Residuals]:
    """Fourier series of one period, with constant amplitudes and with ones linear in time.

    The latter allow for changing directions. Returns the best for each number of harmonics.
    """
    t, span = linear.t, float(linear.t[-1])
    candidates = _peaks(linear, max_frequency)
    frequencies = [
        _refine_frequency(linear, f, lambda f: waves(t, f * np.arange(1, 5))) for f in candidates
    ]
    chi2 = [linear.chi2(waves(t, f * np.arange(1, 5))) for f in frequencies]
    best = [frequencies[k] for k in np.argsort(chi2)[:4]]
    # a series of few harmonics of f may be one of f / 2 or 2 f
    others = (f * part for f in best[:2] for part in (0.5, 2.0))
    best += [f for f in others if 1 <= f * span < max_frequency * span]
    log_trials = float(np.log(max(max_frequency * span, 1.0)))
    out = []
    for order in _ORDERS:
        if 2 * order + 1 > linear.independent / 3:
            break
        harmonics = np.arange(1, order + 1)
        for modulated in (0, min(order, _MODULATED)):
            count = 2 * (order + modulated) + 1
            if count > linear.independent / 3:
                continue

            def columns(f, harmonics=harmonics, modulated=modulated):
                return waves(t, f * harmonics, modulated)

            refined_again = [_refine_frequency(linear, f, columns, steps=7) for f in best]
            f = refined_again[int(np.argmin([linear.chi2(columns(f)) for f in refined_again]))]
            name = f"one period, {order} harmonics" + (", changing" if modulated else "")
            rest = linear.residuals(columns(f))
            out.append(Residuals(name, rest, count, log_trials, (1 / f,)))
    return out


def _peaks(linear: Linear, max_frequency: float) -> list[float]:
    """Frequencies whose series of two or four harmonics explain the most variance."""
    curve, over = linear.curve, 6
    columns = curve.columns(np.inf)[0]
    scan = Scan.of(curve.t, curve.magnitude, columns, max_frequency, over, max(_SCAN_ORDERS))
    # at least one cycle within the light curve: slower waves are trends
    nodes = np.arange(over, scan.count)
    if not nodes.size:
        return [1 / float(linear.t[-1])]
    peaks: list[int] = []
    for order in _SCAN_ORDERS:
        power = scan.fit_nodes(nodes[:, None] * np.arange(1, order + 1))[0]
        peaks += nodes[_maxima(power)[:_CANDIDATES]].tolist()
    return [scan.step * k for k in sorted(set(peaks))]


def _refine_frequency(linear: Linear, frequency: float, columns, steps: int = 11) -> float:
    """The frequency near ``frequency`` at which ``columns(f)`` fit best; at least one cycle within
    the light curve."""
    width = 0.25 / linear.t[-1]
    for _ in range(2):
        near = np.maximum(frequency + width * np.linspace(-1, 1, steps), 1 / linear.t[-1])
        frequency = float(near[int(np.argmin([linear.chi2(columns(f)) for f in near]))])
        width *= 2.5 / steps
    return frequency


def two_periods(linear: Linear, pairs: Pairs, solutions) -> list[Residuals]:
    """Fourier series of two frequencies, from the best pairs of lines and from the best bodies."""
    t = linear.t
    log_trials = _log_pairs(pairs.max_frequency, t[-1])
    choices = [(LINES, g, h) for g, h in zip(pairs.f_phi[:3], pairs.f_psi[:3], strict=True)]
    choices += [(terms(2, even=False), 1 / s.P_phi, 1 / s.P_psi) for s in solutions[:2]]
    out = []
    for sums, g, h in choices:
        count = 2 * len(sums) + 2
        if count > linear.independent / 2:
            continue
        pair = np.array([g, h])
        for _ in range(2):
            for k in (0, 1):

                def columns(f, k=k, pair=pair, sums=sums):
                    return waves(t, sums @ np.where(np.arange(2) == k, f, pair))

                pair[k] = _refine_frequency(linear, pair[k], columns, steps=7)
        rest = linear.residuals(waves(t, sums @ pair))
        out.append(
            Residuals("two periods, series", rest, count, log_trials, tuple((1 / pair).tolist()))
        )
    return out


def tumbler(linear: Linear, pairs: Pairs, best) -> Residuals:
    """The model of a tumbling body, with the parameters that the points determine."""
    log_trials = _log_pairs(pairs.max_frequency, linear.t[-1])
    rest = linear.curve.magnitude - best.model
    return Residuals(
        "tumbling body", rest, best.parameters, log_trials, (float(best.P_phi), float(best.P_psi))
    )


def _log_pairs(max_frequency: float, span: float) -> float:
    """Logarithm of the number of independent pairs of frequencies on a grid."""
    return float(2 * np.log(max(max_frequency * span, 1.0)) - np.log(2))


@jax.jit
def _rotators(x, arrays, basis):
    """Residuals (b, n) of ellipsoids that rotate about their third axis, and their derivatives."""
    t, sun, observer, root, data = arrays

    def residuals(x):
        u, v, longitude, latitude, turn, frequency = x
        c, s = jnp.cos(longitude), jnp.sin(longitude)
        cb, sb = jnp.cos(latitude), jnp.sin(latitude)
        frame = jnp.stack(
            [
                jnp.stack([sb * c, sb * s, -cb]),
                jnp.stack([-s, c, jnp.zeros_like(s)]),
                jnp.stack([cb * c, cb * s, sb]),
            ]
        )
        angle = turn + 2 * jnp.pi * frequency * t
        ca, sa = jnp.cos(angle), jnp.sin(angle)

        def body_axes(vector):
            a, b, z = frame @ vector
            return ca * a + sa * b, ca * b - sa * a, z

        axes = (jnp.ones_like(t), jnp.exp(u) + 0 * t, jnp.exp(v) + 0 * t)
        light = seeliger_ellipsoid(axes, body_axes(sun), body_axes(observer))
        value = -2.5 * jnp.log10(jnp.maximum(light, 1e-12)) * root
        whole = jnp.concatenate([value, jnp.zeros(basis.shape[0] - t.shape[0])])
        return data - whole + basis @ (basis.T @ whole)

    value = jax.vmap(residuals)(x)
    slopes = jax.vmap(jax.jacfwd(residuals))(x)
    return value, slopes


class Rotator(NamedTuple):
    """An ellipsoid that rotates about its third axis."""

    values: np.ndarray  # residuals (n,) [mag], data minus model
    # (6,): logarithms of the second and third axis over the first, longitude and latitude of the
    # pole and phase [rad], and frequency
    parameters: np.ndarray
    chi2: float

    @property
    def period(self) -> float:
        return float(1 / self.parameters[5])


def rotators(linear: Linear, periods, max_frequency: float) -> list[Rotator]:
    """Ellipsoids that rotate about their third axis with about one of ``periods``, the best first.

    Up to `_POLES` with different poles for each period, its half and its double: which of them is
    right may be decided only with another shape. Empty without directions.
    """
    curve = linear.curve
    if curve.sun is None or curve.observer is None:
        return []
    # The columns linear and quadratic in the phase angle absorb the light of a sphere by the law.
    arrays, basis = _padded_arguments(linear, curve.sun, curve.observer)
    longitude, latitude = _spiral_directions(12)
    turn = np.pi * np.arange(4) / 4
    grid = np.array(
        [
            (np.log(0.65), np.log(0.5), a, b, c)
            for a, b in zip(longitude, latitude, strict=True)
            for c in turn
        ]
    )
    frequencies: list[float] = []
    for f in (f for p in periods for f in (1 / p, 0.5 / p, 2 / p)):
        # frequencies from which the fit would converge to the same one are one start
        distance = min((abs(f - other) for other in frequencies), default=np.inf)
        if f <= max_frequency and distance > _JOINED / linear.t[-1]:
            frequencies.append(float(f))
    out: list[Rotator] = []
    for f in sorted(frequencies):
        x = np.c_[grid, np.full(len(grid), f)]
        x = np.concatenate([x, x[: -len(x) % _BATCH]])
        parts = [x[k : k + _BATCH] for k in range(0, len(x), _BATCH)]
        chi2 = [np.sum(np.asarray(_rotators(p, arrays, basis)[0]) ** 2, axis=1) for p in parts]
        x = x[np.argsort(np.concatenate(chi2))[:_BATCH]]
        x, residuals = _improve_rotators(x, arrays, basis)
        size = np.sum(residuals**2, axis=1)
        pole = np.stack(
            [np.cos(x[:, 3]) * np.cos(x[:, 2]), np.cos(x[:, 3]) * np.sin(x[:, 2]), np.sin(x[:, 3])],
            -1,
        )
        distinct: list[int] = []
        for k in np.argsort(size):
            apart = not distinct or (pole[distinct] @ pole[k]).max() < np.cos(_APART)
            if np.isfinite(size[k]) and apart and len(distinct) < _POLES:
                distinct.append(int(k))
        rest = residuals[:, : linear.t.size] / linear.root
        out += [Rotator(rest[k], x[k], float(size[k])) for k in distinct]
    return sorted(out, key=lambda r: r.chi2)


def _padded_arguments(linear: Linear, sun: np.ndarray, observer: np.ndarray):
    """Arguments of `_rotators`, padded with points of zero weight and columns of zeros, so that one
    program serves many light curves."""
    n, priors, columns = linear.t.size, len(linear.rows) - linear.t.size, linear.basis.shape[1]
    missing, more, spare = -n % BLOCK, -priors % 16, -columns % 16

    def rows(x):
        """The points, then the rows of the priors."""
        points, prior = x[:n], x[n:]
        rest = ((0, 0),) * (x.ndim - 1)
        return np.concatenate(
            [np.pad(points, ((0, missing), *rest)), np.pad(prior, ((0, more), *rest))]
        )

    def at_points(x, **how):
        return np.pad(x, (*((0, 0),) * (x.ndim - 1), (0, missing)), **how)

    directions = (at_points(v.T, mode="edge") for v in (sun, observer))
    arrays = (at_points(linear.t, mode="edge"), *directions, at_points(linear.root))
    basis = np.pad(rows(linear.basis), ((0, 0), (0, spare)))
    return tuple(map(jnp.asarray, (*arrays, rows(linear.data)))), jnp.asarray(basis)


def round_rotators(periods) -> list[np.ndarray]:
    """``Rotator.parameters`` of nearly round ellipsoids with poles distributed over the sky.

    They are starts for convex bodies whose light differs much from that of any ellipsoid: the best
    pole of an ellipsoid is then unrelated to that of the body.
    """
    return [
        np.array([-0.05, -0.2, longitude, latitude, 0.0, 1 / period])
        for period in periods
        for longitude, latitude in zip(*_spiral_directions(_ROUND), strict=True)
    ]


def _spiral_directions(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Longitudes and latitudes (count,) [rad], evenly distributed on the sphere along a spiral."""
    k = np.arange(count) + 0.5
    return np.pi * (1 + 5**0.5) * k, np.arcsin(1 - 2 * k / count)


def _improve_rotators(x, arrays, basis, steps: int = 25):
    """Levenberg-Marquardt for rotators (b, 6). Returns parameters, and residuals (b, n)."""
    damping = np.full(len(x), 1e-2)
    value, slopes = map(np.asarray, _rotators(x, arrays, basis))
    for _ in range(steps):
        # prior of the logarithms of the axes' ratios: 0 +- 0.8
        prior_precision = np.diag([0.8**-2, 0.8**-2, 0, 0, 0, 0])
        matrix = np.einsum("bni,bnj->bij", slopes, slopes) + prior_precision
        right = np.einsum("bni,bn->bi", slopes, value) + x @ prior_precision
        trial = x + damped_steps(matrix, right, damping, np.arange(5))
        new, new_slopes = map(np.asarray, _rotators(trial, arrays, basis))
        axis_precision = prior_precision[0, 0]

        def cost(value, x, axis_precision=axis_precision):
            return np.nan_to_num(np.sum(value**2, 1), nan=np.inf) + axis_precision * (
                x[:, :2] ** 2
            ).sum(1)

        better = cost(new, trial) < cost(value, x)
        x = np.where(better[:, None], trial, x)
        value = np.where(better[:, None], new, value)
        slopes = np.where(better[:, None, None], new_slopes, slopes)
        damping = next_damping(damping, better)
    return x, value


def compare_models(
    linear: Linear, candidates: list[Residuals], effective_correlation
) -> tuple[Model, ...]:
    """Evidence of ``candidates``; correlated points count less, by the residuals of the best one.

    ``effective_correlation(curve, residuals over errors)``: how many residuals count as one.
    """
    curve = linear.curve
    n = linear.independent
    sharpest = min(candidates, key=lambda r: np.median(np.abs(r.values * linear.root)))
    scale = 1.4826 * max(float(np.median(np.abs(sharpest.values * linear.root))), 1e-12)
    limit = _CLIP * scale
    alike = effective_correlation(curve, np.clip(sharpest.values * linear.root, -limit, limit))
    alike *= max(n / max(n - sharpest.parameters, 1), 1.0)
    independent = max(n / alike, 2.0)
    out = []
    for each in candidates:
        residuals = each.values * linear.root
        rss = float(np.sum(np.minimum(residuals**2, limit**2)))
        evidence = (
            -independent / 2 * np.log(max(rss, 1e-300) / n)
            - each.parameters / 2 * np.log(independent)
            - each.log_trials
        )
        rms = float(np.sqrt(np.average(each.values**2, weights=linear.root**2)))
        own = float(
            np.sqrt(np.sum(np.minimum(residuals**2, limit**2)) / max(n - each.parameters, 1))
        )
        out.append(Model(each.name, float(evidence), each.parameters, rms, own, each.periods))
    return tuple(out)
