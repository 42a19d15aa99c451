"""From a light curve to every tumbling body that explains it."""

import jax
import jax.numpy as jnp
import numpy as np

from polhode import free, rotation
from polhode.lightcurve._data import LightCurve
from polhode.lightcurve._frequencies import Pairs, fourier_lattices
from polhode.lightcurve._model import Bodies, Points
from polhode.lightcurve._phase import HG1G2, AbstractPhase, SeeligerPhase
from polhode.lightcurve._search import Hypotheses, Trials, hypotheses, tried
from polhode.lightcurve._solutions import Fit, described, frequencies, momentum, notes_on
from polhode.lightcurve._steps import BATCH, Problem, State, picked, taken

_FEW = 256  # points that a search looks at
_AGAIN = 8  # pairs of periods searched again
_LIMIT = 3.0  # of residuals in a search, in sigma
_REACHED = 1.3  # chi-square per degree of freedom at which a search ends


def fit_light_curve(
    curve: LightCurve,
    *,
    phase: AbstractPhase | None = None,
    pairs: Pairs | None = None,
    highest: float | None = None,
    trials: int = 100_000,
    starts: int = 288,
    searches: int = 3,
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
        pairs = fourier_lattices(curve.t, curve.magnitude, columns=columns, highest=highest)
    meant = hypotheses(pairs)
    key = jax.random.key(seed)
    few, problem = _thinned(points, _FEW), Problem(phase, points)
    state = None
    for _ in range(searches):
        key, own = jax.random.split(key)
        found = _searched(own, meant, trials, starts, few, problem, _blur(curve), pairs.resolution)
        state = found if state is None else _joined(state, found)
        # the errors assumed are reached: nothing is left to be found
        freedom = max(curve.t.size - state.matrix.shape[1], 1)
        if state.cost.min() < _REACHED * freedom:
            break
    assert state is not None
    state = _better(problem, state, pairs.resolution, BATCH, limit, 40)
    normals = _mirrors(curve)
    order = _distinct(state, pairs.resolution)[: BATCH // 2]
    images = [_mirrored(taken(state.bodies, order), normal) for normal in normals]
    images = jax.tree.map(lambda *x: np.concatenate([y[: len(order)] for y in x]), *images)
    images = taken(images, np.arange(len(images.wxyz)))
    width = np.full(len(images.wxyz), limit)
    mirrored = problem.improve(problem.start(images, width), width, 30)
    state = _joined(state, mirrored)
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


def _searched(
    key,
    meant: Hypotheses,
    trials: int,
    starts: int,
    few: Points,
    problem: Problem,
    blur,
    resolution,
) -> State:
    """Bodies of all hypotheses; then more with the periods found, whose pole may be wrong."""
    phase, rough = problem.phase, Problem(problem.phase, few)
    trial = tried(jax.random.fold_in(key, 0), meant, trials, phase, few, blur)
    state = _started(trial, starts, rough, each=3)
    state = _better(problem, state, resolution, 3 * BATCH, 10.0, 12)
    near, known = _near(state, resolution)
    trial = tried(
        jax.random.fold_in(key, 1), near, trials // 3, phase, few, 0.5 * resolution, known
    )
    again = _started(trial, starts // 3, rough, each=starts)
    state = _joined(state, problem.start(again.bodies, np.full(len(again.cost), 10.0)))
    return _better(problem, state, resolution, 2 * BATCH, _LIMIT, 12)


def _started(trial: Trials, count: int, problem: Problem, each: int) -> State:
    """A few steps from the best trials, at most ``each`` of one hypothesis."""
    chosen = _varied(trial.misfit, trial.source, count, each)
    bodies = taken(trial.bodies, chosen)
    # the gain, as a first step of the shape
    bodies.unknowns[: len(chosen), 2:4] *= trial.gain[chosen][:, None]
    width = np.full(len(bodies.wxyz), 10.0)
    return problem.improve(problem.start(bodies, width), width, 10)


def _better(problem: Problem, state: State, resolution, keep: int, limit: float, steps: int):
    """The ``keep`` best distinct ones, improved."""
    best = _distinct(state, resolution)[:keep]
    best = np.pad(best, (0, keep - len(best)), mode="edge")
    width = np.full(keep, limit)
    return problem.improve(problem.look(*picked(state[:2], best), width), width, steps)


def _near(state: State, resolution: float) -> tuple[Hypotheses, Bodies]:
    """Periods and modes of the best bodies, poles apart."""
    f_phi, f_psi, mode = frequencies(state.bodies)
    kept: list[int] = []
    for k in np.argsort(state.cost):
        if len(kept) < _AGAIN and np.isfinite(state.cost[k] + f_phi[k] + f_psi[k]):
            size = [max(abs(f_phi[k] - f_phi[j]), abs(f_psi[k] - f_psi[j]))
                    for j in kept if mode[j] == mode[k]]  # fmt: skip
            if min(size, default=np.inf) > 0.3 * resolution:
                kept.append(int(k))
    meant = Hypotheses(f_phi[kept], f_psi[kept], mode[kept] == int(free.Mode.LAM))
    return meant, picked(state.bodies, np.array(kept))


def _joined(*states: State) -> State:
    return jax.tree.map(lambda *x: np.concatenate(x), *states)


def _thinned(points: Points, count: int) -> Points:
    """``count`` of the points at most, evenly chosen."""
    known = np.flatnonzero(np.asarray(points.weight[0]) > 0)
    if len(known) <= count:
        return points
    index = known[np.arange(count) * len(known) // count]
    return jax.tree.map(lambda x: x[..., index], points._replace(stiffness=None))._replace(
        stiffness=points.stiffness
    )


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
