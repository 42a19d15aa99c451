"""The section of the results page about light curves."""

from benchmarks._markdown import machine, number, rows

VERDICTS = ("right", "within its errors", "listed", "told", "silent")
_LISTED = 4  # solutions of each run that are shown


def light_curves(report: dict) -> list[str]:
    numbers, lines = report["numbers"], ["## Light curves", "", machine(report), ""]
    if "speed" in numbers:
        speed = numbers["speed"]
        lines += [
            f"{speed['states']:,} trial states against {speed['samples']} points:"
            f" {number(speed['seconds'])} s.", "",
        ]  # fmt: skip
    cases = numbers.get("cases", [])
    if cases:
        seeds = sorted({row["seed"] for row in cases})
        lines += [
            f"Synthetic tumblers, seeds {_ranges(seeds)}: how the fit from the light alone ends"
            " (see the top of `benchmarks/light_curves.py`); determined: those whose points tell"
            " both periods to 0.1 %.", "",
            *rows(
                ["noise [mag]", "", "bodies", *VERDICTS, "pole within 10 deg listed", "seconds"],
                [
                    line
                    for part in numbers["summary"]
                    for line in (
                        _counts(part, "all", part),
                        _counts(part["determined"], "determined", part),
                    )
                ],
            ),
        ]  # fmt: skip
        lines += _bodies("Those not right", [r for r in cases if r["verdict"] != "right"])
    if numbers.get("eggs"):
        lines += _bodies("Bodies that are no ellipsoids", numbers["eggs"])
    real = numbers.get("real")
    if real:
        lines += [
            "**2012 TC4, the night of 2012**", "",
            *rows(
                ["mode", "P_phi [min]", "P_psi [min]", "rms [mag]"],
                [
                    [mode, f"{p_phi:.3f}", f"{p_psi:.3f}", f"{rms:.4f}"]
                    for p_phi, p_psi, mode, rms in real["tc4_minutes"][: 2 * _LISTED]
                ],
            ),
            "**Toutatis 1992**: the first solutions of each seed of the search; the last two"
            " columns compare with published values, which no fit has seen.", "",
            *rows(
                ["seed", "place", "mode", "P_phi [d]", "P_psi [d]", "rms [mag]", "odds",
                 "pole [deg]", "moments", "pole off [deg]", "radar attitudes off [deg]"],
                [
                    [str(run["seed"]), str(s["number"] + 1), s["mode"], f"{s['P_phi']:.3f}",
                     f"{s['P_psi']:.3f}", f"{s['rms']:.4f}", number(s["odds"]),
                     ", ".join(f"{x:.1f}" for x in s["pole"]),
                     ", ".join(f"{x / min(s['moments']):.2f}" for x in s["moments"]),
                     number(s["pole_error_deg"]), number(s["radar_median_deg"])]
                    for run in real["toutatis"] for s in run["solutions"][:_LISTED]
                ],
            ),
            *(f"- {note}" for note in dict.fromkeys(
                note for run in real["toutatis"] for note in run["notes"])), "",
        ]  # fmt: skip
    return lines


def _counts(part: dict, name: str, whole: dict) -> list[str]:
    found = name == "all"
    return [
        f"{whole['noise']}", name, str(part["cases"]), *(str(part[v]) for v in VERDICTS),
        str(whole["pole_within_10_deg_listed"]) if found else "",
        number(whole["seconds_median"]) if found else "",
    ]  # fmt: skip


def _bodies(title: str, cases: list[dict]) -> list[str]:
    if not cases:
        return []
    header = ["seed", "noise", "verdict", "place", "true periods [d]", "found [d]",
              "residuals over errors", "best pole off [deg]", "nearest listed"]  # fmt: skip
    lines = [
        [str(r["seed"]), f"{r['noise']}", r["verdict"],
         "–" if r["place"] is None else str(r["place"] + 1),
         _motion(("LAM", "SAM")[r["truth"]["mode"]], r["truth"]),
         _motion(r["mode"], r), number(r["scale"]),
         number(r["pole_error_deg"]), number(r["pole_error_listed_deg"])]
        for r in cases
    ]  # fmt: skip
    return [f"**{title}**", "", *rows(header, lines)]


def _motion(mode: str, row: dict) -> str:
    return f"{mode} {row['P_phi']:.4f}, {row['P_psi']:.4f}"


def _ranges(seeds: list[int]) -> str:
    """Such as 10 to 23, 40."""
    out: list[list[int]] = []
    for seed in seeds:
        if out and seed == out[-1][1] + 1:
            out[-1][1] = seed
        else:
            out.append([seed, seed])
    return ", ".join(f"{a}" if a == b else f"{a} to {b}" for a, b in out)
