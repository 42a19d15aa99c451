"""Writes error_control_truth.json: ``python tests/solvers/make_error_control_truth.py``, an hour.

Random bodies under uniform gravity or the attraction of a fixed centre, over six decades of
moments, rates, fields and angles, with their last states. An extrapolated midpoint rule of order
20, implemented here in NumPy's long double (18 digits or more), computes them twice with different
steps. Bodies whose errors grow more than 30 times as fast as the angle are excluded, and so are
those whose two results differ by more than 1e-13 rad.
"""

import json
from fractions import Fraction
from pathlib import Path

import numpy as np

FILE = Path(__file__).with_name("error_control_truth.json")
LONG = np.longdouble
SUBSTEPS = (2, 4, 6, 8, 10, 12, 14, 16, 24, 36)
COUNT, TRIED, SEED = 40, 60, 7
DRAWN = {"gravity": 400, "gradient": 300}
STEPS_PER_RADIAN = (4.5 / 4 / 0.4, 4.5 / 4 / 0.33)
ISSUE = {  # a fast body in weak gravity; constant steps had errors of 40 rtol
    "moments": (0.185374890313552, 0.13598723203931942, 0.0827285151911606),
    "mass": 0.3685115258930283,
    "centre": (0.04258271457322926, 0.03552958728962913, -0.027113658794491458),
    "field": (7.711844185720741, -0.01635052492869326, 6.366097070851165),
    "wxyz": (0.031649356536453836, 0.5188215838305752, -0.6703810462539451, -0.5295391724941864),
    "omega": (-17.101208717045534, -28.363982068922713, -6.938806764772643),
    "end": -2.6826340115856,
}


def share(j: int) -> np.longdouble:
    """Weight of column j: Hairer, Norsett, Wanner, Solving ODEs I, section II.9."""
    weight = Fraction(1)
    for i, m in enumerate(SUBSTEPS):
        if i != j:
            weight *= Fraction(SUBSTEPS[j] ** 2, SUBSTEPS[j] ** 2 - m**2)
    return LONG(weight.numerator) / LONG(weight.denominator)


SHARES = [share(j) for j in range(len(SUBSTEPS))]


def cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def field(kind, body, y):
    """Rates of body momentum and quaternion (7, N)."""
    momentum, (w, x, v, z) = y[:3], y[3:]
    rate = [momentum[i] / body["moments"][i] for i in range(3)]
    rows = [
        [1 - 2 * (v * v + z * z), 2 * (x * v - w * z), 2 * (x * z + w * v)],
        [2 * (x * v + w * z), 1 - 2 * (x * x + z * z), 2 * (v * z - w * x)],
        [2 * (x * z - w * v), 2 * (v * z + w * x), 1 - 2 * (x * x + v * v)],
    ]
    along = [sum(rows[j][i] * body["field"][j] for j in range(3)) for i in range(3)]
    if kind == "gravity":  # the weight, in body axes, acts at the centre of mass
        push = cross([body["mass"] * c for c in body["centre"]], along)
    else:  # 3 mu / r^5 times r x I r
        far = np.sqrt(sum(x * x for x in along))
        held = [m * x for m, x in zip(body["moments"], along)]
        push = [3 * body["mu"] / far**5 * x for x in cross(along, held)]
    turn = [a + b for a, b in zip(cross(momentum, rate), push)]
    a, b, c = (r / 2 for r in rate)
    return np.stack(
        [
            *turn,
            -x * a - v * b - z * c,
            w * a + v * c - z * b,
            w * b + z * a - x * c,
            w * c + x * b - v * a,
        ]
    )


def last_state(kind, body, density, nudge=None):
    """State (7, N) at the end, in ``density`` steps per radian."""
    body = {name: np.asarray(x, LONG) for name, x in body.items()}
    wxyz = body["wxyz"] / np.sqrt(np.sum(body["wxyz"] ** 2, axis=0))
    momentum = body["moments"] * body["omega"]
    if nudge is not None:
        momentum = momentum + nudge * np.sqrt(np.sum(momentum**2, axis=0))
    y = np.concatenate([momentum, wxyz])
    steps = np.maximum(2, np.ceil(body["angle"] * density)).astype(int)
    width = body["end"] / steps
    for k in range(steps.max()):
        on = np.nonzero(k < steps)[0]
        these = {name: x[..., on] for name, x in body.items()}
        y[:, on] = one_step(kind, these, y[:, on], width[on])
    return y


def one_step(kind, body, y, width):
    first, columns = field(kind, body, y), []
    for n in SUBSTEPS:
        h = width / n
        before, now = y, y + h * first
        for _ in range(n - 1):
            before, now = now, before + 2 * h * field(kind, body, now)
        columns.append(now)
    new = columns[-1]
    for weight, column in zip(SHARES[:-1], columns[:-1]):
        new = new + weight * (column - columns[-1])
    new[3:] /= np.sqrt(np.sum(new[3:] ** 2, axis=0))
    return new


def angle(a, b):
    """Angles [rad] between the attitudes of states (7, N)."""
    sign = np.where(np.sum(a[3:] * b[3:], axis=0) < 0, -1, 1)
    chord = np.sqrt(np.sum((a[3:] - sign * b[3:]) ** 2, axis=0))
    return (4 * np.arcsin(np.minimum(1, chord / 2))).astype(float)


def draw(kind, count, seed):
    """Bodies (..., N); ``angle`` [rad]: of the faster of spin and libration."""
    rng = np.random.default_rng(seed)

    def decades(low, high):
        return 10.0 ** rng.uniform(low, high, count)

    def direction(size):
        found = rng.normal(size=(size, count))
        return found / np.linalg.norm(found, axis=0)

    a, b, c = 10.0 ** rng.uniform(-1.5, 0, (3, count))  # of mass along the axes
    moments = np.stack([b + c, a + c, a + b]) * decades(-3, 3)
    omega = direction(3)
    rate = decades(-3, 3)
    omega, wxyz = omega * rate, direction(4)
    kinetic = 0.5 * (moments * omega * omega).sum(axis=0)
    ratio, along, arm, turned = decades(-6, 3), direction(3), direction(3), decades(0, 3)
    body = {"moments": moments, "omega": omega, "wxyz": wxyz, "angle": turned}
    if kind == "gravity":
        push, mass, length = ratio * kinetic, decades(-3, 3), decades(-2, 0)
        along = along * push / (mass * length)
        body |= {"mass": mass, "centre": arm * length, "field": along}
        fast = np.sqrt(rate**2 + push / moments.min(axis=0))
    else:
        pull, far = ratio * kinetic / moments.max(axis=0), decades(-1, 1)
        body |= {"mu": pull * far**3 / 3, "field": along * far}
        gap = moments.max(axis=0) - moments.min(axis=0)
        fast = np.sqrt(rate**2 + pull * gap / moments.min(axis=0))
    return body | {"end": turned / fast}


def judged(kind, body, seed):
    """Last state of every body, whether it is accurate, and the growth of errors."""
    coarse, fine = (last_state(kind, body, density) for density in STEPS_PER_RADIAN)
    away = np.random.default_rng(seed).normal(size=coarse[:3].shape)
    nudge = 1e-10 * away / np.linalg.norm(away, axis=0)
    other = last_state(kind, body, STEPS_PER_RADIAN[0], nudge)
    growth = angle(coarse, other) / 1e-10 / np.maximum(1, body["angle"])
    return fine, angle(coarse, fine) < 1e-13, growth


def listed(body, end):
    """One entry per body, with its numbers and its last state."""
    last = {"momentum_end": end[:3].astype(float), "wxyz_end": end[3:].astype(float)}
    return {name: x.T.tolist() for name, x in (body | last).items()}


def save(made):
    rows = [
        f"{json.dumps(kind)}: {json.dumps(made[kind])}".replace("]], ", "]],\n") for kind in made
    ]
    FILE.write_text("{" + ",\n".join(rows) + "}\n", encoding="utf-8")


def main():
    made = {}
    for kind, drawn in DRAWN.items():
        body = {name: x[..., :TRIED] for name, x in draw(kind, drawn, SEED).items()}
        end, known, growth = judged(kind, body, SEED + 1000)
        keep = np.nonzero(known & (growth < 30))[0][:COUNT]
        assert len(keep) == COUNT, (kind, known.sum(), growth)
        made[kind] = listed({name: x[..., keep] for name, x in body.items()}, end[:, keep])
    body = issue()
    end, known, growth = judged("gravity", body, 1)
    assert known.all(), growth
    for name, x in listed(body, end).items():
        made["gravity"][name] += x
    save(made)


def issue():
    """One given body, as a batch of one."""
    turned = np.linalg.norm(ISSUE["omega"]) * abs(ISSUE["end"])
    return {name: np.array(x)[..., None] for name, x in (ISSUE | {"angle": turned}).items()}


if __name__ == "__main__":
    main()
