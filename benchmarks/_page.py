"""The results page and the tables of the README, written from the committed JSON only."""

from pathlib import Path
from typing import Any

from benchmarks import _levels
from benchmarks._report import RESULTS, read

ROOT = Path(__file__).resolve().parents[1]
BEGIN, END = "<!-- benchmarks: begin -->", "<!-- benchmarks: end -->"
PEERS = ("heyoka", "diffrax", "SciPy closed form", "SciPy solve_ivp", "Numba", "MuJoCo")

INTRODUCTION = """\
# Benchmarks

Written by `python -m benchmarks page` from the JSON in `benchmarks/results`; do not edit. Every
number here stands in one of those files, with the command that made it.

```sh
make bench                          # quick tables and figures into out/benchmarks
python -m benchmarks                # the same in full: an hour on one core
python -m benchmarks.NAME           # one benchmark; --quick, --output FILE, --help
python -m benchmarks compare A B    # what changed between two results beyond noise
python -m benchmarks figures FILES  # draw figures from results
python -m benchmarks.truth --check  # make the truth again with more digits and compare
```

Peers come from the dependency group `bench` (`pip install --group bench`); one that is not
installed is named as missing. The same bodies go to every program, drawn from a seed; programs
take turns, so that a machine whose speed changes shifts them all. Times are medians with compiling
apart; errors are angles in radians against Taylor series of 40 digits (`benchmarks/truth.py`),
which use nothing of the package.
"""


def number(value: float | None, unit: float = 1.0) -> str:
    """Three digits, or a dash."""
    if value is None:
        return "–"
    value = value / unit
    if value == 0:
        return "0"
    if 1e-2 <= abs(value) < 1e7:
        digits = f"{value:.3g}"
        return f"{float(digits):,.0f}" if abs(value) >= 100 else digits
    return f"{value:.1e}"


def rows(header: list[str], lines: list[list[str]]) -> list[str]:
    """A Markdown table; columns after the first are right-aligned."""
    out = ["| " + " | ".join(header) + " |", "|---" + "|---:" * (len(header) - 1) + "|"]
    return [*out, *("| " + " | ".join(line) + " |" for line in lines), ""]


def machine(report: dict) -> str:
    """One line on where and how a result was made."""
    about = report["machine"]
    names = {k: v for k, v in report["versions"].items() if v and k not in ("jaxlib", "equinox")}
    flags = f", `XLA_FLAGS={report['flags']}`" if report["flags"] else ""
    threads = report.get("threads")
    return (
        f"`{report['command']}` on {about['processor']}, {about['system']},"
        f" {about.get('memory_GB', '?')} GB, {threads} core{'s' if threads != 1 else ''} of a"
        f" shared virtual machine{flags}; "
        + ", ".join(f"{name} {version}" for name, version in names.items())
        + f"; {report.get('date', '')}."
    )


def heading(table: dict) -> str:
    kind = "" if table["dtype"] == "float64" else f", {table['dtype']}"
    return f"{table['title']}, N = {table['bodies']:,}{kind}"


def best(table: dict, peer: str, level: float, error: str) -> float | None:
    """Time of the best program of a peer at a level."""
    programs = _levels.curves(row for row in table["rows"] if row["peer"] == peer)
    times = [_levels.time_at(group, level, error) for group in programs.values()]
    return min((time for time in times if time is not None), default=None)


def standings(report: dict, error: str) -> list[str]:
    """Per table and level: how many times as long the best peer takes, and which it is."""
    lines = []
    for table in report["numbers"]["tables"]:
        cells = []
        for at in _levels.standing(table, error):
            if at["ratio"] is not None:
                times = f"{number(at['ratio'])} x"
                cells.append(f"{times if at['ratio'] >= 1 else f'**{times}**'} {at['peer']}")
            elif at["ours"] is not None:
                cells.append("only polhode")
            else:
                cells.append(f"**only {at['peer']}**" if at["peer"] else "none")
        lines.append([heading(table), *cells])
    return rows(["", *(f"{level:.0e} rad" for level in _levels.LEVELS)], lines)


def per_peer(table: dict, error: str = "attitude_median") -> list[str]:
    """Time of every peer at every level."""
    floor = {}
    for row in table["rows"]:
        name = "polhode (default)" if _levels.ours(row) else row["peer"]
        if row["peer"] == _levels.OURS and not _levels.ours(row):
            continue
        floor[name] = min(floor.get(name, 9.0), row[error])
    lines = []
    mine = [row for row in table["rows"] if _levels.ours(row)]
    for name in floor:
        times = [
            _levels.time_at(mine, level, error) if name.startswith("polhode")
            else best(table, name, level, error) for level in _levels.LEVELS
        ]  # fmt: skip
        lines.append([name, *(number(time, 1e3) for time in times), f"{floor[name]:.0e}"])
    header = ["µs per body to reach", *(f"{level:.0e}" for level in _levels.LEVELS), "best reached"]
    return rows(header, lines)


def asked(report: dict) -> list[str]:
    """What the default reaches where it steps, beside what it was asked for."""
    lines = []
    for table in report["numbers"]["tables"]:
        for row in table["rows"]:
            if _levels.ours(row) and row["setting"] != "exact":
                lines.append([
                    heading(table), row["program"].removeprefix("default: "), row["setting"],
                    number(row["attitude_median"]), number(row["attitude_worst"]),
                    number(row["ns_per_body"], 1e3),
                ])  # fmt: skip
    header = ["", "method", "rtol", "median error [rad]", "worst error [rad]", "time [µs/body]"]
    return rows(header, lines) if lines else []


def behind(report: dict) -> list[str]:
    """Where a peer is faster than the default, in words."""
    lines = []
    for table in report["numbers"]["tables"]:
        for error, body in (("attitude_median", "median"), ("attitude_worst", "worst")):
            for at in _levels.standing(table, error):
                if at["ratio"] is not None and at["ratio"] < 1:
                    lines.append(
                        f"- {heading(table)}: {at['peer']} ({at['program']}) reaches"
                        f" {at['level']:.0e} rad ({body} body) in {number(at['peer_time'], 1e3)} µs"
                        f" per body, polhode's default in {number(at['ours'], 1e3)} µs."
                    )
                elif at["ours"] is None and at["peer"] is not None:
                    lines.append(
                        f"- {heading(table)}: polhode's default does not reach {at['level']:.0e}"
                        f" rad ({body} body) at the settings run; {at['peer']} does."
                    )
    return lines or ["- In no table of the last full run, at the levels above."]


def compiling(report: dict) -> list[str]:
    """Range of compile times per peer."""
    spans: dict[str, list[float]] = {}
    for table in report["numbers"]["tables"]:
        for row in table["rows"]:
            if row["compile_s"] is not None:
                spans.setdefault(row["peer"], []).append(row["compile_s"])
    words = [f"{name} {min(x):.2f} to {max(x):.1f} s" for name, x in spans.items()]
    return [
        f"- Compiling, per program: {'; '.join(words)} (least: found again in the same run);"
        " SciPy and MuJoCo compile nothing."
    ]


def merged() -> dict | None:
    """The work-precision results, one file or one per family, as one."""
    paths = sorted(RESULTS.glob("work_precision*.json"))
    if not paths:
        return None
    reports = [read(path) for path in paths]
    from benchmarks.problems import PROBLEMS

    tables = [t for report in reports for t in report["numbers"]["tables"]]
    order = list(PROBLEMS)
    tables.sort(key=lambda t: (order.index(t["family"]), t["dtype"], t["bodies"]))
    whole = dict(reports[0])
    whole["commands"] = [report["command"] for report in reports]
    missing = {k: v for report in reports for k, v in report["numbers"]["missing"].items()}
    whole["numbers"] = {"tables": tables, "missing": missing}
    return whole


def work_precision(report: dict) -> list[str]:
    lines = ["## Error against run time", ""]
    for command in dict.fromkeys(report["commands"]):
        lines.append(f"- {machine({**report, 'command': command})}")
    for name, why in report["numbers"]["missing"].items():
        lines.append(f"- Missing: {name} ({why}).")
    lines += [
        "", "![error against time per body](results/work_precision_all.svg)", "",
        "How many times as long as polhode's default the best peer takes until the median body's"
        " attitude error is below a level, and which peer that is. Interpolated between settings on"
        " logarithmic scales, never extrapolated; an exact method has one setting. In bold: the"
        " peer is faster, or the default does not get there at the settings run.", "",
        *standings(report, "attitude_median"),
        "<details><summary>The same for the worst body</summary>", "",
        *standings(report, "attitude_worst"), "</details>", "",
        "<details><summary>What the default reaches where it steps</summary>", "",
        *asked(report), "</details>", "",
        "<details><summary>Every peer</summary>", "",
    ]  # fmt: skip
    for table in report["numbers"]["tables"]:
        lines += [f"**{heading(table)}**", "", *per_peer(table)]
    return [*lines, "</details>", ""]


def gradients(report: dict) -> list[str]:
    lines = []
    for row in report["numbers"]["rows"]:
        lines.append([
            f"{row['title']}: {row['peer']} {row['program']}", row["setting"],
            number(row["ns_value"], 1e3), number(row["ns_gradient"], 1e3), number(row["ratio"]),
            number(row["error_median"]), number(row["error_worst"]), number(row.get("memory_MB")),
            number(row["compile_s"]),
        ])  # fmt: skip
    header = ["", "setting", "value [µs/body]", "value and gradient [µs/body]", "ratio",
              "median error", "worst error", "memory [MB]", "compile [s]"]  # fmt: skip
    return [
        "## Gradients", "", machine(report), "",
        f"Of a linear function of the final state by the three moments of each body, to t ="
        f" {report['numbers']['horizon']:g}; errors relative, against 40-digit solutions.", "",
        *rows(header, lines),
    ]  # fmt: skip


def scene_cost(report: dict) -> list[str]:
    lines = [
        [row["scene"], number(row["flops"]), number(row["transcendentals"]),
         number(row["bytes accessed"]), number(row["ns"], 1e3), number(row["compile_s"])]
        for row in report["numbers"]["rows"]
    ]  # fmt: skip
    header = ["per body", "operations", "transcendental", "bytes", "time [µs]", "compile [s]"]
    return [
        "## What each kind of scene costs", "", machine(report), "",
        "Operations and bytes as the compiler counts them (the body of a loop once): what a scene"
        " does not need is not in its program.", "", *rows(header, lines),
    ]  # fmt: skip


def scaling(report: dict) -> list[str]:
    lines = []
    for sweep in ("bodies", "horizon", "saves"):
        for name, points in report["numbers"][sweep].items():
            for p in points:
                lines.append([
                    f"{name}: {p['method']}", number(p["bodies"]), number(p["horizon"]),
                    number(p["saves"]), number(p["ns_per_body"], 1e3), number(p["memory_MB"]),
                    number(p["temporary_MB"]), f"{p['chunk']:,}",
                ])  # fmt: skip
    header = ["", "bodies", "horizon [s]", "saved times", "time per body [µs]", "memory [MB]",
              "of it temporary", "chunk"]  # fmt: skip
    return [
        "## Scaling", "", machine(report), "",
        "![time and memory against bodies, horizon and saved times](results/scaling.svg)", "",
        *rows(header, lines),
    ]  # fmt: skip


def stress(report: dict) -> list[str]:
    lines = [
        [row["family"], row["dtype"], str(row["bodies"]), number(row["attitude"]),
         number(row["rates"]), number(row["forward"]), number(row["reverse"]), row["worst body"]]
        for row in report["numbers"]["worst"]
    ]  # fmt: skip
    header = ["worst of the family", "dtype", "bodies", "attitude", "rates", "gradient, forward",
              "gradient, reverse", "worst body (reverse)"]  # fmt: skip
    return [
        "## Stress suite of the exact free motion", "", machine(report), "",
        "Errors against 50 digits in units of eps x max(1, angle turned): of the attitude in"
        " radians, of the rates relative to their size, of derivatives relative to the larger of"
        " the exact one and the natural size. Fast needles lose digits of the gradient in"
        " proportion to the ratio of their moments.", "",
        "![errors of every body by family](results/stress.svg)", "", *rows(header, lines),
    ]  # fmt: skip


def generic(report: dict, name: str) -> list[str]:
    """Any other result: its lists of rows as tables, its other numbers as a list."""
    title = name.replace("_", " ")
    lines = [f"## {title[0].upper()}{title[1:]}", "", machine(report), ""]

    def cell(value: Any) -> str:
        if isinstance(value, bool) or not isinstance(value, int | float):
            return "–" if value is None else str(value)
        return f"{value:,}" if isinstance(value, int) else number(value)

    def walk(name: str, value: Any) -> None:
        if isinstance(value, list) and value and all(isinstance(item, dict) for item in value):
            keys = list(dict.fromkeys(k for item in value for k, v in item.items()
                                      if not isinstance(v, dict | list)))  # fmt: skip
            if name:
                lines.extend([f"**{name}**", ""])
            table = [[cell(item.get(key)) for key in keys] for item in value]
            lines.extend(rows([key.replace("_", " ") for key in keys], table))
        elif isinstance(value, dict):
            plain = {k: v for k, v in value.items() if not isinstance(v, dict | list)}
            if plain:
                if name:
                    lines.extend([f"**{name}**", ""])
                lines.extend(f"- {k.replace('_', ' ')}: {cell(v)}" for k, v in plain.items())
                lines.append("")
            for k, v in value.items():
                if isinstance(v, dict | list):
                    walk(f"{name}, {k}".strip(", ").replace("_", " "), v)
        elif isinstance(value, list) and value:
            lines.extend([f"- {name}: {', '.join(map(cell, value))}", ""])

    walk("", report["numbers"])
    return lines


def identification(report: dict) -> list[str]:
    numbers, lines = report["numbers"], []
    for row in [*numbers["designs"], numbers["designs_pooled"]]:
        kind = f"{row['turns']} turns, {row['samples']} samples" if "turns" in row else "pooled"
        cells = [number(row.get(key)) for key in ("noise_over_rate", "bodies",
                 "flagged_weak_or_flat", "flagged_not_converged")]  # fmt: skip
        for key in ("error_over_bound", "interval_cover"):
            value = row.get(key, row.get(f"{key}_95"))
            cells.append(f"{value:.3f} ± {row[f'{key}_std']:.3f}")
        lines.append([kind, *cells])
    header = ["", "noise / rate", "bodies", "weak or flat", "not converged", "error / bound",
              "cover of 95 %"]  # fmt: skip
    speed = numbers["speed"]
    cases = [
        [f"{k + 1}", number(case["ours_s"], 1e-3), number(case["scipy_s"], 1e-3),
         number(case["faster"]), number(case["error_ours"]), number(case["error_scipy"])]
        for k, case in enumerate(speed["cases"])
    ]  # fmt: skip
    others = ["case", "polhode [ms]", "SciPy [ms]", "ratio", "error", "error of SciPy"]
    return [
        "## Identification", "", machine(report), "",
        "![errors over the bound, cover, times](results/identification.svg)", "",
        "Errors of the tensor over the Cramér-Rao bound and cover of 95 % intervals, with standard"
        " errors; flagged bodies left out:", "", *rows(header, lines),
        "One recording of 1,000 samples, from raw rates to covariance, beside `least_squares` over"
        f" `solve_ivp`; tracing and compiling {number(speed['compile_and_trace_s'])} s once:", "",
        *rows(others, cases),
        f"{speed['batch_bodies']:,} bodies in one call cost"
        f" {number(speed['batch_per_body_over_best_single'])} of the best single fit each"
        f" ({number(speed['batch_s'])} s; compile {number(speed['batch_compile_and_trace_s'])} s)."
        " Derivatives of the residuals against 50 digits: relative error"
        f" {number(speed['residual_gradient_error'])}.", "",
    ]  # fmt: skip


def throws(report: dict) -> list[str]:
    kinds = {"every_throw_alone": "alone", "throws_of_a_configuration_together": "together"}
    lines = []
    for kind, how in kinds.items():
        for name, row in report["numbers"][kind].items():
            moments = [sum(column) / len(row["moments"]) for column in zip(*row["moments"])]
            lines.append([
                f"{name}, {how}", *(number(m, 1e-6) for m in moments),
                number(row.get("moments_error_percent")), number(row.get("axes_error_deg")),
            ])  # fmt: skip
    header = ["", "least moment [1e-6 kg m²]", "middle", "largest", "error [%]", "axes [deg]"]
    return [
        "## Throws with a flywheel", "", machine(report), "",
        "Real recordings (TU Delft, arXiv:2503.13137; not part of the project); every throw alone,"
        " the instrument known from all, or those of a configuration together. Errors where the"
        " reference is known, means over throws.", "", *rows(header, lines),
    ]  # fmt: skip


SECTIONS = {
    "gradients": gradients, "scene_cost": scene_cost, "scaling": scaling,
    "identification": identification, "throws": throws, "stress": stress,
}  # fmt: skip


def names_on(text: str) -> list[str]:
    """The results that a page was written from."""
    return text.partition("<!-- results: ")[2].partition(" -->")[0].split()


def page(names: list[str] | None = None) -> str:
    """The text of benchmarks/README.md from the named results; None: from all."""
    names = [path.stem for path in sorted(RESULTS.glob("*.json"))] if names is None else names
    lines = [f"<!-- results: {' '.join(names)} -->", INTRODUCTION]
    found = merged()
    if found:
        lines += work_precision(found)
        lines += [
            "## Where others are better", "", *behind(found), *compiling(found),
            "- MuJoCo simulates contacts and articulated bodies, heyoka any system of ODEs with"
            " event detection and 128-bit or longer arithmetic, diffrax any equation in JAX;"
            " polhode does rotating rigid bodies only.", "",
        ]  # fmt: skip
    names = [name for name in names if not name.startswith("work_precision")]
    for name in (*SECTIONS, *(name for name in names if name not in SECTIONS)):
        if name in names:
            report = read(name)
            lines += SECTIONS[name](report) if name in SECTIONS else generic(report, name)
    return "\n".join(lines).rstrip() + "\n"


def readme_block() -> str:
    """The generated part of the README: a figure, a table, the command."""
    report = merged()
    if report is None:
        return ""
    lines = []
    for table in report["numbers"]["tables"]:
        if table["bodies"] != 1000 or table["dtype"] != "float64":
            continue
        cells = [table["title"]]
        mine = [row for row in table["rows"] if _levels.ours(row)]
        cells.append(number(_levels.time_at(mine, 1e-9), 1e3))
        cells += [number(best(table, p, 1e-9, "attitude_median"), 1e3) for p in PEERS]
        lines.append(cells)
    return "\n".join([
        BEGIN,
        "![error against run time per body](benchmarks/results/work_precision.svg)", "",
        "Microseconds per body, on one core, for a median attitude error of 1e-9 rad at t = 100"
        " (1e5 in the last row), 1,000 bodies, float64, compiling apart; a dash: never reached, or"
        " not offered:", "",
        *rows(["", "polhode", *PEERS], lines),
        "Made by `python -m benchmarks.work_precision`; quick tables by `make bench`; all results,"
        " other precisions and sizes, and where others are better:"
        " [benchmarks](benchmarks/README.md).",
        END,
    ])  # fmt: skip


def write() -> list[Path]:
    """Write benchmarks/README.md and the generated part of README.md; the files."""
    target, readme = ROOT / "benchmarks" / "README.md", ROOT / "README.md"
    target.write_text(page())
    text = readme.read_text()
    if BEGIN in text:
        before, _, rest = text.partition(BEGIN)
        readme.write_text(before + readme_block() + rest.partition(END)[2])
    return [target, readme]
