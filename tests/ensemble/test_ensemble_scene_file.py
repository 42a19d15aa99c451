"""The [ensemble] of a scene file: what it draws, what it refuses, and `polhode run` of it."""

import numpy as np
import pytest

from polhode.cli import main
from polhode.ensemble import build_ensemble
from polhode.io import SceneFileError, parse_scene

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
        ("bodies = 9000", "bodies = 0", "whole number from 1"),
        ("bodies = 9000", "clones = 9", "unknown key"),
        ("any = true", "any = true\nsigma = 1", "too many choices"),
        ("half_width = [0.0, 2.0, 3.0]", "half_width = -1", "not a spread"),
        ("[ensemble.attitude]\nany = true", "[ensemble.moments]\nrelative_sigma = 1", "not fit"),
        ('quantity = "rate"', 'quantity = "tlt"', "tilt"),
        ("high = 2", "", "half a range"),
        ("high = 2", "high = -2", "not above low"),
    ],
)
def test_mistakes_are_named(old, new, words):
    assert old in SCENE
    with pytest.raises(SceneFileError, match=words):
        parse_scene(SCENE.replace(old, new))


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
    assert "seed: the store has 3, this run 4" in capsys.readouterr().err
    plain = tmp_path / "plain.toml"
    plain.write_text(SCENE[: SCENE.index("[ensemble]")])
    assert main(["run", str(plain), "--processes", "2"]) == 2
    assert "--processes on the command line" in capsys.readouterr().err
