"""The benchmark of unseen light curves: its light curves, without the package, and its scores."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

import polhode as ph
from benchmarks import _page, _report, light_curves_unseen as unseen
from polhode import lightcurve


@pytest.mark.parametrize("long_axis", [True, False])
def test_the_motion_of_the_benchmark_is_that_of_the_package(long_axis):
    rng = np.random.default_rng(3)
    _, _, moments = unseen.polyhedron(rng)
    motion = unseen.Motion(moments, long_axis, 0.6, 0.4)
    t = np.r_[0.0, np.sort(rng.uniform(0, 10, 20))]
    matrices = motion.attitudes(t, 0.2, 0.3)
    omega = motion.momentum(0.2 * motion.period) / moments * motion.scale
    state = ph.State(ph.rotation.matrix_to_wxyz(matrices[0]), omega)
    inertia = ph.Inertia.from_moments(moments)
    path = ph.simulate(ph.Scene(inertia), state, t)
    np.testing.assert_allclose(ph.rotation.wxyz_to_matrix(path.wxyz), matrices, atol=1e-11)
    periods = ph.periods(inertia, state)
    assert float(periods.P_phi) == pytest.approx(motion.P_phi, rel=1e-12)
    assert float(periods.P_psi) == pytest.approx(motion.P_psi, rel=1e-12)
    assert int(periods.mode) == (0 if long_axis else 1)


def test_bodies_of_the_benchmark_are_closed_convex_polyhedra_in_principal_axes():
    rng = np.random.default_rng(0)
    for _ in range(5):
        normals, areas, moments = unseen.polyhedron(rng)
        np.testing.assert_allclose(areas @ normals, 0, atol=1e-13 * areas.sum())
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
        assert moments[0] < moments[1] < moments[2] < moments[0] + moments[1]
        assert normals.shape[0] >= 20


def test_curves_of_the_benchmark_are_what_they_are_called():
    kinds = [unseen.kind_of(seed) for seed in range(140)]
    assert [kinds.count(x) for x in ("tumbler", "rotator", "noise", "few")] == [100, 20, 10, 10]
    for seed in (0, 5, 6, 13):
        (t, magnitude, sun, observer, sigma, group, _), truth = unseen.light_curve(seed)
        assert truth["kind"] == unseen.kind_of(seed)
        assert 0.02 <= sigma <= 0.05
        few = truth["kind"] == "few"
        assert t.size < 40 if few else t.size > 200
        distances = np.linalg.norm(sun, axis=1) * np.linalg.norm(observer, axis=1)
        rest = magnitude - 5 * np.log10(distances)
        rest = rest - np.array([rest[group == k].mean() for k in range(group.max() + 1)])[group]
        if truth["kind"] == "noise":
            assert np.std(rest) < 1.3 * sigma
        elif not few:
            assert np.std(rest) > 2 * sigma
        again = unseen.light_curve(seed)[0][1]
        np.testing.assert_array_equal(again, magnitude)


def test_scores_of_the_benchmark():
    truth = {"kind": "tumbler", "P_phi": 0.3, "P_psi": 0.8, "mode": "LAM", "span": 30.0}
    good = SimpleNamespace(P_phi=0.3002, P_psi=0.801, mode=ph.Mode.LAM)
    assert unseen.same_motion(good, truth)
    assert not unseen.same_motion(good, truth | {"mode": "SAM"})
    assert not unseen.same_motion(SimpleNamespace(P_phi=0.302, P_psi=0.8, mode=good.mode), truth)
    for verdict, right, expected in (
        ("TUMBLING", [True, False], "right"),
        ("TUMBLING", [False, True], "silent"),
        ("AMBIGUOUS", [True], "right, ambiguous"),
        ("AMBIGUOUS", [False, True], "listed"),
        ("AMBIGUOUS", [False], "told"),
        ("ONE_PERIOD", [True], "denied"),
    ):
        assert unseen.score(truth, verdict, right) == expected
    assert unseen.score({"kind": "rotator"}, "ONE_PERIOD", [False]) == "right"
    assert unseen.score({"kind": "noise"}, "AMBIGUOUS", [False]) == "wrong"
    assert unseen.score({"kind": "few"}, "TUMBLING", [True]) == "silent"


def test_a_run_continues_where_it_was_stopped(tmp_path, monkeypatch, capsys):
    """With a replaced search: curves in the file are not fitted again."""
    fitted = []

    def fit(curve):
        fitted.append(curve.t.size)
        body = SimpleNamespace(
            P_phi=1.0,
            P_psi=2.0,
            P_phi_std=0.1,
            P_psi_std=0.1,
            mode=ph.Mode.LAM,
            probability=1.0,
            rms=0.1,
        )
        return SimpleNamespace(
            best=body,
            solutions=(body,),
            verdict=lightcurve.Verdict.AMBIGUOUS,
            par=-1,
            reasons=("one",),
            misfit=1.0,
            agreement=1.0,
            alike=1.0,
            models=(),
        )

    monkeypatch.setattr(lightcurve, "fit_light_curve", fit)
    lines, output = tmp_path / "lines.jsonl", tmp_path / "result.json"
    for first, count in ((0, 2), (0, 3), (5, 2)):
        words = ["x", "--first", str(first), "--count", str(count), "--lines", str(lines)]
        monkeypatch.setattr("sys.argv", [*words, "--output", str(output)])
        unseen.main()
    assert len(fitted) == 5
    seeds = [json.loads(line)["seed"] for line in lines.read_text().splitlines()]
    assert seeds == [0, 1, 2, 5, 6]
    numbers = json.loads(output.read_text())["numbers"]
    assert numbers["curves"] == 5
    (runs,) = numbers["commits"]
    assert (runs["curves"], runs["seeds"]) == (5, "0, 1, 2, 5, 6")
    assert len(runs["commit"].partition("-")[0]) == 7
    ends = {row["score"]: row["curves"] for row in numbers["tumblers"]}
    assert ends["told"] == sum(ends.values()) == 3
    assert numbers["others"][0] == {
        "kind": "rotator",
        "expected": "ONE_PERIOD",
        "right": 0,
        "wrong": 1,
        "silent": 0,
    }
    assert "5 rotator  wrong" in capsys.readouterr().out
    page = "\n".join(_page.section("light_curves_unseen", _report.read(output)))
    assert "| told | not in the list, AMBIGUOUS | 3 |" in page
    assert "| rotator | ONE_PERIOD | 0 | 1 | 0 |" in page
