"""docs/cli.md is generated from the commands, and long commands show their progress."""

import io
import sys
from pathlib import Path

import pytest

from polhode.cli import _process, main
from polhode.cli._main import _COMMANDS

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "docs" / "_ext"))


def test_the_page_is_that_of_the_commands():
    from polhode_docs.commands import page

    text = (ROOT / "docs" / "cli.md").read_text("utf-8")
    assert text == page(), "run: python docs/_ext/polhode_docs/commands.py > docs/cli.md"
    assert [line for line in text.split("\n") if line.startswith("## ")] == [
        f"## `polhode {name}`" for name in _COMMANDS
    ]


@pytest.fixture
def terminal(monkeypatch):
    """Output as a terminal shows it."""
    from rich.console import Console

    file = io.StringIO()
    console = Console(file=file, force_terminal=True, width=120)
    monkeypatch.setattr(_process, "progress_console", lambda quiet: console)
    return file


def test_a_light_curve_search_shows_its_progress(tmp_path, monkeypatch, terminal, capsys):
    from polhode.lightcurve import _command

    monkeypatch.chdir(tmp_path)
    rows = "".join(f"{k / 10},{10 + k % 3}\n" for k in range(20))
    Path("light.csv").write_text("jd,mag\n" + rows)
    monkeypatch.setattr(_command, "fit_file", lambda *_, say, **__: say("a table"))
    assert main(["lightcurve", "light.csv", "--trials", "1000"]) == 0
    assert "searching 20 points with 1,000 trials" in terminal.getvalue()
    assert capsys.readouterr().out == "a table\n"
    assert main(["lightcurve", "light.csv", "-q"]) == 0
    assert capsys.readouterr().out == ""


@pytest.mark.slow
def test_fits_and_ensembles_show_their_progress(tmp_path, monkeypatch, terminal):
    import numpy as np

    import polhode as ph

    monkeypatch.chdir(tmp_path)
    times = np.linspace(0, 6, 150)
    scene = ph.Scene(ph.Inertia.from_moments([1.0, 1.6, 2.1]))
    motion = ph.simulate(scene, ph.State([1.0, 0, 0, 0], [0.4, 2.0, 0.5]), times)
    noise = np.random.default_rng(1).normal(scale=1e-4, size=(150, 3))
    table = np.column_stack([times, np.asarray(motion.omega_body) + noise])
    np.savetxt("imu.csv", table, delimiter=",", header="t,wx,wy,wz", comments="")
    assert main(["fit", "imu.csv", "--no-figure"]) == 0
    assert "fitting 150 samples" in terminal.getvalue()
    Path("many.toml").write_text("""
inertia = { axisymmetric = { transverse = 1.0, axial = 1.5 } }
state = { omega_body = [0.5, 0.2, 3.0] }
times = { stop = 2.0, number = 5 }
ensemble = { bodies = 20, seed = 1, attitude = { any = true } }
""")
    assert main(["run", "many.toml"]) == 0
    assert "20/20" in terminal.getvalue()
