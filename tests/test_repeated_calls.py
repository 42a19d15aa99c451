"""Ordinary calls: one program per structure, checked input, the results of a compiled call."""

import gc
import weakref
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode._plan import choose
from polhode._simulate import run

SCENE = ph.Scene(ph.Inertia.from_moments([1.0, 2.0, 3.0]))
TS = [0.0, 1.0, 3.0]


def _state(size=1.0):
    return ph.State([1.0, 0.0, 0.0, 0.0], [0.3 * size, size, 0.2 * size])


@pytest.mark.parametrize("kind", [jnp.array, np.array, list])
def test_plain_calls_give_what_a_compiled_call_gives(kind):
    state = _state(1.5)
    fast = ph.simulate(SCENE, state, kind(TS))
    slow = jax.jit(ph.simulate)(SCENE, state, jnp.array(TS))
    assert jax.tree.structure(fast) == jax.tree.structure(slow)
    for one, other in zip(jax.tree.leaves(fast), jax.tree.leaves(slow), strict=True):
        assert one.dtype == other.dtype
        assert one.shape == other.shape
        np.testing.assert_allclose(one, other, rtol=1e-14, atol=1e-14)


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


I = ph.Inertia.from_moments([1.0, 1.5, 2.0])
FALL = ph.UniformGravity(1.0, [0.1, 0.0, 0.3])
KINDS = {
    "top": (I, FALL),
    "damped": (I, FALL, ph.LinearDamping(jnp.array([0.1, 0.2, 0.3]))),
    "damped, nothing else": (I, None, ph.LinearDamping(jnp.array([0.1, 0.2, 0.3]))),
    "Lagrange": (ph.Inertia.axisymmetric(1.0, 0.5), ph.UniformGravity.axial(1.0, 0.3)),
    "wheel": (I, None, None, ph.Rotor([0.0, 0.0, 1.0], 0.1, momentum=0.3)),
}


@pytest.mark.parametrize(
    "kind",
    [x if x in ("damped", "Lagrange") else pytest.param(x, marks=pytest.mark.slow) for x in KINDS],
)
def test_scenes_that_differ_in_numbers_share_a_program(kind):
    scene, record = ph.Scene(*KINDS[kind]), ph.Record(work=kind == "damped")
    ph.simulate(scene, _state(), TS, record=record)
    count = run.program._cache_size()
    other = jax.tree.map(lambda x: 1.0 * x, scene)
    found = ph.simulate(other, _state(1.5), np.array(TS), rtol=1e-7, record=record)
    assert run.program._cache_size() == count
    compiled = jax.jit(lambda state: ph.simulate(scene, state, TS, rtol=1e-7, record=record))
    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(compiled(_state(1.5))), strict=True)
    for one, two in pairs:
        np.testing.assert_allclose(one, two, rtol=1e-11, atol=1e-11)


def test_a_scene_ends_with_its_last_reference():
    scene = ph.Scene(ph.Inertia.from_moments([1.0, 1.5, 2.5]), FALL)
    end = weakref.ref(scene)
    found = ph.simulate(scene, _state(), TS)
    assert found.wxyz.shape == (3, 4)
    del scene, found
    gc.collect()
    assert end() is None


def test_threads_share_programs_and_mix_nothing():
    """Scenes of two structures and many numbers, from eight threads at once."""
    scenes = [
        ph.Scene(ph.Inertia.from_moments([1.0, 1.5, 2.0 + k / 20]), FALL if k % 2 else None)
        for k in range(8)
    ]

    def last(scene):
        return np.asarray(ph.simulate(scene, _state(), TS).omega_body[-1])

    alone = [last(scene) for scene in scenes]
    with ThreadPoolExecutor(8) as threads:
        found = list(threads.map(last, 4 * scenes))
    np.testing.assert_array_equal(found, 4 * alone)


def test_long_horizons_of_stepped_bodies_carry_their_rounding():
    scene = ph.Scene(*KINDS["top"])
    short = ph.simulate(scene, _state(), TS, rtol=1e-9)
    for rtol in (1e-11, 3e-13):
        found = ph.simulate(scene, _state(), TS, rtol=rtol)
        method, _ = choose(scene, rtol)
        asked = ph.simulate(scene, _state(), TS, method, rtol=rtol)
        assert method.solver.compensated == (rtol < 20_000 * np.finfo(float).eps)
        assert np.array_equal(found.wxyz, asked.wxyz)
        assert not np.array_equal(found.wxyz, short.wxyz)


def test_the_first_sample_is_the_given_state():
    wxyz = np.array([0.3, -0.5, 0.1, 0.7])
    for scene in (SCENE, ph.Scene(*KINDS["Lagrange"])):
        found = ph.simulate(scene, ph.State(wxyz, [0.1, 0.9, 0.2]), TS)
        np.testing.assert_allclose(found.wxyz[0], wxyz / np.linalg.norm(wxyz), rtol=1e-15)
        assert np.array_equal(found.omega_body[0], [0.1, 0.9, 0.2])


def test_what_is_asked_of_a_trajectory_is_a_program_or_two(caplog):
    """Not one program per operation: twenty operations of an energy would take half a second."""
    weight = ph.UniformGravity(1.0, [0.0, 0.1, 0.5])
    trajectory = ph.simulate(ph.Scene(SCENE.inertia, weight), _state(), jnp.linspace(0, 1, 29))
    asks = (lambda x: x.energy, lambda x: x.momentum_space, lambda x: x.euler())
    for ask in asks:
        caplog.clear()
        with jax.log_compiles():
            ask(trajectory)
        made = [line for line in caplog.messages if "Finished XLA compilation" in line]
        assert 1 <= len(made) <= 2, made


def test_what_was_asked_before_compiles_nothing_again(caplog):
    """A loop over a new function object would be a new program in every call outside of ``jit``."""
    tensor = np.diag([1.0, 2.0, 3.0]) + 0.1
    orbit = ph.KeplerOrbit(1.0, 2.0, 0.1)
    scene = ph.Scene(SCENE.inertia, ph.GravityGradient(1.0, orbit))
    trajectory = ph.simulate(scene, _state(), jnp.array(TS))

    def ask():
        ph.Inertia.from_tensor(tensor).moments.block_until_ready()
        trajectory.energy.block_until_ready()
        ph.LVLH(orbit).attitude(1.5)
        ph.propagate(SCENE, _state(), 0.1, free=lambda s: s.inertia.diagonal)

    with jax.log_compiles():
        ask()
        assert any("XLA compilation" in line for line in caplog.messages)
        ask()
        caplog.clear()
        ask()
    assert not [line for line in caplog.messages if "XLA compilation" in line]
