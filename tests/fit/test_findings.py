"""Saturated sensors and outliers are reported; clean and coarsely digitised recordings are not."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode.fit import Finding, FitOptions, Recording, fit_inertia, stack
from polhode.fit._conclude import (
    _axes_disagree,
    _with_repulsion,
    has_outliers,
    is_weak,
    whiteness_of,
)
from polhode.fit._options import saturation
from polhode.fit._recording import rotation_vector_between, turns_between_samples
from polhode.rotation import multiply, rotation_vector_to_wxyz

T = np.linspace(0, 20, 500)
RATES = np.stack([3 * np.sin(T), 2 * np.cos(1.3 * T), 1 + 0.5 * np.sin(2 * T)], -1)


def noisy(seed=0):
    return RATES + 0.02 * np.random.default_rng(seed).normal(size=RATES.shape)


def is_saturated(omega):
    return bool(jnp.any(saturation(Recording.of(T, omega)) != 0))


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("part", [0.5, 0.75, 0.95])
def test_clipped_rates_are_named(side, part):
    omega = side * noisy()
    limit = part * 3.0
    assert is_saturated(np.minimum(omega, limit))


def test_clipped_and_digitised_rates_are_named():
    omega = np.round(np.clip(noisy(), -2.2, 2.2) / 0.005) * 0.005
    assert is_saturated(omega)


@pytest.mark.parametrize("step", [0.001, 0.01, 0.03])
def test_digitised_rates_are_not_saturated(step):
    assert not is_saturated(noisy())
    assert not is_saturated(np.round(noisy() / step) * step)
    assert not is_saturated(np.round(RATES / step) * step)


def test_constant_rates_are_not_saturated():
    omega = RATES.copy()
    omega[:, 2] = 1.0
    assert not is_saturated(omega)
    omega[:, 2] = 0.0
    assert not is_saturated(omega)
    omega[:, 2] = 1 + 1e-15 * (np.arange(T.size) % 7 == 0)
    assert not is_saturated(omega)


def test_digitised_rates_that_hardly_vary_are_not_saturated():
    """Most of their readings have one value, and its neighbours are rare."""
    omega = np.stack([0.1 * np.sin(T), 0.1 * np.cos(T), np.full(T.size, 1.43)], -1)
    for place, other in ((slice(0, 44), 1.42), (slice(0, 1), 1.44)):
        omega[:, 2] = 1.43
        omega[place, 2] = other
        assert not is_saturated(omega)
        assert not is_saturated(-omega)


def test_a_lower_limit_is_not_positive():
    assert not is_saturated(np.maximum(noisy() + 4.0, 3.5))


def test_single_samples_far_off_are_outliers_and_runs_are_not():
    rng = np.random.default_rng(1)
    rest = rng.normal(size=(1, 500, 3))
    whole = stack([Recording.of(T, RATES)])
    assert not has_outliers(jnp.asarray(rest), whole, None)
    some = rest.copy()
    some[0, rng.choice(500, 8, replace=False), 1] += 15
    assert has_outliers(jnp.asarray(some), whole, None)
    # many short recordings, in some of which all but one of the residuals are small by chance
    short = stack([Recording.of(T[:6], RATES[:6])] * 80)
    draws = jnp.asarray(np.random.default_rng(2).normal(size=(50, 80, 6, 3)))
    assert not np.any(jax.vmap(lambda draw: has_outliers(draw, short, None))(draws))
    # with a robust fit
    assert not has_outliers(jnp.asarray(some), whole, object())
    # an incomplete model
    wrong = rest + 10 * (np.sin(T) > 0.9)[None, :, None]
    assert not has_outliers(jnp.asarray(wrong), whole, None)
    # missing samples
    gaps = dataclasses.replace(whole, present=jnp.asarray(np.abs(some[..., 1]) < 6, float))
    assert not has_outliers(jnp.asarray(some), gaps, None)
    # saturated readings, whose residuals are zero while the model exceeds the limit
    limits = np.zeros((1, 500, 3))
    limits[0, :400, 2] = 1
    at_limit = rest * (limits == 0)
    saturated = dataclasses.replace(whole, saturated=jnp.asarray(limits))
    assert not has_outliers(jnp.asarray(at_limit), saturated, None)


@pytest.mark.parametrize("gaps", [0.0, 0.5, 0.9])
def test_white_residuals_are_white_beside_gaps(gaps):
    """Their probabilities are uniform: of 300, 15 +- 4 are below 0.05."""
    rng = np.random.default_rng(0)
    present = (rng.uniform(size=(300, 1, 200)) >= gaps).astype(float)
    residuals = rng.normal(size=(300, 1, 200, 3)) * present[..., None]
    found = jax.vmap(whiteness_of)(jnp.asarray(residuals), jnp.asarray(present))
    assert 3 <= int(jnp.sum(found < 0.05)) <= 30
    assert 0.4 < float(jnp.median(found)) < 0.65
    # a recording of a few samples, fewer than the lags
    short = np.zeros((2, 200))
    short[0], short[1, :5] = 1, 1
    wave = np.sin(0.3 * np.arange(200))[None, :, None] * np.ones((2, 200, 3)) * short[..., None]
    assert float(whiteness_of(jnp.asarray(wave), jnp.asarray(short))) < 1e-6


@pytest.mark.parametrize("samples", [8, 12, 20])
def test_few_residuals_of_a_correct_fit_are_white(samples):
    """Residuals of 8 unknowns fitted to noise, of smooth functions of time; a wave is not white."""
    rng = np.random.default_rng(samples)
    time = np.arange(samples) / samples
    frequencies, phases = rng.uniform(size=(2, 8, 3)) * [[[samples / 6]], [[1]]]
    waves = np.cos(2 * np.pi * (frequencies[..., None] * time + phases[..., None]))
    basis, _ = np.linalg.qr(waves.swapaxes(1, 2).reshape(8, -1).T)
    noise = rng.normal(size=(20_000, 3 * samples))
    residuals = (noise - (noise @ basis) @ basis.T).reshape(-1, 1, samples, 3)
    part = 8 / (3 * samples)
    probability = jax.vmap(lambda x: whiteness_of(x, jnp.ones((1, samples)), part))
    found = probability(jnp.asarray(residuals))
    assert np.mean(np.asarray(found) < 1e-4) < 1e-3
    assert 0.4 < float(jnp.median(found)) < 0.9
    wave = residuals[:200] + 3 * np.sin(2 * np.pi * time)[:, None]
    assert samples < 20 or np.mean(np.asarray(probability(jnp.asarray(wave))) < 1e-4) > 0.9


def test_spin_about_one_axis_agrees_with_attitudes_and_against_it_does_not():
    """Noise alone determines the transverse axes; an inverted axis reverses the rotation. With a
    bias, a spin about one axis does not determine the axes.
    """
    spin = ph.State([1.0, 0, 0, 0], [0.0, 0, 2.0])
    motion = ph.simulate(ph.Scene(ph.Inertia.spherical(1.0)), spin, np.linspace(0, 6, 121))
    options = FitOptions(), FitOptions(bias=True)
    found = jax.jit(lambda recording: [_axes_disagree(recording, each) for each in options])
    for seed in range(12):
        rates, turns = np.random.default_rng(seed).normal(size=(2, 121, 3))
        rates = np.asarray(motion.omega_body) + 0.01 * rates
        wxyz = multiply(motion.wxyz, rotation_vector_to_wxyz(0.003 * turns))
        for sign, disagrees in ((1, False), (-1, True)):
            recording = stack([Recording.of(motion.ts, sign * rates, wxyz=wxyz)])
            assert [bool(x) for x in found(recording)] == [disagrees, False]


@pytest.mark.parametrize(
    ("ratio", "std", "weak"),
    [(0.4, 0.06, True), (0.4, 0.04, False), (0.016, 0.016, True), (0.016, 0.007, False)],
)
def test_ratios_that_hardly_show_are_weak(ratio, std, weak):
    """A rod that spins across its axis hardly determines the moment about it: 0.016 +- 0.016 of
    0.38.
    """
    assert bool(is_weak(jnp.array([ratio, 1.0, 1.0]), jnp.array([std, 0.0, 0.0]))) == weak


def test_sensor_axes_of_coarse_samples():
    """Rotations of two radians between samples are compared as angles, not as sines."""
    body = ph.Inertia.spherical(1.0)
    motion = ph.simulate(
        ph.Scene(body), ph.State([1.0, 0, 0, 0], [1.0, 2.0, 2.5]), 0.6 * np.arange(9)
    )
    turned = rotation_vector_between(motion.wxyz[0], motion.wxyz[1])
    assert np.linalg.norm(turned) < 0.9 * 0.6 * np.sqrt(11.25)
    recording = Recording.of(motion.ts, motion.omega_body, wxyz=motion.wxyz)
    turns = np.asarray(turns_between_samples(recording))
    np.testing.assert_allclose(turns, np.tile([0.6, 1.2, 1.5], (8, 1)), rtol=1e-9)


@pytest.mark.slow
def test_fits_name_clipped_records_and_outliers():
    inertia = ph.Inertia.from_moments([1.0, 1.6, 2.2])
    t = np.linspace(0, 4.0, 400)
    path = ph.simulate(ph.Scene(inertia), ph.State([1.0, 0, 0, 0], [3.0, 4.0, 2.0]), t)
    rng = np.random.default_rng(0)
    clean = np.asarray(path.omega_body) + 0.02 * rng.normal(size=(400, 3))
    wild = clean.copy()
    wild[rng.choice(400, 6, replace=False), 0] += 1.0
    clipped = np.clip(clean, -3.0, 3.0)
    for omega, expected in (
        (clean, Finding.NONE),
        (wild, Finding.OUTLIERS),
        (clipped, Finding.SATURATED),
    ):
        fit = fit_inertia(t, omega, omega_noise=0.02, throw=False)
        seen = int(fit.diagnostics) & int(Finding.OUTLIERS | Finding.SATURATED)
        assert seen == int(expected)
        assert ("saturated" in fit.findings()) == (expected is Finding.SATURATED)


def test_errors_of_moments_that_are_nearly_equal_hold_what_drives_them_apart():
    """Eigenvalues of tensors with noise in every entry, compared with the noise, which is 5 times
    the gap. To first order the products of inertia do not change the eigenvalues.
    """
    rng = np.random.default_rng(3)
    moments, noise = np.array([1.0, 1.002, 2.0]), 0.01
    errors = noise * rng.normal(size=(4000, 3, 3))
    errors = np.diag(moments) + np.tril(errors) + np.swapaxes(np.tril(errors, -1), 1, 2)
    found = np.linalg.eigvalsh(errors)
    z = []
    for values in found[::20]:
        first = [noise] * 3 + [*(noise * np.hypot(1, values / values[2])[:2]) / values[2], 0]
        std = _with_repulsion(jnp.asarray(values), jnp.asarray([*first, *[noise] * 3]))
        truth = np.concatenate([moments, moments / moments[2]])[:5]
        z.append((np.concatenate([values, values / values[2]])[:5] - truth) / std[:5])
    rms = np.sqrt(np.mean(np.square(z), axis=0))
    assert np.all((rms > 0.8) & (rms < 1.2)), rms
    alone = np.sqrt(np.mean((found[:, :2] - moments[:2]) ** 2, axis=0)) / noise
    assert np.all(alone[:2] > 1.3), alone  # without the addition the intervals would be too narrow
