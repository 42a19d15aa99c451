"""The reference data of `polhode reference`: 17 digits, against Taylor series and polhode."""

import csv
import io
import json
from itertools import pairwise

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

import polhode as ph
from polhode.files._write import REFERENCE, reference_csv

from .make_tumbling import BODIES, START, TURNS, by_turns, difference, stored
from .reference_free import free_reference

pytestmark = pytest.mark.filterwarnings("ignore:Descending:DeprecationWarning")

DATA = ph.files.reference_motions()
ROWS = {row["name"]: row for row in DATA["bodies"]}
TEXTS = {row["name"]: row for row in stored()}
SUBSET = [("permuted_axes", 0), ("prolate", 1), ("plate", 6), ("toutatis", 6)]


def test_the_file_holds_every_body_as_its_script_has_it():
    assert [row["name"] for row in DATA["bodies"]] == [name for name, *_ in BODIES]
    for (_, _, moments, omega), row in zip(BODIES, DATA["bodies"]):
        assert (tuple(row["moments"]), tuple(row["omega_body"])) == (moments, omega)
        assert tuple(row["wxyz"]) == START
        assert [sample["turns"] for sample in row["samples"]] == list(TURNS)


@pytest.mark.parametrize(("name", "place"), SUBSET)
def test_stored_states_agree_with_taylor_series(name, place):
    row = TEXTS[name]
    assert difference(row, row["samples"][place], False) < 0.5001


@pytest.mark.parametrize("moments", [(1.0, 1.0, 1.5), (0.5, 2.0, 2.0)])
def test_steps_of_a_symmetric_body_are_those_of_one_series(moments):
    """For the sphere with one changed moment, whose rates do not return within a period."""
    omega = (0.5, -0.25, 1.0)
    with mp.workdps(60):
        found = by_turns([*map(mp.mpf, moments)], [*map(mp.mpf, omega)], 7.3, mp.mpf("1.1"), 40)
        q, w = free_reference(moments, START, omega, 7.3, digits=40)
        assert max(abs(a - b) for a, b in zip(found, [*q, *w])) < mp.mpf(10) ** -38


@pytest.mark.slow
@pytest.mark.parametrize("name", ROWS)
def test_stored_states_and_derivatives_agree_with_taylor_series(name):
    """States of all samples, derivatives of the last one. ``make_tumbling.py --check`` compares the
    derivatives of all samples, a test below those of the first ones with the closed form.
    """
    *others, last = TEXTS[name]["samples"]
    assert difference(TEXTS[name], last, True, digits=70) < 0.5001
    for sample in others:
        assert difference(TEXTS[name], sample, False) < 0.5001


@pytest.mark.parametrize("name", ["t_handle", "permuted_axes"])
def test_flip_times_are_the_first_zeros_of_the_intermediate_rate(name):
    row = ROWS[name]
    middle = int(np.argsort(row["moments"])[1])
    times = [0.0, *row["flip_times"]]
    between = [(a + b) / 2 for a, b in pairwise(times)]

    def rate(t):
        return free_reference(row["moments"], START, row["omega_body"], t, digits=30)[1][middle]

    scale = max(map(abs, row["omega_body"]))
    assert max(abs(rate(t)) for t in row["flip_times"]) < 1e-14 * scale
    signs = [mp.sign(rate(t)) for t in (0.0, *between[1:])]
    assert signs == [signs[0] * (-1) ** k for k in range(len(signs))]


def rotation_angles(a, b):
    near = np.minimum(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1))
    return 4 * np.arcsin(near / 2)


@pytest.mark.slow
def test_closed_forms_agree_to_rounding_of_the_phase():
    moments, wxyz, omega = (
        jnp.array([row[key] for row in DATA["bodies"]]) for key in ("moments", "wxyz", "omega_body")
    )
    times = jnp.array([[0.0, *(s["t"] for s in row["samples"])] for row in DATA["bodies"]])
    scene = ph.Scene(ph.Inertia.from_moments(moments))
    traj = ph.simulate(scene, ph.State(wxyz, omega), times)
    stored = np.array([[s["wxyz"] for s in row["samples"]] for row in DATA["bodies"]])
    phase = 2 * np.pi * np.array(TURNS)
    angles = rotation_angles(np.asarray(traj.wxyz[:, 1:]), stored)
    # a phase has an error of eps times its size; if flips are rare, an error of the rates grows by
    # the inverse of the distance to the separatrix
    growth = np.ones(len(ROWS))
    growth[list(ROWS).index("near_separatrix")] = 1e3
    assert np.all(angles < 1e-14 * np.maximum(1, phase) * growth[:, None])


@pytest.mark.slow
def test_derivatives_of_the_closed_form_agree():
    for row in DATA["bodies"]:
        if len(set(row["moments"])) < 3 or row["name"] == "nearly_oblate":
            continue  # changing a single moment breaks the symmetry

        def final(parameters, times, row=row):
            scene = ph.Scene(ph.Inertia.from_moments(parameters[:3]))
            traj = ph.simulate(scene, ph.State(row["wxyz"], parameters[3:]), times)
            return jnp.concatenate([traj.wxyz[-1], traj.omega_body[-1]])

        start = jnp.array([*row["moments"], *row["omega_body"]])
        for sample in row["samples"][:4]:
            found = jax.jacfwd(final)(start, jnp.array([0.0, sample["t"]]))
            stored = np.array(sample["wxyz_derivative"] + sample["omega_body_derivative"])
            sign = np.sign(np.dot(final(start, jnp.array([0.0, sample["t"]]))[:4], sample["wxyz"]))
            stored[:4] *= sign
            size = np.abs(stored).max(axis=0)
            size[size == 0] = 1  # a permanent rotation does not depend on its moments
            np.testing.assert_allclose(np.asarray(found) / size, stored / size, atol=1e-9)


def test_the_table_holds_the_numbers_of_the_file_with_all_digits():
    rows = list(csv.DictReader(io.StringIO(reference_csv())))
    samples = [(row, s) for row in DATA["bodies"] for s in row["samples"]]
    assert len(rows) == len(samples)
    for line, (body, sample) in zip(rows, samples):
        assert line["body"] == body["name"]
        assert [float(line[f"I{k}"]) for k in (1, 2, 3)] == body["moments"]
        assert float(line["t"]) == sample["t"]
        assert [float(line[k]) for k in ("qw", "qx", "qy", "qz")] == sample["wxyz"]
        assert float(line["dwz_dwx0"]) == sample["omega_body_derivative"][2][3]
        assert float(line["dqx_dI2"]) == sample["wxyz_derivative"][1][1]
    digits = json.loads(REFERENCE.read_text("utf-8"), parse_float=str)
    assert rows[0]["qw"] == digits["bodies"][0]["samples"][0]["wxyz"][0]
