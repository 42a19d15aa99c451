"""Eight forced host devices give the bits of one, without a collective in the compiled program."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("zarr")


def test_eight_devices_are_as_one_and_exchange_nothing(tmp_path):
    script = Path(__file__).with_name("eight_devices.py")
    done = subprocess.run(
        [sys.executable, str(script), str(tmp_path)], capture_output=True, timeout=300, text=True
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found == {
        "devices": 8, "wxyz": True, "omega_body": True, "status": True, "collectives": [],
        "shards": 8, "rows": 8192,
        "same": True, "kept": True, "each": 10_000, "exchanges": [],
    }  # fmt: skip
