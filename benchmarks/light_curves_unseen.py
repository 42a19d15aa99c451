"""Verdicts on light curves of bodies that the model of the fit does not contain.

Bodies are convex polyhedra: hulls of 12 to 60 random points near an ellipsoid, whose moments of
inertia differ by up to 4 % from those of a homogeneous interior. Their motion is computed from
SciPy's Jacobi elliptic functions and a Fourier series of the precession rate; their brightness is a
sum over facets with a mixture of the Lommel-Seeliger and Lambert laws and a phase function. The
light curves are computed without any function of the package.

Of every 14 curves 10 are tumblers (P_phi 2 to 30 h, both modes), 2 rotate about their short axis,
1 is noise alone, 1 is a tumbler with 12 to 34 points. Each is observed in 10 to 20 nights within 15
to 60 days from one or two observatories, with 2 to 5 % noise, a part of which is correlated over
half an hour, zero points of nights that differ by 0.03 mag, and gaps due to clouds. Two thirds are
calibrated.

Every curve is fitted with the default settings and appended to a file of JSON lines, so that a run
can be stopped and continued: curves that the file already contains are not fitted again.

    nice python -m benchmarks.light_curves_unseen [--first 0] [--count 140] [--lines FILE]
    python -m benchmarks.light_curves_unseen --count 0      # the summary of FILE alone
"""

import argparse
import json
import math
import time
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull
from scipy.special import ellipj, ellipk

from benchmarks._report import OUT, commit, one_thread, write

KINDS = ("tumbler",) * 5 + ("rotator", "noise") + ("tumbler",) * 5 + ("rotator", "few")
RIGHT = {"rotator": "ONE_PERIOD", "noise": "NO_SIGNAL", "few": "TOO_FEW_POINTS"}
TUMBLERS = {
    "right": "true periods and mode in first place, TUMBLING",
    "right, ambiguous": "true periods and mode in first place, AMBIGUOUS",
    "listed": "in the list, AMBIGUOUS",
    "told": "not in the list, AMBIGUOUS",
    "denied": "not called tumbling",
    "silent": "other periods, TUMBLING",
}
FRESH = 20  # curves between clearings of JAX's caches: each program uses memory maps
LIGHT_TIME = 499.00478384 / 86400  # days per au
OFFSET = 0.03  # standard deviation of the zero points of nights [mag]


def kind_of(seed: int) -> str:
    """Kind of the light curve with this seed."""
    return KINDS[seed % len(KINDS)]


def polyhedron(rng):
    """Normals (f, 3), areas (f,) and ascending moments (3,) of a random body, in principal axes.

    Volume integrals are sums over the tetrahedra between the facets and the centre.
    """
    count = int(rng.integers(12, 61))
    points = rng.normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    middle = rng.uniform(0.5, 0.9)
    axes = np.array([1.0, middle, middle * rng.uniform(0.55, 0.95)])
    vertices = points * axes * np.exp(0.1 * rng.normal(size=(count, 1)))
    hull = ConvexHull(vertices)
    corners = vertices[hull.simplices]  # (f, 3, 3)
    outward = hull.equations[:, :3]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    volume = np.abs(np.einsum("fk,fk->f", corners[:, 0], cross)) / 6  # the origin is inside
    centre = (volume[:, None] * corners.sum(1) / 4).sum(0) / volume.sum()
    # second moments of a tetrahedron with one corner at the origin
    total = corners.sum(1)
    second = np.einsum("f,fi,fj->ij", volume / 20, total, total)
    second += np.einsum("f,fci,fcj->ij", volume / 20, corners, corners)
    second = second / volume.sum() - np.outer(centre, centre)
    spread, frame = np.linalg.eigh(second)  # ascending: the long axis last
    order = [2, 1, 0]
    spread, frame = spread[order], frame[:, order]
    frame *= np.linalg.det(frame)
    spread = np.sort(spread * np.exp(0.04 * rng.uniform(-1, 1, 3)))[::-1]
    return outward @ frame, np.linalg.norm(cross, axis=1) / 2, spread.sum() - spread


class Motion:
    """Free motion about the long (LAM) or short (SAM) axis; Landau & Lifshitz, Mechanics, sec. 37.

    ``moments`` are ascending; ``part`` extends from 0 (rotation about the axis) to 1 (the
    separatrix); the unit of time is one day. The angular momentum is along z.
    """

    def __init__(self, moments, long_axis: bool, part: float, P_phi: float):
        a, b, c = self.moments = np.asarray(moments, float)
        axis = a if long_axis else c
        energy = (1 / axis + part * (1 / b - 1 / axis)) / 2  # of unit angular momentum
        high, low = 2 * energy * c - 1, 1 - 2 * energy * a
        sizes = np.sqrt([high / (a * (c - a)), 0, low / (c * (c - a))])
        if long_axis:
            sizes[1] = math.sqrt(low / (b * (b - a)))
            self.rate = math.sqrt((b - a) * high / (a * b * c))
            self.m = (c - b) * low / (b - a) / high
        else:
            sizes[1] = math.sqrt(high / (b * (c - b)))
            self.rate = math.sqrt((c - b) * low / (a * b * c))
            self.m = (b - a) * high / (c - b) / low
        self.sizes, self.long_axis, self.energy = sizes, long_axis, energy
        self.period = 4 * float(ellipk(self.m)) / self.rate
        grid = np.arange(2048) * self.period / 2048
        waves = np.fft.rfft(self.precession(self.momentum(grid))) / 2048
        waves[np.abs(waves) < 1e-14 * abs(waves[0])] = 0
        self.mean, self.waves = waves[0].real, waves
        self.scale = 2 * np.pi / self.mean / P_phi  # time unit of L = 1 per day
        self.P_phi, self.P_psi = P_phi, self.period / self.scale

    def momentum(self, t):
        """Angular momentum in body axes (n, 3) at times in the units in which |L| = 1."""
        sn, cn, dn, _ = ellipj(self.rate * np.asarray(t), self.m)
        parts = (dn, sn, cn) if self.long_axis else (cn, sn, dn)
        return np.stack(parts, -1) * self.sizes * self.moments

    def precession(self, momentum):
        """Precession rate of the long axis about the momentum."""
        across = momentum[:, 1:] ** 2
        return (across / self.moments[1:]).sum(1) / across.sum(1)

    def tilt(self) -> float:
        """Largest angle [rad] between the axis of the mode and the momentum."""
        momentum = self.momentum(np.linspace(0, self.period, 200))
        return float(np.arccos(np.abs(momentum[:, 0 if self.long_axis else 2]).min()))

    def attitudes(self, t, start: float, turn: float):
        """Matrices (n, 3, 3), body to space, at ``t`` [day]; ``start`` and ``turn`` are phases as
        fractions of their periods.
        """
        own = np.asarray(t) * self.scale + start * self.period
        order = np.flatnonzero(self.waves)[1:]
        series = self.waves[order] * self.period / (2j * np.pi * order)
        wave = np.exp(2j * np.pi * np.outer(own / self.period, order))
        phi = self.mean * own + 2 * (wave @ series).real + 2 * np.pi * turn
        m = self.momentum(own)
        cosine = m[:, :1]
        sine = np.sqrt(1 - cosine**2)
        x = np.broadcast_to([1.0, 0, 0], m.shape)
        second = (x - cosine * m) / sine
        body = np.stack([m, second, np.cross(m, second)], -1)
        c, s, zero = np.cos(phi), np.sin(phi), np.zeros_like(phi)
        across = np.stack([c, s, zero], -1)
        along = np.broadcast_to([0.0, 0, 1], m.shape)
        space = np.stack([along, across, np.cross(along, across)], -1)
        return space @ np.swapaxes(body, 1, 2)


def rotation_about_short_axis(t, period: float, turn: float):
    """Matrices (n, 3, 3) of a permanent rotation about z."""
    angle = 2 * np.pi * (np.asarray(t) / period + turn)
    c, s, zero = np.cos(angle), np.sin(angle), np.zeros_like(angle)
    rows = [np.stack(x, -1) for x in ((c, -s, zero), (s, c, zero), (zero, zero, zero + 1))]
    return np.stack(rows, 1)


def random_rotation(rng):
    """A rotation matrix, uniformly at random."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.linalg.det(q)


def geometry(t, rng):
    """Vectors [au] from the body to Sun and Earth on circular orbits.

    The phase angle is 5 to 80 degrees, and the body is at least 60 degrees from the Sun in the sky.
    """
    while True:
        radius, tilt = rng.uniform(1.1, 2.4), rng.uniform(0, 0.4)
        begin, node = rng.uniform(0, 2 * np.pi, 2)
        angle = begin + 2 * np.pi * t / 365.25 / radius**1.5
        place = radius * np.stack(
            [np.cos(angle), np.sin(angle) * np.cos(tilt), np.sin(angle) * np.sin(tilt)], -1
        )
        year = node + 2 * np.pi * t / 365.25
        earth = np.stack([np.cos(year), np.sin(year), 0 * year], -1)
        sun, observer = -place, earth - place
        delta = np.linalg.norm(observer, axis=1)
        phase = np.degrees(_angle(sun, observer))
        elongation = np.degrees(_angle(-earth, -observer))
        if phase.min() > 5 and phase.max() < 80 and elongation.min() > 60 and delta.min() > 0.05:
            return sun, observer


def _angle(a, b):
    size = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    return np.arccos(np.clip(np.sum(a * b, axis=1) / size, -1, 1))


def nights(rng, few: bool):
    """Times [day] and numbers of the nights (n,)."""
    days, many = rng.uniform(15, 60), int(rng.integers(10, 21))
    total = rng.integers(320, 451)
    sites = rng.integers(1, 3)
    if few:
        many, total = int(rng.integers(2, 6)), int(rng.integers(12, 35))
    start = np.sort(rng.choice(int(days), min(many, int(days)), replace=False)).astype(float)
    start += rng.uniform(-0.04, 0.04, start.size) + rng.integers(0, sites, start.size) / 3
    t, group = [], []
    for k, begin in enumerate(start):
        length, each = rng.uniform(0.12, 0.33), max(int(total / start.size), 3)
        at = np.linspace(0, length, each) + 0.1 * length / each * rng.normal(size=each)
        if rng.uniform() < 0.3:  # clouds
            cloud = rng.uniform(0, length)
            at = at[np.abs(at - cloud) > 0.1 * length]
        t.append(begin + np.sort(at))
        group.append(np.full(at.size, k))
    t, group = np.concatenate(t), np.concatenate(group)
    order = np.argsort(t)
    return t[order], group[order]


def correlated_noise(t, sigma: float, part: float, rng):
    """Noise (n,), of whose variance ``part`` is correlated over half an hour."""
    white, slow = rng.normal(size=(2, t.size))
    for k in range(1, t.size):
        keep = math.exp(-(t[k] - t[k - 1]) * 48)
        slow[k] = keep * slow[k - 1] + math.sqrt(1 - keep**2) * slow[k]
    return sigma * (math.sqrt(1 - part) * white + math.sqrt(part) * slow)


def light_curve(seed: int):
    """Times, magnitudes, vectors, errors, groups, whether calibrated; and the truth."""
    rng = np.random.default_rng([2026, seed])
    kind = kind_of(seed)
    t, group = nights(rng, kind == "few")
    span = float(np.ptp(t))
    sun, observer = geometry(t, rng)
    delta = np.linalg.norm(observer, axis=1)
    emitted = t - LIGHT_TIME * delta
    normals, areas, moments = polyhedron(rng)
    truth: dict = {"kind": kind, "moments": (moments / moments.max()).tolist()}
    start, turn = rng.uniform(size=2)
    if kind == "rotator":
        truth["period"] = math.exp(rng.uniform(math.log(2), math.log(30))) / 24
        matrices = rotation_about_short_axis(emitted, truth["period"], turn)
    else:
        while True:
            long_axis = bool(rng.uniform() < 0.5)
            period = math.exp(rng.uniform(math.log(2), math.log(30))) / 24
            motion = Motion(moments, long_axis, rng.uniform(0.02, 0.95), period)
            if motion.tilt() > math.radians(15) and motion.P_psi < min(5, span / 6):
                break
        matrices = motion.attitudes(emitted, start, turn)
        truth |= {
            "P_phi": motion.P_phi,
            "P_psi": motion.P_psi,
            "mode": "LAM" if long_axis else "SAM",
        }
    matrices = random_rotation(rng) @ matrices
    to_body = [
        np.einsum("nji,nj->ni", matrices, v / np.linalg.norm(v, axis=1, keepdims=True))
        for v in (sun, observer)
    ]
    mu0, mu = (np.maximum(v @ normals.T, 0) for v in to_body)
    lambert = rng.uniform(0.05, 0.3)
    both = mu * mu0
    light = (areas * both * (1 / np.where(both > 0, mu + mu0, 1) + lambert)).sum(1)
    alpha = _angle(sun, observer)
    light *= 0.5 * np.exp(-alpha / 0.1) - 0.4 * alpha + 1
    magnitude = -2.5 * np.log10(light)
    if kind == "noise":
        magnitude = 0.03 * np.degrees(alpha)
    magnitude += 15 + 5 * np.log10(np.linalg.norm(sun, axis=1) * delta)
    sigma = rng.uniform(0.02, 0.05)
    magnitude += correlated_noise(t, sigma, rng.uniform(0.2, 0.5), rng)
    magnitude += OFFSET * rng.normal(size=group.max() + 1)[group]
    truth |= {"sigma": sigma, "amplitude": float(np.ptp(-2.5 * np.log10(light))), "span": span}
    calibrated = bool(rng.uniform() < 2 / 3)
    return (t, magnitude, sun, observer, sigma, group, calibrated), truth


def same_motion(solution, truth: dict) -> bool:
    """Whether the mode agrees, and both frequencies to half of the inverse span."""
    return solution.mode.name == truth["mode"] and all(
        abs(1 / getattr(solution, name) - 1 / truth[name]) < 0.5 / truth["span"]
        for name in ("P_phi", "P_psi")
    )


def score(truth: dict, verdict: str, right: list[bool]) -> str:
    """Outcome of a fit; ``right``: whether each listed solution, best first, is the true motion.

    For tumblers: "right" (in first place, TUMBLING), "right, ambiguous" (in first place,
    AMBIGUOUS), "listed" (in another place, AMBIGUOUS), "told" (not listed, AMBIGUOUS), "denied"
    (neither TUMBLING nor AMBIGUOUS), "silent" (a wrong motion, TUMBLING). For other curves:
    "right", "wrong", or "silent" (TUMBLING).
    """
    if truth["kind"] != "tumbler":
        if verdict == "TUMBLING":
            return "silent"
        return "right" if verdict == RIGHT[truth["kind"]] else "wrong"
    if verdict == "TUMBLING":
        return "right" if right[0] else "silent"
    if verdict != "AMBIGUOUS":
        return "denied"
    return "right, ambiguous" if right[0] else "listed" if any(right) else "told"


def case(seed: int) -> dict:
    """Fit one light curve with default settings, and score it."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from polhode import lightcurve

    (t, magnitude, sun, observer, sigma, group, calibrated), truth = light_curve(seed)
    curve = lightcurve.LightCurve.of(
        t, magnitude, sun, observer, sigma=sigma, group=group, calibrated=calibrated
    )
    began = time.process_time()
    fit = lightcurve.fit_light_curve(curve)
    seconds = time.process_time() - began
    best = fit.best
    row = {
        "seed": seed,
        "truth": truth,
        "points": t.size,
        "calibrated": calibrated,
        "verdict": fit.verdict.name,
        "par": fit.par,
        "reasons": list(fit.reasons),
        "misfit": fit.misfit,
        "agreement": fit.agreement,
        "alike": fit.alike,
        "solutions": [
            [s.P_phi, s.P_phi_std, s.P_psi, s.P_psi_std, s.mode.name, s.probability, s.rms]
            for s in fit.solutions
        ],
        "models": [[m.name, m.log_evidence, m.misfit, list(m.periods)] for m in fit.models],
        "seconds": seconds,
        "commit": commit(),
    }
    right = [kind_of(seed) in ("tumbler", "few") and same_motion(s, truth) for s in fit.solutions]
    row["score"] = score(truth, row["verdict"], right)
    row["place"] = right.index(True) if any(right) else None
    if right[0]:
        row["z"] = [
            (getattr(best, name) - truth[name]) / getattr(best, name + "_std")
            for name in ("P_phi", "P_psi")
        ]
    return row


def summary(rows: list[dict]) -> dict:
    """Counts, and the rms of the period errors divided by the stated errors."""
    tumblers = [r for r in rows if r["truth"]["kind"] == "tumbler"]
    z = np.array([z for r in tumblers if r["place"] == 0 for z in r["z"]])
    seconds = [r["seconds"] for r in rows]

    def count(name: str, kind: str) -> int:
        return sum(r["score"] == name and r["truth"]["kind"] == kind for r in rows)

    return {
        "curves": len(rows),
        "commits": [
            {"commit": name, "curves": len(seeds), "seeds": ", ".join(map(str, seeds))}
            for name, seeds in _seeds_by_commit(rows).items()
        ],
        "tumblers": [
            {"score": name, "meaning": meaning, "curves": count(name, "tumbler")}
            for name, meaning in TUMBLERS.items()
        ],
        "others": [
            {"kind": kind, "expected": RIGHT[kind]}
            | {name: count(name, kind) for name in ("right", "wrong", "silent")}
            for kind in RIGHT
        ],
        "period_errors_over_stated": {
            "periods": z.size,
            "rms": float(np.sqrt(np.mean(z**2))) if z.size else None,
            "within_2": float(np.mean(np.abs(z) < 2)) if z.size else None,
        },
        "processor_seconds": {
            "median": float(np.median(seconds)) if rows else None,
            "most": max(seconds, default=None),
        },
        "not_right": [_not_right(r) for r in rows if r["score"] != "right"],
    }


def _seeds_by_commit(rows: list[dict]) -> dict[str, list[int]]:
    """Seeds of the curves that each commit (its first seven digits) fitted.

    Rows of earlier versions of this script may have no commit.
    """
    seeds: dict[str, list[int]] = {}
    for row in rows:
        full, _, dirty = (row.get("commit") or "unknown").partition("-")
        seeds.setdefault(full[:7] + ("-dirty" if dirty else ""), []).append(row["seed"])
    return seeds


def _not_right(row: dict) -> dict:
    """A curve whose verdict does not claim the truth, with the periods in hours."""
    truth, first = row["truth"], row["solutions"][0]
    true = [f"{24 * truth[k]:.3f}" for k in ("P_phi", "P_psi", "period") if k in truth]
    return {
        "seed": row["seed"],
        "kind": truth["kind"],
        "verdict": row["verdict"],
        "score": row["score"],
        "place": None if row["place"] is None else row["place"] + 1,
        "true": f"{', '.join(true)} {truth.get('mode', '')}".strip(),
        "first": f"{24 * first[0]:.3f}, {24 * first[2]:.3f} {first[4]}",
        "calibrated": row["calibrated"],
        "reasons": " ".join(row["reasons"]),
    }


def main() -> None:
    import jax  # after `one_thread`

    parser = argparse.ArgumentParser(description="Verdicts on light curves of convex polyhedra.")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=140)
    parser.add_argument("--lines", type=Path, default=OUT / "light_curves_unseen.jsonl")
    parser.add_argument("--output", type=Path)
    options = parser.parse_args()
    options.lines.parent.mkdir(parents=True, exist_ok=True)
    rows = []
    if options.lines.exists():
        rows = [json.loads(line) for line in options.lines.read_text().splitlines()]
    done = {row["seed"] for row in rows}
    for seed in range(options.first, options.first + options.count):
        if seed in done:
            continue
        row = case(seed)
        rows.append(row)
        with options.lines.open("a") as file:
            file.write(json.dumps(row) + "\n")
        if len(rows) % FRESH == 0:
            jax.clear_caches()
        truth = row["truth"]
        print(
            f"{seed:4d} {truth['kind']:8s} {row['score']:17s} {row['verdict']:14s}"
            f" place {row['place']} z {[round(z, 1) for z in row.get('z', [])]}"
            f" {row['seconds']:.0f} s",
            flush=True,
        )
    result = summary(rows)
    print(json.dumps(result, indent=1))
    write("light_curves_unseen", result | {"rows": rows}, path=options.output)


if __name__ == "__main__":
    one_thread()
    main()
