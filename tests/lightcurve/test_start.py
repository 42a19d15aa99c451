"""A fit that starts from the solutions of an earlier one, and the JSON file between them."""

import json
from pathlib import Path

import numpy as np
import pytest

import polhode as ph
from benchmarks.light_curves import directions
from polhode import lightcurve
from polhode.lightcurve import _command, _solutions

AXES = np.array([1.0, 0.6, 0.45])
MOMENTS = AXES @ AXES - AXES**2
STATE = ph.State([0.8, 0.4, -0.3, 0.2], np.array([11.0, 3.0, 5.0]))


def a_solution(**others):
    entries = dict.fromkeys(_solutions.Solution._fields)
    entries |= {
        "P_phi": 0.4,
        "P_psi": 0.9,
        "mode": ph.Mode.LAM,
        "moments": MOMENTS / MOMENTS.max(),
        "axes": AXES,
        "wxyz": np.asarray(ph.rotation.normalise(STATE.wxyz)),
        "omega_body": np.asarray(STATE.omega_body),
        "coefficients": np.array([0.03]),
        "epoch": 0.0,
        "probability": 1.0,
        **others,
    }
    return _solutions.Solution(**entries)  # pyright: ignore[reportArgumentType]


def written(path, *solutions):
    rows = [
        {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in s._asdict().items()}
        | {"mode": s.mode.name}
        for s in solutions
    ]
    path.write_text(json.dumps({"solutions": rows}))
    return path


def test_earlier_solutions_move_to_the_first_time_of_the_new_curve(tmp_path):
    path = written(tmp_path / "earlier.json", a_solution())
    (earlier,) = lightcurve.read_solutions(path)
    for name, kind in _solutions.Solution.__annotations__.items():
        if kind is np.ndarray:
            assert isinstance(getattr(earlier, name), np.ndarray | None), name
    bodies = _solutions.bodies_of((earlier, earlier), 3.7, lightcurve.LinearPhase())
    scene = ph.Scene(ph.Inertia.from_moments(MOMENTS))
    path = ph.simulate(scene, STATE, np.array([0.0, 3.7]))
    np.testing.assert_allclose(bodies.unknowns[0, 4:7], path.omega_body[1], rtol=1e-9)
    turned = np.abs(np.sum(bodies.wxyz[1] * np.asarray(path.wxyz[1])))
    assert turned == pytest.approx(1, abs=1e-9)
    np.testing.assert_allclose(np.exp(bodies.unknowns[0, 2:4]), AXES[1:])
    assert bodies.unknowns[0, 7] == 0.03
    # a phase function with other coefficients begins at its typical ones
    other = _solutions.bodies_of((earlier,), 3.7, lightcurve.HG1G2())
    np.testing.assert_array_equal(other.unknowns[0, 7:], lightcurve.HG1G2().typical)


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"solutions": []}', '{"solutions": [{}]}'])
def test_files_that_are_no_result_are_named(tmp_path, text):
    path = tmp_path / "wrong.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"wrong\.json"):
        lightcurve.read_solutions(path)


def test_no_search_needs_earlier_solutions():
    t = np.linspace(0, 1, 40)
    vectors = np.tile([1.0, 0, 0], (40, 1)), np.tile([0.8, 0.6, 0], (40, 1))
    curve = lightcurve.LightCurve.of(t, np.sin(t), *vectors)
    with pytest.raises(ValueError, match="searches must be at least 1, or 0 with a start"):
        lightcurve.fit_light_curve(curve, searches=0)


def test_unknown_phase_functions_are_refused(tmp_path):
    t = np.linspace(0, 1, 40)
    vectors = np.tile([1.0, 0, 0], (40, 1)), np.tile([0.8, 0.6, 0], (40, 1))
    curve = lightcurve.LightCurve.of(t, np.sin(20 * t), *vectors)
    with pytest.raises(ValueError, match="one of seeliger, linear, hg, hg1g2"):
        _command.fit_file(
            curve,
            "x",
            tmp_path / "x.png",
            tmp_path / "x.json",
            trials=1,
            floor=0.1,
            seed=0,
            phase="lambert",
        )


@pytest.mark.slow
def test_a_night_is_added_to_an_earlier_fit(tmp_path, monkeypatch):
    """Seven nights from a known start, then an eighth, both without a search."""
    pytest.importorskip("matplotlib")
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(2)
    jd = np.sort(np.repeat(np.r_[0, 1, 3, 4, 6, 7, 9, 15], 16) + rng.uniform(0, 0.3, 128))
    sun, observer = (v / np.linalg.norm(v, axis=1)[:, None] for v in directions(jd))
    scene = ph.Scene(ph.Inertia.from_moments(MOMENTS))
    start = ph.simulate(scene, STATE, np.array([0.0, jd[0]]))
    back = ph.rotation.conjugate(ph.simulate(scene, STATE, np.r_[0.0, jd]).wxyz[1:])
    seen = [tuple(ph.rotation.rotate(back, v).T) for v in (sun, observer)]
    light = lightcurve.seeliger_ellipsoid(tuple(AXES), *seen)
    magnitude = -2.5 * np.log10(np.asarray(light)) + 0.01 * rng.normal(size=jd.size)
    table = np.column_stack([jd, magnitude, np.full(jd.size, 0.01), sun, observer])
    names = "jd,magnitude,sigma,sun_x,sun_y,sun_z,observer_x,observer_y,observer_z"
    for name, rows in (("seven.csv", jd < 10), ("eight.csv", jd < 99)):
        np.savetxt(name, table[rows], delimiter=",", header=names, comments="")
    truth = ph.periods(ph.Inertia.from_moments(MOMENTS), STATE)
    body = a_solution(
        P_phi=float(truth.P_phi),
        P_psi=float(truth.P_psi),
        epoch=float(jd[0]),
        wxyz=np.asarray(start.wxyz[1]),
        omega_body=np.asarray(start.omega_body[1]) * 1.001,
    )
    earlier, words = written(Path("known.json"), body), []
    for name in ("seven", "eight"):
        fit = lightcurve.run(
            f"{name}.csv",
            reduced=True,
            calibrated=True,
            phase="linear",
            start=earlier,
            searches=0,
            floor=0.01,
            output=name,
            say=words.append,
        )
        assert fit is not None
        earlier = Path(f"{name}.json")
        document = json.loads(earlier.read_text())
        assert document["settings"]["phase"] == "linear"
        assert document["settings"]["reduced"] is True
        assert document["settings"]["start"] == ("known.json" if name == "seven" else "seven.json")
        (first, *_) = document["solutions"]
        covariance = np.array(first["covariance"])
        assert len(document["covariance_of"]) == len(covariance)
        assert np.sqrt(covariance[0, 0]) == pytest.approx(first["P_phi_std"])
        assert np.sqrt(covariance[1, 1]) == pytest.approx(first["P_psi_std"])
        assert abs(fit.best.P_phi - float(truth.P_phi)) < 4 * fit.best.P_phi_std
        assert abs(fit.best.P_psi - float(truth.P_psi)) < 4 * fit.best.P_psi_std
        assert fit.best.P_phi_std < 1e-3 * fit.best.P_phi
    assert fit.best.P_phi_std < 0.7 * document_of("seven")["solutions"][0]["P_phi_std"]
    assert not any("No second search" in reason for reason in fit.reasons)


def document_of(name):
    return json.loads(Path(f"{name}.json").read_text())
