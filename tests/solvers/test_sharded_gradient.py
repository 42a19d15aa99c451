"""The gradient of a batch that is sharded over devices is that of the batch on one."""

import json
import subprocess
import sys
from pathlib import Path


def test_two_devices_give_the_gradient_of_one():
    script = Path(__file__).with_name("sharded_gradient.py")
    done = subprocess.run(
        [sys.executable, str(script)], capture_output=True, timeout=300, text=True
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found.pop("devices") == 2
    assert set(found) == {"free", "top", "damped"}
    for name, case in found.items():
        assert case["kept"], name  # the slopes of each body stay where the body is
        assert max(case["away"]) < 1e-11, name
        assert case["size"][0] > 0.1, name
        assert name == "free" or case["size"][1] > 0.1, name  # of a number that all share
