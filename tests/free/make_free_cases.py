"""Writes free_cases.json: states and derivatives of free bodies in every regime, to 50 digits.

Run by hand (``python make_free_cases.py``, some minutes) after a change of the list; delete the
file to compute every case again.
"""

import json
import math
import time
from pathlib import Path

import numpy as np
from reference_free import free_jacobian, free_reference

START = (0.5, -0.125, 0.75, 0.5)
ULP = 2.0**-52


def _separatrix(distance: float) -> tuple:
    """Exactly on the separatrix for distance 0: I3 w3^2 (I3 - I2) = I1 w1^2 (I2 - I1)."""
    return (1.0, 2.0, 2.25), (0.75, 0.5, 1.0 + distance)


def _short(values) -> list[float]:
    """Rounded to single precision, for both precisions, unless this removes the special case."""
    kept = []
    for x in values:
        y = float(np.float32(x)) if 1e-30 < abs(x) < 1e30 else float(x)
        kept.append(y if abs(y - x) > 1e-15 * abs(x) and not 0 < abs(x - 1) < 1e-3 else float(x))
    return kept


def cases() -> list[dict]:
    found = []

    def add(family, name, moments, omega, t, start=START):
        found.append(
            {
                "family": family,
                "name": name,
                "moments": _short(moments),
                "omega": _short(omega),
                "t": _short([t])[0],
                "wxyz": _short(start),
            }
        )

    for order in ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)):
        m = (1.0, 2.0, 3.0)
        add("orders", f"{order}", [m[k] for k in order], (0.7, -0.9, 1.1), 7.0)
        add("orders", f"{order} long", [m[k] for k in order], (-1.1, 0.3, -0.2), -5.0)
    for ulps in (0, 1, 1e3, 1e6, 1e12):
        near = 1.0 + ulps * ULP
        add("oblate", f"{ulps:g} ulps", (1.0, near, 1.5), (0.4, -0.6, 0.9), 6.0)
        add("oblate", f"{ulps:g} ulps, across", (1.0, near, 1.5), (0.4, -0.6, 0.0), 6.0)
        add("oblate", f"{ulps:g} ulps, nearly across", (near, 1.5, 1.0), (0.4, 1e-5, 0.7), 6.0)
        add("prolate", f"{ulps:g} ulps", (0.6, near, 1.0), (0.4, -0.6, 0.9), 6.0)
        add("prolate", f"{ulps:g} ulps, across", (0.6, near, 1.0), (0.0, -0.6, 0.9), 6.0)
        add("sphere", f"{ulps:g} ulps", (1.0, near, near), (0.4, -0.6, 0.9), 6.0)
        add("sphere", f"{ulps:g} ulps, all", (1.0, near, 1 + 3 * ulps * ULP), (0.4, -0.6, 0.9), 6.0)
    for axis in range(3):
        for off in (0.0, 1e-160, 1e-9, 1e-3):
            omega = [off, off, off]
            omega[axis] = 1.3
            add("axes", f"axis {axis} off {off:g}", (1.0, 2.0, 3.0), omega, 6.0)
    for distance in (1e-2, 1e-6, 1e-12, 2**-52, 0.0, -(2**-53), -1e-7):
        moments, omega = _separatrix(distance)
        add("separatrix", f"distance {distance:g}", moments, omega, 6.0)
        add("separatrix", f"distance {distance:g}, short", moments, omega, 0.01)
    for size in (1e-150, 1e-20, 1e-12, 1e12, 1e20, 1e140):
        omega = (0.7 * size, -0.9 * size, 1.1 * size)
        add("scale", f"rates {size:g}", (1.0, 2.0, 3.0), omega, 7.0 / size)
        add("scale", f"rates {size:g}, moments", (1e-9, 2e-9, 3e-9), omega, 7.0 / size)
    for size in (0.0, 1e-150, 1e-12, 1e-6, 1e-3):
        omega = (0.7 * size, -0.9 * size, 1.1 * size)
        add("resting", f"rates {size:g}", (1.0, 2.0, 3.0), omega, 7.0)
    for ratio in (1e-8, 1e-4, 1e-2):
        add("needle", f"ratio {ratio:g}", (ratio, 1.0, 1.1), (0.9, 0.5, -0.6), 50 * ratio)
        add("needle", f"ratio {ratio:g}, turning", (1.0, 1.1, ratio), (0.01, 0.5, 5.0), 50 * ratio)
        add("flat", f"ratio {ratio:g}", (ratio, 1.3 * ratio, 1.3), (0.4, 0.5, -0.02), 50 * ratio)
    add("times", "start", (1.0, 2.0, 3.0), (0.7, -0.9, 1.1), 0.0)
    add("times", "soon", (1.0, 2.0, 3.0), (0.7, -0.9, 1.1), 1e-9)
    add("times", "at once", (1.0, 2.0, 3.0), (0.7, -0.9, 1.1), -1e-200)
    return found


def main() -> None:
    table = cases()
    path = Path(__file__).with_name("free_cases.json")
    inputs = ("moments", "omega", "wxyz", "t")
    old = json.loads(path.read_text()) if path.exists() else []
    known = {repr([c[k] for k in inputs]): c for c in old}
    for case in table:
        before = known.get(repr([case[k] for k in inputs]))
        if before is not None:
            case.update({k: v for k, v in before.items() if k not in case})
            continue
        given = (case["moments"], case["wxyz"], case["omega"], case["t"])
        q, w = free_reference(*given)
        case["wxyz_t"], case["omega_t"] = [float(x) for x in q], [float(x) for x in w]
        # Columns: moments, products xy xz yz, rates, time; each scaled to a relative change.
        i, size = np.array(case["moments"]), np.linalg.norm(case["omega"]) or 1.0
        unit = [*i, math.sqrt(i[0] * i[1]), math.sqrt(i[0] * i[2]), math.sqrt(i[1] * i[2])]
        unit += [size] * 3 + [1 / size]
        rows = free_jacobian(*given)
        scaled = [[float(x * u) for x in row] for row, u in zip(rows, unit, strict=True)]
        case["jacobian"] = scaled
        case["unit"] = [float(u) for u in unit]
        print(time.process_time(), case["family"], case["name"], flush=True)
    path.write_text("[\n" + ",\n".join(json.dumps(c) for c in table) + "\n]\n")


if __name__ == "__main__":
    main()
