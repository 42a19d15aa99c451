"""Fits beyond free flight: wheel and drag, biased and rotated sensors, outliers, float32."""

import importlib.util
import warnings
from itertools import pairwise
from pathlib import Path

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import polhode as ph
from polhode.fit import (
    Drag,
    Finding,
    FitOptions,
    FreeMotion,
    FullTensor,
    Gyroscope,
    Huber,
    Model,
    MomentsOnly,
    Parameters,
    Recording,
    SceneMotion,
    SteppedMotion,
    fit_inertia,
    fit_recordings,
    log_density,
    residuals,
    sensor_axes,
    stack,
    windows,
)
from polhode.fit._conclude import _axes_disagree
from polhode.fit._determination import determination_of
from polhode.fit._model import AbstractMotion, NoInertia, Predicted, base_of, free_columns
from polhode.fit._solve import _bias_of_rates, _sensor_start, solve_fit
from polhode.rotation import multiply, rotation_vector_to_wxyz, wxyz_to_matrix

TENSOR = np.array([[2.0, 0.1, 0.2], [0.1, 2.5, -0.3], [0.2, -0.3, 3.2]])


def flight(times, omega, *, wheel=None, drag=(0.0, 0.0)):
    """Attitudes (t, 4) and rates (t, 3) by DOP853; ``wheel``: momentum along z as function of t."""
    inverse = np.linalg.inv(TENSOR)

    def field(t, y):
        q, momentum = y[:4], y[4:]
        carried = np.array([0, 0, 0 if wheel is None else wheel(t)])
        w = inverse @ (momentum - carried)
        torque = -(drag[0] + drag[1] * np.linalg.norm(w)) * w
        turn = np.array(
            [
                -q[1:] @ w,
                *(q[0] * w + np.cross(q[1:], w)),
            ]
        )
        return np.concatenate([turn / 2, np.cross(momentum, w) + torque])

    start = np.concatenate(
        [[1, 0, 0, 0], TENSOR @ omega + [0, 0, 0 if wheel is None else wheel(times[0])]]
    )
    y = solve_ivp(field, times[[0, -1]], start, "DOP853", times, rtol=1e-10, atol=1e-10).y.T
    carried = np.zeros((len(times), 3))
    if wheel is not None:
        carried[:, 2] = wheel(times)
    return y[:, :4], (y[:, 4:] - carried) @ inverse.T


@pytest.mark.slow  # faster: derivatives of the residuals, below
def test_a_wheel_shows_the_scale_and_drag_and_delay_are_fitted():
    rng = np.random.default_rng(3)
    times = np.linspace(0, 2, 401)
    delay, spin_inertia = 0.004, 0.01

    def speed(t):
        return 400 * (1 - np.exp(-10 * np.maximum(t, 0)))

    _, omega = flight(
        times,
        np.array([5.0, 2.0, 3.0]),
        wheel=lambda t: spin_inertia * speed(t - delay),
        drag=(0.05, 0.02),
    )
    fit = fit_inertia(
        times,
        omega + 0.02 * rng.normal(size=omega.shape),
        wheel_speed=speed(times),
        omega_noise=0.02,
        options=FitOptions(
            motion=SteppedMotion(spin_inertia, drag=Drag(), fit_drag=True, fit_delay=True),
            gyroscope=Gyroscope.ideal(),
        ),
    )
    assert fit.scale_known
    assert int(fit.null_count) == 0
    moments = np.linalg.eigvalsh(TENSOR)
    off = (np.asarray(fit.moments) - moments) / np.asarray(fit.moments_std)
    assert np.abs(off).max() < 4
    assert np.max(np.asarray(fit.moments_std) / moments) < 0.01
    # after the tensor: two drag coefficients and the delay, by name
    spread = np.sqrt(np.diagonal(np.asarray(fit.covariance)))[6:9]
    found = fit.parameters.motion
    known = np.array([delay, 0.05, 0.02])
    got = np.array([found["delay"], found["drag"].linear, found["drag"].quadratic])
    np.testing.assert_array_equal(got, fit.values[1:])
    np.testing.assert_allclose(spread, fit.std[1:])
    np.testing.assert_array_equal(fit.values[0], fit.inertia.tensor)
    off = (np.asarray(fit.values[0]) - TENSOR) / np.asarray(fit.std[0])
    assert np.abs(off).max() < 4
    assert np.all(np.abs(got - known) < 4 * spread)
    assert spread[0] < 0.001
    assert 0.9 < float(fit.noise) < 1.1


@pytest.mark.slow  # faster: the tests of fit_scene
def test_any_scene_may_be_the_model():
    """A known torque determines the scale; the damping is fitted."""
    rng = np.random.default_rng(6)
    times = np.linspace(0, 3, 61)
    torque = np.array([1.0, -2.0, 1.5])

    def field(_, w):
        return np.linalg.solve(TENSOR, np.cross(TENSOR @ w, w) + torque - 0.4 * w)

    start = [2.0, -1.0, 3.0]
    path = solve_ivp(field, [0, 3], start, "DOP853", times, rtol=1e-10, atol=1e-10).y.T

    def build(inertia, unknown):
        push = ph.BodyTorque(jnp.asarray(torque)) + ph.LinearDamping(unknown["damping"])
        return ph.Scene(inertia, torque=push)

    fit = ph.fit_inertia(
        times,
        path + 0.01 * rng.normal(size=path.shape),
        omega_noise=0.01,
        options=FitOptions(
            motion=SceneMotion(build, {"damping": 0.1}, rtol=1e-6),
            initial_inertia=ph.Inertia.from_moments([2.0, 2.4, 3.0]),
            max_starts=1,
        ),
    )
    assert fit.scale_known
    moments = np.linalg.eigvalsh(TENSOR)
    off = (np.asarray(fit.moments) - moments) / np.asarray(fit.moments_std)
    assert np.abs(off).max() < 4
    spread = float(fit.covariance[6, 6]) ** 0.5
    assert abs(float(fit.parameters.motion["damping"]) - 0.4) < 4 * spread
    assert spread < 0.02


def test_a_scene_has_no_accelerometer():
    rates, motion = np.ones((5, 3)), SceneMotion(lambda i, u: ph.Scene(i), {"damping": 0.1})
    with pytest.raises(ValueError, match="FreeMotion or SteppedMotion, got SceneMotion"):
        fit_inertia(np.arange(5.0), rates, force_body=rates, options=FitOptions(motion=motion))


TIMES = np.linspace(0, 6, 121)
SENSOR = {"bias": np.array([0.3, -0.2, 0.1]), "turn": np.array([0.1, -0.15, 0.2])}


def sensed(times, *, flip=(1, 1, 1), outliers=0):
    """Readings of a biased and rotated gyroscope, attitudes, an accelerometer on a lever arm."""
    rng = np.random.default_rng(8)
    wxyz, omega = flight(times, np.array([2.56, 1.82, 1.91]))
    slope = np.linalg.solve(TENSOR, np.cross(omega @ TENSOR, omega).T).T
    lever = np.array([0.05, -0.02, 0.1])
    force = np.cross(slope, lever) + np.cross(omega, np.cross(omega, lever))
    rates = Rotation.from_rotvec(SENSOR["turn"]).inv().apply(omega) + SENSOR["bias"]
    rates = rates * np.array(flip) + 0.02 * rng.normal(size=omega.shape)
    rates[rng.choice(len(times), outliers, replace=False)] += 3.0
    small = 0.01 * rng.normal(size=(len(times), 3))
    xyzw = np.concatenate([wxyz[:, 1:], wxyz[:, :1]], axis=1)
    seen = (Rotation.from_quat(xyzw) * Rotation.from_rotvec(small)).as_quat()
    return {
        "times": times,
        "omega_body": rates,
        "wxyz": np.concatenate([seen[:, 3:], seen[:, :3]], axis=1),
        "force_body": force + 0.02 * rng.normal(size=force.shape),
        "omega_noise": 0.02,
        "attitude_noise": 0.01,
        "force_noise": 0.02,
    }, lever


@pytest.mark.slow
def test_bias_mounting_lever_and_outliers():
    data, lever = sensed(TIMES, outliers=4)
    options = FitOptions(bias=True, mounting=True, robust=Huber(3.0))
    fit = fit_inertia(**data, options=options, throw=False)
    spread = np.sqrt(np.diagonal(np.asarray(fit.covariance)))
    for name, known, place in (
        ("bias", SENSOR["bias"], 6),
        ("mounting", SENSOR["turn"], 9),
        ("lever", lever, 12),
    ):
        std = np.asarray(fit.sensor_std[name])
        np.testing.assert_allclose(std, spread[place : place + 3])
        assert np.all(np.abs(np.asarray(fit.sensor[name]) - known) < 4 * std)
    true = np.linalg.eigvalsh(TENSOR)
    off = (np.asarray(fit.ratios) - true / true[2])[:2] / np.asarray(fit.ratios_std)[:2]
    assert np.abs(off).max() < 4
    assert not int(fit.diagnostics) & int(Finding.STEP_LIMIT | Finding.AXES_DISAGREE)


def biased_prolate_bodies(seeds):
    """Times, rates with biases (b, 3), attitudes, biases and smallest ratios (b,)."""
    draws = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        ratio, spin = rng.uniform(0.2, 0.5), rng.normal(size=3)
        spin *= 3 / np.linalg.norm(spin)
        spin = spin if seed % 2 else np.array([0.1 * spin[0], 0.1 * spin[1], 3.0])
        draws.append((ratio, spin, *rng.normal(size=(2, 81, 3)), 6 * rng.normal(size=3)))
    ratio, spin, of_rates, of_turns, bias = map(np.array, zip(*draws))
    inertia = ph.Inertia.from_moments(
        np.stack([ratio, np.ones_like(ratio), np.ones_like(ratio)], -1)
    )
    state = ph.State(np.tile([1.0, 0, 0, 0], (len(ratio), 1)), spin)
    motion = ph.simulate(ph.Scene(inertia), state, np.linspace(0, 8, 81))
    rates = motion.omega_body + bias[:, None] + 0.02 * of_rates
    wxyz = multiply(motion.wxyz, rotation_vector_to_wxyz(0.01 * of_turns))
    return motion.ts, rates, wxyz, bias, ratio


def test_the_bias_to_start_from_is_that_beside_the_attitudes():
    wxyz, omega = flight(TIMES, np.array([2.56, 1.82, 1.91]))
    gain, bias = np.diag([2.0, 1.0, 1.0]), np.array([5.0, -8.0, 3.0])
    recording = stack([Recording.of(TIMES, omega + bias, wxyz=wxyz)])
    for mounting, expected in ((False, bias), (True, np.zeros(3))):
        options = FitOptions(bias=True, mounting=mounting)
        start = _bias_of_rates(recording, options, Gyroscope(gain))
        np.testing.assert_allclose(start, expected, atol=0.01)
    start = _sensor_start(recording, Gyroscope(gain), jnp.asarray(bias), jnp.float64)["bias"]
    np.testing.assert_allclose(start, gain @ bias)


@pytest.mark.slow
def test_a_bias_of_twice_the_rates_and_flat_bodies_are_no_traps():
    """The fit starts from the bias that the attitudes imply, and does not end with a flat body that
    explains the readings worse than another body (the last case).
    """
    times, rates, wxyz, bias, ratio = biased_prolate_bodies([1, 3, 5, 7, 13, 26])
    data = {"omega_noise": 0.02, "attitude_noise": 0.01, "options": FitOptions(bias=True)}
    fit = fit_inertia(times, rates, wxyz=wxyz, **data)
    assert np.asarray(fit.noise).max() < 1.06
    assert np.abs((fit.sensor["bias"] - bias) / fit.sensor_std["bias"]).max() < 3
    assert np.abs((fit.ratios[:, 0] - ratio) / fit.ratios_std[:, 0]).max() < 3
    assert np.all(np.asarray(fit.steps)[:5] < 20)


@pytest.mark.parametrize("mounting", [True, False])
@pytest.mark.parametrize(("flip", "wrong"), [((1, 1, 1), False), ((1, -1, 1), True)])
def test_an_inverted_axis_contradicts_the_attitudes(mounting, flip, wrong):
    data, _ = sensed(TIMES, flip=flip)
    recording = stack([Recording.of(data["times"], data["omega_body"], wxyz=data["wxyz"])])
    options = FitOptions(FreeMotion(), FullTensor(), mounting=mounting)
    assert bool(_axes_disagree(recording, options)) == wrong
    assert (np.linalg.det(np.asarray(sensor_axes(recording))[0]) < 0) == wrong


def test_windows_are_of_one_length_and_share_their_ends():
    times = np.linspace(0, 12, 241, dtype=np.float32)
    whole = Recording.of(times, np.ones((241, 3), np.float32), omega_noise=np.float32(0.02))
    parts = windows(whole, 61)
    assert [part.times.shape for part in parts] == [(61,)] * 4
    assert parts[0].times.dtype == jnp.float64
    for before, after in pairwise(parts):
        assert float(after.times[0]) == float(before.times[-1])


def test_a_fit_in_single_precision_names_what_it_needs():
    with jax.enable_x64(False):
        recording = Recording.of(np.arange(5.0), np.ones((5, 3)))
        for fit in (
            lambda: fit_inertia(np.arange(5.0), np.ones((5, 3))),
            lambda: fit_recordings([recording]),
            lambda: ph.fit_scene(ph.Scene(ph.Inertia([1, 2, 3])), recording, lambda s: s.inertia),
        ):
            with pytest.raises(RuntimeError, match="fits need float64"):
                fit()


@pytest.mark.slow
def test_windows_of_a_long_recording_stored_in_single_precision():
    rng = np.random.default_rng(4)
    times = np.linspace(0, 12, 241, dtype=np.float32)
    moments = np.linalg.eigvalsh(TENSOR)
    turn = np.linalg.eigh(TENSOR)[1]
    turn = turn * np.sign(np.linalg.det(turn))
    _, omega = flight(times.astype(float), turn @ np.array([0.5, 4.0, 1.0]))
    rates = (omega @ turn + 0.02 * rng.normal(size=omega.shape)).astype(np.float32)
    whole = Recording.of(times, rates, omega_noise=np.float32(0.02))
    parts = windows(whole, 61)
    assert len(parts) == 4
    assert float(parts[1].times[0]) == float(parts[0].times[-1])
    fit = fit_recordings(parts, options=FitOptions(unknown=MomentsOnly(), trust_noise=True))
    assert fit.parameters.omega.shape == (4, 3)
    off = (np.asarray(fit.ratios) - moments / moments[2])[:2] / np.asarray(fit.ratios_std)[:2]
    assert np.abs(off).max() < 4
    assert np.asarray(fit.ratios_std).max() < 0.01
    angle = np.abs(np.asarray(wxyz_to_matrix(fit.axes)))
    np.testing.assert_allclose(angle, np.eye(3), atol=1e-6)
    assert 0.9 < float(fit.noise) < 1.1


def reference():
    """The multiple-precision series of tests/free."""
    path = Path(__file__).parents[1] / "free" / "reference_free.py"
    found = importlib.util.spec_from_file_location("reference_free", path)
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module


def test_gradient_of_the_residuals_against_30_digits():
    taylor = reference()
    sigma = np.diag([1.1, 0.7, 0.4])
    base = base_of(jnp.asarray(sigma), True)
    fixed = tuple(map(tuple, free_columns(FullTensor(), True).tolist()))
    model = Model(FreeMotion(), base, None, None, fixed, True)
    times = np.array([0.0, 0.4, 1.1, 2.5])
    recording = stack([Recording.of(times, np.ones((4, 3)), omega_noise=0.1)])
    omega = np.array([0.8, 2.0, -1.1])

    def flat(shape, omega):
        found = residuals(Parameters(shape, omega[None]), recording, model)["omega"].ravel()
        return found, found

    slopes = jax.jit(jax.jacfwd(flat, argnums=(0, 1), has_aux=True))
    slopes, value = slopes(jnp.zeros(6), jnp.asarray(omega))
    found = np.concatenate([np.asarray(s) for s in slopes], axis=1)
    density = jax.jit(log_density(recording, model))
    density = density(Parameters(jnp.zeros(6), jnp.asarray(omega)[None]))
    assert float(density) == pytest.approx(-np.sum(np.asarray(value) ** 2) / 2)
    soft = mp.mpf(float(base.soft))
    unit = float(base.soft) / 5e-3

    def truth(y):
        """The same residuals, computed entirely by mpmath."""
        with mp.workdps(30), warnings.catch_warnings():
            # newer versions of mpmath warn of another order of coefficients
            warnings.simplefilter("ignore", DeprecationWarning)
            e = [mp.mpf(float(b)) + mp.mpf(unit) * x for b, x in zip(base.entries, y[:6])]
            a, b, c, p, q, r = e
            s = mp.matrix([[a, r, q], [r, b, p], [q, p, c]])
            values, vectors = mp.eigsy(s)
            bent = [(v + mp.sqrt(v * v + soft * soft)) / 2 for v in values]
            second = vectors * mp.diag(bent) * vectors.T
            total = second[0, 0] + second[1, 1] + second[2, 2]
            inertia = mp.eye(3) * total - second
            diagonal = [inertia[k, k] for k in range(3)]
            off = [inertia[0, 1], inertia[0, 2], inertia[1, 2]]
            rows = []
            for t in times:
                found = taylor.free_reference(diagonal, [1, 0, 0, 0], y[6:], mp.mpf(t), off)
                rows += [(1 - w) / mp.mpf(0.1) for w in found[1]]
            return rows

    h = mp.mpf(10) ** -12
    at = [mp.mpf(0)] * 6 + [mp.mpf(x) for x in omega]
    for k in (0, 4, 7):
        ends = []
        with mp.workdps(30):
            for sign in (1, -1):
                moved = list(at)
                moved[k] += sign * h
                ends.append(truth(moved))
            column = np.array([float((a - b) / (2 * h)) for a, b in zip(*ends)])
        error = np.abs(found[:, k] - column).max() / np.abs(column).max()
        assert error < 1e-10, (k, error)


@pytest.mark.parametrize("threshold", [0.0, -1.0])
def test_a_loss_needs_a_positive_threshold(threshold):
    with pytest.raises(ValueError, match="positive"):
        Huber(threshold)


@pytest.mark.slow  # faster: the inverse alone, test_the_loss_of_large_residuals_has_an_inverse
def test_residuals_of_outliers_are_reported_as_measured():
    times = np.linspace(0, 8, 161)
    state = ph.State([1.0, 0, 0, 0], [0.3, 1.0, 0.6])
    rates = ph.simulate(ph.Scene(ph.Inertia.from_moments([1.0, 1.5, 2.2])), state, times).omega_body
    rates = np.array(rates) + np.random.default_rng(0).normal(0, 0.01, rates.shape)
    rates[40, 1] += 0.5
    options = FitOptions(robust=Huber(3.0))
    fit = fit_inertia(times, rates, omega_noise=0.01, options=options)
    assert float(np.abs(fit.residuals["omega"]).max()) == pytest.approx(50, abs=4)
    assert float(fit.rms) == pytest.approx(np.sqrt(0.01**2 + 0.5**2 / 483), rel=0.1)


class ConstantRates(AbstractMotion):
    """Constant rates, for tests of what does not depend on the motion."""

    def start(self):
        return None

    def fixes_scale(self):
        return True

    def __call__(self, tensor, omega, wxyz, times, wheel, unknown, acceleration=True):
        return Predicted(jnp.broadcast_to(omega, (*times.shape, 3)), None, None)


@pytest.mark.parametrize("trusted", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_intervals_beside_gross_outliers(trusted):
    """The mean of rates with 5 % outliers about x, 20 % about y, none about z: 1,000 draws."""
    rng = np.random.default_rng(0)
    errors = rng.normal(size=(1000, 1, 40, 3))
    is_outlier = rng.random(errors.shape) < [0.05, 0.2, 0.0]
    errors += 30 * is_outlier * rng.choice([-1, 1], errors.shape)
    recording = Recording.of(np.arange(40.0), 0.01 * errors, omega_noise=0.01 if trusted else 0.012)
    options = FitOptions(
        motion=ConstantRates(),
        unknown=NoInertia(),
        robust=Huber(3.0),
        gyroscope=Gyroscope.ideal(),
        trust_noise=trusted,
        max_starts=1,
    )

    def fit(recording):
        solution = solve_fit(recording, options)
        found = determination_of(solution, recording, trusted)
        return solution.parameters.omega[0], jnp.diagonal(found.covariance), found.noise

    mean, variance, noise = jax.jit(jax.vmap(fit))(recording)
    rms = np.sqrt(np.mean(np.asarray(mean) ** 2 / np.asarray(variance), axis=0))
    np.testing.assert_allclose(rms, 1, atol=0.1)
    np.testing.assert_allclose(np.mean(noise), 1 if trusted else 0.01 / 0.012, rtol=0.05)


def test_the_loss_of_large_residuals_has_an_inverse():
    size = jnp.array([-50.0, -3.0, -1.0, 0.0, 2.9, 3.1, 1e4])
    np.testing.assert_allclose(Huber(3.0).inverse(Huber(3.0)(size)), size, rtol=1e-12)
