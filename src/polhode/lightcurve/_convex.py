"""Bodies with a convex shape: refined ellipsoid solutions, and rotators about a fixed axis."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from polhode import rotation
from polhode._closed_forms import Mode
from polhode.lightcurve._brightness import (
    AbstractPhase,
    Bodies,
    Convex,
    Points,
    _cross,
    _to_body,
    attitudes,
    harmonics,
    moments_of,
)
from polhode.lightcurve._least_squares import damped_steps, next_damping, stepped
from polhode.lightcurve._nulls import Linear
from polhode.lightcurve._solutions import (
    Described,
    Linearised,
    Solution,
    covariance_of_periods,
    derivatives_of_derived,
    effective_correlation,
    ellipsoid_of,
    frequencies,
    momentum,
    pole_std_of,
    same_periods,
)

# The surface density is that of an ellipsoid times spherical harmonics. An ellipsoid fitted to a
# body of another shape biases the periods by several of its own standard errors and leaves
# correlated residuals. With a free convex shape errors and residuals are at the level of the noise.

DEGREE = 6
HARMONICS = (DEGREE + 1) ** 2 - 1  # without l = 0: a constant factor is an offset of the magnitudes
_FACETS = 800
# Standard deviations of the priors: of each coefficient, of the sum of areas times normals over the
# area, and of the logarithms of the axes of the inertia about those of the fitted ellipsoid.
_HARMONIC_SIGMA, _CLOSED_SIGMA, _INERTIA_SIGMA = 0.3, 0.02, 0.25
_STEPS, _ENDING = 25, 1e-3  # maximum number of steps, and the decrease of the cost that ends them
_MOTION = np.array([0, 1, 4, 5, 6])  # unknowns of the motion: inertia (2) and rates (3)


class Refined(NamedTuple):
    """A body with a convex shape."""

    body: Bodies  # a single body, (1, ...)
    coefficients: np.ndarray  # (k,) of the harmonics, l from 1 on
    chi2: float  # robust, of the points, by their own errors
    cost: float  # chi2 and the priors
    covariance: np.ndarray  # (8, 8) of inertia, rates and rotation vector, for unit errors
    values: np.ndarray  # residuals (n,) [mag], model minus data
    parameters: float  # effective number of parameters that the points determine
    linearised: Linearised


@jax.jit
def _light(body: Bodies, coefficients, points: Points, surface):
    """Magnitudes (n,) of the Lommel-Seeliger law, and their derivatives by motion (n, 8) and
    coefficients (n, k); the sum of areas times normals over the area (3,), its derivatives (3, k).
    """
    normals, density, rows = surface
    u, wxyz = body
    areas = density * jnp.exp(coefficients @ rows)

    def attitude_after(step):
        q = attitudes(u.at[:, jnp.asarray(_MOTION)].add(step), wxyz, points.t)
        assert q is not None  # for the type checker: attitudes are requested
        return tuple(x[0] for x in q)

    q, along = jax.linearize(attitude_after, jnp.zeros(5, u.dtype))

    def brightness_of(q, turn):
        def body_axes(vector):
            space = tuple(
                a[0] - b for a, b in zip(vector, _cross(turn, tuple(x[0] for x in vector)))
            )
            return jnp.stack(_to_body(q, space), -1)

        mu0 = jnp.maximum(body_axes(points.sun) @ normals.T, 0)
        mu = jnp.maximum(body_axes(points.observer) @ normals.T, 0)
        both = mu * mu0
        parts = both / jnp.where(both > 0, mu + mu0, 1) * areas[None]
        total = jnp.maximum(jnp.sum(parts, axis=-1), 1e-12)
        return -2.5 * jnp.log10(total), (parts, total)

    zero = tuple(jnp.zeros(points.t.shape[1], u.dtype) for _ in range(3))
    value, pull, (parts, total) = jax.vjp(brightness_of, q, zero, has_aux=True)
    by_q, by_turn = pull(jnp.ones_like(value))
    turned = jax.vmap(along)(jnp.eye(5, dtype=u.dtype))
    motion = sum(a[None] * b for a, b in zip(by_q, turned, strict=True))
    by_shape = -2.5 / jnp.log(10.0) * (parts @ rows.T) / total[:, None]
    area = jnp.sum(areas)
    open_area = areas @ normals / area
    by_open = (rows * areas[None]) @ normals / area - jnp.outer(rows @ areas, open_area) / area
    return value, jnp.concatenate([motion, jnp.stack(by_turn)]).T, by_shape, open_area, by_open


def refine(
    body: Bodies,
    linear: Linear,
    points: Points,
    phase: AbstractPhase,
    limit: float,
    *,
    rotating: bool = False,
) -> Refined:
    """Least-squares fit of motion, inertia and a convex shape, starting from an ellipsoid.

    ``body``: a single one, (1, ...). Offsets, and a phase function quadratic in the phase angle in
    addition to the body's own, are projected out. Residuals beyond ``limit`` sigma count linearly.
    ``rotating``: the body rotates about its third axis throughout, with a fixed inertia.
    """
    moving = np.isin(np.arange(8), (4, 5, 6, 7)) if rotating else np.full(8, True)
    n, many = linear.t.size, len(phase.typical)
    normals = np.asarray(Convex.from_ellipsoid(jnp.ones(3), _FACETS).normals)
    rows = np.asarray(harmonics(jnp.asarray(normals), DEGREE))[1:]
    square = np.exp(2 * np.r_[0.0, np.asarray(body.unknowns)[0, 2:4]])
    density = np.prod(square) / (normals**2 @ square) ** 2
    surface = tuple(map(jnp.asarray, (normals, density, rows)))
    own = np.asarray(
        phase.magnitudes(points.alpha[0], jnp.asarray(body.unknowns)[0, 7 : 7 + many])
        - points.sphere[0]
    )[:n]
    start = np.asarray(body.unknowns)[0, :2].copy()
    prior_precision = np.diag(
        np.r_[
            np.full(2, _INERTIA_SIGMA**-2.0), np.zeros(6), np.full(HARMONICS, _HARMONIC_SIGMA**-2.0)
        ]
    )

    def evaluated(body, coefficients):
        out = _light(body, jnp.asarray(coefficients), points.without_offsets(), surface)
        value, motion, shape, open_area, by_open = map(np.asarray, out)
        whole = np.hstack([np.where(moving, motion, 0.0), shape])[:n]
        rest = linear.projected(value[:n] + own) - linear.data
        return rest, whole, open_area, by_open

    def robust_cost(rest):
        squared = (rest / limit) ** 2
        return float(2 * limit**2 * np.sum(squared / (1 + np.sqrt(1 + squared))))

    def costed(rest, coefficients, body, open_area):
        chi2 = robust_cost(rest)
        off = np.asarray(body.unknowns)[0, :2] - start
        prior = (off**2).sum() * prior_precision[0, 0] + (coefficients**2).sum() * prior_precision[
            -1, -1
        ]
        return chi2, chi2 + prior + float((open_area**2).sum()) / _CLOSED_SIGMA**2

    coefficients, damping, quiet = np.zeros(HARMONICS), 1e-2, 0
    body = Bodies(jnp.asarray(body.unknowns), jnp.asarray(body.wxyz))
    rest, slopes, open_area, by_open = evaluated(body, coefficients)
    chi2, cost = costed(rest, coefficients, body, open_area)

    def normal(rest, slopes, open_area, by_open, body, coefficients):
        weight = 1 / np.sqrt(1 + (rest / limit) ** 2)
        whole = linear.projected(slopes)
        data = (whole.T * weight) @ whole
        matrix, right = data + prior_precision, (whole.T * weight) @ rest
        off = np.asarray(body.unknowns)[0, :2] - start
        right[:2] += off * prior_precision[0, 0]
        right[8:] += coefficients * prior_precision[-1, -1] + by_open @ open_area / _CLOSED_SIGMA**2
        matrix[8:, 8:] += by_open @ by_open.T / _CLOSED_SIGMA**2
        return data, matrix, right

    for _ in range(_STEPS):
        _, matrix, right = normal(rest, slopes, open_area, by_open, body, coefficients)
        limited = np.delete(np.arange(len(matrix)), (2, 3, 4))  # all but the rates
        (step,) = damped_steps(matrix[None], right[None], damping, limited)
        change = np.zeros((1, body.unknowns.shape[1] + 3))
        change[0, _MOTION], change[0, -3:] = step[:5], step[5:8]
        # ``stepped`` corrects the rates by derivatives of the periods, which do not exist at a
        # permanent rotation
        if rotating:
            turn = rotation.rotation_vector_to_wxyz(jnp.asarray(change[:, -3:]))
            trial = Bodies(
                body.unknowns + change[:, :-3],
                rotation.normalise(rotation.multiply(turn, body.wxyz)),
            )
        else:
            trial = stepped(body, change)
        new = evaluated(trial, coefficients + step[8:])
        new_chi2, new_cost = costed(new[0], coefficients + step[8:], trial, new[2])
        better = np.isfinite(new_cost) and new_cost < cost
        gain = cost - new_cost if better else 0.0
        small = gain < _ENDING * max(1.0, 1e-3 * cost) if better else damping > 10
        quiet = quiet + 1 if small else 0
        if better:
            body, coefficients = trial, coefficients + step[8:]
            (rest, slopes, open_area, by_open), chi2, cost = new, new_chi2, new_cost
        damping = float(next_damping(damping, better))
        if quiet == 3:
            break
    data, matrix, right = normal(rest, slopes, open_area, by_open, body, coefficients)
    pull = linear.projected(slopes).T @ (rest / np.sqrt(1 + (rest / limit) ** 2))
    inverse = np.linalg.pinv(matrix, hermitian=True)
    return Refined(
        jax.tree.map(np.asarray, body),
        coefficients,
        chi2,
        cost,
        inverse[:8, :8],
        rest[:n] / linear.root,
        float(np.trace(inverse @ data)),
        _linearised(
            rest[:n], slopes * linear.root[:, None], matrix - data, right - pull, linear
        )._replace(prior_cost=cost - robust_cost(rest[:n])),
    )


def _linearised(
    residuals: np.ndarray,
    derivatives: np.ndarray,
    prior: np.ndarray,
    gradient: np.ndarray,
    linear: Linear,
) -> Linearised:
    """The ``Linearised`` model, with the columns of ``linear`` (such as offsets) as unknowns."""
    many, columns = derivatives.shape[1], (linear.columns * linear.root).T
    full = np.zeros((many + columns.shape[1],) * 2)
    full[:many, :many] = prior
    full[many:, many:] = np.diag(linear.stiffness)
    # The offsets solve the least squares with their priors: both gradients cancel at the solution.
    pull = np.where(linear.stiffness > 0, -residuals @ columns, 0.0)
    return Linearised(residuals, np.hstack([derivatives, columns]), full, np.r_[gradient, pull])


def refined_solutions(
    solutions: tuple[Solution, ...],
    linear: Linear,
    points: Points,
    phase: AbstractPhase,
    limit: float,
) -> Described:
    """The solutions refitted with convex shapes, the best first. ``solutions``: the best first.

    The errors of a period include its spread over the other poles with the same periods, weighted
    by their odds.
    """
    curve = linear.curve
    bodies = [refine(ellipsoid_of(s), linear, points, phase, limit) for s in solutions]
    order = sorted(range(len(bodies)), key=lambda k: bodies[k].cost)
    best = bodies[order[0]]
    scale = float(np.sqrt(best.chi2 / max(linear.independent - best.parameters, 1.0)))
    limited = np.clip(best.values * linear.root, -limit * scale, limit * scale)
    alike = effective_correlation(curve, limited)
    root = np.sqrt(alike) * scale
    candidates = [
        _solution(solutions[k], bodies[k], linear, scale, root, limit, best.cost) for k in order
    ]
    roots = [k if solutions[k].mirror_of is None else solutions[k].mirror_of for k in order]
    resolution = 1 / float(np.ptp(curve.t))
    distinct = _without_copies(candidates, resolution)
    out: list[Solution] = []
    first: dict[int | None, int] = {}
    for k in distinct:
        place = first.setdefault(roots[k], len(out))
        out.append(candidates[k]._replace(mirror_of=None if place == len(out) else place))
    linearised = tuple(bodies[order[k]].linearised for k in distinct)
    return Described(
        _with_spread_of_poles(out, resolution),
        scale,
        alike,
        linearised,
        candidates[order.index(0)],
    )


def rotating_body(
    linear: Linear, ellipsoid: np.ndarray, points: Points, phase: AbstractPhase, limit: float
) -> Refined:
    """A convex body that rotates about one axis, from ``parameters`` (6,) of a `Rotator`."""
    second, third, longitude, latitude, turn, frequency = ellipsoid
    c, s, cb, sb = (f(x) for x in (longitude, latitude) for f in (np.cos, np.sin))
    frame = np.array([[sb * c, sb * s, -cb], [-s, c, 0], [cb * c, cb * s, sb]])
    ca, sa = np.cos(turn), np.sin(turn)
    matrix = np.array([[ca, sa, 0], [-sa, ca, 0], [0, 0, 1]]) @ frame
    # any inertia whose third axis has the largest moment: the rotation does not depend on it
    unknowns = np.r_[np.log([0.8, 0.6]), second, third, 0, 0, 2 * np.pi * frequency, phase.typical]
    wxyz = np.asarray(rotation.matrix_to_wxyz(jnp.asarray(matrix.T)))
    body = Bodies(unknowns[None], wxyz[None])
    return refine(body, linear, points, phase, limit, rotating=True)


def _solution(
    old: Solution, body: Refined, linear: Linear, scale: float, root: float, limit, least: float
) -> Solution:
    unknowns, wxyz = (x[0] for x in body.body)
    f_phi, f_psi, mode = (x[0] for x in frequencies(body.body))
    slopes = derivatives_of_derived(body.body)[0]
    places = np.r_[_MOTION, len(unknowns) + np.arange(3)]
    spread = root**2 * slopes[:, places] @ body.covariance @ slopes[:, places].T
    std = np.sqrt(np.maximum(np.diag(spread), 0))
    if not np.isfinite(body.cost + f_phi + f_psi + std.sum()):
        return old._replace(cost=np.inf, probability=0.0)
    moments = np.array(moments_of(unknowns))
    pole = momentum(body.body)[0]
    residuals = body.values * linear.root / scale
    return old._replace(
        P_phi=float(1 / f_phi),
        P_psi=float(1 / f_psi),
        P_phi_std=float(std[0] / f_phi),
        P_psi_std=float(std[1] / f_psi),
        mode=Mode(int(mode)),
        rms=float(np.sqrt(np.average(body.values**2, weights=linear.root**2))),
        cost=body.cost,
        probability=float(np.exp(-(body.cost - least) / 2 / root**2)),
        moments=moments / moments.max(),
        moments_std=std[2:5],
        pole=np.degrees(
            [np.arctan2(pole[1], pole[0]) % (2 * np.pi), np.arcsin(np.clip(pole[2], -1, 1))]
        ),
        pole_std=pole_std_of(std[5:]),
        wxyz=wxyz,
        omega_body=unknowns[4:7],
        offsets=linear.offsets(body.values, old),
        model=linear.curve.magnitude + body.values,
        weights=1 / np.sqrt(1 + (residuals / limit) ** 2),
        harmonics=body.coefficients,
        parameters=body.parameters,
        epoch=float(linear.curve.t[0]),
        covariance=covariance_of_periods(spread, f_phi, f_psi),
    )


def _without_copies(solutions: list[Solution], resolution: float) -> list[int]:
    """Indices of the solutions that differ in periods, or by 10 degrees in the pole."""
    classes = same_periods(solutions, resolution)
    poles = np.radians([s.pole for s in solutions])
    poles = np.stack(
        [
            np.cos(poles[:, 1]) * np.cos(poles[:, 0]),
            np.cos(poles[:, 1]) * np.sin(poles[:, 0]),
            np.sin(poles[:, 1]),
        ],
        -1,
    )
    distinct: list[int] = []
    for k in range(len(solutions)):
        same_periods_as = [j for j in distinct if classes[j] == classes[k]]
        if not same_periods_as or (poles[same_periods_as] @ poles[k]).max() < np.cos(
            np.radians(10)
        ):
            distinct.append(k)
    return distinct


def _with_spread_of_poles(solutions: list[Solution], resolution: float) -> tuple[Solution, ...]:
    classes = np.array(same_periods(solutions, resolution))
    odds = np.array([s.probability for s in solutions])
    out = []
    for k, s in enumerate(solutions):
        same = classes == classes[k]
        weight = odds * same / max((odds * same).sum(), 1e-300)
        change = {}
        covariance = None if s.covariance is None else s.covariance.copy()
        for i, name in enumerate(("P_phi", "P_psi")):
            period = getattr(s, name)
            apart = np.array([getattr(x, name) for x in solutions]) - period
            change[name + "_std"] = float(
                np.sqrt(getattr(s, name + "_std") ** 2 + weight @ apart**2)
            )
            if covariance is not None:
                covariance[i, i] = change[name + "_std"] ** 2
        out.append(s._replace(**change, covariance=covariance))
    return tuple(out)
