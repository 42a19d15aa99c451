"""Tables of gradients through controllers, from the result of ``benchmarks.controllers``."""

from benchmarks._markdown import machine, number, rows
from benchmarks.controllers import LEVELS, level_times


def least_times(numbers: dict, dtype: str = "float64") -> list[str]:
    """Milliseconds of processor time to an error, polhode beside both solvers of diffrax."""
    lines = []
    keys = dict.fromkeys(
        (row["activation"], row["bodies"], row["dtype"]) for row in numbers["rows"]
    )
    for activation, bodies, kind in keys:
        if kind != dtype:
            continue
        mine = [
            row for row in numbers["rows"]
            if (row["activation"], row["bodies"], row["dtype"]) == (activation, bodies, kind)
        ]  # fmt: skip
        cells = []
        for level in LEVELS:
            ours, *others = level_times(mine, level).values()
            least = min([x for x in others if x is not None], default=None)
            text = [number(x, 1e-3) for x in (ours, *others)]
            if least is not None and (ours is None or least < ours):
                text = [f"**{t}**" if x == least else t for t, x in zip(text, (ours, *others))]
            cells.append(" / ".join(text))
        lines.append([f"{activation}, {bodies:,} bodies", *cells])
    return rows(["error below", *(f"{level:.0e} [ms]" for level in LEVELS)], lines)


def kinds(numbers: dict) -> list[str]:
    """Cost of value and gradient, error and memory by kind of controller."""
    lines = [
        [row["kind"], f"{row['parameters']:,}", number(row["value_s"], 1e-3),
         number(row["gradient_s"], 1e-3), number(row["ratio"]), f"{row['error']:.0e}",
         number(row["compile_s"]), number(row["memory_MB"])]
        for row in numbers["kinds"]
    ]  # fmt: skip
    header = ["controller", "parameters", "value [ms]", "value and gradient [ms]", "ratio",
              "error of the gradient", "compile [s]", "memory [MB]"]  # fmt: skip
    return rows(header, lines)


def controllers(report: dict) -> list[str]:
    """The section of the results page."""
    numbers = report["numbers"]
    lines = [
        [f"{row['activation']}, {row['bodies']:,} bodies, {row['dtype']}", row["program"],
         f"{row['tolerance']:.0e}", number(row["seconds"], 1e-3), f"{row['error']:.0e}",
         number(row["compile_s"]), number(row["memory_MB"])]
        for row in numbers["rows"]
    ]  # fmt: skip
    checks = "; ".join(
        f"{x['activation']} {x['along']:.0e} and {x['across']:.0e}" for x in numbers["checks"]
    )
    header = ["", "program", "tolerance", "time [ms]", "error", "compile [s]", "memory [MB]"]
    return [
        "## Gradients through controllers", "", machine(report), "",
        "The mean cost of bodies under a network of 1,411 parameters, differentiated by all of"
        " them; horizon 5 s. Errors are norms over that of the gradient, against polhode at"
        " `rtol=1e-11`, which differs from central differences of SciPy's DOP853, along the"
        f" gradient and along a random direction, by ({checks}) of its norm. Least processor time"
        " of one core, of the tolerances that reach an error: polhode / diffrax Tsit5 / diffrax"
        " Dopri8; in bold where diffrax is faster or polhode does not get there.", "",
        *least_times(numbers),
        "The same in float32, errors included:", "", *least_times(numbers, "float32"),
        "By kind of controller, 32 bodies, `rtol=1e-6`:", "", *kinds(numbers),
        "<details><summary>Every tolerance</summary>", "", *rows(header, lines), "</details>", "",
    ]  # fmt: skip
