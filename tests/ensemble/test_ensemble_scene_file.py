"""The [ensemble] of a scene file: what it draws, what it rejects, and `polhode run`."""

import os
import signal

import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode import ensemble as ens
from polhode.cli import main
from polhode.ensemble import build_ensemble, open_store
from polhode.files import SceneFileError, build_scene, build_state, parse_scene, read_scene

pytest.importorskip("zarr")
xarray = pytest.importorskip("xarray")

SCENE = """
[inertia]
axisymmetric = { transverse = 1.0, axial = 1.5 }
[state]
omega_body = [0.01, 1.0, 0.0]
[times]
stop = 6.0
number = 3
[ensemble]
bodies = 9000
seed = 3
[ensemble.attitude]
any = true
[ensemble.omega_body]
half_width = [0.0, 2.0, 3.0]
unit = "deg/s"
[[ensemble.statistics]]
quantity = "rate"
low = 0
high = 2
"""


def test_draws_in_the_units_of_the_file():
    ensemble, (kept,) = build_ensemble(parse_scene(SCENE), np.float64)
    _, state = ensemble.draw(np.arange(2000))
    away = np.abs(np.asarray(state.omega_body) - [0.01, 1.0, 0.0]).max(axis=0)
    limit = np.radians([0.0, 2.0, 3.0])
    assert np.all(away <= limit * (1 + 1e-9) + 1e-16)
    assert np.all(away >= 0.98 * limit)
    assert (kept.name, kept.low, kept.high, kept.bins) == ("rate", 0.0, 2.0, 100)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("bodies = 9000", "bodies = 0", "greater than or equal to 1"),
        ("bodies = 9000", "clones = 9", "Extra inputs"),
        ("any = true", "any = true\nsigma = 1", "exactly one of"),
        ("half_width = [0.0, 2.0, 3.0]", "half_width = -1", "greater than or equal to 0"),
        ("[ensemble.attitude]\nany = true", "[ensemble.moments]\nrelative_sigma = 1", "not fit"),
        ('quantity = "rate"', 'quantity = "tlt"', "tilt"),
        ("high = 2", "", "both low and high"),
        ("high = 2", "high = -2", "high must be above low"),
        (
            "[[ensemble.statistics]]",
            '[[published]]\nname = "P_psi"\nvalue = 1.0\nsource = ""\n[[ensemble.statistics]]',
            "published.* has no use in an",
        ),
    ],
)
def test_mistakes_are_named(old, new, words):
    assert old in SCENE
    with pytest.raises(SceneFileError, match=words):
        parse_scene(SCENE.replace(old, new))


ARRAYS = """
[inertia]
moments = [1.0, 2.0, 2.5]
[state]
omega_body = [0.01, 1.0, 0.0]
[times]
stop = 6.0
number = 3
[torque]
kind = "body"
n = [0.0, 0.0, 0.1]
[ensemble]
bodies = 50
seed = 3
[ensemble.torque]
half_width = 0.05
[ensemble.arrays]
moments = "moments.npy"
omega_body = "omega.npy"
"""


def test_rows_of_files_and_torques(tmp_path):
    numbers = np.random.default_rng(1)
    moments = numbers.uniform(1.0, 1.9, (50, 3)).astype(np.float32)
    omega = numbers.normal(size=(50, 3))
    np.save(tmp_path / "moments.npy", moments)
    np.save(tmp_path / "omega.npy", omega)
    scene = tmp_path / "rows.toml"
    ensemble, _ = build_ensemble(parse_scene(ARRAYS, scene), np.float64)
    some = np.array([49, 7])
    drawn, state = ensemble.draw(some)
    np.testing.assert_array_equal(drawn.inertia.moments, moments[some])
    np.testing.assert_array_equal(state.omega_body, omega[some])
    away = np.asarray(ensemble.draw(np.arange(50))[0].torque.n) - [0.0, 0.0, 0.1]
    assert np.all(np.abs(away) <= 0.05)
    assert np.all(np.abs(away).max(axis=0) > 0.04)
    moments[7] = [1.0, 1.0, 2.5]
    np.save(tmp_path / "moments.npy", moments)
    with pytest.raises(SceneFileError, match="row 7"):
        parse_scene(ARRAYS, scene)
    np.save(tmp_path / "moments.npy", moments[:-1])
    with pytest.raises(SceneFileError, match="50 x 3 numbers"):
        parse_scene(ARRAYS, scene)
    with pytest.raises(SceneFileError, match=r"nothing\.npy"):
        parse_scene(ARRAYS.replace("moments.npy", "nothing.npy"), scene)
    with pytest.raises(SceneFileError, match="given twice"):
        parse_scene(SCENE + '[ensemble.arrays]\nwxyz = "omega.npy"', scene)
    orbit = "[orbit]\nmu = 4e14\nsemi_major_axis = 7e6\n[ensemble]"
    for text in (
        SCENE + "[ensemble.torque]\nsigma = 1.0",
        ARRAYS.replace(
            "n = [0.0, 0.0, 0.1]", "n = { times = [0, 9], values = [[0, 0, 1], [0, 1, 0]] }"
        ),
        ARRAYS.replace('"body"', '"body"\nframe = "lvlh"').replace("[ensemble]", orbit, 1),
    ):
        with pytest.raises(SceneFileError, match=r"\[ensemble\] torque.*one .torque. of kind"):
            parse_scene(text, scene)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--part", "0/2"], "is not I/N"),
        (["--part", "3/2"], "is not I/N"),
        (["--part", "1"], "is not I/N"),
        (["--seed", "5"], "[ensemble] seed"),
        (["--clones", "5"], "write `bodies = 5`"),
        (["--chunk", "1"], "--chunk 8192 or a multiple"),
        (["--memory", "1kB"], "raise --memory to"),
        (["--chunk", "1000"], "multiple of the block of 8192"),
        (["--memory", "100MB"], "too small"),
        (["--devices", "99"], "--devices 99: this machine has"),
    ],
)
def test_bad_options_change_nothing(options, words, tmp_path, capsys):
    scene = tmp_path / "big.toml"
    scene.write_text(SCENE)
    try:
        code = main(["run", str(scene), "-o", str(tmp_path / "big.zarr"), *options])
    except SystemExit as ended:  # options that typer rejects
        code = ended.code
    assert code == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "big.zarr").exists()


def test_no_place_to_write(tmp_path, capsys):
    scene = tmp_path / "big.toml"
    scene.write_text(SCENE)
    (tmp_path / "file").write_text("keep")
    assert main(["run", str(scene), "-o", str(tmp_path / "file" / "big.zarr")]) == 1
    assert "cannot make the store" in capsys.readouterr().err
    assert (tmp_path / "file").read_text() == "keep"


def test_parts_say_what_is_missing(tmp_path, capsys):
    scene = tmp_path / "big.toml"
    scene.write_text(SCENE)
    command = ["run", str(scene), "-o", str(tmp_path / "big.zarr"), "--chunk", "8192"]
    assert main([*command, "--part", "2/2"]) == 0
    told = capsys.readouterr().out
    assert "808 bodies (0 from before)" in told
    assert "part 2 of 2 is complete; 1 of 2 chunks is missing (0)" in told
    assert main([*command, "--part", "1/2"]) == 0
    assert "part 1 of 2 is complete; no chunk is missing" in capsys.readouterr().out
    assert main(command) == 0
    assert "9,000 bodies (9,000 from before), nothing was missing" in capsys.readouterr().out
    with open_store(tmp_path / "big.zarr") as data:
        assert data.rate_summary_count.values.tolist() == [9000] * 3


def test_run_writes_resumes_and_refuses(tmp_path, capsys):
    scene = tmp_path / "big.toml"
    scene.write_text(SCENE)
    store = tmp_path / "out" / "big.zarr"
    command = ["run", str(scene), "-o", str(store), "--memory", "2GB"]
    assert main(command) == 0
    with xarray.open_zarr(store) as data:
        assert data.attrs["scene"] == SCENE
        assert data.wxyz.shape == (9000, 3, 4)
        assert data.rate_summary_count.values.tolist() == [9000] * 3
        rates = np.linalg.norm(data.omega_body.values, axis=-1)
        np.testing.assert_allclose(data.rate_summary_mean, rates.mean(axis=0), rtol=1e-12)
    assert main(command) == 0
    assert "9,000 from before" in capsys.readouterr().out
    scene.write_text(SCENE.replace("seed = 3", "seed = 4"))
    assert main(command) == 1
    told = capsys.readouterr().err
    assert "seed: the store has 3, this run 4" in told
    assert "scene: line 11 of the store is 'seed = 3', of this run 'seed = 4'" in told
    plain = tmp_path / "plain.toml"
    plain.write_text(SCENE[: SCENE.index("[ensemble]")])
    assert main(["run", str(plain), "--part", "1/2"]) == 2
    assert "--part on the command line" in capsys.readouterr().err


def test_heavy_tops_on_their_axis_follow_the_closed_form():
    """The method of an ensemble depends on types only, so the scene must declare the symmetry."""
    import jax

    import polhode as ph
    from polhode.ensemble._stream import Block

    gravity = '[potential]\nkind = "uniform-gravity"\nmass = 1.0\ncentre_body = [0, 0, 0.1]\n'
    for text, kind in ((gravity, ph.LagrangeTop), (gravity.replace("[0,", "[0.1,"), ph.LiePoisson)):
        ensemble, _ = build_ensemble(parse_scene(SCENE + text), np.float64)
        block = Block(ensemble, [0.0, 1.0], None, None, True, (), jax.devices()[:1])
        assert isinstance(block.method, kind)


BODY = ph.Inertia.from_moments([1.0, 1.5, 2.2])
TURNING = ph.State([1.0, 0.2, 0.1, 0.3], [0.6, 1.1, -0.4])


def test_spread_moments_keep_the_principal_axes():
    tensor = np.array([[1.5, 0.3, 0.1], [0.3, 1.7, 0.2], [0.1, 0.2, 2.2]])
    scene = ph.Scene(ph.Inertia.from_tensor(tensor))
    narrow = ens.SpreadMoments(ens.Deviate(jnp.full(3, 1e-9)))
    moments = np.tile(scene.inertia.moments, (2, 1))
    of_rows = ens.Ensemble(scene, TURNING, 2, rows={"moments": moments})
    for ensemble in (ens.Ensemble(scene, TURNING, 2, (narrow,)), of_rows):
        drawn, _ = ensemble.draw(np.arange(2))
        np.testing.assert_allclose(drawn.inertia.tensor, [tensor, tensor], atol=1e-7)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_says_how_it_goes_on(number, tmp_path, monkeypatch, capsys):
    """The store already contains chunks: "no file was changed" would be wrong."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "s.toml").write_text(SCENE)
    monkeypatch.setattr(ens, "stream", lambda *_, **__: os.kill(os.getpid(), number))
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        code = main(["run", "s.toml"])
    except SystemExit as ended:
        code = ended.code
    finally:
        signal.signal(signal.SIGINT, before)
    assert code == 128 + number
    assert "ed; the same command finishes what is missing" in capsys.readouterr().err


def test_rows_are_moved_by_the_method_that_the_planner_chooses(tmp_path):
    rates = np.array([[0.1, 1.0, 0.2], [0.3, 0.2, 0.9]])
    ensemble = ens.Ensemble(ph.Scene(BODY), TURNING, 2, rows={"omega_body": rates})
    path = ens.stream(ensemble, [0.0, 1.0], tmp_path / "rows.zarr")
    with ens.open_store(path) as stored:
        moved = ph.simulate(ph.Scene(BODY), ph.State(TURNING.wxyz, rates), [0.0, 1.0])
        np.testing.assert_allclose(stored.omega_body, moved.omega_body, rtol=1e-13)


@pytest.mark.parametrize("loose", [{}, {"torque": 0.1}])
def test_a_momentum_includes_that_of_the_wheels(loose, tmp_path):
    wheels = ph.Rotor([0.0, 0.6, 0.8], inertia=0.1, speed=20.0, **loose)
    wheels = wheels + ph.Rotor([1.0, 0.0, 0.0], momentum=0.4)
    rows = {"momentum_body": np.array([[0.6, 1.0, 3.0]] * 2)}
    drawn = ens.Ensemble(ph.Scene(BODY, rotors=wheels), TURNING, 2, rows=rows).draw(np.arange(2))
    momentum = ph.simulate(*drawn, [0.0, 1.0]).momentum_body[:, 0]
    np.testing.assert_allclose(momentum, rows["momentum_body"], rtol=1e-13)
    file = tmp_path / "wheel.toml"
    torque = "torque = 0.1" if loose else ""
    file.write_text(
        "inertia.moments = [1.0, 1.5, 2.2]\nstate.momentum_body = [0.6, 1.0, 3.0]\n"
        "times = { stop = 5.0, number = 3 }\n"
        f"[[rotors]]\naxis_body = [0, 0.6, 0.8]\ninertia = 0.1\nspeed = 20.0\n{torque}\n"
    )
    scene_file = read_scene(file)
    scene = build_scene(scene_file, float)
    state = build_state(scene_file, float, scene.inertia)
    found = ph.simulate(scene, state, [0.0, 1.0]).momentum_body[0]
    np.testing.assert_allclose(found, [0.6, 1.0, 3.0], rtol=1e-13)


def test_the_method_is_that_of_the_bodies_drawn(tmp_path):
    """A symmetric top whose moments are spread has three different moments."""
    scene = ph.Scene(ph.Inertia.axisymmetric(1.0, 0.5), ph.UniformGravity.axial(1.0, 0.3))
    spread = ens.SpreadMoments(ens.Deviate(jnp.full(3, 0.02)))
    ensemble = ens.Ensemble(scene, TURNING, 4, (spread,))
    ens.stream(ensemble, jnp.linspace(0, 5, 3), tmp_path / "s.zarr", name="tops")
    assert not ens.open_store(tmp_path / "s.zarr").status.values.any()


@pytest.mark.slow
def test_explain_names_the_method_of_a_block(tmp_path, capsys):
    """Few bodies with a torque take other steps than many."""
    (tmp_path / "s.toml").write_text(SCENE + '[[torque]]\nkind = "linear-damping"\nc = 0.1\n')
    assert main(["explain", str(tmp_path / "s.toml")]) == 0
    text = capsys.readouterr().out
    assert "an ensemble of 9,000 bodies, seed 3, in blocks:" in text
    assert "8,192 bodies x 3 samples" in text
    assert "extrapolated midpoint rule" in text
