"""The kinetic energy is written in a single line.

A copy of the package with another factor in this line integrates, in both coordinates, and
differentiates the motion of the other energy. H = 1.1 T + V is the Hamiltonian of a body with
inertia I / 1.1 and the same momentum. The reference is the original package with that inertia.
"""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from hamiltonian import motions

import polhode as ph

FACTOR = 1.1
SOURCE = Path(ph.__file__).parent
LINE = "kinetic = twice / 2\n"


@pytest.fixture(scope="module")
def by_another_energy(tmp_path_factory):
    """Output of ``motions.py`` for a kinetic energy multiplied by ``FACTOR``."""
    folder = tmp_path_factory.mktemp("energy")
    shutil.copytree(SOURCE, folder / "polhode", ignore=shutil.ignore_patterns("__pycache__"))
    stated = [path for path in folder.rglob("*.py") if LINE in path.read_text(encoding="utf-8")]
    (energy,) = stated
    assert energy.relative_to(folder) == Path("polhode", "_hamiltonian", "_energy.py")
    text = energy.read_text(encoding="utf-8")
    assert text.count(LINE) == 1
    energy.write_text(text.replace(LINE, f"kinetic = {FACTOR} * twice / 2\n"), encoding="utf-8")

    def run(quantity: str, *cases: str) -> dict[str, np.ndarray]:
        command = [sys.executable, motions.__file__, quantity, *cases]
        environment = os.environ | {"PYTHONPATH": str(folder)}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=600)
        assert done.returncode == 0, done.stderr
        return {case: np.array(value) for case, value in json.loads(done.stdout).items()}

    return run


def test_both_coordinates_follow_the_one_kinetic_energy(by_another_energy):
    """A free body rotates ``FACTOR`` times as fast, a heavy top as one with smaller inertia."""
    found = by_another_energy("values", "Lie-Poisson", "Euler angles")
    x = jnp.array(motions.START)
    lighter, unchanged = (np.array(motions.values("Lie-Poisson", x, f)) for f in (FACTOR, 1.0))
    scene = ph.Scene(ph.Inertia.from_moments(motions.MOMENTS))
    state = ph.State(motions.WXYZ, motions.OMEGA)
    faster = ph.simulate(scene, state, [FACTOR * t for t in motions.TIMES])
    assert np.min(np.max(np.abs(lighter - unchanged), axis=(1, 2))) > 0.05
    for case, samples in found.items():
        side = np.sum(samples[..., :4] * lighter[..., :4], axis=-1, keepdims=True)
        samples[..., :4] *= np.sign(side)
        np.testing.assert_allclose(samples, lighter, atol=1e-9, err_msg=case)
        free = ph.rotation.angle_between(samples[1, :, :4], faster.wxyz)
        np.testing.assert_allclose(free, 0, atol=1e-9, err_msg=case)
        np.testing.assert_allclose(samples[1, :, 4:], faster.momentum_body, atol=1e-9)


@pytest.mark.slow
def test_gradients_follow_the_one_kinetic_energy(by_another_energy):
    """Gradients of the flow in both coordinates, and of steps that end at switches."""
    for case, gradient in by_another_energy("gradients", *motions.CASES).items():
        lighter, unchanged = (
            np.array(motions.gradients(case, jnp.array(motions.START), f)) for f in (FACTOR, 1.0)
        )
        assert np.max(np.abs(lighter - unchanged)) > 0.05, case
        np.testing.assert_allclose(gradient, lighter, rtol=1e-7, atol=1e-8, err_msg=case)


def test_the_readme_names_the_test_of_the_closed_forms():
    """The command of the README selects the test that autodiff of H equals V, Theta and Psi."""
    root = Path(__file__).resolve().parents[2]
    commands = re.findall(r"^pytest (\S+) -k (\w+)$", (root / "README.md").read_text("utf-8"), re.M)
    assert commands == [("tests/hamiltonian/test_document_000.py", "test_autodiff_is_document_000")]
    ((file, name),) = commands
    assert f"def {name}(" in (root / file).read_text("utf-8")
