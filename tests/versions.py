"""``make test-versions``: run smoke.py with the lowest and the newest versions of the dependencies.

Each set has its own environment in the checkout, ``.venv-lowest`` and ``.venv-newest``, created
with the interpreter that runs this file (JAX 0.11 and newer need Python 3.12) and including every
extra; the name of a set runs it alone. The lowest set is read from pyproject.toml.

``python tests/versions.py next`` installs the newest JAX, beyond the upper bound. With fused
kernels enabled it runs smoke.py, the functions that XLA simplifies to constants, and the tests that
depend on JAX's own operations: kernels and switches of programs. If they pass, add the version to
``FUSED_JAXLIB`` in ``src/polhode/_policy.py``, the table of versions with which fused kernels are
used, raise the bound, and run all tests.
"""

import os
import re
import subprocess
import sys
import tomllib
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
OF_OPERATIONS = ("tests/xla", "tests/solvers/test_switches.py")
"""Tests of what polhode does with the operations that a program of JAX consists of."""


def floors() -> list[str]:
    """``name==version`` of the dependencies and of those of every extra, at their lower bounds."""
    project = PROJECT["project"]
    needs = {*project["dependencies"]}.union(*project["optional-dependencies"].values())
    needs = sorted(need for need in needs if not need.startswith("polhode["))
    found = [re.fullmatch(r"([\w-]+)>=([\d.]+)(,<[\d.]+)?", need) for need in needs]
    assert all(found), needs
    exact = dict(match.group(1, 2) for match in found if match)
    assert len(exact) == len(needs), f"two floors of one package: {needs}"
    exact["jaxlib"] = exact["jax"]
    return [f"{name}=={number}" for name, number in exact.items()]


def run(name: str) -> int:
    folder = ROOT / f".venv-{name}"
    python = folder / "bin" / "python"
    if not python.exists():
        venv.create(folder, with_pip=True)
    pins = floors() if name == "lowest" else ["--upgrade", "--upgrade-strategy", "eager"]
    install = [str(python), "-m", "pip", "install", "--quiet"]
    subprocess.run([*install, f"{ROOT}[all]", *pins], check=True)
    environment, commands = dict(os.environ), [["tests/smoke.py"]]
    if name == "next":
        subprocess.run([*install, *PROJECT["dependency-groups"]["test"]], check=True)
        subprocess.run([*install, "--upgrade", "--no-deps", "jax", "jaxlib"], check=True)
        environment["POLHODE_PLAIN"] = "0"
        commands.append(["tests/xla/folding_units.py"])
        commands.append(["-m", "pytest", "-q", "-m", "not slow", *OF_OPERATIONS])
    codes = []
    for command in commands:
        print(f"{name}, {' '.join(command)}: ", end="", flush=True)
        done = subprocess.run([str(python), *command], env=environment, cwd=ROOT)
        codes.append(done.returncode)
    return max(codes)


if __name__ == "__main__":
    codes = [run(name) for name in sys.argv[1:] or ("lowest", "newest")]
    sys.exit(max(codes))
