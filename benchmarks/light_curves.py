"""How often a tumbling body is identified from its light curve, and the time of a trial.

The synthetic tumblers are ellipsoids whose inertia differs slightly from that of their shape, in
both modes. They are observed during nights of 6 hours with gaps, for a month of a circular orbit,
with noise and an offset for every night. Each case has one of these outcomes:

- right: the best solution has the right mode and both periods to 0.1 %;
- within its errors: right to three of the stated standard deviations, if these are larger;
- listed: not the best solution, but one in the list with odds above 1 in 1000;
- told: wrong, and a note says that it may be wrong;
- silent: wrong without a warning.

The search was developed on seeds 0 to 257; only other seeds are valid tests. ``--egg``: bodies that
are not ellipsoids. ``--real FOLDER`` adds 2012 TC4 and Toutatis, the latter with ``--seeds`` seeds
of the search, from the files that ``real`` reads.

    python -m benchmarks.light_curves [--first 258] [--count 50] [--noise 0.02 0.1] [--egg 5]
        [--real FOLDER] [--speed]
"""

import argparse
import csv
import itertools
import math
import sys
import time
from pathlib import Path

from benchmarks._report import one_thread, write

if __name__ == "__main__" and "--speed" in sys.argv:
    one_thread()

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import ConvexHull

import polhode as ph
from polhode import lightcurve
from polhode.lightcurve import _brightness, _fit, _frequencies, _least_squares, _search, _solutions

_magnitudes = jax.jit(_brightness.magnitudes, static_argnums=0)

VERDICTS = ("right", "within its errors", "listed", "told", "silent")
HIGHEST = 7.0  # end of the frequency search for synthetic tumblers [1/d]
TOUTATIS = {"P_phi": (7.41, 0.1), "P_psi": (5.38, 0.05), "pole": (180.2, -54.75)}


def directions(jd, lean=0.1):
    """Vectors [au] to Sun and observer, of a body at 1.8 au and an observer at 1 au on circles."""

    def circle(radius, longitude, tilt):
        return radius * np.stack(
            [np.cos(longitude), np.sin(longitude) * np.cos(tilt), np.sin(longitude) * np.sin(tilt)],
            -1,
        )

    body = circle(1.8, 0.25 + 2 * np.pi * jd / (365.25 * 1.8**1.5), lean)
    return -body, circle(1.0, 2 * np.pi * jd / 365.25, 0.0) - body


def synthetic(seed: int, noise: float, *, nights=24, days=80.0, each=20, spread=0.02, egg=False):
    """A light curve, its truth (P_phi, P_psi [day], mode, pole), and the body.

    ``each`` point of a night represents 15 minutes; above 0.05 mag of noise it is the mean of five
    measurements. ``egg``: the shape is `blunt` instead of an ellipsoid, and the moments are those
    of the homogeneous body.
    """
    rng = np.random.default_rng(seed)
    several = 5 if noise > 0.05 else 1
    each = each * several
    # two observatories, 8 hours apart, alternate; clouds remove a tenth of the points
    start = np.sort(rng.choice(int(days), nights, replace=False)) + rng.uniform(-0.05, 0.05, nights)
    start[0], start[-1] = 0.0, days
    start += np.where(rng.uniform(size=nights) < 0.5, 0, 1 / 3)
    t = np.sort((start[:, None] + rng.uniform(0, 0.25, (nights, each))), axis=1).reshape(-1)
    group = np.repeat(np.arange(nights), each)
    clouded = rng.uniform(size=t.size) < 0.1
    t, group = t[~clouded], group[~clouded]
    t = t - t[0]
    sun, observer = directions(t)
    while True:
        b = rng.uniform(0.35, 0.9)
        axes = np.array([1.0, b, b * rng.uniform(0.5, 0.95)])
        square = (axes * np.exp(0.05 * rng.normal(size=3))) ** 2
        moments = np.array([square[1] + square[2], square[0] + square[2], square[0] + square[1]])
        if egg:
            moments, vertices, faces = blunt(axes)
            square = (moments.sum() / 2 - moments) / (moments.sum() / 2 - moments).max()
            moments = square.sum() - square
        omega = rng.normal(size=3) / moments
        state = ph.State(rng.normal(size=4), omega)
        found = ph.periods(ph.Inertia(moments), state)
        P_phi = rng.uniform(0.35, 1.2)
        scale = float(found.P_phi) / P_phi
        P_psi, mode = float(found.P_psi) / scale, int(found.mode)
        nutation = float(found.theta_max - found.theta_min)
        wide = float(found.theta_max) > 0.25 if mode == 0 else nutation > 0.35
        # at least twenty revolutions, and not within 0.1 % of a permanent rotation
        if wide and 2 / P_phi + 2 / P_psi < 7 and P_psi < days / 20:
            break
    bodies = _brightness.Bodies(
        jnp.asarray(
            np.r_[np.log(square[1:] / square[0]) / 2, np.log(axes[1:]), omega * scale, 0.3, 0.35]
        )[None],
        state.wxyz[None],
    )
    blank = lightcurve.LightCurve.of(t, 0 * t, sun, observer, group=group, calibrated=True)
    points = blank.points(1.0)
    light = np.asarray(_magnitudes(lightcurve.HG1G2(), bodies, points))[0, : t.size]
    if egg:
        body, q = (
            lightcurve.Convex.from_mesh(vertices, faces),
            _brightness.attitudes(*bodies, points.t),
        )
        sun, observer = (
            jnp.stack(_brightness._to_body(q, v), -1)[0] for v in (points.sun, points.observer)
        )
        light = -2.5 * jnp.log10(body.brightness(sun, observer)) - points.sphere[0]
        light = light + lightcurve.HG1G2().magnitudes(points.alpha[0], bodies.unknowns[0, 7:])
        light = np.asarray(light)[: t.size]
    pole = _pole(bodies)
    light = light + noise * rng.normal(size=t.size) + spread * rng.normal(size=nights)[group]
    curve = blank._replace(magnitude=light, sigma=np.full(t.size, noise))
    if several > 1:
        curve = curve.binned(0.25 * several / each)
    return curve, {"P_phi": P_phi, "P_psi": P_psi, "mode": mode, "pole": pole}, bodies


def blunt(axes, blunting=3.0, taper=0.25):
    """Moments (3,), vertices and faces of a convex body in its principal axes.

    It is a superellipsoid with exponent ``blunting`` with one end thicker than the other: it is
    transformed by x -> x / (1 + taper x), a projective map that preserves convexity.
    """
    turn = np.linspace(0, 2 * np.pi, 49)[:-1]
    rise = np.linspace(-np.pi / 2, np.pi / 2, 25)[1:-1, None]
    ring = np.stack(
        [np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise) + 0 * turn]
    )
    unit = np.c_[ring.reshape(3, -1), [0, 0, -1], [0, 0, 1]].T
    unit = unit / (np.abs(unit) ** blunting).sum(1, keepdims=True) ** (1 / blunting)
    vertices = unit * axes / (1 + taper * unit[:, :1])
    hull = ConvexHull(vertices)
    a, b, c = (vertices[hull.simplices[:, k]] for k in range(3))
    outward = np.sum(np.cross(b - a, c - a) * hull.equations[:, :3], axis=1) > 0
    faces = np.where(outward[:, None], hull.simplices, hull.simplices[:, ::-1])
    tensor = ph.MassProperties.from_mesh(vertices, faces, density=1.0).inertia.tensor
    moments = np.diag(np.asarray(tensor))  # diagonal: the coordinate planes are planes of symmetry
    return moments, vertices, faces


def _pole(bodies):
    x, y, z = _solutions.momentum(bodies)[0]
    return math.degrees(math.atan2(y, x)) % 360, math.degrees(math.asin(z))


def apart(a, b) -> float:
    """Angle between two directions given by longitude and latitude [deg]."""
    a, b = np.radians(a), np.radians(b)
    value = np.sin(a[1]) * np.sin(b[1]) + np.cos(a[1]) * np.cos(b[1]) * np.cos(a[0] - b[0])
    return float(np.degrees(np.arccos(np.clip(value, -1, 1))))


def _right(solution, truth, tolerance=1e-3, sigmas=0.0) -> bool:
    """Whether mode and both periods agree, to ``tolerance`` or to ``sigmas`` stated errors."""
    return int(solution.mode) == truth["mode"] and all(
        abs(period / truth[name] - 1) < max(tolerance, sigmas * error / period)
        for name, period, error in (
            ("P_phi", solution.P_phi, solution.P_phi_std),
            ("P_psi", solution.P_psi, solution.P_psi_std),
        )
    )


def _verdict(fit, truth) -> str:
    """Outcome of a case, as defined in the docstring of the module."""
    if _right(fit.best, truth):
        return "right"
    if _right(fit.best, truth, sigmas=3.0):
        return "within its errors"
    said = any(word in note for note in fit.notes for word in ("Ambiguous", "No second search"))
    if any(_right(s, truth, sigmas=3.0) and s.probability > 1e-3 for s in fit.solutions):
        return "listed"
    return "told" if said or fit.scale > math.sqrt(_solutions.REACHED) else "silent"


def case(seed: int, noise: float, egg: bool = False, **options) -> dict:
    """Fit one synthetic tumbler: outcome, place in the list, and errors."""
    curve, truth, body = synthetic(seed, noise, egg=egg)
    began = time.process_time()
    # no convex shapes: the cost is compared with that of an ellipsoid fitted from the truth
    fit = lightcurve.fit_light_curve(
        curve, floor=0.01, max_frequency=HIGHEST, convex=False, **options
    )
    seconds = time.process_time() - began
    known = None if egg else best_possible(curve, body, fit.offset_sigma)
    place = next((k for k, s in enumerate(fit.solutions) if _right(s, truth)), None)
    best = fit.best
    return {
        "seed": seed,
        "noise": noise,
        "truth": truth,
        "verdict": _verdict(fit, truth),
        "place": place,
        "rms": best.rms,
        "cost": best.cost,
        "scale": fit.scale,
        "points": curve.t.size,
        "possible": known,
        "offset_sigma": fit.offset_sigma,
        "P_phi": best.P_phi,
        "P_psi": best.P_psi,
        "mode": best.mode.name,
        "odds": None if place is None else fit.solutions[place].probability,
        "pole_error_deg": apart(best.pole, truth["pole"]),
        "pole_error_listed_deg": min(apart(s.pole, truth["pole"]) for s in fit.solutions),
        "notes": fit.notes,
        "seconds": seconds,
    }


def best_possible(curve, body, learnt=None, floor=0.01, spread=0.02) -> dict:
    """Relative errors of the periods and robust cost of a fit that starts at the truth.

    The errors are computed with the known ``spread`` of the nights' offsets, the cost with the
    estimated one (``learnt``).
    """
    phase, width = lightcurve.HG1G2(), np.full(_least_squares.BATCH, 3.0)
    problem = _least_squares.Problem(phase, curve.points(floor, spread))
    start = _least_squares.select_padded(jax.tree.map(np.asarray, body), np.zeros(1, int))
    state = problem.improve(problem.start(start, width), width, 20)
    normals, one = _fit._mirrors(curve), np.array([0])
    (found,), *_ = _solutions.describe_solutions(problem, state, one, curve, normals, 3.0)
    problem = _least_squares.Problem(phase, curve.points(floor, learnt))
    state = problem.improve(problem.evaluate(*state[:2], width), width, 20)
    return {
        "P_phi_std": found.P_phi_std / found.P_phi,
        "P_psi_std": found.P_psi_std / found.P_psi,
        "cost": float(state.cost[0]),
    }


def summary(cases, noise: float) -> dict:
    """Counts of the outcomes at one noise level.

    ``determined``: only cases whose data determine both periods to 0.1 % at three sigma.
    """
    rows = [r for r in cases if r["noise"] == noise]
    sharp = [
        r for r in rows if 3 * max(r["possible"]["P_phi_std"], r["possible"]["P_psi_std"]) < 1e-3
    ]

    def counts(some):
        return {name: sum(r["verdict"] == name for r in some) for name in VERDICTS}

    return {
        "noise": noise,
        "cases": len(rows),
        **counts(rows),
        "determined": {"cases": len(sharp), **counts(sharp)},
        "pole_within_10_deg_listed": sum(r["pole_error_listed_deg"] < 10 for r in rows),
        "seconds_median": float(np.median([r["seconds"] for r in rows])) if rows else None,
    }


def speed(states: int = 100_000, samples: int = 400) -> dict:
    """Time [s] to score trial states, without compilation."""
    curve, *_ = synthetic(0, 0.02)
    keep = np.linspace(0, curve.t.size - 1, samples - samples % 128).astype(int)
    sun, observer = directions(np.sort(curve.t[keep]))
    t = np.linspace(0, 25.0, samples)
    sun, observer = directions(t)
    points = lightcurve.LightCurve.of(t, 0 * t, sun, observer).points(0.02)
    one = _frequencies.Hypotheses(np.array([1.0]), np.array([1.3]), np.array([True]))
    phase = lightcurve.HG1G2()
    bodies, _ = _search.build(*_search.draw(jax.random.key(0), one, states), phase)
    _search.misfits(phase, jax.tree.map(lambda x: x[: _search.CHUNK], bodies), points)
    began = time.perf_counter()
    _search.misfits(phase, bodies, points)
    taken = time.perf_counter() - began
    return {"states": states, "samples": samples, "seconds": taken}


def toutatis(folder: Path):
    """The photometry of Spencer et al. 1995 as a light curve."""

    def rows(name):
        lines = [x for x in (folder / name).read_text().splitlines() if not x.startswith("#")]
        return list(csv.DictReader(lines))

    seen, geometry = rows("toutatis_1992.csv"), rows("toutatis_1992_directions.csv")

    def column(table, *names):
        return np.array([[float(row[n]) for n in names] for row in table])

    r, delta, magnitude, error = column(seen, "r_au", "delta_au", "mag", "mag_err").T
    return lightcurve.LightCurve.of(
        column(geometry, "jd_utc_target")[:, 0],
        magnitude - 5 * np.log10(r * delta),
        column(geometry, "sx", "sy", "sz"),
        column(geometry, "ox", "oy", "oz"),
        sigma=error,
        group=[row["observer"] for row in seen],
        calibrated=True,
        at_body=True,
        reduced=True,
    )


def radar(folder: Path, solution, start: float, until=2449000.0 + 365) -> list[float]:
    """Angles [deg] between a solution's attitudes and those by radar.

    The light of an ellipsoid is the same after half turns about its axes: of the four equivalent
    attitudes the one that fits best is used.
    """
    lines = (folder / "toutatis_radar_epochs.csv").read_text().splitlines()
    table = list(csv.DictReader(x for x in lines if not x.startswith("#")))
    jd = np.array([float(row["jd_utc"]) for row in table])
    table, jd = [row for row, at in zip(table, jd) if at < until], jd[jd < until]
    names = ("alpha_deg", "beta_deg", "gamma_deg")
    angles = np.radians([[float(row[n]) for n in names] for row in table])
    seen = [_passive(*row).T for row in angles]  # body -> space
    ts = np.r_[start, jd] - start
    order = np.argsort(solution.moments)  # long, middle, short
    path = ph.simulate(
        ph.Scene(ph.Inertia(solution.moments)), ph.State(solution.wxyz, solution.omega_body), ts
    )
    mine = np.asarray(ph.rotation.wxyz_to_matrix(path.wxyz[1:]))[:, :, order]
    seen = np.array(seen)[:, :, [2, 0, 1]]  # from the source's axes middle, short, long
    hand = np.linalg.det(mine[0]) * np.linalg.det(seen[0])
    turns = [e for e in itertools.product((1, -1), repeat=3) if np.prod(e) * hand > 0]
    traces = np.einsum("nij,nij,ej->en", mine, seen, np.array(turns, float))
    angles = np.degrees(np.arccos(np.clip((traces - 1) / 2, -1, 1)))
    return min(angles.tolist(), key=np.median)


def _passive(alpha, beta, gamma):
    """The matrix R3(gamma) R1(beta) R3(alpha), space -> body."""

    def about(axis, angle):
        c, s = np.cos(angle), np.sin(angle)
        return np.array(
            [[c, s, 0], [-s, c, 0], [0, 0, 1]] if axis == 3 else [[1, 0, 0], [0, c, s], [0, -s, c]]
        )

    return about(3, gamma) @ about(1, beta) @ about(3, alpha)


def real(folder: Path, seeds: int, **options) -> dict:
    """Fit 2012 TC4 and Toutatis."""
    tc4 = lightcurve.fit_light_curve(
        lightcurve.read_light_curve(folder / "tc4_2012.csv", folder / "tc4_2012_vectors.csv"),
        **options,
    )
    minutes = [(s.P_phi * 1440, s.P_psi * 1440, s.mode.name, s.rms) for s in tc4.solutions]
    print(minutes, flush=True)
    curve, runs = toutatis(folder), []
    for seed in range(seeds):
        fit = lightcurve.fit_light_curve(curve, floor=0.05, seed=seed, **options)
        listed = []
        for k, s in enumerate(fit.solutions):
            errors = radar(folder, s, curve.t[0])
            listed.append(
                {
                    "number": k,
                    "P_phi": s.P_phi,
                    "P_psi": s.P_psi,
                    "mode": s.mode.name,
                    "rms": s.rms,
                    "odds": s.probability,
                    "pole": s.pole.tolist(),
                    "moments": s.moments.tolist(),
                    "moments_std": s.moments_std.tolist(),
                    "mirror_of": s.mirror_of,
                    "pole_error_deg": apart(s.pole, TOUTATIS["pole"]),
                    "radar_median_deg": float(np.median(errors)),
                }
            )
            print(seed, listed[-1], flush=True)
        print(fit.notes, flush=True)
        runs.append({"seed": seed, "solutions": listed, "notes": fit.notes})
    return {"tc4_minutes": minutes, "toutatis": runs}


def best_solutions(runs: list[dict], count: int = 4) -> list[dict]:
    """The first solutions of each seed."""
    return [{"seed": run["seed"], **row} for run in runs for row in run["solutions"][:count]]


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--first", type=int, default=258)
    parser.add_argument("--noise", type=float, nargs="*", default=[0.02, 0.1])
    parser.add_argument("--trials", type=int, default=40_000)
    parser.add_argument("--egg", type=int, default=0)
    parser.add_argument("--real", type=Path)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--speed", action="store_true")
    parser.add_argument("--output", type=Path)
    given = parser.parse_args()
    result: dict = {}

    def keep(name, value):
        """Write the file after each case, so that a long run can be read before it ends."""
        result[name] = value
        return write("light_curves", result, path=given.output)

    if given.speed:
        print(keep("speed", speed()), result["speed"], flush=True)
    if given.real:
        keep("real", real(given.real, given.seeds, trials=given.trials))
        keep("toutatis", best_solutions(result["real"]["toutatis"]))
    for name, egg, count, noises in (
        ("eggs", True, given.egg, [0.02]),
        ("cases", False, given.count, given.noise),
    ):
        rows: list[dict] = []
        for seed in range(given.first, given.first + count):
            for noise in noises:
                rows.append(case(seed, noise, egg, trials=given.trials))
                keep(name, rows)
                if not egg:
                    keep("summary", [summary(rows, each) for each in given.noise])
                print(_line(rows[-1]), flush=True)
    print(result.get("summary"))


def _line(row) -> str:
    t = row["truth"]
    return (
        f"{row['noise']} {row['seed']:3d} {row['verdict']}, place {row['place']}"
        f" {ph.Mode(t['mode']).name} {t['P_phi']:.4f} {t['P_psi']:.4f} found {row['mode']}"
        f" {row['P_phi']:.4f} {row['P_psi']:.4f} rms {row['rms']:.3f} scale {row['scale']:.2f}"
        f" pole {row['pole_error_deg']:.0f} ({row['pole_error_listed_deg']:.0f})"
        f" {row['seconds']:.0f} s"
    )


if __name__ == "__main__":
    main()
