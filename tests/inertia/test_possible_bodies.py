"""Moments that a body can have: constructors check them, and the status reports traced ones."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode.inertia import Inertia, Symmetry

STATE = ph.State([1.0, 0, 0, 0], [0.1, 1.0, 0.1])
TS = [0.0, 2.0]
WATER, TEXTBOOK = (0.345, 0.653, 1.0), (2.0, 1.0, 2 / 3)


def turned(moments, rng):
    """Tensors with these moments in random axes, symmetric to the last bit."""
    q, _ = np.linalg.qr(rng.normal(size=(*moments.shape, 3)))
    tensor = q * moments[..., None, :] @ np.swapaxes(q, -1, -2)
    return (tensor + np.swapaxes(tensor, -1, -2)) / 2


def drawn(rng, n):
    """Moments over six decades of size, half of them possible; some flat, some needles."""
    spread = 10 ** rng.uniform(-5, 0, (n, 3))
    spread[: n // 8, 0] = 0
    moments = spread.sum(axis=-1, keepdims=True) - spread
    moments[n // 2 :] = 10 ** rng.uniform(-2, 0, (n - n // 2, 3))
    moments[-n // 8 :, 1] *= -1
    return moments * 10 ** rng.uniform(-3, 3, (n, 1))


def accepted(make, given):
    try:
        make(given)
    except ValueError:
        return False
    return True


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_traced_numbers_are_judged_as_known_ones(dtype):
    rng = np.random.default_rng(3)
    moments = jnp.asarray(drawn(rng, 400), dtype)
    tensors = jnp.asarray(turned(np.asarray(moments, float), rng), dtype)
    judge = jax.jit(lambda x, make: make(x).is_possible, static_argnums=1)
    for make, given in ((Inertia.from_moments, moments), (Inertia.from_tensor, tensors)):
        known = np.array([accepted(make, x) for x in given])
        assert 100 < known.sum() < 300
        np.testing.assert_array_equal(judge(given, make), known)


def test_the_status_tells_what_no_body_has():
    moments = jnp.array(
        [
            [1.0, 1.5, 2.0],
            [1.0, 1.0, 2.0],
            [1.0, 1.0, 2.1],
            [1.0, -1.0, 1.0],
            [0.0, 1.0, 1.0],
            [jnp.nan, 1.0, 1.0],
            [1.0, 1.0, jnp.inf],
            [-1.0, -1.0, -1.0],
        ]
    )
    good = np.array([1, 1, 0, 0, 0, 0, 0, 0], bool)

    @eqx.filter_jit
    def status(inertia):
        return ph.simulate(ph.Scene(inertia), STATE, TS, throw=False).status

    @jax.jit
    def of_tensor(tensor):
        return status(Inertia.from_tensor(tensor))

    want = np.where(good, ph.Status.SUCCESSFUL, ph.Status.NOT_PHYSICAL)
    np.testing.assert_array_equal(status(Inertia(diagonal=moments, physical=True)), want)
    skew = jnp.diag(jnp.array([1.0, 1.5, 2.0])).at[0, 1].set(0.5)
    tensors = jnp.stack([jnp.diag(moments[0]), jnp.diag(moments[2]), skew, jnp.full((3, 3), 1.0)])
    wrong = ph.Status.NOT_PHYSICAL
    np.testing.assert_array_equal(of_tensor(tensors), [0, wrong, wrong, wrong])
    # values passed by keyword are checked in a simulation
    with pytest.raises(ph.SimulationError, match="no body has this inertia"):
        ph.simulate(ph.Scene(Inertia(diagonal=[2.0, 1.0, -0.5])), STATE, TS)


@pytest.mark.parametrize("moments", [WATER, TEXTBOOK])
def test_published_numbers_that_no_body_has(moments):
    with pytest.raises(ValueError, match="physical=False"):
        Inertia.from_moments(moments)
    made = Inertia.from_moments(moments, physical=False)
    assert bool(made.is_possible)
    assert bool(Inertia.from_tensor(np.diag(moments), physical=False).is_possible)
    assert ph.simulate(ph.Scene(made), STATE, TS).successful
    for bad in (-np.array(moments), np.array(moments) * [1, 0, 1]):
        with pytest.raises(ValueError, match="positive"):
            Inertia.from_moments(bad, physical=False)
        assert not bool(Inertia(diagonal=bad).is_possible)


@pytest.mark.parametrize(
    ("given", "error", "word"),
    [
        (np.eye(3), ValueError, "Inertia.from_tensor or Inertia.from_moments"),
        (np.ones((3, 3)), ValueError, "Inertia.from_tensor or Inertia.from_moments"),
        (np.ones((5, 3, 3)), ValueError, "Inertia.from_tensor or Inertia.from_moments"),
        (2.0, ValueError, "Inertia.spherical"),
        ([1.0, 2.0], ValueError, r"shape \(\.\.\., 3\)"),
        (np.ones(6), ValueError, r"shape \(\.\.\., 3\)"),
        ([1.0, 2.0, 4.0], ValueError, "triangle"),
        ([1.0, -2.0, 2.0], ValueError, "positive"),
        ([1.0, np.nan, 2.0], ValueError, "NaN"),
        ("123", TypeError, "real numbers"),
        (Inertia.spherical(1.0), TypeError, "takes numbers, got Inertia"),
        (ph.MassProperties.from_sphere(1.0, 1.0), TypeError, "MassProperties take .inertia"),
    ],
)
def test_the_obvious_call_says_what_to_call(given, error, word):
    with pytest.raises(error, match=word):
        ph.Inertia(given)


def test_the_obvious_call_does_what_is_meant():
    assert jax.tree.leaves(ph.Inertia([1, 2, 3]))[0].dtype == jnp.result_type(float)
    assert ph.Inertia(np.ones((5, 3))).batch_shape == (5,)
    assert ph.Inertia(diagonal=np.ones((3, 3))).batch_shape == (3,)
    assert ph.Inertia(full=np.eye(3)).batch_shape == ()
    assert ph.simulate(ph.Scene(ph.Inertia([1, 2, 3])), STATE, TS).successful


def test_a_step_keeps_the_symmetry():
    """A step in the leaves of a symmetric inertia preserves the symmetry; derivatives add up."""
    omega = jnp.array([0.5, -1.0, 2.0])

    def energy(inertia):
        return jnp.sum(inertia.momentum(omega) * omega) / 2

    for made, slope in (
        (Inertia.axisymmetric(1.0, 1.5), [(0.25 + 1.0) / 2, 2.0]),
        (Inertia.spherical(2.0), [5.25 / 2]),
    ):
        slopes = jax.tree.leaves(jax.grad(energy)(made))
        np.testing.assert_allclose(slopes, slope)
        noise = iter(np.random.default_rng(0).uniform(0.9, 1.1, 5))
        stepped = jax.tree.map(lambda x: x * next(noise), made)  # noqa: B023
        assert stepped.symmetry is made.symmetry is not Symmetry.NONE
        assert stepped.moments[0] == stepped.moments[1] != made.moments[1]
        general = Inertia(diagonal=stepped.moments)
        ends = [ph.simulate(ph.Scene(x), STATE, TS).wxyz for x in (stepped, general)]
        np.testing.assert_allclose(*ends, rtol=0, atol=1e-14)


def test_wheels_leave_the_symmetry_that_they_have():
    def carrier(inertia, axis):
        options = {"inertia": 0.25, "speed": 1.0, "torque": 0.0}
        if 1.0 in axis:  # a body axis
            wheel = ph.Rotor.axial(**options, axis=axis.index(1.0))
        else:
            wheel = ph.Rotor(axis, **options)
        scene = ph.Scene(inertia, rotors=wheel)
        return scene.settled(STATE, jnp.array(0.0)).carrier

    for inertia in (Inertia.axisymmetric(1.0, 1.5), Inertia.spherical(1.0)):
        assert carrier(inertia, [0.0, 0.0, 1.0]).symmetry is Symmetry.AXISYMMETRIC
        assert carrier(inertia, [1.0, 0, 0]).symmetry is Symmetry.NONE
        assert not carrier(inertia, [0.6, 0, 0.8]).is_principal
        for axis in ([0.0, 0, 1], [1.0, 0, 0], [0.6, 0, 0.8]):
            want = inertia.tensor - 0.25 * np.outer(axis, axis)
            np.testing.assert_allclose(carrier(inertia, axis).tensor, want, atol=1e-16)


def test_a_wheel_larger_than_its_body_is_told_while_traced():
    @jax.jit
    def status(j):
        rotor = ph.Rotor([0.0, 0.0, 1.0], inertia=j, speed=1.0, torque=0.0)
        scene = ph.Scene(Inertia.from_moments([1.0, 1.5, 2.0]), rotors=rotor)
        return scene.settled(STATE, jnp.array(0.0)).is_possible

    assert [bool(status(j)) for j in (0.5, 1.9, 2.5, -0.5)] == [True, True, False, False]
