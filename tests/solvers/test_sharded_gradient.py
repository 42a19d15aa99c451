"""The gradient of a batch that is sharded over devices equals that of the batch on one."""

from pathlib import Path

import pytest
from devices import told_by


@pytest.mark.slow
@pytest.mark.parametrize("names", [("top",), ("free", "damped")], ids=" ".join)
def test_two_devices_give_the_gradient_of_one(names):
    found = told_by(Path(__file__).with_name("sharded_gradient.py"), *names)
    assert set(found) == set(names)
    for name, case in found.items():
        assert case["kept"], name  # the slopes of each body stay where the body is
        assert max(case["away"]) < 1e-11, name
        assert case["size"][0] > 0.1, name
        assert name == "free" or case["size"][1] > 0.1, name  # of a number that all share
