"""``fit_scene``: drag, wheels, gravity and orbits from recordings, and their uncertainty."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode import plot
from polhode._scene._scene import places_of
from polhode.fit import FitOptions, Gyroscope, Recording
from polhode.fit._conclude import _prior_disagrees
from polhode.fit._model import LeafMotion

BODY = ph.Inertia.from_moments([1.0, 2.0, 2.5])
STATE = ph.State([0.8, 0.0, 0.6, 0.0], [1.2, -0.8, 1.0])
NOISE = 0.01


def noisy(key, values):
    return values + NOISE * jax.random.normal(jax.random.key(key), values.shape)


TRUE_DRAG = np.array([0.1, 0.05, 0.2])
TIMES = np.linspace(0.0, 8.0, 25)


def damped(rates):
    """Rates of a body with this drag, as 240 recordings."""
    scene = ph.Scene(BODY, torque=ph.LinearDamping(TRUE_DRAG))
    path = ph.simulate(scene, ph.State(STATE.wxyz, rates), TIMES).omega_body
    return np.broadcast_to(path, (240, 25, 3))


def drag_of(rates, throw=True):
    """The drag fitted to such recordings, all in one program."""
    data = Recording.of(TIMES, rates, omega_noise=NOISE)
    start = ph.Scene(BODY, torque=ph.LinearDamping(0.15))
    free = lambda s: [s.torque.c]  # noqa: E731
    options = FitOptions(trust_noise=True, max_starts=1, gyroscope=Gyroscope.ideal())
    return ph.fit_scene(start, data, free=free, rtol=1e-7, options=options, throw=throw)


@pytest.fixture(scope="module")
def found():
    """Fits of 240 draws of the noise."""
    return drag_of(noisy(1, damped(STATE.omega_body)))


@pytest.mark.slow
def test_intervals_of_a_drag_hold_the_truth(found):
    """Errors are normal deviates of the stated size."""
    true = TRUE_DRAG
    assert found.values[0].shape == found.std[0].shape == (240, 3)
    off = (np.asarray(found.values[0]) - true) / np.asarray(found.std[0])
    assert np.all(np.abs(off.mean(axis=0)) < 0.26)  # four standard deviations of the mean
    assert np.all(np.abs(off.std(axis=0) - 1) < 0.19)
    inside = np.mean(np.abs(off) < 1.96)
    assert 0.92 < inside < 0.98, inside
    np.testing.assert_allclose(np.mean(np.asarray(found.noise)), 1, atol=0.05)
    assert np.all(np.asarray(found.null_count) == 0)
    assert np.mean(np.asarray(found.diagnostics) == 0) > 0.98


@pytest.mark.slow
def test_whatever_a_scene_holds():
    """Offset of the centre of mass, orbit, drag and wheel together, from two recordings."""

    def scene(centre, axis, drag, momentum):
        gravity = ph.UniformGravity(1.0, centre, [0.0, 0.0, -2.0])
        tide = ph.GravityGradient(2.0, ph.KeplerOrbit(2.0, axis, 0.2, 0.3))
        wheel = ph.Rotor([0.0, 0.6, 0.8], momentum=momentum)
        return ph.Scene(BODY, gravity + tide, ph.LinearDamping(drag), wheel)

    true = ([0.1, 0.0, 0.5], 1.2, [0.1, 0.05, 0.2], 0.4)
    ts, data = jnp.linspace(0.0, 6.0, 40), []
    for k, rates in enumerate(([1.0, -0.8, 1.0], [-0.5, 1.5, 0.2])):
        moved = ph.simulate(scene(*true), ph.State(STATE.wxyz, rates), ts)
        turn = noisy(20 + k, jnp.zeros((40, 3))) / 2
        wxyz = jnp.concatenate([jnp.ones((40, 1)), turn], axis=-1)
        data.append(
            Recording.of(
                ts,
                noisy(10 + k, moved.omega_body),
                wxyz=ph.rotation.multiply(moved.wxyz, wxyz),
                omega_noise=NOISE,
                attitude_noise=NOISE,
            )
        )
    start = scene([0.0, 0.05, 0.4], 1.3, 0.1, 0.3)
    found = ph.fit_scene(
        start,
        data,
        lambda s: [
            s.potential.terms[0].centre_body,
            s.potential.terms[1].position_space.semi_major_axis,
            s.torque.c,
            s.rotors.momentum,
        ],
        rtol=1e-7,
        options=FitOptions(trust_noise=True),
    )
    assert found.findings() == []
    for value, std, exact in zip(found.values, found.std, true, strict=True):
        assert np.all(np.asarray(std) < 0.05)
        off = (np.asarray(value) - np.asarray(exact)) / np.asarray(std)
        assert np.all(np.abs(off) < 4), off
    assert abs(float(found.noise) - 1) < 0.15
    assert found.initial.wxyz.shape == (2, 4)
    np.testing.assert_allclose(
        found.initial.omega_body, [[1.0, -0.8, 1.0], [-0.5, 1.5, 0.2]], atol=0.03
    )
    np.testing.assert_array_equal(found.scene.rotors.momentum, found.values[3])
    assert "+-" in found.report()


@pytest.mark.slow
def test_what_the_data_cannot_show_is_said():
    """The drag about two axes about which the body does not rotate."""
    found = drag_of(damped([0.0, 0.0, 1.0]), throw=False)
    assert found.findings() == ["undetermined"]
    assert np.all(np.asarray(found.null_count) == 2)
    np.testing.assert_array_equal(np.isfinite(found.std[0]), [[False, False, True]] * 240)
    np.testing.assert_allclose(found.values[0][:, 2], 0.2, rtol=1e-6)
    assert "standard deviations are infinite" in found.report()


@pytest.mark.parametrize(
    ("free", "word"),
    [
        (lambda s: [s.torque.c[0]], "arrays that the scene holds"),
        (lambda s: [2 * s.torque.c], "arrays that the scene holds"),
        (lambda s: [s.potential.mass], "arrays that the scene holds"),
        (lambda s: [], "arrays that the scene holds"),
        ("torque.c", "function of the scene"),
    ],
)
def test_what_free_may_point_at(free, word):
    scene = ph.Scene(BODY, torque=ph.LinearDamping(0.1))
    assert places_of(scene, lambda s: s.torque) == places_of(scene, lambda s: [s.torque.c])
    data = Recording.of(jnp.arange(5.0), jnp.ones((5, 3)) * 0.1)
    with pytest.raises(TypeError, match=word):
        ph.fit_scene(scene, data, free)


def test_refused_scenes_and_data():
    scene = ph.Scene(BODY, torque=ph.LinearDamping(0.1))
    data = Recording.of(jnp.arange(5.0), jnp.ones((5, 3)) * 0.1)
    with pytest.raises(ValueError, match="twice"):
        ph.fit_scene(scene, data, lambda s: [s.torque.c, s.torque.c])
    with pytest.raises(TypeError, match=r"Recording\.of"):
        ph.fit_scene(scene, jnp.ones((5, 3)), lambda s: [s.torque.c])
    several = ph.Scene(BODY, torque=ph.LinearDamping([[0.1, 0.1, 0.1]] * 2))
    with pytest.raises(ValueError, match="one body"):
        ph.fit_scene(several, data, lambda s: [s.torque.c])


@pytest.mark.slow  # faster: a fitted scene, test_fit_exports
def test_a_fit_of_a_scene_has_the_fields_of_every_fit(found):
    # the drag, then the initial rates
    spread = np.sqrt(np.diagonal(np.asarray(found.covariance), axis1=1, axis2=2))
    np.testing.assert_allclose(spread[:, :3], found.std[0])
    assert spread.shape == (240, 6)
    assert found.sensor == found.sensor_std == {}
    rates = np.asarray(found.initial.omega_body)
    assert rates.shape == (240, 1, 3)
    off = rates[:, 0] - np.asarray(STATE.omega_body)
    assert np.all(np.abs(off) < 5 * spread[:, 3:])
    np.testing.assert_array_equal(found.initial.wxyz, np.broadcast_to([1.0, 0, 0, 0], (240, 1, 4)))
    np.testing.assert_allclose(found.rms, NOISE, rtol=0.3)
    assert found.is_usable
    assert found.scene.torque.c.shape == (240, 3)
    assert found.report(3).startswith("body 3:\n")
    assert found.report().count("+-") == 3 * 240


@pytest.mark.slow
def test_the_bias_and_the_model_of_a_fitted_scene():
    """``sensor`` has the bias; ``parameters`` and ``model`` predict the motion of ``scene``."""
    scene = ph.Scene(BODY, torque=ph.LinearDamping(0.1))
    rates = np.asarray(
        ph.simulate(scene, ph.State([1.0, 0, 0, 0], STATE.omega_body), TIMES).omega_body
    )
    bias = np.array([0.05, 0.0, -0.02])
    data = Recording.of(TIMES, rates + bias, omega_noise=1e-3)
    start = ph.Scene(BODY, torque=ph.LinearDamping(0.2))
    options = FitOptions(bias=True, max_starts=1, gyroscope=Gyroscope.ideal())
    fit = ph.fit_scene(start, data, lambda s: s.torque.c, options=options, rtol=1e-7)
    np.testing.assert_allclose(fit.values[0], 0.1, atol=1e-5)
    np.testing.assert_allclose(fit.sensor["bias"], bias, atol=1e-5)
    # bias, drag, initial rates
    spread = np.sqrt(np.diagonal(fit.covariance))
    np.testing.assert_allclose(fit.sensor_std["bias"], spread[:3])
    np.testing.assert_allclose(fit.std[0], spread[3:6])
    predicted = ph.fit.predict(fit.parameters, ph.fit.stack([data]), fit.model).omega
    state = ph.State(fit.initial.wxyz[0], fit.initial.omega_body[0])
    again = ph.simulate(fit.scene, state, TIMES).omega_body
    np.testing.assert_allclose(predicted[0], again, atol=1e-6)


@pytest.mark.slow  # faster: transformations of bounded values, below
def test_bounds_and_priors_hold():
    """A coefficient that is zero, bounded by zero; another with a prior narrower than the data."""
    scene = ph.Scene(BODY, torque=ph.LinearDamping([0.1, 0.06, 0.0]))
    rates = noisy(4, ph.simulate(scene, STATE, TIMES).omega_body)
    data = Recording.of(TIMES, rates, omega_noise=NOISE)
    start = ph.Scene(BODY, torque=ph.LinearDamping([0.12, 0.06, 0.02]))
    options = FitOptions(trust_noise=True, max_starts=1, gyroscope=Gyroscope.ideal())
    fit = ph.fit_scene(
        start,
        data,
        lambda s: s.torque.c,
        bounds=[(0.0, [np.inf, 0.07, np.inf])],
        prior_std=[[1.0, 1e-4, 1.0]],
        options=options,
        rtol=1e-6,
    )
    value, std = np.asarray(fit.values[0]), np.asarray(fit.std[0])
    assert np.all(value >= 0)
    assert abs(value[0] - 0.1) < 4 * std[0]
    assert std[0] < 0.02
    # the prior decides
    assert abs(value[1] - 0.06) < 2e-4
    assert std[1] == pytest.approx(1e-4, rel=0.01)
    assert value[2] < 3 * std[2]
    derived, spread = fit.derived(lambda v: v[0])
    np.testing.assert_allclose(derived, value)
    np.testing.assert_allclose(spread, std, rtol=1e-6)
    row = fit.observability()[0]
    assert (row.shown, row.count, row.source) == (2, 3, "data and prior")
    assert "the prior" in fit.limit()
    # a prior mean of twice the drag
    start = ph.Scene(BODY, torque=ph.LinearDamping([0.2, 0.06, 0.02]))
    narrow = [[0.01, 1.0, 1.0]]
    free = lambda s: s.torque.c  # noqa: E731
    wrong = ph.fit_scene(start, data, free, prior_std=narrow, options=options, rtol=1e-6)
    assert wrong.findings() == ["prior disagrees"]
    assert "prior disagrees" in wrong.limit()


def test_a_tensor_has_six_unknowns_in_a_scene():
    """Faster than the next test."""
    tensor = np.array([[1.0, 0.1, -0.05], [0.1, 2.0, 0.02], [-0.05, 0.02, 2.5]])
    scene = ph.Scene(ph.Inertia.from_tensor(tensor), torque=ph.LinearDamping(0.1))
    motion = LeafMotion(scene, places_of(scene, lambda s: [s.torque.c, s.inertia.full]))
    drag, entries = motion.start()
    np.testing.assert_array_equal(entries, [1.0, 2.0, 2.5, 0.02, -0.05, 0.1])
    assert motion.entry_counts == [None, 6]
    np.testing.assert_array_equal(motion.arrays_of([drag, entries])[1], tensor)


@pytest.mark.slow
def test_an_inertia_tensor_is_fitted_by_its_six_entries():
    """Opposite products are one unknown: finite deviations, one prior, and bounds of both."""
    tensor = np.array([[1.0, 0.1, -0.05], [0.1, 2.0, 0.02], [-0.05, 0.02, 2.5]])
    scene = ph.Scene(ph.Inertia.from_tensor(tensor), torque=ph.LinearDamping(0.1))
    rates = noisy(5, ph.simulate(scene, STATE, TIMES).omega_body)
    data = Recording.of(TIMES, rates, omega_noise=NOISE)
    free = lambda s: [s.inertia.full]  # noqa: E731
    width = np.full((3, 3), 0.5)
    width[0, 1] = width[1, 0] = 1e-4
    options = FitOptions(trust_noise=True, max_starts=1, gyroscope=Gyroscope.ideal())
    fit = ph.fit_scene(scene, data, free, prior_std=[width], options=options, rtol=1e-6)
    value, std = np.asarray(fit.values[0]), np.asarray(fit.std[0])
    assert fit.findings() == []
    assert np.all(std < 0.1)
    assert np.all(np.abs(value - tensor) < 4 * std)
    assert std[0, 1] == pytest.approx(1e-4, rel=0.01)  # the prior decides
    np.testing.assert_array_equal(std, std.T)
    np.testing.assert_array_equal(fit.scene.inertia.full, value)
    np.testing.assert_allclose(fit.derived(lambda v: v[0])[1], std, rtol=1e-6)
    np.testing.assert_allclose(fit.derived(lambda v: (v[0] + v[0].T) / 2)[1], std, rtol=1e-6)
    row = fit.observability()[0]
    assert (row.quantity, row.shown, row.count) == ("inertia.full (6)", 5, 6)
    labels = [x.get_text()[-6:] for x in plot.fit(fit, data).axes[4].get_xticklabels()]
    assert labels == ["[0][0]", "[1][1]", "[2][2]", "[1][2]", "[2][0]", "[0][1]"]
    width[0, 1] = 0.2
    with pytest.raises(ValueError, match="symmetric"):
        ph.fit_scene(scene, data, free, prior_std=[width], options=options)


@pytest.mark.parametrize(
    ("measured", "std", "named"),
    [
        (0.1, 0.05, False),
        (0.1, 0.001, True),
        (0.14, 0.01, False),
        (0.1, 0.01, True),
        (-0.2, 0.05, True),
    ],
)
def test_a_prior_that_contradicts_the_data_is_named(measured, std, named):
    """A drag of 0.15 +- 0.01 and data of ``measured`` +- ``std``: the estimate is their mean."""
    scene = ph.Scene(BODY, torque=ph.LinearDamping(0.15))
    widths = (jnp.full(3, 0.01),)
    motion = LeafMotion(scene, places_of(scene, lambda s: s.torque.c), widths=widths)
    variance = 1 / (std**-2 + 0.01**-2)
    value = variance * (measured * std**-2 + 0.15 * 0.01**-2)
    both = jnp.full(3, value), jnp.full(3, variance**0.5)
    assert bool(_prior_disagrees(motion, [both[0]], [both[1]])) == named


@pytest.mark.slow  # 25 s of compilation; faster: test_bounds_and_priors_hold
def test_optima_at_a_bound_are_found():
    """Of a body without quadratic drag half of the coefficients end at zero, each of 8 recordings
    in fewer steps than the limit."""
    ts = np.linspace(0.0, 12.0, 61)

    def scene(linear, quadratic):
        return ph.Scene(BODY, torque=ph.LinearDamping(linear) + ph.QuadraticDamping(quadratic))

    state = ph.State([1.0, 0, 0, 0], [0.6, 1.5, 0.8])
    rates = ph.simulate(scene([0.1, 0.05, 0.2], 0.0), state, ts).omega_body
    noise = 0.01 * np.random.default_rng(0).normal(size=(8, *rates.shape))
    fitted = ph.fit_scene(
        scene([0.12, 0.08, 0.15], 0.05),
        Recording.of(ts, np.asarray(rates) + noise, omega_noise=0.01),
        lambda s: [s.torque.terms[0].c, s.torque.terms[1].c],
        bounds=[(0.0, None), (0.0, None)],
        options=FitOptions(trust_noise=True),
    )  # raises where one stops at the limit
    linear, quadratic = fitted.values
    assert np.all(linear > 0)
    assert np.all(quadratic >= 0)
    assert np.any(quadratic < 1e-9)
    assert np.all(quadratic < 0.1)


@pytest.mark.parametrize("given", [None, np.ones((6, 3))])
def test_fitted_values_of_a_table_have_their_own_derivatives(given):
    """Not those of the values from which the fit starts, unless they were given."""
    times = np.linspace(0.0, 5.0, 6)
    start = ph.Table(times, np.zeros((6, 3)), derivatives=given)
    scene = ph.Scene(BODY, torque=ph.BodyTorque(start))
    motion = LeafMotion(scene, places_of(scene, lambda s: s.torque.n.values))
    values = np.sin(times)[:, None] * np.array([1.0, 2.0, 3.0])
    fitted = motion.with_values([jnp.asarray(values)]).torque.n
    expected = ph.Table(times, values, derivatives=given)
    np.testing.assert_allclose(fitted(1.7), expected(1.7), rtol=1e-14)
    assert fitted.has_kinks == expected.has_kinks


def test_values_between_bounds_and_numbers_that_may_be_anything():
    """The transformation and its inverse for two bounds, one and none; derivatives do not vanish
    far beyond a bound.
    """
    scene = ph.Scene(BODY, torque=ph.LinearDamping([0.1, 0.2, 0.3]))
    low, high = jnp.array([0.0, 0.0, -jnp.inf]), jnp.array([0.15, jnp.inf, 0.4])
    motion = LeafMotion(scene, places_of(scene, lambda s: s.torque.c), bounds=((low, high),))
    for values in ([0.1, 0.2, 0.3], [0.149, 1e-6, -5.0], [1e-9, 50.0, 0.399999]):
        numbers = motion.unbounded([jnp.array(values)])
        np.testing.assert_allclose(motion.bounded(numbers)[0], values, rtol=1e-6)
    far = jnp.array([-30.0, -30.0, 30.0])
    value, slope = jax.jvp(lambda x: motion.bounded([x])[0], (far,), (jnp.ones(3),))
    assert np.all((value > low) & (value < high))
    assert np.all(np.isfinite(slope) & (slope != 0))
    np.testing.assert_allclose(jnp.abs(slope[1:]), 1, rtol=1e-4)
    assert bool(motion.at_bound([jnp.array([0.1, 1e-6, 0.3])]))
    assert not bool(motion.at_bound([jnp.array([0.1, 0.01, 0.3])]))
    free = LeafMotion(scene, places_of(scene, lambda s: s.torque.c), bounds=(None,))
    np.testing.assert_array_equal(free.bounded([far])[0], far)


@pytest.mark.parametrize(
    ("more", "error", "message"),
    [
        ({"bounds": [(0.2, None)]}, ValueError, "must lie between their bounds"),
        ({"bounds": (0.0, None)}, ValueError, "one entry for each of the 1 arrays"),
        ({"bounds": [0.0]}, TypeError, r"bounds\[0\] must be a pair"),
        ({"prior_std": [-1.0]}, ValueError, r"prior_std\[0\] must be positive"),
        ({"prior_std": 0.1}, ValueError, "prior_std must be a list with one entry"),
    ],
)
def test_wrong_bounds_and_priors_are_refused(more, error, message):
    scene = ph.Scene(BODY, torque=ph.LinearDamping(0.1))
    data = Recording.of(jnp.arange(5.0), jnp.ones((5, 3)) * 0.1)
    with pytest.raises(error, match=message):
        ph.fit_scene(scene, data, lambda s: s.torque.c, **more)
