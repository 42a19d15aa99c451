"""What works with the core dependencies alone, and the extras that other errors name."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from polhode import _extras

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = PROJECT["optional-dependencies"]
# some extras import these, so they cannot be core dependencies
BLOCKED = {"pandas", "numcodecs", "PIL", "click"}

SCRIPT = '''
import sys

class Without:
    """A finder that does not find the packages of the extras."""

    def __init__(self, finder):
        self.finder = finder

    def __getattr__(self, name):
        return getattr(self.finder, name)

    def find_spec(self, name, path=None, target=None):
        absent = name.partition(".")[0] in sys.argv[1:]
        return None if absent else self.finder.find_spec(name, path, target)

sys.meta_path[:] = map(Without, sys.meta_path)

import numpy as np
import polhode as ph
from polhode import ensemble, files, fit, frames, inertia, lightcurve, plot, rotation
from polhode.cli import main

times = np.linspace(0.0, 10.0, 21)
scene = ph.Scene(ph.Inertia.from_moments([1.0, 2.0, 3.0]))
state = ph.State([1.0, 0.0, 0.0, 0.0], [0.01, 1.0, 0.01])
motion = ph.simulate(scene, state, times)
curve = lightcurve.LightCurve.of(times, times, np.ones((21, 3)), np.ones((21, 3)))
page = plot.view(motion)
assert len(page.html) > 500_000
page.write("page.html")
samples = plot.samples(times, motion.omega_body, motion.wxyz, scene.inertia)

uses = {
    "works": [
        lambda: rotation.wxyz_to_matrix(motion.wxyz),
        lambda: inertia.principal(scene.inertia.tensor),
        lambda: frames.gyroscope,
        lambda: fit.Recording.of(times, motion.omega_body),
        lambda: ensemble.Ensemble(scene, state, 3),
        lambda: ensemble.build_ensemble,
        lambda: curve.points(0.03),
        lambda: plot.view(samples),
        lambda: files.shipped_scenes()["toutatis"],
    ],
    "plot": [
        *(lambda name=name: getattr(plot, name)(motion)
          for name in ("polhode", "herpolhode", "history", "overview", "animate")),
        lambda: plot.work_precision({"a": ([1.0], [1.0])}),
        lambda: plot.fit(None, None),
        lambda: lightcurve.figure(None),
    ],
    "cli": [
        motion.to_xarray,
        lambda: files.write_netcdf(None, "x.nc"),
        lambda: files.parse_scene(""),
        lambda: plot.view_file("x.nc"),
        *(lambda name=name: getattr(files, name) for name in
          ("SceneFile", "build_scene", "build_inertia", "build_method", "draw_clones")),
    ],
    "scale": [lambda: ensemble.stream(ensemble.Ensemble(scene, state, 3), times, "x.zarr")],
    "mesh": [lambda: ph.MassProperties.from_mesh_file("x.stl", mass=1.0)],
    "robots": [lambda: ph.MassProperties.from_mjcf("x.xml", "hand")],
}
for extra, calls in uses.items():
    for number, call in enumerate(calls):
        try:
            call()
        except ImportError as error:
            assert f"pip install 'polhode[{extra}]'" in str(error), (extra, number, error)
        else:
            assert extra == "works", (extra, number)
for words in (["--help"], ["run", "x.toml"], ["view", "x.nc"]):
    assert main(words) == 1
'''


def test_the_core_dependencies_alone_do_all_that_needs_no_extra(tmp_path):
    """Every public namespace imports; what needs an extra raises an ImportError that names it."""
    needs = [need for extra in EXTRAS.values() for need in extra if "polhode" not in need]
    modules = {re.split(r"[>=\[]", need)[0].replace("-", "_") for need in needs} | BLOCKED
    command = [sys.executable, "-c", SCRIPT, *sorted(modules)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    told = done.stderr.splitlines()
    assert [line for line in told if "polhode --help" in line and "pip install '.[cli]'" in line]


def test_every_extra_that_a_message_names_exists():
    named = set()
    for path in (ROOT / "src").rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        for extras in re.findall(r"(?:\bextra=|how_to_install\()[\"']([\w,]+)[\"']", text):
            named |= set(extras.split(",")) - {"forbid"}  # a setting of pydantic, not an extra
    assert {"cli", "scale", "plot", "mesh"} <= named <= set(EXTRAS)


def test_all_holds_every_extra():
    """Except MuJoCo, a complete simulator that few users need."""
    (everything,) = EXTRAS["all"]
    assert set(re.findall(r"\w+", everything)) - {"polhode"} == set(EXTRAS) - {"all", "robots"}


def test_a_broken_package_keeps_its_own_message(tmp_path, monkeypatch):
    (tmp_path / "brittle.py").write_text("raise ImportError('libfoo.so is missing')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ImportError, match=r"libfoo\.so"):
        _extras.imported("a test", "brittle")
    with pytest.raises(ImportError, match="a test needs no_such_package: pip install"):
        _extras.imported("a test", "math", "no_such_package", extra="plot")
