"""Figures show the right data; wrong input raises errors; the user's settings do not change."""

import sys

import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

matplotlib.use("agg")
from matplotlib import pyplot as plt

import polhode as ph
from polhode import plot
from polhode.plot import _trajectory

MOMENTS = np.array([1.0, 2.0, 2.5])


@pytest.fixture(scope="module")
def trajectory():
    """Two bodies in free motion."""
    scene = ph.Scene(ph.Inertia.from_moments(MOMENTS))
    omega = jnp.array([[0.1, 1.0, 0.2], [1.0, 0.3, 0.1]])
    state = ph.State(wxyz=jnp.array([1.0, 0.0, 0.0, 0.0]), omega_body=omega)
    return ph.simulate(scene, state, np.linspace(0, 20, 201), ph.LiePoisson())


@pytest.fixture(autouse=True)
def _close_figures():
    yield
    plt.close("all")


@pytest.mark.parametrize("axis", [0, 2])
def test_family_curves_have_the_energy_and_momentum_they_are_drawn_for(axis):
    for inertia in (1.2, 1.9) if axis == 0 else (2.1, 2.45):
        curves = list(_trajectory._level(MOMENTS, 3.0, inertia, axis))
        assert len(curves) == 2
        for side, curve in zip((1, -1), curves, strict=True):
            np.testing.assert_allclose(curve**2 @ MOMENTS, 3.0, rtol=1e-13)
            np.testing.assert_allclose(curve**2 @ MOMENTS**2, 3.0 * inertia, rtol=1e-13)
            assert (side * curve[:, axis] > 0).all()


def test_separatrix_passes_through_the_intermediate_axis():
    for curve in _trajectory._separatrix(MOMENTS, 3.0):
        np.testing.assert_allclose(curve**2 @ MOMENTS**2, 3.0 * 2.0, rtol=1e-13)
        assert np.abs(curve[:, 1]).max() == pytest.approx(np.sqrt(3.0 / 2.0))
        assert np.abs(curve[:, 2]).min() < 1e-7
    assert not list(_trajectory._separatrix(np.array([1.0, 1.0, 2.0]), 3.0))


@pytest.mark.parametrize("turned", [False, True])
def test_polhode_curve_lies_on_the_ellipsoid(trajectory, turned):
    made = plot.samples(
        trajectory.ts,
        trajectory.omega_body,
        inertia=ph.Inertia.from_tensor(_tensor()) if turned else trajectory.scene.inertia,
    )
    ax = plot.polhode(made, body=1)
    drawn = [line for line in ax.lines if line.get_linewidth() == 2.4]
    points = np.concatenate([np.stack(line.get_data_3d(), axis=-1) for line in drawn])
    points = points[np.isfinite(points).all(axis=-1)]
    assert len(points) >= 201
    tensor = made.tensor[1]
    twice = made.omega_body[1, 0] @ tensor @ made.omega_body[1, 0]
    semi = np.sqrt(twice / np.linalg.eigvalsh(tensor).min())
    if not turned:
        energy = np.einsum("pi,ij,pj->p", points * semi, tensor, points * semi)
        np.testing.assert_allclose(energy, twice, rtol=1e-6)
    rates = {tuple(np.round(p, 9)) for p in made.omega_body[1] / semi}
    assert {tuple(np.round(p, 9)) for p in points} == rates


def _tensor():
    turn = np.linalg.qr(np.arange(9.0).reshape(3, 3) + np.eye(3))[0]
    return turn @ np.diag(MOMENTS) @ turn.T


def test_herpolhode_stays_between_its_circles(trajectory):
    ax = plot.herpolhode(trajectory)
    inner, outer, curve = ax.lines[:3]
    radius = np.hypot(*curve.get_data())
    assert np.hypot(*inner.get_data()).max() == pytest.approx(radius.min())
    assert np.hypot(*outer.get_data()).max() == pytest.approx(radius.max())
    # |w|^2 = (part along L)^2 + radius^2, and the part along L is 2T/|L|
    omega, momentum = np.asarray(trajectory.omega_body[0]), np.asarray(trajectory.momentum_body[0])
    along = np.sum(omega * momentum, axis=-1) / np.linalg.norm(momentum, axis=-1)
    np.testing.assert_allclose(radius**2, np.sum(omega**2, axis=-1) - along**2, rtol=1e-6)


def test_history_shows_rates_attitude_and_drift(trajectory):
    figure = plot.history(trajectory, body=1)
    rates, attitude, drift = figure.axes
    np.testing.assert_array_equal(rates.lines[0].get_ydata(), trajectory.omega_body[1, :, 0])
    np.testing.assert_array_equal(attitude.lines[3].get_ydata(), trajectory.wxyz[1, :, 3])
    energy = np.asarray(trajectory.energy[1])
    want = np.abs(energy / energy[0] - 1)
    np.testing.assert_allclose(np.nan_to_num(drift.lines[0].get_ydata()), want, rtol=1e-12)
    bare = plot.history(plot.samples(trajectory.ts, trajectory.omega_body))
    assert len(bare.axes) == 1


def test_work_precision_sorts_and_names_failures():
    curves = {"good": ([1e-3, 1e-6], [2.0, 1.0]), "bad": ([np.nan], [1.0])}
    ax = plot.work_precision(curves, highlight="good")
    np.testing.assert_array_equal(ax.lines[0].get_xdata(), [1.0, 2.0])
    np.testing.assert_array_equal(ax.lines[0].get_ydata(), [1e-6, 1e-3])
    names = [text.get_text() for text in ax.get_legend().get_texts()]
    assert names == ["good", "bad (failed)"]
    with pytest.raises(ValueError, match="one length"):
        plot.work_precision({"odd": ([1.0, 2.0], [1.0])})
    with pytest.raises(ValueError, match="at least one"):
        plot.work_precision({})


def test_overview_draws_bands_and_observations(trajectory):
    first = slice(0, 3)
    seen = plot.samples(
        trajectory.ts[first], trajectory.omega_body[0, first], trajectory.wxyz[0, first]
    )
    three = plot.samples(
        trajectory.ts,
        trajectory.omega_body[np.array([0, 1, 1])],
        trajectory.wxyz[np.array([0, 1, 1])],
        trajectory.scene.inertia,
    )
    figure = plot.overview(three, observed=seen, title="two bodies")
    panel = figure.axes[0]
    assert len(panel.collections) == 3
    line, dots = panel.lines[0], panel.lines[1]
    # body x axis along space x: the first matrix entry
    _, _, y, z = np.moveaxis(np.asarray(trajectory.wxyz[0]), -1, 0)
    np.testing.assert_allclose(line.get_ydata(), 1 - 2 * (y**2 + z**2), atol=1e-15)
    np.testing.assert_array_equal(dots.get_ydata(), line.get_ydata()[first])


def test_bodies_with_times_of_their_own_are_lines_at_these(trajectory):
    ts = np.linspace(0, 1, trajectory.ts.size) * np.array([[1.0], [3.0], [3.0]])
    bodies = np.array([0, 1, 1])
    three = plot.samples(
        ts, trajectory.omega_body[bodies], trajectory.wxyz[bodies], trajectory.scene.inertia
    )
    panel = plot.overview(three).axes[0]
    assert not panel.collections
    drawn = {(line.get_xdata()[-1] / line.get_xdata()[1]).round(6) for line in panel.lines}
    assert len(panel.lines) == 9
    ends = sorted(line.get_xdata()[-1] for line in panel.lines)
    np.testing.assert_allclose(ends, np.array([1.0] * 3 + [3.0] * 6) * ends[0])
    assert len(drawn) == 1


@pytest.mark.parametrize(("family", "levels"), [(0, 0), (1, 1), (5, 5), (8, 8)])
def test_the_family_has_as_many_levels_as_are_asked_for(family, levels):
    curves = list(_trajectory._family(MOMENTS, 3.0, family))
    momenta = {round(float((curve[0] ** 2) @ MOMENTS**2), 9) for curve in curves}
    assert len(momenta) == levels
    assert len(curves) == 2 * levels


def test_boxes_have_the_inertia_of_their_body():
    tensor = _tensor()
    corners = _trajectory._box(tensor)
    # a homogeneous box has one third of its corners' second moments
    second = corners.T @ corners / 8 / 3
    inertia = np.trace(second) * np.eye(3) - second
    np.testing.assert_allclose(inertia / np.trace(inertia), tensor / np.trace(tensor), atol=1e-14)
    assert np.linalg.norm(corners[0] - corners[-1]) == pytest.approx(1)


def test_interpolation_takes_the_short_way_and_meets_the_samples():
    ts = np.array([0.0, 1.0, 2.0])
    half = np.array([0.0, 0.3, 0.6])
    wxyz = np.stack([np.cos(half), np.sin(half), 0 * half, 0 * half], axis=-1)
    wxyz[1] *= -1
    at = _trajectory._interpolate(np.array([0.5, 1.0, 2.0]), ts, wxyz)
    angle = np.arctan2(at[:, 2, 1], at[:, 1, 1])
    np.testing.assert_allclose(angle, [0.3, 0.6, 1.2], atol=1e-12)
    back = _trajectory._interpolate(np.array([0.5, 1.0, 2.0]), ts[::-1], wxyz[::-1])
    np.testing.assert_allclose(back, at, atol=1e-12)


@pytest.mark.parametrize("ending", ["gif", "html"])
def test_animation_is_written_whole(trajectory, tmp_path, ending):
    path = tmp_path / f"two.{ending}"
    animation = plot.animate(trajectory, path, seconds=0.2, fps=10, dpi=30)
    assert list(tmp_path.iterdir()) == [path]
    assert path.stat().st_size > 500
    plt.close(animation._fig)


def test_panels_of_bodies_with_times_of_their_own_show_one_time(monkeypatch, tmp_path):
    ts = np.stack([np.linspace(0, 10, 41), np.linspace(5, 20, 41)])
    half = 0.1 * ts
    wxyz = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=-1)
    rates = np.broadcast_to([0.0, 0.0, 0.2], (2, 41, 3))
    bodies = plot.samples(ts, rates, 3 * wxyz, ph.Inertia.from_moments(MOMENTS))
    np.testing.assert_allclose(bodies.wxyz, wxyz, atol=1e-15)
    shown, draw = [], Poly3DCollection.set_verts
    monkeypatch.setattr(
        Poly3DCollection,
        "set_verts",
        lambda self, verts, *rest: (shown.append(verts), draw(self, verts, *rest)),
    )
    animation = plot.animate(bodies, tmp_path / "two.gif", seconds=0.3, fps=10, dpi=20)
    shown.clear()
    *_, title = animation._func(1)
    np.testing.assert_allclose(*shown, atol=1e-3)
    assert title.get_text() == "t = 10.00 s"


def test_animation_refuses_what_it_cannot_write(trajectory, tmp_path):
    with pytest.raises(ValueError, match=r"\.gif, \.mp4 or \.html"):
        plot.animate(trajectory, tmp_path / "a.avi")
    with pytest.raises(ValueError, match="1 to 64 bodies"):
        plot.animate(trajectory, bodies=[])
    if not matplotlib.animation.writers.is_available("ffmpeg"):
        with pytest.raises(RuntimeError, match="ffmpeg"):
            plot.animate(trajectory, tmp_path / "a.mp4")
    assert not list(tmp_path.iterdir())


def test_missing_data_and_wrong_bodies_are_named(trajectory):
    bare = plot.samples(trajectory.ts, trajectory.omega_body)
    with pytest.raises(ValueError, match="needs inertia"):
        plot.polhode(bare)
    with pytest.raises(ValueError, match="needs wxyz"):
        plot.herpolhode(bare)
    for body in (2, 0.5):
        with pytest.raises(ValueError, match="whole number below that of the bodies, 2"):
            plot.history(bare, body=body)
    with pytest.raises(TypeError, match=r"ph\.Trajectory"):
        plot.polhode(np.zeros((3, 3)))
    for empty in (trajectory[:0], trajectory[..., 3:3]):
        with pytest.raises(ValueError, match="one body and one sample or more"):
            plot.overview(empty)
    with pytest.raises(ValueError, match="omega_body must have shape"):
        plot.samples([0.0, 1.0], [1.0, 2.0])
    with pytest.raises(ValueError, match="ts must have shape"):
        plot.samples([0.0, 1.0, 2.0], np.zeros((2, 3)))
    rest = plot.samples(
        [0.0, 1.0], np.zeros((2, 3)), inertia=ph.Inertia.from_moments([1.0, 2.0, 2.5])
    )
    with pytest.raises(ValueError, match="at rest"):
        plot.polhode(rest)
    with pytest.raises(ValueError, match="that of the bodies, 2"):
        plot.animate(trajectory, bodies=[2])


def test_a_body_that_did_not_finish_is_not_said_to_be_at_rest():
    omega = np.ones((2, 3, 3))
    omega[0] = np.nan
    wxyz = np.broadcast_to([1.0, 0, 0, 0], (2, 3, 4))
    failed = plot.samples([0.0, 1.0, 2.0], omega, wxyz, ph.Inertia.from_moments(MOMENTS))
    for figure in (plot.polhode, plot.herpolhode):
        with pytest.raises(ValueError, match="did not finish"):
            figure(failed)
    assert "Energy [J]" in [ax.get_title("left") for ax in plot.overview(failed).axes]


def test_settings_of_the_user_are_left_alone(trajectory):
    before = dict(matplotlib.rcParams)
    plot.history(trajectory)
    assert dict(matplotlib.rcParams) == before


def test_message_without_matplotlib(trajectory, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ImportError, match=r"pip install 'polhode\[plot\]'"):
        plot.history(trajectory)


def test_momentum_is_that_of_body_and_wheels():
    """With wheels the momentum is constant to rounding, and the herpolhode is in one plane."""
    wheel = ph.Rotor([0.0, 0.0, 1.0], momentum=3.0)
    scene = ph.Scene(ph.Inertia.from_moments(MOMENTS), rotors=wheel)
    state = ph.State([1.0, 0, 0, 0], [0.1, 1.0, 0.2])
    traj = ph.simulate(scene, state, np.linspace(0, 20, 101))
    data = plot._samples.as_samples(traj)
    np.testing.assert_allclose(data.momentum_space[0], traj.momentum_space, rtol=1e-12)
    lines = plot.history(traj).axes[-1].lines
    drift = next(line for line in lines if line.get_label() == "momentum").get_ydata()
    assert np.nanmax(drift) < 1e-7


def test_a_body_that_starts_at_rest_has_an_overview():
    torque = ph.BodyTorque([0.0, 0.0, 0.1])
    scene = ph.Scene(ph.Inertia.from_moments(MOMENTS), torque=torque)
    rest = ph.State([1.0, 0, 0, 0], [0.0, 0.0, 0.0])
    page = plot.overview(ph.simulate(scene, rest, [0.0, 1.0, 2.0]))
    assert "Energy [J]" in [ax.get_title("left") for ax in page.axes]


def test_the_band_is_that_of_the_clones_that_are_there(trajectory):
    ts = np.linspace(0, 1, 5)
    omega = np.ones((6, 5, 3)) * np.arange(6)[:, None, None]
    omega[3, 2:] = np.nan
    wxyz = np.broadcast_to([1.0, 0, 0, 0], (6, 5, 4))
    page = plot.overview(plot.samples(ts, omega + 1, wxyz, ph.Inertia.from_moments(MOMENTS)))
    band = page.axes[3].collections[0].get_paths()[0].vertices
    assert np.all(np.isfinite(band))
    assert band[:, 0].max() == pytest.approx(1.0)
