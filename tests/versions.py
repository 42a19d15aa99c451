"""``make test-versions``: smoke.py on the lowest and the newest versions of what polhode needs.

Each set has an environment of its own beside the checkout, ``.venv-lowest`` and ``.venv-newest``,
made with the interpreter that runs this file (JAX from 0.11 on needs Python 3.12) and holding every
extra; name one set to run it alone. The lowest set is read from pyproject.toml.

``python tests/versions.py next`` installs the newest JAX that exists, beyond the upper bound, and
runs smoke.py and the functions that XLA folds away with fused kernels requested. Where both pass,
the version may be added to ``FUSED_JAXLIB`` in ``src/polhode/_policy.py``, which is the table of
versions on which fused kernels are used, and the bound raised.
"""

import os
import re
import subprocess
import sys
import tomllib
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def floors() -> list[str]:
    """``name==version`` of the dependencies and of those of every extra, at the floors."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
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
    environment, scripts = dict(os.environ), ["smoke.py"]
    if name == "next":
        subprocess.run([*install, "--upgrade", "--no-deps", "jax", "jaxlib"], check=True)
        environment["POLHODE_PLAIN"] = "0"
        scripts.append("xla/folding_units.py")
    codes = []
    for script in scripts:
        print(f"{name}, {script}: ", end="", flush=True)
        command = [str(python), str(ROOT / "tests" / script)]
        codes.append(subprocess.run(command, env=environment).returncode)
    return max(codes)


if __name__ == "__main__":
    codes = [run(name) for name in sys.argv[1:] or ("lowest", "newest")]
    sys.exit(max(codes))
