"""Bad input gets a clear error: what was given, what is expected, how to mend it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import polhode as ph

INERTIA = ph.Inertia.from_moments([1.0, 1.5, 2.0])
SCENE = ph.Scene(INERTIA)
STATE = ph.State([1.0, 0, 0, 0], [0.1, 0.2, 0.3])
TS = [0.0, 1.0]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ph.State([0.0, 0, 0, 0], [0.0, 0, 1]), r"wxyz must not be zero.*scalar first"),
        (
            lambda: ph.State([1.0, 0, 0], [0.0, 0, 1]),
            r"wxyz must have shape \(\.\.\., 4\), got \(3,\)",
        ),
        (lambda: ph.State([1.0, 0, 0, np.nan], [0.0, 0, 1]), "wxyz holds NaN or infinity"),
        (lambda: ph.State([1.0, 0, 0, 0], [np.inf, 0, 1]), "omega_body holds NaN or infinity"),
        (lambda: ph.State(np.ones((2, 4)), np.ones((3, 3))), "broadcast together"),
        (lambda: ph.State.from_euler(0.1, 0.2, 0.3), "exactly one of rates"),
        (
            lambda: ph.State.from_euler(0.1, 0.0, 0.3, momenta=[1.0, 2, 3], inertia=INERTIA),
            "theta at 0 or pi",
        ),
        (lambda: ph.Inertia.from_moments([1.0, -1.0, 1.0]), "positive"),
        (lambda: ph.Inertia.from_moments([1.0, 1.0, 3.0]), "triangle inequality"),
        (lambda: ph.UniformGravity(-1.0, [0.0, 0, 1]), "mass must not be negative"),
        (lambda: ph.GravityGradient(1.0, [0.0, 0, 0]), "must not be zero"),
        (lambda: ph.LinearDamping([0.1, -0.1, 0.1]), "must not be negative"),
        (lambda: ph.BodyTorque([1.0, 2.0]), r"shape \(\.\.\., 3\)"),
        (lambda: ph.simulate(SCENE, STATE, [0.0]), "at least two times"),
        (lambda: ph.simulate(SCENE, STATE, [0.0, 1.0, 1.0]), "entries 1 and 2"),
        (lambda: ph.simulate(SCENE, STATE, [0.0, 2.0, 1.0]), "strictly increasing or strictly"),
        (lambda: ph.simulate(SCENE, STATE, [0.0, np.nan]), "ts holds NaN"),
        (lambda: ph.simulate(SCENE, STATE, TS, rtol=-1.0), "rtol must be positive"),
        (lambda: ph.simulate(SCENE, STATE, TS, rtol=1e-17), "below what float64 can reach"),
    ],
)
def test_values(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ph.Scene([1.0, 2.0, 3.0]), r"ph\.Inertia\.from_moments"),
        (lambda: ph.Scene(INERTIA, potential=ph.LinearDamping(0.1)), "must be a potential"),
        (lambda: ph.Scene(INERTIA, torque=3.0), "must be a torque"),
        (lambda: ph.simulate(STATE, SCENE, TS), r"scene must be a ph\.Scene, got State"),
        (lambda: ph.simulate(SCENE, STATE, TS, "rk4"), "object such as"),
        (lambda: ph.simulate(SCENE, STATE, TS, record="all"), r"ph\.Record"),
        (lambda: ph.State("up", [0.0, 0, 1]), "wxyz must be an array of real numbers"),
        (lambda: ph.State([1j, 0, 0, 0], [0.0, 0, 1]), "real numbers"),
        (lambda: ph.BodyTorque([0.0, 0, 1]) + ph.Potential(lambda r, t: 0.0), "torque adds to"),
        (lambda: ph.Potential(3.0), "takes a function"),
    ],
)
def test_kinds(call, message):
    with pytest.raises(TypeError, match=message):
        call()


def test_mixed_dtypes_and_batches_that_do_not_fit():
    single = ph.State(np.array([1, 0, 0, 0], np.float32), np.array([0, 0, 1], np.float32))
    with pytest.raises(TypeError, match=r"mix the dtypes \['float32', 'float64'\]"):
        ph.simulate(SCENE, single, TS)
    three = ph.State(np.ones((3, 4)), np.ones((3, 3)))
    two = ph.Scene(ph.Inertia.from_moments(np.ones((2, 3))))
    with pytest.raises(ValueError, match="do not broadcast together"):
        ph.simulate(two, three, TS)
    scene = ph.Scene(ph.Inertia.from_moments(np.ones(3, np.float32)))
    with pytest.raises(ValueError, match="float32 can reach"):
        ph.simulate(scene, single, TS, rtol=1e-9)


def test_non_unit_quaternions_are_normalised_at_every_scale():
    for scale in (1e-300, 1e-5, 1.0, 1e300):
        state = ph.State(np.array([3.0, 0, 4.0, 0]) * scale, [0.0, 0, 1])
        np.testing.assert_allclose(state.wxyz, [0.6, 0, 0.8, 0], rtol=4e-16)


def _parts(box, vertices, faces):
    """One of every part that checks its values, from arrays that are known."""
    upright, up, number = jnp.array([1.0, 0, 0, 0]), jnp.array([0.0, 0, 1]), jnp.array(0.01)
    inertia = ph.Inertia.from_moments(box)
    angles = jnp.array(0.1), jnp.array(0.2), jnp.array(0.3)
    return (
        ph.State(upright, up),
        ph.State.from_euler(*angles, momenta=box, inertia=inertia),
        ph.Scene(
            inertia,
            ph.UniformGravity(number, up, -up) + ph.GravityGradient(number, up),
            ph.BodyTorque(up) + ph.LinearDamping(jnp.full(3, number)),
            ph.Rotor(up, number, speed=number),
        ),
        ph.GravityGradient(number, ph.KeplerOrbit(number, number, number)),
        ph.MassProperties.from_box(number, box, box / 2).moved(up),
        ph.MassProperties.from_sphere(number, number, number / 2).moved(wxyz=upright),
        ph.MassProperties.from_mesh(vertices, faces, density=number),
        ph.fit.Recording.of(jnp.arange(9.0), jnp.ones((9, 3)), omega_noise=number),
    )


def test_parts_are_made_of_known_arrays_under_jit():
    """What a traced function closes over is known, yet operations on it are traced."""
    box = jnp.array([1.0, 1.5, 2.0])
    vertices = np.concatenate([np.zeros((1, 3)), np.eye(3)])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    plain = _parts(box, jnp.asarray(vertices), faces)
    traced = eqx.filter_jit(lambda: _parts(box, jnp.asarray(vertices), faces))()
    for want, got in zip(jax.tree.leaves(plain), jax.tree.leaves(traced), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-14, atol=1e-16)
    explained = eqx.filter_jit(lambda: str(ph.explain(SCENE, STATE, TS)) and jnp.zeros(()))()
    assert explained == 0


def test_moments_near_the_largest_number_are_judged_like_others():
    moments = ph.Inertia.from_moments(np.array([1.0, 1.5, 1.7]) * 1e308).moments
    np.testing.assert_allclose(moments, np.array([1.0, 1.5, 1.7]) * 1e308)
    with pytest.raises(ValueError, match="triangle inequality"):
        ph.Inertia.from_moments(np.array([0.1, 0.2, 1.7]) * 1e308)


garbage = st.one_of(
    st.none(),
    st.booleans(),
    st.text(max_size=3),
    st.integers(-(2**70), 2**70),
    st.floats(),
    st.complex_numbers(),
    st.lists(st.floats(), max_size=5),
    st.lists(st.lists(st.floats(), max_size=5), max_size=4),
    st.dictionaries(st.text(max_size=2), st.floats(), max_size=2),
)


@settings(max_examples=150, deadline=None)
@given(first=garbage, second=garbage)
def test_garbage_never_passes_silently(first, second):
    """A constructor raises ValueError or TypeError, or holds finite arrays of the right rank."""
    makers = [
        lambda: ph.State(first, second),
        lambda: ph.UniformGravity(first, second),
        lambda: ph.GravityGradient(first, second),
        lambda: ph.BodyTorque(first),
        lambda: ph.SpaceTorque(second),
        lambda: ph.LinearDamping(first),
        lambda: ph.Inertia.from_moments(first),
        lambda: ph.Inertia.from_tensor(second),
        lambda: ph.State.from_euler(first, second, 0.3, rates=second),
    ]
    for make in makers:
        try:
            made = make()
        except (ValueError, TypeError):
            continue
        for name, rank in made.core_ranks.items():
            value = getattr(made, name)
            if value is not None:
                assert bool(jnp.all(jnp.isfinite(value)))
                assert value.ndim >= rank
