"""Writes truth.json: ``python tests/systems/make_truth.py [name ...]``, for all systems by default.

All systems take a few minutes.
"""

import itertools
import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import parts
import table
import taylor
from mpmath import mp, mpf

STEP = mpf(10) ** -18


def final(system, moments, steps):
    wxyz = [mpf(x) for x in system.wxyz]
    norm = mp.sqrt(sum(x * x for x in wxyz))
    y = [mpf(x) for x in system.omega] + [x / norm for x in wxyz]
    y, field = y + parts.more_unknowns(system, y), parts.field_of(system)
    times = (system.span[0], *system.cuts, system.span[1])
    for part, (start, end) in enumerate(itertools.pairwise(times)):
        share = abs(end - start) / abs(system.span[1] - system.span[0])
        y = taylor.integrate(field(moments, part, y), y, start, end, max(4, round(steps * share)))
    return y[:7]


def main():
    mp.dps = taylor.DIGITS
    wanted = sys.argv[1:] or list(table.BY_NAME)
    entries = json.loads(table.TRUTH.read_text()) if sys.argv[1:] else {}
    for system in (table.BY_NAME[name] for name in wanted):
        moments = [mpf(m) for m in system.moments]
        state = final(system, moments, system.steps)
        check = final(system, moments, system.steps + 9)
        gap = max(abs(a - b) for a, b in zip(state, check))
        assert gap < mpf(10) ** -40, (system.name, gap)
        columns = []
        for i in range(3):
            up, down = list(moments), list(moments)
            up[i], down[i] = up[i] + STEP, down[i] - STEP
            ends = final(system, up, system.steps), final(system, down, system.steps)
            columns.append([(a - b) / (2 * STEP) for a, b in zip(*ends)])
        entries[system.name] = {
            "state": [mp.nstr(x, 25) for x in state],
            "gradient": [[mp.nstr(column[k], 25) for column in columns] for k in range(7)],
        }
        print(system.name, "agreement of two step sizes", mp.nstr(gap, 3), flush=True)
        table.TRUTH.write_text(json.dumps(entries, indent=1) + "\n")


if __name__ == "__main__":
    main()
