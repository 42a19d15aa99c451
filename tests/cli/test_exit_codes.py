"""One rule for every command: 2 for wrong usage or input, 1 for a failed computation or write."""

import os

import h5py
import numpy as np
import pytest

from polhode.cli import main

SCENE = """title = "free"
[inertia]
axisymmetric = { transverse = 1.0, axial = 1.5 }
[state]
omega_body = [0.5, 0.2, 3.0]
[times]
stop = 2.0
number = 5
"""
ENSEMBLE = SCENE + "[ensemble]\nbodies = 20\nseed = 1\n[ensemble.attitude]\nany = true\n"
RATES = "".join(f"{k / 10},{k % 3},0.5,0.25\n" for k in range(20))
LIGHT = "".join(f"{k / 10},{10 + k % 3}\n" for k in range(20))
TEXTS = {
    "tip.toml": SCENE,
    "many.toml": ENSEMBLE,
    "named.toml": SCENE + '[output]\nfile = "x.csv"\n',
    "empty.toml": "",
    "empty.csv": "",
    "empty.nc": "",
    "blank.csv": "\n# a remark\n\n",
    "imu.csv": "stamp,a,b,c\n" + RATES,
    "wheel.csv": "t,wx,wy,wz\n" + RATES,
    "header.csv": "t,wx,wy,wz\n",
    "short.csv": "t,wx,wy,wz,v\n" + "".join(f"{k},1,0,0,{k}\n" for k in range(5)),
    "words.csv": "t,wx,wy,wz\n0,fast,0,0\n1,0,0,0\n",
    "light.csv": "jd,mag\n" + LIGHT,
    "flux.csv": "jd,flux\n" + LIGHT.replace(",10", ",-1"),
    "jd.csv": "jd,mag\n",
    "few.csv": "jd,mag\n0,1\n1,2\n",
    "ragged.csv": "jd,mag\n0,1,5\n1,2\n",
    "sun.csv": "jd,sun_x\n0,1\n",
    "bare.csv": "jd,mag,sun_x,sun_y,sun_z,earth_x,earth_y,earth_z\n"
    + "".join(f"{k},10,1,0,0,0,1,0\n" for k in range(9)),
}
ANY = ("Traceback", "Errno", "ValueError", "--debug", "pip install")

CASES = [
    # unknown commands, and files in place of a command
    ("simulate tip.toml", 2, ["No such command", "'run'"]),
    ("plot tip.nc", 2, ["'view'"]),
    ("light-curve light.csv", 2, ["'lightcurve'"]),
    ("help", 2, ["'--help'"]),
    ("nonsense", 2, ["run, explain, fit"]),
    ("tip.toml", 2, ["polhode run"]),
    ("schema tip.toml", 2, ["tip.toml"]),
    # run and explain
    ("run", 2, ["SCENE"]),
    ("run none.toml", 2, ["none.toml", "No such file"]),
    ("explain tip", 2, ["did you mean tip.toml?"]),
    ("run tpi.toml", 2, ["did you mean tip.toml?"]),
    ("run toutatsi", 2, ["polhode run toutatis"]),
    ("run elsewhere/wing_nut.toml", 2, ["polhode run wing_nut"]),
    ("run .", 2, ["directory"]),
    ("run empty.toml", 2, ["inertia", "Field required"]),
    ("run bin.toml", 2, ["not a text file"]),
    ("run imu.csv", 2, ["not valid TOML", "polhode fit"]),
    ("explain foreign.nc", 2, ["foreign.nc", "polhode view"]),
    ("run tip.toml -o x.csv", 2, [".nc", ".csv"]),
    ("run tip.toml -o fig.png", 2, [".nc", ".png"]),
    ("run named.toml", 2, ["x.csv", ".nc"]),
    ("run tip.toml --clones -1", 2, ["whole number from 0"]),
    ("run tip.toml --seed 0.5", 2, ["whole number from 0"]),
    ("run tip.toml --seed 9223372036854775808", 2, ["from 0 to 9223372036854775807"]),
    ("run tip.toml --clones 10000001", 2, ["from 0 to 10000000"]),
    ("run tip.toml --seed 7", 2, ["[monte_carlo]"]),
    ("run tip.toml --chunk 7", 2, ["--chunk", "[ensemble]"]),
    ("run tip.toml -o folder.nc", 1, ["is a folder"]),
    ("run tip.toml -o mine.nc", 1, ["mine.nc", "--force"]),
    ("run tip.toml -o tip.toml/x.nc", 1, ["tip.toml"]),
    # run of an ensemble
    ("run many.toml -o big.nc", 2, [".zarr", ".nc"]),
    ("run many.toml --clones 5", 2, ["[ensemble] bodies"]),
    ("run many.toml --memory 0", 2, ["not a size"]),
    ("run many.toml --memory lots", 2, ["not a size"]),
    ("run many.toml --memory 1e999", 2, ["not a size"]),
    ("run many.toml --chunk 0", 2, ["whole number from 1"]),
    ("run many.toml --devices 0", 2, ["whole number from 1"]),
    ("run many.toml --devices 999", 2, ["this machine has"]),
    ("run many.toml --part 0/2", 2, ["not I/N"]),
    ("run many.toml --part 3/2", 2, ["not I/N"]),
    ("run many.toml --part 2", 2, ["not I/N"]),
    ("run tip.toml --part 1/2", 2, ["--part", "[ensemble]"]),
    # fit
    ("fit none.csv", 2, ["none.csv", "no such file"]),
    ("fit imu", 2, ["did you mean imu.csv?"]),
    ("fit .", 2, ["is a folder"]),
    ("fit empty.csv", 2, ["is empty"]),
    ("fit blank.csv", 2, ["is empty"]),
    ("fit header.csv", 2, ["at least 4 rows"]),
    ("fit bin.csv", 2, ["not text"]),
    ("fit words.csv", 2, ["line 2", "fast"]),
    ("fit imu.csv", 2, ["stamp", "--columns t=COLUMN wx=COLUMN wy=COLUMN wz=COLUMN"]),
    (
        "fit wheel.csv --columns wheel=w --wheel-inertia 1e-6",
        2,
        ["wheel -> w", "--columns wheel=COLUMN"],
    ),
    ("fit tip.toml", 2, ["polhode run"]),
    ("fit foreign.nc", 2, ["polhode view"]),
    ("fit wheel.csv --noise 0", 2, ["positive"]),
    ("fit wheel.csv --robust -1 --noise 1", 2, ["positive"]),
    ("fit wheel.csv --block 0", 2, ["--block"]),
    ("fit wheel.csv --wheel-inertia nan", 2, ["positive"]),
    ("fit short.csv --wheel-inertia 1 --columns wheel=v --no-figure", 2, ["at least 8 samples"]),
    ("fit wheel.csv --wheel-axis 0 0 0", 2, ["direction"]),
    ("fit wheel.csv -o x.csv", 2, [".json or .png", ".csv"]),
    ("fit wheel.csv imu.csv", 2, ["one RECORDING"]),
    ("fit wheel.csv -o tip.toml/x", 1, ["tip.toml"]),
    # view
    ("view none.nc", 2, ["none.nc", "no such file", "polhode run"]),
    ("view foreign", 2, ["did you mean foreign.nc?"]),
    ("view .", 2, ["is a folder", "polhode run"]),
    ("view store.zarr", 2, ["folder", "xarray.open_zarr"]),
    ("view tip.toml", 2, ["NetCDF", "polhode run"]),
    ("view imu.csv", 2, ["NetCDF", "polhode run", "polhode fit"]),
    ("view empty.nc", 2, ["NetCDF", "polhode run"]),
    ("view bin.csv", 2, ["NetCDF", "polhode run"]),
    ("view cut.nc", 2, ["cut.nc", "damaged", "polhode run"]),
    ("view foreign.nc", 2, ["lacks", "polhode run"]),
    ("view foreign.nc -o x.pdf", 2, [".html", ".pdf"]),
    # lightcurve
    ("lightcurve none.csv", 2, ["none.csv", "no such file", "light curve"]),
    ("lightcurve light", 2, ["did you mean light.csv?"]),
    ("lightcurve .", 2, ["is a folder"]),
    ("lightcurve empty.csv", 2, ["is empty"]),
    ("lightcurve blank.csv", 2, ["is empty"]),
    ("lightcurve jd.csv", 2, ["jd.csv", "no rows"]),
    ("lightcurve few.csv", 2, ["few.csv", "at least 8"]),
    ("lightcurve bin.csv", 2, ["bin.csv", "not text"]),
    ("lightcurve ragged.csv", 2, ["line 2", "cells"]),
    ("lightcurve imu.csv", 2, ["must have a column jd"]),
    ("lightcurve flux.csv", 2, ["must be positive"]),
    ("lightcurve tip.toml", 2, ["polhode run"]),
    ("lightcurve light.csv --vectors none.csv", 2, ["none.csv", "no such file", "sun_x"]),
    ("lightcurve light.csv --vectors empty.csv", 2, ["empty.csv", "is empty"]),
    ("lightcurve light.csv --vectors bin.csv", 2, ["not text"]),
    ("lightcurve light.csv --vectors sun.csv", 2, ["lacks the columns"]),
    ("lightcurve light.csv --trials 0", 2, ["whole number from 1"]),
    ("lightcurve light.csv --phase lambert", 2, ["'lambert'", "seeliger, linear, hg, hg1g2"]),
    ("lightcurve light.csv --searches 0", 2, ["--start"]),
    ("lightcurve light.csv --start none.json", 2, ["none.json", "no such file"]),
    ("lightcurve light.csv --start light.csv", 2, ["light.csv is not a result"]),
    ("lightcurve light.csv --max-frequency 0", 2, ["positive number"]),
    ("lightcurve light.csv --max-frequency nan", 2, ["positive number"]),
    ("lightcurve light.csv --trials -3", 2, ["whole number from 1"]),
    ("lightcurve light.csv --trials 1e4", 2, ["whole number from 1"]),
    ("lightcurve light.csv --seed -1", 2, ["whole number from 0"]),
    ("lightcurve light.csv --floor -1", 2, ["number from 0"]),
    ("lightcurve light.csv --floor nan", 2, ["number from 0"]),
    ("lightcurve bare.csv --floor 0", 2, ["sigma"]),
    ("lightcurve light.csv -o x.csv", 2, [".png or .json", ".csv"]),
    ("lightcurve bare.csv -o tip.toml/x", 1, ["tip.toml"]),
    ("lightcurve bare.csv -o mine", 1, ["mine.png", "--force"]),
    # scenes
    ("scenes no_such_scene", 2, ["toutatis"]),
    ("scenes wingnut", 2, ["did you mean wing_nut?"]),
    ("scenes -o x.toml", 2, ["NAME"]),
    ("scenes toutatis -o x.csv", 2, [".toml", ".csv"]),
    ("scenes toutatis -o tip.toml", 1, ["tip.toml exists", "--force"]),
    ("scenes toutatis -o folder.toml", 1, ["is a folder"]),
]


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder with valid and invalid input of every kind."""
    monkeypatch.chdir(tmp_path)
    for name, text in TEXTS.items():
        (tmp_path / name).write_text(text)
    for name in ("bin.csv", "bin.toml"):
        (tmp_path / name).write_bytes(bytes(range(256)))
    for name in ("mine.nc", "mine.png", "mine.json"):
        (tmp_path / name).write_text("of the user")
    for name in ("folder.nc", "folder.toml", "store.zarr"):
        (tmp_path / name).mkdir()
    with h5py.File("foreign.nc", "w") as file:
        file["a"] = np.arange(3.0)
    (tmp_path / "cut.nc").write_bytes((tmp_path / "foreign.nc").read_bytes()[:60])
    return tmp_path


@pytest.mark.parametrize(("command", "code", "words"), CASES, ids=[case[0] for case in CASES])
def test_exit_code_and_message(here, capsys, command, code, words):
    before = sorted(os.listdir(here))
    try:
        found = main(command.split())
    except SystemExit as ended:  # options that typer rejects
        found = ended.code
    told = capsys.readouterr()
    assert found == code, told.err
    assert told.out == ""
    for word in words:
        assert word in told.err
    for word in ANY:
        assert word not in told.err
    assert sorted(os.listdir(here)) == before


def test_a_light_curve_that_does_not_vary_is_wrong_input(here, capsys):
    (here / "flat.csv").write_text("jd,mag\n" + "".join(f"{k},10\n" for k in range(9)))
    assert main(["lightcurve", "flat.csv"]) == 2
    told = capsys.readouterr().err
    assert told.startswith("polhode: flat.csv: the brightness does not vary")
    assert "--debug" not in told
    assert main(["lightcurve", "flat.csv", "--binned", "20"]) == 2
    assert "at least 8 points, this one has 1" in capsys.readouterr().err
