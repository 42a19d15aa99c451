"""Writes second_cases.json: second derivatives of free bodies along pairs of directions.

Run by hand (``python make_second_cases.py``, some minutes) after a change of the list. Central
differences of the 50-digit states of reference_free.py with a step of 1e-12 are accurate to 24
digits.
"""

import json
import math
from pathlib import Path

import mpmath as mp
from reference_free import free_reference

START = (0.5, -0.125, 0.75, 0.5)
RATES = (0.75, -0.875, 1.125)
STEP = mp.mpf(10) ** -12
# Relative changes of the moments, of the products xy, xz, yz (in units of the roots of the
# products of their moments); changes of the rates and of the time.
MOVES = (
    (0.5, -0.75, 0.25, 0.375, -0.25, 0.5, 0, 0, 0, 0),
    (0, 0, 0, 0, 0, 0, -0.5, 0.25, 0.75, 0.125),
    (0.25, 0.125, -0.5, 0, 0, 0, 0.125, 0.375, -0.25, -0.25),
)
PAIRS = ((0, 0), (0, 1), (1, 1), (2, 0))


def cases() -> list[dict]:
    found = []

    def add(name, moments, omega, t, products=True):
        """``products``: False if two moments are equal or nearly equal."""
        found.append(
            {"name": name, "moments": moments, "omega": omega, "t": t, "products": products}
        )

    add("triaxial", (1, 2, 3), RATES, 3.0)
    add("the other mode, other order", (3, 1, 2), (-0.25, 1.125, 0.5), -5.0)
    add("sphere", (2, 2, 2), RATES, 3.0, False)
    add("sphere, across", (2, 2, 2), (0.5, 0.25, 0), -7.0, False)
    for power in (52, 40, 20, 10):
        near = 2.0**-power
        add(f"sphere within 2^-{power}", (1, 1 + near, 1 - near / 2), RATES, 3.0, power < 20)
    # On both sides of the threshold of a series.
    for t in (7.0, 9.0):
        add(f"sphere within 2^-10, t={t}", (1, 1 + 2.0**-10, 1 - 2.0**-11), RATES, t)
    add("oblate", (1, 1, 1.5), RATES, 3.0, False)
    add("prolate", (1.5, 1, 1.5), RATES, 3.0, False)
    add("oblate within an ulp", (1, 1 + 2.0**-52, 1.5), RATES, 3.0, False)
    add("oblate, across", (1, 1, 1.5), (0.75, -0.875, 0), 3.0, False)
    for axis in range(3):
        for off in (0, 2.0**-40, 2.0**-20):
            omega = [off, -off, off]
            omega[axis] = 1.25
            add(f"spin {axis} but for {off}", (1, 2, 3), omega, 3.0)
    # On the separatrix I3 w3^2 (I3 - I2) = I1 w1^2 (I2 - I1).
    for off in (0, 2.0**-50, -(2.0**-40), 2.0**-20):
        add(f"separatrix but for {off}", (1, 2, 2.25), (0.75, 0.5, 1 + off), 3.0)
    add("long at the unstable axis", (2, 3, 5), (0, 2, 0), 8.0)
    add("at rest", (1, 2, 3), (0, 0, 0), 5.0)
    add("slow", (1, 2, 3), (2.0**-10, 2.0**-9, -(2.0**-10)), 5.0)
    add("needle", (0.0078125, 1, 1.125), RATES, 1.0)
    add("disc", (128, 1, 1.125), RATES, 1.0)
    add("many turns", (1, 2, 3), RATES, 60.0)
    add("many turns near the separatrix", (1, 2, 2.25), (0.75, 0.5, 1.0078125), 60.0)
    return found


def state(case, change):
    wxyz, omega = free_reference(
        [mp.mpf(x) + d for x, d in zip(case["moments"], change[:3], strict=True)],
        START,
        [mp.mpf(x) + d for x, d in zip(case["omega"], change[6:9], strict=True)],
        mp.mpf(case["t"]) + change[9],
        change[3:6],
    )
    return mp.matrix([*wxyz, *omega])


def directions(case) -> list[list]:
    """The pairs of MOVES of a case, in absolute units."""
    a, b, c = case["moments"]
    units = [a, b, c, math.sqrt(a * b), math.sqrt(a * c), math.sqrt(b * c), 1, 1, 1, 1]
    kept = [
        [0 if 3 <= k < 6 and not case["products"] else x for k, x in enumerate(move)]
        for move in MOVES
    ]
    return [[[x * u for x, u in zip(kept[n], units, strict=True)] for n in pair] for pair in PAIRS]


def main() -> None:
    table = cases()
    with mp.workdps(60):
        for case in table:
            case["pairs"], case["second"] = directions(case), []
            for pair in case["pairs"]:
                total = mp.matrix(7, 1)
                for a in (1, -1):
                    for b in (1, -1):
                        change = [
                            STEP * (a * mp.mpf(x) + b * mp.mpf(y))
                            for x, y in zip(*pair, strict=True)
                        ]
                        total += a * b * state(case, change)
                case["second"].append([float(x) for x in total / (4 * STEP**2)])
            case["wxyz_t"] = [float(x) for x in state(case, [0] * 10)[:4]]
            print(case["name"], flush=True)
    rows = ",\n".join(json.dumps(case) for case in table)
    Path(__file__).with_name("second_cases.json").write_text(f"[\n{rows}\n]\n")


if __name__ == "__main__":
    main()
