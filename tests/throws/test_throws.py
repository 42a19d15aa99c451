"""``benchmarks.throws``: throws in air with a wheel and an imperfect gyroscope."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from benchmarks import throws_synthetic as study
from benchmarks.throws import (
    Instrument,
    Tolerance,
    __main__ as recipe,
    estimator,
    fit_balance,
    fit_each,
    lever_arm,
)
from benchmarks.throws.numerics import whiteness_of
from polhode.fit import Recording, averaged, stack

SPIN = 1.7e-6
TENSORS = 1e-6 * np.array(
    [
        [[400.0, 15.0, -10.0], [15.0, 180.0, 8.0], [-10.0, 8.0, 500.0]],
        [[200.0, -5.0, 6.0], [-5.0, 260.0, 12.0], [6.0, 12.0, 320.0]],
    ]
)
AXIS = np.array([0.012, -0.008, 1.0]) / np.linalg.norm([0.012, -0.008, 1.0])
SKEW = np.array([[0.004, 0.002, -0.003], [0.002, -0.001, -0.006], [-0.003, -0.006, -0.003]])
DELAY, STEP, ARM = 6e-4, 1e-3, np.array([0.01, -0.004, 0.03])


def speed(t):
    """Speed of the wheel: 200 rad/s, 1300 from 0.1 s on, and down again from 0.3 s on."""
    first = 1 - np.exp(-np.maximum(t - 0.1, 0) / 0.03)
    last = 1 - np.exp(-np.maximum(t - 0.3, 0) / 0.03)
    return -200 - 1100 * first + 1100 * last


def throw(rng, tensor, drag=True):
    """Times, and readings of gyroscope, wheel and accelerometer, in half a second of flight."""
    times = np.arange(0, 0.48, STEP)
    inverse = np.linalg.inv(tensor)

    def rates_of(momentum, t):
        return inverse @ (momentum - SPIN * speed(t - DELAY) * AXIS)

    def field(t, momentum):
        w = rates_of(momentum, t)
        torque = -1.5e-6 * (np.linalg.norm(w) + 4) * w if drag else 0
        return np.cross(momentum, w) + torque

    begin = rng.normal(size=3)
    begin *= 18 / np.linalg.norm(begin)
    start = tensor @ begin + SPIN * speed(-DELAY) * AXIS
    # up to, between and after the corners of the wheel's speed
    cuts = [0, 0.1 + DELAY, 0.3 + DELAY, 0.5]
    path, slope = np.zeros((len(times), 3)), np.zeros((len(times), 3))
    for a, b in itertools.pairwise(cuts):
        inside = (times >= a) & (times < b)
        found = solve_ivp(
            field, [a, b], start, "DOP853", [*times[inside], b], rtol=1e-9, atol=1e-12
        ).y.T
        path[inside], start = found[:-1], found[-1]
    omega = np.array([rates_of(m, t) for m, t in zip(path, times, strict=True)])
    for k, t in enumerate(times):
        push = 1e-5
        wheel = SPIN * (speed(t + push - DELAY) - speed(t - push - DELAY)) / (2 * push) * AXIS
        slope[k] = inverse @ (field(t, path[k]) - wheel)
    felt = np.cross(slope, ARM) + np.cross(omega, np.cross(omega, ARM))
    reading = np.linalg.solve(np.eye(3) + SKEW, omega.T).T + 0.01 * rng.normal(size=omega.shape)
    force = felt + 0.1 * rng.normal(size=omega.shape)
    wheel = speed(times) + 3 * rng.normal(size=len(times))
    # after switching, readings of the motor are invalid
    bad = ((times > 0.09) & (times < 0.14)) | ((times > 0.29) & (times < 0.31))
    return times, reading, np.where(bad, np.nan, wheel), force


@pytest.fixture(scope="module")
def throws():
    rng = np.random.default_rng(8)
    return [throw(rng, tensor) for tensor in TENSORS for _ in range(4)]


BODIES = [0] * 4 + [1] * 4


@pytest.mark.slow
def test_throws_in_air_show_the_tensor_and_the_instrument(throws):
    given = [Recording.of(t, w, wheel_speed=h) for t, w, h, _ in throws]
    fit = fit_balance(given, Instrument(SPIN), bodies=BODIES, tolerance=Tolerance(bias=0), block=4)
    true = np.linalg.eigvalsh(TENSORS)
    off = (np.asarray(fit.moments) - true) / np.asarray(fit.moments_std)
    assert np.abs(off).max() < 4
    assert np.max(np.asarray(fit.moments_std) / true) < 0.02
    np.testing.assert_allclose(fit.instrument.delay[0], DELAY, atol=2e-4)
    np.testing.assert_allclose(fit.instrument.axis[0], AXIS, atol=3e-3)
    assert fit.instrument.skew is not None
    found = np.asarray(fit.instrument.skew[0])
    np.testing.assert_allclose(found[[1, 2, 0], [2, 0, 1]], SKEW[[1, 2, 0], [2, 0, 1]], atol=2.5e-3)
    # four samples to a residual: half the noise of one
    np.testing.assert_allclose(fit.noise_levels.omega, 0.005, rtol=0.15)
    # innovations: of the expected size, and uncorrelated
    rest = np.asarray(fit.residuals["omega"]).reshape(8, -1, 3)
    np.testing.assert_allclose(np.mean(rest[rest != 0] ** 2), 1, atol=0.1)
    assert abs(np.mean(rest[:, 1:] * rest[:, :-1])) < 0.05
    # a single throw, with the jointly fitted instrument
    alone = fit_each(fit, given[4:], body=1)
    assert alone.moments.shape == (4, 3)
    assert alone.is_usable
    off = (np.asarray(alone.moments) - true[1]) / np.asarray(alone.moments_std)
    assert np.abs(off).max() < 4
    # assuming an ideal instrument causes errors larger than those of the noise
    ideal = jax.tree.map(jnp.zeros_like, fit.instrument)
    ideal = eqx.tree_at(
        lambda device: (device.spin_inertia, device.axis),
        ideal,
        (fit.instrument.spin_inertia, jnp.asarray([[0.0, 0.0, 1.0]] * 2)),
    )
    plain = fit_each(eqx.tree_at(lambda found: found.instrument, fit, ideal), given[4:], body=1)
    worse = np.abs(np.asarray(plain.moments) - true[1]).mean()
    assert worse > 1.5 * np.abs(np.asarray(alone.moments) - true[1]).mean()


@pytest.mark.slow
def test_throws_without_a_wheel_show_ratios():
    times = np.arange(0, 1, 0.01)
    tensor = TENSORS[0] / np.linalg.eigvalsh(TENSORS[0])[2]
    rng = np.random.default_rng(2)
    given = []

    def field(_, w):
        drag = (0.05 + 0.005 * np.linalg.norm(w)) * w
        return np.linalg.solve(tensor, np.cross(tensor @ w, w) - drag)

    for _ in range(3):
        begin = rng.normal(size=3)
        begin *= 10 / np.linalg.norm(begin)
        omega = solve_ivp(field, times[[0, -1]], begin, "DOP853", times, rtol=1e-9, atol=1e-9).y.T
        given.append(Recording.of(times, omega + 0.01 * rng.normal(size=(100, 3))))
    fit = fit_balance(given, Instrument(None))
    true = np.linalg.eigvalsh(tensor)
    assert float(fit.moments[0, 2]) == pytest.approx(1, abs=1e-12)
    off = (np.asarray(fit.ratios[0]) - true)[:2] / np.asarray(fit.ratios_std[0])[:2]
    assert np.abs(off).max() < 4
    assert np.max(fit.ratios_std) < 2e-3
    assert not fit.scale_known
    assert np.all(np.isinf(fit.moments_std))
    np.testing.assert_allclose(fit.noise_levels.omega, 0.01, rtol=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("size", [1.0, 30.0])
def test_single_throws_are_unbiased_and_their_errors_are_the_bound(size):
    """Of light bodies, and of heavy ones that the wheel hardly moves: 120 throws, each fitted
    alone.
    """
    number = 120
    found = study.study(size, number, together=30)
    chance = 2.5 / number**0.5
    assert found["converged"] == number
    assert np.abs(found["mean_error_over_std"]).max() < 0.3 + chance
    assert np.abs(np.array(found["rms_error_over_bound"]) - 1.025).max() < 0.075 + chance / 2**0.5
    assert 93 - 5 < found["covered_percent_all"] < 97 + 2.5
    # the information about a heavy body is a hundred times smaller
    low, high = (0.05, 0.6) if size == 1 else (1.0, 3.0)
    assert low < np.max(found["std_percent"]) < high


def test_the_accelerometer_tells_its_distance_from_the_centre_of_mass(throws):
    given = stack([Recording.of(t, w, force_body=a) for t, w, _, a in throws])
    # the gyroscope has errors of about 0.5 %
    np.testing.assert_allclose(lever_arm(averaged(given, 4)), np.tile(ARM, (8, 1)), atol=1e-3)


def test_what_a_balance_cannot_use_is_refused():
    times = np.linspace(0, 1, 20)
    rates = np.sin(np.outer(times, [3.0, 4, 5]))
    bare = Recording.of(times, rates)
    with pytest.raises(ValueError, match="needs wheel_speed in every recording"):
        fit_balance([bare], Instrument(SPIN))
    with pytest.raises(ValueError, match="need the wheel's spin_inertia"):
        fit_balance([Recording.of(times, rates, wheel_speed=times)], Instrument(None))
    whole = Recording.of(times, rates, wheel_speed=times)
    with pytest.raises(ValueError, match=r"number the body of each of 2 recordings.*\[0, 2\]"):
        fit_balance([whole] * 2, Instrument(SPIN), bodies=[0, 2])
    with pytest.raises(ValueError, match="spin_inertia must be positive, got 0"):
        Instrument(0.0)
    few = Recording.of(times, rates, wheel_speed=np.where(times < 0.25, 1.0, np.nan))
    with pytest.raises(ValueError, match="at least 8 samples with rates and wheel, got 5"):
        fit_balance([few], Instrument(SPIN))


@pytest.mark.skipif(not recipe.DATA.exists(), reason="needs ../shared/data/tudelft_throws")
@pytest.mark.slow
def test_throws_of_objects_whose_inertia_is_known():
    """Published regression on the same throws: 1.69 % and 2.8 degrees."""
    names = ("device_only", "proof_body", "config_empty", "config_a")
    found = recipe.run(recipe.DATA, names)["every_throw_alone"]
    counts = [len(row["moments"]) for row in found.values()]
    moments, axes = (
        np.average([row[kind] for row in found.values()], weights=counts)
        for kind in ("moments_error_percent", "axes_error_deg")
    )
    assert sum(counts) == 21
    assert moments <= 1.2
    assert axes <= 2.0


@pytest.mark.slow
def test_bodies_with_fewer_recordings_are_filled_up():
    places, used = estimator._by_body(np.array([1, 0, 1, 1]), 2)
    np.testing.assert_array_equal(places, [[1, 0, 0], [0, 2, 3]])
    np.testing.assert_array_equal(used, [[1, 0, 0], [1, 1, 1]])
    rest = jax.random.normal(jax.random.key(0), (3, 40, 3))
    present = jnp.ones((3, 40))
    alone = whiteness_of(rest[:1], present[:1])
    mask = jnp.asarray(used[0])
    filled = whiteness_of(rest * mask[:, None, None], present * mask[:, None])
    np.testing.assert_allclose(filled, alone, rtol=1e-12)
