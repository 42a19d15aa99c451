"""Null hypotheses and verdicts: noise, rotators, too few points, rival solutions, misfits."""

import numpy as np
import pytest

import polhode as ph
from benchmarks.light_curves import directions
from polhode import lightcurve
from polhode.lightcurve import _brightness, _convex, _nulls, _solutions, _verdict

Verdict = lightcurve.Verdict
PHASE = lightcurve.SeeligerPhase()
NOISE, P_PHI, P_PSI = 0.03, 0.42, 1.31


def curve_of(light, seed=0, nights=10, days=20, each=24, noise=NOISE, sigma=NOISE):
    """Nights of a quarter of a day with offsets; ``light(t)`` [mag]."""
    rng = np.random.default_rng(seed)
    start = np.sort(rng.choice(days, nights, replace=False))
    t = np.sort(start[:, None] + rng.uniform(0, 0.25, (nights, each)), axis=1).ravel()
    t, group = t - t[0], np.repeat(np.arange(nights), each)
    sun, observer = directions(t)
    sun, observer = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (sun, observer))
    value = light(t) + noise * rng.normal(size=t.size) + 0.02 * rng.normal(size=nights)[group]
    return lightcurve.LightCurve.of(
        t, value, sun, observer, sigma=sigma, group=group, calibrated=True
    )


def rotating(t, period=0.37):
    """Brightness with one period and four harmonics."""
    return sum(
        a * np.cos(2 * np.pi * k * t / period + k) for k, a in ((1, 0.05), (2, 0.2), (4, 0.04))
    )


def tumbling(t, f_phi=1 / P_PHI, f_psi=1 / P_PSI):
    return sum(
        a * np.cos(2 * np.pi * (i * f_phi + j * f_psi) * t + i)
        for i, j, a in ((1, 0, 0.2), (2, 0, 0.1), (2, 2, 0.15))
    )


def flat(t):
    return 0 * t


def solution(model, P_phi=P_PHI, P_psi=P_PSI, odds=1.0, **others):
    entries = dict.fromkeys(_solutions.Solution._fields)
    entries |= {
        "P_phi": P_phi,
        "P_psi": P_psi,
        "mode": ph.Mode.LAM,
        "probability": odds,
        "model": model,
        "parameters": 10.0,
        **others,
    }
    return _solutions.Solution(**entries)  # pyright: ignore[reportArgumentType]


def pairs_of(curve):
    return lightcurve.fourier_lattices(
        curve.t, curve.magnitude, columns=curve.columns(np.inf)[0], max_frequency=8.0
    )


@pytest.fixture(scope="module")
def cases():
    """Curves of each kind, their pairs of frequencies, and the fitted null hypotheses."""
    out = {}
    for name, light in (("noise", flat), ("rotator", rotating), ("tumbler", tumbling)):
        curve = curve_of(light, each=12)
        pairs = pairs_of(curve)
        out[name] = curve, pairs, *_verdict.null_models(curve, pairs, 0.02, PHASE)
    return out


def verdict(case, *solutions, reproduced=True):
    _, pairs, linear, nulls = case
    return _verdict.judge(linear, nulls, pairs, solutions, reproduced=reproduced, limit=3.0)


def offset_free(case, light):
    """A model of the case's curve: the brightness, and the best offsets."""
    curve, _, linear, _ = case
    rest = curve.magnitude - light(curve.t - curve.t[0])
    free = linear.columns.T
    return curve.magnitude - rest + free @ np.linalg.lstsq(free, rest, rcond=None)[0]


def test_noise_alone_is_no_signal(cases):
    case = cases["noise"]
    found = verdict(case, solution(offset_free(case, flat)))
    assert found.verdict is Verdict.NO_SIGNAL
    assert found.par == 0
    assert found.models[0].name == "noise only"
    assert found.models[0].misfit == pytest.approx(1.0, abs=0.15)
    assert "noise" in found.reasons[0]


def test_one_period_is_told_from_tumbling(cases):
    """Also if a tumbling body fits as well as the rotator: it has more parameters."""
    case = cases["rotator"]
    found = verdict(case, solution(offset_free(case, rotating)))
    assert found.verdict is Verdict.ONE_PERIOD
    assert found.par == 2
    single = found.models[1]
    assert single.name.startswith("one period")
    assert min(abs(single.periods[0] / p - 1) for p in (0.37, 0.185)) < 1e-3
    assert single.misfit == pytest.approx(1.0, abs=0.15)
    # a body that fits worse does not change this
    worse = verdict(case, solution(offset_free(case, flat)))
    assert worse.verdict is Verdict.ONE_PERIOD


def test_a_tumbler_that_is_explained_is_called_so(cases):
    case = cases["tumbler"]
    found = verdict(case, solution(offset_free(case, tumbling)))
    assert found.verdict is Verdict.TUMBLING
    assert found.par == -4
    assert found.reasons == ()
    assert found.agreement == 1.0
    body, single = found.models[-1], found.models[1]
    assert body.log_evidence > single.log_evidence + 50


def test_the_list_of_models_begins_with_the_null_hypotheses(cases):
    case = cases["tumbler"]
    found = verdict(case, solution(offset_free(case, tumbling)))
    words = [m.name.split(",")[0] for m in found.models]
    assert words == ["noise only", "one period", "two periods", "tumbling body"]


def test_table_prints_null_hypotheses_before_bodies_and_the_verdict_last(cases):
    curve, pairs, *_ = cases["tumbler"]
    body = solution(
        offset_free(cases["tumbler"], tumbling),
        P_phi_std=1e-4,
        P_psi_std=1e-3,
        rms=NOISE,
        moments=np.array([0.5, 0.8, 1.0]),
        pole=np.array([10.0, 20.0]),
        pole_std=3.0,
        parameters=8.3,
    )
    found = verdict(cases["tumbler"], body)
    fit = lightcurve.LightCurveFit(
        (body,),
        curve,
        pairs,
        None,
        1.0,
        1.0,
        None,
        ("a note",),
        found.verdict,
        found.reasons,
        found.par,
        found.models,
        found.misfit,
        found.agreement,
    )
    text = lightcurve.table(fit)
    places = [text.index(x) for x in ("noise only", "one period", "tumbling body", "P_phi short")]
    assert places == sorted(places)
    assert text.endswith("verdict: TUMBLING (PAR -4)\nnote: a note")
    assert f"main lines of the best: f_phi: {24 * P_PHI:.5g} h" in text


def test_residuals_of_twice_the_errors_are_never_certain(cases):
    """The right periods, with residuals of 2.3 times the errors on average."""
    case = cases["tumbler"]
    curve = case[0]
    rng = np.random.default_rng(3)
    model = offset_free(case, tumbling) + 2.1 * NOISE * rng.normal(size=curve.t.size)
    found = verdict(case, solution(model))
    assert found.misfit > 2
    assert found.verdict is Verdict.AMBIGUOUS
    assert any("times the errors" in reason for reason in found.reasons)


def test_rivals_of_other_periods_are_ambiguous_and_other_poles_are_not(cases):
    case = cases["tumbler"]
    model = offset_free(case, tumbling)
    best = solution(model)
    pole = solution(model + 1e-4, odds=0.5)
    assert verdict(case, best, pole).verdict is Verdict.TUMBLING
    assert verdict(case, best, pole).par == -3
    other = solution(model + 1e-4, P_psi=1.1 * P_PSI, odds=0.5)
    found = verdict(case, best, pole, other)
    assert found.verdict is Verdict.AMBIGUOUS
    assert found.par == -2
    assert any("1 other pair(s) of periods" in reason for reason in found.reasons)


def test_periods_that_a_few_nights_decide_are_ambiguous(cases):
    """Odds of 1 in 10,000 that depend on one night: the other body explains the others better."""
    case = cases["tumbler"]
    curve, _, linear, _ = case
    model = offset_free(case, tumbling)
    rng = np.random.default_rng(2)
    noise = NOISE * rng.normal(size=curve.t.size)
    other = np.where(curve.group == 3, model + 2 * noise, model + 0.05 * noise)
    rival = solution(other, P_psi=1.1 * P_PSI, odds=1e-4)
    agreement = _verdict.bootstrap_agreement(
        curve, linear.root, (solution(model), rival), [0, 1], limit=3.0
    )
    assert agreement < 0.9
    assert verdict(case, solution(model), rival).verdict is Verdict.AMBIGUOUS
    # one that is worse in all nights is excluded
    worse = solution(model + 2 * noise, P_psi=1.1 * P_PSI, odds=1e-4)
    assert verdict(case, solution(model), worse).verdict is Verdict.TUMBLING


def test_refits_of_resampled_curves_are_weighted_least_squares():
    """One Gauss-Newton step is exact for a linear model without outliers."""
    rng = np.random.default_rng(0)
    block, derivatives = np.repeat(np.arange(6), 10), rng.normal(size=(60, 3))
    data, prior = rng.normal(size=60), np.diag([0.0, 0.5, 2.0])
    best = -np.linalg.solve(derivatives.T @ derivatives + prior, derivatives.T @ data)
    solution = _solutions.Linearised(data + derivatives @ best, derivatives, prior, prior @ best)
    weight = rng.multinomial(6, np.full(6, 1 / 6), 20).astype(float)
    cost = _verdict._refitted_cost(solution, block, weight, 1.0, 1e6)
    at_best = best @ prior @ best
    for k in range(20):
        rows = np.sqrt(weight[k][block])[:, None]
        stacked = np.vstack([derivatives * rows, np.sqrt(prior)])
        target = np.r_[-data * rows[:, 0], np.zeros(3)]
        left = np.linalg.lstsq(stacked, target, rcond=None)[1][0]
        assert cost[k] + at_best == pytest.approx(left, rel=1e-6)


def test_a_refit_gains_nothing_by_offsets_without_points_or_by_ending_early():
    """A free offset of a block that is not drawn; a solution that is not at the minimum of the
    cost.
    """
    rng = np.random.default_rng(1)
    block = np.repeat(np.arange(6), 10)
    offsets = (block[:, None] == np.arange(6)).astype(float)
    derivatives = np.hstack([rng.normal(size=(60, 2)), offsets])
    residuals = 0.3 + rng.normal(size=60)  # the offsets are not at the minimum of the cost
    none = np.zeros((8, 8)), np.zeros(8)
    weight = np.vstack([np.ones(6), [0, 2, 1, 1, 1, 1]]).astype(float)
    solution = _solutions.Linearised(residuals, derivatives, *none)
    cost = _verdict._refitted_cost(solution, block, weight, 1.0, 3.0)
    everything = _verdict._robust_cost(residuals, 3.0).sum()
    assert cost[0] == pytest.approx(everything)
    assert abs(cost[1] / everything - 1) < 0.3


def test_periods_that_win_in_few_refits_are_ambiguous(cases):
    """Two bodies that fit equally well: which one is better depends on the nights."""
    case = cases["tumbler"]
    curve, _, linear, _ = case
    model = offset_free(case, tumbling)
    derivatives = np.random.default_rng(1).normal(size=(curve.t.size, 3))
    best, residuals = solution(model), curve.magnitude - model
    for worse, certain in ((0.25, False), (1.5, True)):
        part = np.where(curve.group % 2 == 0, 0.3, -worse)
        other = solution(model + part * residuals, P_psi=1.1 * P_PSI, odds=1e-4)
        linearised = [
            _solutions.Linearised(
                (s.model - curve.magnitude) * linear.root,
                derivatives,
                np.zeros((3, 3)),
                np.zeros(3),
            )
            for s in (best, other)
        ]
        agreement = _verdict.bootstrap_agreement(
            curve, linear.root, (best, other), [0, 1], 3.0, linearised
        )
        assert (agreement >= _verdict._AGREEMENT) == certain
        _, pairs, linear, nulls = case
        found = _verdict.judge(
            linear, nulls, pairs, (best, other), reproduced=True, limit=3.0, linearised=linearised
        )
        assert (found.verdict is Verdict.TUMBLING) == certain
        assert any("resampled" in reason for reason in found.reasons) == (not certain)


def test_resampled_light_curves_count_the_priors_as_the_order_of_solutions_does(cases):
    """A body that fits half of the nights better, with a shape that the prior nearly excludes."""
    curve, _, linear, _ = cases["tumbler"]
    model = offset_free(cases["tumbler"], tumbling)
    part = np.where(curve.group % 2 == 0, 0.2, -0.2)
    best = solution(model)
    other = solution(model + part * (curve.magnitude - model), P_psi=1.1 * P_PSI, odds=1e-4)
    columns, none = np.zeros((curve.t.size, 1)), (np.zeros((1, 1)), np.zeros(1))
    for prior_cost, certain in ((0.0, False), (1000.0, True)):
        linearised = [
            _solutions.Linearised((s.model - curve.magnitude) * linear.root, columns, *none, cost)
            for s, cost in ((best, 0.0), (other, prior_cost))
        ]
        agreement = _verdict.bootstrap_agreement(
            curve, linear.root, (best, other), [0, 1], 3.0, linearised
        )
        assert (agreement > 0.9) == certain


def test_solutions_that_are_excluded_are_not_fitted_again(cases):
    """Solutions that the linear model would improve beyond the best, with odds of 1e-10 and of
    1e-4.
    """
    case = cases["tumbler"]
    curve, _, linear, _ = case
    model = offset_free(case, tumbling)
    best, residuals = solution(model), (model - curve.magnitude) * linear.root
    derivatives = np.random.default_rng(2).normal(size=(curve.t.size, 100))
    none = np.zeros((100, 100)), np.zeros(100)
    for odds, certain in ((1e-4, False), (1e-10, True)):
        far = solution(model + 2 * (model - curve.magnitude), P_psi=1.1 * P_PSI, odds=odds)
        linearised = [
            _solutions.Linearised(residuals, 0 * derivatives, *none),
            _solutions.Linearised(residuals, derivatives, *none),
        ]
        agreement = _verdict.bootstrap_agreement(
            curve, linear.root, (best, far), [0, 1], 3.0, linearised
        )
        assert (agreement > 0.9) == certain


def test_a_body_found_once_or_at_the_edge_of_the_search_is_ambiguous(cases):
    case = cases["tumbler"]
    body = solution(offset_free(case, tumbling))
    found = verdict(case, body, reproduced=False)
    assert found.verdict is Verdict.AMBIGUOUS
    cut = (case[0], case[1]._replace(is_cut=True), *case[2:])
    found = verdict(cut, body)
    assert found.verdict is Verdict.AMBIGUOUS
    assert any("max_frequency" in reason for reason in found.reasons)


def test_a_mode_that_the_shape_decides_is_ambiguous(cases):
    """The best ellipsoid and the best convex body have the same periods, but different modes."""
    _, pairs, linear, nulls = cases["tumbler"]
    body = solution(offset_free(cases["tumbler"], tumbling))
    other = body._replace(mode=ph.Mode.SAM, model=body.model + 1e-3)
    for ellipsoid, expected in ((body, Verdict.TUMBLING), (other, Verdict.AMBIGUOUS)):
        found = _verdict.judge(
            linear, nulls, pairs, (body,), reproduced=True, limit=3.0, others=(ellipsoid,)
        )
        assert found.verdict is expected
    assert "assumption on the shape" in found.reasons[0]
    # unless convex bodies with the ellipsoid's motion are clearly excluded
    for odds, expected in ((1e-5, Verdict.AMBIGUOUS), (1e-8, Verdict.TUMBLING)):
        rival = other._replace(probability=odds, model=body.model + 0.1)
        found = _verdict.judge(
            linear, nulls, pairs, (body, rival), reproduced=True, limit=3.0, others=(other,)
        )
        assert found.verdict is expected


def test_an_ellipsoid_whose_convex_body_is_excluded_does_not_make_a_result_ambiguous(cases):
    """Its convex body is not in the list, whose length is limited."""
    _, pairs, linear, nulls = cases["tumbler"]
    body = solution(offset_free(cases["tumbler"], tumbling))
    ellipsoid = body._replace(P_psi=1.2 * P_PSI, model=body.model + 1e-3)
    for convex, expected in (
        (ellipsoid._replace(probability=1e-8), Verdict.TUMBLING),
        (ellipsoid._replace(probability=1e-4), Verdict.AMBIGUOUS),
        (body, Verdict.TUMBLING),  # the best motion, with a convex shape
    ):
        found = _verdict.judge(
            linear,
            nulls,
            pairs,
            (body,),
            reproduced=True,
            limit=3.0,
            others=(ellipsoid,),
            refined=(convex,),
        )
        assert found.verdict is expected


def test_the_evidence_for_tumbling_is_that_of_the_best_listed_body(cases):
    """The first solution fits better, but by too little for its additional parameters."""
    case = cases["tumbler"]
    model = offset_free(case, tumbling)
    first, second = solution(model, parameters=60.0), solution(model + 1e-4, odds=0.5)
    alone, both = verdict(case, first), verdict(case, first, second)
    assert both.models[-1].parameters == 10.0
    assert both.models[-1].log_evidence > alone.models[-1].log_evidence + 50
    assert both.misfit == alone.misfit


def test_a_body_that_is_no_better_than_a_series_of_two_periods_is_ambiguous(cases):
    """A Fourier series, in which the lines are not combinations of two frequencies, has a similar
    evidence.
    """
    case = cases["tumbler"]
    model = offset_free(case, tumbling)
    plain = verdict(case, solution(model))
    series = next(m for m in plain.models if m.name.startswith("two periods"))
    more = (plain.models[-1].log_evidence - series.log_evidence) / 2.5  # per half ln N, N about 150
    found = verdict(case, solution(model, parameters=10.0 + more))
    series, body = found.models[-2:]
    assert abs(body.log_evidence - series.log_evidence) < 5
    assert found.verdict is Verdict.AMBIGUOUS
    (reason,) = found.reasons
    assert "decisively better than a series of two periods" in reason


@pytest.mark.slow  # faster: the other verdicts, above
def test_fourteen_points_are_too_few():
    curve = curve_of(tumbling, nights=2, days=4, each=7)
    pairs = pairs_of(curve)
    linear, nulls = _verdict.null_models(curve, pairs, 0.02, PHASE)
    found = _verdict.judge(
        linear, nulls, pairs, (solution(curve.magnitude),), reproduced=True, limit=3.0
    )
    assert found.verdict is Verdict.TOO_FEW_POINTS
    assert found.par == 0
    assert "14" in found.reasons[0] or "13" in found.reasons[0] or "12" in found.reasons[0]


def test_the_rotating_ellipsoid_is_found_with_its_geometry():
    """Its brightness is not periodic, since the directions change; the ellipsoid explains this."""
    axes, period = np.array([1.0, 0.6, 0.45]), 0.3
    blank = curve_of(flat, noise=0.0, days=90, each=12)  # as many points as in the cases
    state = ph.State([0.8, 0.4, -0.3, 0.2], [0, 0, 2 * np.pi / period])
    inertia = ph.Inertia.from_moments(np.sum(axes**2) - axes**2)
    back = ph.rotation.conjugate(ph.simulate(ph.Scene(inertia), state, blank.t).wxyz)
    assert blank.sun is not None
    assert blank.observer is not None
    seen = [ph.rotation.rotate(back, v).T for v in (blank.sun, blank.observer)]
    light = lightcurve.seeliger_ellipsoid(tuple(axes), *(tuple(v) for v in seen))
    rng = np.random.default_rng(0)
    value = -2.5 * np.log10(np.asarray(light)) + 0.01 * rng.normal(size=blank.t.size)
    curve = blank._replace(magnitude=value, sigma=np.full(blank.t.size, 0.01))
    linear = _nulls.Linear(curve, 0.02)
    # periods that a fit would join are one start; of each period, its half and its double the
    # best poles are listed
    found = _nulls.rotators(linear, [period / 2 * 1.0002, period / 2 * 1.0003], 10.0)
    assert len(found) == 2 * _nulls._POLES  # the double frequency is beyond the highest
    assert [r.chi2 for r in found] == sorted(r.chi2 for r in found)
    rest = found[0]
    assert rest.period == pytest.approx(period, rel=1e-4)
    assert np.std(rest.values) < 0.0105
    # and with harmonics it still rotates about one axis, with more parameters
    body = _convex.rotating_body(linear, rest.parameters, curve.points(0.0, 0.02), PHASE, 3.0)
    assert np.std(body.values) < 1.01 * np.std(rest.values)
    np.testing.assert_array_equal(body.body.unknowns[0, 4:6], 0.0)
    assert 2 * np.pi / body.body.unknowns[0, 6] == pytest.approx(period, rel=1e-4)
    assert 6 < body.parameters < 30


def test_a_rotating_body_is_found_where_the_best_ellipsoid_has_another_period():
    """Its light curve has strong odd harmonics, which no ellipsoid has."""
    period, blank = 0.42, curve_of(flat, noise=0.0, each=12)
    attitude = np.array([0.8, 0.4, -0.3, 0.2])
    state = ph.State(attitude / np.linalg.norm(attitude), [0, 0, 2 * np.pi / period])
    inertia = ph.Inertia.from_moments([0.6, 0.8, 1.0])
    back = ph.rotation.conjugate(ph.simulate(ph.Scene(inertia), state, blank.t).wxyz)
    assert blank.sun is not None
    assert blank.observer is not None
    seen = [ph.rotation.rotate(back, v) for v in (blank.sun, blank.observer)]
    sphere = lightcurve.Convex.from_ellipsoid(np.ones(3), 1500)
    rows = np.asarray(lightcurve.harmonics(sphere.normals, 3))
    rng = np.random.default_rng(2)
    more = np.exp(0.5 * np.r_[np.zeros(4), rng.normal(size=12)] @ rows)
    body = lightcurve.Convex(sphere.normals, sphere.areas * more)
    value = -2.5 * np.log10(np.asarray(body.brightness(*seen)))
    value = value + 0.01 * rng.normal(size=value.size)
    curve = blank._replace(magnitude=value, sigma=np.full(value.size, 0.01))
    linear, points = _nulls.Linear(curve, 0.02), curve.points(0.0, 0.02)

    def cost(start):
        return _convex.rotating_body(linear, start, points, PHASE, 3.0).cost

    ellipsoid = _nulls.rotators(linear, [period], 10.0)[0]
    starts = _nulls.round_rotators([period])
    assert len({tuple(s[2:4]) for s in starts}) == len(starts)
    least = min(cost(start) for start in starts[::3])
    assert least < 1.5 * value.size
    assert ellipsoid.period > 1.9 * period
    assert least < 0.3 * cost(ellipsoid.parameters)


def test_nights_with_a_trend_or_too_small_errors_are_named():
    curve = curve_of(flat)
    rng = np.random.default_rng(5)
    residuals = NOISE * rng.normal(size=curve.t.size)
    assert _solutions.notes_on_groups(curve, residuals, 1.0) == ()
    third = curve.group == 2
    part = (curve.t - curve.t[third].min()) / np.ptp(curve.t[third])
    drifting = np.where(third, residuals + 0.15 * part, residuals)
    (note,) = _solutions.notes_on_groups(curve, drifting, 1.0)
    assert "group(s) 2 (+0.1" in note
    assert "comparison star" in note
    # the same trend is not remarkable where neighbours are alike
    assert _solutions.notes_on_groups(curve, drifting, 8.0) == ()
    noisy = np.where(third, 4 * residuals, residuals)
    (note,) = _solutions.notes_on_groups(curve, noisy, 1.0)
    assert "group(s) 2 scatter" in note


def test_points_without_errors_get_the_scatter_of_neighbours():
    curve = curve_of(tumbling, noise=0.08, sigma=0.0)
    assert curve.scatter() == pytest.approx(0.08, rel=0.15)
    known = curve.with_errors(0.03)
    np.testing.assert_allclose(known.sigma, curve.scatter())
    assert "scatter of neighbours" in known.notes[-1]
    given = curve_of(tumbling)
    assert given.with_errors(0.03) is given


def test_precession_of_the_short_axis_is_counted_in_the_motion():
    """Revolutions of the body's third axis about the momentum, in both modes."""
    inertia = ph.Inertia.from_moments([0.4, 0.8, 1.0])
    for omega in ([1.0, 0.2, 0.3], [0.2, 0.3, 1.0]):
        state = ph.State([1.0, 0, 0, 0], omega)
        found = ph.periods(inertia, state)
        t = np.linspace(0, 400.0, 8001)
        wxyz = ph.simulate(ph.Scene(inertia), state, t).wxyz
        pole = np.array(omega) * [0.4, 0.8, 1.0]
        pole = pole / np.linalg.norm(pole)
        e = np.linalg.svd(pole[None])[2][1:]
        axis = np.asarray(ph.rotation.rotate(wxyz, np.tile([0.0, 0, 1.0], (t.size, 1))))
        turned = np.unwrap(np.arctan2(axis @ e[1], axis @ e[0]))
        rate = abs(turned[-1] - turned[0]) / 400 / (2 * np.pi)
        body = solution(None, float(found.P_phi), float(found.P_psi))
        assert 1 / body.P_phi_short_axis == pytest.approx(rate, rel=0.01)


@pytest.fixture(scope="module")
def convex_case():
    """A convex body that is not an ellipsoid, observed in 12 nights, and its true motion."""
    rng = np.random.default_rng(7)
    blank = curve_of(flat, nights=12, days=30, each=20)
    rough = 0.12 * rng.normal(size=16) * np.r_[0, np.ones(15)]
    square = np.array([1.0, 0.7, 0.5]) ** 2
    moments = square.sum() - square
    state = ph.State([0.8, 0.4, -0.3, 0.2], np.array([11.0, 3.0, 5.0]))
    back = ph.rotation.conjugate(ph.simulate(ph.Scene(ph.Inertia(moments)), state, blank.t).wxyz)
    assert blank.sun is not None
    assert blank.observer is not None
    seen = [ph.rotation.rotate(back, v) for v in (blank.sun, blank.observer)]
    ellipsoid = lightcurve.Convex.from_ellipsoid(np.array([1.0, 0.7, 0.5]), 1500)
    more = np.exp(rough @ np.asarray(lightcurve.harmonics(ellipsoid.normals, 3)))
    body = lightcurve.Convex(ellipsoid.normals, ellipsoid.areas * more)
    light = -2.5 * np.log10(np.asarray(body.brightness(*seen)))
    value = light + 0.02 * rng.normal(size=light.size)
    curve = blank._replace(magnitude=value, sigma=np.full(light.size, 0.02))
    body = _brightness.Bodies(
        np.r_[np.log(square[1:]) / 2, np.log(square[1:]) / 2, state.omega_body, 0.3][None],
        np.asarray(ph.rotation.normalise(state.wxyz))[None],
    )
    return curve, body, ph.periods(ph.Inertia(moments), state)


@pytest.mark.slow  # faster: of ellipsoids, test_fit
def test_derivatives_of_convex_bodies(convex_case):
    curve, body, _ = convex_case
    points = curve.points(0.0, 0.02)
    normals = lightcurve.Convex.from_ellipsoid(np.ones(3), 200).normals
    rows = lightcurve.harmonics(normals, _convex.DEGREE)[1:]
    known = (normals, 1.0 + normals[:, 0] ** 2, rows)
    coefficients = 0.05 * np.random.default_rng(0).normal(size=_convex.HARMONICS)
    _, motion, shape, open_area, by_open = _convex._light(body, coefficients, points, known)
    size = 1e-6

    def value(step, more):
        change = np.zeros((1, body.unknowns.shape[1] + 3))
        change[0, _convex._MOTION], change[0, -3:] = step[:5], step[5:]
        turned = ph.rotation.rotation_vector_to_wxyz(change[:, -3:])
        moved = _brightness.Bodies(
            body.unknowns + change[:, :-3], ph.rotation.multiply(turned, body.wxyz)
        )
        out = _convex._light(moved, coefficients + more, points, known)
        return np.asarray(out[0]), np.asarray(out[3])

    none = np.zeros(_convex.HARMONICS)
    for k in range(8):
        e = size * np.eye(8)[k]
        measured = (value(e, none)[0] - value(-e, none)[0]) / (2 * size)
        scale = np.abs(measured).max()
        # facets become visible or dark: single points differ
        off = np.abs(motion[:, k] - measured) / scale
        assert np.median(off) < 1e-6
        assert np.quantile(off, 0.95) < 1e-2
    for k in (0, 5, 20):
        e = size * np.eye(_convex.HARMONICS)[k]
        ends = [value(np.zeros(8), x) for x in (e, -e)]
        measured, opened = ((a - b) / (2 * size) for a, b in zip(*ends, strict=True))
        np.testing.assert_allclose(shape[:, k], measured, atol=1e-6)
        np.testing.assert_allclose(by_open[k], opened, atol=1e-6)
    assert open_area.shape == (3,)


@pytest.mark.slow
def test_a_convex_shape_leaves_the_noise_and_periods_within_their_errors(convex_case):
    curve, body, truth = convex_case
    linear, phase = _nulls.Linear(curve, 0.02), lightcurve.SeeligerPhase()
    body = body._replace(unknowns=body.unknowns[:, : 7 + len(phase.typical)])
    start = solution(
        curve.magnitude,
        moments=np.array(_brightness.moments_of(body.unknowns[0])),
        axes=np.exp(np.r_[0, body.unknowns[0, 2:4]]),
        omega_body=body.unknowns[0, 4:7],
        coefficients=body.unknowns[0, 7:],
        wxyz=body.wxyz[0],
        offsets=np.zeros(13),
    )
    # a second start whose pole is 2 degrees off ends as a copy of the first
    near = start._replace(
        wxyz=np.asarray(ph.rotation.multiply(np.array([1.0, 0.01, 0.01, 0]), start.wxyz))
    )
    found, scale, alike, linearised, refined = _convex.refined_solutions(
        (start, near), linear, curve.points(0.0, 0.02), phase, 3.0
    )
    assert len(found) == len(linearised) == 1
    assert refined is not None
    assert refined.P_psi == pytest.approx(found[0].P_psi, rel=1e-3)
    best = found[0]
    assert scale == pytest.approx(1.0, abs=0.12)
    assert alike < 1.5
    assert best.harmonics is not None
    for name in ("P_phi", "P_psi"):
        error = getattr(best, name) - float(getattr(truth, name))
        assert abs(error) < 3.5 * getattr(best, name + "_std")
        assert getattr(best, name + "_std") < 1e-3 * getattr(best, name)
    # an ellipsoid with the true motion leaves more
    ellipsoid = _brightness.magnitudes(phase, body, curve.points(0.0, 0.02))
    left = linear.projected(np.asarray(ellipsoid)[0, : curve.t.size]) - linear.data
    assert np.std(left) > 1.5 * scale


@pytest.mark.slow
def test_a_rotator_and_noise_are_no_tumblers_in_whole_fits():
    for light, expected in ((flat, Verdict.NO_SIGNAL), (rotating, Verdict.ONE_PERIOD)):
        curve = curve_of(light, nights=8, each=16)
        fit = lightcurve.fit_light_curve(curve, max_frequency=8.0, trials=2_000, searches=1)
        assert fit.verdict is expected, lightcurve.table(fit)
        text = lightcurve.table(fit)
        assert text.index("noise only") < text.index("tumbling body") < text.index("P_phi short")
        assert f"verdict: {expected.name} (PAR {fit.par:+d})" in text
