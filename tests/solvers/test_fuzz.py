"""A part of the fuzz test of all scene parts (`benchmarks/fuzz.py`).

Motions and derivatives of random scenes against SciPy's DOP853 with equations in plain Python.
"""

import jax
import numpy as np
import pytest

from benchmarks import fuzz
from benchmarks.fuzz_parts import PARTS

SEED = 20261125


@pytest.mark.parametrize("part", PARTS, ids=lambda part: part.name)
@pytest.mark.slow  # 10 s to 60 s each, most of it in compiling and in the reference
def test_random_motions_of_a_part_keep_rtol(part):
    """All runs of regular motions have errors below 10 rtol, at four tolerances; none is flagged
    except friction in a narrow layer, which is stiff.
    """
    rows = list(fuzz.results(fuzz.Group((part,), "float64", False), 3, SEED, 30.0))
    ran = [row for row in rows if "kind" in row]
    assert not [row for row in rows if "raised" in row]
    assert ran, f"all cases were left out: {rows}"
    assert not [row for row in ran if row["kind"] == "beyond"]
    if not part.name.endswith("narrow"):
        assert not [row for row in ran if row["kind"] == "flagged"]
    jax.clear_caches()


# Parts whose derivatives tests/systems, test_every_torque and test_switches do not compare with an
# independent motion, or which change more slowly than those; the script compares all of them.
DIFFERENTIATED = (
    "UniformGravity.axial, axisymmetric",
    "GravityGradient, ellipse",
    "Potential",
    "SpaceTorque of time",
    "RateDamping",
    "RelativeTorque(LinearDamping), ellipse",
    "MagneticDipole",
    "BDot on an orbit, limited",
    "Rotor, ViscousCoupling",
    "Rotor, Motor with limits",
    "Inertia with products",
)


@pytest.mark.parametrize(
    "part", [part for part in PARTS if part.name in DIFFERENTIATED], ids=lambda part: part.name
)
@pytest.mark.slow
def test_derivatives_of_a_part_keep_rtol(part):
    """Median error at most 50 rtol and maximum 1,000 rtol, against differences of the reference,
    whose own rounding error is up to 1e-9.
    """
    rows = [row for row in fuzz.derivatives(part, "float64", 1, SEED, 30.0) if row["status"] == 0]
    if not rows:
        pytest.skip("no reference: a small change of the case adds or removes a switch")
    ratios = [row["error"] / (row["rtol"] + 1e-9 / 50) for row in rows]
    assert np.median(ratios) <= 50
    assert max(ratios) <= 1000
    jax.clear_caches()
