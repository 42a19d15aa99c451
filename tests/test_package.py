"""What is installed: the types are marked as part of the package."""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.slow
def test_the_wheel_says_that_it_is_typed_and_holds_every_module(tmp_path):
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", str(tmp_path)]
    subprocess.run([*command, str(ROOT)], check=True, capture_output=True, timeout=300)
    (wheel,) = tmp_path.glob("*.whl")
    held = {name for name in zipfile.ZipFile(wheel).namelist() if name.startswith("polhode/")}
    assert "polhode/py.typed" in held
    source = ROOT / "src"
    assert "polhode/__init__.pyi" in held
    assert held >= {str(path.relative_to(source)) for path in (source / "polhode").rglob("*.py")}


def test_the_mark_stands_beside_the_modules():
    import polhode

    assert Path(polhode.__file__).with_name("py.typed").exists()
