"""Every conversion against 120-digit arithmetic: the stress test with few random samples."""

import numpy as np
import pytest

from benchmarks import rotation_cases, rotation_stress
from polhode.rotation import Sequence

# value: the documented bound; derivatives: about twice the maximum of the full table
BOUNDS = {"value": 4.0, "first": 12.0, "second": 24.0}
CASES = rotation_cases.plain_cases(4)
for _sequence in (Sequence.ZYZ, Sequence.ZXY_SPACE):
    CASES += rotation_cases.euler_cases(_sequence, 4, stride=3)


PLAIN = "wxyz -> matrix", "matrix -> wxyz"  # in single precision; the other formulas: slow
SINGLE = [
    pytest.param(
        case,
        np.float32,
        id=f"{case.name}-float32",
        marks=() if case.name in PLAIN else pytest.mark.slow,
    )
    for case in CASES
]


@pytest.mark.parametrize(
    ("case", "dtype"),
    [*(pytest.param(case, np.float64, id=f"{case.name}-float64") for case in CASES), *SINGLE],
)
def test_worst_errors_against_mpmath(case, dtype):
    worst = rotation_stress.measure_case(case, dtype)
    assert all(worst[name] <= BOUNDS[name] for name in BOUNDS), worst
