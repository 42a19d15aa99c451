"""Results of fits as dictionaries, JSON, CSV and figures; what limits them."""

import csv
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode import plot
from polhode.fit import FitOptions, Gyroscope, Recording, log_density, residuals, stack, windows
from polhode.fit._residuals import prior_cost
from polhode.plot._fits import _single

BODY = ph.Inertia.from_moments([1.0, 2.0, 2.5])
STATE = ph.State([0.8, 0.0, 0.6, 0.0], [1.2, -0.8, 1.0])
DRAG, NOISE, TIMES = np.array([0.1, 0.05, 0.2]), 0.01, np.linspace(0.0, 8.0, 25)


@pytest.fixture(scope="module")
def of_scene():
    """Moments and drag, whose common scale the rates do not determine."""
    scene = ph.Scene(BODY, torque=ph.LinearDamping(DRAG))
    path = ph.simulate(scene, STATE, TIMES).omega_body
    rates = path + NOISE * jax.random.normal(jax.random.key(3), path.shape)
    data = Recording.of(TIMES, rates, omega_noise=NOISE)
    options = FitOptions(max_starts=1, gyroscope=Gyroscope.ideal(), trust_noise=True)
    free = lambda s: (s.inertia.diagonal, s.torque.c)  # noqa: E731
    return ph.fit_scene(scene, data, free, rtol=1e-6, options=options), data


@pytest.fixture(scope="module")
def of_inertia():
    times = np.linspace(0.0, 20.0, 60)
    rates = ph.simulate(ph.Scene(BODY), STATE, times).omega_body
    rates = rates + NOISE * jax.random.normal(jax.random.key(1), rates.shape)
    return ph.fit_inertia(times, rates, omega_noise=NOISE)


def test_windows_hold_every_sample():
    recording = Recording.of(np.arange(101.0), np.zeros((101, 3)))
    ends = [(float(w.times[0]), float(w.times[-1])) for w in windows(recording, 50)]
    assert ends == [(0.0, 49.0), (49.0, 100.0)]


def test_values_have_the_names_of_the_scene(of_scene, of_inertia):
    fit, _ = of_scene
    assert fit.value_names == ["inertia.diagonal", "torque.c"]
    assert "torque.c: " in fit.report()
    assert fit.observability()[0].quantity == "inertia.diagonal (3)"
    assert of_inertia.value_names == ["inertia"]


def test_ratios_are_known_where_only_a_common_factor_is_not(of_scene):
    fit, _ = of_scene
    assert fit.findings() == ["undetermined"]
    assert int(fit.null_count) == 1
    assert not np.any(np.isfinite(np.concatenate(fit.std)))
    assert np.all(np.isinf(fit.derived(lambda v: v[0] + v[1])[1]))
    assert "standard deviations are infinite" in fit.report()
    (first, moments, moments_std), (second, drag, drag_std) = fit.common_scale()
    assert (first, second) == ("inertia.diagonal", "torque.c")
    assert np.all(np.abs(moments - [0.4, 0.8, 1.0]) < 4 * moments_std + 1e-9)
    assert np.all(np.abs(drag - DRAG / 2.5) < 4 * drag_std)
    assert moments_std[2] == 0
    assert 0 < drag_std.max() < 0.05
    assert "ratios to the largest" in fit.report()
    expected = fit.derived(lambda v: v[1] / v[0][2])
    np.testing.assert_allclose(drag_std, expected[1])


def test_residuals_of_readings_are_those_of_the_fit(of_inertia):
    """Also, and in figures, if a calibrated bias relates readings to rates."""
    times, bias = np.linspace(0.0, 20.0, 60), np.array([0.3, -0.2, 0.1])
    rates = ph.simulate(ph.Scene(BODY), STATE, times).omega_body
    rates = rates + NOISE * jax.random.normal(jax.random.key(1), rates.shape)
    model = of_inertia.model
    biased = eqx.tree_at(
        lambda m: m.gyroscope, model, Gyroscope(bias=bias, scale_std=0.01, misalignment_std=0.01)
    )
    plain = stack([Recording.of(times, rates, omega_noise=NOISE)])
    readings = stack([Recording.of(times, rates + bias[None], omega_noise=NOISE)])
    expected = residuals(of_inertia.parameters, plain, model)["omega"]
    np.testing.assert_allclose(expected, of_inertia.residuals["omega"], rtol=1e-9, atol=1e-12)
    found = residuals(of_inertia.parameters, readings, biased)["omega"]
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
    fit = eqx.tree_at(lambda f: f.model, of_inertia, biased)
    shown = _single(fit, readings, 0)["omega"]
    np.testing.assert_allclose(shown, rates, rtol=1e-12, atol=1e-12)
    doubled = log_density(readings, biased, noise=2.0)(of_inertia.parameters)
    single = log_density(readings, biased)(of_inertia.parameters)
    prior = prior_cost(of_inertia.parameters, readings, biased)
    np.testing.assert_allclose(4 * (doubled + prior), single + prior)


def test_the_result_as_json_and_csv(of_scene, of_inertia, tmp_path):
    for fit, kind in ((of_scene[0], "scene"), (of_inertia, "inertia")):
        fit.to_json(tmp_path / "fit.json")
        document = json.loads((tmp_path / "fit.json").read_text())
        assert document == json.loads(json.dumps(fit.to_dict()))
        assert document["kind"] == kind
        for name, value in zip(fit.value_names, fit.values, strict=True):
            np.testing.assert_allclose(document["values"][name], value)
        np.testing.assert_allclose(np.array(document["covariance"]), fit.covariance)
        fit.to_csv(tmp_path / "fit.csv")
        with (tmp_path / "fit.csv").open() as file:
            rows = list(csv.DictReader(file))
        numbers = [float(r["value"]) for r in rows if r["name"] == fit.value_names[0]]
        np.testing.assert_allclose(numbers, np.ravel(fit.values[0]))
    assert document["scale_known"] is False
    assert document["moments_std"] == [None] * 3
    assert {"inertia", "moments", "ratios", "gain"} <= {r["name"] for r in rows}
    # no finite standard deviation for what the data do not determine
    assert all(r["std"] == "" for r in rows if r["name"] == "moments")


def test_what_limits_a_fit_is_said(of_scene, of_inertia):
    fit, _ = of_scene
    assert fit.limit().startswith("the motion, which does not show all unknowns")
    assert fit.to_dict()["limit"] == fit.limit()
    # scale factors known to 1 % limit this recording of 0.01 rad/s
    part = of_inertia._calibration_part(0)
    assert of_inertia.limit().startswith(f"the calibration of the gyroscope ({part:.0%}")
    assert 0.5 < part <= 1
    # with an exact calibration the noise limits it
    matrix = np.array(of_inertia.covariance)
    own, gain = slice(0, 6), slice(6, 15)
    side = matrix[own, gain]
    matrix[own, own] -= side @ np.linalg.pinv(matrix[gain, gain], hermitian=True) @ side.T
    matrix[own, gain], matrix[gain, own] = 0, 0
    exact = eqx.tree_at(lambda f: f.covariance, of_inertia, jnp.asarray(matrix))
    assert exact.limit().startswith("the noise of the readings")
    wrong = eqx.tree_at(
        lambda f: f.diagnostics, of_inertia, jnp.asarray(int(ph.fit.Finding.NOT_WHITE))
    )
    assert wrong.limit() == "the model, which does not explain the readings (not white)"


def test_a_figure_of_a_batch_needs_its_recording(of_inertia):
    pytest.importorskip("matplotlib")
    batch = jax.tree.map(lambda x: jnp.stack([x, x]), of_inertia)
    times = np.linspace(0.0, 20.0, 60)
    with pytest.raises(ValueError, match=r"leading axes \(2,\), got \(\)"):
        plot.fit(batch, Recording.of(times, np.ones((60, 3))), body=1)


def test_a_figure_of_a_fitted_scene(of_scene):
    pytest.importorskip("matplotlib")
    figure = plot.fit(*of_scene, title="damping")
    titles = [ax.get_title(loc=where) for ax in figure.axes for where in ("left", "center")]
    assert "Correlations of the fitted numbers" in titles
    assert "Residuals over noise, lines at twice their spread" in titles
    (picture,) = (ax.images[0] for ax in figure.axes if ax.images)
    matrix = np.asarray(picture.get_array())
    assert matrix.shape == (6, 6)
    np.testing.assert_allclose(np.diagonal(matrix), 1)
    text = [t.get_text() for ax in figure.axes for t in ax.texts]
    assert any("torque.c[2]" in x and "not determined" in x for x in text)


INERTIA = (
    "inertia",
    "moments",
    "axes",
    "ratios",
    "moments_std",
    "ratios_std",
    "axes_std",
    "scale_known",
    "principal_values",
    "mirror_inertia",
)


@pytest.mark.parametrize("name", INERTIA)
def test_what_a_fit_of_a_scene_lacks_is_named(of_scene, name):
    with pytest.raises(AttributeError, match=f"has no {name}:"):
        getattr(of_scene[0], name)
    assert not hasattr(of_scene[0], name)


def test_a_fit_of_a_scene_has_no_interval_of_moments(of_scene):
    with pytest.raises(AttributeError, match="a fit of a scene has no principal_values"):
        of_scene[0].interval()
