"""Trial bodies with given periods: random draws, and alignment of their phases with the data."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode import rotation
from polhode._closed_forms import free_motion, principal_periods
from polhode.lightcurve._brightness import (
    AbstractPhase,
    Bodies,
    Points,
    _to_body,
    magnitudes,
    moments_of,
    seeliger_ellipsoid,
)
from polhode.lightcurve._frequencies import Hypotheses
from polhode.lightcurve._least_squares import select

# Alignment of trial bodies with the phases of a light curve's Fourier series.
#
# For constant directions to Sun and observer, the light of a body is a function of its two phase
# angles (on a torus), and a shift of both angles multiplies the Fourier coefficients by phase
# factors. The light is therefore computed once, at the 72 nodes of a grid on the torus, and every
# node is compared with the data through the normal equations of the series: 72 starting phases of a
# body cost about as much as its light at 72 times, whatever the number of points.

# Sums i f_phi + j f_psi that are compared, for SAM and for LAM: nearly all of an ellipsoid's light.
_SUMS = np.array(
    [
        [(1, 1), (2, 0), (2, 2), (1, -1), (0, 2), (1, 3), (3, 1), (4, 0), (2, -2), (3, 3), (4, 2)],
        [(1, 0), (2, 0), (2, 2), (1, 2), (0, 2), (1, -2), (3, 0), (4, 0), (4, 2), (3, 2), (4, 4)],
    ]
)
_TURN, _HALF = 12, 6  # nodes in a turn about the momentum, and in half a period of the nutation
GAIN = (0.6, 1.7)  # limits of the factor by which a trial's light variations are scaled
_NODES = np.stack(np.meshgrid(np.arange(_TURN), np.arange(_HALF), indexing="ij"), -1).reshape(-1, 2)
_ANGLES = 2 * np.pi * np.einsum("nc,mkc->mnk", _NODES / (_TURN, 2 * _HALF), _SUMS)


def series(points: Points, f_phi, f_psi, long_axis) -> tuple[np.ndarray, np.ndarray]:
    """Right sides (h, 2 k) and matrices (h, 2 k, 2 k) of normal equations of the waves at the sums.

    For frequencies (h,) and modes (h,), with the points weighted by their errors. Offsets and a
    quadratic function of the phase angle are projected out.
    """
    is_point = _present_points(points)
    t, alpha, data, weight = (
        np.asarray(x[0])[is_point]
        for x in (points.t, points.alpha, points.magnitude, points.weight)
    )
    root = np.sqrt(weight)
    columns = np.vstack([np.asarray(points.columns)[:, is_point], alpha, alpha**2]) * root
    _, size, basis = np.linalg.svd(columns, full_matrices=False)
    basis = basis[size > 1e-10 * size[0]]
    data = data * root
    data = data - (data @ basis.T) @ basis
    right, matrix = [], []
    for f, g, sums in zip(f_phi, f_psi, _SUMS[long_axis.astype(int)], strict=True):
        angle = 2 * np.pi * (sums @ [f, g])[:, None] * t
        waves = np.concatenate([np.cos(angle), np.sin(angle)]) * root
        waves = waves - (waves @ basis.T) @ basis
        right.append(waves @ data)
        matrix.append(waves @ waves.T)
    return np.array(right), np.array(matrix)


def directions(points: Points) -> tuple[np.ndarray, np.ndarray]:
    """Mean directions (3,) to Sun and observer, as unit vectors."""
    is_point = _present_points(points)
    means = (
        np.array([np.asarray(x[0])[is_point].mean() for x in v])
        for v in (points.sun, points.observer)
    )
    sun, observer = (v / np.linalg.norm(v) for v in means)
    return sun, observer


def _present_points(points: Points) -> np.ndarray:
    return np.asarray(points.weight[0]) > 0  # others are padding


@jax.jit
def align_phases(
    bodies: Bodies, f_phi, f_psi, long_axis, right, matrix, sun, observer
) -> tuple[Bodies, Float[Array, " b"]]:
    """The bodies (b,), with frequencies (b,), at the phases where their light best fits the series.

    ``right`` (b, 2 k), ``matrix`` (b, 2 k, 2 k): from `series`; ``sun``, ``observer`` (3,): from
    `directions`. Only attitude and rates change, not the momentum in space. Also returns the
    decrease of chi-square by each body.
    """
    u, wxyz = bodies
    moments, omega = moments_of(u), tuple(u[:, k] for k in (4, 5, 6))
    # Half a period of the nutation suffices: by the symmetry of an ellipsoid the other half repeats
    # the same light, in SAM combined with half a turn about the momentum.
    times = jnp.arange(_HALF)[None] / (2 * _HALF) / f_psi[:, None]
    rates, q = free_motion(moments, tuple(wxyz[:, k] for k in range(4)), omega, times)
    assert rates is not None  # for the type checker: both are requested
    assert q is not None
    pole = rotation.rotate(
        wxyz, jnp.stack([a * b for a, b in zip(moments, omega, strict=True)], -1)
    )
    pole = pole / jnp.linalg.norm(pole, axis=-1, keepdims=True)
    turn = 2 * jnp.pi * (_NODES[None, :, 0] / _TURN - f_phi[:, None] * times[:, _NODES[:, 1]])
    # Single precision suffices here, because the result only selects a node; it halves the time.
    c, s, axis = (x.astype(jnp.float32) for x in (jnp.cos(turn), jnp.sin(turn), pole))

    def back(vector):
        """A direction in space, turned about the pole by minus ``turn``: components (b, n)."""
        along = (axis @ vector)[:, None] * axis
        across, plain = jnp.cross(axis, vector[None]), vector[None] - along
        return tuple(
            along[:, k, None] + c * plain[:, k, None] - s * across[:, k, None] for k in range(3)
        )

    sun, observer, right, matrix, shape = (
        x.astype(jnp.float32) for x in (sun, observer, right, matrix, jnp.exp(u[:, 2:4]))
    )
    axes = (jnp.ones_like(shape[:, :1]), shape[:, :1], shape[:, 1:])
    facing = tuple(x.astype(jnp.float32)[:, _NODES[:, 1]] for x in q)
    light = seeliger_ellipsoid(axes, *(_to_body(facing, back(v)) for v in (sun, observer)))
    light = -2.5 * jnp.log10(jnp.maximum(light, 1e-12))

    mode = long_axis.astype(int)
    c, s = (jnp.asarray(wave(_ANGLES), jnp.float32)[mode] for wave in (np.cos, np.sin))
    even, odd = (2 * jnp.einsum("bn,bnk->bk", light, x)[:, None] / len(_NODES) for x in (c, s))
    # The shift theorem: the coefficients of the light that starts at a node are those at node 0,
    # rotated by the node's angles. All nodes share one set of coefficients.
    model = jnp.concatenate([even * c + odd * s, odd * c - even * s], -1)
    both = jnp.einsum("bnk,bk->bn", model, right)
    own = jnp.sum(jnp.einsum("bnk,bkl->bnl", model, matrix) * model, -1)
    gain = jnp.clip(both / jnp.maximum(own, 1e-12), *GAIN)
    fall = gain * (2 * both - gain * own)
    best = jnp.argmax(fall, axis=-1)
    fall = jnp.take_along_axis(fall, best[:, None], 1)[:, 0]
    node = jnp.asarray(_NODES)[best]

    def at(parts):
        return jnp.stack([jnp.take_along_axis(x, node[:, 1:], 1)[:, 0] for x in parts], -1)

    parts = node / np.array([[_TURN, 2 * _HALF]])  # of a turn, of a period
    half = jnp.pi * (parts[:, :1] - (f_phi / f_psi)[:, None] * parts[:, 1:])
    turn = jnp.concatenate([jnp.cos(half), jnp.sin(half) * pole], -1)
    return Bodies(u.at[:, 4:7].set(at(rates)), rotation.multiply(turn, at(q))), fall


# Trial bodies with given periods, many at a time, and their misfit.
#
# The inertia is drawn first. The rates are then solved for the required ratio of periods (by
# bisection between small nutation and the separatrix) and scaled to the required P_phi. Every trial
# therefore has the right frequencies, and the random search has two dimensions fewer: random rates
# would rarely have both frequencies to the resolution of a long light curve.

CHUNK = 2048
_light = jax.jit(magnitudes, static_argnums=0)
_BISECTIONS = 24
_PART = 4  # one body of this many, whose light best fits the series, is compared with the points
_SLOPE_SIGMA = 0.5  # prior deviation of a linear phase function in a trial's score [mag / rad]


class Draws(NamedTuple):
    """Random numbers and frequencies that define trial bodies, besides the mode; (b, ...)."""

    inertia: Float[Array, "b 2"]  # in [0, 1]: axes' ratios of the homogeneous ellipsoid
    late: Float[Array, " b"]  # phase of the nutation at t = 0, in periods
    wxyz: Float[Array, "b 4"]  # not normalised
    shape: Float[
        Array, "b 2"
    ]  # normal deviates of the logarithms of the shape's over the inertia's
    f_phi: Float[Array, " b"]
    f_psi: Float[Array, " b"]


def _axes(inertia):
    """Logarithms of the second and third axis over the first."""
    y = 0.2 + 0.8 * inertia[..., 0]
    return jnp.log(jnp.stack([y, y * (0.3 + 0.7 * inertia[..., 1])], -1))


def _spins(u, part, long_axis):
    """Moments, rates and periods of motions from small nutation (``part`` 0) to the separatrix (1).

    The rates lie in the plane of axes x and z and have unit angular momentum.
    """
    a, b, c = moments_of(u)
    split = jnp.arcsin(jnp.sqrt((1 / a - 1 / b) / (1 / a - 1 / c)))
    along = jnp.broadcast_to(long_axis, split.shape)
    angle = jnp.where(along, split * part, jnp.pi / 2 - (jnp.pi / 2 - split) * part)
    omega = (jnp.cos(angle) / a, jnp.zeros_like(a), jnp.sin(angle) / c)
    return (a, b, c), omega, principal_periods((a, b, c), omega)


def _periods_possible(u, long_axis, ratio):
    periods = _spins(u, 1e-3, long_axis)[2]
    return periods.P_phi / periods.P_psi > ratio


@jax.jit
def _draw_chunk(key, f_phi, f_psi, long_axis) -> Draws:
    """Random draws; of six inertias the first that allows the periods."""
    count, keys = f_phi.shape[0], jax.random.split(key, 4)
    inertia = jax.random.uniform(keys[0], (6, count, 2))
    allowed = _periods_possible(_axes(inertia), long_axis, (f_psi / f_phi)[None])
    pick = jnp.argmax(allowed, axis=0)
    return Draws(
        jnp.take_along_axis(inertia, pick[None, :, None], axis=0)[0],
        jax.random.uniform(keys[1], (count,)),
        jax.random.normal(keys[2], (count, 4)),
        jax.random.normal(keys[3], (count, 2)),
        f_phi,
        f_psi,
    )


@jax.jit
def _build_chunk(draws: Draws, long_axis, spread):
    """Bodies (b,) with the required periods, and whether the inertia drawn allows these."""
    u, ratio = _axes(draws.inertia), draws.f_psi / draws.f_phi

    def halve(_, ends):
        low, high = ends
        middle = (low + high) / 2
        periods = _spins(u, middle, long_axis)[2]
        fast = periods.P_phi / periods.P_psi > ratio
        return jnp.where(fast, middle, low), jnp.where(fast, high, middle)

    ends = (jnp.zeros_like(ratio), jnp.ones_like(ratio))
    low, high = jax.lax.fori_loop(0, _BISECTIONS, halve, ends)
    moments, omega, periods = _spins(u, (low + high) / 2, long_axis)
    scale = periods.P_phi * draws.f_phi
    omega = tuple(x * scale for x in omega)
    omega, _ = free_motion(moments, None, omega, draws.late / draws.f_psi, attitude=False)
    assert omega is not None  # for the type checker: rates are requested
    near = jnp.abs(periods.P_phi / periods.P_psi / ratio - 1) < 0.01
    good = _periods_possible(u, long_axis, ratio) & near & jnp.isfinite(sum(omega))
    shape = u + spread * draws.shape
    wxyz = draws.wxyz / jnp.linalg.norm(draws.wxyz, axis=-1, keepdims=True)
    return Bodies(jnp.concatenate([u, shape, jnp.stack(omega, -1)], -1), wxyz), good


def _in_chunks(function, total: int, *arrays):
    """``function(number, *chunks)`` of padded chunks of arrays (total, ...), concatenated."""
    parts = []
    for k, start in enumerate(range(0, total, CHUNK)):
        index = np.minimum(np.arange(start, start + CHUNK), total - 1)
        parts.append(function(k, *jax.tree.map(lambda x, at=index: x[at], arrays)))
    return jax.tree.map(lambda *x: np.concatenate(x)[:total], *parts)


def build(draws: Draws, long_axis, phase: AbstractPhase, spread: float = 0.15):
    """Bodies (b,), and which of them exist; ``spread``: standard deviation of the logarithms of the
    shape's axes' ratios about those of the inertia."""
    total = len(long_axis)
    bodies, good = _in_chunks(
        lambda _, d, mode: _build_chunk(d, mode, spread), total, draws, np.asarray(long_axis)
    )
    typical = np.broadcast_to(np.asarray(phase.typical, float), (total, len(phase.typical)))
    return Bodies(np.concatenate([bodies.unknowns, typical], -1), bodies.wxyz), good


def perturb(key, meant: Hypotheses, blur: float) -> Hypotheses:
    """The hypotheses with frequencies shifted at random by up to ``blur``."""
    shake = blur * np.asarray(jax.random.uniform(key, (2, len(meant.f_phi)), minval=-1.0))
    f_phi, f_psi = (np.maximum(f + d, f / 2) for f, d in zip(meant[:2], shake, strict=True))
    return Hypotheses(f_phi, f_psi, meant.long_axis)


def draw(key, hypotheses: Hypotheses, each: int) -> tuple[Draws, np.ndarray]:
    """Draws of ``each`` bodies for every hypothesis, and their modes."""
    f_phi, f_psi, long_axis = (np.repeat(x, each) for x in hypotheses)
    draws = _in_chunks(
        lambda k, *x: _draw_chunk(jax.random.fold_in(key, k), *x),
        len(f_phi),
        f_phi,
        f_psi,
        long_axis,
    )
    return draws, long_axis


@jax.jit
def _misfit(light, points: Points, solver):
    """Misfit (b,) and gain (b,), the factor of the light variations that fits best."""

    def free_of_offsets(x):
        return x - ((x * points.weight) @ points.columns.T @ solver) @ points.columns

    model = free_of_offsets(light)
    data = free_of_offsets(points.magnitude)
    both, own = ((model * x * points.weight).sum(-1, keepdims=True) for x in (data, model))
    gain = jnp.clip(both / jnp.maximum(own, 1e-12), *GAIN)
    rest = (gain * model - data) ** 2
    # The score grows with the logarithm of large residuals, so that single points do not decide.
    scale = jnp.sum(rest * points.weight, -1, keepdims=True) / jnp.sum(points.weight)
    size = jnp.sum(points.weight * scale * jnp.log1p(rest / scale), -1) / jnp.sum(points.weight)
    return size, gain[..., 0]


def misfits(phase: AbstractPhase, bodies: Bodies, points: Points) -> tuple[np.ndarray, np.ndarray]:
    """Robust mean squares of the residuals [mag^2] of each body (b,), and gains (b,).

    Offsets are fitted, and the light variations are multiplied by the gain, which stands for a
    change of the axes' ratios.
    """
    # A column linear in the phase angle stands for the phase function, which is not fitted yet.
    slope = jnp.where(points.weight > 0, points.alpha, 0.0)
    points = points._replace(
        columns=jnp.concatenate([points.columns, slope]),
        stiffness=jnp.append(points.stiffness, _SLOPE_SIGMA**-2.0),
    )
    c = np.asarray(points.columns)
    solver = np.linalg.inv((c * np.asarray(points.weight)) @ c.T + np.diag(points.stiffness))
    total = bodies.wxyz.shape[0]
    out = []
    for start in range(0, total, CHUNK):
        index = np.minimum(np.arange(start, start + CHUNK), total - 1)
        part = Bodies(bodies.unknowns[index], bodies.wxyz[index])
        light = _light(phase, part, points.without_offsets())
        out.append(np.asarray(_misfit(light, points, jnp.asarray(solver))))
    misfit, gain = np.concatenate(out, axis=-1)[:, :total]
    return np.nan_to_num(misfit, nan=np.inf), gain


class Trials(NamedTuple):
    """The best trial bodies (b, ...) of every hypothesis, grouped by hypothesis."""

    bodies: Bodies
    gain: np.ndarray
    source: np.ndarray  # number of the hypothesis


def best_trials(
    key,
    meant: Hypotheses,
    count: int,
    keep: int,
    phase: AbstractPhase,
    points: Points,
    few: Points,
    blur: float,
) -> Trials:
    """The ``keep`` best bodies of each hypothesis, from about ``count`` draws in total.

    Their phases are aligned with the series of all ``points``, for constant directions. The misfit
    to the points ``few``, with their actual directions, then selects the best.
    """
    many = len(meant.f_phi)
    each = max(keep, count // many)
    keys = jax.random.split(key)
    meant = perturb(keys[0], meant, blur)
    draws, long_axis = draw(keys[1], meant, each)
    bodies, good = build(draws, long_axis, phase)
    source = np.repeat(np.arange(many), each)
    right, matrix = series(points, *meant)
    sun, observer = directions(points)
    bodies, fall = _in_chunks(
        lambda _, b, d, own: align_phases(
            b, d.f_phi, d.f_psi, meant.long_axis[own], right[own], matrix[own], sun, observer
        ),
        len(source),
        bodies,
        draws,
        source,
    )
    index = _smallest(np.where(good, -fall, np.inf), many, max(keep, each // _PART))
    bodies = select(bodies, index)
    misfit, gain = misfits(phase, bodies, few)
    best = _smallest(np.where(good[index], misfit, np.inf), many, keep)
    return Trials(select(bodies, best), gain[best], np.repeat(np.arange(many), keep))


def _smallest(values: np.ndarray, many: int, keep: int) -> np.ndarray:
    """Indices of the ``keep`` smallest values in each of ``many`` equal parts."""
    each = len(values) // many
    best = np.argsort(values.reshape(many, each), axis=1)[:, :keep]
    return (best + each * np.arange(many)[:, None]).reshape(-1)
