"""Motions of free bodies that are correct to 17 digits, to test other programs against."""

import csv
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

REFERENCE = Path(__file__).with_name("reference") / "tumbling.json"
_PARAMETERS = ("I1", "I2", "I3", "wx0", "wy0", "wz0")
_COMPONENTS = ("qw", "qx", "qy", "qz", "wx", "wy", "wz")


def reference_motions() -> dict[str, Any]:
    """Motions of free rigid bodies, correct to 17 significant digits, to test a program against.

    The contents of the file that ``polhode reference`` writes: under ``"bodies"`` a list of bodies
    in every regime, each with ``name``, ``title``, ``moments`` (3) [kg m^2], ``wxyz`` (4) and
    ``omega_body`` (3) [rad/s] at t = 0, ``flip_times`` (3 or none) [s] and ``samples`` up to 1e5
    revolutions: ``t`` [s], ``wxyz`` (4), ``omega_body`` (3) and their derivatives (4, 6) and (3, 6)
    with respect to the three moments and the three initial rates. The other entries state units
    and conventions.

        bodies = ph.files.reference_motions()["bodies"]

    Source: closed forms in arithmetic of 150 digits, checked by Taylor series
    (``tests/free/make_tumbling.py``); the numbers are CC0-1.0.
    """
    return json.loads(REFERENCE.read_text(encoding="utf-8"))


def reference_csv() -> str:
    """The same motions as a table, one row for each body and time, without the flip times."""
    text = io.StringIO()
    derivatives = [f"d{y}_d{x}" for y in _COMPONENTS for x in _PARAMETERS]
    starts = [f"{y}0" for y in _COMPONENTS[:4]]
    table = csv.writer(text, lineterminator="\n")
    table.writerow(
        ["body", *_PARAMETERS[:3], *starts, *_PARAMETERS[3:], "t", *_COMPONENTS, *derivatives]
    )
    table.writerows(_rows())
    return text.getvalue()


def _rows() -> Iterator[list[Any]]:
    # numbers keep the digits of the file: parsed as text
    bodies = json.loads(REFERENCE.read_text(encoding="utf-8"), parse_float=str)["bodies"]
    for body in bodies:
        start = [body["name"], *body["moments"], *body["wxyz"], *body["omega_body"]]
        for sample in body["samples"]:
            changes = sample["wxyz_derivative"] + sample["omega_body_derivative"]
            row = [*start, sample["t"], *sample["wxyz"], *sample["omega_body"]]
            yield row + [x for component in changes for x in component]
