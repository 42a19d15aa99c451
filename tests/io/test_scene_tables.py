"""Tables over time, plates, gyroscopes, clusters and variable inertia of a scene file."""

import os
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode.files import SceneFileError, build_scene, build_state, parse_scene, read_scene

BODY = """
inertia = { moments = [1.0, 1.5, 2.0] }
state = { omega_body = [1.0, 0.0, 0.0] }
times = { stop = 1.0, number = 2 }
"""
ORBIT = """
[orbit]
mu = 3.986e14
semi_major_axis = 6.9e6
"""
PLATES = """
plates = [
  { area = 1.0, normal = [1, 0, 0], centre = [0.5, 0, 0.1] },
  { area = 2.0, normal = [-1, 0, 1], centre = [-0.5, 0, 0.2] },
]
"""
FACES = ph.Plates([1.0, 2.0], [[1.0, 0, 0], [-1.0, 0, 1]], [[0.5, 0, 0.1], [-0.5, 0, 0.2]])
PLANET = ph.KeplerOrbit(3.986e14, 6.9e6)
TURN = ph.Table([0.0, 1.0, 4.0], [0.0, 0.5, 0.25])
TORQUES = {
    'kind = "body"\nn = { times = [0, 1, 3], values = [[0,0,1],[0,1,0],[1,0,0]], order = 1 }': (
        lambda: ph.BodyTorque(
            ph.Table([0.0, 1, 3], [[0.0, 0, 1], [0, 1, 0], [1, 0, 0]], 1, kind="vector")
        )
    ),
    'kind = "space"\nn = { times = [0, 1], values = [[0,0,1],[0,1,0]], unit = "min" }': (
        lambda: ph.SpaceTorque(ph.Table([0.0, 60], [[0.0, 0, 1], [0, 1, 0]]))
    ),
    f'kind = "drag"\ndensity = 1e-11\nvelocity = [7600, 0, 0]{PLATES}': (
        lambda: ph.Drag(FACES, 1e-11, [7600.0, 0, 0])
    ),
    f'kind = "drag"\ndensity = {{ times = [0, 1], values = [1e-11, 2e-11] }}\n'
    f'velocity = [7600, 0, 0]\ncoefficient = [2, 2.5]\nframe = "lvlh"{PLATES}': lambda: (
        ph.RelativeTorque(
            ph.Drag(FACES, ph.Table([0.0, 1], [1e-11, 2e-11]), [7600.0, 0, 0], [2.0, 2.5]),
            ph.LVLH(PLANET),
        )
    ),
    f'kind = "solar-pressure"\ndirection = [0, 1, 0]\nspecular = 0.25{PLATES}': (
        lambda: ph.SolarPressure(FACES, [0.0, 1, 0], specular=0.25)
    ),
    f'kind = "solar-pressure"\ndirection = [0, 1, 0]\neclipse = {{ radius = 6.4e6 }}'
    f"\nspecular = 0.25\ndiffuse = [0.5, 0.25]\npressure = 9e-6{PLATES}": lambda: ph.SolarPressure(
        FACES, [0.0, 1, 0], ph.Eclipse(PLANET, [0.0, 1, 0], 6.4e6), 0.25, [0.5, 0.25], 9e-6
    ),
    'kind = "momentum-dumping"\nk = 0.001\nfield_space = [1e-5, 0, 2e-5]': (
        lambda: ph.MomentumDumping(1e-3, [1e-5, 0, 2e-5])
    ),
    'kind = "momentum-dumping"\nk = 0.001\ndipole_space = [0, 0, -7.8e22]\nmax_moment = 0.5': (
        lambda: ph.MomentumDumping(1e-3, ph.DipoleField([0, 0, -7.8e22]), PLANET, max_moment=0.5)
    ),
    'kind = "control-moment-gyro"\nmomentum = 2\ngimbal = [0, 0, 2]\nspin = [1, 0, 0]\n'
    "angle = { times = [0, 1, 4], values = [0, 0.5, 0.25] }": (
        lambda: ph.ControlMomentGyro(2.0, [0, 0, 1.0], [1.0, 0, 0], TURN)
    ),
}


def numbers_of(part):
    return [np.asarray(x) for x in jax.tree.leaves(part) if isinstance(x, jax.Array | np.ndarray)]


@pytest.mark.parametrize("text", TORQUES, ids=lambda t: re.sub(r"\W+", " ", t)[5:40])
def test_torques_are_those_of_python(text):
    for dtype in (np.float64, np.float32):
        torque = build_scene(parse_scene(f"{BODY}[torque]\n{text}\n{ORBIT}"), dtype).torque
        expected = TORQUES[text]()
        assert {x.dtype for x in numbers_of(torque)} == {np.dtype(dtype)}
        assert type(torque) is type(expected)
        for x, y in zip(numbers_of(torque), numbers_of(expected), strict=True):
            np.testing.assert_allclose(x, y, rtol=8 * np.finfo(dtype).eps)


def test_the_velocity_of_drag_may_be_that_of_the_orbit():
    text = f'[torque]\nkind = "drag"\ndensity = 1e-11\nvelocity = "orbit"{PLATES}{ORBIT}'
    torque = build_scene(parse_scene(BODY + text), np.float64).torque
    # a circular orbit: v = sqrt(mu / a) along y when the position is along x
    np.testing.assert_allclose(
        torque.velocity(jnp.array(0.0)), [0, np.sqrt(3.986e14 / 6.9e6), 0], atol=1e-6
    )


def test_files_of_columns(tmp_path, monkeypatch):
    (tmp_path / "torque.csv").write_text(
        "t, x, y, z\n0, 0, 0, 1\n\n1, 0, 1, 0  # half\n3, 1, 0, 0\n"
    )
    text = f'{BODY}[torque]\nkind = "body"\nn = {{ file = "torque.csv", order = 1 }}\n'
    (tmp_path / "scene.toml").write_text(text)
    torque = build_scene(read_scene(tmp_path / "scene.toml"), np.float64).torque
    np.testing.assert_array_equal(torque.n.times, [0, 1, 3])
    np.testing.assert_array_equal(torque.n.values, [[0, 0, 1], [0, 1, 0], [1, 0, 0]])
    monkeypatch.chdir(tmp_path)  # where the files of a scene from standard input are
    before = os.dup(0)
    try:
        with open("scene.toml") as file:
            os.dup2(file.fileno(), 0)
            assert read_scene("-").columns(read_scene("scene.toml").torque[0].n)[0] == [0, 1, 3]
    finally:
        os.dup2(before, 0)
        os.close(before)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "cannot be read"),
        ("t,x,y,z\n0,0,0,1\n1,0,one,0\n", "line 3"),
        ("0,0,0,1\n1,0,0\n", "3 numbers, got 2, 3"),
        ("0,0,0,1\n0,0,0,1\n", "must ascend"),
        ("0,0,0,1\n1,0,0,nan\n", "not finite"),
        ("t,x,y,z\n", "3 numbers"),
        ("0,0,0,1\n", "two or more rows"),
    ],
)
def test_files_that_are_refused(tmp_path, content, message):
    if content is not None:
        (tmp_path / "n.csv").write_text(content)
    text = f'{BODY}[torque]\nkind = "body"\nn = {{ file = "n.csv" }}\n'
    with pytest.raises(SceneFileError, match=message) as caught:
        parse_scene(text, tmp_path / "scene.toml")
    assert "[torque.n] file" in str(caught.value)


TABLE = "times = [0, 2], values = [[1, 1.5, 2], [1, 1.25, 1.5]]"


def test_variable_inertia():
    text = BODY.replace("moments = [1.0, 1.5, 2.0]", f'table = {{ {TABLE} }}, unit = "g cm^2"')
    text = text.replace("omega_body = [1.0, 0.0, 0.0]", "momentum_body = [0, 3e-7, 0]")
    file = parse_scene(text)
    scene = build_scene(file, np.float64)
    np.testing.assert_allclose(scene.inertia.at(1.0).moments, [1e-7, 1.375e-7, 1.75e-7])
    state = build_state(file, np.float64, scene.inertia)
    np.testing.assert_allclose(state.omega_body, [0, 2, 0])
    wrong = text.replace("[1, 1.25, 1.5]", "[1, 1.25, 2.5]")
    with pytest.raises(SceneFileError, match=r"\[inertia.table\].*\n?.*impossible moments"):
        build_scene(parse_scene(wrong), np.float64)
    rows = "[[1, 0.1, 0, 0.1, 1.5, 0, 0, 0, 2], [1, 0.1, 0, {}, 1.5, 0, 0, 0, 2]]"
    tensors = text.replace("[[1, 1.5, 2], [1, 1.25, 1.5]]", rows)
    scene = build_scene(parse_scene(tensors.replace("{}", "0.1")), np.float64)
    np.testing.assert_allclose(scene.inertia.at(1.0).full[0], [1e-7, 1e-8, 0])
    with pytest.raises(SceneFileError, match=r"not symmetric\n.*row 2"):
        build_scene(parse_scene(tensors.replace("{}", "0.2")), np.float64)


CLUSTER = """
[[rotors]]
axis_body = [1, 0, 0]
inertia = 0.01
momentum = 0.1
[clusters]
axes = [[1, 1, 1], [-1, 1, 1], [-1, -1, 1], [1, -1, 1]]
inertia = 0.001
kp = 0.0
kd = [0.1, 0.2, 0.3]
speed = [1, 2, 3, 4]
max_torque = 0.5
viscous = 1e-5
null_gain = 0.01
"""


@pytest.mark.slow
def test_clusters_exert_the_torque_of_the_law():
    scene = build_scene(parse_scene(BODY + CLUSTER), np.float64)
    assert len(scene.rotors.terms) == 5
    axes = [[1, 1, 1], [-1, 1, 1], [-1, -1, 1], [1, -1, 1]]
    wheels = ph.Rotor([1.0, 0, 0], inertia=0.01, momentum=0.1) + ph.wheel_cluster(
        axes,
        1e-3,
        lambda t, wxyz, omega_body: -jnp.array([0.1, 0.2, 0.3]) * omega_body,
        speed=[1.0, 2, 3, 4],
        max_torque=0.5,
        friction=ph.ViscousCoupling(1e-5),
        null_gain=0.01,
        first=1,
    )
    state = ph.State([1.0, 0, 0, 0], [0.5, -0.25, 1.0])
    ends = [
        ph.simulate(s, state, [0.0, 3.0]).omega_body[-1]
        for s in (scene, ph.Scene(scene.inertia, rotors=wheels))
    ]
    np.testing.assert_allclose(*ends, rtol=1e-9)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('kind = "body"\nn = [0, 1]', "[torque] n"),
        ('kind = "body"\nn = { times = [0, 1], values = [[0, 0, 1]] }', "2 times and 1 values"),
        ('kind = "body"\nn = { times = [1, 0], values = [[0, 0, 1], [0, 0, 1]] }', "ascend"),
        (
            'kind = "body"\nn = { times = [0, 0.5], values = [[0, 0, 1], [0, 0, 1]] }',
            "[torque.n]: a table that does not cover the simulated times",
        ),
        ('kind = "body"\nn = { times = [0, 1], values = [1, 2] }', "[torque.n] values"),
        ('kind = "body"\nn = { values = [[0, 0, 1]] }', "times and values"),
        ('kind = "body"\nn = { file = "../n.csv" }', "leaves the folder"),
        (f'kind = "drag"\ndensity = -1\nvelocity = [1, 0, 0]{PLATES}', "[torque] density"),
        (
            f'kind = "drag"\ndensity = {{ times = [0, 1], values = [1, -999] }}\n'
            f"velocity = [1, 0, 0]{PLATES}",
            "must not be negative, got -999",
        ),
        (f'kind = "drag"\ndensity = 1\nvelocity = "wind"{PLATES}', "[torque] velocity"),
        (f'kind = "drag"\ndensity = 1\nvelocity = "orbit"{PLATES}', "needs an [orbit]"),
        (
            f'kind = "drag"\ndensity = 1\nvelocity = [1, 0, 0]\ncoefficient = [1]{PLATES}',
            "1 numbers for 2 plates",
        ),
        (
            'kind = "drag"\ndensity = 1\nvelocity = [1, 0, 0]\n'
            "plates = [{ area = 1, normal = [0, 0, 0], centre = [0, 0, 0] }]",
            "[torque.plates 1] normal",
        ),
        (f'kind = "solar-pressure"\ndirection = [0, 0, 0]{PLATES}', "direction must not be zero"),
        (f'kind = "solar-pressure"\ndirection = [0, 0, 1]\neclipse = {{}}{PLATES}', "[orbit]"),
        (
            f'kind = "solar-pressure"\ndirection = [0, 0, 1]\nlit = 1\neclipse = {{}}{PLATES}',
            "at most one of lit, eclipse",
        ),
        (
            'kind = "magnetorquer"\nmoment_body = [0, 0, 1]\nfield_space = [1e-5, 0, 0]\n'
            'frame = "lvlh"',
            "[torque] frame",
        ),
        (
            f'kind = "drag"\ndensity = 1\nvelocity = "orbit"\nframe = "lvlh"{PLATES}',
            "known in space axes",
        ),
        (
            f'kind = "solar-pressure"\ndirection = [0, 0, 1]\neclipse = {{}}\nframe = "lvlh"'
            f"{PLATES}",
            "known in space axes",
        ),
        ('kind = "momentum-dumping"\nk = 1', "field_space, dipole_space"),
        (
            'kind = "momentum-dumping"\nk = 1\nfield_space = [0, 0, 1]\nframe = "lvlh"',
            "[torque] frame",
        ),
        (
            'kind = "control-moment-gyro"\nmomentum = 2\ngimbal = [0, 0, 1]\nspin = [0, 0, 1]\n'
            "angle = { times = [0, 1], values = [0, 1] }",
            "normal to the gimbal",
        ),
    ],
)
def test_mistakes_name_their_place(text, words):
    with pytest.raises(SceneFileError) as caught:
        build_scene(parse_scene(f"{BODY}[torque]\n{text}\n"), np.float64)
    assert words in str(caught.value)


def test_mistakes_in_clusters_name_their_place():
    for wrong, words in [
        ("speed = [1, 2]", "2 numbers for 4 wheels"),
        ("inertia = 0", "[clusters] inertia"),
        ("axes = [[1, 0, 0], [0, 1, 0], [1, 1, 0]]\nspeed = 0", "span space"),
    ]:
        key = wrong.partition(" ")[0]
        lines = [
            x for x in CLUSTER.partition("[clusters]")[2].splitlines() if x.partition(" ")[0] != key
        ]
        if "\n" in wrong:
            lines = [x for x in lines if not x.startswith("speed")]
        text = "[clusters]\n" + "\n".join([*lines, wrong])
        with pytest.raises(SceneFileError) as caught:
            build_scene(parse_scene(BODY + text), np.float64)
        assert words in str(caught.value)


@pytest.mark.slow
def test_a_run_with_inertia_from_a_file_keeps_the_momentum(tmp_path, monkeypatch, capsys):
    import xarray

    from polhode.cli import main

    (tmp_path / "deployment.csv").write_text("0,1,1.5,2\n5,1,1.25,1.5\n10,1.5,1.5,1.5\n")
    text = BODY.replace("moments = [1.0, 1.5, 2.0]", 'table = { file = "deployment.csv" }')
    text = text.replace("stop = 1.0, number = 2", "stop = 10.0, number = 11")
    (tmp_path / "boom.toml").write_text(text.replace("[1.0, 0.0, 0.0]", "[0.2, 1.0, 0.3]"))
    monkeypatch.chdir(tmp_path)
    assert main(["run", "boom.toml", "--no-cache"]) == 0
    data = xarray.open_dataset(tmp_path / "boom.nc", engine="h5netcdf", decode_times=False)
    momentum = np.asarray(data["momentum_space"])
    np.testing.assert_allclose(momentum, np.broadcast_to([0.2, 1.5, 0.6], (11, 3)), atol=1e-8)
    np.testing.assert_allclose(np.asarray(data["moments"]), [1, 1.5, 2])
    assert float(np.ptp(np.asarray(data["energy"]))) > 0.01
