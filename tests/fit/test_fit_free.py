"""Fits of free bodies: errors against the Cramer-Rao bound, scale, handedness, gaps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.identification import bodies, entries, tumble
from polhode.fit import (
    Finding,
    FitOptions,
    FreeMotion,
    Gyroscope,
    Recording,
    fit_inertia,
    stack,
)
from polhode.fit._options import median_step
from polhode.fit._start import regression
from polhode.inertia import inertia_of_second_moments, is_physical

BODIES, SAMPLES = 200, 80
SIGMA = np.where(np.arange(BODIES) % 2 == 0, 0.01, 0.05)


@pytest.fixture(scope="module")
def cases():
    rng, tensors, starts = bodies(11, BODIES, 0.2)
    times = 3.0 + np.sort(rng.uniform(0, 4, SAMPLES))
    clean = tumble(tensors, starts, times)
    noisy = clean + SIGMA[:, None, None] * rng.normal(size=clean.shape)
    ratios = np.linalg.eigvalsh(tensors)
    return times, clean, noisy, ratios / ratios[:, 2:], tensors


OPTIONS = FitOptions(gyroscope=Gyroscope.ideal())


def fitted(times, rates):
    """Fits in groups of eight recordings, concatenated: the program for all 200 would take three
    times as long to compile.
    """
    noise = SIGMA[:, None, None]
    parts = [
        fit_inertia(
            times, rates[k : k + 8], omega_noise=noise[k : k + 8], options=OPTIONS, throw=False
        )
        for k in range(0, BODIES, 8)
    ]
    return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)


@pytest.fixture(scope="module")
def fits(cases):
    return fitted(cases[0], cases[2])


@pytest.mark.slow  # faster: eight at once, above
def test_recordings_fitted_at_once_have_the_fits_of_parts(cases, fits):
    noise = SIGMA[:, None, None]
    found = fit_inertia(cases[0], cases[2], omega_noise=noise, options=OPTIONS, throw=False)
    np.testing.assert_array_equal(found.diagnostics, fits.diagnostics)
    off = np.abs(found.ratios - fits.ratios)[:, :2] / np.asarray(fits.ratios_std)[:, :2]
    assert np.nanmax(off) < 1e-2


def test_every_fit_is_a_physical_body(fits):
    assert not (np.asarray(fits.diagnostics) & int(Finding.NOT_FINITE)).any()
    assert bool(jnp.all(is_physical(fits.inertia.tensor, slack=1e-12)))


def test_every_fit_converges(fits):
    assert not (np.asarray(fits.diagnostics) & int(Finding.STEP_LIMIT)).any()
    assert np.asarray(fits.noise).max() < 1.25


def test_errors_are_as_large_as_the_bound_says(fits, cases):
    """Errors of all six entries together, in the metric of their information."""
    information = np.asarray(fits.information)
    inner = np.linalg.solve(information[:, 6:, 6:], information[:, 6:, :6])
    marginal = information[:, :6, :6] - information[:, :6, 6:] @ inner
    truth = cases[4] / np.linalg.eigvalsh(cases[4])[:, 2, None, None]
    error = entries(np.asarray(fits.inertia.tensor)) - entries(truth)
    square = np.einsum("ni,nij,nj->n", error, marginal, error)
    # linear theory is not valid for bodies that their motion hardly determines
    told = np.asarray(fits.diagnostics) & int(Finding.WEAK | Finding.NEARLY_FLAT) == 0
    assert told.mean() > 0.95
    # five directions are determined, the sixth is the scale
    assert 0.9 < np.sqrt(square[told].mean() / 5) < 1.1
    low, high = fits.interval(0.95)
    inside = (np.asarray(low) <= cases[3]) & (cases[3] <= np.asarray(high))
    assert 0.93 < inside[told, :2].mean() < 0.97
    assert abs(np.asarray(fits.noise).mean() - 1) < 0.02


def test_errors_of_moments_that_are_nearly_equal_are_larger_than_their_covariance_says(fits):
    """Against linear propagation of the covariance, of the body whose axes are known least."""
    told = np.asarray(fits.diagnostics) & int(Finding.WEAK | Finding.NEARLY_FLAT) == 0
    body = int(np.argmax(np.where(told, np.asarray(fits.axes_std).max(-1), 0)))

    def ratios(values):
        moments = jnp.linalg.eigvalsh(values[0])
        return moments[:2] / moments[2]

    found, linear = fits.derived(ratios, body)
    np.testing.assert_allclose(found, fits.ratios[body][:2], rtol=1e-9)
    assert np.all(fits.ratios_std[body][:2] >= 0.999 * linear)
    assert np.max(fits.ratios_std[body][:2] / linear) > 1.01


def test_a_level_is_a_probability(fits):
    low, high = (
        np.asarray(fits.interval(level)[1] - fits.ratios)[:, :2] for level in (0.5, np.float32(0.9))
    )
    np.testing.assert_allclose(high / low, 1.6448536269514722 / 0.6744897501960817, rtol=1e-6)
    for level in (0.0, 1.0, 95):
        with pytest.raises(ValueError, match=r"level must lie between 0 and 1"):
            fits.interval(level)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("scene", "a fit of an inertia has no scene"),
    ],
)
def test_what_a_fit_of_an_inertia_lacks_is_named(fits, name, message):
    with pytest.raises(AttributeError, match=message):
        getattr(fits, name)


def test_values_are_the_tensor_and_start_at_the_initial_rates(fits, cases):
    np.testing.assert_array_equal(fits.values[0], fits.inertia.tensor)
    assert len(fits.values) == len(fits.std) == 1
    assert np.all(np.isinf(fits.std[0]).any(axis=(1, 2)))  # the scale is not determined
    assert fits.sensor == fits.sensor_std == {}
    np.testing.assert_allclose(fits.initial.omega_body[:, 0], cases[1][:, 0], atol=0.3)
    assert fits.initial.wxyz.shape == (BODIES, 1, 4)


def test_the_scale_is_reported_as_unknown(fits):
    assert not fits.scale_known
    assert np.all(np.asarray(fits.null_count) >= 1)
    assert np.mean(np.asarray(fits.null_count) == 1) > 0.97
    np.testing.assert_allclose(fits.moments[:, 2], 1, rtol=1e-12)
    assert np.all(np.isinf(fits.moments_std))
    # the tensor itself is the null direction
    tensor, information = np.asarray(fits.inertia.tensor), np.asarray(fits.information)
    change = np.einsum("nij,nj->ni", information[:, :6, :6], entries(tensor))
    assert np.abs(change).max() < 1e-8 * np.abs(information[:, :6, :6]).max()
    assert "Only ratios" in fits.report()


def test_an_inverted_axis_means_the_mirrored_body(cases, fits):
    wrong = fitted(cases[0], cases[2] * np.array([1, 1, -1.0]))
    twins = np.sort(np.asarray(wrong.mirror_inertia.moments), axis=-1)
    spread = np.asarray(fits.ratios_std)[:, :2]
    far = np.abs(twins - np.asarray(fits.ratios))[:, :2]
    known = np.max(spread, axis=1) < 0.02
    assert known.mean() > 0.9
    assert np.max(far[known] / spread[known]) < 0.02
    assert np.abs(np.asarray(wrong.ratios) - np.asarray(fits.ratios)).max() > 0.1


def test_gaps_are_left_out(cases, fits):
    holed = cases[2].copy()
    holed[:, 10:20, 1] = np.nan
    other = fitted(cases[0], holed)
    far = (
        np.abs(np.asarray(other.ratios - fits.ratios))[:, :2] / np.asarray(other.ratios_std)[:, :2]
    )
    assert np.nanmedian(far) < 0.6
    assert np.nanmedian(np.asarray(other.ratios_std)[:, 0] / np.asarray(fits.ratios_std)[:, 0]) > 1


def test_regression_on_clean_data_finds_the_shape():
    times = np.linspace(0, 2, 400)
    tensor = np.array([[2, 0.1, 0.2], [0.1, 2.5, -0.3], [0.2, -0.3, 3.0]])
    rates = tumble(tensor[None], np.array([[2.0, 4.0, 3.0]]), times)
    start, other, misfit = jax.jit(regression)(rates, times[None], np.ones((1, 400)))
    for sigma in (start, other):
        found = np.asarray(inertia_of_second_moments(sigma))
        np.testing.assert_allclose(found / found[0, 0] * 2, tensor, atol=1e-3)
    assert float(misfit) < 1e-8


def test_prediction_is_the_exact_motion_and_differentiable(cases):
    times, clean, _, _, tensors = cases
    model = jax.jit(FreeMotion())
    path = model(tensors[3], clean[3, 0], None, times, None, None)
    np.testing.assert_allclose(path.omega, clean[3], atol=1e-8)


@pytest.mark.parametrize(
    ("times", "rates", "message"),
    [
        ([0, 1, 2], np.ones((3, 3)), "at least 4 samples"),
        ([0, 1, 1, 2], np.ones((4, 3)), "strictly increasing"),
        ([0, 2, 1, 3], np.ones((4, 3)), "strictly increasing"),
        ([0, 1, 2, 3], np.ones((5, 3)), "shape"),
        ([0, 1, 2, 3], None, "neither"),
        ([0, 1, 2, 3], np.full((4, 3), np.nan), "without NaN"),
        ([0, 1, 2, 3], np.full((4, 3), np.inf), "infinity"),
        ([0, 1, 2, 3], np.full((4, 3), 200.0), "deg/s"),
        (np.arange(20.0), np.eye(20)[:, [7, 0, 0]] * 50, "sample 7 would turn .* an outlier"),
    ],
)
def test_bad_recordings_are_refused(times, rates, message):
    with pytest.raises(ValueError, match=message):
        fit_inertia(times, rates)


def test_recordings_of_different_length_stack():
    one = Recording.of([0.0, 1, 2, 3], np.ones((4, 3)))
    two = Recording.of([0.0, 1, 2, 3, 4], np.ones((5, 3)))
    both = stack([one, two])
    assert both.times.shape == (2, 5)
    np.testing.assert_array_equal(both.present, [[1, 1, 1, 1, 0], [1, 1, 1, 1, 1]])


@pytest.mark.parametrize("epoch", [0.0, 1.7e9])
def test_gaps_that_fill_a_recording_up_end_within_an_interval(epoch):
    """A table of a torque, or the motion itself, may end with the recording."""
    short = Recording.of(epoch + np.arange(4.0), np.ones((4, 3)))
    long = Recording.of(np.arange(100.0), np.ones((100, 3)))
    times = np.asarray(stack([short, long]).times[0])
    np.testing.assert_array_equal(times[:4], epoch + np.arange(4.0))
    assert np.all(np.diff(times) > 0)
    assert times[-1] <= epoch + 4.0
    # a noise density refers to the interval between samples
    np.testing.assert_allclose(median_step(stack([short, long])), 1)


@pytest.mark.slow  # faster: gaps, test_gaps_are_left_out
def test_a_missing_row_in_five_does_not_hide_the_noise(cases):
    """And readings without any noise do not count as far from it."""
    times, clean, noisy, *_ = cases
    holed = np.stack([noisy[2], noisy[4], np.broadcast_to(clean[0, :1], clean[0].shape)])
    holed[:2, ::5] = np.nan
    for rates in holed:
        fit = fit_inertia(times, rates, throw=False)
        assert not int(fit.diagnostics) & int(Finding.POOR)
