"""The sections of the results page: each from one result, as lines of Markdown."""

from typing import Any

from benchmarks._controller_section import controllers
from benchmarks._light_curve_section import light_curves
from benchmarks._markdown import machine, number, rows, source
from benchmarks._throw_sections import satellites, throw_design, throws, throws_synthetic


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
        "Of a linear function of the final state by the moments of each body, or by what is named,"
        f" to t = {report['numbers']['horizon']:g}; errors relative, against 40-digit solutions.",
        "", *rows(header, lines),
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
        " does not need is not in its program. Times compare the rows of this table alone: the"
        " programs return whole trajectories, and the top, of moments (1, 2, 3) and with a centre"
        " of mass given as a vector, takes more steps and more work in each than the top of the"
        " other tables, of moments (1, 1.5, 2) and with a centre of mass on its third axis.", "",
        *rows(header, lines),
    ]  # fmt: skip


def scaling(report: dict) -> list[str]:
    lines = []
    for sweep in ("bodies", "horizon", "saves"):
        for name, points in report["numbers"][sweep].items():
            for p in points:
                lines.append([
                    f"{name}: {p['method']}", number(p["bodies"]), number(p["horizon"]),
                    number(p["saves"]), number(p["ns_per_body"], 1e3), number(p["memory_MB"]),
                    number(p["temporary_MB"]),
                    "by size" if p["chunk"] is None else f"{p['chunk']:,}",
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


def cold_tasks(report: dict) -> list[str]:
    from benchmarks import _fragments

    return [
        "## Tasks from a cold process", "", machine(report), "",
        "Seconds from the start of a process to the first answer, imports and compilation included;"
        " the second call in the same process; the first answer of a later process that finds"
        " compiled programs in JAX's persistent cache; the largest resident size. polhode / the"
        " other library; in bold where the other is sooner or smaller. The script of each task"
        " is in `benchmarks/cold_tasks.py`.", "",
        _fragments.cold_tasks(), "",
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
    parts = numbers.get("origin", {})

    def origin(part):
        return f" ({source(parts[part])})" if part in parts else ""

    others = ["case", "polhode [ms]", "SciPy [ms]", "ratio", "error", "error of SciPy"]
    return [
        "## Identification", "", machine(report), "",
        "![errors over the bound, cover, times](results/identification.svg)", "",
        "Errors of the tensor over the Cramér-Rao bound and cover of 95 % intervals, with standard"
        f" errors; flagged bodies left out{origin('designs')}:", "", *rows(header, lines),
        "One recording of 1,000 samples, from raw rates to covariance, beside `least_squares` over"
        f" `solve_ivp`; tracing and compiling {number(speed['compile_and_trace_s'])} s once"
        f"{origin('speed')}:", "",
        *rows(others, cases),
        f"{speed['batch_bodies']:,} bodies in one call cost"
        f" {number(speed['batch_per_body_over_best_single'])} of the best single fit each"
        f" ({number(speed['batch_s'])} s; compile {number(speed['batch_compile_and_trace_s'])} s)."
        " Derivatives of the residuals against 50 digits: relative error"
        f" {number(speed['residual_gradient_error'])}.", "",
    ]  # fmt: skip


def racquet(report: dict) -> list[str]:
    numbers = report["numbers"]
    alone = numbers["alone"]
    lines = []
    for name, row in numbers["together"].items():
        ratios = " : ".join(
            f"{value:.4f}" + (f" ± {spread:.4f}" if k < 2 else "")
            for k, (value, spread) in enumerate(zip(row["ratios"], row["ratios_std"], strict=True))
        )
        error, largest = row["flip_period_error_mean"], row["flip_period_error_largest"]
        flips = ["", ""] if error is None else [number(100 * error), number(100 * largest)]
        lines.append([name, str(row["trials"]), ratios, number(row["rms_rad_s"]), *flips,
                      str(row["flips_compared"])])  # fmt: skip
    header = ["", "trials", "ratios", "rms [rad/s]", "flip period, mean error [%]", "largest",
              "trials with flips"]  # fmt: skip
    flags = ", ".join(f"{k.replace('_', ' ')} {v}" for k, v in alone["findings"].items() if v)
    return [
        "## Tosses of a racquet", "", machine(report), "",
        "Real recordings of a phone's gyroscope (University of British Columbia,"
        " doi:10.14288/1.0448943; not part of the project). The trials of a round together; the"
        " seven of the first, fast spins about all axes, are not the free motion of one body, and"
        " those of the fourth are mostly fast, where the air matters. Standard deviations are"
        " those of white residuals, which these are not (the model lacks the air).", "",
        *rows(header, lines),
        f"Each of the {alone['trials']} trials alone: {alone['physical']} physical bodies,"
        f" {alone['converged']} usable, remarks: {flags}. Published: 0.0660 : 0.9348 : 1 at 0.32"
        " rad/s from 63 trials; single unconstrained fits fail 54 times of 117.", "",
    ]  # fmt: skip


def free_body(report: dict) -> list[str]:
    numbers = report["numbers"]
    lines = [
        [f"({', '.join(f'{m:g}' for m in row['moments'])})", f"{row['t']:,.0f}",
         *(number(row[key]) for key in ("attitude_median", "attitude_worst", "rate_median",
                                        "rate_worst")),
         number(row["ns_per_body"])]
        for row in numbers["final_states"]
    ]  # fmt: skip
    header = ["moments", "t", "attitude, median [rad]", "worst", "rates, median", "worst",
              "time [ns/body]"]  # fmt: skip
    out = [
        "## The exact free motion", "", machine(report), "",
        f"Final states of {numbers['final_states'][0]['bodies']:,} bodies by `ClosedForm`; errors"
        " of the first"
        f" {' or '.join(f'{n:,}' for n in sorted({r['scored'] for r in numbers['final_states']}))}"
        f" of them against {numbers['truth']}.", "",
        *rows(header, lines),
    ]  # fmt: skip
    if numbers["heyoka"]:
        lines = [
            [f"{row['tolerance']:.0e}", number(row["attitude_median"]),
             number(row["attitude_worst"]), number(row["ns_per_body"]),
             number(row["times_as_long"])]
            for row in numbers["heyoka"]
        ]  # fmt: skip
        header = ["tolerance of heyoka", "attitude, median [rad]", "worst", "time [ns/body]",
                  "times as long"]  # fmt: skip
        out += ["heyoka on the bodies of the first row, eight at a time, in the same run:", "",
                *rows(header, lines)]  # fmt: skip
    slope, saved, call = numbers["gradient"], numbers["saved_times"], numbers["latency"]
    error = ""
    if "error_median" in slope:
        error = (
            f"; relative error {number(slope['error_median'])} (median),"
            f" {number(slope['error_worst'])} (worst)"
        )
    out += [
        f"- Gradient of a misfit with respect to the moments, t = {slope['t']:g}:"
        f" {number(slope['gradient_ns_per_body'])} ns per body with the value,"
        f" {number(slope['ratio'])} times the value alone{error}.",
        f"- {saved['times']:,} saved times: {number(saved['ns_per_state_both'])} ns per state,"
        f" {number(saved['ns_per_state_rates'])} without the attitude.",
        f"- One body, one time: {number(call['us_per_call'])} µs a call.",
        f"- Compiling: {number(numbers['final_states'][0]['compile_s'])} s, with the gradient"
        f" {number(slope['compile_gradient_s'])} s.",
    ]
    if linear := numbers.get("linear"):
        out.append("- " + "; ".join(
            f"{row['bodies']:,} bodies {number(row['ns_per_body'])} ns each" for row in linear
        ) + ".")  # fmt: skip
    return [*out, ""]


def rotation_stress(report: dict) -> list[str]:
    found: dict[str, dict] = {}
    for row in report["numbers"]["rows"]:
        found.setdefault(row["conversion"], {})[row["dtype"]] = row
    kinds = {}  # the Euler sequences, worst of each direction
    for name, each in found.items():
        words = name.split(" ")
        if "Euler" in words and "wxyz" in words:
            given = words[0] == "Euler"
            name = "Euler (any sequence) -> wxyz" if given else "wxyz -> Euler (any sequence)"
        kinds.setdefault(name, []).append(each)
    lines, columns = [], ("value", "first", "second")
    for name, members in kinds.items():
        cells = [f"{name}, worst of {len(members)}" if len(members) > 1 else name]
        for dtype in ("float64", "float32"):
            for column in columns:
                values = [each[dtype][column] for each in members]
                cells.append("∞" if None in values else f"{max(values):.2f}")
        lines.append([cell.replace("->", "→") for cell in cells])
    header = ["worst [eps]", "float64: value", "first derivative", "second", "float32: value",
              "first derivative", "second"]  # fmt: skip
    return [
        "## Conversions of rotations", "", machine(report), "",
        "Worst errors against 120 digits over random samples and samples at and near the identity,"
        " half turns, the ends of the angle ranges and every threshold, in units of eps: values"
        " relative to the rotation's angle where it is small, derivatives (forward and reverse)"
        " relative to the largest of the sample.", "",
        *rows(header, lines),
    ]  # fmt: skip


def torqued(report: dict) -> list[str]:
    out = [
        "## Asked and reached where something acts", "", machine(report), "",
        "`method=None`, 24 bodies that share nothing (needles, discs, near-spheres; 1/32 to 8"
        " rad/s) in one batch, four of them alone too. Reached error over the larger of `rtol` and"
        " 4 eps angle^1.5, median and worst of the bodies whose attitude at the end depends on the"
        " start less than ten times as strongly as that of a free turn (how many, in brackets, of"
        " 24; no method can keep the others), worst of both ways of moving them. Truth: 80-bit"
        " Taylor series by heyoka.", "",
        *([f"Note: {note}.", ""] if (note := report["numbers"].get("note")) else []),
    ]  # fmt: skip
    cells: dict[tuple, dict] = {}
    for row in report["numbers"]["rows"]:
        key = row["dtype"], row["scene"], row["horizon"]
        at = cells.setdefault(key, {}).setdefault(row["rtol"], [])
        at.append(row)
    for dtype in dict.fromkeys(key[0] for key in cells):
        levels = sorted({r for key, at in cells.items() if key[0] == dtype for r in at})[::-1]
        lines = []
        for (kind, scene, horizon), found in cells.items():
            if kind != dtype:
                continue
            tame = max(row["tame"] for rows_ in found.values() for row in rows_)
            line = [f"{scene}, t = {horizon:g} [{tame}]"]
            for level in levels:
                both = found.get(level, [])
                median = max((r["over_median"] or 0.0 for r in both), default=None)
                worst = max((r["over_worst"] or 0.0 for r in both), default=None)
                flags = sum(r["flagged"] for r in both)
                text = f"{number(median)} / {number(worst)}"
                line.append(f"{text} ({flags} flagged)" if flags else text)
            lines.append(line)
        header = [dtype, *(f"rtol {level:.0e}" for level in levels)]
        out += rows(header, lines)
    return out


def plain_calls(report: dict) -> list[str]:
    lines = [
        [row["title"], f"{row['bodies']:,}", number(row["ns_bare"], 1e3),
         number(row["ns_plain"], 1e3), number(row["ratio"]), number(row["us_over_program"]),
         number(row["ns_sample"]), number(row["attitude_median"]), number(row["attitude_worst"])]
        for row in report["numbers"]["rows"]
    ]  # fmt: skip
    header = ["", "bodies", "bare [µs/body]", "plain [µs/body]", "ratio", "over the program [µs]",
              "each of 100 saved times [ns]", "median error", "worst error"]  # fmt: skip
    sweeps = [
        [f"{sweep['bodies']:,}", number(sweep["spread"]),
         ", ".join(f"{s}: {number(t)}" for s, t in zip(sweep["saves"], sweep["ns_per_body"]))]
        for sweep in report["numbers"]["layouts"]
    ]  # fmt: skip
    return [
        "## Plain calls", "", machine(report), "",
        "`ph.simulate` as typed, with its checks and both times, beside the compiled program for"
        " the last state alone, at the default `rtol`; the errors beside are those reached. Error"
        " against run time, above, interpolates to a given error instead, and takes the time of"
        " one body from three.", "", *rows(header, lines),
        "Free bodies by saved times, ns per body; how far the dearest lies above a straight line"
        " between its neighbours:", "",
        *rows(["bodies", "dearest over its neighbours", "saved times: ns per body"], sweeps),
    ]  # fmt: skip


def first_calls(report: dict) -> list[str]:
    lines = [
        [row["title"], *(number(row[what]) for what in ("value", "gradient")),
         *(" + ".join(number(row[f"{what}_stages"][s]) for s in ("trace", "lower", "compile"))
           for what in ("value", "gradient"))]
        for row in report["numbers"]["rows"]
    ]  # fmt: skip
    header = ["", "value [s]", "gradient [s]", "value: trace + lower + compile",
              "gradient: trace + lower + compile"]  # fmt: skip
    return [
        "## First calls", "", machine(report), "",
        "Seconds of processor time of the first call and the first gradient of a new process"
        " without a cache of programs, one body; the stages are those of one program under"
        " `jax.jit`.", "",
        *rows(header, lines),
    ]  # fmt: skip


def imports(report: dict) -> list[str]:
    lines = [[row["program"], number(row["seconds"])] for row in report["numbers"]["rows"]]
    return [
        "## Imports", "", machine(report), "",
        f"Least seconds of a new process over {report['numbers']['runs']} alternated runs, beside"
        " the libraries that polhode builds on.", "",
        *rows(["", "time [s]"], lines),
    ]  # fmt: skip


def engines(report: dict) -> list[str]:
    from benchmarks.engines import at_turns

    rows_of = report["numbers"]["rows"]
    lines = []
    for row in rows_of:
        cells = []
        for turns in (1, 10, 100, 1000):
            angle, energy = at_turns(row, turns)
            text = "–" if angle is None else f"{angle:.1e} / {energy:+.1e}"
            cells.append(text)
        lines.append([f"{row['body']}: {row['engine']}", *cells, number(row["us_per_step"])])
    header = ["attitude error [rad] / change of the energy after",
              *(f"{n:,} revolutions" for n in (1, 10, 100, 1000)), "µs a step"]  # fmt: skip
    return [
        "## Physics engines beside the exact motion", "", machine(report), "",
        "Free bodies of `polhode reference` at about 10 rad/s, without damping, in steps of"
        f" {1e3 * report['numbers']['step']:g} ms; a dash: the motion has diverged.", "",
        "![attitude error and energy of physics engines](results/engines.svg)", "",
        *rows(header, lines),
    ]  # fmt: skip


SECTIONS = {
    "cold_tasks": cold_tasks, "imports": imports, "plain_calls": plain_calls,
    "first_calls": first_calls, "gradients": gradients, "controllers": controllers,
    "scene_cost": scene_cost,
    "scaling": scaling, "identification": identification, "throws": throws,
    "throws_synthetic": throws_synthetic, "throw_design": throw_design, "satellites": satellites,
    "light_curves": light_curves,
    "racquet": racquet,
    "stress": stress,
    "free_body": free_body,
    "rotation_stress": rotation_stress, "torqued": torqued, "engines": engines,
}  # fmt: skip
"""By name of the benchmark, in the order of the page; the others go through ``generic``."""
