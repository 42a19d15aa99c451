"""First and second derivatives against differences of 60-digit values, in both dtypes."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

from polhode._closed_forms import elliptic

TABLE = json.loads((Path(__file__).parent / "slopes.json").read_text())
# Relative to the largest entry of the row: (float64, float32).
FIRST = (4e-14, 2e-5)
SECOND = 3e-12


def _stacked(name):
    function = getattr(elliptic, name)
    if name == "ellipj":
        return lambda *arguments: jnp.stack(function(*arguments))
    return lambda *arguments: function(*arguments)[None]


def _columns(name, dtype):
    return [jnp.asarray(column, dtype) for column in zip(*(row[0] for row in TABLE[name]))]


def _floats(nested):
    return np.array([[[float(x) for x in part] for part in row] for row in nested])


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("name", sorted(TABLE))
def test_first_derivatives(name, dtype):
    columns = _columns(name, dtype)
    order = tuple(range(len(columns)))
    slopes = jax.jit(jax.vmap(jax.jacrev(_stacked(name), order)))(*columns)
    found = np.stack([np.asarray(slope) for slope in slopes], axis=-1)
    truth = _floats([row[1] for row in TABLE[name]])
    limit = FIRST[0 if dtype == np.float64 else 1]
    error = np.abs(found - truth) / np.maximum(np.abs(truth), np.abs(truth).max() * 1e-3)
    at = np.unravel_index(np.argmax(error), error.shape)
    assert error.max() <= limit, (TABLE[name][at[0]][0], at, error.max())


# The complete third kind and the incomplete second have the same rules in less to compile.
SLOW = {"ellippi_inc": pytest.mark.slow}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=SLOW.get(name, ())) for name in sorted(TABLE)]
)
def test_second_derivatives(name):
    columns = _columns(name, np.float64)
    everything = range(len(columns))
    # The angle of the third kind has its slope in closed form: n and m are what needs a test.
    order = (0, 2) if name == "ellippi_inc" else tuple(everything)
    nested = jax.jit(jax.vmap(jax.jacfwd(jax.jacrev(_stacked(name), order), order)))(*columns)
    table = [(i, j) for i in everything for j in everything if i <= j]
    pairs = [(order.index(i), order.index(j)) for i, j in table if {i, j} <= set(order)]
    kept = [k for k, (i, j) in enumerate(table) if {i, j} <= set(order)]
    found = np.stack([np.asarray(nested[i][j]) for i, j in pairs], axis=-1)
    mirror = np.stack([np.asarray(nested[j][i]) for i, j in pairs], axis=-1)
    truth = _floats([row[2] for row in TABLE[name]])[..., kept]
    scale = np.maximum(np.abs(truth), np.abs(truth).max(axis=(1, 2), keepdims=True) * 1e-3)
    scale = np.maximum(scale, 1e-3)
    for matrix in (found, mirror):
        error = np.abs(matrix - truth) / scale
        at = np.unravel_index(np.argmax(error), error.shape)
        assert error.max() <= SECOND, (TABLE[name][at[0]][0], at, error.max())


def test_reverse_over_reverse_through_the_duplications():
    twice = jax.jit(jax.grad(jax.grad(elliptic.carlson_rd), 2))(0.4, 0.7, 2.0)
    mp.mp.dps = 40
    truth = mp.diff(mp.elliprd, (mp.mpf(0.4), mp.mpf(0.7), mp.mpf(2)), (1, 0, 1))
    assert twice == pytest.approx(float(truth), rel=1e-12)


def test_the_parameter_pair_is_differentiated_once():
    def both(x):
        return elliptic.ellipk(1 - x, m1=x)

    def one(x):
        return elliptic.ellipk(1 - x)

    slope, other = (jax.jit(jax.vmap(jax.grad(f))) for f in (both, one))
    second, other_second = (jax.jit(jax.vmap(jax.grad(jax.grad(f)))) for f in (both, one))
    x = jnp.array([1e-3, 0.3, 0.7])
    np.testing.assert_allclose(slope(x), other(x), rtol=1e-13)
    np.testing.assert_allclose(second(x), other_second(x), rtol=1e-12)
    # m itself no longer knows about m1 = 1e-20: dK/dm1 = -1/(2 m1) to leading order.
    assert jax.jit(jax.grad(both))(1e-20) == pytest.approx(-0.5e20, rel=1e-14)


def test_right_angle_and_small_angle_slopes():
    slope = jax.jit(jax.grad(lambda m: elliptic.ellippi_inc_sincos(-3.0, 1.0, 0.0, m)))(0.4)
    complete = jax.jit(jax.grad(elliptic.ellippi, 1))(-3.0, 0.4)
    assert slope == pytest.approx(float(complete), rel=1e-13)
    # dF/dm = phi^3/6 and dE/dm = -phi^3/6 for small angles, without cancellation.
    phi = 1e-5
    of_f, of_e = (jax.jit(jax.grad(f, 1))(phi, 0.4) for f in (elliptic.ellipf, elliptic.ellipe_inc))
    assert of_f == pytest.approx(phi**3 / 6, rel=1e-9)
    assert of_e == pytest.approx(-(phi**3) / 6, rel=1e-9)


def test_carlson_slopes():
    mp.mp.dps = 40
    cases = {
        "rf": [(0.3, 0.4, 2.0), (1.0, 1.0, 1.0), (1e-6, 1.0, 5.0)],
        "rc": [(0.3, 2.0), (1.0, 1.0), (1.0, 1.019), (1.0, 1.021), (2.0, 0.1)],
        "rd": [(0.3, 0.4, 2.0), (1.0, 1.0, 1.0), (1e-6, 1.0, 5.0)],
        "rj": [(0.3, 0.4, 2.0, 0.7), (1.0, 1.0, 1.0, 1.0), (0.1, 1.0, 1.1, 1e6)],
    }
    for kind, places in cases.items():
        size = len(places[0])
        gradient = jax.jit(jax.vmap(jax.grad(getattr(elliptic, f"carlson_{kind}"), range(size))))
        found = np.stack(gradient(*map(jnp.asarray, zip(*places, strict=True))), axis=-1)
        exact = getattr(mp, f"ellip{kind}")
        for row, place in zip(found, places, strict=True):
            for i in range(size):
                order = tuple(int(k == i) for k in range(size))
                at = tuple(map(mp.mpf, place))
                # mpmath's own forms have removable 0/0 at equal arguments: step aside a little.
                at = tuple(x * (1 + mp.mpf(10) ** -22 * k) for k, x in enumerate(at))
                truth = float(mp.re(mp.diff(exact, at, order, h=mp.mpf(10) ** -12)))
                assert row[i] == pytest.approx(truth, rel=2e-13), (kind, place, i)
