"""The results page, benchmarks/README.md, from the JSON in benchmarks/results only.

A result is shown by its own keys; ``SECTIONS`` holds the titles, the texts and the choice of keys.
The tables of README.md are written from the same files.
"""

import re
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks._report import RESULTS, ROOT, read

FOLDED_ROWS = 50
"""Longer tables are folded on the page."""

INTRODUCTION = """\
# Benchmarks

Written by `python -m benchmarks page` from the JSON in `benchmarks/results`; do not edit. Every
number here stands in one of those files, with the command that made it.

```sh
make bench                          # quick tables and figures into out/benchmarks
python -m benchmarks                # the same in full: hours on one core
python -m benchmarks.NAME           # one benchmark; --quick, --output FILE, --help
python -m benchmarks.truth --check  # compute the truth again with more digits and compare
```

Peers come from the dependency group `bench` (`pip install --group bench`); one that is not
installed is named as missing. The same bodies go to every program, drawn from a seed; programs
take turns, so that a machine whose speed changes shifts them all. Times are medians, without
compilation; errors are angles in radians against Taylor series of 40 digits
(`benchmarks/truth.py`), which use nothing of the package.

Columns have the names that the numbers have in the files, with their units. Every result names its
commit: that of the measured code, with `-dirty` where it was changed; or for older results, the
commit that brought the file into the repository ("committed with"). The tables of README.md are
written by the same command.
"""


# Numbers and tables


def number(value: float) -> str:
    """Three digits."""
    if value == 0:
        return "0"
    if 1e-2 <= abs(value) < 1e7:
        digits = f"{value:.3g}"
        return f"{float(digits):,.0f}" if abs(value) >= 100 else digits
    return f"{value:.1e}"


def cell(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(map(cell, value))
    if isinstance(value, float):
        return number(value)
    if isinstance(value, int) and not isinstance(value, bool):
        return f"{value:,}"
    return "–" if value is None else str(value)


def table(rows: Iterable[dict], columns: tuple[str, ...] = ()) -> list[str]:
    """Rows by the columns; where none are named, by their keys, without underscores. Columns after
    the first are right-aligned.
    """
    rows = list(rows)
    keys = columns or tuple(
        dict.fromkeys(k for row in rows for k, v in row.items() if _is_shown(v))
    )
    lines = [list(columns) or [key.replace("_", " ") for key in keys]]
    lines += [[cell(row.get(key)) for key in keys] for row in rows]
    text = ["| " + " | ".join(line) + " |" for line in lines]
    return [text[0], "|---" + "|---:" * (len(keys) - 1) + "|", *text[1:], ""]


def _is_shown(value: Any) -> bool:
    """Whether a value fits into a cell: a few numbers, or one."""
    if isinstance(value, list):
        return len(value) <= 8 and all(isinstance(x, int | float) for x in value)
    return not isinstance(value, dict)


def by_keys(title: str, value: Any) -> list[str]:
    """Numbers under their own keys: rows of alike entries as tables, others as lists."""
    head = [f"**{title}**", ""] if title else []
    entries = list(value.values()) if isinstance(value, dict) else []
    if len(entries) > 1 and all(isinstance(entry, dict) for entry in entries):
        counts = Counter(k for entry in entries for k, v in entry.items() if _is_shown(v))
        if 2 * max(counts.values(), default=0) >= len(entries):  # entries that are alike
            value = [{"": name} | entry for name, entry in value.items()]
    if isinstance(value, list):
        if not (value and isinstance(value[0], dict)):
            return [f"- {title}: {cell(value)}", ""] if value and _is_shown(value) else []
        if len(value) > FOLDED_ROWS:
            summary = f"<details><summary>{title or 'rows'}, {len(value)} rows</summary>"
            return [summary, "", *table(value), "</details>", ""]
        return head + table(value)
    if not isinstance(value, dict):
        return [f"- {title}: {cell(value)}", ""]
    plain = {k: v for k, v in value.items() if not isinstance(v, dict | list)}
    lines = [f"- {k.replace('_', ' ')}: {cell(v)}" for k, v in plain.items()]
    lines = [*head, *lines, ""] if lines else []
    for key in value:
        if key not in plain and key != "origin":
            names = [title, "" if key == "rows" else key.replace("_", " ")]
            lines += by_keys(", ".join(filter(None, names)), value[key])
    return lines


# Where a result comes from


def source(report: dict) -> str:
    """The date and the commit of a result, or of a part of one (its ``origin``)."""
    date = report.get("date", "")
    if head := report.get("commit"):
        name, _, changed = head.partition("-")
        return f"{date}, commit `{name[:7]}`{' with uncommitted changes' if changed else ''}"
    if head := report.get("committed_with"):
        return f"{date}, committed with `{head[:7]}`"
    return f"{date}, commit unknown"


def command(report: dict) -> str:
    """The command of a result, its date and its commit."""
    return f"`{report['command']}`, {source(report)}"


def machine(report: dict) -> str:
    """One line on where and how a result was made."""
    about = report["machine"]
    versions = {k: v for k, v in report["versions"].items() if v and k != "equinox"}
    flags = f", `XLA_FLAGS={report['flags']}`" if report["flags"] else ""
    threads = report.get("threads")
    model = f" ({about['model']})" if about.get("model") else ""
    device = about.get("device", "cpu")
    model += "" if device == "cpu" else f" and one {device}"
    return (
        f"`{report['command']}` on {about['processor']}{model}, {about['system']},"
        f" {about.get('memory_GB', '?')} GB, {threads} core{'s' if threads != 1 else ''} of a"
        f" shared virtual machine{flags}; "
        + ", ".join(f"{name} {version}" for name, version in versions.items())
        + f"; {source(report)}."
    )


def origins(report: dict) -> list[str]:
    """Lines on the parts of a result that are of another run."""
    return [
        f"- {part.replace('_', ' ')}: {(command if 'command' in origin else source)(origin)}."
        for part, origin in report["numbers"].get("origin", {}).items()
    ]


def merged() -> dict | None:
    """The work-precision results, one file for some families each, as one; None: there are none."""
    from benchmarks.problems import PROBLEMS

    reports = [read(path) for path in RESULTS.glob("work_precision*.json")]
    if not reports:
        return None
    runs = {(r["date"], str(sorted(r["machine"].items())), r.get("commit")) for r in reports}
    if len(runs) > 1:
        raise ValueError("work_precision*.json are of several commits, machines or days: run again")
    scenes = [problem.title for problem in PROBLEMS.values()]
    reports.sort(key=lambda r: scenes.index(r["numbers"]["tables"][0]["title"]))
    numbers: dict[str, Any] = {"missing": {}}
    for report in reports:
        numbers["missing"] |= report["numbers"]["missing"]
        for key, value in report["numbers"].items():
            if isinstance(value, list):
                numbers[key] = [*numbers.get(key, []), *value]
                numbers[key].sort(key=lambda row: scenes.index(row.get("scene") or row["title"]))
    return reports[0] | {"numbers": numbers, "reports": reports}


# The page


class Section(NamedTuple):
    """``keys``: those of the numbers that are shown, separated by spaces; none: all."""

    title: str
    text: str = ""
    keys: str = ""


SECTIONS = {
    "work_precision": Section(
        "Error against run time",
        "How many times as long as polhode's default the fastest peer takes until the attitude"
        " error is below a level; below 1 the peer is faster. Interpolated between settings on"
        " logarithmic scales, never extrapolated; an exact method has one setting. Then the times"
        " of every peer, and what the default reaches where it integrates.",
        "missing fastest_peer_median_body fastest_peer_worst_body time_to_error_median_body "
        "default_errors",
    ),
    "cold_tasks": Section(
        "Tasks from a cold process",
        "Seconds from the start of a process to the first answer, imports and compilation included;"
        " the second call; the first answer of a later process that finds compiled programs in"
        " JAX's persistent cache (`first stored`); the largest resident size.",
        "side_by_side",
    ),
    "imports": Section("Imports", "Least seconds of a new process over alternated runs."),
    "plain_calls": Section(
        "Plain calls",
        "`ph.simulate` as typed, with its checks and both times, beside the compiled program for"
        " the last state alone, at the default `rtol`. Then free bodies by saved times, and how far"
        " the most expensive lies above a straight line between its neighbours (`spread`).",
    ),
    "first_calls": Section(
        "First calls",
        "Seconds of processor time of the first call and the first gradient of a new process"
        " without a cache of programs, one body.",
    ),
    "gradients": Section(
        "Gradients",
        "Of a linear function of the final state by the moments of each body, or by what is named,"
        " to t = `horizon`; errors relative, against 40-digit solutions.",
    ),
    "controllers": Section(
        "Gradients through controllers",
        "The mean cost of bodies under a network of 1,411 parameters, differentiated by all of"
        " them: least processor time of the tolerances whose error, over the norm of the gradient,"
        " is below a level. The reference is polhode at `rtol=1e-11`, which is compared with"
        " central differences of SciPy's DOP853 along the gradient and across it (`checks`).",
        "horizon time_to_error kinds checks",
    ),
    "fuzz": Section(
        "Every part against an independent integrator",
        "Random scenes over six decades against SciPy's DOP853, restarted at every switch. Errors"
        " of attitudes, and of derivatives by the initial rates, a moment of inertia and a gain"
        " (`slopes`), over `rtol`; `beyond`: more than ten, and more than rounding explains.",
        "values slopes parts",
    ),
    "conservation": Section(
        "Energy and angular momentum over many revolutions",
        "Relative change of the energy, and of the components of the angular momentum that the"
        " scene conserves, the largest up to each number of revolutions. Integrated motions"
        " accumulate the error that `rtol` allows.",
    ),
    "scene_cost": Section(
        "Cost of each kind of scene",
        "Operations and bytes per body as the compiler counts them (the body of a loop once), and"
        " times that compare the rows of this table alone. Then a satellite, and 50 of them, for an"
        " hour under the gravity gradient and with one part more (`ratio` over that without): 61"
        " samples, `rtol=1e-6`, processor time of one core. Last, reading mass properties.",
    ),
    "accelerator": Section(
        "Accelerators",
        "Beside diffrax at the loosest tolerance whose median error is at most 1e-9 rad; where"
        " `equal error` is False, no tolerance reaches the error of polhode. Shares are of the"
        " bandwidth and arithmetic peak that two small programs reach.",
    ),
    "scaling": Section("Time and memory against bodies, horizon and saved times"),
    "identification": Section(
        "Identification",
        "Simulated bodies: errors of the tensor over the Cramér-Rao bound, how often the intervals"
        " of 95 % contain the truth, and the time of a fit beside SciPy.",
    ),
    "throws": Section(
        "Throws with a flywheel",
        "Real recordings (TU Delft, arXiv:2503.13137; not part of the project). Errors where the"
        " reference is known, means over throws; the mean of single throws beside the joint fit, by"
        " principal moment; other choices of the analysis.",
        "every_throw_alone throws_of_a_configuration_together single_throws_and_joint_fit varied",
    ),
    "throws_synthetic": Section(
        "Simulated throws",
        "Bodies of 1 to 30 times the inertia of the TU Delft device, each throw alone, with the"
        " noise that 40 of every 120 show, or with its own noise; values by principal moment. `std"
        " percent` is the stated standard deviation, which is also the bound.",
    ),
    "throw_design": Section(
        "Information of a throw by its design",
        "Geometric mean of the standard deviations of the tensor after one throw, by direction of a"
        " spin of 18 rad/s, and by the program of the wheel.",
        "best_spin_rad_s largest_over_least_spread",
    ),
    "satellites": Section(
        "Satellites with a wheel",
        "Mean relative error of the tensor from 60 s of rates at 10 Hz with noise of 1e-4 rad/s;"
        " `covered percent`: how often the intervals of 95 % of the likelihood contain the truth.",
    ),
    "light_curves": Section(
        "Light curves",
        "Synthetic tumblers, bodies that are no ellipsoids (`eggs`), and the best solutions of"
        " Toutatis in 1992 by seed of the search (see the top of `benchmarks/light_curves.py`).",
        "speed summary eggs toutatis",
    ),
    "light_curves_unseen": Section(
        "Light curves of other bodies",
        "Convex polyhedra, whose shapes, motions and light do not come from the package (see the"
        " top of `benchmarks/light_curves_unseen.py`), fitted with the default settings; periods in"
        " hours.",
        "curves commits tumblers others period_errors_over_stated processor_seconds not_right",
    ),
    "racquet": Section(
        "Tosses of a racquet",
        "Real recordings of a phone's gyroscope (University of British Columbia,"
        " doi:10.14288/1.0448943; not part of the project). The seven trials of the first round are"
        " not the free motion of one body; those of the fourth are mostly fast, where the air"
        " matters. Standard deviations are those of white residuals, which these are not.",
    ),
    "stress": Section(
        "Stress suite of the exact free motion",
        "Errors against 50 digits in units of eps x max(1, angle turned): of the attitude in"
        " radians, of the rates relative to their size, of derivatives relative to the larger of"
        " the exact one and the natural size. Fast needles lose digits of the gradient in"
        " proportion to the ratio of their moments.",
        "worst",
    ),
    "free_body": Section("The exact free motion"),
    "rotation_stress": Section(
        "Conversions of rotations",
        "Worst errors against 120 digits in units of eps, over random and special samples: values"
        " relative to the rotation's angle where it is small, first and second derivatives relative"
        " to the largest of the sample.",
        "random_points worst_by_conversion",
    ),
    "torqued": Section(
        "Tolerance and error where something acts",
        "Error over the larger of `rtol` and 4 eps angle^1.5, of 24 bodies that share nothing:"
        " largest median, and worst body by horizon. Counted are bodies whose attitude at the end"
        " depends on the start less than ten times as strongly as that of free rotation (no method"
        " can keep the others). Truth: 80-bit Taylor series by heyoka.",
        "over_tolerance",
    ),
    "error_control": Section(
        "Error estimate and tolerance",
        "The true error of single steps over the estimate and over the difference of two orders"
        " (quantiles of 5, 50 and 95 %); the error of the attitude at the last time over `rtol`.",
    ),
    "error_control_constants": Section(
        "Constants of the error control",
        "Each constant at the value at which it does nothing (`without`), one at a time: steps over"
        " those with the constant, least and most of eleven kinds of motion; the largest ratio of"
        " the errors that 95 % of the bodies keep; changes of the numbers of bodies with an error"
        " beyond ten `rtol`, and of bodies that fail.",
    ),
    "engines": Section(
        "Physics engines beside the exact motion",
        "Free bodies at about 10 rad/s in steps of `step` seconds: attitude error and relative"
        " change of the energy after numbers of revolutions; a dash: the motion has diverged.",
        "step after_turns",
    ),
}
"""By name of the result, in the order of the page; others have their name only."""


def section(name: str, report: dict) -> list[str]:
    """Title, text, sources, figure and numbers of a result."""
    title, text, keys = SECTIONS.get(name, Section(name.replace("_", " ").capitalize()))
    numbers = report["numbers"]
    lines = [f"## {title}", "", *([text, ""] if text else [])]
    for each in report.get("reports", [report]):
        lines += [machine(each), "", *origins(each)]
    lines += [""] if lines[-1] else []
    if (RESULTS / f"{name}.svg").exists():
        lines += [f"![{title}](results/{name}.svg)", ""]
    return lines + by_keys("", {k: numbers[k] for k in keys.split() or numbers if k in numbers})


def page() -> str:
    """The text of benchmarks/README.md."""
    reports = {path.stem: read(path) for path in sorted(RESULTS.glob("*.json"))}
    reports = {k: v for k, v in reports.items() if not k.startswith("work_precision")}
    if report := merged():
        reports["work_precision"] = report
    lines = [INTRODUCTION]
    for name in dict.fromkeys((*SECTIONS, *reports)):
        if name in reports:
            lines += section(name, reports[name])
    return "\n".join(lines).rstrip() + "\n"


# Tables in README.md

PROGRAMS = (
    "polhode",
    "heyoka",
    "diffrax",
    "SciPy closed form",
    "SciPy solve_ivp",
    "Numba",
    "MuJoCo",
)
MARK = re.compile(r"<!-- result: ([\w-]+) -->(.*?)<!-- end -->", re.DOTALL)


def cold_tasks_block() -> list[str]:
    """First and later answers of tasks from a cold process."""
    report = read("cold_tasks")
    rows = [
        {
            "": ", beside ".join(filter(None, (row["task"], row["other_library"]))),
            "first [s]": row["first_s"],
            "its first [s]": row["other_first_s"],
            "stored [s]": row["first_stored_s"],
            "second [s]": row["second_s"],
            "its second [s]": row["other_second_s"],
            "memory [MB]": row["memory_MB"],
            "its memory [MB]": row["other_memory_MB"],
            "error": row["error"],
            "its error": row["other_error"],
        }
        for row in report["numbers"]["side_by_side"]
    ]
    return [*table(rows), f"({command(report)})"]


def work_precision_block() -> list[str]:
    """Microseconds per body of polhode and its peers to an error of 1e-9 rad."""
    report = merged()
    if report is None:
        raise FileNotFoundError("no work_precision*.json in benchmarks/results")
    integrated = {row["scene"] for row in report["numbers"]["default_errors"]}
    rows: dict[str, dict[str, Any]] = {}
    for row in report["numbers"]["time_to_error_median_body"]:
        scene, bodies = row["scene"], row["bodies"]
        sizes = (1, 1000) if scene in integrated else (1000,)
        if row["dtype"] == "float64" and bodies in sizes:
            name = scene + ", integrated" * (scene in integrated) + ", one body" * (bodies == 1)
            rows.setdefault(name, {"": name})[row["program"]] = row["us_to_1e-09_rad"]
    sources = dict.fromkeys(source(each) for each in report["reports"])
    made = f"(`python -m benchmarks.work_precision`, {'; '.join(sources)})"
    return [*table(rows.values(), ("", *PROGRAMS)), made]


def plain_calls_block() -> list[str]:
    """Microseconds per body of ordinary calls."""
    report = read("plain_calls")
    rows = [
        {
            "": f"{row['title']}, {row['bodies']:,} {'body' if row['bodies'] == 1 else 'bodies'}",
            "program": row["ns_bare"] / 1e3,
            "call": row["ns_plain"] / 1e3,
            "each of 100 saved times": row["ns_sample"] / 1e3,
            "median error": row["attitude_median"],
        }
        for row in report["numbers"]["rows"]
        if row["bodies"] == 1000 or (row["family"] == "heavy_top" and row["bodies"] == 1)
    ]
    return [*table(rows), f"({command(report)})"]


BLOCKS = {
    "cold-tasks": cold_tasks_block,
    "work-precision": work_precision_block,
    "plain-calls": plain_calls_block,
}


def fill(text: str) -> str:
    """README.md with its tables written anew."""

    def block(match: re.Match) -> str:
        return "\n".join([f"<!-- result: {match[1]} -->", *BLOCKS[match[1]](), "<!-- end -->"])

    return MARK.sub(block, text)


def write() -> list[Path]:
    """Write benchmarks/README.md and the tables of README.md; the files."""
    target, readme = ROOT / "benchmarks" / "README.md", ROOT / "README.md"
    target.write_text(page(), encoding="utf-8")
    readme.write_text(fill(readme.read_text(encoding="utf-8")), encoding="utf-8")
    return [target, readme]
