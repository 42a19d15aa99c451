"""From a light curve to every tumbling body that explains it."""

import jax
import jax.numpy as jnp
import numpy as np

from polhode import rotation
from polhode.lightcurve._data import LightCurve
from polhode.lightcurve._frequencies import Pairs, fourier_pairs
from polhode.lightcurve._model import Bodies
from polhode.lightcurve._phase import HG1G2, AbstractPhase, SeeligerPhase
from polhode.lightcurve._search import Hypotheses, draw, hypotheses, misfits
from polhode.lightcurve._solutions import Fit, described, frequencies, momentum, notes_on
from polhode.lightcurve._steps import BATCH, Problem, State, picked, taken


def fit_light_curve(
    curve: LightCurve,
    *,
    phase: AbstractPhase | None = None,
    pairs: Pairs | None = None,
    highest: float | None = None,
    trials: int = 60_000,
    starts: int = 192,
    floor: float = 0.03,
    offset_sigma: float | None = None,
    limit: float = 3.0,
    seed: int = 0,
    most: int = 12,
) -> Fit:
    """Every tumbling ellipsoid, of free inertia, that explains a light curve; without a guess.

    Pairs of frequencies from Fourier series, each with all it can mean; ``trials`` bodies of these
    periods, all else drawn at random; Levenberg-Marquardt, with exact derivatives, on the best
    ``starts``; the mirror images of what is found; distinct solutions, the ``most`` best.

    ``phase``: a phase function (default: ``HG1G2()`` where the phase angle changes by more than 5
    degrees, else ``SeeligerPhase()``). ``pairs``: instead of those from the series. ``highest``
    frequency sought, per day. ``floor`` [mag]: added to the errors in quadrature, growing with
    the phase angle, for what an ellipsoid cannot be. ``offset_sigma``: see
    ``LightCurve.columns``. ``limit``: residuals beyond as many sigma count by their size, not
    their square. Needs float64 (``jax_enable_x64``).

    Raises RuntimeError in float32, ValueError for a light curve without directions.
    """
    # JAX adds its settings when it runs, which its types do not tell
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise RuntimeError(
            "fits of light curves need float64: jax.config.update('jax_enable_x64', True)."
        )
    points = curve.points(floor, offset_sigma)
    if phase is None:
        phase = HG1G2() if np.ptp(curve.alpha) > np.radians(5) else SeeligerPhase()
    if pairs is None:
        columns = curve.columns(np.inf)[0]
        if np.ptp(curve.alpha) > np.radians(1):
            columns = np.vstack([columns, curve.alpha, curve.alpha**2])
        pairs = fourier_pairs(
            curve.t, curve.magnitude, columns=columns, highest=highest, order=1, even=False, keep=60
        )
    meant = hypotheses(pairs)
    key = jax.random.key(seed)
    problem = Problem(phase, points)
    bodies, misfit, source = _trials(key, meant, trials, phase, points, _blur(curve))
    start = _varied(misfit, source, starts, each=4)
    state = problem.start(taken(bodies, start), np.full(starts, 10.0))
    for keep, bound, steps in ((3 * BATCH, 10.0, 8), (BATCH, 10.0, 12), (0, limit, 40)):
        width = np.full(len(state.cost), bound)
        state = problem.improve(state, width, steps)
        if keep:
            best = _varied(state.cost, np.zeros(len(state.cost)), keep, each=keep)
            state = problem.look(*picked(state[:2], best), np.full(keep, limit))
    normals = _mirrors(curve)
    order = _distinct(state, pairs.resolution)[: BATCH // 2]
    images = [_mirrored(taken(state.bodies, order), normal) for normal in normals]
    images = jax.tree.map(lambda *x: np.concatenate([y[: len(order)] for y in x]), *images)
    images = taken(images, np.arange(len(images.wxyz)))
    width = np.full(len(images.wxyz), limit)
    mirrored = problem.improve(problem.start(images, width), width, 30)
    state = jax.tree.map(lambda *x: np.concatenate(x), state, mirrored)
    order = _distinct(state, pairs.resolution)[:most]
    solutions, scale = described(problem, state, order, curve, normals, limit)
    return Fit(solutions, curve, pairs, meant, scale, notes_on(curve, solutions, scale))


def _blur(curve: LightCurve) -> float:
    """How far off the frequencies of a series may be: its grid, and the turn of the directions."""
    sun, observer = curve._known_directions()
    bisector = sun + observer
    bisector = bisector / np.linalg.norm(bisector, axis=1, keepdims=True)
    turned = np.arccos(
        np.clip((bisector @ bisector[:: max(1, len(bisector) // 50)].T).min(), -1, 1)
    )
    return float((0.125 + turned / (2 * np.pi)) / np.ptp(curve.t))


def _trials(key, meant: Hypotheses, trials: int, phase, points, blur):
    """Bodies of all hypotheses, then more of those that did best."""
    count = len(meant.f_phi)
    each = max(1, trials // 3 // count)
    bodies, good = draw(jax.random.fold_in(key, 0), meant, each, phase, blur)
    misfit = np.where(good, misfits(phase, bodies, points), np.inf)
    source = np.repeat(np.arange(count), each)
    best = np.sort(np.argsort(misfit.reshape(count, each).min(1))[: max(1, count // 4)])
    more = max(1, (trials - len(misfit)) // len(best))
    chosen = Hypotheses(*(x[best] for x in meant))
    extra, good = draw(jax.random.fold_in(key, 1), chosen, more, phase, blur)
    second = np.where(good, misfits(phase, extra, points), np.inf)
    bodies = jax.tree.map(lambda *x: np.concatenate(x), bodies, extra)
    return bodies, np.r_[misfit, second], np.r_[source, np.repeat(best, more)]


def _varied(misfit, source, count: int, each: int) -> np.ndarray:
    """Numbers of the best, at most ``each`` from one source, padded with the last."""
    used: dict = {}
    chosen = []
    for k in np.argsort(misfit):
        used[source[k]] = used.get(source[k], 0) + 1
        if used[source[k]] <= each:
            chosen.append(k)
        if len(chosen) == count:
            break
    return np.pad(np.array(chosen), (0, count - len(chosen)), mode="edge")


def _distinct(state: State, resolution: float) -> np.ndarray:
    """Numbers of the solutions that differ in mode, frequencies or pole, the best first."""
    f_phi, f_psi, mode = frequencies(state.bodies)
    pole = momentum(state.bodies)
    kept: list[int] = []
    for k in np.argsort(state.cost):
        if not np.isfinite(state.cost[k] + f_phi[k] + f_psi[k]):
            continue
        same = [
            mode[k] == mode[j]
            and abs(f_phi[k] - f_phi[j]) < 0.2 * resolution
            and abs(f_psi[k] - f_psi[j]) < 0.2 * resolution
            and pole[k] @ pole[j] > np.cos(np.radians(15))
            for j in kept
        ]
        if not any(same):
            kept.append(int(k))
    return np.array(kept)


def _mirrors(curve: LightCurve) -> np.ndarray:
    """Normals (3, 3) of the mirrors that leave the light of an ellipsoid as it is.

    The plane of Sun and observer: exactly, while they keep to it. The plane across the bisector of
    their directions, and the one across both: the better, the smaller the phase angle.
    """
    sun, observer = curve._known_directions()
    first = np.linalg.svd(np.vstack([sun, observer]))[2][-1]
    middle = (sun + observer).sum(0)
    middle = middle - first * (first @ middle)
    middle = middle / np.linalg.norm(middle)
    return np.stack([first, middle, np.cross(first, middle)])


def _mirrored(bodies: Bodies, normal: np.ndarray) -> Bodies:
    """The motions seen in a mirror that holds Sun and observer, which gives the same light.

    With M the reflection in space and D that of body axis y, the attitude is M R D, the rates
    -D omega; the ellipsoid and its inertia do not change.
    """
    matrix = np.asarray(rotation.wxyz_to_matrix(jnp.asarray(bodies.wxyz)))
    flip = np.diag([1.0, -1.0, 1.0])
    mirror = np.eye(3) - 2 * np.outer(normal, normal)
    unknowns = bodies.unknowns.copy()
    unknowns[:, [4, 6]] *= -1
    wxyz = np.array(rotation.matrix_to_wxyz(jnp.asarray(mirror @ matrix @ flip)))
    return Bodies(unknowns, wxyz)
