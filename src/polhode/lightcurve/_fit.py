"""``fit_light_curve``: all tumbling bodies that explain a light curve, and a verdict."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from polhode import rotation
from polhode._closed_forms import Mode
from polhode.lightcurve._brightness import HG1G2, AbstractPhase, Bodies, Points, SeeligerPhase
from polhode.lightcurve._convex import refined_solutions
from polhode.lightcurve._data import BLOCK, LightCurve
from polhode.lightcurve._frequencies import (
    Hypotheses,
    Pairs,
    check_max_frequency,
    fourier_lattices,
    hypotheses,
)
from polhode.lightcurve._least_squares import (
    BATCH,
    Problem,
    State,
    select,
    select_padded,
    spread_of_offsets,
)
from polhode.lightcurve._search import best_trials
from polhode.lightcurve._solutions import (
    EXCLUDED,
    FIXED,
    REACHED,
    LightCurveFit,
    Solution,
    bodies_of,
    change_of_directions,
    describe_solutions,
    frequencies,
    momentum,
    notes_on,
    notes_on_groups,
)
from polhode.lightcurve._verdict import judge, null_models

# The search. Its cost is dominated by light curves of trial bodies. Most bodies are therefore
# rejected by cheap scores: all draws by the Fourier series, a part of them by their misfit to
# `_FEW` points, the rest by a few least-squares steps on these points, with fewer bodies and more
# steps in each round (`_DESCENT`). Only the best are fitted to all points.

_FEW = BLOCK  # points that a search uses
_DESCENT = ((1.0, 2), (0.5, 3), (0.25, 6))  # rounds: part of the starts, and number of steps
_LAST = 12  # steps of the better half of the bodies after these rounds
_WIDE = 10.0  # limit of residuals in the first steps, in sigma
# Motions searched again with more poles: their number, trials of each, and the number of parts of
# these trials, each with its own frequencies.
_AGAIN, _MORE, _PARTS = 8, 2000, 6
_LIMIT = 3.0  # limit of residuals in the last steps of a search, in sigma
# Second round of a search: number of hypotheses, and repeats of the first; the 128th has half.
_LEADING, _OFTEN = 512, 3
_ALIKE = 4  # solutions per pair of periods: a motion and its three mirror images
_GROUPS = 8  # least number of groups from which the spread of their zero points is estimated


def fit_light_curve(
    curve: LightCurve,
    *,
    phase: AbstractPhase | None = None,
    pairs: Pairs | None = None,
    max_frequency: float | None = None,
    trials: int = 40_000,
    starts: int = 2,
    searches: int = 3,
    floor: float = 0.03,
    offset_sigma: float | None = None,
    limit: float = 3.0,
    seed: int = 0,
    max_solutions: int = 12,
    convex: bool | None = None,
    start: Sequence[Solution] | None = None,
    progress: Callable[[str], None] | None = None,
) -> LightCurveFit:
    """All tumbling bodies that explain a light curve, with a verdict; needs no starting guess.

    The search (docs/light_curves.md): pairs of frequencies from Fourier series, each with all its
    interpretations; ``trials`` ellipsoids of any inertia with these periods, with phases from the
    series and other parameters drawn at random; Levenberg-Marquardt, with exact derivatives, on the
    best ``starts`` of each interpretation, then again on the most probable; mirror images; the
    ``max_solutions`` best distinct solutions and all others that cannot be excluded. The search is
    repeated until two searches agree and the residuals correspond to the errors, at most
    ``searches`` times.

    ``phase``: a phase function (default: ``HG1G2()`` where the phase angle changes by more than 5
    degrees, else ``SeeligerPhase()``). ``pairs``: instead of those from the series.
    ``max_frequency``: the highest frequency of the search, per day. ``floor`` [mag]: added to the
    errors in quadrature, growing with the phase angle, for what an ellipsoid cannot represent.
    ``offset_sigma``: see ``LightCurve.columns``; None: for a calibrated curve with at least eight
    groups it is estimated from the best motion, and all bodies are fitted again with it. ``limit``:
    residuals beyond this many sigma count linearly, not by their square. ``convex``: whether convex
    shapes are fitted; None: if the directions to Sun or observer change by 5 degrees or more.
    ``start``: solutions of an earlier fit, such as one to fewer nights. They are fitted to this
    light curve first and count as a search; ``searches=0`` adds no other. ``progress`` is called
    with a short description of each stage. Needs float64 (``jax_enable_x64``).

    Raises RuntimeError in float32, ValueError for a light curve without directions, and for
    ``searches`` below 1, or 0 with ``start``.
    """
    # JAX defines this attribute at run time; its type stubs lack it
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise RuntimeError(
            "fits of light curves need float64: jax.config.update('jax_enable_x64', True)."
        )
    curve.require_points()
    curve._known_directions()
    check_max_frequency(curve.t, max_frequency)
    if searches < (0 if start else 1):
        raise ValueError(f"searches must be at least 1, or 0 with a start, got {searches}.")
    say = progress or (lambda words: None)
    say("searching pairs of frequencies")
    curve = curve.with_errors(floor)
    points = curve.points(floor, offset_sigma)
    if phase is None:
        phase = HG1G2() if np.ptp(curve.alpha) > np.radians(5) else SeeligerPhase()
    columns = curve.columns(np.inf)[0]
    if np.ptp(curve.alpha) > np.radians(1):
        columns = np.vstack([columns, curve.alpha, curve.alpha**2])
    if pairs is None:
        pairs = fourier_lattices(
            curve.t, curve.magnitude, columns=columns, max_frequency=max_frequency
        )
    if not np.isfinite(pairs.max_frequency):  # of the caller's pairs: estimates how many were tried
        pairs = pairs._replace(max_frequency=2 * float(max(pairs.f_phi.max(), pairs.f_psi.max())))
    meant = hypotheses(pairs, curve.t, curve.magnitude, columns=columns)
    key = jax.random.key(seed)
    rough, problem = Problem(phase, _subsample(points, _FEW)), Problem(phase, points)
    state, reproduced = None, False
    if start:
        say(f"fitting {len(start)} earlier solutions")
        bodies = select_padded(bodies_of(start, float(curve.t[0]), phase), np.arange(len(start)))
        state = problem.start(bodies, np.full(len(bodies.wxyz), _WIDE))
        state = _improve_best(problem, state, pairs.resolution, BATCH, limit, 30)
        state = _with_poles(jax.random.fold_in(key, 2), state, rough, problem, pairs.resolution)
        # the earlier fit's own searches found its best solution
        reproduced = searches == 0 and _is_best(start[0], state, pairs.resolution)
    for k in range(searches):
        say(f"search {k + 1} of at most {searches}: {len(meant.f_phi)} pairs of periods")
        key, search_key = jax.random.split(key)
        result = _search_once(
            search_key, meant, trials, starts, rough, problem, _blur(curve), pairs.resolution
        )
        if state is not None:
            agree = _searches_agree(state, result, pairs.resolution)
            # a motion that two searches found remains reproduced if a third one misses it
            reproduced = agree or (reproduced and state.cost.min() <= result.cost.min())
        state = result if state is None else _concatenate(state, result)
        # reproduced, with residuals that correspond to the errors: no further search is needed
        freedom = max(curve.t.size - state.matrix.shape[1], 1)
        if reproduced and state.cost.min() < REACHED * freedom:
            break
    assert state is not None
    say("fitting the best motions to all points")
    state = _with_poles(jax.random.fold_in(key, 1), state, rough, problem, pairs.resolution)
    state = _improve_best(problem, state, pairs.resolution, BATCH, limit, 60)
    if offset_sigma is None and curve.calibrated and len(curve.names) >= _GROUPS:
        best = select(state, int(np.argmin(state.cost)))
        groups = slice(1, 1 + len(curve.names))  # the first column is a constant
        offset_sigma = spread_of_offsets(
            best.matrix, best.right, best.offsets, problem.stiffness, groups
        )
        problem = Problem(phase, curve.points(floor, offset_sigma))
        state = _improve_best(problem, state, pairs.resolution, BATCH, limit, 30)
    normals = _mirrors(curve)
    order = _distinct_solutions(state, pairs.resolution, BATCH // 2)
    images = [_reflect(select_padded(state.bodies, order), normal) for normal in normals]
    images = jax.tree.map(lambda *x: np.concatenate([y[: len(order)] for y in x]), *images)
    images = select_padded(images, np.arange(len(images.wxyz)))
    width = np.full(len(images.wxyz), limit)
    mirrored = problem.improve(problem.start(images, width), width, 30)
    state = _concatenate(state, mirrored)
    order = _distinct_solutions(state, pairs.resolution, max(max_solutions, BATCH))
    described = describe_solutions(problem, state, order, curve, normals, limit)
    say("fitting noise alone and one period")
    linear, nulls = null_models(curve, pairs, offset_sigma, phase, limit)
    ellipsoids = described.solutions[:1]
    if convex is None:
        convex = change_of_directions(curve) >= FIXED
    if convex:
        say(f"fitting convex shapes to {len(described.solutions)} motions")
        exact = curve.points(0.0, offset_sigma)  # without the floor
        described = refined_solutions(described.solutions, linear, exact, phase, limit)
    solutions, scale, alike, linearised, refined_ellipsoid = described
    solutions = solutions[: max(max_solutions, sum(s.probability > EXCLUDED for s in solutions))]
    notes = notes_on(curve, solutions, scale, alike) + pairs.warnings()
    notes += notes_on_groups(curve, solutions[0].model - curve.magnitude, alike)
    if not reproduced:
        notes += (
            "No second search found the best motion again: better ones may have been missed. Ask"
            " for more trials or searches.",
        )
    judgement = judge(
        linear,
        nulls,
        pairs,
        solutions,
        reproduced=reproduced,
        limit=limit,
        others=ellipsoids,
        refined=() if refined_ellipsoid is None else (refined_ellipsoid,),
        linearised=linearised[: len(solutions)],
    )
    return LightCurveFit(
        solutions,
        curve,
        pairs,
        meant,
        scale,
        alike,
        offset_sigma,
        notes,
        judgement.verdict,
        judgement.reasons,
        judgement.par,
        judgement.models,
        judgement.misfit,
        judgement.agreement,
        phase,
    )


def _blur(curve: LightCurve) -> float:
    """Uncertainty of the frequencies of a series, by its grid and by the change of directions."""
    sun, observer = curve._known_directions()
    bisector = sun + observer
    bisector = bisector / np.linalg.norm(bisector, axis=1, keepdims=True)
    angle = np.arccos(np.clip((bisector @ bisector[:: max(1, len(bisector) // 50)].T).min(), -1, 1))
    return float((0.125 + angle / (2 * np.pi)) / np.ptp(curve.t))


def _second_round(meant: Hypotheses, least_cost: np.ndarray) -> Hypotheses:
    """Hypotheses for a second round, each repeated several times with its own trials and starts.

    They alternate between the most probable and those with the lowest ``least_cost`` (h,).
    """
    many = len(least_cost)
    place = np.minimum(np.arange(many), np.argsort(np.argsort(least_cost)) + 0.5)
    leading = np.argsort(place)[:_LEADING]
    repeats = np.rint(_OFTEN / (1 + np.arange(len(leading)) / (_LEADING / 4))).astype(int)
    index = np.repeat(leading, repeats)
    return Hypotheses(*(x[index] for x in meant))


def _search_once(
    key, meant, trials: int, starts: int, rough: Problem, problem: Problem, blur, resolution
) -> State:
    """One search: bodies of all hypotheses, a second round, more poles for the best periods."""
    own = jax.random.split(key, 3)
    state, reached = _descend(own[0], meant, trials, starts, rough, problem, blur)
    likely = _second_round(meant, reached)
    more, _ = _descend(own[2], likely, trials, starts, rough, problem, blur)
    state = _improve_best(problem, _concatenate(state, more), resolution, 3 * BATCH, _WIDE, 12)
    return _with_poles(own[1], state, rough, problem, resolution)


def _with_poles(key, state: State, rough: Problem, problem: Problem, resolution) -> State:
    """The best bodies, and further ones with the same periods, whose poles may be better."""
    near = _hypotheses_of_best(state, resolution)
    trials = _MORE * len(near.f_phi)
    near = Hypotheses(*(np.repeat(x, _PARTS) for x in near))
    more, _ = _descend(key, near, trials, 2, rough, problem, 0.5 * resolution)
    more = problem.start(more.bodies, np.full(len(more.cost), _WIDE))
    return _improve_best(problem, _concatenate(state, more), resolution, 2 * BATCH, _LIMIT, 12)


def _descend(key, meant, trials: int, keep: int, rough: Problem, whole: Problem, blur):
    """Least-squares steps from the ``keep`` best trials of every hypothesis, more for the best.

    Returns the bodies of the last rounds, and the lowest cost of each hypothesis.
    """
    best_drawn = best_trials(
        key, meant, trials, keep, rough.phase, whole.points, rough.points, blur
    )
    count = len(best_drawn.gain)
    bodies = select_padded(best_drawn.bodies, np.arange(count))
    # the gain multiplies the light's variations: a first correction of the axes' logarithms
    bodies.unknowns[:count, 2:4] *= best_drawn.gain[:, None]
    source = np.pad(best_drawn.source, (0, len(bodies.wxyz) - count), mode="edge")
    state = rough.start(bodies, np.full(len(bodies.wxyz), _WIDE))
    least_cost = np.full(len(meant.f_phi), np.inf)
    for part, steps in _DESCENT:
        best = np.argsort(state.cost)[: int(part * len(bodies.wxyz))]
        best = np.pad(best, (0, -len(best) % BATCH), mode="edge")
        source = source[best]
        state = rough.improve(select(state, best), np.full(len(best), _WIDE), steps)
        np.minimum.at(least_cost, source, state.cost)
    best = np.argsort(state.cost)[: len(state.cost) // 2]
    best = np.pad(best, (0, -len(best) % BATCH), mode="edge")
    last = rough.improve(select(state, best), np.full(len(best), _WIDE), _LAST)
    np.minimum.at(least_cost, source[best], last.cost)
    return _concatenate(state, last), least_cost


def _improve_best(problem: Problem, state: State, resolution, keep: int, limit: float, steps: int):
    """The ``keep`` best distinct bodies, after ``steps`` of least squares."""
    best = _distinct_solutions(state, resolution, keep)
    best = np.pad(best, (0, keep - len(best)), mode="edge")
    width = np.full(keep, limit)
    return problem.improve(problem.evaluate(*select(state[:2], best), width), width, steps)


def _hypotheses_of_best(state: State, resolution: float) -> Hypotheses:
    """The periods and modes of the best bodies, as hypotheses: up to `_AGAIN` distinct ones."""
    f_phi, f_psi, mode = frequencies(state.bodies)
    index: list[int] = []
    for k in np.argsort(state.cost):
        if len(index) < _AGAIN and np.isfinite(state.cost[k] + f_phi[k] + f_psi[k]):
            size = [
                max(abs(f_phi[k] - f_phi[j]), abs(f_psi[k] - f_psi[j]))
                for j in index
                if mode[j] == mode[k]
            ]
            if min(size, default=np.inf) > 0.3 * resolution:
                index.append(int(k))
    return Hypotheses(f_phi[index], f_psi[index], mode[index] == int(Mode.LAM))


def _searches_agree(one: State, other: State, resolution: float) -> bool:
    """Whether both states contain the best motion of the two, with any pole."""
    f_phi, f_psi, mode = zip(*(frequencies(s.bodies) for s in (one, other)))
    k = int(np.argmin([s.cost.min() for s in (one, other)]))
    best = int(np.argmin((one, other)[k].cost))
    same_motion = [
        (mode[j] == mode[k][best])
        & (abs(f_phi[j] - f_phi[k][best]) < 0.2 * resolution)
        & (abs(f_psi[j] - f_psi[k][best]) < 0.2 * resolution)
        for j in (0, 1)
    ]
    return all(x.any() for x in same_motion)


def _is_best(solution: Solution, state: State, resolution: float) -> bool:
    """Whether the best body of a state has the periods and the mode of a solution."""
    f_phi, f_psi, mode = frequencies(select(state.bodies, [int(np.argmin(state.cost))]))
    return bool(
        mode[0] == int(solution.mode)
        and abs(f_phi[0] - 1 / solution.P_phi) < 0.5 * resolution
        and abs(f_psi[0] - 1 / solution.P_psi) < 0.5 * resolution
    )


def _concatenate(*states: State) -> State:
    return jax.tree.map(lambda *x: np.concatenate(x), *states)


def _subsample(points: Points, count: int) -> Points:
    """At most ``count`` of the points, evenly spaced in number."""
    places = np.flatnonzero(np.asarray(points.weight[0]) > 0)
    if len(places) <= count:
        return points
    index = places[np.arange(count) * len(places) // count]
    return jax.tree.map(lambda x: x[..., index], points._replace(stiffness=None))._replace(
        stiffness=points.stiffness
    )


def _distinct_solutions(state: State, resolution: float, max_count: int) -> np.ndarray:
    """Indices of the ``max_count`` best solutions that differ in mode, frequencies or pole.

    At most `_ALIKE` have the same mode and frequencies, so that other motions are not crowded out.
    """
    f_phi, f_psi, mode = frequencies(state.bodies)
    pole = momentum(state.bodies)
    finite = np.isfinite(state.cost + f_phi + f_psi)
    index: list[int] = []
    for k in np.argsort(state.cost):
        if not finite[k]:
            continue
        same_motion = (
            (mode[index] == mode[k])
            & (abs(f_phi[index] - f_phi[k]) < 0.2 * resolution)
            & (abs(f_psi[index] - f_psi[k]) < 0.2 * resolution)
        )
        same_pole = same_motion & (pole[index] @ pole[k] > np.cos(np.radians(15)))
        if same_motion.sum() < _ALIKE and not same_pole.any():
            index.append(int(k))
        if len(index) == max_count:
            break
    return np.array(index)


def _mirrors(curve: LightCurve) -> np.ndarray:
    """Normals (3, 3) of the mirror planes that preserve the light of an ellipsoid.

    The plane of Sun and observer: exactly, while both remain in it. The plane perpendicular to the
    bisector of their directions, and the one perpendicular to these two planes: approximately, the
    better, the smaller the phase angle.
    """
    sun, observer = curve._known_directions()
    first = np.linalg.svd(np.vstack([sun, observer]))[2][-1]
    middle = (sun + observer).sum(0)
    middle = middle - first * (first @ middle)
    middle = middle / np.linalg.norm(middle)
    return np.stack([first, middle, np.cross(first, middle)])


def _reflect(bodies: Bodies, normal: np.ndarray) -> Bodies:
    """The motions reflected in a plane through Sun and observer, which gives the same light.

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
