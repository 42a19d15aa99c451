"""Writes stress_truth.json: states and derivatives of the stress suite's bodies with 50 digits.

Run by hand from the repository's root (``python tests/stress/make_stress_truth.py``, some minutes)
after a change of benchmarks/stress_families.py; bodies that the file already contains are retained.

The Taylor series of tests/free/reference_free.py compute the motion; over long horizons they
compute one period of the momentum in the body and the remainder, and the rotation about the
momentum in one period is raised to the number of periods. Derivatives are central differences along
two directions.
"""

import json
import sys
import time
from pathlib import Path

import mpmath as mp

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parents[1]), str(HERE.parent / "free")]

from reference_free import _step, _tensor
from tumbling import about, quaternion_product as multiply

from benchmarks.stress_families import Body, bodies, nutation

DIGITS = 50
# Deviations grow by up to nine decades: the squared step is still below double precision.
STEP = mp.mpf(10) ** -21


def start_of(kind: str, x):
    """Tensor, attitude and body rates from the exact inputs."""
    count = {"tensor": 6, "axisymmetric": 2, "spherical": 1}.get(kind, 3)
    inertia, rest = x[:count], x[count:-1]
    if kind == "axisymmetric":
        inertia = [inertia[0], inertia[0], inertia[1]]
    elif kind == "spherical":
        inertia = [inertia[0]] * 3
    tensor = _tensor(inertia[:3], inertia[3:] or (0, 0, 0))
    if kind != "euler":
        q, omega = rest[:4], rest[4:]
        size = mp.sqrt(mp.fdot(q, q))
        return tensor, [c / size for c in q], omega
    phi, theta, psi = rest[:3]
    a, b, c = rest[3:]
    q = multiply(multiply(about(2, phi), about(1, theta)), about(2, psi))
    s, k = mp.sin(psi), mp.cos(psi)
    omega = [
        s * b - mp.sin(theta) * k * a,
        k * b + mp.sin(theta) * s * a,
        mp.cos(theta) * a + c,
    ]
    return tensor, q, omega


def carry(inverse, q, momentum, t):
    """Attitude and momentum after t, and the rotation angle."""
    left, angle = mp.mpf(t), mp.mpf(0)
    while left != 0:
        rate = mp.norm(inverse * mp.matrix(momentum))
        q, momentum, step = _step(q, momentum, inverse, left, DIGITS)
        left -= step
        angle += abs(step) * (rate + mp.norm(inverse * mp.matrix(momentum))) / 2
    return q, momentum, angle


def final(kind: str, long: bool, x):
    tensor, q, omega = start_of(kind, x)
    inverse, t = tensor**-1, x[-1]
    momentum = list(tensor * mp.matrix(omega))
    if not long:
        q, momentum, angle = carry(inverse, q, momentum, t)
        return q, list(inverse * mp.matrix(momentum)), angle
    rate, m = nutation([tensor[k, k] for k in range(3)], omega)
    period = 4 * mp.ellipk(m) / rate
    whole = mp.floor(t / period)
    after, again, once = carry(inverse, q, momentum, period)
    off = mp.norm(mp.matrix(again) - mp.matrix(momentum)) / mp.norm(mp.matrix(momentum))
    if off > mp.mpf(10) ** (8 - DIGITS):
        raise ArithmeticError(f"after a period the momentum is off by {mp.nstr(off, 3)}")
    rotation = multiply(after, [q[0], -q[1], -q[2], -q[3]])
    size = mp.sqrt(mp.fdot(rotation[1:], rotation[1:]))
    angle = mp.atan2(size, rotation[0]) * whole
    power = [mp.cos(angle), *(mp.sin(angle) * c / size for c in rotation[1:])]
    q, momentum, rest = carry(inverse, q, momentum, t - whole * period)
    return multiply(power, q), list(inverse * mp.matrix(momentum)), whole * once + rest


def truth(body: Body) -> dict:
    x = [mp.mpf(c) for c in body.inputs]
    q, omega, angle = final(body.kind, body.long, x)
    slopes = []
    for move in body.moves():
        ends = []
        for sign in (1, -1):
            moved = [a + sign * STEP * mp.mpf(b) for a, b in zip(x, move, strict=True)]
            a, b, _ = final(body.kind, body.long, moved)
            ends.append(a + b)
        slopes.append([(a - b) / (2 * STEP) for a, b in zip(*ends, strict=True)])

    def written(values):
        return [mp.nstr(c, 25) for c in values]

    return {
        "wxyz_t": written(q),
        "omega_t": written(omega),
        "angle": float(angle),
        "slopes": [written(row) for row in slopes],
    }


def main() -> None:
    path = HERE / "stress_truth.json"
    known = {}
    if path.exists():
        known = {repr((c["kind"], c["long"], c["inputs"])): c for c in json.loads(path.read_text())}
    table, begin = [], time.process_time()
    with mp.workdps(DIGITS + 10):
        for body in bodies():
            key = repr((body.kind, body.long, body.inputs))
            row = known.get(key)
            if row is None:
                row = {"kind": body.kind, "long": body.long, "inputs": body.inputs, **truth(body)}
                print(round(time.process_time() - begin), body.family, body.name, flush=True)
            table.append({**row, "family": body.family, "name": body.name})
            known[key] = row
    path.write_text("[\n" + ",\n".join(json.dumps(row) for row in table) + "\n]\n")


if __name__ == "__main__":
    main()
