"""Writes tops_truth.json: ``python tests/tops/make_tops_truth.py`` (some minutes)."""

import json
import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1] / "systems")]

import taylor
import top_cases
from mpmath import mp, mpf

STEP = mpf(10) ** -18


def final(numbers, steps=16):
    a, c, pull = numbers[:3]
    norm = mp.sqrt(sum(x * x for x in numbers[6:]))

    def torque(t, omega, rows):
        up = rows[2]
        return [up[1] * pull, -(up[0] * pull), omega[0] * mpf(0)]

    start = [*numbers[3:6], *(x / norm for x in numbers[6:])]
    return taylor.integrate(taylor.body((a, a, c), torque), start, 0, top_cases.TIME, steps)


def main():
    mp.dps = taylor.DIGITS
    entries = {}
    for name, case in top_cases.CASES.items():
        numbers = [mpf(x) for x in case]
        state = final(numbers)
        gap = max(abs(x - y) for x, y in zip(state, final(numbers, 21)))
        assert gap < mpf(10) ** -35, (name, gap)
        columns = []
        for i in range(10):
            ends = []
            for h in (STEP, -STEP):
                moved = list(numbers)
                moved[i] += h
                ends.append(final(moved))
            columns.append([(x - y) / (2 * STEP) for x, y in zip(*ends)])
        entries[name] = {
            "state": [mp.nstr(x, 20) for x in state],
            "gradient": [[mp.nstr(column[k], 20) for column in columns] for k in range(7)],
        }
        print(name, "agreement of two step sizes", mp.nstr(gap, 3), flush=True)
    top_cases.TRUTH.write_text(json.dumps(entries, indent=1) + "\n")


if __name__ == "__main__":
    main()
