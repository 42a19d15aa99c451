"""Fits of light curves share the programs that take long to compile."""

import jax.numpy as jnp
import numpy as np
import pytest

from polhode import lightcurve
from polhode.lightcurve import _least_squares
from polhode.lightcurve._brightness import Bodies


def problem(points, nights):
    """Least-squares problem of a light curve with an offset for each night."""
    t = np.linspace(0, nights, points)
    sun, observer = np.tile([1.0, 0, 0], (points, 1)), np.tile([0.6, 0.48, 0.64], (points, 1))
    curve = lightcurve.LightCurve.of(
        t, np.sin(9 * t), sun, observer, sigma=0.02, group=np.minimum(t.astype(int), nights - 1)
    )
    return _least_squares.Problem(lightcurve.SeeligerPhase(), curve.points(0.01))


@pytest.mark.slow
def test_one_program_of_light_serves_other_numbers_of_points_and_nights():
    for function in (_least_squares._light_and_derivatives, _least_squares.robust_equations):
        function.clear_cache()
    many = 7 + len(lightcurve.SeeligerPhase().typical)
    unknowns = np.tile(np.r_[-0.3, -0.6, -0.3, -0.6, 1.0, 2.0, 3.0, np.zeros(many - 7)], (32, 1))
    bodies = Bodies(unknowns, np.tile([1.0, 0, 0, 0], (32, 1)))
    costs = []
    for points, nights in ((100, 3), (400, 9)):
        each = problem(points, nights)
        offsets = np.zeros((32, each.columns))
        costs.append(each.evaluate(bodies, offsets, np.full(32, 3.0)).cost)
    assert _least_squares._light_and_derivatives._cache_size() == 1
    assert _least_squares.robust_equations._cache_size() == 2  # the part that compiles at once
    assert all(jnp.all(jnp.isfinite(cost)) for cost in costs)
