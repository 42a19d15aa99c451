"""Write values.json and slopes.json, the truth that test_elliptic_*.py reads.

    python tests/elliptic/make_truth.py

values.json: per function and dtype, rows [arguments, allowances, values as 22 digits] at the random
and adversarial points of elliptic_points.py. slopes.json: first and second derivatives by
differences of 60-digit values at hand-picked points.
"""

import itertools
import json
from pathlib import Path

import elliptic_truth as truth
import mpmath as mp
import numpy as np
from elliptic_points import FUNCTIONS, points, regions
from elliptic_scores import allowances, true_values

FOLDER = Path(__file__).parent
PER_REGION = 20


def text(value):
    return mp.nstr(value, 22, strip_zeros=True)


def value_rows(name, dtype):
    rows = []
    for region in regions(name):
        rng = np.random.default_rng(7)
        count = PER_REGION * (4 // len(regions(name)))
        for at in zip(*points(name, region, count, dtype, rng), strict=True):
            at = tuple(float(argument) for argument in at)
            values = true_values(name, at)
            allowed = [float(f"{a:.3g}") for a in allowances(name, at, values)]
            rows.append([at, allowed, [text(value) for value in values]])
    return rows


def complete_third(n, m):
    return truth.third_of(n, mp.mpf(1), mp.mpf(0), m, 1 - m)


def incomplete(quarter):
    return lambda phi, m: quarter(mp.sin(phi), mp.cos(phi), m, 1 - m)


# name -> (functions of the free arguments, points); the last argument is m.
SLOPES = {
    "ellipk": ([mp.ellipk], [(0.0,), (1e-9,), (0.3,), (0.5,), (0.5000001,), (0.99,)]),
    "ellipe": ([mp.ellipe], [(0.0,), (1e-9,), (0.3,), (0.5,), (0.5000001,), (0.99,)]),
    "ellipj": (
        [lambda u, m, k=k: truth.jacobi_of(u, m, 1 - m)[k] for k in range(4)],
        [
            (0.0, 0.3),
            (1e-3, 0.7),
            (0.169, 0.4),
            (0.171, 0.4),
            (0.169, 0.8),
            (0.171, 0.8),
            (1.3, 0.0),
            (1.3, 1e-12),
            (-2.1, 0.5),
            (-2.1, 0.5000001),
            (7.7, 0.2),
            (-23.0, 0.95),
            (1.1, 1.0),
            (6.0, 1.0),
        ],
    ),
    "ellipf": (
        [incomplete(truth.first_of)],
        [(0.0, 0.3), (1e-3, 0.6), (0.4, 0.0), (0.9, 0.5), (1.5, 0.5000001), (-1.2, 0.97)],
    ),
    "ellipe_inc": (
        [incomplete(truth.second_of)],
        [(0.0, 0.3), (1e-3, 0.6), (0.4, 0.0), (0.9, 0.5), (1.5, 0.5000001), (-1.2, 0.97)],
    ),
    "ellippi": (
        [complete_third],
        [
            (0.0, 0.0),
            (0.0, 0.5),
            (0.3, 0.3),
            (-1e-9, 1e-9),
            (-1.0, 0.2),
            (-1.0000001, 0.2),
            (0.5, 0.1),
            (0.5000001, 0.1),
            (0.9, 0.95),
            (0.99, 0.95),
            (-30.0, 0.0),
            (-1e6, 0.9),
        ],
    ),
    "ellippi_inc": (
        [lambda n, phi, m: truth.third_of(n, mp.sin(phi), mp.cos(phi), m, 1 - m)],
        [
            (0.0, 0.7, 0.0),
            (0.0, 0.7, 0.5),
            (0.3, 0.7, 0.3),
            (-1.0, 0.785, 0.2),
            (-1.0, 0.786, 0.2),
            (0.8, 1.2, 0.9),
            (-40.0, 0.3, 0.6),
        ],
    ),
}


def difference(function, at, order):
    mp.mp.dps = 60
    if at[-1] == 1.0:  # m = 1 is the end of the domain
        return mp.diff(function, at, order, direction=-1, h=mp.mpf(10) ** -25)
    return mp.diff(function, at, order)


def slope_rows(name):
    functions, places = SLOPES[name]
    rows = []
    for place in places:
        at = tuple(mp.mpf(x) for x in place)
        size = len(at)
        units = np.eye(size, dtype=int)
        first = [[text(difference(f, at, tuple(map(int, e)))) for e in units] for f in functions]
        pairs = list(itertools.combinations_with_replacement(range(size), 2))
        second = [
            [text(difference(f, at, tuple(map(int, units[i] + units[j])))) for i, j in pairs]
            for f in functions
        ]
        rows.append([place, first, second])
    return rows


def write(name, table):
    lines = ",\n".join(
        f"{json.dumps(key)}: [\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]"
        for key, rows in table.items()
    )
    (FOLDER / name).write_text("{\n" + lines + "\n}\n")


if __name__ == "__main__":
    write("slopes.json", {name: slope_rows(name) for name in SLOPES})
    kinds = {"float64": np.float64, "float32": np.float32}
    cells = itertools.product(FUNCTIONS, kinds)
    write("values.json", {f"{name} {kind}": value_rows(name, kinds[kind]) for name, kind in cells})
