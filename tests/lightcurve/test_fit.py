"""Tumbling bodies recovered from their light curves; derivatives, mirror images, messages."""

import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from benchmarks import light_curves
from polhode import lightcurve
from polhode._closed_forms import principal_periods
from polhode.lightcurve import _brightness, _fit, _frequencies, _search, _solutions

PHASE = lightcurve.HG1G2()
STEPPED = jax.jit(_brightness.apply_step)


@jax.jit
def magnitudes(bodies, points):
    return _brightness.magnitudes(PHASE, bodies, points)


@pytest.fixture(scope="module")
def seen():
    curve, truth, _ = light_curves.synthetic(3, 0.02, nights=8, days=12.0, each=16)
    return curve, truth, curve.points(0.01)


@pytest.fixture(scope="module")
def trial(seen):
    """Eight bodies with the same periods in each mode."""
    meant = _frequencies.Hypotheses(
        np.array([1.2, 1.2]), np.array([0.7, 0.7]), np.array([True, False])
    )
    # as many bodies as in test_search, which checks their periods
    bodies, good = _search.build(*_search.draw(jax.random.key(1), meant, 32), PHASE)
    lam, sam = (np.flatnonzero(x)[:8] for x in good.reshape(2, 32))
    index = np.r_[lam, 32 + sam]
    assert len(index) == 16
    return jax.tree.map(lambda x: jnp.asarray(x[index]), bodies)


def test_model_is_that_of_simulate(seen, trial):
    """Brightness computed with public functions, one body at a time."""
    curve, _, points = seen
    values = magnitudes(trial, points)
    x = np.asarray(trial.unknowns[0])
    inertia = ph.Inertia(np.stack(_brightness.moments_of(jnp.asarray(x))))
    path = ph.simulate(ph.Scene(inertia), ph.State(trial.wxyz[0], x[4:7]), curve.t - curve.t[0])
    axes = np.exp([0.0, *x[2:4]])

    @jax.jit
    def expected(wxyz, *vectors):
        back, alpha = ph.rotation.conjugate(wxyz), jnp.asarray(curve.alpha)
        sun, observer = (ph.rotation.rotate(back, v) for v in vectors)
        light = lightcurve.seeliger_ellipsoid(tuple(axes), tuple(sun.T), tuple(observer.T))
        light = light / (np.pi / 2 * np.prod(axes) ** (2 / 3))
        reduced = -2.5 * jnp.log10(light / lightcurve.seeliger_sphere(alpha))
        return reduced + PHASE.magnitudes(alpha, jnp.asarray(x[7:9]))

    want = expected(path.wxyz, curve.sun, curve.observer)
    np.testing.assert_allclose(values[0, : curve.t.size], want, atol=1e-9)


def test_light_has_the_sums_of_its_mode(trial):
    """With constant directions few combinations of the frequencies contain the variance; their
    parity depends on the mode.
    """
    t = np.r_[0, np.sort(np.random.default_rng(4).uniform(0, 60, 127))]
    sun, observer = np.tile([1.0, 0, 0], (128, 1)), np.tile([0.8, 0.6, 0], (128, 1))
    curve = lightcurve.LightCurve.of(t, 0 * t, sun, observer)
    light = np.asarray(magnitudes(trial, curve.points(0.01)))[:, :128]
    left = []
    for sums in (_frequencies.LAM, _frequencies.SAM):
        phases = 2 * np.pi * np.outer(t, np.array(list(sums)) @ [1.2, 0.7])
        whole = np.hstack([np.ones((128, 1)), np.cos(phases), np.sin(phases)])
        rest = light.T - whole @ np.linalg.lstsq(whole, light.T, rcond=None)[0]
        left.append(rest.var(0) / light.var(1))
    own, other = np.where(np.arange(16) < 8, left, left[::-1])
    assert np.median(own) < 0.05
    assert np.median(other) > 0.3


@pytest.mark.slow  # faster: values, test_model_is_that_of_simulate
def test_derivatives_by_every_unknown(seen, trial):
    _, _, points = seen
    value, slopes = jax.jit(lambda *x: _brightness.magnitudes_and_derivatives(PHASE, *x))(
        trial, points
    )
    np.testing.assert_allclose(value, magnitudes(trial, points), atol=1e-12)
    size, (count, many, _) = 1e-6, slopes.shape
    for k in range(many):
        e = jnp.zeros((count, many)).at[:, k].set(size)
        ends = [magnitudes(STEPPED(trial, x), points) for x in (e, -e)]
        measured = (ends[0] - ends[1]) / (2 * size)
        scale = jnp.max(jnp.abs(slopes[:, k]))
        np.testing.assert_allclose(slopes[:, k] / scale, measured / scale, atol=1e-6)


def test_steps_keep_the_frequencies_that_they_mean(trial):
    """Equal to plain steps to first order; to second order the frequencies change as the step
    intends.
    """

    @jax.jit
    def logs(unknowns):
        found = principal_periods(_brightness.moments_of(unknowns), unknowns[..., 4:7])
        return -jnp.log(jnp.stack([found.P_phi, found.P_psi], -1))

    unknowns, wxyz = trial
    step = jnp.zeros((len(wxyz), unknowns.shape[1] + 3)).at[:, 0].set(0.03).at[:, 5].set(0.02)
    # by differences of fourth order, since the derivative would be another program
    ends = [logs(unknowns + 0.01 * k * step[:, :-3]) for k in (-2, -1, 1, 2)]
    meant = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / 0.12
    plain = logs(unknowns + step[:, :-3]) - logs(unknowns) - meant
    moved = STEPPED(trial, step)
    rest = logs(moved.unknowns) - logs(unknowns) - meant
    # near the separatrix the step is not corrected
    mended = np.abs(rest).max(1) < 1e-5
    assert mended.mean() > 0.7
    assert np.median(np.abs(plain)[mended]) > 100 * np.median(np.abs(rest)[mended])
    np.testing.assert_allclose(moved.unknowns[:, :4], (unknowns + step[:, :-3])[:, :4], rtol=1e-12)


def test_mirror_gives_the_same_light(trial):
    t = np.linspace(0, 5, 128)
    sun, observer = np.tile([1.0, 0, 0], (128, 1)), np.tile([0.6, 0.48, 0.64], (128, 1))
    curve = lightcurve.LightCurve.of(t, 0 * t, sun, observer)
    normal = _fit._mirrors(curve)[0]
    points = curve.points(0.01)
    image = _fit._reflect(jax.tree.map(np.asarray, trial), normal)
    np.testing.assert_allclose(magnitudes(image, points), magnitudes(trial, points), atol=1e-9)
    turned = 2 * normal * (_solutions.momentum(trial) @ normal)[:, None] - _solutions.momentum(
        trial
    )
    np.testing.assert_allclose(_solutions.momentum(image), turned, atol=1e-9)


def test_a_list_that_ends_before_the_odds_do_says_so():
    curve, *_ = light_curves.synthetic(3, 0.02, nights=8, days=12.0, each=16)

    def said(word, *odds, step=0.1):
        solutions = [
            types.SimpleNamespace(
                P_phi=1.0 + step * k, P_psi=1.0, probability=p, mirror_of=None, mode=0
            )
            for k, p in enumerate(odds)
        ]
        return [n for n in _solutions.notes_on(curve, solutions, 1.0, 1.0) if word in n]

    assert not said("mbiguous", 1.0, 1e-4)
    assert said("Ambiguous", 1.0, 0.1, 1e-4)[0].startswith("Ambiguous: 1 other pair")
    assert said("Ambiguous", 1.0, 0.1, 0.01)[0].startswith("Ambiguous: at least 2 other")
    # other poles of the same periods
    assert not said("Ambiguous", 1.0, 0.1, 1e-4, step=0.0)
    assert said("pole is ambiguous", 1.0, 0.1, 1e-4, step=0.0)


@pytest.mark.slow
def test_a_tumbler_is_found_again():
    """One night in one geometry, with a gap: the body, or its mirror image."""
    minute, rng = 1 / 1440, np.random.default_rng(1)
    square = np.array([1.0, 0.6, 0.4]) ** 2
    inertia = ph.Inertia(square.sum() - square)
    start = ph.State([0.9, 0.1, -0.3, 0.3], np.array([0.45, 0.15, 0.2]) / minute)
    truth = ph.periods(inertia, start)
    t = np.sort(rng.uniform(0, 150, 250)) * minute
    t = t[(t < 60 * minute) | (t > 75 * minute)]
    sun, observer = np.array([1.0, 0, 0]), np.array([np.cos(0.7), np.sin(0.7), 0])
    sun, observer = (np.tile(v, (t.size, 1)) for v in (sun, observer))
    blank = lightcurve.LightCurve.of(t, 0 * t, sun, observer, sigma=0.02)
    x = np.r_[np.log(square[1:]) / 2, np.log(square[1:]) / 2, start.omega_body]
    body = _brightness.Bodies(jnp.asarray(x)[None], start.wxyz[None])
    light = _brightness.magnitudes(lightcurve.SeeligerPhase(), body, blank.points(0.01))[
        0, : t.size
    ]
    curve = blank._replace(magnitude=np.asarray(light) + 0.02 * rng.normal(size=t.size))
    fit = lightcurve.fit_light_curve(curve, floor=0.005, trials=8_000)
    best, text = fit.best, lightcurve.table(fit)
    assert int(best.mode) == int(truth.mode), text
    # another first time of the light curve does not change the periods
    assert best.P_phi == pytest.approx(float(truth.P_phi), rel=2e-3), text
    assert best.P_psi == pytest.approx(float(truth.P_psi), rel=5e-3), text
    pole = np.asarray(_solutions.momentum(body))[0]
    pole = np.degrees([np.arctan2(pole[1], pole[0]), np.arcsin(pole[2])])
    assert min(light_curves.apart(s.pole, pole) for s in fit.solutions[:4]) < 15, text
    assert best.rms < 0.025
    costs = [s.cost for s in fit.solutions]
    assert costs == sorted(costs)
    assert all(note in text for note in fit.notes)


def test_an_unknown_pole_has_the_spread_of_random_directions():
    directions = np.random.default_rng(0).normal(size=(100_000, 3))
    angles = np.arccos(directions[:, 2] / np.linalg.norm(directions, axis=1))
    assert _solutions.pole_std_of(np.full(3, 50.0)) == pytest.approx(
        np.degrees(np.sqrt(np.mean(angles**2))), rel=0.01
    )
    assert _solutions.pole_std_of(np.array([3e-3, 4e-3, 0])) == pytest.approx(np.degrees(5e-3))


@pytest.mark.slow
def test_how_much_zero_points_differ_is_learnt():
    curve, truth, _ = light_curves.synthetic(3, 0.02, nights=10, days=16.0, each=14, spread=0.06)
    fit = lightcurve.fit_light_curve(
        curve, floor=0.01, max_frequency=7.0, trials=12_000, searches=1
    )
    assert int(fit.best.mode) == truth["mode"]
    assert fit.best.P_phi == pytest.approx(truth["P_phi"], rel=5e-3)
    assert fit.best.P_psi == pytest.approx(truth["P_psi"], rel=5e-3)
    # ten nights: to a quarter, one sigma
    assert fit.offset_sigma is not None
    assert 0.03 < fit.offset_sigma < 0.1


def test_without_directions_only_frequencies(tmp_path):
    t = np.linspace(0, 1, 60)
    path = tmp_path / "points.csv"
    rows = [f"{a},{10 + np.sin(20 * a) + 0.5 * np.sin(33 * a)}" for a in t]
    path.write_text("\n".join(["t,mag", *rows]))
    said = []
    assert lightcurve.run(path, say=said.append) is None
    assert "f_phi" in "\n".join(said)
    assert any("no body can be fitted" in line for line in said)
    with pytest.raises(ValueError, match="no vectors"):
        lightcurve.fit_light_curve(lightcurve.read_light_curve(path))


@pytest.mark.slow
def test_tc4_in_the_night_of_2012(shared, tmp_path):
    """Published: 12.25 and 8.5 = 1 / (1/12.23 + 1/27.8) min, long-axis mode (Lee et al. 2021)."""
    folder = shared / "data" / "light_curves"
    if not folder.exists():
        pytest.skip("the folder of light curves is absent")
    pytest.importorskip("matplotlib")
    said = []
    # every third point, the number that a search uses: search and fit share a program
    header, *rows = (folder / "tc4_2012.csv").read_text().splitlines()
    few = tmp_path / "few.csv"
    few.write_text("\n".join([header, *rows[::3]]) + "\n")
    fit = lightcurve.run(
        few,
        vectors=folder / "tc4_2012_vectors.csv",
        trials=8_000,
        output=tmp_path / "tc4",
        say=said.append,
    )
    assert fit.best.mode == ph.Mode.LAM
    assert fit.best.P_phi * 1440 == pytest.approx(12.23, abs=0.05)
    assert fit.best.P_psi * 1440 == pytest.approx(27.8, abs=0.3)
    assert any(s.mirror_of is not None for s in fit.solutions)
    assert (tmp_path / "tc4.png").stat().st_size > 10_000
    assert "solutions" in (tmp_path / "tc4.json").read_text()
