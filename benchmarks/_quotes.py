"""Numbers and tables in pages, written from the committed results.

A page holds ``<!-- result: NAME -->text<!-- end -->``; ``python -m benchmarks page`` replaces the
text by what the function of that name returns, and a test compares both. A text of several lines is
set between markers on lines of their own. A marker within a sentence must not begin a line, where
Markdown would take the whole line as HTML.
"""

import itertools
import math
import re
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path

from benchmarks import _page
from benchmarks._page import LEVELS, command, markdown, number, source, time_at
from benchmarks._report import ROOT, read

MARK = re.compile(r"<!-- result: ([\w-]+) -->(.*?)<!-- end -->", re.DOTALL)
QUOTES: dict[str, Callable[[], str]] = {}


def pages() -> list[Path]:
    """The pages that may hold quotations."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def fill(text: str) -> str:
    """The text of a page with its quotations written anew."""

    def quotation(match: re.Match) -> str:
        made = QUOTES[match[1]]()
        made = f"\n{made.strip()}\n" if "\n" in made else made
        return f"<!-- result: {match[1]} -->{made}<!-- end -->"

    return MARK.sub(quotation, text)


def _quote(name: str) -> Callable:
    def register(function: Callable[[], str]) -> Callable[[], str]:
        QUOTES[name] = function
        return function

    return register


def _numbers(name: str) -> dict:
    return read(name)["numbers"]


def _between(values: Iterable[float]) -> str:
    """The least and the largest value."""
    values = list(values)
    return f"{number(min(values))} to {number(max(values))}"


RANGES: dict[str, Callable[[], Iterable[float]]] = {
    "first-call": lambda: (row["value"] for row in _numbers("first_calls")["rows"]),
    "first-gradient": lambda: (row["gradient"] for row in _numbers("first_calls")["rows"]),
    "gradient-ratio": lambda: (
        row["ratio"] for row in _numbers("gradients")["rows"] if row["peer"] == "polhode"
    ),
    "step-estimate": lambda: (
        row["true_over_estimate"][1] for row in _numbers("error_control")["steps"]
    ),
    "step-estimate-most": lambda: (
        row["true_over_estimate"][k] for row in _numbers("error_control")["steps"] for k in (0, 2)
    ),
    "step-difference": lambda: (
        row["true_over_difference"] for row in _numbers("error_control")["steps"]
    ),
    "saved-times": lambda: (
        100 * row["ns_sample"] / row["ns_plain"]
        for row in _numbers("plain_calls")["rows"]
        if row["family"] in ("heavy_top", "gradient")
    ),
    "heavy-top-heyoka": lambda: _over_ours(_tables("heavy_top"), "heyoka"),
    "gradient-heyoka": lambda: _over_ours(_tables("gradient"), "heyoka"),
    "saved-heyoka": lambda: _over_ours(_tables("dense_top"), "heyoka"),
    "exact-scipy": lambda: _over_ours(
        _tables("free", "near_symmetric", "extreme", "separatrix"), "SciPy closed form"
    ),
    "read-first": lambda: (row["first_read_s"] for row in _numbers("scene_cost")["files"]),
    "racquet-torques": lambda: (
        row["slow_torque_rad_s2"]
        for row in _numbers("racquet")["likelihood_of_the_readings"].values()
    ),
}
"""Quotations of the least and the largest of some numbers."""
QUOTES |= {name: lambda values=values: _between(values()) for name, values in RANGES.items()}


def _block(lines: list[str], made: str) -> str:
    return "\n".join([*lines, made])


# Work against precision


@cache
def _work() -> dict:
    report = _page.merged()
    if report is None:
        raise FileNotFoundError("no work_precision*.json in benchmarks/results")
    return report


def _tables(*families: str, least: int = 1000) -> list[dict]:
    """The float64 tables of some families, of at least so many bodies."""
    return [
        table
        for table in _work()["numbers"]["tables"]
        if table["family"] in families and table["dtype"] == "float64" and table["bodies"] >= least
    ]


def _over_ours(tables: list[dict], peer: str) -> list[float]:
    """Times of a peer over those of the default, at every level of the median body both reach."""
    found = []
    for table in tables:
        mine = _page.default_rows(table)
        for level in LEVELS:
            own = time_at(mine, level)
            other = _page.best(table, peer, level)
            if own and other:
                found.append(other / own)
    return found


QUOTES["readme-tables"] = _page.readme_block


@_quote("one-top")
def _() -> str:
    lines, table = [], next(t for t in _tables("heavy_top", least=1) if t["bodies"] == 1)
    for error, of in (("attitude_median", "median"), ("attitude_worst", "worst")):
        mine = _page.default_rows(table)
        for name, times in (
            ("polhode", [time_at(mine, level, error) for level in LEVELS]),
            ("heyoka", [_page.best(table, "heyoka", level, error) for level in LEVELS]),
        ):
            lines.append([f"{name}, {of} of three", *(number(time, 1e3) for time in times)])
    header = ["µs to reach an error of", *(f"{level:.0e} rad" for level in LEVELS)]
    return _block(markdown(header, lines), f"({command(read('work_precision_heavy_top'))})")


@_quote("euler-diffrax")
def _() -> str:
    """Euler angles by ``diffrax`` over heyoka's time."""
    found = []
    for table in (t for t in _tables("free", "heavy_top") if t["bodies"] == 1000):
        mine = [row for row in table["rows"] if "Euler" in row["program"]]
        for level in LEVELS:
            time = time_at(mine, level)
            other = _page.best(table, "heyoka", level)
            if time and other:
                found.append(time / other)
    return _between(found)


@_quote("cold-tasks")
def _() -> str:
    report = read("cold_tasks")
    return _block(_page.cold_tasks_table(report), f"({command(report)})")


# Calls


@_quote("controller-times")
def _() -> str:
    lines = _page.controller_times(_numbers("controllers"))
    return _block(
        lines, f"polhode / diffrax Tsit5 / diffrax Dopri8 ({command(read('controllers'))})"
    )


@_quote("controller-kinds")
def _() -> str:
    lines = _page.controller_kinds(_numbers("controllers"))
    return _block(lines, f"({command(read('controllers'))})")


# Parts of a scene

SATELLITES = {
    "cost-dipole": "magnetic dipole, field by formula",
    "cost-table": "magnetic dipole, field by cubic table",
    "cost-plates": "drag and sunlight on seven plates, with shadow",
    "cost-inertia": "inertia that changes with time",
    "cost-wheels": "four wheels under control",
    "cost-dumping": "four wheels and momentum dumping",
    "cost-gyro": "control moment gyro",
    "cost-save": "momentum saved in place of states",
}


def _satellite_cost(part: str) -> str:
    """Time of one satellite and of 50, over that without the part, and of the first call."""
    one, fifty = (row for row in _numbers("scene_cost")["parts"] if row["part"] == part)
    return (
        f"{one['ratio']:.1f} times as long ({fifty['ratio']:.1f} times for"
        f" {fifty['bodies']} satellites; first call {number(one['first_call_s'])} s)"
    )


QUOTES |= {name: lambda part=part: _satellite_cost(part) for name, part in SATELLITES.items()}


@_quote("cost-base")
def _() -> str:
    one, fifty = (
        row for row in _numbers("scene_cost")["parts"] if row["part"] == "gravity gradient"
    )
    return (
        f"{number(one['later_call_ms'])} ms ({number(fifty['later_call_ms'])} ms for"
        f" {fifty['bodies']} satellites; first call {number(one['first_call_s'])} s)"
    )


def _read_ms(kind: str) -> str:
    (row,) = (row for row in _numbers("scene_cost")["files"] if row["file"].startswith(kind))
    return number(row["later_read_ms"])


QUOTES["read-urdf"] = lambda: _read_ms("URDF")
QUOTES["read-mjcf"] = lambda: _read_ms("MJCF")
QUOTES["read-mesh"] = lambda: _read_ms("STL")


# Integrators


@_quote("rtol-kept")
def _() -> str:
    cells: dict[str, dict[float, dict]] = {}
    for row in _numbers("error_control")["kept"]:
        cells.setdefault(row["family"], {})[row["rtol"]] = row
    levels = sorted(next(iter(cells.values())), reverse=True)
    lines = []
    for family, found in cells.items():
        values = (
            ", ".join(f"{found[level][key]:.2g}" for key in ("median", "q95", "worst"))
            for level in levels
        )
        lines.append([family, str(found[levels[0]]["bodies"]), *values])
    first, *others = (f"rtol {level:.0e}" for level in levels)
    header = ["", "bodies", f"{first}: median, 95 %, worst", *others]
    return _block(markdown(header, lines), f"({command(read('error_control'))})")


@_quote("control-constants")
def _() -> str:
    report = read("error_control_constants")
    lines = []
    for row in report["numbers"]["constants"]:
        steps = (f"{row[key]:.2f}" for key in ("least_steps", "most_steps"))
        counts = (f"{x:+d}" if x else "" for x in (row["beyond_10"], row["failed"]))
        scene = row["most_in"] if row["most_steps"] > 1.02 else ""
        name, value = f"`{row['constant']}`", f"{row['without']:g}"
        error = f"{row['error']:.1f}" if row["error"] < 1000 else f"{row['error']:.0e}"
        lines.append([name, value, *steps, scene, error, *counts])
    header = ["", "without it", "steps: least", "most", "in", "error", "beyond 10 `rtol`", "failed"]
    return _block(markdown(header, lines), f"({command(report)})")


@_quote("rtol-beyond")
def _() -> str:
    kept = _numbers("error_control")["kept"]
    beyond, bodies = (sum(row[key] for row in kept) for key in ("beyond_10", "bodies"))
    return f"{beyond} of {bodies:,}"


@_quote("rtol-worst")
def _() -> str:
    return f"{max(row['worst'] for row in _numbers('error_control')['kept']):.3g}"


@_quote("rtol-estimate")
def _() -> str:
    found = [100 * row["estimate_within_10"] for row in _numbers("error_control")["kept"]]
    return f"{min(found):.0f} to {max(found):.0f} %"


def _kept(key: str) -> str:
    return f"{sum(row[key] for row in _numbers('error_control')['kept'])}"


QUOTES["rtol-false"] = lambda: _kept("false_alarms")
QUOTES["rtol-missed"] = lambda: _kept("missed")


@_quote("fuzz-values")
def _() -> str:
    report, keys = read("fuzz"), ("runs", "beyond", "flagged", "raised")
    lines = [
        [row["dtype"], row["parts"], *(f"{row[k]:,}" for k in keys)]
        + [number(row[k]) for k in ("median", "worst")]
        for row in report["numbers"]["values"]
    ]
    header = ["", "parts", "runs", "beyond 10 `rtol`", *keys[2:], "median [`rtol`]", "worst"]
    return _block(markdown(header, lines), f"({command(report)})")


@_quote("fuzz-slopes")
def _() -> str:
    report = read("fuzz")
    lines = [
        [row["parts"], f"{row['rtol']:.0e}", *(str(row[k]) for k in ("runs", "flagged"))]
        + [number(row[k]) for k in ("median", "worst")]
        for row in report["numbers"]["slopes"]
    ]
    header = ["parts", "`rtol`", "runs", "flagged", "median [`rtol`]", "worst"]
    return _block(markdown(header, lines), f"({command(report)})")


@_quote("single-worst")
def _() -> str:
    rows = _numbers("torqued")["rows"]
    return number(max(row["over_worst"] or 0.0 for row in rows if row["dtype"] == "float32"))


# Accelerators


@_quote("accelerator")
def _() -> str:
    report = read("accelerator")
    if reason := report["numbers"].get("not_run"):
        return f"not run: {reason}"
    times: dict[tuple, dict] = {}
    for row in report["numbers"]["rows"]:
        if row["bodies"] in (10**3, 10**5, 10**6):
            of_row = times.setdefault((row["title"], row["bodies"]), {})
            of_row[row["program"], row["dtype"]] = row["ns_per_body"] * row["bodies"] / 1e6
    columns = ("polhode", "float64"), ("polhode", "float32"), ("diffrax", "float64")
    header = ["scene", "bodies", *(f"{program}, {dtype}" for program, dtype in columns)]
    lines = [
        [title, f"{bodies:,}", *(number(of_row[key]) if key in of_row else "–" for key in columns)]
        for (title, bodies), of_row in times.items()
    ]
    device = f"milliseconds on one {report['machine']['device']}, jax {report['versions']['jax']}"
    return _block(markdown(header, lines), f"({device}; {command(report)})")


# Fits


@_quote("fit-bodies")
def _() -> str:
    return f"{sum(row['bodies'] for row in _numbers('identification')['designs']):,}"


@_quote("fit-bound")
def _() -> str:
    found = _numbers("identification")
    low, high = (
        f"{choose(row['error_over_bound'] for row in found['designs']):.3f}"
        for choose in (min, max)
    )
    each = max(row["error_over_bound_std"] for row in found["designs"])
    pooled = found["designs_pooled"]["error_over_bound_std"]
    return f"{low} to {high} of the bound (standard error {each:.3f} each, {pooled:.3f} pooled)"


@_quote("fit-cover")
def _() -> str:
    found = _numbers("identification")
    values = [100 * row["interval_cover_95"] for row in found["designs"]]
    each = 100 * max(row["interval_cover_std"] for row in found["designs"])
    pooled = found["designs_pooled"]
    return (
        f"{min(values):.1f} to {max(values):.1f} % (standard error {each:.1f} each; pooled"
        f" {100 * pooled['interval_cover_95']:.1f} ± {100 * pooled['interval_cover_std']:.1f})"
    )


@_quote("fit-flagged")
def _() -> str:
    rows = _numbers("identification")["designs"]
    weak, lost = (
        sum(row[key] for row in rows) for key in ("flagged_weak_or_flat", "flagged_not_converged")
    )
    return f"{weak} bodies flagged as weak or flat and {lost} as not converged"


@_quote("fit-source")
def _() -> str:
    return f"`python -m benchmarks.identification`, {source(_part('identification', 'designs'))}"


def _part(name: str, part: str) -> dict:
    """Where a part of a result comes from."""
    report = read(name)
    return report["numbers"].get("origin", {}).get(part, report)


def _throws(part: str) -> str:
    rows = _numbers("throws_synthetic")[part]
    rows = [{k: v for k, v in row.items() if not k.startswith("joint")} for row in rows]
    return _block(_page.throws_table(rows), f"({command(_part('throws_synthetic', part))})")


QUOTES["throws-noise-of-all"] = lambda: _throws("sizes")
QUOTES["throws-noise-of-one"] = lambda: _throws("own_noise")


@_quote("throws-chance")
def _() -> str:
    """Standard errors of the columns of the first table of simulated throws."""
    count = min(row["throws"] for row in _numbers("throws_synthetic")["sizes"])
    mean, ratio, cover = count**-0.5, (2 * count) ** -0.5, 100 * math.sqrt(0.05 * 0.95 / count)
    return f"{mean:.2f} for means, {ratio:.2f} for ratios, {cover:.1f} % for covers"


@_quote("throws-real")
def _() -> str:
    """Means over the throws, as the throws of the objects with a reference are counted."""
    alone, together = (
        _numbers("throws")[kind]
        for kind in ("every_throw_alone", "throws_of_a_configuration_together")
    )
    known = {k: len(row["moments"]) for k, row in alone.items() if "moments_error_percent" in row}

    def mean(found: dict, key: str) -> float:
        return sum(count * found[k][key] for k, count in known.items()) / sum(known.values())

    one, all_ = (
        f"{mean(found, 'moments_error_percent'):.2f} % in the moments and"
        f" {mean(found, 'axes_error_deg'):.2f} degrees in the axes"
        for found in (alone, together)
    )
    return f"{one} for a single throw, {all_} for all throws of an object together"


@_quote("throws-turn")
def _() -> str:
    rows = [
        row
        for row in _numbers("throws")["every_throw_alone"].values()
        if "moments_error_percent" in row
    ]
    turns = " and ".join(f"{row['turn_common_deg'][2]:.2f}" for row in rows)
    others = max(abs(value) for row in rows for value in row["turn_common_deg"][:2])
    return f"{turns} degrees in the mean, about the other axes at most {others:.1f}"


@_quote("throws-scatter")
def _() -> str:
    rows = _numbers("throws")["every_throw_alone"].values()
    found = (f"{row['axes_scatter_deg']:.2f}" for row in rows if "axes_scatter_deg" in row)
    return " and ".join(found)


def _apart(key: str) -> list[float]:
    rows = _numbers("throws")["single_throws_and_joint_fit"].values()
    return sorted((abs(value) for row in rows for value in row[key]), reverse=True)


@_quote("throws-apart")
def _() -> str:
    largest, ratios = _apart("apart_percent")[0], _apart("apart_over_std")
    return (
        f"{largest:.2f} %, {sum(ratio < 1 for ratio in ratios)} of the {len(ratios)} moments by"
        f" less than one standard error, the largest by {ratios[0]:.1f}"
    )


@_quote("throws-apart-weighed")
def _() -> str:
    percent, ratios = _apart("apart_weighed_percent"), _apart("apart_weighed_over_std")
    return f"{percent[0]:.2f} %, {ratios[0]:.2f} standard errors"


@_quote("throws-scatter-over-stated")
def _() -> str:
    return _between(
        (
            scatter / stated
            for row in _numbers("throws")["single_throws_and_joint_fit"].values()
            for scatter, stated in zip(row["scatter_of_one_percent"], row["std_of_one_percent"])
        )
    )


@_quote("throws-varied")
def _() -> str:
    names = {
        "flight from 0.10 to 0.52 s": "flight from 0.10 to 0.52 s instead of 0.08 to 0.56",
        "10 ms more left out at each switch": "10 ms more left out at each switch of the motor",
        "5 samples to a residual": "5 samples to a residual instead of 4",
    }
    lines = []
    for name, row in _numbers("throws")["varied"].items():
        count = sum(len(shifts) for shifts in row["shift_over_std"].values())
        wider = f"{row['rms_over_expected'] or 0:.2f} ({row['wider']} moments)"
        lines.append(
            [
                names.get(name, name),
                f"{row['largest']:.1f} ({row['largest_percent']:.2f} %)",
                f"{row['beyond_half']} of {count}",
                wider if row["wider"] else "nothing left out",
                f"{row['means_rms_over_own_scatter']:.1f}",
            ]
        )
    header = [
        "varied",
        "largest change over its deviation",
        "more than half",
        "rms over that expected",
        "rms over own scatter, means",
    ]
    return _block(markdown(header, lines), f"({command(read('throws'))})")


@_quote("throws-lightest")
def _() -> str:
    shifts = _numbers("throws")["varied"]["5 samples to a residual"]["means_over_own_scatter"]
    return _between(abs(value) for value in shifts["config_empty"])


@_quote("racquet")
def _() -> str:
    found = _numbers("racquet")
    free = found["together"]["round3, over 15 rad/s"]
    lines = []
    for cut in (0, 10):
        row = found["likelihood_of_the_readings"][f"over 15 rad/s, {cut} samples cut"]
        drag = _ratio(row["drag_fitted_ratios"], row["drag_fitted_ratios_std"])
        uncut = f"{_ratio(free['ratios'], free['ratios_std'])}, {free['rms_rad_s']:.2f} rad/s"
        lines.append(
            [
                f"{cut / 100:g} s" if cut else "nothing",
                str(row["trials"]),
                "–" if cut else uncut,
                f"{drag}, {row['drag_fitted_rms_rad_s']:.2f} rad/s",
                _ratio(row["ratios"], row["ratios_std"]),
                f"{row['rms_one_sample_ahead_rad_s']:.2f} rad/s",
            ]
        )
    header = [
        "cut off both ends",
        "trials",
        "free motion",
        "with drag",
        "likelihood of the readings",
        "its residuals one sample ahead",
    ]
    return _block(markdown(header, lines), f"({command(read('racquet'))})")


def _ratio(ratios: list[float], spread: list[float]) -> str:
    return f"{ratios[0]:.4f}({round(1e4 * spread[0])})"


@_quote("racquet-slow")
def _() -> str:
    found = _numbers("racquet")["likelihood_of_the_readings"]
    values = (found[f"up to 15 rad/s, {cut} samples cut"]["ratios"][0] for cut in (0, 10))
    return "{:.3f} as recorded and {:.3f} with 0.1 s cut".format(*values)


@_quote("satellites")
def _() -> str:
    kinds = ("least_squares", "instrumental_variables", "likelihood")
    lines = [
        [
            row["satellite"] + (", disturbed" if row["disturbed"] else ""),
            *(f"{row[f'{kind}_percent']:.2g} %" for kind in kinds),
            f"{row['covered_percent']:.0f} %",
        ]
        for row in _numbers("satellites")["rows"]
    ]
    header = [
        "",
        "least squares",
        "instrumental variables",
        "likelihood of the readings",
        "95 % hold",
    ]
    return _block(markdown(header, lines), f"({command(read('satellites'))})")


def _spread(kind: str) -> str:
    values = list(itertools.chain(*_numbers("throw_design")[kind]))
    return f"{max(values) / min(values):.1f}"


QUOTES["throw-spins"] = lambda: _spread("spread_of_spins")
QUOTES["throw-programs"] = lambda: _spread("spread_of_programs")
