"""Phases of trial bodies are chosen so that their series is closest to that of the points."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from polhode import lightcurve
from polhode._closed_forms import free_motion
from polhode.lightcurve import _brightness, _search, _solutions
from polhode.lightcurve._frequencies import Hypotheses

PHASE = lightcurve.SeeligerPhase()
MEANT = Hypotheses(np.array([1.2, 1.9]), np.array([0.7, 0.5]), np.array([True, False]))
MANY = 24
magnitudes = jax.jit(_brightness.magnitudes, static_argnums=0)


@jax.jit
def moved(bodies, later):
    """Rates and attitudes of free bodies at one time each."""
    found = free_motion(
        _brightness.moments_of(bodies.unknowns),
        tuple(bodies.wxyz.T),
        tuple(bodies.unknowns[:, 4:7].T),
        later,
    )
    return tuple(jnp.stack([x[:, 0] for x in part], -1) for part in found)


@pytest.fixture(scope="module")
def blank():
    """Constant directions, and two nights with different offsets."""
    t = np.sort(np.random.default_rng(0).uniform(0, 10, 256))
    sun, observer = np.array([1.0, 0, 0.1]), np.array([np.cos(0.4), np.sin(0.4), -0.1])
    return lightcurve.LightCurve.of(
        t, 0 * t, *(np.tile(v, (t.size, 1)) for v in (sun, observer)), sigma=0.02, group=t > 5
    )


@pytest.mark.parametrize("mode", [0, 1])
@pytest.mark.slow
def test_any_phases_are_turned_to_those_of_the_points(blank, mode):
    """A body that explains the points; copies of it with other phases on the polhode and about the
    momentum.
    """
    meant = Hypotheses(*(x[mode : mode + 1] for x in MEANT))
    draws, long_axis = _search.draw(jax.random.key(3), meant, MANY)
    bodies, good = _search.build(draws, long_axis, PHASE)
    (first,) = np.flatnonzero(good)[:1]
    points = blank.points(0.0)
    light = np.asarray(magnitudes(PHASE, bodies, points))[first, : blank.t.size]
    points = blank._replace(magnitude=light + 0.3 * (blank.t > 5)).points(0.0)
    right, matrix = _search.series(points, *meant)
    # the same body at other times and rotated about its momentum: other phases
    later = jnp.asarray(np.random.default_rng(1).uniform(0, 10, (MANY, 1)))
    same = jax.tree.map(lambda x: jnp.tile(x[first], (MANY, 1)), bodies)
    rates, wxyz = moved(same, later)
    pole = _solutions.momentum(same)
    angle = jnp.asarray(np.random.default_rng(2).uniform(0, 6, (MANY, 1)))
    wxyz = _search.rotation.multiply(_search.rotation.rotation_vector_to_wxyz(angle * pole), wxyz)
    away = _brightness.Bodies(same.unknowns.at[:, 4:7].set(rates), wxyz)
    found, fall = _search.align_phases(
        away,
        *(np.repeat(x, MANY) for x in meant),
        np.repeat(right, MANY, 0),
        np.repeat(matrix, MANY, 0),
        *_search.directions(points),
    )
    np.testing.assert_allclose(_solutions.momentum(found), pole, atol=1e-9)
    f_phi, f_psi, _ = _solutions.frequencies(found)
    np.testing.assert_allclose(f_phi, meant.f_phi[0], rtol=1e-9)
    np.testing.assert_allclose(f_psi, meant.f_psi[0], rtol=1e-2)
    before, after = (_search.misfits(PHASE, x, points)[0] for x in (away, found))
    whole = np.var(light)
    # 15 degrees at most from the nearest node in either angle
    assert np.median(before) > 0.3 * whole
    assert np.max(after) < 0.15 * whole
    # the fraction of chi-square that the series does not explain
    data = points.magnitude[0, : len(light)]
    fall = np.asarray(fall, float)
    assert np.min(fall) * 0.02**2 / len(light) > 0.7 * whole
    assert np.max(fall) * 0.02**2 / len(light) < np.var(data)


def test_a_series_explains_waves_and_no_offsets(blank):
    angle = 2 * np.pi * (1.2 + 2 * 0.7) * (blank.t - blank.t[0])
    data = 0.2 * np.cos(angle) - 0.1 * np.sin(angle) + 0.5 * (blank.t > 5)
    right, matrix = _search.series(blank._replace(magnitude=data).points(0.0), *MEANT)
    found = np.linalg.solve(matrix[0], right[0])
    expected = np.zeros(22)
    expected[[3, 14]] = 0.2, -0.1  # f_phi + 2 f_psi is the fourth of the sums of LAM
    np.testing.assert_allclose(found, expected, atol=1e-9)
