"""Every conversion against 120-digit arithmetic: the stress table with few random samples."""

import numpy as np
import pytest

from benchmarks import rotation_cases, rotation_stress
from polhode.rotation import Sequence

# value: the promised bound; derivatives: worst of the full table, times about two
BOUNDS = {"value": 4.0, "first": 12.0, "second": 24.0}
CASES = rotation_cases.plain_cases(4)
for _sequence in (Sequence.ZYZ, Sequence.ZXY_SPACE):
    CASES += rotation_cases.euler_cases(_sequence, 4, stride=3)


@pytest.mark.parametrize("dtype", [np.float64, np.float32], ids=["float64", "float32"])
@pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
def test_worst_errors_against_mpmath(case, dtype):
    worst = rotation_stress.measure_case(case, dtype)
    assert all(worst[name] <= BOUNDS[name] for name in BOUNDS), worst
