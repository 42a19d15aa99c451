"""Eight virtual devices give the same bits as one, and the program contains no collective."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("zarr")


@pytest.mark.slow
def test_eight_devices_are_as_one_and_exchange_nothing(tmp_path):
    script = Path(__file__).with_name("eight_devices.py")
    done = subprocess.run(
        [sys.executable, str(script), str(tmp_path)], capture_output=True, timeout=300, text=True
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    for name, bound, each in (
        ("closed", 1e-14, [10_000, 3, 3]),
        ("stepped", 1e-9, [2, 3, 3, 3]),
        ("explicit", 1e-14, [10_000, 3, 3]),
    ):
        case = found.pop(name)
        assert case.pop("away") < bound
        assert case == {"kept": True, "energy": True, "each": each, "exchanges": []}
    assert "in different ways" in found.pop("mixed")
    same = [True, True, True]
    assert found == {
        "devices": 8,
        "wxyz": same,
        "omega_body": same,
        "status": same,
        "collectives": [],
        "used": 8,
        "layouts": ["1 x cpu (cpu)", "8 x cpu (cpu)"],
    }
