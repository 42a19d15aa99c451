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

from benchmarks import _controller_section, _levels, _page
from benchmarks._markdown import command, number, rows, source
from benchmarks._report import RESULTS, ROOT, read
from benchmarks.cold_tasks import TASKS

MARK = re.compile(r"<!-- result: ([\w-]+) -->(.*?)<!-- end -->", re.DOTALL)
FRAGMENTS: dict[str, Callable[[], str]] = {}


def pages() -> list[Path]:
    """The pages that may hold fragments."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def filled(text: str) -> str:
    """The text of a page with its fragments written anew."""

    def fragment(match: re.Match) -> str:
        made = FRAGMENTS[match[1]]()
        made = f"\n{made.strip()}\n" if "\n" in made else made
        return f"<!-- result: {match[1]} -->{made}<!-- end -->"

    return MARK.sub(fragment, text)


def _fragment(name: str) -> Callable:
    def register(function: Callable[[], str]) -> Callable[[], str]:
        FRAGMENTS[name] = function
        return function

    return register


def _numbers(name: str) -> dict:
    return read(name)["numbers"]


def _between(values: Iterable[float]) -> str:
    """The least and the largest value."""
    values = list(values)
    return f"{number(min(values))} to {number(max(values))}"


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
        mine = [row for row in table["rows"] if _levels.ours(row)]
        for level in _levels.LEVELS:
            own = _levels.time_at(mine, level)
            other = _page.best(table, peer, level, "attitude_median")
            if own and other:
                found.append(other / own)
    return found


FRAGMENTS["readme-tables"] = _page.readme_block


@_fragment("heavy-top-heyoka")
def _() -> str:
    return _between(_over_ours(_tables("heavy_top"), "heyoka"))


@_fragment("gradient-heyoka")
def _() -> str:
    return _between(_over_ours(_tables("gradient"), "heyoka"))


@_fragment("saved-heyoka")
def _() -> str:
    return _between(_over_ours(_tables("dense_top"), "heyoka"))


@_fragment("exact-scipy")
def _() -> str:
    families = ("free", "near_symmetric", "extreme", "separatrix")
    return _between(_over_ours(_tables(*families), "SciPy closed form"))


@_fragment("one-top")
def _() -> str:
    lines, table = [], next(t for t in _tables("heavy_top", least=1) if t["bodies"] == 1)
    for error, of in (("attitude_median", "median"), ("attitude_worst", "worst")):
        mine = [row for row in table["rows"] if _levels.ours(row)]
        for name, times in (
            ("polhode", [_levels.time_at(mine, level, error) for level in _levels.LEVELS]),
            ("heyoka", [_page.best(table, "heyoka", level, error) for level in _levels.LEVELS]),
        ):
            lines.append([f"{name}, {of} of three", *(number(time, 1e3) for time in times)])
    header = ["µs to reach an error of", *(f"{level:.0e} rad" for level in _levels.LEVELS)]
    return _block(rows(header, lines), f"({command(read('work_precision_heavy_top'))})")


@_fragment("euler-diffrax")
def _() -> str:
    """Euler angles by ``diffrax`` over heyoka's time."""
    found = []
    for table in (t for t in _tables("free", "heavy_top") if t["bodies"] == 1000):
        mine = [row for row in table["rows"] if "Euler" in row["program"]]
        for level in _levels.LEVELS:
            time = _levels.time_at(mine, level)
            other = _page.best(table, "heyoka", level, "attitude_median")
            if time and other:
                found.append(time / other)
    return _between(found)


def cold_tasks() -> str:
    """Ten tasks from a cold process; in bold where the other library has its answer sooner."""
    lines = []
    for row in _numbers("cold_tasks")["rows"]:
        ours, peer = row["polhode"], row["peer"] or {}
        other = f", {TASKS[row['task']][2]}" if peer else ""

        def cells(key, ours=ours, peer=peer):
            sooner = key in peer and peer[key] < ours[key]
            mine, its = number(ours.get(key)), number(peer.get(key))
            return f"{mine} / **{its}**" if sooner else f"{mine} / {its}"

        errors = [f"{x['error']:.0e}" if "error" in x else "–" for x in (ours, peer)]
        lines.append([
            row["task"] + other, cells("first"), cells("second"), number(ours.get("cached")),
            cells("memory"), " / ".join(errors),
        ])  # fmt: skip
    header = ["polhode / other", "first answer [s]", "second call [s]",
              "first answer with stored programs [s]", "memory [MB]", "error"]  # fmt: skip
    return _block(rows(header, lines), f"({command(read('cold_tasks'))})")


if (RESULTS / "cold_tasks.json").exists():
    FRAGMENTS["cold-tasks"] = cold_tasks


# Calls


def _stepped_calls() -> list[dict]:
    return [
        row for row in _numbers("plain_calls")["rows"] if row["family"] in ("heavy_top", "gradient")
    ]


@_fragment("saved-times")
def _() -> str:
    """A call with 100 saved times over one with its last."""
    found = (100 * row["ns_sample"] / row["ns_plain"] for row in _stepped_calls())
    return _between(found)


@_fragment("first-call")
def _() -> str:
    return _between(row["value"] for row in _numbers("first_calls")["rows"])


@_fragment("first-gradient")
def _() -> str:
    return _between(row["gradient"] for row in _numbers("first_calls")["rows"])


@_fragment("gradient-ratio")
def _() -> str:
    mine = (row for row in _numbers("gradients")["rows"] if row["peer"] == "polhode")
    return _between(row["ratio"] for row in mine)


def controller_times() -> str:
    return _block(
        _controller_section.least_times(_numbers("controllers")),
        f"polhode / diffrax Tsit5 / diffrax Dopri8 ({command(read('controllers'))})",
    )


def controller_kinds() -> str:
    return _block(
        _controller_section.kinds(_numbers("controllers")), f"({command(read('controllers'))})"
    )


if (RESULTS / "controllers.json").exists():
    FRAGMENTS["controller-times"] = controller_times
    FRAGMENTS["controller-kinds"] = controller_kinds


# Integrators


@_fragment("step-estimate")
def _() -> str:
    return _between(row["true_over_estimate"][1] for row in _numbers("error_control")["steps"])


@_fragment("step-estimate-most")
def _() -> str:
    steps = _numbers("error_control")["steps"]
    return _between(row["true_over_estimate"][k] for row in steps for k in (0, 2))


@_fragment("step-difference")
def _() -> str:
    return _between(row["true_over_difference"] for row in _numbers("error_control")["steps"])


@_fragment("rtol-kept")
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
    return _block(rows(header, lines), f"({command(read('error_control'))})")


@_fragment("rtol-beyond")
def _() -> str:
    kept = _numbers("error_control")["kept"]
    beyond, bodies = (sum(row[key] for row in kept) for key in ("beyond_10", "bodies"))
    return f"{beyond} of {bodies:,}"


@_fragment("rtol-worst")
def _() -> str:
    return f"{max(row['worst'] for row in _numbers('error_control')['kept']):.3g}"


@_fragment("rtol-estimate")
def _() -> str:
    found = [100 * row["estimate_within_10"] for row in _numbers("error_control")["kept"]]
    return f"{min(found):.0f} to {max(found):.0f} %"


def _kept(key: str) -> str:
    return f"{sum(row[key] for row in _numbers('error_control')['kept'])}"


FRAGMENTS["rtol-false"] = lambda: _kept("false_alarms")
FRAGMENTS["rtol-missed"] = lambda: _kept("missed")


@_fragment("single-worst")
def _() -> str:
    rows_ = _numbers("torqued")["rows"]
    return number(max(row["over_worst"] or 0.0 for row in rows_ if row["dtype"] == "float32"))


# Fits


@_fragment("fit-bodies")
def _() -> str:
    return f"{sum(row['bodies'] for row in _numbers('identification')['designs']):,}"


@_fragment("fit-bound")
def _() -> str:
    found = _numbers("identification")
    low, high = (
        f"{choose(row['error_over_bound'] for row in found['designs']):.3f}"
        for choose in (min, max)
    )
    each = max(row["error_over_bound_std"] for row in found["designs"])
    pooled = found["designs_pooled"]["error_over_bound_std"]
    return f"{low} to {high} of the bound (standard error {each:.3f} each, {pooled:.3f} pooled)"


@_fragment("fit-cover")
def _() -> str:
    found = _numbers("identification")
    values = [100 * row["interval_cover_95"] for row in found["designs"]]
    each = 100 * max(row["interval_cover_std"] for row in found["designs"])
    pooled = found["designs_pooled"]
    return (
        f"{min(values):.1f} to {max(values):.1f} % (standard error {each:.1f} each; pooled"
        f" {100 * pooled['interval_cover_95']:.1f} ± {100 * pooled['interval_cover_std']:.1f})"
    )


@_fragment("fit-flagged")
def _() -> str:
    rows_ = _numbers("identification")["designs"]
    weak, lost = (
        sum(row[key] for row in rows_) for key in ("flagged_weak_or_flat", "flagged_not_converged")
    )
    return f"{weak} bodies flagged as weak or flat and {lost} as not converged"


@_fragment("fit-source")
def _() -> str:
    return f"`python -m benchmarks.identification`, {source(_part('identification', 'designs'))}"


def _part(name: str, part: str) -> dict:
    """Where a part of a result comes from."""
    report = read(name)
    return report["numbers"].get("origin", {}).get(part, report)


def _throws(part: str) -> str:
    kinds = ("std_percent", "mean_error_over_std", "rms_error_over_bound")
    lines = [
        [
            f"{row['size']:g}",
            f"{row['throws']:,}",
            *(" ".join(f"{value:.2f}" for value in row[kind]) for kind in kinds),
            f"{row['covered_percent_all']:.1f} %",
        ]
        for row in _numbers("throws_synthetic")[part]
    ]
    header = ["size", "throws", "stated, %", "mean error over its deviation",
              "rms error over the bound", "95 % hold"]  # fmt: skip
    return _block(rows(header, lines), f"({command(_part('throws_synthetic', part))})")


FRAGMENTS["throws-noise-of-all"] = lambda: _throws("sizes")
FRAGMENTS["throws-noise-of-one"] = lambda: _throws("own_noise")


@_fragment("throws-chance")
def _() -> str:
    """Standard errors of the columns of the first table of simulated throws."""
    count = min(row["throws"] for row in _numbers("throws_synthetic")["sizes"])
    mean, ratio, cover = count**-0.5, (2 * count) ** -0.5, 100 * math.sqrt(0.05 * 0.95 / count)
    return f"{mean:.2f} for means, {ratio:.2f} for ratios, {cover:.1f} % for covers"


@_fragment("throws-real")
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


@_fragment("throws-turn")
def _() -> str:
    rows_ = [
        row
        for row in _numbers("throws")["every_throw_alone"].values()
        if "moments_error_percent" in row
    ]
    turns = " and ".join(f"{row['turn_common_deg'][2]:.2f}" for row in rows_)
    others = max(abs(value) for row in rows_ for value in row["turn_common_deg"][:2])
    return f"{turns} degrees in the mean, about the other axes at most {others:.1f}"


@_fragment("throws-scatter")
def _() -> str:
    rows_ = _numbers("throws")["every_throw_alone"].values()
    found = (f"{row['axes_scatter_deg']:.2f}" for row in rows_ if "axes_scatter_deg" in row)
    return " and ".join(found)


def _apart(key: str) -> list[float]:
    rows_ = _numbers("throws")["single_throws_and_joint_fit"].values()
    return sorted((abs(value) for row in rows_ for value in row[key]), reverse=True)


@_fragment("throws-apart")
def _() -> str:
    largest, ratios = _apart("apart_percent")[0], _apart("apart_over_std")
    return (
        f"{largest:.2f} %, {sum(ratio < 1 for ratio in ratios)} of the {len(ratios)} moments by"
        f" less than one standard error, the largest by {ratios[0]:.1f}"
    )


@_fragment("throws-apart-weighed")
def _() -> str:
    percent, ratios = _apart("apart_weighed_percent"), _apart("apart_weighed_over_std")
    return f"{percent[0]:.2f} %, {ratios[0]:.2f} standard errors"


@_fragment("throws-scatter-over-stated")
def _() -> str:
    return _between(
        (
            scatter / stated
            for row in _numbers("throws")["single_throws_and_joint_fit"].values()
            for scatter, stated in zip(row["scatter_of_one_percent"], row["std_of_one_percent"])
        )
    )


@_fragment("throws-varied")
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
        lines.append([
            names.get(name, name), f"{row['largest']:.1f} ({row['largest_percent']:.2f} %)",
            f"{row['beyond_half']} of {count}", wider if row["wider"] else "nothing left out",
            f"{row['means_rms_over_own_scatter']:.1f}",
        ])  # fmt: skip
    header = ["varied", "largest change over its deviation", "more than half",
              "rms over that expected", "rms over own scatter, means"]  # fmt: skip
    return _block(rows(header, lines), f"({command(read('throws'))})")


@_fragment("throws-lightest")
def _() -> str:
    shifts = _numbers("throws")["varied"]["5 samples to a residual"]["means_over_own_scatter"]
    return _between(abs(value) for value in shifts["config_empty"])


@_fragment("racquet")
def _() -> str:
    found = _numbers("racquet")
    free = found["together"]["round3, over 15 rad/s"]
    lines = []
    for cut in (0, 10):
        row = found["likelihood_of_the_readings"][f"over 15 rad/s, {cut} samples cut"]
        drag = _ratio(row["drag_fitted_ratios"], row["drag_fitted_ratios_std"])
        uncut = f"{_ratio(free['ratios'], free['ratios_std'])}, {free['rms_rad_s']:.2f} rad/s"
        lines.append([
            f"{cut / 100:g} s" if cut else "nothing", str(row["trials"]), "–" if cut else uncut,
            f"{drag}, {row['drag_fitted_rms_rad_s']:.2f} rad/s",
            _ratio(row["ratios"], row["ratios_std"]),
            f"{row['rms_one_sample_ahead_rad_s']:.2f} rad/s",
        ])  # fmt: skip
    header = ["cut off both ends", "trials", "free motion", "with drag",
              "likelihood of the readings", "its residuals one sample ahead"]  # fmt: skip
    return _block(rows(header, lines), f"({command(read('racquet'))})")


def _ratio(ratios: list[float], spread: list[float]) -> str:
    return f"{ratios[0]:.4f}({round(1e4 * spread[0])})"


@_fragment("racquet-slow")
def _() -> str:
    found = _numbers("racquet")["likelihood_of_the_readings"]
    values = (found[f"up to 15 rad/s, {cut} samples cut"]["ratios"][0] for cut in (0, 10))
    return "{:.3f} as recorded and {:.3f} with 0.1 s cut".format(*values)


@_fragment("racquet-torques")
def _() -> str:
    found = _numbers("racquet")["likelihood_of_the_readings"].values()
    return _between(row["slow_torque_rad_s2"] for row in found)


@_fragment("satellites")
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
    header = ["", "least squares", "instrumental variables",
              "likelihood of the readings", "95 % hold"]  # fmt: skip
    return _block(rows(header, lines), f"({command(read('satellites'))})")


def _spread(kind: str) -> str:
    values = list(itertools.chain(*_numbers("throw_design")[kind]))
    return f"{max(values) / min(values):.1f}"


FRAGMENTS["throw-spins"] = lambda: _spread("spread_of_spins")
FRAGMENTS["throw-programs"] = lambda: _spread("spread_of_programs")
