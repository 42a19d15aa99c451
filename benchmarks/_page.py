"""The results page and the block of the README, written from the committed JSON only."""

from pathlib import Path

from benchmarks import _levels
from benchmarks._markdown import command, machine, number, rows, source
from benchmarks._report import RESULTS, ROOT, read
from benchmarks._sections import SECTIONS, generic

PEERS = ("heyoka", "diffrax", "SciPy closed form", "SciPy solve_ivp", "Numba", "MuJoCo")

INTRODUCTION = """\
# Benchmarks

Written by `python -m benchmarks page` from the JSON in `benchmarks/results`; do not edit. Every
number here stands in one of those files, with the command that made it.

```sh
make bench                          # quick tables and figures into out/benchmarks
python -m benchmarks                # the same in full: hours on one core
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

Every result names its commit: that of the code measured, with `-dirty` where it was changed; or for
older results, the commit that brought the file into the repository ("committed with"). Other pages
quote results between markers (`benchmarks/_fragments.py`); the same command writes them, and a test
compares them.
"""


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
    runs = {(r["date"], str(sorted(r["machine"].items())), r.get("commit")) for r in reports}
    if len(runs) > 1:
        raise ValueError("work_precision*.json are of several commits, machines or days: run again")
    from benchmarks.problems import PROBLEMS

    tables = [t for report in reports for t in report["numbers"]["tables"]]
    order = list(PROBLEMS)
    tables.sort(key=lambda t: (order.index(t["family"]), t["dtype"], t["bodies"]))
    whole = dict(reports[0])
    whole["reports"] = reports
    missing = {k: v for report in reports for k, v in report["numbers"]["missing"].items()}
    whole["numbers"] = {"tables": tables, "missing": missing}
    return whole


def work_precision(report: dict) -> list[str]:
    lines = ["## Error against run time", ""]
    lines += [f"- {machine(each)}" for each in report["reports"]]
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
    """The generated part of the README: a figure, two tables, the commands."""
    report = merged()
    if report is None:
        return ""
    lines = []
    for table in report["numbers"]["tables"]:
        mine = [row for row in table["rows"] if _levels.ours(row)]
        stepped = any(row["setting"] != "exact" for row in mine)
        if table["dtype"] != "float64" or table["bodies"] not in (
            (1, 1000) if stepped else (1000,)
        ):
            continue
        about = ", integrated" * stepped + ", one body" * (table["bodies"] == 1)
        cells = [table["title"] + about, number(_levels.time_at(mine, 1e-9), 1e3)]
        cells += [number(best(table, p, 1e-9, "attitude_median"), 1e3) for p in PEERS]
        lines.append(cells)
    return "\n".join([
        "![error against run time per body](benchmarks/results/work_precision.svg)", "",
        "Microseconds per body, on one core, for a median attitude error of 1e-9 rad at t = 100"
        " (1e5 in the last row), 1,000 bodies where none are named, float64, compiling apart; a"
        " dash: never reached, or not offered; rows that are not marked as integrated are closed"
        " forms in polhode:", "",
        *rows(["", "polhode", *PEERS], lines),
        f"Made by `python -m benchmarks.work_precision` ({runs(report)});"
        " quick tables by `make bench`; all results, other precisions and sizes, and where others"
        " are better: [benchmarks](benchmarks/README.md).",
        "",
        *plain_calls_block(),
    ])  # fmt: skip


def runs(report: dict) -> str:
    """The sources of the merged results, each with its families."""
    found: dict[str, list[str]] = {}
    for each in report["reports"]:
        families = dict.fromkeys(table["family"] for table in each["numbers"]["tables"])
        found.setdefault(source(each), []).extend(families)
    return "; ".join(f"{made}: {', '.join(families)}" for made, families in found.items())


def plain_calls_block() -> list[str]:
    """What the calls of a user cost, in a few rows."""
    if not (RESULTS / "plain_calls.json").exists():
        return []
    lines = [
        [
            f"{row['title']}, {row['bodies']:,} {'body' if row['bodies'] == 1 else 'bodies'}",
            *(number(row[name], 1e3) for name in ("ns_bare", "ns_plain", "ns_sample")),
            f"{row['attitude_median']:.0e}",
        ]
        for row in read("plain_calls")["numbers"]["rows"]
        if row["bodies"] == 1000 or (row["family"] == "heavy_top" and row["bodies"] == 1)
    ]  # fmt: skip
    return [
        "Cost of an ordinary call, `ph.simulate(scene, state, [0, 100])`, beside that of its"
        " compiled program for the last state, at the default `rtol`, microseconds per body"
        f" ({command(read('plain_calls'))}):",
        "",
        *rows(["", "program", "call", "each of 100 saved times", "median error"], lines),
    ]


def with_marker(text: str, name: str, after: str) -> str:
    """The page with a marker of a fragment, set after a heading if there is none."""
    marker = f"<!-- result: {name} -->"
    return (
        text if marker in text else text.replace(after, f"{after}{marker}\n-\n<!-- end -->\n\n", 1)
    )


def write() -> list[Path]:
    """Write benchmarks/README.md and the fragments of all pages; the files."""
    from benchmarks import _fragments

    target = ROOT / "benchmarks" / "README.md"
    target.write_text(page(), encoding="utf-8")
    written = [target]
    for path in _fragments.pages():
        text = path.read_text(encoding="utf-8")
        if path.name == "README.md" and "cold-tasks" in _fragments.FRAGMENTS:
            text = with_marker(text, "cold-tasks", after="## Cost\n\n")
        if _fragments.MARK.search(text):
            path.write_text(_fragments.filled(text), encoding="utf-8")
            written.append(path)
    return written
