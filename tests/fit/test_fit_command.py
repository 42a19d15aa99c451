"""``polhode fit``: from a recording to a table, numbers and a figure; errors for bad files."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from polhode.cli import main
from polhode.fit import SteppedMotion
from polhode.fit._numerics import compiled


@pytest.fixture
def toss(tmp_path):
    """A long box that tumbles freely, by small Runge-Kutta steps, in deg/s, with noise and gap."""
    moments = np.array([1.0, 2.6, 3.2])
    rng = np.random.default_rng(5)

    def field(w):
        return np.cross(moments * w, w) / moments

    rows, w, h = [], np.array([1.0, 9.0, 0.5]), 1e-3
    for k in range(1001):
        if k % 10 == 0:
            rows.append([k * h, *(np.degrees(w) + rng.normal(size=3))])
        k1 = field(w)
        k2 = field(w + h / 2 * k1)
        k3 = field(w + h / 2 * k2)
        w = w + h / 6 * (k1 + 2 * k2 + 2 * k3 + field(w + h * k3))
    lines = ["time,p,q,r", *(",".join(f"{x:.6g}" for x in row) for row in rows)]
    lines[30] = lines[30].rsplit(",", 1)[0] + ","
    path = tmp_path / "toss.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


NAMES = ["--columns", "t=time", "wx=p", "wy=q", "wz=r"]


def test_a_recording_becomes_numbers_and_a_figure(toss, tmp_path, capsys):
    output = tmp_path / "new" / "result"
    noise = ["--degrees", "--noise", str(np.radians(1.0))]
    assert main(["fit", str(toss), *NAMES, *noise, "--bias", "-o", str(output)]) == 0
    printed = capsys.readouterr().out
    assert "smallest" in printed
    assert "Only ratios" in printed
    assert output.with_suffix(".png").read_bytes()[:4] == b"\x89PNG"
    found = json.loads(output.with_suffix(".json").read_text())
    assert found["samples"] == 100
    assert found["gaps"] == 1
    assert found["moments_std"] == [None] * 3
    off = (np.array(found["ratios"]) - [1 / 3.2, 2.6 / 3.2, 1])[:2]
    assert np.all(np.abs(off) < 4 * np.array(found["ratios_std"][:2]))
    assert np.all(np.array(found["ratios_std"][:2]) < 0.01)
    assert "step limit" not in found["findings"]
    assert "bias of the gyroscope" in printed
    assert "t = time, wx = p" in printed
    bias, spread = np.array(found["bias_rad_per_s"]), np.array(found["bias_std_rad_per_s"])
    assert np.all(np.abs(bias) < 5 * spread)
    assert np.all(spread < 0.05)
    assert "what this recording can show" in printed
    assert f"- limited by {found['limit']}" in printed.replace("\n", " ")
    assert found["options"]["calibration"] == 0.01
    assert np.shape(found["gyroscope_gain"]) == (3, 3)
    sources = {row["quantity"]: row["source"] for row in found["observability"]}
    assert sources["rotation of the gyroscope (3)"] == "calibration"
    assert "NaN" not in output.with_suffix(".json").read_text()


@pytest.mark.slow  # faster: the command, the test above
def test_a_recording_that_shows_nothing_ends_with_an_error(tmp_path, capsys):
    path = tmp_path / "still.csv"
    path.write_text("t,wx,wy,wz\n" + "".join(f"{k / 100},0,0,0\n" for k in range(60)))
    command = ["fit", str(path), "--moments-only", "--no-figure", "-o", str(tmp_path / "out")]
    assert main(command) == 1
    told = capsys.readouterr()
    assert "--allow-undetermined" in told.err
    assert "given" in told.out
    json.loads((tmp_path / "out.json").read_text(), parse_constant=lambda word: 1 / 0)
    assert main([*command, "--allow-undetermined"]) == 0


@pytest.mark.slow  # compiles for half a minute
def test_a_wheel_shows_the_size(tmp_path, capsys):
    """A wheel along the y axis that accelerates uniformly."""
    times = np.linspace(0, 2, 101)
    moments = np.array([2e-4, 3e-4, 3.5e-4])
    flight = SteppedMotion(1e-6, (0.0, 1.0, 0.0), steps=4)
    start, unknown = np.array([3.0, 1.0, 4.0]), {"drag": None, "delay": None}
    rates = np.asarray(flight(np.diag(moments), start, None, times, 500 * times, unknown).omega)
    rates = rates + 1e-3 * np.random.default_rng(1).normal(size=rates.shape)
    table = np.column_stack([times, rates, 500 * times])
    path, out = tmp_path / "wheel.csv", tmp_path / "out"
    rows = [",".join(repr(float(x)) for x in row) for row in table]
    path.write_text("\n".join(["t,wx,wy,wz,wheel", *rows]) + "\n")
    options = "--columns wheel=wheel --wheel-inertia 1e-6 --wheel-axis 0 2 0 --calibration 0 --drag"
    command = ["fit", str(path), *options.split(), "--noise", "1e-3", "--no-figure"]
    assert main([*command, "-o", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "moment [kg m^2]" in printed
    assert "drag, N m s, N m s^2: linear" in printed
    found = json.loads(out.with_suffix(".json").read_text())
    off = (np.array(found["moments"]) - moments) / np.array(found["moments_std"])
    assert np.abs(off).max() < 4
    for name in ("linear", "quadratic"):  # there is no drag
        assert abs(found["drag"][name]) < 4 * found["drag_std"][name] < 1e-4
    assert np.all(np.array(found["moments_std"]) < 0.05 * moments)


def test_wrong_units_are_suspected(toss, capsys):
    assert main(["fit", str(toss), *NAMES]) == 2
    assert "See --degrees" in capsys.readouterr().err


def test_missing_columns_are_to_be_named_whatever_the_others_are_called(tmp_path, capsys):
    rows = ["clock,gyro_x [deg/s],wy -> deg/s,gyro_z [deg/s]", *["0,0,0,0"] * 5]
    (tmp_path / "toss.csv").write_text("\n".join(rows))
    assert main(["fit", str(tmp_path / "toss.csv")]) == 2
    assert capsys.readouterr().err.rstrip().endswith("Name them: --columns wy=COLUMN")


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--columns", "t=clock"], "missing: t -> clock"),
        (["--columns", "time"], "NAME=COLUMN"),
        ([*NAMES, "--robust", "3"], "--noise"),
        ([*NAMES, "--wheel-inertia", "1e-6"], "wheel=COLUMN"),
        ([*NAMES, "wheel=wheel"], "wheel=COLUMN needs --wheel-inertia"),
    ],
)
def test_bad_options_and_files_are_named(toss, capsys, more, message):
    assert main(["fit", str(toss), *more]) == 2
    assert message in capsys.readouterr().err


def test_repeated_times_are_named(toss, capsys):
    lines = toss.read_text().splitlines()
    lines[5] = lines[4]
    toss.write_text("\n".join(lines))
    assert main(["fit", str(toss), *NAMES, "--degrees"]) == 2
    assert "line 6" in capsys.readouterr().err


def test_a_missing_file_is_an_error(tmp_path, capsys):
    assert main(["fit", str(tmp_path / "none.csv")]) == 2
    assert "none.csv" in capsys.readouterr().err


def test_programs_for_brief_fits_give_the_same():
    def function(x):
        return jnp.sin(x) @ jnp.linspace(0.0, 1.0, 5)

    x, asked = jnp.arange(5.0), []
    for is_brief in (True, False):
        run = compiled(lambda x, is_brief=is_brief: asked.append(x.size) or is_brief)(function)
        expected = np.sin(np.arange(5.0)) @ np.linspace(0, 1, 5)
        np.testing.assert_allclose(run(x), expected, rtol=1e-14)
        np.testing.assert_allclose(jax.jit(run)(x), expected, rtol=1e-14)
    assert asked == [5, 5]  # not if the fit is a part of another program
