"""Orbits, wheels, control laws, pulses and events of a scene file equal those built in Python."""

import re
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode.files import SceneFileError, build_events, build_scene, build_state, parse_scene

BODY = """
inertia = { moments = [1.0, 1.5, 2.0] }
state = { omega_body = [1.0, 0.0, 0.0] }
times = { stop = 1.0, number = 2 }
"""
ORBIT = """[orbit]
mu = 3.986e14
semi_major_axis = 6.9e6
eccentricity = 0.01
inclination = 90
mean_anomaly = 180
unit = "deg"
"""
HALF = np.pi / 2


def orbit():
    return ph.KeplerOrbit(3.986e14, 6.9e6, 0.01, inclination=HALF, mean_anomaly=np.pi)


def lvlh(torque):
    return ph.RelativeTorque(torque, ph.LVLH(orbit()))


TORQUES = {
    'kind = "quadratic-damping"\nc = 0.1': lambda: ph.QuadraticDamping([0.1] * 3),
    'kind = "linear-damping"\nc = [0.1, 0.2, 0.3]\nframe = "lvlh"': lambda: lvlh(
        ph.LinearDamping([0.1, 0.2, 0.3])
    ),
    'kind = "energy-sink"\nk = 0.5': lambda: ph.EnergySink(0.5),
    'kind = "rate-damping"\nc = 2\nrates = [0, 0, 1.5]': lambda: ph.RateDamping(
        [2.0] * 3, [0, 0, 1.5]
    ),
    'kind = "pointing"\nkp = 1\nkd = [2, 3, 4]': lambda: ph.Pointing([1.0] * 3, [2.0, 3.0, 4.0]),
    'kind = "pointing"\nkp = 1\nkd = 2\nwxyz = [1, 0, 0, 1]\nframe = "lvlh"': lambda: lvlh(
        ph.Pointing([1.0] * 3, [2.0] * 3, ph.rotation.normalise(jnp.array([1.0, 0, 0, 1])))
    ),
    'kind = "magnetorquer"\nmoment_body = [0, 0, 1]\nfield_space = [1e-5, 0, 0]': lambda: (
        ph.MagneticDipole([0.0, 0, 1], [1e-5, 0.0, 0])
    ),
    'kind = "magnetorquer"\nb_dot = { k = 4, max_moment = 2 }\ndipole_space = [0, 0, -7.8e22]': (
        lambda: ph.MagneticDipole(
            ph.BDot(4.0, max_moment=2.0), ph.DipoleField([0, 0, -7.8e22]), orbit()
        )
    ),
    'kind = "pulses"\nn = [0, 0, 2]\nstarts = [0.25, 0.5]\nends = [0.375, 0.75]': lambda: ph.Pulses(
        ph.BodyTorque([0.0, 0, 2]), [0.25, 0.5], [0.375, 0.75]
    ),
    'kind = "pulses"\nn = [0, 0, 2]\naxes = "space"\nstarts = [0]\nends = [1]': lambda: ph.Pulses(
        ph.SpaceTorque([0.0, 0, 2]), [0.0], [1.0]
    ),
}


def same(a, b):
    """Equal except for the weak types of Python numbers."""
    pairs = zip(_leaves(a), _leaves(b), strict=True)
    return type(a) is type(b) and all(np.array_equal(x, y) for x, y in pairs)


def _leaves(x):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(x) if eqx.is_array_like(leaf)]


@pytest.mark.parametrize("text", TORQUES, ids=lambda t: re.sub(r"\W+", " ", t)[5:40])
def test_torques_are_those_of_python(text):
    for dtype in (np.float64, np.float32):
        torque = build_scene(parse_scene(f"{BODY}[torque]\n{text}\n{ORBIT}"), dtype).torque
        assert {leaf.dtype for leaf in _leaves(torque)} == {np.dtype(dtype)}
        if dtype == np.float64:
            assert same(torque, TORQUES[text]())


def test_orbits_wheels_and_states_are_those_of_python():
    text = """
    potential = { kind = "gravity-gradient" }
    [[rotors]]
    axis_body = [0, 0, 2]
    inertia = 0.5
    speed = 3.0
    viscous = 1e-4
    coulomb = { torque = 0.25, speed = 0.5 }
    motor = { command = 0.125, max_torque = 0.5, max_speed = 100 }
    """
    body = BODY.replace("state = {", 'state = { frame = "lvlh", wxyz = [1, 1, 0, 0],')
    file = parse_scene(body + text + ORBIT)
    scene = build_scene(file, np.float64)
    assert same(scene.potential, ph.GravityGradient(3.986e14, orbit()))
    coupling = ph.ViscousCoupling(1e-4) + ph.CoulombFriction(0.25, 0.5) + ph.Motor(0.125, 0.5, 100)
    wheel = ph.Rotor.axial(inertia=0.5, speed=3.0, coupling=coupling)
    assert same(scene.rotors, wheel)
    state = build_state(file, np.float64, scene.inertia)
    wxyz = ph.rotation.normalise(jnp.array([1.0, 1, 0, 0]))
    expected = ph.State(*ph.LVLH(orbit()).from_frame(wxyz, [1.0, 0, 0], 0.0))
    np.testing.assert_allclose(state.wxyz, expected.wxyz, atol=1e-15)
    np.testing.assert_allclose(state.omega_body, expected.omega_body, atol=1e-15)
    place = "[orbit]\nmu = 1.0\nposition = [1, 0, 0]\nvelocity = [0, 1, 0]\nepoch = 2.0\n"
    found = build_scene(parse_scene(BODY + text + place), np.float64).potential
    through = ph.KeplerOrbit.from_state(1.0, [1.0, 0, 0], [0, 1.0, 0], 2.0)
    assert same(found, ph.GravityGradient(1.0, through))


def test_steps_between_samples():
    seconds = parse_scene(BODY.replace("number = 2", "step = 0.1")).times.seconds
    np.testing.assert_allclose(seconds, np.linspace(0, 1, 11), atol=1e-15)
    back = BODY.replace("stop = 1.0, number = 2", 'start = 1, stop = 0, step = 0.3, unit = "min"')
    np.testing.assert_allclose(parse_scene(back).times.seconds, [60, 42, 24, 6])


EVENTS = """
[[events]]
name = "level"
axis_body = [0, 1, 0]
direction_space = [0, 0, 1]
angle = 60
unit = "deg"
crossing = "rising"
[[events]]
name = "fast"
rate = 45
unit = "deg/s"
"""


@pytest.mark.slow  # faster: events, tests/test_events
def test_events_are_at_the_times_at_which_they_are(tmp_path, monkeypatch, capsys):
    """A ball rotates about x at 0.5 rad/s: its y axis is cos(t/2) along space y and sin(t/2) along
    space z, so that the angle to space z rises through 60 degrees when t/2 = 150 degrees.
    """
    import xarray

    from polhode.cli import main

    text = """
    inertia = { spherical = 2.0 }
    state = { omega_body = [0.5, 0.0, 0.0] }
    times = { stop = 20.0, number = 3 }
    [monte_carlo]
    clones = 2
    seed = 1
    attitude = { sigma = [0.1, 0, 0], source = "test" }
    """
    monkeypatch.chdir(tmp_path)
    Path("ball.toml").write_text(text + EVENTS)
    assert main(["run", "ball.toml", "--no-figure"]) == 0
    told = capsys.readouterr().out
    assert "event level: first [s] (number)" in told
    assert "5.2360 (2)" in told
    assert "none" in told
    with xarray.open_dataset("ball.nc", engine="h5netcdf") as data:
        assert data.level_times.dims == ("clone", "level_crossing")
        expected = np.array([5, 17]) * np.pi / 3
        np.testing.assert_allclose(data.level_times[0], expected, rtol=1e-12)
        assert data.fast_times.shape == (3, 0)
    events = build_events(parse_scene(text + EVENTS), np.float64)
    assert [event.direction for event in events.values()] == [-1, 0]


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        ('potential = { kind = "gravity-gradient" }', "[potential 1] needs an [orbit]"),
        ('potential = { kind = "gravity-gradient", mu = 1 }', "both mu and position_space"),
        ('torque = { kind = "body", n = [0, 0, 1], frame = "lvlh" }', "[torque 1] needs an"),
        ('torque = { kind = "magnetorquer" }', "exactly one of moment_body, b_dot"),
        ('torque = { kind = "pointing", kp = -1, kd = 1 }', "greater than or equal to 0"),
        ('torque = { kind = "pulses", n = [0, 0, 1], starts = [1], ends = [1] }', "after its"),
        ('torque = { kind = "pulses", n = [0, 0, 1], starts = [1], ends = [] }', "at least 1 item"),
        ("rotors = { axis_body = [0, 0, 0], speed = 1 }", "not all be zero"),
        ("orbit = { mu = -1, semi_major_axis = 1 }", "greater than 0"),
        ("orbit = { mu = 1, position = [1, 0, 0] }", "given together"),
        ("events = [{ name = 'a b', rate = 1 }]", "pattern"),
        ("events = [{ name = 'a', angle = 1 }]", "needs axis_body"),
        ("events = [{ name = 'a', rate = 1, unit = 'deg' }]", "does not fit"),
        ("events = [{ name = 'a', rate = 1 }, { name = 'a', rate = 2 }]", "a name twice"),
        ("rotors = [" + "{ axis_body = [0, 0, 1], speed = 1 }," * 101 + "]", "at most 100 items"),
    ],
)
def test_mistakes_are_named(text, hint):
    with pytest.raises(SceneFileError) as caught:
        parse_scene(BODY + text)
    assert hint in str(caught.value)


def test_numbers_that_a_constructor_refuses_name_the_table():
    text = "[orbit]\nmu = 1\nsemi_major_axis = 1\neccentricity = 1.0\n"
    with pytest.raises(SceneFileError, match=r"\[orbit\].*eccentricity must lie in"):
        build_scene(parse_scene(BODY + text), np.float64)


def test_the_scenes_of_the_page_build():
    page = (Path(__file__).parents[2] / "docs" / "scene_files.md").read_text()
    scenes = re.findall(r"^```toml\n(.*?)^```", page, re.S | re.M)
    assert len(scenes) == 2
    for text in scenes:
        file = parse_scene(text)
        build_state(file, np.float64, build_scene(file, np.float64).inertia)
