"""Sections of the results page about throws and wheels."""

from benchmarks._markdown import machine, number, rows, source


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


def throws_synthetic(report: dict) -> list[str]:
    kinds = ["std_percent", "mean_error_over_std", "rms_error_over_bound"]
    header = ["size", "throws", "stated [%]", "mean error over its deviation",
              "rms error over the bound", "95 % intervals hold [%]"]  # fmt: skip
    joint = "joint_rms_error_over_std"

    def lines(name, kinds):
        return [
            [f"{row['size']:g}", f"{row['throws']:,}",
             *(" ".join(f"{value:.2f}" for value in row[kind]) for kind in kinds),
             number(row["covered_percent_all"]),
             *([" ".join(f"{value:.2f}" for value in row[joint])] if joint in row else [])]
            for row in report["numbers"][name]
        ]  # fmt: skip

    part = report["numbers"].get("origin", {}).get("own_noise")
    own = f" ({source(part)})" if part else ""
    return [
        "## Simulated throws", "", machine(report), "",
        "Bodies of 1 to 30 times the inertia of the TU Delft device, each throw alone, with the"
        " noise that 40 of every 120 show; three principal moments.", "",
        *rows([*header, "40 throws together: rms error over the one stated"],
              lines("sizes", kinds)), "",
        f"The same with the noise of each throw estimated from that throw alone{own}.", "",
        *rows(header, lines("own_noise", kinds)),
    ]  # fmt: skip


def throw_design(report: dict) -> list[str]:
    return [
        "## Which throw tells most", "", machine(report), "",
        "Geometric mean of the standard deviations that one throw leaves of the tensor, from the"
        " log-determinant of `benchmarks.throws.throw_information`: by direction of a spin of 18"
        " rad/s, and by the program of the wheel.", "",
        "![what a throw tells by spin and by program](results/throw_design.svg)", "",
    ]  # fmt: skip


def satellites(report: dict) -> list[str]:
    kinds = ("least_squares", "instrumental_variables", "likelihood")
    lines = [
        [row["satellite"] + (", disturbed" if row["disturbed"] else ""), str(row["runs"]),
         *(number(row[f"{kind}_percent"]) for kind in kinds),
         number(row["moments_rms_error_over_std"]), number(row["covered_percent"])]
        for row in report["numbers"]["rows"]
    ]  # fmt: skip
    header = ["", "runs", *(kind.replace("_", " ") + " [%]" for kind in kinds),
              "rms error of the moments over the one stated", "95 % hold [%]"]  # fmt: skip
    return [
        "## Satellites with a wheel", "", machine(report), "",
        "Mean relative error of the tensor from 60 s of rates at 10 Hz with noise of 1e-4 rad/s;"
        " satellites and the wheel's program are assumed (`benchmarks/satellites.py`).", "",
        *rows(header, lines),
    ]  # fmt: skip
