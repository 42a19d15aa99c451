"""What a script tells that is run with two host devices, which one process cannot change."""

import json
import subprocess
import sys
from pathlib import Path


def told_by(script: Path, *words: str) -> dict:
    """The JSON of its last line, given some words, without the count of devices."""
    done = subprocess.run(
        [sys.executable, str(script), *words], capture_output=True, timeout=900, text=True
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found.pop("devices") == 2
    return found
