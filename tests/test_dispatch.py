"""Repeated plain calls: the same answers, the same care."""

import gc

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode import _dispatch
from polhode._plan import choose

SCENE = ph.Scene(ph.Inertia.from_moments([1.0, 2.0, 3.0]))
TS = [0.0, 1.0, 3.0]


def _state(size=1.0):
    return ph.State([1.0, 0.0, 0.0, 0.0], [0.3 * size, size, 0.2 * size])


@pytest.fixture(autouse=True)
def taken():
    """Every test starts where the scene is known."""
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


I = ph.Inertia.from_moments([1.0, 1.5, 2.0])
FALL = ph.UniformGravity(1.0, [0.1, 0.0, 0.3])
KINDS = {
    "top": (I, FALL),
    "damped": (I, FALL, ph.LinearDamping(jnp.array([0.1, 0.2, 0.3]))),
    "damped, nothing else": (I, None, ph.LinearDamping(jnp.array([0.1, 0.2, 0.3]))),
    "Lagrange": (ph.Inertia.axisymmetric(1.0, 0.5), ph.UniformGravity(1.0, [0.0, 0.0, 0.3])),
    "wheel": (I, None, None, ph.Rotor([0.0, 0.0, 1.0], 0.1, momentum=0.3)),
}


KINDS_TOO = "damped", "wheel"


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_scene_is_remembered(kind, monkeypatch):
    """The second call does not check the scene again, and gives what the long way gives."""
    scene, record = ph.Scene(*KINDS[kind]), ph.Record(work=kind == "damped")
    ph.simulate(scene, _state(), TS, record=record)

    def again(*_):
        raise AssertionError("looked at the scene again")

    monkeypatch.setattr("polhode._simulate.check_inputs", again)
    fast = ph.simulate(scene, _state(1.5), np.array(TS), rtol=1e-7, record=record)
    monkeypatch.undo()
    slow = jax.jit(lambda state: ph.simulate(scene, state, TS, rtol=1e-7, record=record))
    slow = slow(_state(1.5))
    for one, other in zip(jax.tree.leaves(fast), jax.tree.leaves(slow), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)
    assert (fast._work is None) == (kind != "damped")
    if kind == "wheel":  # whose momentum is that of its own initial state
        assert fast.scene is not scene
    np.testing.assert_allclose(fast.energy, slow.energy, rtol=1e-12)


@pytest.mark.parametrize(
    "kind", ["top", "Lagrange", *(pytest.param(k, marks=pytest.mark.slow) for k in KINDS_TOO)]
)
def test_twenty_numbers_of_saved_times_compile_three_programs_at_most(kind):
    scene = ph.Scene(*KINDS[kind])

    def compiled():
        return sum(made.call._cache_size() for made in _dispatch._PROGRAMS.values())

    _dispatch._PROGRAMS.clear()
    counts = [3, 4, 7, 8, 9, 12, 20, 33, 50, 64, 65, 80, 100, 101, 150, 200, 257, 300, 400, 500]
    for count in counts:
        ts = np.linspace(0.0, 2.0, count)
        found = ph.simulate(scene, _state(), ts, rtol=10.0 ** -(3 + count % 5))
        assert np.array_equal(found.ts, ts)
        assert found.wxyz.shape == (count, 4)
        assert jax.eval_shape(lambda one: one.energy, found).shape == (count,)
        assert np.all(np.isfinite(found.wxyz))
    assert 1 <= compiled() <= 3
    record = ph.Record(final_only=True)
    for count in (2, 3, 5, 90):
        ph.simulate(scene, _state(), np.linspace(0.0, 2.0, count), record=record)
    assert compiled() <= 4


SPIN = ph.Rotor([0.0, 0.0, 1.0], 0.1, speed=0.3, coupling=ph.ViscousCoupling(0.05))
PULSES = ph.Pulses(ph.BodyTorque([0.0, 0.3, 0.0]), [0.4, 1.1], [0.6, 1.3])


PARTS = {
    "free": (ph.Inertia.from_moments([1.0, 2.0, 3.0]),),
    "top": (I, FALL),
    "pulses": (I, None, PULSES),
    "coupled wheel": (I, FALL, None, SPIN),
    "Lagrange": (ph.Inertia.axisymmetric(1.0, 0.5), ph.UniformGravity(1.0, [0.0, 0.0, 0.3])),
}
WAYS = [(name, 1.0) for name in PARTS] + [("free", -1.0), ("pulses", -1.0)]
BACK = [
    pytest.param(name, -1.0, marks=pytest.mark.slow) for name in PARTS if (name, -1.0) not in WAYS
]


@pytest.mark.parametrize(("name", "turned"), [*WAYS, *BACK])
def test_samples_do_not_depend_on_how_many_times_a_program_is_for(name, turned):
    """Thirteen times, for which a program of more serves, beside one of thirteen."""
    parts = PARTS[name]
    scene, record = ph.Scene(*parts), ph.Record(work=len(parts) > 1)
    ts = turned * np.linspace(0.0, 2.0, 13) + 0.5
    for _ in range(2):
        fast = ph.simulate(scene, _state(), ts, record=record)
    slow = jax.jit(lambda state: ph.simulate(scene, state, ts, record=record))(_state())
    assert jax.tree.structure(fast) == jax.tree.structure(slow)
    for one, other in zip(jax.tree.leaves(fast), jax.tree.leaves(slow), strict=True):
        assert one.shape == other.shape
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(fast.first.wxyz, _state().wxyz, rtol=1e-15)
    np.testing.assert_allclose(fast.first.omega_body, _state().omega_body, rtol=1e-15)


def test_a_state_that_another_law_holds_for_is_moved_by_it():
    scene = ph.Scene(*KINDS["damped, nothing else"])
    assert np.all(np.asarray(ph.simulate(scene, _state(), TS).steps) > 0)
    about_one_axis = ph.State([1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.7])
    assert ph.simulate(scene, about_one_axis, TS).steps == 0
    assert "one fixed principal axis" in str(ph.explain(scene, about_one_axis, TS))
    assert np.all(np.asarray(ph.simulate(scene, _state(), TS).steps) > 0)


def test_long_horizons_of_stepped_bodies_carry_their_rounding():
    scene = ph.Scene(*KINDS["top"])
    short = ph.simulate(scene, _state(), TS, rtol=1e-9)
    for rtol in (1e-12, 3e-13):
        found = ph.simulate(scene, _state(), TS, rtol=rtol)
        method, _ = choose(scene, _state(), ph.Record(), rtol, jnp.array(TS))
        asked = ph.simulate(scene, _state(), TS, method, rtol=rtol)
        assert method.solver.compensated == (rtol < 2000 * np.finfo(float).eps)
        assert np.array_equal(found.wxyz, asked.wxyz)
        assert not np.array_equal(found.wxyz, short.wxyz)


def test_what_is_kept_of_a_scene_ends_with_it_and_programs_are_shared_and_few():
    gc.collect()
    scenes, programs = len(_dispatch._SCENES), len(_dispatch._PROGRAMS)
    made = [ph.Scene(ph.Inertia.from_moments([1.0, 1.5, 2.0 + k / 9])) for k in range(3)]
    found = [ph.simulate(scene, _state(), TS) for scene in made]
    assert len(_dispatch._SCENES) == scenes + 3
    assert len(_dispatch._PROGRAMS) <= programs + 1  # they differ in numbers
    assert len({float(f.omega_body[-1, 0]) for f in found}) == 3
    del made, found
    gc.collect()
    assert len(_dispatch._SCENES) == scenes
    assert len(_dispatch._PROGRAMS) <= _dispatch._KEPT


def test_the_first_sample_is_the_given_state():
    wxyz = np.array([0.3, -0.5, 0.1, 0.7])
    for scene in (SCENE, ph.Scene(*KINDS["Lagrange"])):
        found = ph.simulate(scene, ph.State(wxyz, [0.1, 0.9, 0.2]), TS)
        np.testing.assert_allclose(found.wxyz[0], wxyz / np.linalg.norm(wxyz), rtol=1e-15)
        assert np.array_equal(found.omega_body[0], [0.1, 0.9, 0.2])


def test_what_is_asked_of_a_trajectory_is_a_program_or_two(caplog):
    """Not one for each operation: twenty of an energy are half a second."""
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
    """Loops with functions of their own would be new programs in every call outside of ``jit``."""
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
