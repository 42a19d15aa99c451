"""Second derivatives of the closed-form free motion against 50 digits (second_cases.json)."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from polhode._closed_forms import free_motion

START = (0.5, -0.125, 0.75, 0.5)
CASES = json.loads(Path(__file__).with_name("second_cases.json").read_text())


@pytest.mark.slow  # 30 s of compilation
@pytest.mark.parametrize("products", [False, True], ids=["moments", "tensors"])
def test_second_derivatives(products):
    """Forward over reverse mode. ``products``: with respect to products of inertia, which adds the
    derivatives of the principal axes to the program; otherwise along directions without them.
    """
    dtype = np.float64
    rows = {True: 0, False: 0}

    def numbers(x, weights):
        wxyz = tuple(jnp.asarray(START, x.dtype))
        given = tuple(x[:3]), wxyz, tuple(x[6:9]), x[9]
        rates, attitude = free_motion(*given, tuple(x[3:6]) if products else None)
        return jnp.dot(weights, jnp.stack([*attitude, *rates]))

    @jax.jit
    @jax.vmap
    def slopes(x, weights, move):
        return jax.jvp(lambda y: jax.grad(numbers)(y, weights), (x,), (move,))

    def column(values):
        return jnp.asarray(np.array(values), dtype)

    x = column([[*c["moments"], 0, 0, 0, *c["omega"], c["t"]] for c in CASES])
    given = tuple(x[:, :3].T), tuple(column(START)), tuple(x[:, 6:9].T), x[:, 9]
    lanes = jax.jit(lambda *given: free_motion(*given, rates=False)[1])
    attitudes = np.stack(lanes(*given), axis=-1)
    weights = np.random.default_rng(8).normal(size=(len(CASES), 7)).astype(dtype)
    for k in range(4):
        first, second = (np.array([c["pairs"][k][n] for c in CASES]) for n in (0, 1))
        _, found = slopes(x, jnp.asarray(weights), column(second))
        found = np.sum(np.asarray(found, float) * first, axis=-1)
        for n, case in enumerate(CASES):
            if not products and (np.any(first[n, 3:6]) or np.any(second[n, 3:6])):
                continue
            sign = np.sign(np.dot(attitudes[n], case["wxyz_t"]))
            exact = np.array(case["second"][k]) * np.array([sign] * 4 + [1] * 3)
            size = max(1, *(np.linalg.norm(row) for row in case["second"]))
            size *= np.linalg.norm(weights[n])
            off = abs(found[n] - np.dot(weights[n], exact)) / size
            # Larger bounds: growth by sixteen e-folds at the unstable axis, squared by the second
            # derivative; small rotation angles; axes of nearly equal moments, which rotate fast.
            rooms = {"long at the unstable axis": 200, "slow": 2000}
            near = case["name"].startswith("sphere within") and case["products"]
            room = 400 if near else rooms.get(case["name"], 20)
            assert off <= room * np.finfo(dtype).eps, (case["name"], k)
            rows[case["products"]] += 1
    assert rows[False] > 20
    assert rows[True] > 15


@pytest.mark.slow
def test_second_derivatives_of_many_bodies_at_once():
    """Forward over vmapped reverse mode differentiates the coefficients of the derivative rule."""
    rng = np.random.default_rng(4)
    moments = 1 + rng.random((3, 3))
    omega, move = rng.normal(size=(2, 3, 3))

    def numbers(omega, moments):
        rates, _ = free_motion(tuple(moments), START, tuple(omega), 2.0, attitude=False)
        return rates[0] * rates[1] + rates[2]

    def many(omega):
        return jax.vmap(jax.grad(numbers))(omega, moments)

    both, step = jax.jit(lambda w, dw: jax.jvp(many, (w,), (dw,))), 1e-5
    _, found = both(omega, move)
    ends = (both(omega + s * step * move, move)[0] for s in (1, -1))
    want = np.subtract(*ends) / (2 * step)
    np.testing.assert_allclose(found, want, rtol=1e-8, atol=1e-8)
