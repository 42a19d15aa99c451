"""Trial bodies have the requested periods, and the best of each hypothesis are retained; normal
points.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from benchmarks import light_curves
from polhode import lightcurve
from polhode.lightcurve import _brightness, _fit, _frequencies, _least_squares, _search, _solutions

PHASE = lightcurve.HG1G2()
Hypotheses = _frequencies.Hypotheses
MEANT = Hypotheses(np.array([1.2, 1.9]), np.array([0.7, 0.5]), np.array([True, False]))


def test_bodies_have_the_periods_of_their_hypothesis():
    bodies, good = _search.build(*_search.draw(jax.random.key(0), MEANT, 32), PHASE)
    mode = np.repeat(MEANT.long_axis, 32)
    assert good.mean() > 0.5
    f_phi, f_psi, found = _solutions.frequencies(bodies)
    np.testing.assert_allclose(f_phi[good], np.repeat(MEANT.f_phi, 32)[good], rtol=1e-9)
    np.testing.assert_allclose(f_psi[good], np.repeat(MEANT.f_psi, 32)[good], rtol=1e-2)
    # never the other mode; inertias at their bounds are symmetric, with a separate mode
    other = np.where(mode, ph.Mode.SAM, ph.Mode.LAM)
    assert not np.any((found == other) & good)


@pytest.mark.slow
def test_steps_from_the_best_of_each_hypothesis_tell_the_right_one():
    curve, truth, _ = light_curves.synthetic(9, 0.02, nights=10, days=12.0, each=12)
    points = curve.points(0.01)
    right = 1 / truth["P_phi"], 1 / truth["P_psi"]
    # the right pair among eight with offsets of one to eight steps of the resolution
    off = np.arange(9) * 1.5 / np.ptp(curve.t)
    meant = Hypotheses(right[0] + off, right[1] + 0 * off, np.full(9, truth["mode"] == 0))
    key = jax.random.key(0)
    trials = _search.best_trials(key, meant, 1800, 3, PHASE, points, points, 0.0)
    np.testing.assert_array_equal(trials.source, np.repeat(np.arange(9), 3))
    f_phi, *_ = _solutions.frequencies(trials.bodies)
    np.testing.assert_allclose(f_phi, meant.f_phi[trials.source], rtol=1e-9)
    # the best of 200 fit better than the others, and are sorted
    misfit, _ = _search.misfits(PHASE, trials.bodies, points)
    misfit = misfit.reshape(9, 3)
    assert np.all(np.diff(misfit, axis=1) >= 0)
    few, _ = _search.build(*_search.draw(jax.random.key(1), meant, 3), PHASE)
    assert misfit.mean() < 0.7 * _search.misfits(PHASE, few, points)[0].mean()
    problem = _least_squares.Problem(PHASE, points)
    state, reached = _fit._descend(key, meant, 1800, 3, problem, problem, 0.0)
    assert np.argmin(reached) == 0
    assert reached.min() == state.cost.min()
    assert np.isfinite(reached).all()
    f_phi, f_psi, _ = _solutions.frequencies(state.bodies)
    best = np.argmin(state.cost)
    np.testing.assert_allclose([f_phi[best], f_psi[best]], right, rtol=3e-3)


def test_the_likeliest_and_the_best_so_far_are_tried_again():
    count, half = 800, _fit._LEADING // 2
    many = Hypotheses(np.arange(count), np.ones(count), np.ones(count, bool))
    shared = _fit._second_round(many, np.arange(count)[::-1])  # the least likely reached the least
    times = np.bincount(shared.f_phi, minlength=count)
    assert times[0] == times[-1] == _fit._OFTEN
    assert np.all(times[half:-half] == 0)
    assert times[:half].min() > 0
    assert times[-half:].min() > 0
    assert np.all(np.diff(times[:half]) <= 0)
    assert np.all(np.diff(times[-half:]) >= 0)
    # half as often from a quarter of them on
    assert times[half // 4] == round(_fit._OFTEN / 2)
    one = _fit._second_round(Hypotheses(*(x[:1] for x in many)), np.array([np.inf]))
    assert len(one.f_phi) == _fit._OFTEN


def test_poles_of_one_pair_do_not_crowd_out_others():
    bodies, good = _search.build(*_search.draw(jax.random.key(0), MEANT, 32), PHASE)
    lam, sam = np.flatnonzero(good[:32])[0], 32 + np.flatnonzero(good[32:])[0]
    index = np.r_[np.full(20, lam), sam]
    wxyz = np.random.default_rng(0).normal(size=(21, 4))
    bodies = _brightness.Bodies(
        bodies.unknowns[index], wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True)
    )
    nothing = np.zeros(21)
    state = _least_squares.State(bodies, nothing, np.arange(21.0), nothing, nothing, nothing)
    kept = _fit._distinct_solutions(state, 0.01, 12)
    assert len(kept) == 1 + _fit._ALIKE
    assert kept[0] == 0
    assert kept[-1] == 20


def test_spread_of_offsets_is_the_likeliest():
    """Twelve groups of a linear model with three other unknowns, which are integrated out."""
    rng = np.random.default_rng(1)
    group = np.repeat(np.arange(12), 6)
    other = np.c_[rng.normal(size=(72, 2)), np.ones(72)]
    own = (group[:, None] == np.arange(12)).astype(float)
    whole, sigma = np.hstack([other, own]), 0.05
    data = other @ [1.0, -2.0, 3.0] + 0.08 * rng.normal(size=12)[group]
    data = data + sigma * rng.normal(size=72)
    stiffness = np.r_[0.0, np.full(12, 0.2**-2)]
    matrix = whole.T @ whole / sigma**2 + np.diag(np.r_[0, 0, stiffness])
    x = rng.normal(size=15)  # not the best
    right = matrix @ x - whole.T @ data / sigma**2
    spreads = np.linspace(0.01, 0.2, 400)

    def evidence(spread):
        covariance = sigma**2 * np.eye(72) + spread**2 * own @ own.T
        inverse = np.linalg.inv(covariance)
        reduced = other.T @ inverse @ other
        left = data - other @ np.linalg.solve(reduced, other.T @ inverse @ data)
        sizes = np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(reduced)[1]
        return -(left @ inverse @ left + sizes) / 2

    best = spreads[np.argmax([evidence(s) for s in spreads])]
    found = _least_squares.spread_of_offsets(matrix, right, x[2:], stiffness, slice(1, 13))
    assert found == pytest.approx(best, rel=0.01)


def test_misfit_is_that_of_the_light_times_the_gain():
    curve, _, body = light_curves.synthetic(3, 0.02, nights=8, days=12.0, each=16)
    points = curve.points(0.01)
    assert np.asarray(body.unknowns).shape == (1, 9)
    misfit, gain = _search.misfits(PHASE, body, points)
    # noise of 0.02, robust cost, minus the part that the offsets fit
    assert 0.01 < np.sqrt(misfit[0]) < 0.025
    assert gain[0] == pytest.approx(1.0, abs=0.05)
    flat = body._replace(unknowns=jnp.asarray(body.unknowns).at[:, 2:4].multiply(0.8))
    assert _search.misfits(PHASE, flat, points)[1][0] > 1.1


def test_likeness_is_the_variance_of_sums_over_that_of_independent_ones():
    """Nights of 20 points with a correlation of 0.7 between neighbours; the sums of 400 draws."""
    rng = np.random.default_rng(2)
    night = np.repeat(np.arange(20), 20)
    t = night + 0.01 * np.tile(np.arange(20), 20)
    sun = np.tile([1.0, 0, 0], (400, 1))
    curve = lightcurve.LightCurve.of(t, 0 * t, sun, sun, group=night)
    alone = rng.normal(size=(400, 400))
    alike = alone.copy()
    for k in np.flatnonzero(np.diff(night, prepend=-1) == 0):
        alike[:, k] = 0.7 * alike[:, k - 1] + np.sqrt(1 - 0.7**2) * alone[:, k]
    measured = np.var(alike.sum(1)) / 400
    found = [_solutions.effective_correlation(curve, row) for row in alike[:20]]
    assert np.mean(found) == pytest.approx(measured, rel=0.15)
    assert np.mean([_solutions.effective_correlation(curve, row) for row in alone[:20]]) < 1.05


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
    unknown = curve._replace(sigma=np.where(np.arange(9) == 8, 0.0, 0.1)).binned(0.01)
    np.testing.assert_allclose(unknown.sigma, few.sigma * [1, 1, 1, 0])
    with pytest.raises(ValueError, match="positive number of days"):
        curve.binned(0.0)
