"""Wheel and source archive are complete and run the README's examples where they are installed."""

import os
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from polhode.files import shipped_scenes

ROOT = Path(__file__).resolve().parents[1]
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> dict[str, Path]:
    """The source archive, and the wheel that is built from it."""
    pytest.importorskip("build", reason="the group docs, which holds it, is not installed")
    folder = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "build", "--outdir", folder, ROOT]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    (wheel,), (archive,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    return {"wheel": wheel, "archive": archive}


def test_they_hold_what_is_needed(built):
    needed = {"polhode/py.typed", "polhode/plot/viewer/viewer.js", "polhode/plot/viewer/page.html"}
    needed |= {f"polhode/plot/viewer/three.{kind}" for kind in ("min.js", "LICENSE.txt")}
    needed |= {f"polhode/files/scenes/{name}.toml" for name in shipped_scenes()}
    needed.add("polhode/files/reference/tumbling.json")
    names = set(zipfile.ZipFile(built["wheel"]).namelist())
    assert needed <= names
    assert all(name.startswith("polhode") for name in names)
    licences = {Path(name).name for name in names if ".dist-info/licenses/" in name}
    assert licences == {"LICENSE", "three.LICENSE.txt"}
    with zipfile.ZipFile(built["wheel"]) as wheel:
        (name,) = [name for name in names if name.endswith(".dist-info/METADATA")]
        metadata = wheel.read(name).decode()
    assert "\nLicense-Expression: Apache-2.0 AND MIT\n" in metadata
    assert "\nClassifier: Typing :: Typed\n" in metadata
    assert not re.search(r"\]\((?!https?:|#)", metadata), "a relative link in the readme"
    with tarfile.open(built["archive"]) as archive:
        names = {name.split("/", 1)[-1] for name in archive.getnames()}
    assert {f"src/{name}" for name in needed} <= names
    assert {"README.md", "LICENSE", "CHANGELOG.md", "CITATION.cff", "tests/conftest.py"} <= names


@pytest.mark.parametrize("kind", ["wheel", "archive"])
def test_installed_it_runs_the_lines_of_the_readme(built, kind, tmp_path):
    target = tmp_path / "installed"
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", target]
    done = subprocess.run([*command, built[kind]], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```", readme, re.S | re.M)
    assert len(blocks) == 2  # the second uses names of the first
    script = tmp_path / "readme.py"
    # its own dependencies come from this environment, polhode from the folder
    where = "import polhode, pathlib; print(pathlib.Path(polhode.__file__).resolve())\n"
    shown = "from polhode import plot; assert len(plot.view(traj).html) > 500_000\n"
    script.write_text(where + "".join(blocks) + shown, encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": str(target)}
    done = subprocess.run(
        [sys.executable, script], capture_output=True, text=True, cwd=tmp_path, env=environment
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert Path(done.stdout.splitlines()[0]).is_relative_to(target.resolve())
