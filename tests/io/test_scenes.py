"""The included scenes can be read and built in both dtypes, and agree with their stated values."""

from pathlib import Path

import jax
import numpy as np
import pytest

from polhode.files import build_scene, build_state, draw_clones, read_scene, shipped_scenes

SCENES = shipped_scenes()
CHECKOUT = Path(__file__).parents[2] / "scenes"


def test_there_are_scenes():
    assert len(SCENES) >= 5


@pytest.mark.skipif(not CHECKOUT.exists(), reason="source archives hold the files in src only")
def test_a_checkout_has_them_in_a_folder_of_its_own():
    assert {path.stem: path.resolve() for path in CHECKOUT.glob("*.toml")} == SCENES


@pytest.mark.parametrize("path", SCENES.values(), ids=SCENES)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_scene_builds(path, dtype):
    file = read_scene(path)
    scene = build_scene(file, dtype)
    state = build_state(file, dtype, scene.inertia)
    assert scene.inertia.dtype == state.wxyz.dtype == state.omega_body.dtype == dtype
    with jax.enable_x64(dtype is np.float64):  # the default is the precision of JAX
        default = build_scene(file), build_state(file)
    assert default[1].wxyz.dtype == dtype
    jax.tree.map(np.testing.assert_array_equal, default, (scene, state))
    np.testing.assert_allclose(np.linalg.norm(state.wxyz), 1, rtol=1e-6)
    assert file.source
    if file.monte_carlo is not None:
        assert all(spread.source for spread in file.monte_carlo.spreads.values())


def test_wing_nut_spins_about_its_intermediate_axis():
    file = read_scene(SCENES["wing_nut"])
    inertia = build_scene(file, np.float64).inertia
    along_spin = np.asarray(inertia.tensor)[0, 0]
    smallest, middle, largest = np.sort(inertia.moments)
    assert smallest < middle < largest
    np.testing.assert_allclose(along_spin, middle, rtol=1e-12)


def test_clones_are_drawn_as_the_file_says():
    file = read_scene(SCENES["toutatis"])
    clones = draw_clones(file, np.float64)
    again = draw_clones(file, np.float64)
    assert clones.redrawn == 0
    moments, omega = np.asarray(clones.inertia.moments), np.asarray(clones.state.omega_body)
    np.testing.assert_array_equal(moments, again.inertia.moments)
    assert moments.shape == omega.shape == (1001, 3)
    np.testing.assert_array_equal(moments[0], [3.0836, 3.235, 1.0])
    np.testing.assert_array_equal(moments[:, 2], 1.0)
    np.testing.assert_array_equal(omega[0], file.state.value)
    # mean and spread of 1000 draws, five standard errors wide
    relative = moments[1:, :2] / moments[0, :2] - 1
    assert np.abs(relative.mean(axis=0)).max() < 5 * 0.01 / np.sqrt(1000)
    np.testing.assert_allclose(relative.std(axis=0), 0.01, rtol=5 / np.sqrt(2000))
    rates = np.rad2deg(omega[1:] - omega[0]) * 86400
    np.testing.assert_allclose(rates.std(axis=0), 0.08, rtol=5 / np.sqrt(2000))
    # independent streams: no correlation between quantities
    assert abs(np.corrcoef(relative[:, 0], rates[:, 0])[0, 1]) < 5 / np.sqrt(1000)
    # the same draws in float32, and unchanged if another spread is removed
    single = draw_clones(file, np.float32)
    np.testing.assert_allclose(single.inertia.moments, moments, rtol=1e-6)


def test_impossible_moments_are_drawn_again_or_refused(tmp_path):
    from polhode.files import SceneFileError, parse_scene

    text = """
    inertia = { moments = [1.0, 1.0, 1.99] }
    state = { omega_body = [1.0, 0.0, 0.0] }
    times = { stop = 1.0, number = 2 }
    monte_carlo = { clones = 500, seed = 2, moments = { relative_sigma = SIZE, source = "test" } }
    """
    clones = draw_clones(parse_scene(text.replace("SIZE", "0.1")), np.float64)
    moments = np.asarray(clones.inertia.moments)
    assert moments.shape == (501, 3)
    stream = np.random.default_rng([2, int.from_bytes(b"moments", "big")])
    draws = [1.0, 1.0, 1.99] * (1 + 0.1 * stream.standard_normal((2000, 3)))
    good = (draws.min(axis=1) > 0) & (2 * draws.max(axis=1) <= draws.sum(axis=1))
    assert clones.redrawn == np.flatnonzero(good)[499] + 1 - 500 > 100
    assert (2 * moments.max(axis=1) <= moments.sum(axis=1)).all()
    with pytest.raises(SceneFileError, match="make relative_sigma smaller"):
        draw_clones(parse_scene(text.replace("SIZE", "[0, 0, 1e9]")), np.float64)
    with pytest.raises(SceneFileError, match="triangle inequality"):
        draw_clones(parse_scene(text.replace("1.99", "2.5").replace("SIZE", "0.1")), np.float64)


def test_everything_that_acts_is_built_and_adds_up():
    import polhode as ph
    from polhode.files import parse_scene

    text = """
    inertia = { moments = [1.0, 1.5, 2.0] }
    state = { omega_body = [1.0, 0.0, 0.0] }
    times = { stop = 1.0, number = 2 }
    [[potential]]
    kind = "uniform-gravity"
    mass = 2.0
    centre_body = [0.0, 0.0, 0.1]
    [[potential]]
    kind = "gravity-gradient"
    mu = 3.0
    position_space = [5.0, 0.0, 0.0]
    [[torque]]
    kind = "body"
    n = [0.1, 0.0, 0.0]
    [[torque]]
    kind = "space"
    n = [0.0, 0.2, 0.0]
    [[torque]]
    kind = "linear-damping"
    c = [0.01, 0.02, 0.03]
    [[rotors]]
    axis_body = [0.0, 0.0, 2.0]
    inertia = 0.1
    speed = 7.0
    [[rotors]]
    axis_body = [1.0, 0.0, 0.0]
    momentum = 0.3
    """
    for dtype in (np.float32, np.float64):
        scene = build_scene(parse_scene(text), dtype)
        gravity, gradient = scene.potential.terms
        np.testing.assert_allclose(gravity.gravity_space, [0, 0, -9.80665], rtol=1e-7)
        np.testing.assert_array_equal(gradient.position_space, [5, 0, 0])
        names = [type(term).__name__ for term in scene.torque.terms]
        assert names == ["BodyTorque", "SpaceTorque", "LinearDamping"]
        wheel, flywheel = scene.rotors.terms
        np.testing.assert_array_equal(gravity.centre, np.array([0, 0, 0.1], dtype))
        np.testing.assert_array_equal(wheel.direction, [0, 0, 1])
        # an ensemble uses the closed form that its scene file declares
        assert gravity.distance is not None
        assert (wheel.axis, flywheel.axis) == (2, 0)
        assert float(wheel.speed) == 7
        np.testing.assert_allclose(flywheel.momentum, 0.3, rtol=1e-7)
        made = {x.dtype for x in (gravity.gravity_space, wheel.speed, scene.torque.terms[2].c)}
        assert made == {np.dtype(dtype)}
    assert isinstance(scene, ph.Scene)
