"""The sensor model of gyroscopes: its simulated noise, and fits of readings with its errors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode.fit import (
    Finding,
    FitOptions,
    FreeMotion,
    Gyroscope,
    Huber,
    Model,
    Parameters,
    Recording,
    fit_inertia,
    fit_recordings,
)
from polhode.fit._model import Predicted, base_of
from polhode.fit._options import calibrate
from polhode.fit._residuals import residuals_of_motion

TIMES = np.arange(400) / 100
KEY = jax.random.key(3)


def allan_variance(readings, counts):
    """Allan variances of averages over ``counts`` samples, for all starting samples (IEEE Std
    952-1997, annex C: half the mean square of differences of successive averages).
    """
    found = []
    for count in counts:
        size = len(readings) // count
        means = readings[: size * count].reshape(size, count).mean(axis=1)
        found.append(np.mean(np.diff(means) ** 2) / 2)
    return np.array(found)


def test_simulated_noise_has_the_allan_variance_of_its_densities():
    """White noise ``N^2 / tau`` at short times, a random walk ``K^2 tau / 3`` at long ones."""
    step, density, walk = 0.01, 0.003, 0.02
    times = step * np.arange(60_000)
    still = jnp.zeros((60_000, 3))
    counts = np.array([1, 4, 16, 64, 256])
    tau = step * counts
    for sensor, expected in (
        (Gyroscope(noise_density=density), density**2 / tau),
        (Gyroscope(bias_walk=walk), walk**2 * tau / 3),
        (Gyroscope(noise_density=density, bias_walk=walk), density**2 / tau + walk**2 * tau / 3),
    ):
        readings = np.asarray(sensor.read(KEY, times, still))
        found = np.mean([allan_variance(readings[:, k], counts) for k in range(3)], axis=0)
        # within an average of few samples a random walk is discrete: 1 + 1 / (2 count^2)
        share = walk**2 * tau / 3 * (sensor.bias_walk > 0)
        expected = expected + share / (2 * counts**2)
        # averages of 256 samples: 3 * 234 of them, a standard error of about 6 %
        np.testing.assert_allclose(found, expected, rtol=0.25)
        np.testing.assert_allclose(found[:3], expected[:3], rtol=0.08)


def test_readings_are_those_of_the_fields():
    omega = np.stack([np.sin(3 * TIMES), np.cos(2 * TIMES), np.sin(TIMES)], axis=-1)
    gain = np.array([[1.02, 0.01, 0.0], [0.0, 0.97, 0.03], [-0.02, 0.0, 1.0]])
    read = Gyroscope(gain, [0.1, 0.0, -0.2], max_rate=0.9).read(KEY, TIMES, omega)
    expected = np.clip(omega @ gain.T + [0.1, 0, -0.2], -0.9, 0.9)
    np.testing.assert_allclose(read, expected, atol=1e-12)
    late = Gyroscope(delay=0.013).read(KEY, TIMES, np.stack([omega, omega]))
    exact = np.stack([np.sin(3 * (TIMES - 0.013)), np.cos(2 * (TIMES - 0.013))], axis=-1)
    np.testing.assert_allclose(late[1, 3:-3, :2], exact[3:-3], atol=1e-5)
    jittered = np.asarray(Gyroscope(jitter=0.002).read(KEY, TIMES, omega)) - omega
    slope = np.gradient(omega, TIMES, axis=0)
    assert np.std(jittered / 0.002) == pytest.approx(np.sqrt(np.mean(slope**2)), rel=0.1)
    # all axes of a sample have one time stamp
    shift = jittered[:, :2] / slope[:, :2]
    clear = np.abs(slope[:, :2]).min(axis=1) > 0.5
    np.testing.assert_allclose(shift[clear, 0], shift[clear, 1], atol=2e-4)


def test_a_delayed_gyroscope_fits_its_own_motion():
    """Residuals vanish to third order in the delay, as in ``Gyroscope.read``."""
    delay = 0.013

    def rates(t):
        return np.stack([np.sin(3 * t), np.cos(2 * t), np.sin(t)], axis=-1)

    data = ph.fit.stack([Recording.of(TIMES, rates(TIMES - delay))])
    model = Model(FreeMotion(), base_of(jnp.eye(3), True), gyroscope=Gyroscope(delay=delay))
    parameters = Parameters(jnp.zeros(6), jnp.zeros((1, 3)))
    motion = Predicted(jnp.asarray(rates(TIMES))[None], None, None)
    residuals = residuals_of_motion(motion, parameters, data, model)["omega"]
    np.testing.assert_allclose(residuals[0, 3:-3], 0, atol=3e-5)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"noise_density": -1.0}, "noise_density of Gyroscope must be one finite number"),
        ({"scale_std": np.nan}, "scale_std of Gyroscope must be one finite number"),
        ({"max_rate": 0.0}, "max_rate of Gyroscope must be positive"),
        ({"delay": np.inf}, "delay of Gyroscope must be a finite number"),
        ({"gain": np.eye(2)}, "gain must have shape"),
    ],
)
def test_wrong_fields_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        Gyroscope(**given)


@pytest.mark.parametrize(
    ("sensor", "more", "message"),
    [
        (Gyroscope(delay_std=1e-3), {}, "the delay of a gyroscope shows only beside attitudes"),
        (Gyroscope(jitter=1e-3), {}, "jitter of the gyroscope adds to a known noise"),
        (Gyroscope(noise_density=0.1), {"omega_noise": 0.1}, "state the same noise"),
    ],
)
def test_what_a_fit_cannot_use_is_refused(sensor, more, message):
    rates = np.sin(np.outer(TIMES, [3.0, 4, 5]))
    with pytest.raises(ValueError, match=message):
        fit_inertia(TIMES, rates, options=FitOptions(gyroscope=sensor), **more)


def test_options_that_contradict_each_other_are_refused():
    rates = np.sin(np.outer(TIMES, [3.0, 4, 5]))
    options = FitOptions(bias=True, gyroscope=Gyroscope(bias_std=0.1))
    with pytest.raises(ValueError, match="bias_std of the gyroscope is its prior"):
        fit_inertia(TIMES, rates, options=options)
    with pytest.raises(ValueError, match="robust counts residuals"):
        fit_recordings([Recording.of(TIMES, rates)], options=FitOptions(robust=Huber(3.0)))


@pytest.mark.parametrize(
    ("gain", "rates_std", "sides"),
    [
        (2 * np.eye(3), [0.05, 0.1, 0.15], [0, 0, 1]),
        (np.eye(3)[[1, 0, 2]] * [1, -1, 1], [0.2, 0.1, 0.3], [0, 0, 1]),
        (np.diag([1.0, 1.0, -1.0]), [0.1, 0.2, 0.3], [0, 0, -1]),
    ],
)
def test_noise_and_limits_of_readings_become_those_of_rates(gain, rates_std, sides):
    readings = np.tile([0.1, -0.2, 3.0], (8, 1))
    recording = Recording.of(TIMES[:8], readings, omega_noise=[0.1, 0.2, 0.3])
    rates = calibrate(recording, Gyroscope(gain, max_rate=3.0))
    np.testing.assert_allclose(rates.omega @ gain.T, readings, atol=1e-12)
    np.testing.assert_allclose(rates.omega_noise[0], rates_std)
    np.testing.assert_array_equal(rates.saturated[0], sides)
    assert rates.present.all()


def test_a_saturated_reading_that_is_of_several_rates_is_a_gap():
    gain = np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.3], [0.2, 0.0, 1.0]])
    readings = np.tile([0.1, -0.2, 2.0], (8, 1))
    readings[3, 2] = 3.0
    rates = calibrate(Recording.of(TIMES[:8], readings), Gyroscope(gain, max_rate=3.0))
    np.testing.assert_array_equal(rates.present, np.arange(8) != 3)
    assert not rates.saturated.any()


def bodies(count, seed=5):
    """Tensors (n, 3, 3), ascending ratios of their moments, and their rates (n, 400, 3)."""
    rng = np.random.default_rng(seed)
    sigma = rng.uniform(0.2, 1, (count, 3))
    axes = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    second = np.einsum("nij,nj,nkj->nik", axes, sigma, axes)
    tensors = np.trace(second, axis1=1, axis2=2)[:, None, None] * np.eye(3) - second
    start = rng.normal(size=(count, 3))
    start *= (rng.uniform(4, 12, count) / np.linalg.norm(start, axis=1))[:, None]
    scene = ph.Scene(ph.Inertia(full=jnp.asarray(tensors)))
    state = ph.State(np.tile([1.0, 0, 0, 0], (count, 1)), start)
    moments = np.linalg.eigvalsh(tensors)
    path = ph.simulate(scene, state, TIMES)
    return moments / moments[:, 2:], np.asarray(path.omega_body), np.asarray(path.wxyz)


def deviations(fit, ratios):
    """Errors of the two smaller ratios over their standard deviations."""
    return (np.asarray(fit.ratios) - ratios)[:, :2] / np.asarray(fit.ratios_std)[:, :2]


def with_errors(omega, std, seed=0):
    """Readings of gyroscopes with random scale-factor errors and misalignments."""
    errors = std * np.random.default_rng(seed).normal(size=(omega.shape[0], 3, 3))
    return np.einsum("nij,ntj->nti", np.eye(3) + errors, omega)


@pytest.mark.slow
def test_intervals_hold_with_errors_of_scale_and_misalignment():
    """One per cent of each, 60 bodies; treated as exact, their intervals miss the truth."""
    ratios, omega, _ = bodies(60)
    data = Gyroscope(noise_density=0.002).read(KEY, TIMES, with_errors(omega, 0.01))[:, ::4]
    times = TIMES[::4]
    fit = fit_inertia(times, data, omega_noise=0.02, throw=False)
    inside = np.abs(deviations(fit, ratios)) < 1.96
    print(f"95 % intervals hold in {100 * inside.mean():.1f} % of 120 ratios")
    assert 0.92 <= inside.mean() <= 1
    assert 0.8 < np.sqrt(np.mean(deviations(fit, ratios) ** 2)) < 1.15
    assert np.mean(np.asarray(fit.diagnostics) == 0) > 0.95
    assert np.asarray(fit.noise).mean() == pytest.approx(1, abs=0.01)
    exact = FitOptions(gyroscope=Gyroscope.ideal())
    fit = fit_inertia(times, data, omega_noise=0.02, options=exact, throw=False)
    narrow = np.abs(deviations(fit, ratios)) < 1.96
    print(f"with scale factors and axes taken as exact: {100 * narrow.mean():.1f} %")
    assert narrow.mean() < 0.3


@pytest.mark.slow
def test_errors_of_scale_and_misalignment_do_not_leave_residuals():
    """Few bodies; ``noise`` is not stated, so the residuals' noise weights the prior."""
    ratios, omega, _ = bodies(4)
    data = Gyroscope(noise_density=0.002).read(KEY, TIMES, with_errors(omega, 0.01))
    fit = fit_inertia(TIMES[::4], data[:, ::4])
    assert np.all(np.abs(deviations(fit, ratios)) < 4)
    np.testing.assert_allclose(fit.noise, 0.02, rtol=0.15)
    assert fit.sensor["gain"].shape == fit.sensor_std["gain"].shape == (4, 3, 3)
    prior = np.full((3, 3), 0.01)
    assert np.all(np.asarray(fit.sensor_std["gain"]) < 1.0001 * prior)
    assert not np.any(np.asarray(fit.diagnostics) & int(Finding.CALIBRATION | Finding.POOR))
    far = fit_inertia(TIMES[::4], with_errors(omega, 0.1)[:, ::4], throw=False)
    assert np.any(np.asarray(far.diagnostics) & int(Finding.CALIBRATION))


@pytest.mark.slow
def test_two_of_three_scale_factors_of_a_free_body_leave_no_residuals():
    """Free rates stretched along principal axes are those of another free body, to rounding."""
    moments = np.array([1.0, 1.6, 2.2])
    scene = ph.Scene(ph.Inertia.from_moments(moments))
    rates = np.asarray(
        ph.simulate(scene, ph.State([1.0, 0, 0, 0], [2.0, 3.0, -1.5]), TIMES).omega_body
    )
    # coefficients of Euler's equations for s_i omega_i
    coefficient = np.array(
        [(moments[(k + 1) % 3] - moments[(k + 2) % 3]) / moments[k] for k in range(3)]
    )

    def constraint(last):
        s = np.array([1.004, 0.998, last])
        a = coefficient * s / (np.roll(s, -1) * np.roll(s, 1))
        return a.sum() + a.prod(), s  # zero if the coefficients are those of a body

    low, high = 0.9, 1.1
    for _ in range(60):
        middle = (low + high) / 2
        if (constraint(middle)[0] > 0) == (constraint(high)[0] > 0):
            high = middle
        else:
            low = middle
    scale = constraint(low)[1]
    fit = fit_inertia(TIMES[::4], scale * rates[::4])
    assert float(fit.rms) < 1e-9
    assert np.abs(np.asarray(fit.ratios) - moments / moments[2])[:2].max() > 1e-4
    off = (np.asarray(fit.ratios) - moments / moments[2])[:2] / np.asarray(fit.ratios_std)[:2]
    assert np.abs(off).max() < 3


@pytest.mark.slow
def test_readings_at_a_limit_count_as_bounds():
    """Six bodies with 0 to 100 % of the readings of an axis at its limit."""
    ratios, omega, _ = bodies(6)
    noisy = np.asarray(Gyroscope(noise_density=0.002).read(KEY, TIMES, omega))
    clipped = np.clip(noisy, -4.0, 4.0)
    assert np.mean(np.abs(clipped) == 4.0) > 0.3
    sensor = Gyroscope(max_rate=4.0, scale_std=0, misalignment_std=0)
    fit = fit_inertia(
        TIMES, clipped, omega_noise=0.02, options=FitOptions(gyroscope=sensor), throw=False
    )
    codes = np.asarray(fit.diagnostics)
    assert np.all(codes & int(Finding.SATURATED) > 0)
    # failures are reported
    sound = codes & int(Finding.POOR | Finding.UNDETERMINED | Finding.STEP_LIMIT) == 0
    assert sound.sum() >= 4
    assert np.all(np.abs(deviations(fit, ratios))[sound] < 4)
    assert np.all(np.asarray(fit.ratios_std)[sound] < 0.01)


@pytest.mark.slow
def test_a_saturated_reading_is_a_bound_beside_errors_of_scale():
    """The limit is detected; a residual at it is zero while the model exceeds the limit."""
    ratios, omega, _ = bodies(1)
    noisy = with_errors(omega, 0.01)[:, ::4]
    noisy = noisy + 0.02 * np.random.default_rng(2).normal(size=noisy.shape)
    limit = 0.8 * np.abs(noisy).max()
    clipped = np.clip(noisy, -limit, limit)
    side = np.where(np.abs(clipped) == limit, np.sign(clipped), 0)
    assert np.mean(side != 0) > 0.05
    fit = fit_inertia(TIMES[::4], clipped, omega_noise=0.02)
    assert "saturated" in fit.findings()
    assert np.all(np.abs(deviations(fit, ratios)) < 4)
    rest = np.asarray(fit.residuals["omega"])[:, 0]
    assert np.all(rest * side >= 0)
    assert np.mean(rest[side != 0] == 0) > 0.5
    assert np.std(rest[side == 0]) == pytest.approx(1, abs=0.2)


@pytest.mark.slow
def test_a_walk_of_the_bias_and_jitter_are_in_the_intervals():
    ratios, omega, _ = bodies(40)
    exact = {"scale_std": 0.0, "misalignment_std": 0.0}
    for part in ({"bias_walk": 0.02}, {"jitter": 0.002}):
        sensor = Gyroscope(noise_density=0.002, **part, **exact)
        data = sensor.read(KEY, TIMES, omega)
        fit = fit_inertia(TIMES, data, options=FitOptions(gyroscope=sensor), throw=False)
        inside = np.mean(np.abs(deviations(fit, ratios)) < 1.96)
        print(f"{part}: 95 % intervals hold in {100 * inside:.1f} %")
        assert inside > 0.9
        assert np.asarray(fit.noise).mean() == pytest.approx(1, abs=0.03)


@pytest.mark.slow
def test_a_delay_of_the_gyroscope_shows_beside_attitudes():
    _, omega, wxyz = bodies(1)
    sensor = Gyroscope(noise_density=0.002, delay=0.006)
    data = sensor.read(KEY, TIMES, omega[0])
    options = FitOptions(gyroscope=Gyroscope(delay_std=0.02, scale_std=0, misalignment_std=0))
    fit = fit_inertia(
        TIMES, data, wxyz=wxyz[0], omega_noise=0.02, attitude_noise=1e-3, options=options
    )
    off = (float(fit.sensor["delay"]) - 0.006) / float(fit.sensor_std["delay"])
    assert abs(off) < 4
    assert float(fit.sensor_std["delay"]) < 5e-4
    assert not int(fit.diagnostics) & int(Finding.POOR)


@pytest.mark.slow
def test_deviations_are_those_of_readings():
    """``sensor`` has bias and gain in terms of readings, and so have ``sensor_std`` and
    ``bias_std``.
    """
    _, omega, _ = bodies(1)
    std = {}
    for size in (1.0, 2.0):
        gain = np.diag([1.0, size, 1.0])
        data = (
            np.asarray(omega[0]) @ gain
            + np.random.default_rng(0).normal(0, 0.002, (TIMES.size, 3)) @ gain
        )
        recording = Recording.of(TIMES, data, omega_noise=0.02 * np.diag(gain))
        options = FitOptions(gyroscope=Gyroscope(gain), bias=True, trust_noise=True)
        fit = fit_recordings([recording], options=options)
        std[size] = fit.sensor_std
    # half of the readings' size
    prior = 0.5 * float(std[2.0]["bias"][1])
    options = FitOptions(gyroscope=Gyroscope(gain, bias_std=prior), trust_noise=True)
    known = fit_recordings([recording], options=options)
    assert 0.8 * prior < float(known.sensor_std["bias"][1]) < prior
    np.testing.assert_allclose(
        std[2.0]["bias"], std[1.0]["bias"] * np.array([1.0, 2, 1]), rtol=1e-3
    )
    np.testing.assert_allclose(
        std[2.0]["gain"], std[1.0]["gain"] * np.array([[1.0], [2], [1]]), rtol=1e-3
    )


@pytest.mark.slow  # faster: a fit with the usual sensor model, test_fit_exports
def test_calibrated_readings_are_corrected():
    """With calibrated ``gain`` and ``bias`` the fit is that of true rates; ``sensor`` has both."""
    _, omega, _ = bodies(1)
    gain = np.array([[1.05, 0.02, 0.0], [0.0, 0.93, 0.04], [-0.03, 0.0, 1.0]])
    sensor = Gyroscope(gain, [0.3, -0.2, 0.1], noise_density=0.002)
    data = sensor.read(KEY, TIMES, omega[0])
    options = FitOptions(gyroscope=sensor, bias=True)
    fit = fit_recordings([Recording.of(TIMES, data)], options=options)
    back = np.linalg.inv(gain)
    rates = (np.asarray(data) - [0.3, -0.2, 0.1]) @ back.T
    noise = 0.002 / 0.01**0.5 * np.linalg.norm(back, axis=1)  # of samples 0.01 s apart
    recording = Recording.of(TIMES, rates, omega_noise=noise)
    plain = fit_recordings([recording], options=FitOptions(bias=True, trust_noise=True))
    np.testing.assert_allclose(fit.ratios, plain.ratios, atol=5e-5)
    assert np.abs(np.asarray(fit.sensor["gain"]) - gain).max() < 0.03
    off = np.asarray(fit.sensor["bias"]) - [0.3, -0.2, 0.1]
    assert np.abs(off / np.asarray(fit.sensor_std["bias"])).max() < 4
    assert float(fit.noise) == pytest.approx(1, abs=0.1)


@pytest.mark.slow  # faster: a fit with the usual sensor model, test_fit_exports
def test_the_table_names_what_shows_it():
    """Rates alone: no size, no rotation of the sensor, two scale factors only by calibration."""
    _, omega, _ = bodies(1)
    fit = fit_inertia(TIMES[::4], with_errors(omega, 0.01)[:, ::4], omega_noise=0.02)
    rows = {row.quantity: row for row in fit.observability()}
    assert rows["size of the inertia"].source == "nothing"
    assert "wheel" in rows["size of the inertia"].remedy
    assert rows["handedness of the axes"].source == "nothing"
    rotation = rows["rotation of the gyroscope (3)"]
    assert (rotation.shown, rotation.count, rotation.source) == (0, 3, "calibration")
    assert "attitudes" in rotation.remedy
    stretch = rows["scale factors and non-orthogonality of the gyroscope (6)"]
    assert (stretch.shown, stretch.source) == (4, "data and calibration")
    assert rows["ratios of the moments (2)"].source == "data and calibration"
    assert "what this recording can show" in fit.report()
    assert "rotation of the gyroscope (3): calibration" in fit.report()
