"""Phase functions against published tables and another implementation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from polhode import lightcurve
from polhode.lightcurve import _brightness

# (1) Ceres and (24) Themis every 20 degrees, as sbpy 0.5 gives them (absolute magnitudes off).
TWENTIES = jnp.radians(jnp.arange(0.0, 160.0, 20.0))
CERES = (
    np.array(
        [3.34, 4.37957695, 4.97935011, 5.55797517, 6.20811269, 7.03560828, 8.2295693, 10.19445176]
    )
    - 3.34
)
THEMIS = (
    np.array(
        [
            7.063,
            8.07436233,
            8.68048572,
            9.29834638,
            9.96574599,
            10.72080704,
            11.52317465,
            12.15094612,
        ]
    )
    - 7.063
)


@pytest.mark.parametrize(
    ("phase", "coefficients", "published"),
    [(lightcurve.HG(), [0.12], CERES), (lightcurve.HG1G2(), [0.62, 0.14], THEMIS)],
)
def test_published_values(phase, coefficients, published):
    found = phase.magnitudes(TWENTIES, jnp.asarray(coefficients))
    np.testing.assert_allclose(found, published, atol=2e-6)


@pytest.mark.parametrize("table", ["_FIRST", "_SECOND", "_THIRD"])
def test_slopes_printed_are_those_of_the_cubic_spline(table):
    """The inner derivatives follow from the values and the end derivatives: one spline."""
    interpolate = pytest.importorskip("scipy.interpolate")
    values, slopes = getattr(_brightness, table)
    knots = _brightness._NEAR if table == "_THIRD" else _brightness._KNOTS
    ends = ((1, slopes[0]), (1, slopes[-1]))
    spline = interpolate.CubicSpline(knots, values, bc_type=ends)
    np.testing.assert_allclose(spline(knots, 1), slopes, atol=1e-6)
    inside = np.linspace(knots[0], knots[-1], 50)
    mine = _brightness._spline(knots, (values, slopes), jnp.asarray(inside))
    np.testing.assert_allclose(mine, spline(inside), atol=1e-7)


@pytest.mark.parametrize(
    "phase",
    [lightcurve.SeeligerPhase(), lightcurve.LinearPhase(), lightcurve.HG(), lightcurve.HG1G2()],
)
def test_every_phase_function_starts_at_zero_and_has_derivatives(phase):
    alpha, typical = jnp.radians(jnp.array([0.0, 10.0, 170.0])), jnp.asarray(phase.typical, float)
    found = phase.magnitudes(alpha, typical)
    assert found[0] == pytest.approx(0, abs=1e-12)
    assert bool(jnp.all(jnp.diff(found) > 0))
    slopes = jax.jacfwd(lambda c: phase.magnitudes(alpha, c))(typical)
    assert bool(jnp.all(jnp.isfinite(slopes)))
