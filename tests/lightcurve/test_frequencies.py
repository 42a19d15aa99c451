"""Two-dimensional Fourier series against sums over the points, and their interpretations."""

import numpy as np
import pytest

from polhode import lightcurve
from polhode.lightcurve import _frequencies

F_PHI, F_PSI = 1.7, 0.6


@pytest.fixture(scope="module")
def series():
    """A series in combinations of F_PHI and 2 F_PSI, with gaps, an offset per night, and noise."""
    rng = np.random.default_rng(3)
    t = np.sort(np.concatenate([k + 0.4 * rng.uniform(size=40) for k in (0, 1, 2, 4, 7, 8)]))
    night = np.floor(t)
    value = sum(
        a * np.cos(2 * np.pi * (i * F_PHI + j * F_PSI) * t + p)
        for i, j, a, p in ((2, 0, 0.3, 1.0), (2, 2, 0.2, 2.0), (1, 2, 0.1, 0.5))
    )
    value = value + 0.01 * rng.normal(size=t.size) + 0.1 * night
    return t, value, (night[None] == np.unique(night)[:, None]).astype(float)


@pytest.mark.parametrize("even", [True, False])
def test_pairs_explain_what_least_squares_say(series, even):
    t, value, columns = series
    found = lightcurve.fourier_pairs(
        t, value, columns=columns, max_frequency=4.0, even=even, order=2 if even else 1, keep=200
    )
    basis = [columns.T]
    multiples = _frequencies.terms(2 if even else 1, even)
    for k in (0, 5):
        phases = 2 * np.pi * np.outer(t, multiples @ [found.f_phi[k], found.f_psi[k]])
        whole = np.hstack([*basis, np.cos(phases), np.sin(phases)])
        left = [value - m @ np.linalg.lstsq(m, value, rcond=None)[0] for m in (columns.T, whole)]
        explained = 1 - np.sum(left[1] ** 2) / np.sum(left[0] ** 2)
        # combinations near a multiple of one per day are nearly constant within nights
        assert found.explained[k] == pytest.approx(explained, abs=0.01)
    assert found.explained[0] > 0.9


def _long(waves):
    """Twenty nights in sixty days of a series in F_PHI and F_PSI."""
    rng = np.random.default_rng(5)
    start = np.sort(rng.choice(60, 20, replace=False))
    t = np.sort(start[:, None] + rng.uniform(0, 0.3, (20, 20)), axis=1).ravel()
    value = sum(a * np.cos(2 * np.pi * (i * F_PHI + j * F_PSI) * t + p) for i, j, a, p in waves)
    return t, value + 0.02 * rng.normal(size=t.size)


MIXED = ((2, 0, 0.3, 1.0), (2, 2, 0.2, 2.0), (1, 2, 0.1, 0.5))
ONE_LINE = (
    (1, 0, 0.3, 1.0),
    (2, 0, 0.3, 2.0),
    (3, 0, 0.1, 0.5),
    (4, 0, 0.05, 0.0),
    (2, 2, 0.05, 2),
)
SHORT_AXIS = ((1, 1, 0.2, 1.0), (2, 0, 0.15, 2.0), (2, 2, 0.05, 0.5))


@pytest.mark.parametrize(
    ("waves", "long_axis"),
    [
        (MIXED, True),
        pytest.param(ONE_LINE, True, marks=pytest.mark.slow),
        # a body in short-axis mode: test_default_range_holds_the_lines_of_a_fast_tumbler
        pytest.param(SHORT_AXIS, False, marks=pytest.mark.slow),
    ],
)
def test_hypotheses_hold_the_body(waves, long_axis):
    """Also if harmonics of one line dominate: multiples of one line are not used as two lines."""
    t, value = _long(waves)
    found = lightcurve.fourier_lattices(t, value, max_frequency=7.0)
    meant = _frequencies.hypotheses(found, t, value)
    near = np.hypot(meant.f_phi - F_PHI, meant.f_psi - F_PSI) < 0.5 * found.resolution
    assert np.any(near[:20] & (meant.long_axis[:20] == long_axis))
    # by the triangle inequality, precession is not slower than the rotation about the long axis
    assert np.all(meant.long_axis | (meant.f_psi <= meant.f_phi))
    assert len(near) <= 800


def test_light_that_does_not_vary_is_refused():
    t = np.linspace(0, 1, 30)
    with pytest.raises(ValueError, match="does not vary"):
        lightcurve.fourier_pairs(t, np.full(30, 12.3))


def test_meaning_names_mode_and_sums():
    text = lightcurve.meaning(2.0, 1.0)
    assert text.startswith("LAM or SAM")
    assert "SAM: f_phi + f_psi = 3" in text
    text = lightcurve.meaning(1.0, 2.0)
    assert text.startswith("LAM only")
    assert "f_phi = 1" in text
    assert "2 f_phi + 2 f_psi = 6" in text


def test_lattices_find_the_sums_of_a_long_curve():
    """The pair of the body is the first, with the variance of a least-squares fit."""
    t, value = _long(MIXED)
    found = lightcurve.fourier_lattices(t, value, max_frequency=7.0, keep=20)
    assert np.all(np.diff(found.explained) <= 0)
    assert found.explained[0] > 0.9
    sums = _frequencies.LINES @ [found.f_phi[0], found.f_psi[0]]
    for i, j, *_ in MIXED[:2]:
        assert np.abs(np.abs(sums) - (i * F_PHI + j * F_PSI)).min() < 0.5 * found.resolution
    phases = 2 * np.pi * np.outer(t, sums)
    whole = np.hstack([np.ones((t.size, 1)), np.cos(phases), np.sin(phases)])
    left = value - whole @ np.linalg.lstsq(whole, value, rcond=None)[0]
    assert found.explained[0] == pytest.approx(1 - left.var() / value.var(), abs=0.01)


def test_default_range_holds_the_lines_of_a_fast_tumbler():
    """Short-axis mode, 12.0 and 29.2 h, in 60 days: the strongest line is at 4.0 per day."""
    rng = np.random.default_rng(0)
    start = np.sort(rng.choice(60, 16, replace=False))
    t = np.sort(start[:, None] + rng.uniform(0, 0.3, (16, 25)), axis=1).ravel()
    f_phi, f_psi = 1 / 0.501, 1 / 1.218
    value = sum(
        a * np.cos(2 * np.pi * (i * f_phi + j * f_psi) * t + p)
        for i, j, a, p in ((1, 1, 0.15, 1.0), (2, 0, 0.2, 2.0), (2, 2, 0.05, 0.5))
    )
    value = value + 0.02 * rng.normal(size=t.size)
    found = lightcurve.fourier_lattices(t, value)
    assert found.max_frequency > 2 * f_phi + 2 * f_psi
    assert found.strongest == pytest.approx(2 * f_phi, abs=0.5 * found.resolution)
    assert not found.is_cut
    assert found.warnings() == ()
    meant = _frequencies.hypotheses(found, t, value)
    near = np.hypot(meant.f_phi - f_phi, meant.f_psi - f_psi) < 0.5 * found.resolution
    assert np.any(near[:5] & ~meant.long_axis[:5])


@pytest.mark.parametrize("period", [2 / 24, 3 / 1440])
def test_default_range_reaches_fast_rotations(period):
    """Two hours in ten nights of a month; three minutes in one night."""
    rng = np.random.default_rng(1)
    if period > 0.01:
        start = np.sort(rng.choice(30, 10, replace=False))
        t = np.sort(start[:, None] + rng.uniform(0, 0.3, (10, 40)), axis=1).ravel()
    else:
        t = np.sort(rng.uniform(0, 0.1, 300))
    value = 0.2 * np.cos(4 * np.pi * t / period) + 0.1 * np.cos(2 * np.pi * t / period)
    found = lightcurve.fourier_lattices(t, value + 0.01 * rng.normal(size=t.size))
    assert found.max_frequency > 2 / period
    assert not found.is_cut


def test_a_grid_that_ends_below_strong_lines_says_so():
    t, value = _long(MIXED)
    found = lightcurve.fourier_lattices(t, value, max_frequency=2.0)
    assert found.max_frequency == pytest.approx(2.0, abs=found.resolution)
    assert found.strongest == pytest.approx(2 * F_PHI, abs=0.5 * found.resolution)
    (text,) = found.warnings()
    assert "ends at 2" in text
    assert "max_frequency" in text


def test_a_default_grid_that_must_be_cut_says_so(monkeypatch):
    t, value = _long(MIXED)
    monkeypatch.setattr(_frequencies, "_MAX_LINE_NODES", 600)
    found = lightcurve.fourier_lattices(t, value)
    assert found.is_cut
    assert found.max_frequency < 2 * F_PHI
    assert "faster rotations were not tried" in found.warnings()[0]


def test_a_line_at_the_edge_of_the_grid_is_named():
    t, value = _long(MIXED)
    found = lightcurve.fourier_lattices(t, value, max_frequency=1.02 * 2 * F_PHI)
    assert any("at the edge" in text for text in found.warnings())
