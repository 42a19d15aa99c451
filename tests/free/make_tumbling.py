"""Writes the reference data of free motion that the package includes: ``polhode reference``.

``python tests/free/make_tumbling.py`` (some minutes) computes them from closed forms in 150-digit
arithmetic. ``--check`` compares every number with an independent method: Taylor series of the
equations of motion over one period of the body rates, which determines the motion at all times. It
takes 5 minutes on one core; the largest error is 0.4999 units of the 17th digit.
"""

import argparse
import json
import sys
import time
from functools import lru_cache
from pathlib import Path

import mpmath as mp

sys.path.insert(0, str(Path(__file__).parent))

from reference_free import free_reference
from tumbling import DIGITS, Motion, conjugate, differences, quaternion_product

FILE = (
    Path(__file__).resolve().parents[2]
    / "src"
    / "polhode"
    / "files"
    / "reference"
    / ("tumbling.json")
)
TURNS = (0.25, 1, 10, 100, 1_000, 10_000, 100_000)
FLIPS = 3
START = (0.7, 0.1, -0.5, 0.5)

BODIES = (
    (
        "short_axis",
        "short-axis mode: circulates about the axis of the largest moment",
        (2.0, 3.0, 4.0),
        (0.25, -0.5, 1.0),
    ),
    (
        "long_axis",
        "long-axis mode: circulates about the axis of the smallest moment",
        (2.0, 3.0, 4.0),
        (1.0, 0.5, -0.25),
    ),
    (
        "permuted_axes",
        "long-axis mode, moments in no order, axes left-handed when sorted",
        (3.0, 2.0, 4.5),
        (0.5, -1.5, 0.25),
    ),
    (
        "t_handle",
        "turns over: starts almost about the intermediate axis",
        (0.25, 0.375, 0.5),
        (0.03125, 10.0, 0.0625),
    ),
    (
        "near_separatrix",
        "turns over rarely: 1e-6 off the intermediate axis",
        (1.0, 2.0, 2.5),
        (1e-6, 1.0, 1e-6),
    ),
    ("oblate", "symmetric about body z, the largest moment", (1.0, 1.0, 1.5), (0.5, -0.25, 1.0)),
    ("prolate", "symmetric about body x, the smallest moment", (0.5, 2.0, 2.0), (2.0, 0.5, -0.25)),
    (
        "nearly_oblate",
        "two moments that differ by 1e-9",
        (1.0, 1.000000001, 1.5),
        (0.5, -0.25, 1.0),
    ),
    ("sphere", "all moments equal", (0.4, 0.4, 0.4), (0.3, -0.2, 0.9)),
    (
        "needle",
        "moments 1 : 500 : 500.25, spins about its long axis",
        (0.002, 1.0, 1.0005),
        (20.0, 0.25, -0.125),
    ),
    (
        "plate",
        "flat: the largest moment is the sum of the others",
        (1.0, 1.5, 2.5),
        (0.5, 0.75, 1.0),
    ),
    (
        "permanent_rotation",
        "about the axis of the largest moment; only derivatives move",
        (1.0, 1.5, 2.0),
        (0.0, 0.0, 1.25),
    ),
    (
        "book",
        "a book of 3 x 20 x 30 cm thrown about its intermediate axis",
        (0.0108333, 0.007575, 0.00340833),
        (0.0625, 12.0, 0.125),
    ),
    (
        "toutatis",
        "asteroid 4179 Toutatis, rad/day; relative moments (Takahashi et al. 2013)",
        (3.0836, 3.235, 1.0),
        (0.253247, 0.585191, -1.722797),
    ),
)
"""Name, description, moments [kg m^2] and initial body rates [rad/s]; times of Toutatis in days."""


def times_of(omega) -> list[float]:
    rate = mp.sqrt(sum(mp.mpf(w) ** 2 for w in omega))
    return [float(mp.nstr(turns * 2 * mp.pi / rate, 7)) for turns in TURNS]


def body(name: str, title: str, moments, omega) -> dict:
    def at(t):
        def numbers(moments, omega):
            wxyz, rates = Motion.of(moments, START, omega).state(t)
            return wxyz + rates

        return numbers

    motion = Motion.of(moments, START, omega)
    samples = []
    for turns, t in zip(TURNS, times_of(omega)):
        wxyz, rates = motion.state(t)
        changes = differences(at(t), moments, omega)
        samples.append(
            {
                "turns": turns,
                "t": t,
                "wxyz": wxyz,
                "omega_body": rates,
                "wxyz_derivative": changes[:4],
                "omega_body_derivative": changes[4:],
            }
        )
    flips = motion.flips(FLIPS)
    changes = []
    if flips:
        changes = differences(lambda i, w: Motion.of(i, START, w).flips(FLIPS), moments, omega)
    return {
        "name": name,
        "title": title,
        "moments": list(moments),
        "wxyz": list(START),
        "omega_body": list(omega),
        "flip_times": flips,
        "flip_times_derivative": changes,
        "samples": samples,
    }


def written(value, indent: int = 0) -> str:
    """JSON with numbers of 17 significant digits; lists of numbers on one line."""
    space = " " * indent
    if isinstance(value, mp.mpf):
        text = mp.nstr(value, 17, min_fixed=-5, max_fixed=17)
        return "0.0" if abs(value) < mp.mpf(10) ** -60 else text
    if isinstance(value, dict):
        rows = (f'{space} "{key}": {written(x, indent + 1)}' for key, x in value.items())
        return "{\n" + ",\n".join(rows) + f"\n{space}}}"
    if isinstance(value, list) and value and isinstance(value[0], dict | list):
        rows = (f"{space} {written(x, indent + 1)}" for x in value)
        return "[\n" + ",\n".join(rows) + f"\n{space}]"
    if isinstance(value, list):
        return "[" + ", ".join(map(written, value)) + "]"
    return json.dumps(value)


ABOUT = {
    "title": "Motions of free rigid bodies, correct to 17 significant digits",
    "units": "kg m^2, rad/s, s (Toutatis: relative moments, rad/day, days)",
    "inputs": "moments, wxyz, omega_body and t are the double-precision numbers nearest to the"
    " decimals written here",
    "wxyz": "unit quaternion, scalar first, body -> space, continuous in time; -wxyz is the same"
    " attitude; at t = 0 the values given are normalised",
    "omega_body": "angular velocity in body axes, which are principal axes",
    "derivatives": "rows: the components; columns: the three moments, then the three initial"
    " omega_body, the initial attitude held fixed",
    "turns": "t is about this many times 2 pi/|omega_body(0)|",
    "flip_times": "the first times above 0 at which omega_body about the intermediate axis is 0;"
    " none where two moments are equal, or in a permanent rotation",
    "licence": "CC0-1.0",
    "source": "polhode: tests/free/make_tumbling.py",
}


def make() -> None:
    bodies = []
    for row in BODIES:
        began = time.process_time()
        bodies.append(body(*row))
        print(row[0], f"{time.process_time() - began:.0f} s", flush=True)
    FILE.parent.mkdir(exist_ok=True)
    FILE.write_text(written({**ABOUT, "bodies": bodies}) + "\n", "utf-8")


def by_period(moments, omega, t, digits: int = 50) -> list:
    """Attitude and rates at t by Taylor series over at most one period of the body rates."""
    motion = Motion.of(moments, START, omega)
    if motion.axes is None:  # uniform rotation
        size = mp.sqrt(sum(mp.mpf(w) ** 2 for w in omega))
        turn = mp.fmod(size * mp.mpf(t), 4 * mp.pi) / size
        wxyz, rates = free_reference(moments, START, omega, turn, digits=digits)
        return [*wxyz, *rates]
    p, m = motion.data[3:5]
    period = 4 * mp.ellipk(m) / p  # checked: the rates must return
    rate = mp.sqrt(sum(mp.mpf(w) ** 2 for w in omega))
    if period * rate > _SLOW:  # a sphere with one moment changed for a derivative
        return by_turns(moments, omega, t, 2 * mp.pi / rate, digits)
    whole = mp.floor(mp.mpf(t) / period)
    # one period rotates space by `turn`, about the angular momentum
    turn = _turn(tuple(moments), tuple(omega), period, digits)
    half = mp.atan2(mp.sqrt(mp.fdot(turn[1:], turn[1:])), turn[0])
    axis = [x / mp.sin(half) for x in turn[1:]]
    many = [mp.cos(whole * half)] + [mp.sin(whole * half) * x for x in axis]
    q, w = free_reference(moments, START, omega, mp.mpf(t) - whole * period, digits=digits)
    return quaternion_product(many, q) + list(w)


_SLOW = 1e9
"""[rad] Rotation in one period of the body rates that no series is summed along."""


def by_turns(moments, omega, t, step, digits: int) -> list:
    """The same for a body with two equal moments, by Taylor series over one of many equal steps.

    The body rates after a step are those before it, rotated by an angle about the axis of symmetry
    (s as a quaternion). The next step f' is therefore f in rotated axes, s f s^-1, and n steps are
    f (s f s^-1) (s^2 f s^-2) ... = (f s)^n s^-n.
    """
    (k,) = (i for i in range(3) if moments[i - 1] == moments[i - 2] != moments[i])
    i, j = (k + 1) % 3, (k + 2) % 3
    f, after = free_reference(moments, (1, 0, 0, 0), omega, step, digits=digits)
    angle = mp.atan2(
        omega[i] * after[j] - omega[j] * after[i], omega[i] * after[i] + omega[j] * after[j]
    )
    count = mp.floor(mp.mpf(t) / step)

    def about_axis(angle):
        return [mp.cos(angle / 2)] + [mp.sin(angle / 2) * (axis == k) for axis in range(3)]

    both = quaternion_product(f, about_axis(angle))
    half = mp.atan2(mp.sqrt(mp.fdot(both[1:], both[1:])), both[0])
    axis = [x / mp.sin(half) for x in both[1:]]
    many = [mp.cos(count * half)] + [mp.sin(count * half) * x for x in axis]
    size = mp.sqrt(sum(mp.mpf(x) ** 2 for x in START))
    start = quaternion_product([mp.mpf(x) / size for x in START], many)
    start = quaternion_product(start, about_axis(-count * angle))
    c, s = mp.cos(count * angle), mp.sin(count * angle)
    rates = list(omega)
    rates[i], rates[j] = c * omega[i] - s * omega[j], s * omega[i] + c * omega[j]
    q, w = free_reference(moments, start, rates, mp.mpf(t) - count * step, digits=digits)
    return [*q, *w]


@lru_cache(maxsize=64)
def _turn(moments, omega, period, digits: int) -> list:
    start, rates = free_reference(moments, START, omega, 0, digits=digits)
    after, returned = free_reference(moments, START, omega, period, digits=digits)
    assert max(abs(x - y) for x, y in zip(rates, returned)) < mp.mpf(10) ** (8 - digits)
    return quaternion_product(after, conjugate(start))


def stored() -> list[dict]:
    """The bodies of the file, with the digits of its numbers as text."""
    return json.loads(FILE.read_text("utf-8"), parse_float=str)["bodies"]


def in_last_digits(exact, text: str) -> float:
    """Error of a number in units of its 17th significant digit; rounding allows 0.5."""
    size = max(abs(exact), mp.mpf(10) ** -30)
    return float(abs(exact - mp.mpf(text)) / mp.mpf(10) ** (mp.floor(mp.log10(size)) - 16))


@mp.workdps(DIGITS)
def difference(row: dict, sample: dict, derivative: bool, digits: int = 50) -> float:
    """Largest error of the numbers of one sample in units of their 17th digits.

    ``row``, ``sample``: from ``stored``; ``derivative``: whether to check the derivatives too.
    """
    moments, omega = ([float(x) for x in row[key]] for key in ("moments", "omega_body"))
    t = float(sample["t"])
    found = by_period(moments, omega, t, digits)
    error = max(map(in_last_digits, found, [*sample["wxyz"], *sample["omega_body"]]))
    if not derivative:
        return error
    rows = sample["wxyz_derivative"] + sample["omega_body_derivative"]
    for k in range(6):
        h = mp.mpf(10) ** (-digits // 3) * (moments[k] if k < 3 else max(map(abs, omega)))
        ends = []
        for sign in (1, -1):
            given = [[mp.mpf(x) for x in moments], [mp.mpf(x) for x in omega]]
            given[k // 3][k % 3] += sign * h
            ends.append(by_period(*given, t, digits))
        column = [(x - y) / (2 * h) for x, y in zip(*ends)]
        error = max(error, *(in_last_digits(x, r[k]) for x, r in zip(column, rows)))
    return error


def check() -> None:
    worst = 0.0
    for row in stored():
        errors = [difference(row, sample, True, digits=70) for sample in row["samples"]]
        worst = max(worst, *errors)
        print(f"{row['name']:20}", *(f"{x:.4f}" for x in errors), flush=True)
    print(f"largest error {worst:.4f} units of the 17th digit")
    sys.exit(worst > 0.5001)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true")
    with mp.workdps(DIGITS):
        check() if parser.parse_args().check else make()
