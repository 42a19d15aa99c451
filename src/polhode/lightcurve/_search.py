"""Trial bodies with given periods, many at a time, and their misfit."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode._closed_forms import free_motion, principal_periods
from polhode.lightcurve._hypotheses import Hypotheses
from polhode.lightcurve._model import Bodies, Points, magnitudes, moments_of
from polhode.lightcurve._phase import AbstractPhase
from polhode.lightcurve._series import GAIN, directions, series, turned
from polhode.lightcurve._steps import picked

CHUNK = 2048
_BISECTIONS = 24
_PART = 4  # of so many bodies the one whose light comes nearest to the series is looked at
_SLOPE_SIGMA = 0.5  # of the phase function, in a trial's score [mag / rad]


class Draws(NamedTuple):
    """What a trial body is made from, besides its mode; arrays (b, ...)."""

    inertia: Float[Array, "b 2"]  # in [0, 1]: axes' ratios of the homogeneous ellipsoid
    late: Float[Array, " b"]  # part of a turn about the long axis, at t = 0
    wxyz: Float[Array, "b 4"]  # not normalised
    shape: Float[Array, "b 2"]  # normal deviates: logarithms of the shape's ratios by the inertia's
    f_phi: Float[Array, " b"]
    f_psi: Float[Array, " b"]


def _axes(inertia):
    """Logarithms of the second and third axis over the first."""
    y = 0.2 + 0.8 * inertia[..., 0]
    return jnp.log(jnp.stack([y, y * (0.3 + 0.7 * inertia[..., 1])], -1))


def _spins(u, part, long_axis):
    """From small nutation (part 0) to the separatrix (1), in the plane of axes x and z."""
    a, b, c = moments_of(u)
    split = jnp.arcsin(jnp.sqrt((1 / a - 1 / b) / (1 / a - 1 / c)))
    along = jnp.broadcast_to(long_axis, split.shape)
    angle = jnp.where(along, split * part, jnp.pi / 2 - (jnp.pi / 2 - split) * part)
    omega = (jnp.cos(angle) / a, jnp.zeros_like(a), jnp.sin(angle) / c)
    return (a, b, c), omega, principal_periods((a, b, c), omega)


def _allowed(u, long_axis, ratio):
    found = _spins(u, 1e-3, long_axis)[2]
    return found.P_phi / found.P_psi > ratio


@jax.jit
def _fresh(key, f_phi, f_psi, long_axis) -> Draws:
    """Anything possible; of six inertias the first that allows the periods."""
    count, keys = f_phi.shape[0], jax.random.split(key, 4)
    inertia = jax.random.uniform(keys[0], (6, count, 2))
    allowed = _allowed(_axes(inertia), long_axis, (f_psi / f_phi)[None])
    pick = jnp.argmax(allowed, axis=0)
    return Draws(
        jnp.take_along_axis(inertia, pick[None, :, None], axis=0)[0],
        jax.random.uniform(keys[1], (count,)), jax.random.normal(keys[2], (count, 4)),
        jax.random.normal(keys[3], (count, 2)), f_phi, f_psi,
    )  # fmt: skip


@jax.jit
def _built(draws: Draws, long_axis, spread):
    """Bodies (b,) with the periods asked, and whether there are any for the inertia drawn."""
    u, ratio = _axes(draws.inertia), draws.f_psi / draws.f_phi

    def halve(_, ends):
        low, high = ends
        middle = (low + high) / 2
        found = _spins(u, middle, long_axis)[2]
        fast = found.P_phi / found.P_psi > ratio
        return jnp.where(fast, middle, low), jnp.where(fast, high, middle)

    ends = (jnp.zeros_like(ratio), jnp.ones_like(ratio))
    low, high = jax.lax.fori_loop(0, _BISECTIONS, halve, ends)
    moments, omega, found = _spins(u, (low + high) / 2, long_axis)
    scale = found.P_phi * draws.f_phi
    omega = tuple(x * scale for x in omega)
    omega, _ = free_motion(moments, None, omega, draws.late / draws.f_psi, attitude=False)
    assert omega is not None  # the rates were not declined
    near = jnp.abs(found.P_phi / found.P_psi / ratio - 1) < 0.01
    good = _allowed(u, long_axis, ratio) & near & jnp.isfinite(sum(omega))
    shape = u + spread * draws.shape
    wxyz = draws.wxyz / jnp.linalg.norm(draws.wxyz, axis=-1, keepdims=True)
    return Bodies(jnp.concatenate([u, shape, jnp.stack(omega, -1)], -1), wxyz), good


def _in_chunks(function, total: int, *arrays):
    """``function(number, *chunks)`` of arrays (total, ...), joined."""
    parts = []
    for k, start in enumerate(range(0, total, CHUNK)):
        index = np.minimum(np.arange(start, start + CHUNK), total - 1)
        parts.append(function(k, *jax.tree.map(lambda x, at=index: x[at], arrays)))
    return jax.tree.map(lambda *x: np.concatenate(x)[:total], *parts)


def build(draws: Draws, long_axis, phase: AbstractPhase, spread: float = 0.15):
    """Bodies (b,), and which exist; ``spread``: of the shape's ratios by the inertia's, in ln."""
    total = len(long_axis)
    bodies, good = _in_chunks(
        lambda _, d, mode: _built(d, mode, spread), total, draws, np.asarray(long_axis)
    )
    typical = np.broadcast_to(np.asarray(phase.typical, float), (total, len(phase.typical)))
    return Bodies(np.concatenate([bodies.unknowns, typical], -1), bodies.wxyz), good


def shaken(key, meant: Hypotheses, blur: float) -> Hypotheses:
    """Frequencies within ``blur`` of those meant."""
    shake = blur * np.asarray(jax.random.uniform(key, (2, len(meant.f_phi)), minval=-1.0))
    f_phi, f_psi = (np.maximum(f + d, f / 2) for f, d in zip(meant[:2], shake, strict=True))
    return Hypotheses(f_phi, f_psi, meant.long_axis)


def draw(key, hypotheses: Hypotheses, each: int) -> tuple[Draws, np.ndarray]:
    """``each`` of every hypothesis, and their modes."""
    f_phi, f_psi, long_axis = (np.repeat(x, each) for x in hypotheses)
    made = _in_chunks(
        lambda k, *x: _fresh(jax.random.fold_in(key, k), *x),
        len(f_phi), f_phi, f_psi, long_axis,
    )  # fmt: skip
    return made, long_axis


def _misfit(phase, bodies: Bodies, points: Points, solver):
    """Misfit (b,) and gain (b,): what the body's variations are multiplied by to fit best."""

    def free_of_offsets(x):
        return x - ((x * points.weight) @ points.columns.T @ solver) @ points.columns

    model = free_of_offsets(magnitudes(phase, bodies, points))
    data = free_of_offsets(points.magnitude)
    both, own = ((model * x * points.weight).sum(-1, keepdims=True) for x in (data, model))
    gain = jnp.clip(both / jnp.maximum(own, 1e-12), *GAIN)
    rest = (gain * model - data) ** 2
    # the mean of |r| where it is large: single points do not decide
    scale = jnp.sum(rest * points.weight, -1, keepdims=True) / jnp.sum(points.weight)
    size = jnp.sum(points.weight * scale * jnp.log1p(rest / scale), -1) / jnp.sum(points.weight)
    return size, gain[..., 0]


_scored = jax.jit(_misfit, static_argnums=0)


def misfits(phase: AbstractPhase, bodies: Bodies, points: Points) -> tuple[np.ndarray, np.ndarray]:
    """Robust mean squares of the residuals [mag^2] of each body (b,), and gains (b,).

    Offsets are fitted, and the light's variations may be a little greater or smaller all over: by
    the gain, as other axes' ratios would make them.
    """
    # a slope by the phase angle: the phase function is not known yet
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
        out.append(np.asarray(_scored(phase, part, points, jnp.asarray(solver))))
    misfit, gain = np.concatenate(out, axis=-1)[:, :total]
    return np.nan_to_num(misfit, nan=np.inf), gain


class Trials(NamedTuple):
    """The best bodies tried of every hypothesis, those of one beside each other; (b, ...)."""

    bodies: Bodies
    gain: np.ndarray
    source: np.ndarray  # number of the hypothesis


def tried(
    key, meant: Hypotheses, count: int, keep: int, phase: AbstractPhase,
    points: Points, few: Points, blur: float,
) -> Trials:  # fmt: skip
    """The ``keep`` best of each hypothesis among about ``count`` bodies drawn.

    Their phases are those that the series of all ``points`` prefers, their misfit that of ``few``:
    directions that turn are left to the latter.
    """
    many = len(meant.f_phi)
    each = max(keep, count // many)
    keys = jax.random.split(key)
    meant = shaken(keys[0], meant, blur)
    draws, long_axis = draw(keys[1], meant, each)
    bodies, good = build(draws, long_axis, phase)
    source = np.repeat(np.arange(many), each)
    right, matrix = series(points, *meant)
    sun, observer = directions(points)
    bodies, fall = _in_chunks(
        lambda _, b, d, own: turned(
            b, d.f_phi, d.f_psi, meant.long_axis[own], right[own], matrix[own], sun, observer
        ),
        len(source), bodies, draws, source,
    )  # fmt: skip
    index = _least(np.where(good, -fall, np.inf), many, max(keep, each // _PART))
    bodies = picked(bodies, index)
    misfit, gain = misfits(phase, bodies, few)
    best = _least(np.where(good[index], misfit, np.inf), many, keep)
    return Trials(picked(bodies, best), gain[best], np.repeat(np.arange(many), keep))


def _least(values: np.ndarray, many: int, keep: int) -> np.ndarray:
    """Numbers of the ``keep`` least of each of ``many`` equal parts."""
    each = len(values) // many
    best = np.argsort(values.reshape(many, each), axis=1)[:, :keep]
    return (best + each * np.arange(many)[:, None]).reshape(-1)
