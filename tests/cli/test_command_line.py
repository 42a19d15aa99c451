"""The command line: what it writes and prints, its exit codes, and the files after a failure."""

import importlib.util
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import equinox as eqx
import numpy as np
import pytest
import xarray

import polhode as ph
from polhode.cli import main
from polhode.cli._options import scene_path
from polhode.files import build_scene, build_state, read_scene, shipped_scenes

SCENES = shipped_scenes()["toutatis"].parent
TOP = """
title = "small top"
source = "test"
[inertia]
moments = [1.0, 1.5, 2.0]
[state]
euler = { angles = [10, 30, 0], unit = "deg" }
omega_body = [0.5, 0.2, 3.0]
[potential]
kind = "uniform-gravity"
mass = 1.0
centre_body = [0.0, 0.0, 0.1]
[times]
stop = 2.0
number = 11
[monte_carlo]
clones = 120
seed = 5
moments = { relative_sigma = 0.01, source = "assumed: for the test" }
"""


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty current folder that contains the small scene."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "top.toml").write_text(TOP)
    return tmp_path


def run(*arguments):
    return main(["run", *map(str, arguments)])


def test_run_writes_data_and_figure_and_prints_a_summary(here, capsys):
    assert run("top.toml", "-o", "new/top.nc") == 0
    out = capsys.readouterr().out
    assert "small top" in out
    assert "change of energy" in out
    assert "assumed: for the test" in out
    assert sorted(path.name for path in (here / "new").iterdir()) == ["top.nc", "top.png"]
    assert (here / "new" / "top.png").read_bytes()[:4] == b"\x89PNG"
    with xarray.open_dataset(here / "new" / "top.nc", engine="h5netcdf") as data:
        assert data.sizes == {"clone": 121, "time": 11, "quaternion": 4, "axis": 3}
        assert data.attrs["title"] == "small top"
        assert data.attrs["scene"] == TOP
        np.testing.assert_array_equal(data["moments"][0], [1, 1.5, 2])
        # the nominal body and the last clone, computed without the command line
        file = read_scene("top.toml")
        scene = build_scene(file, np.float64)
        state = build_state(file, np.float64, scene.inertia)
        for clone in (0, 120):
            body = ph.Inertia.from_moments(data["moments"].values[clone])
            single = ph.Scene(body, scene.potential)
            alone = ph.simulate(single, state, file.times.seconds)
            np.testing.assert_allclose(data["wxyz"][clone], alone.wxyz, atol=2e-7)
        assert (data["status"] == 0).all()


def test_options_replace_the_scene(here, capsys):
    assert run("top.toml", "--clones", 3, "--seed", 9, "--no-figure", "--precision", "float32") == 0
    assert "3 clones" in capsys.readouterr().out
    assert not (here / "top.png").exists()
    with xarray.open_dataset("top.nc", engine="h5netcdf") as data:
        assert data.sizes["clone"] == 4
        assert data["wxyz"].dtype == np.float32
        first = data["moments"].values[1:]
    again = ("--precision", "float32", "--no-figure", "-q")  # reuses the compiled program
    assert run("top.toml", "--clones", 3, "--seed", 10, *again) == 0
    captured = capsys.readouterr()
    assert captured.out == captured.err == ""
    with xarray.open_dataset("top.nc", engine="h5netcdf") as data:
        assert np.abs(data["moments"].values[1:] - first).max() > 1e-3
    assert run("top.toml", "--clones", 0, *again) == 0
    with xarray.open_dataset("top.nc", engine="h5netcdf") as data:
        assert "clone" not in data.sizes


def test_chunks_cover_every_body_once(here):
    from polhode.cli import _job

    job = _job.prepare(read_scene("top.toml"), "float64")
    seen = []
    outcome = _job.run(job, seen.append)
    assert seen == [50, 100, 121]
    whole = ph.simulate(job.scene, job.state, job.ts, job.method)
    np.testing.assert_allclose(outcome.trajectory.wxyz, whole.wxyz, atol=2e-7)
    assert outcome.run_seconds > 0


def test_observations_within_the_times_are_compared(here):
    """Backward in time, at the first time, between samples, and outside on both sides."""
    from polhode.cli import _job

    text = """
    inertia = { spherical = 2.0 }
    state = { omega_body = [0.0, 0.5, 0.0] }
    times = { start = 3.0, stop = 0.0, number = 4 }
    [observations]
    rows = [ { time = -1.0, omega_body = [9, 9, 9] },
             { time = 0.5, wxyz = [1, 0, 0, 0] },
             { time = 3.0, wxyz = [1, 0, 0, 0], omega_body = [0.0, 0.25, 0.0] },
             { time = 4.0, omega_body = [9, 9, 9] } ]
    """
    (here / "ball.toml").write_text(text)
    outcome = _job.run(_job.prepare(read_scene("ball.toml"), "float64"), lambda _: None)
    np.testing.assert_array_equal(outcome.trajectory.ts, [3.0, 2.0, 1.0, 0.0])
    assert outcome.trajectory.wxyz.shape == (4, 4)
    # a ball turns at a constant rate: 0.5 rad/s for the 2.5 s from 3.0 back to 0.5
    found = outcome.residuals
    np.testing.assert_array_equal(found.seconds, [0.5, 3.0])
    np.testing.assert_allclose(found.angle, [1.25, 0.0], atol=1e-7)
    np.testing.assert_allclose(found.rates[1], [0.0, -0.25, 0.0], atol=1e-12)
    assert np.isnan(found.rates[0]).all()


@pytest.mark.slow
def test_a_scene_with_a_wheel_runs(here, capsys):
    spread = 'omega_body = { sigma = 0.1, source = "test" }\n'
    text = TOP[: TOP.index("[potential]")] + TOP[TOP.index("[times]") : TOP.rindex("moments")]
    text = text.replace("120", "2") + spread
    wheel = "[[rotors]]\naxis_body = [0, 0, 1]\ninertia = 0.1\nmomentum = 2.0\n"
    (here / "wheel.toml").write_text(text + wheel)
    assert run("wheel.toml", "--no-figure") == 0
    assert "P_psi" not in capsys.readouterr().out  # periods are those of bodies without wheels
    with xarray.open_dataset("wheel.nc", engine="h5netcdf") as data:
        momentum = data["momentum_space"].values
        drift = np.linalg.norm(momentum - momentum[:, :1], axis=-1)
        assert drift.max() < 1e-6 * np.linalg.norm(momentum[0, 0])


@pytest.mark.parametrize("name", ["nasa_brick", "symmetric_top"])
def test_scenes_meet_the_reference_values_they_carry(name):
    """Rates and attitudes recomputed with 34 digits, printed with 12 or more decimals."""
    from polhode.cli import _job

    job = _job.prepare(read_scene(SCENES / f"{name}.toml"), "float64")
    found = _job.run(job, lambda _: None).residuals
    assert len(found.seconds) == len(job.file.observations.seconds)
    assert np.nanmax(found.angle) < 1e-13
    assert np.abs(found.rates).max() < 1e-13


@pytest.mark.parametrize(
    ("value", "width", "text"),
    [
        (5.38, 0.03, "5.38 ± 0.03"),
        (7.4, 0.03, "7.40 ± 0.03"),
        (5.3685, 0.0624, "5.369 ± 0.062"),
        (1234.5, 12.3, "1234 ± 12"),
        (5.0, None, "5"),
        (3.0, 0.0, "3"),
        (2.0, 1e-9, "2 ± 1e-09"),
    ],
)
def test_values_are_printed_with_the_digits_of_their_spread(value, width, text):
    from polhode.cli import _job

    assert _job._plus_minus(value, width) == text


def test_compile_time_counts_nested_reports_once(monkeypatch):
    from polhode.cli import _job

    clock, now = _job._CompileClock(), iter([1.0, 3.0, 4.0, 9.0, 20.0])
    monkeypatch.setattr(_job.time, "perf_counter", lambda: next(now))
    # (end, duration): 0.5-1 before the start, 2.5-3 inside 2-4, 8-9 apart, 1 of another kind
    for duration in (0.5, 0.5, 2.0, 1.0):
        clock.listen("/jax/core/compile/jaxpr_trace_duration", duration, fun_name="f")
    clock.listen("/jax/other", 1.0)
    assert clock.since(1.5) == 3.0


@pytest.mark.parametrize(
    ("arguments", "code", "hints"),
    [
        (["run", "absent.toml"], 2, ["absent.toml", "No such file"]),
        (["run", "bad.toml"], 2, ["bad.toml", "momnets", 'did you mean "moments"']),
        (["explain", "bad.toml"], 2, ["bad.toml", "momnets"]),
        (["run", "flat.toml"], 2, ["flat.toml", "[inertia] moments", "triangle"]),
        (["run", "method.toml"], 2, ["[method] solver", 'did you mean "Dopri8"']),
        (["run", "sharp.toml", "--precision", "float32"], 2, ["sharp.toml", "rtol", "float32"]),
        (["explain", "sharp.toml", "--precision", "float32"], 2, ["sharp.toml", "rtol"]),
        (["run", "slow.toml"], 1, ["nominal body did not finish", "max_steps"]),
        (["run", "single.toml", "--clones", "5"], 2, ["[monte_carlo]", "--clones"]),
        (["run", "top.toml", "-o", "folder.nc"], 1, ["is a folder"]),
    ],
)
def test_failures_are_one_readable_block(here, capsys, arguments, code, hints):
    (here / "folder.nc").mkdir()
    texts = {
        "bad": TOP.replace("moments = [1.0", "momnets = [1.0"),
        "flat": TOP.replace("1.5, 2.0]", "1.5, 3.0]"),
        "method": TOP + "[method]\nkind = 'lie-poisson'\nsolver = 'Dorpi8'\n",
        "slow": TOP[: TOP.index("[monte_carlo]")]
        + "[method]\nkind = 'lie-poisson'\nsolver = 'Euler'\nstep = 1e-6\n",
        "sharp": TOP + "[method]\nrtol = 1e-12\n",
        "single": TOP[: TOP.index("[monte_carlo]")],
    }
    for name, text in texts.items():
        (here / f"{name}.toml").write_text(text)
    old = here / "slow.nc"
    old.touch()
    before = sorted(here.iterdir())
    assert main(arguments) == code
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("polhode: ")
    assert "Traceback" not in captured.err
    for hint in hints:
        assert hint in captured.err
    assert sorted(here.iterdir()) == before
    assert old.read_text() == ""
    assert main([*arguments, "--debug"]) == code
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        ([], "Missing command"),
        (["rnu"], "Did you mean 'run'"),
        (["run"], "SCENE"),
        (["run", "top.toml", "--clones", "-1"], "whole number from 0"),
        (["run", "top.toml", "--clones", "many"], "whole number from 0"),
        (["run", "top.toml", "--precision", "float16"], "float64"),
        (["run", "top.toml", "--nofigure"], "--no-figure"),
        (["fit", "toss.csv", "--calibration", "inf"], "'inf' is not a number from 0 up"),
    ],
)
def test_wrong_options_are_usage_errors(here, capsys, arguments, hint):
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
    assert hint in capsys.readouterr().err


def test_the_scenes_that_come_with_polhode(here, capsys):
    """Listed, copied, and run by name from any folder; a file of that name takes precedence."""
    assert main(["scenes"]) == 0
    told = capsys.readouterr().out
    names = [path.stem for path in SCENES.glob("*.toml")]
    assert len(names) > 3
    assert all(name in told for name in names)
    assert main(["explain", "lagrange_top"]) == 0
    assert "Lagrange top" in capsys.readouterr().out
    assert main(["scenes", "toutatis", "-o", "copies/mine"]) == 0
    assert (here / "copies" / "mine.toml").read_bytes() == (SCENES / "toutatis.toml").read_bytes()
    (here / "toutatis").write_text("no scene")
    assert main(["explain", "toutatis"]) == 2
    assert "not valid TOML" in capsys.readouterr().err


def test_the_example_of_the_help_runs_where_only_polhode_is(here, capsys):
    with pytest.raises(SystemExit):
        main(["run", "--help"])
    (words,) = re.findall(r"^ *example: polhode (.*)$", capsys.readouterr().out, re.M)
    command, scene, *_ = words.split()
    assert command == "run"
    assert scene_path(scene).samefile(SCENES / f"{scene}.toml")


def test_help_and_version(capsys):
    for arguments, text in (
        (["--help"], "explain"),
        (["run", "--help"], "--precision"),
        (["--version"], ph.__version__),
    ):
        with pytest.raises(SystemExit) as caught:
            main(arguments)
        assert caught.value.code == 0
        assert text in capsys.readouterr().out


@pytest.mark.parametrize("failure", [OSError(28, "disk full"), KeyboardInterrupt()])
def test_failed_write_keeps_the_old_file(here, capsys, monkeypatch, failure):
    (here / "top.nc").write_text("old")

    write = Path.write_bytes

    def half(self, data):
        if ".part" not in self.name:
            return write(self, data)
        with open(self, "wb") as file:
            file.write(bytes(data)[:100])
        raise failure

    monkeypatch.setattr(Path, "write_bytes", half)
    code = run("top.toml", "--clones", 2, "--force")
    assert code == (130 if isinstance(failure, KeyboardInterrupt) else 1)
    assert ("interrupted" if code == 130 else "disk full") in capsys.readouterr().err
    assert (here / "top.nc").read_text() == "old"
    assert sorted(path.name for path in here.iterdir()) == ["top.nc", "top.toml"]


def test_missing_packages_are_named_before_the_work(here, capsys, monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util,
        "find_spec",
        lambda name: None if name in ("h5py", "matplotlib") else find(name),
    )
    assert run("top.toml") == 1
    told = capsys.readouterr().err
    assert "`polhode run` needs h5py, matplotlib: pip install 'polhode[cli]'" in told
    (here / "toss.csv").touch()
    assert main(["fit", "toss.csv"]) == 1
    assert "`polhode fit` needs matplotlib: pip install 'polhode[cli]'" in capsys.readouterr().err
    assert sorted(path.name for path in here.iterdir()) == ["top.toml", "toss.csv"]


def test_termination_unwinds(here, monkeypatch):
    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(ph, "simulate", lambda *_, **__: os.kill(os.getpid(), signal.SIGTERM))
    with pytest.raises(SystemExit) as caught:
        run("top.toml", "--clones", 2)
    assert caught.value.code == 143
    assert signal.getsignal(signal.SIGTERM) is before
    assert [path.name for path in here.iterdir()] == ["top.toml"]


def test_clones_that_do_not_finish_are_reported(here, capsys, monkeypatch):
    simulate = ph.simulate

    def failing(*arguments, **options):
        made = simulate(*arguments, **options)
        status = made.status.at[-1].set(ph.Status.NOT_FINITE)
        return eqx.tree_at(lambda t: t.status, made, status)

    monkeypatch.setattr(ph, "simulate", failing)
    assert run("top.toml", "--clones", 2, "--no-figure") == 1
    assert "1 of 3 bodies did not finish, the first being clone 2" in capsys.readouterr().err
    with xarray.open_dataset("top.nc", engine="h5netcdf") as data:
        np.testing.assert_array_equal(data["status"], [0, 0, ph.Status.NOT_FINITE])


def test_an_interrupt_of_code_made_from_text_has_its_exit_code(tmp_path):
    """With ``python -m`` Python would end by the signal although the interrupt was caught."""
    (tmp_path / "ended.py").write_text("""
from polhode import cli
def main():
    try:
        exec("raise KeyboardInterrupt")
    except KeyboardInterrupt:
        print("interrupted")
        return 130
cli.main = main
cli.command()
""")
    done = subprocess.run([sys.executable, "-m", "ended"], cwd=tmp_path, stdout=-1, text=True)
    assert done.stdout == "interrupted\n"
    assert done.returncode == 130


def test_an_interrupt_waits_for_the_end_of_an_import(tmp_path):
    """An exception during the initialisation of an extension module of jaxlib aborts the process,
    and pydantic turns an interrupt into an error of its own.
    """
    (tmp_path / "slow_module.py").write_text("""
import os, signal
os.kill(os.getpid(), signal.SIGINT)
loaded = sum(range(100000)) > 0
print("loaded", flush=True)
""")
    (tmp_path / "runs.py").write_text("""
import time
from polhode.cli import _process
try:
    with _process.signal_handlers():
        import slow_module
        time.sleep(20)
except KeyboardInterrupt:
    print("interrupted")
try:
    with _process.signal_handlers():
        try:
            import os, signal
            os.kill(os.getpid(), signal.SIGINT)
        except KeyboardInterrupt:
            raise ValueError("of another library")
except KeyboardInterrupt:
    print("interrupted")
""")
    before = signal.getsignal(signal.SIGINT)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    done = subprocess.run(
        [sys.executable, "runs.py"], cwd=tmp_path, capture_output=True, text=True, timeout=60
    )
    signal.signal(signal.SIGINT, before)
    assert done.stdout.split() == ["loaded", "interrupted", "interrupted"], done.stderr


def test_interrupt_of_a_running_process_leaves_nothing_half_written(here):
    output = here / "new" / "top.nc"
    command = [
        sys.executable,
        "-m",
        "polhode",
        "run",
        "top.toml",
        "-o",
        str(output),
        "--clones",
        "1000000",
    ]
    before = signal.getsignal(signal.SIGINT)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        signal.signal(signal.SIGINT, before)
        deadline = time.monotonic() + 120
        # the folder is created after the scene is read, just before the computation
        while not output.parent.exists() and time.monotonic() < deadline:
            assert process.poll() is None
            time.sleep(0.05)
        time.sleep(0.5)
        process.send_signal(signal.SIGINT)
        errors = process.communicate(timeout=120)[1]
    assert process.returncode == 130
    assert "interrupted" in errors
    assert "Traceback" not in errors
    assert list(output.parent.iterdir()) == []


def test_explain_names_the_method(here, capsys):
    assert main(["explain", "top.toml"]) == 0
    out = capsys.readouterr().out
    assert "small top" in out
    assert "120 clones, seed 5" in out
    assert "LagrangeTop" in out or "LiePoisson(Automatic)" in out
    (here / "free.toml").write_text(TOP[: TOP.index("[potential]")] + TOP[TOP.index("[times]") :])
    assert main(["explain", "free.toml"]) == 0
    assert "ClosedForm" in capsys.readouterr().out


def test_the_log_of_xla_is_off_unless_it_is_asked_for(monkeypatch, capsys):
    for before, after in ((None, "3"), ("0", "0")):
        monkeypatch.delenv("TF_CPP_MIN_LOG_LEVEL", raising=False)
        if before is not None:
            monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", before)
        assert main(["schema"]) == 0
        assert os.environ["TF_CPP_MIN_LOG_LEVEL"] == after


def test_the_reference_motions_are_written(here, capsys):
    shipped = (SCENES.parent / "reference" / "tumbling.json").read_text("utf-8")
    assert main(["reference"]) == 0
    assert main(["reference"]) == 0
    assert (here / "tumbling.json").read_text("utf-8") == shipped
    assert main(["reference", "-o", "truth/mine.csv"]) == 0
    assert "mine.json" in capsys.readouterr().out
    lines = (here / "truth" / "mine.csv").read_text("utf-8").splitlines()
    bodies = json.loads(shipped)["bodies"]
    assert len(lines) == 1 + sum(len(body["samples"]) for body in bodies)
    assert main(["reference", "-o", "mine.txt"]) == 2
    (here / "tumbling.csv").write_text("not of this program")
    assert main(["reference"]) == 1
    assert main(["reference", "--force"]) == 0


@pytest.mark.parametrize("clones", [0, 3])
def test_wheels_with_friction_are_written_as_simulated(tmp_path, monkeypatch, clones):
    """Without external torque the momentum in space is constant, also in the file."""
    monkeypatch.chdir(tmp_path)
    text = (
        TOP.partition("[potential]")[0]
        + """
[[rotors]]
axis_body = [0, 0, 1]
inertia = 0.1
speed = 5.0
viscous = 0.01
[times]
stop = 20.0
number = 5
"""
    )
    if clones:
        text += f"[monte_carlo]\nclones = {clones}\nseed = 1\n"
        text += 'moments = { relative_sigma = 0.01, source = "assumed: for the test" }\n'
    Path("wheel.toml").write_text(text)
    assert main(["run", "wheel.toml", "-o", "wheel.nc"]) == 0
    with xarray.open_dataset("wheel.nc", engine="h5netcdf") as data:
        momentum = data.momentum_space.values
        speed = data.wheel_speed.values[..., 0]
    first = momentum[..., :1, :]
    assert np.abs(momentum - first).max() < 1e-7 * np.abs(first).max()
    assert np.all(np.abs(speed[..., -1]) < 2.5)
