"""Values against the table of make_truth.py, limits, thresholds, shapes and domain."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

from polhode._closed_forms import elliptic

ROWS = json.loads((Path(__file__).parent / "values.json").read_text())
# Worst ulps of the full run of benchmarks/elliptic_accuracy.py are 1 to 4.7.
MOST_ULPS = 5.0


def _found(name, arguments):
    function = getattr(elliptic, name)
    if name.startswith("carlson"):
        return (np.asarray(function(*arguments)),)
    *rest, m1 = arguments
    value = function(*rest, m1=m1)
    return tuple(map(np.asarray, value)) if name == "ellipj" else (np.asarray(value),)


@pytest.mark.parametrize("cell", sorted(ROWS))
def test_values_are_within_a_few_ulps(cell):
    name, dtype = cell.split()
    eps = float(np.finfo(dtype).eps)
    columns = np.array([row[0] for row in ROWS[cell]], dtype).T
    found = _found(name, tuple(columns))
    assert all(array.dtype == dtype for array in found)
    mp.mp.dps = 30
    for i, (at, allowances, texts) in enumerate(ROWS[cell]):
        for k, text in enumerate(texts):
            value = mp.mpf(text)
            scale = 1 if name == "ellipj" and k < 2 else abs(value)
            error = abs(mp.mpf(float(found[k][i])) - value)
            limit = eps * (MOST_ULPS * scale + allowances[k])
            assert error <= limit, (name, dtype, at, k, float(error / eps))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_limits_are_exact(dtype):
    zero, one = dtype(0), dtype(1)
    tolerance = 2 * float(np.finfo(dtype).eps)
    half_pi = np.pi / 2
    assert elliptic.ellipk(zero) == pytest.approx(half_pi, rel=tolerance)
    assert elliptic.ellipe(zero) == pytest.approx(half_pi, rel=tolerance)
    assert elliptic.ellipe(one) == 1
    assert elliptic.associate_b(one) == 1
    for infinite in (
        elliptic.ellipk(one),
        elliptic.associate_d(one),
        elliptic.ellippi(dtype(-3), one),
        elliptic.ellippi(one, dtype(0.3)),
        elliptic.ellipf_sincos(one, zero, one),
        elliptic.ellippi_inc_sincos(dtype(-3), one, zero, one),
    ):
        assert infinite == np.inf
    assert elliptic.ellipe_inc_sincos(one, zero, one) == 1
    u = dtype(1.25)
    sn, cn, dn, am = elliptic.ellipj(u, one)
    np.testing.assert_allclose(
        [sn, cn, dn, am],
        [np.tanh(1.25), 1 / np.cosh(1.25), 1 / np.cosh(1.25), 2 * np.arctan(np.tanh(0.625))],
        rtol=4 * np.finfo(dtype).eps,
    )
    sn, cn, dn, am = elliptic.ellipj(u, zero)
    np.testing.assert_allclose(
        [sn, cn, dn, am],
        [np.sin(1.25), np.cos(1.25), 1, 1.25],
        rtol=4 * np.finfo(dtype).eps,
    )
    np.testing.assert_array_equal(elliptic.ellipj(zero, one), [0, 1, 1, 0])


def test_outside_the_domain_is_nan_in_value_and_slope():
    def everything(m):
        return jnp.stack(
            [
                elliptic.ellipk(m),
                elliptic.ellipe(m),
                *elliptic.ellipj(0.3, m),
                elliptic.ellipf(0.3, m),
                elliptic.ellipe_inc(0.3, m),
                elliptic.ellippi(-2.0, m),
                elliptic.ellippi_inc(-2.0, 0.3, m),
            ]
        )

    values_and_slopes = jax.jit(lambda m: jax.jvp(everything, (m,), (jnp.ones_like(m),)))
    for m in (-0.1, 1.1, np.nan):
        values, slopes = values_and_slopes(m)
        assert np.isnan(values).all()
        assert np.isnan(slopes).all()
    assert np.isfinite(values_and_slopes(0.4)).all()
    assert np.isnan(elliptic.ellippi(1.5, 0.3))
    assert np.isnan(jax.jvp(lambda n: elliptic.ellippi(n, 0.3), (1.5,), (1.0,))[1])
    assert np.isnan(elliptic.ellippi_inc(1.5, 0.2, 0.3))
    assert np.isnan(elliptic.ellippi_inc_sincos(1.5, 1.0, 0.0, 1.0))
    assert np.isnan(elliptic.carlson_rf(0.0, 0.0, 1.0))
    assert np.isnan(elliptic.carlson_rf(-1.0, 1.0, 1.0))
    assert np.isnan(elliptic.carlson_rc(1.0, 0.0))
    assert np.isnan(elliptic.carlson_rd(1.0, 1.0, 0.0))
    assert np.isnan(elliptic.carlson_rj(1.0, 1.0, 1.0, -1.0))


def test_principal_value_of_rc():
    mp.mp.dps = 30
    x, y = np.array([0.3, 2.0, 0.0]), np.array([-0.4, -1e-3, -1.0])
    truth = [float(mp.re(mp.elliprc(a, b))) for a, b in zip(x, y, strict=True)]
    np.testing.assert_allclose(elliptic.carlson_rc(x, y), truth, rtol=1e-15, atol=0)


@pytest.mark.parametrize("ratio", [1e-12, 1e-6, 1e6, 1e12, 1e24])
def test_rj_with_a_far_fourth_argument(ratio):
    mp.mp.dps = 40
    for x, y, z in ((0.0, 0.3, 1.0), (0.2, 0.9, 1.1)):
        truth = float(mp.elliprj(x, y, z, ratio))
        assert elliptic.carlson_rj(x, y, z, ratio) == pytest.approx(truth, rel=1e-15)


def test_huge_characteristic_stays_finite():
    for n in (-1e12, -1e100, -1e300):
        mp.mp.dps = 700
        big = mp.mpf(n)
        truth = mp.elliprf(0, 0.75, 1) + big / 3 * mp.elliprj(0, 0.75, 1, 1 - big)
        assert elliptic.ellippi(n, 0.25) == pytest.approx(float(truth), rel=1e-15)


def _jump(function, below, above, slope_scale):
    left, right = float(function(below)), float(function(above))
    return abs(right - left) / (np.finfo(float).eps * max(abs(left), slope_scale))


def test_no_jump_at_any_threshold():
    def neighbours(x):
        return np.nextafter(x, -np.inf), np.nextafter(x, np.inf)

    cases = [
        (elliptic.ellipk, 0.5),
        (elliptic.ellipe, 0.5),
        (elliptic.associate_b, 0.5),
        (elliptic.associate_d, 0.5),
        (lambda m: elliptic.ellipj(1.3, m)[0], 0.5),
        (lambda m: elliptic.ellipj(1.3, m)[2], 0.5),
        (lambda m: elliptic.ellipf(1.3, m), 0.5),
        (lambda m: elliptic.ellipe_inc(1.3, m), 0.5),
        (lambda n: elliptic.ellippi(n, 0.2), -1.0),
        (lambda n: elliptic.ellippi(n, 0.2), 0.5),
        (lambda n: elliptic.ellippi(n, 0.64), 0.8),
        (lambda n: elliptic.ellippi_inc(n, np.pi / 4, 0.2), -1.0),
        (lambda e: elliptic.carlson_rc(1.0, 1 + e), 0.02),
        (lambda e: elliptic.carlson_rc(1.0, 1 + e), -0.02),
    ]
    for function, threshold in cases:
        assert _jump(function, *neighbours(threshold), 0) < 12
    # Slopes across the hand-over from the series in sn to the theta series.
    for m in (0.3, 0.8):
        slope = jax.grad(lambda u, m=m: elliptic.ellipf(u, m))
        assert _jump(slope, *neighbours(0.17), 0) < 12
        along_m = jax.grad(lambda m, u: elliptic.ellipj(u, m)[3])
        below, above = (along_m(m, u) for u in neighbours(0.17))
        assert abs(above / below - 1) < 1e-12


def test_the_complement_keeps_what_m_loses():
    m1 = np.array([1e-20, 1e-100, 1e-300])
    np.testing.assert_allclose(
        elliptic.ellipk(np.ones(3), m1=m1), np.log(4 / np.sqrt(m1)), rtol=4e-16
    )


def test_long_arguments_keep_their_phase():
    mp.mp.dps = 40
    for m in (0.3, 0.9999):
        u = 1e6 + 0.123
        truth = mp.ellipfun("sn", mp.mpf(u), m=mp.mpf(m))
        assert abs(float(elliptic.ellipj(u, m)[0] - float(truth))) < u * np.finfo(float).eps


def test_shapes_broadcast_and_batch():
    u, m = np.linspace(-3, 3, 12).reshape(3, 4), np.linspace(0, 1, 3)[:, None]
    whole = elliptic.ellipj(u, m)
    assert all(part.shape == (3, 4) for part in whole)
    rows = jax.vmap(elliptic.ellipj)(jnp.asarray(u), jnp.broadcast_to(m, (3, 4)))
    np.testing.assert_allclose(np.array(whole), np.array(rows), rtol=1e-14, atol=1e-15)
    assert elliptic.ellippi(np.full((3, 1), -2.0), np.full((1, 4), 0.3)).shape == (3, 4)
    assert elliptic.ellippi_inc(-2.0, u, 0.3).shape == (3, 4)
    assert elliptic.ellipk(0).dtype == jnp.result_type(float)


def test_sine_and_cosine_of_any_length_and_quadrant():
    angles = np.linspace(-3.1, 3.1, 9)
    s, c = 700 * np.sin(angles), 700 * np.cos(angles)
    for first, second in (
        (elliptic.ellipf(angles, 0.6), elliptic.ellipf_sincos(s, c, 0.6)),
        (
            elliptic.ellippi_inc(-4.0, angles, 0.6),
            elliptic.ellippi_inc_sincos(-4.0, s, c, 0.6),
        ),
    ):
        np.testing.assert_allclose(first, second, rtol=1e-14, atol=0)
