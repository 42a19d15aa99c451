"""The short way of repeated calls: the same answers, the same care."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph

SCENE = ph.Scene(ph.Inertia.from_moments([1.0, 2.0, 3.0]))
TS = [0.0, 1.0, 3.0]


def _state(size=1.0):
    return ph.State([1.0, 0.0, 0.0, 0.0], [0.3 * size, size, 0.2 * size])


@pytest.fixture(autouse=True)
def taken():
    """Every test starts where the short way is known."""
    return ph.simulate(SCENE, _state(), jnp.array(TS))


@pytest.mark.parametrize("kind", [jnp.array, np.array, list])
def test_repeated_calls_give_what_a_compiled_call_gives(taken, kind):
    state = _state(1.5)
    fast = ph.simulate(SCENE, state, kind(TS))
    slow = jax.jit(ph.simulate)(SCENE, state, jnp.array(TS))
    assert jax.tree.structure(fast) == jax.tree.structure(slow)
    for one, other in zip(jax.tree.leaves(fast), jax.tree.leaves(slow), strict=True):
        assert one.dtype == other.dtype
        assert one.shape == other.shape
        np.testing.assert_allclose(one, other, rtol=1e-14, atol=1e-14)
    assert not np.allclose(fast.wxyz, taken.wxyz)


def test_the_method_follows_the_numbers():
    """A horizon so long that a rounded phase would miss rtol: not the method of the first call."""
    ts, scene = jnp.array([0.0, 2e9, 4e9]), SCENE
    exact = ph.simulate(scene, _state(), ts, ph.ClosedForm(compensated=True))
    chosen = ph.simulate(scene, _state(), ts)
    assert np.array_equal(chosen.wxyz, exact.wxyz)
    assert np.array_equal(ph.simulate(scene, _state(1e9), ts / 1e9).ts, ts / 1e9)
    assert "sums of two floats" in str(ph.explain(scene, _state(1e9), jnp.array([0.0, 2.0, 4.0])))
    plain = ph.simulate(scene, _state(1e9), jnp.array([0.0, 2.0, 4.0]))
    wanted = ph.ClosedForm(compensated=True)
    wanted = ph.simulate(scene, _state(1e9), jnp.array([0.0, 2.0, 4.0]), wanted)
    assert np.array_equal(plain.wxyz, wanted.wxyz)


@pytest.mark.parametrize(
    ("ts", "error", "said"),
    [
        ([0.0, 2.0, 1.0], ValueError, "strictly increasing"),
        ([0.0, 1.0, 1.0], ValueError, "strictly increasing"),
        ([0.0, np.nan, 1.0], ValueError, "NaN"),
        ([0.0, 1.0, np.inf], ValueError, "infinity"),
        ([0.0], ValueError, "at least two"),
        ([[[0.0, 1.0, 3.0]], [[0.0, 1.0, 0.5]]], ValueError, "strictly increasing"),
        (["a", "b", "c"], TypeError, "real numbers"),
    ],
)
def test_bad_times_are_still_found(ts, error, said):
    with pytest.raises(error, match=said):
        ph.simulate(SCENE, _state(), ts)


def test_bad_parts_are_still_found():
    with pytest.raises(ValueError, match="rtol"):
        ph.simulate(SCENE, _state(), TS, rtol=1e-30)
    with pytest.raises(ValueError, match="rtol"):
        ph.simulate(SCENE, _state(), TS, rtol=float("nan"))
    with pytest.raises(TypeError, match="record"):
        ph.simulate(SCENE, _state(), TS, record="all")
    single = jax.tree.map(lambda x: x.astype("float32"), _state())
    with pytest.raises(TypeError, match="mix the dtypes"):
        ph.simulate(SCENE, single, TS)
    with pytest.raises(TypeError, match="state must be"):
        ph.simulate(SCENE, SCENE, TS)


def test_a_body_that_fails_is_still_reported():
    broken = jax.tree.map(lambda x: x * jnp.nan, _state())
    with pytest.raises(ph.SimulationError, match="NaN or infinity"):
        ph.simulate(SCENE, broken, TS)
    assert ph.simulate(SCENE, broken, TS, throw=False).status == ph.Status.NOT_FINITE


def test_traced_parts_take_the_long_way():
    def last(size):
        return ph.simulate(SCENE, _state(size), TS).omega_body[-1, 0]

    slope = jax.grad(last)(1.0)
    assert slope == pytest.approx(float((last(1 + 1e-6) - last(1 - 1e-6)) / 2e-6), rel=1e-7)
