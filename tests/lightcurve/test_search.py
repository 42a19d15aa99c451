"""Trial bodies: bred ones keep the periods asked, rounds get nearer, normal points."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from benchmarks import light_curves
from polhode import lightcurve
from polhode.lightcurve import _search, _solutions

PHASE = lightcurve.HG1G2()
MEANT = _search.Hypotheses(np.array([1.2, 1.9]), np.array([0.7, 0.5]), np.array([True, False]))


def test_bred_bodies_have_the_periods_of_their_parents():
    draws, mode = _search.draw(jax.random.key(0), MEANT, 32, 0.0)
    bred = _search.breed(jax.random.key(1), draws, 0.0, 0.3)
    for made in (draws, bred):
        bodies, good = _search.build(made, mode, PHASE)
        assert good.mean() > 0.5
        f_phi, f_psi, found = _solutions.frequencies(bodies)
        np.testing.assert_allclose(f_phi[good], np.repeat(MEANT.f_phi, 32)[good], rtol=1e-9)
        np.testing.assert_allclose(f_psi[good], np.repeat(MEANT.f_psi, 32)[good], rtol=1e-2)
        # never the other mode; inertias at their bounds have a symmetry, and a mode of their own
        other = np.where(mode, ph.Mode.SAM, ph.Mode.LAM)
        assert not np.any((found == other) & good)
    assert not np.allclose(bred.wxyz, draws.wxyz)


def test_draws_of_a_body_build_it_again_but_for_its_place_on_the_polhode():
    draws, mode = _search.draw(jax.random.key(0), MEANT, 1, 0.0)
    bodies, _ = _search.build(draws, mode, PHASE)
    again = _search.draws_of(jax.random.key(2), bodies, MEANT, 1)
    np.testing.assert_allclose(again.inertia, draws.inertia, atol=1e-9)
    second, _ = _search.build(again, mode, PHASE)
    np.testing.assert_allclose(second.wxyz, bodies.wxyz, atol=1e-12)
    np.testing.assert_allclose(
        _solutions.frequencies(second)[0], _solutions.frequencies(bodies)[0], rtol=1e-9
    )


def test_rounds_come_nearer_and_leave_the_wrong_periods():
    curve, truth, _ = light_curves.synthetic(9, 0.02, nights=10, days=12.0, each=12)
    points = curve.points(0.01)
    right = 1 / truth["P_phi"], 1 / truth["P_psi"]
    # the right one among eight that are off by one to eight steps of the resolution
    off = np.arange(9) * 1.5 / np.ptp(curve.t)
    meant = _search.Hypotheses(right[0] + off, right[1] + 0 * off, np.full(9, truth["mode"] == 0))
    trials = _search.tried(jax.random.key(0), meant, 4000, PHASE, points, 0.0)
    assert trials.source[np.argmin(trials.misfit)] == 0
    own = trials.misfit[trials.source == 0]
    assert own[len(own) // 2 :].min() < own[: len(own) // 4].min()


def test_misfit_is_that_of_the_light_times_the_gain():
    curve, _, body = light_curves.synthetic(3, 0.02, nights=8, days=12.0, each=16)
    points = curve.points(0.01)
    assert np.asarray(body.unknowns).shape == (1, 9)
    misfit, gain = _search.misfits(PHASE, body, points)
    # noise 0.02, robust, and as little as the offsets leave
    assert 0.01 < np.sqrt(misfit[0]) < 0.025
    assert gain[0] == pytest.approx(1.0, abs=0.05)
    flat = body._replace(unknowns=jnp.asarray(body.unknowns).at[:, 2:4].multiply(0.8))
    assert _search.misfits(PHASE, flat, points)[1][0] > 1.1


def test_normal_points_are_means_of_one_group():
    t = np.array([0.0, 0.001, 0.002, 0.5, 0.501, 1.0, 1.001, 1.002, 1.003])
    group = np.array(["a", "b", "a", "a", "a", "a", "a", "a", "a"])
    sun = np.tile([1.0, 0, 0], (9, 1))
    curve = lightcurve.LightCurve.of(t, np.arange(9.0), sun, sun, sigma=0.1, group=group)
    few = curve.binned(0.01)
    np.testing.assert_allclose(few.magnitude, [1.0, 1.0, 3.5, 6.5])
    np.testing.assert_allclose(few.t, [0.001, 0.001, 0.5005, 1.0015])
    np.testing.assert_allclose(few.sigma, 0.1 / np.sqrt([2, 1, 2, 4]))
    assert few.group.tolist() in ([0, 1, 0, 0], [1, 0, 0, 0])
    np.testing.assert_allclose(few.sun, sun[:4])
    with pytest.raises(ValueError, match="positive number of days"):
        curve.binned(0.0)
