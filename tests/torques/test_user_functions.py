"""User functions: checked at construction of a part; pytrees contain arrays only."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode import FeedbackTorque

INERTIA = ph.Inertia.from_moments([1.0, 1.5, 2.0])
STATE = ph.State([0.8, 0.0, 0.6, 0.0], [0.5, -0.25, 0.75])


def wheel(impulse):
    return ph.Rotor([0.0, 0.0, 1.0], inertia=0.1, speed=1.0, impulse=impulse)


def of_time(made):
    return lambda result: made(lambda t: result)


TAKERS = {
    "BodyTorque": (of_time(ph.BodyTorque), (3,)),
    "SpaceTorque": (of_time(ph.SpaceTorque), (3,)),
    "GravityGradient": (of_time(lambda f: ph.GravityGradient(1.0, f)), (3,)),
    "FeedbackTorque": (lambda x: FeedbackTorque(lambda t, q, w: x), (3,)),
    "Potential": (lambda x: ph.Potential(lambda R, t: x), ()),
    "Rotor impulse": (of_time(wheel), ()),
    "origin": (of_time(lambda f: ph.RotatingFrame.from_rate([0.0, 0, 1], f)), (3,)),
    "from_rate": (of_time(ph.RotatingFrame.from_rate), (3,)),
}


@pytest.mark.parametrize("name", list(TAKERS))
def test_only_the_documented_shape_passes(name):
    make, shape = TAKERS[name]
    for tried in [(), (1,), (2,), (3,), (4,), (5,), (7,), (1, 3), (3, 1), (3, 3)]:
        if tried == shape:
            make(jnp.ones(tried))
            continue
        with pytest.raises(ValueError, match=rf"{name}.*shape \(.*expected") as told:
            make(jnp.ones(tried))
        assert f"returned shape {tried}" in str(told.value)
    for odd in (None, "three", {"x": 1.0}, jnp.ones(shape, bool), jnp.ones(shape, complex)):
        with pytest.raises(TypeError, match=f"{name}.*returned.*expected"):
            make(odd)
    for good in (np.ones(shape, np.float32), np.ones(shape, int), np.ones(shape).tolist()):
        make(good)


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: FeedbackTorque(lambda wxyz, omega, t: -omega), r"order fn\(t, wxyz, omega_body\)"),
        (lambda: FeedbackTorque(lambda t, omega, q: -omega), r"order fn\(t, wxyz, omega_body\)"),
        (lambda: FeedbackTorque(lambda t, q: q), "called as.*takes \\(t, q\\)"),
        (lambda: FeedbackTorque(lambda t, q, w, k: q), "missing a required argument: 'k'"),
        (lambda: ph.Potential(lambda t, R: R[0, 0]), r"order fn\(R, t\)"),
        (lambda: ph.Potential(lambda R: R[0, 0]), r"called as fn\(R, t\)"),
        (lambda: ph.Potential(ph.UniformGravity), "got the class UniformGravity"),
        (lambda: ph.GravityGradient(1.0, ph.KeplerOrbit), "got the class KeplerOrbit"),
        (lambda: ph.BodyTorque(lambda: jnp.ones(3)), r"called as fn\(t\)"),
        (lambda: ph.SampledTorque(lambda t, q: -q, 1.0), r"^SampledTorque is called as"),
        (lambda: wheel(3.0), "takes a function"),
        (lambda: ph.frames.FrameForce(lambda position, velocity, t: position), "order fn"),
    ],
)
def test_number_and_order_of_arguments(make, word):
    with pytest.raises(TypeError, match=word):
        make()


def test_shapes_tell_an_order_that_names_do_not():
    with pytest.raises(ValueError, match=r"returned shape \(4,\)"):
        FeedbackTorque(lambda a, b, c: -0.1 * b)
    with pytest.raises(IndexError) as told:
        FeedbackTorque(lambda a, b, c: -a[0] * c)
    assert any("called as fn(t, wxyz, omega_body)" in note for note in told.value.__notes__)
    FeedbackTorque(lambda t, *state: -state[1])


def test_what_a_function_raises_passes_with_a_note():
    class Mine(Exception):
        pass

    def bad(t):
        raise Mine("mine")

    with pytest.raises(Mine) as told:
        ph.SpaceTorque(bad)
    assert any("SpaceTorque" in note and "jax.numpy" in note for note in told.value.__notes__)


class Spring(eqx.Module):
    k: jax.Array

    def __call__(self, R, t):
        return self.k * R[2, 2]


class Unhashable:
    def __eq__(self, other):
        return False

    __hash__ = None

    def __call__(self, t):
        return jnp.ones(3)


def scene_of(k):
    """Functions of every kind, closing over ``k``."""
    potential = ph.Potential(lambda R, t: k * R[2, 2] * jnp.cos(t)) + ph.Potential(Spring(2.0 * k))
    torque = ph.BodyTorque(lambda t: k * jnp.stack([t, 0 * t, 1.0 + 0 * t])) + FeedbackTorque(
        lambda t, q, w: -k * w
    )
    return ph.Scene(INERTIA, potential, torque, wheel(lambda t: 0.1 * k * jnp.sin(t)))


def test_scenes_are_trees_of_arrays():
    scene = scene_of(jnp.array(0.5))
    leaves = jax.tree.leaves(scene)
    assert all(isinstance(x, jax.Array) for x in leaves)
    assert len(leaves) == 5  # moments, k of the spring, axis, inertia and speed of the wheel
    doubled = jax.tree.map(lambda x: 2 * x, scene)
    assert doubled.potential.terms[1].fn.k == 2.0
    same = jax.jit(lambda s: s)(scene)
    assert jax.tree.structure(same) == jax.tree.structure(scene)
    assert not any(x.shape for x in jax.tree.leaves(ph.BodyTorque(Unhashable())))


@pytest.mark.slow  # a closure is differentiated in tests/test_stepping.py, leaves everywhere
def test_a_scene_goes_through_jit_and_grad_and_closures_are_differentiated():
    """The derivative by a closed-over number equals that by the same number as a leaf."""
    method = ph.LiePoisson(max_steps=64)

    def end(scene):
        return ph.simulate(scene, STATE, [0.0, 0.25], method, rtol=1e-7).omega_body[-1, 0]

    def of_closure(k):
        return end(ph.Scene(INERTIA, ph.Potential(lambda R, t: k * R[2, 2])))

    as_leaf = ph.Scene(INERTIA, ph.Potential(Spring(jnp.array(0.5))))
    value, slope = jax.jit(jax.value_and_grad(of_closure))(0.5)
    other, slopes = jax.jit(jax.value_and_grad(end))(as_leaf)
    np.testing.assert_allclose(value, other, rtol=1e-14)
    np.testing.assert_allclose(slope, slopes.potential.fn.k, rtol=1e-12)
    assert abs(float(slope)) > 1e-3


def test_times_may_be_many():
    """Functions of one time are mapped over the samples, even if there are three of them."""
    from polhode._hamiltonian import from_quaternion

    ts = jnp.array([0.0, 1.0, 2.0])
    attitude = from_quaternion(tuple(jnp.ones((4, 3)) / 2))
    rates = tuple(jnp.ones((3, 3)))
    torques = (
        ph.BodyTorque(lambda t: jnp.stack([t, 2 * t, 3 * t])),
        FeedbackTorque(lambda t, q, w: t * jnp.array([1.0, 2, 3]) * w),
    )
    for torque in torques:
        push = torque.body_components(ts, attitude, rates)
        np.testing.assert_array_equal(jnp.stack(push), np.outer([1, 2, 3], ts))


TRACED = {
    "numpy": (lambda x: np.sin(x), r"np\.sin\(x\).*Use jax\.numpy, such as jnp\.sin"),
    "if": (lambda x: 1.0 if x > 0 else -1.0, r"`if`.*jnp\.where\(condition, a, b\)"),
    "math": (lambda x: math.sin(x), r"float\(\).*jnp\.sin\(x\) for math\.sin\(x\)"),
    "index": (lambda x: [1.0, 2.0][jnp.asarray(x, int)], r"index.*Index a jnp\.array"),
}
PARTS = {
    "BodyTorque": lambda use: ph.BodyTorque(lambda t: use(t) * jnp.ones(3)),
    "SpaceTorque": lambda use: ph.SpaceTorque(lambda t: use(t) * jnp.ones(3)),
    "FeedbackTorque": lambda use: FeedbackTorque(lambda t, q, w: use(w[0]) * w),
    "Potential": lambda use: ph.Potential(lambda R, t: use(R[2, 2])),
    "GravityGradient": lambda use: ph.GravityGradient(1.0, lambda t: use(t) * jnp.ones(3)),
    "Motor": lambda use: ph.Motor(lambda t, q, w, speed: use(speed)),
    "Rotor impulse": lambda use: wheel(lambda t: use(t)),
    "EnergySink": lambda use: ph.EnergySink(lambda momentum, omega: use(omega[0])),
    "MagneticDipole field": lambda use: ph.MagneticDipole(
        [1.0, 0.0, 0.0], lambda x, t: use(t) * x, [1.0, 0.0, 0.0]
    ),
    "Event": lambda use: ph.Event(lambda q, w, t: use(w[0])),
    "RotatingFrame": lambda use: ph.RotatingFrame.from_rate(lambda t: use(t) * jnp.ones(3)),
}


@pytest.mark.parametrize("mistake", list(TRACED))
@pytest.mark.parametrize("part", list(PARTS))
def test_what_tracing_forbids_is_named_with_its_jax_form(part, mistake):
    use, words = TRACED[mistake]
    with pytest.raises(TypeError, match=rf"given to {part}.*called as fn\(.*{words}") as raised:
        PARTS[part](use)
    assert isinstance(raised.value.__cause__, jax.errors.JAXTypeError | TypeError)
    assert "test_user_functions.py" in str(raised.value)  # the user's own line


def test_what_tracing_forbids_is_named_inside_the_simulation():
    """A branch that the check at construction does not reach, since it depends on the dtype."""

    def push(t):
        return jnp.ones(3) if t.weak_type else np.sin(t) * jnp.ones(3)

    torque = ph.BodyTorque(push)
    with pytest.raises(TypeError, match=r"given to BodyTorque.*Use jax\.numpy"):
        ph.simulate(ph.Scene(INERTIA, torque=torque), STATE, [0.0, 1.0])
