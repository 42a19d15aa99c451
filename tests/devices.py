"""Run scripts that use two host devices; the number cannot be changed within a process."""

import json
import subprocess
import sys
from pathlib import Path


def told_by(script: Path, *words: str) -> dict:
    """The JSON of a script's last line of output, without its number of devices, which must be two.

    ``words``: arguments of the script.
    """
    done = subprocess.run(
        [sys.executable, str(script), *words], capture_output=True, timeout=900, text=True
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found.pop("devices") == 2
    return found
