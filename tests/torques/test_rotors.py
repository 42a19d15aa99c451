import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode import Rotor

INERTIA = ph.Inertia.from_moments([1.0, 2.0, 2.5])
STATE = ph.State([0.8, 0.3, 0.4, 0.2], [[0.1, 0.2, 0.3], [0.4, -0.5, 0.1]])
TS = jnp.array([0.5, 2.0, 6.0])
ROTORS = {
    "free and held": Rotor([1.0, 1.0, 0.0], inertia=0.2, speed=[3.0, -1.0], torque=0.0)
    + Rotor([0.0, 0.0, 2.0], inertia=0.1, speed=2.0),
    "driven": Rotor([1.0, 1.0, 0.0], inertia=0.2, speed=3.0, torque=0.05)
    + Rotor([0.0, 0.0, 1.0], inertia=0.1, speed=2.0, impulse=lambda t: jnp.sin(t)),
}


@pytest.mark.parametrize(
    "name",
    [
        "free and held",
        pytest.param("driven", marks=pytest.mark.slow),  # such wheels: test_every_torque
    ],
)
def test_momentum_and_energy(name):
    scene = ph.Scene(INERTIA, rotors=ROTORS[name])
    got = ph.simulate(scene, STATE, TS, ph.LiePoisson(), rtol=1e-11)
    momentum = np.array(got.momentum_space)
    assert np.abs(momentum - momentum[:, :1]).max() < 1e-9
    start = np.array(INERTIA.momentum(STATE.omega_body))
    for wheel in ROTORS[name].wheels:
        relative = wheel.momentum if wheel.momentum is not None else wheel.inertia * wheel.speed
        start = start + np.atleast_1d(relative)[:, None] * np.array(wheel.axis_body)
    assert np.abs(np.array(got.momentum_body)[:, 0] - start).max() < 1e-15
    energy = np.array(got.energy)
    if name != "driven":
        assert np.abs(energy - energy[:, :1]).max() < 1e-9


def test_euler_equation_with_wheels():
    """I' domega/dt = L x omega - u a, and the energy of the body and of wheels without prescribed
    speed.

    I' excludes wheels that are free about their axes a, on which their motors exert u. Conserved
    quantities do not reveal the sign of the wheels, nor constant parts of the energy.
    """
    omega, moments = np.array([0.4, -0.5, 0.1]), np.diag([1.0, 2.0, 2.5])
    oblique, upright = np.array([0.6, 0.8, 0.0]), np.array([0.0, 0.0, 1.0])
    wheels = Rotor(oblique, inertia=0.2, speed=3.0, torque=0.05)
    wheels = wheels + Rotor(upright, inertia=0.1, speed=2.0)
    state = ph.State([0.8, 0.3, 0.4, 0.2], omega)
    scene = ph.Scene(INERTIA, rotors=wheels).settled(state, jnp.array(0.0))
    carrier = moments - 0.2 * np.outer(oblique, oblique)
    momentum = carrier @ omega + 0.2 * (3.0 + oblique @ omega) * oblique + 0.1 * 2.0 * upright
    want = np.linalg.solve(carrier, np.cross(momentum, omega) - 0.05 * oblique)
    got = scene.acceleration(state.wxyz, state.omega_body, 0.0)
    np.testing.assert_allclose(got, want, rtol=1e-14, atol=1e-15)
    np.testing.assert_allclose(scene.momentum(state.omega_body, 0.0), momentum, rtol=1e-14)
    energy = omega @ carrier @ omega / 2 + 0.2 * (3.0 + oblique @ omega) ** 2 / 2
    total = scene.hamiltonian.total(tuple(jnp.array(momentum)), None, 0.0)
    np.testing.assert_allclose(total, energy, rtol=1e-14)


def test_a_wheel_against_newton():
    """One axis: (C - J) domega/dt = -tau, and d(Omega + omega)/dt = tau / J, Omega relative to the
    body, which turns the other way; with derivatives by tau.
    """
    state = ph.State([1.0, 0, 0, 0], [0.0, 0.0, 1.0])

    def moved(torque):
        wheel = Rotor([0.0, 0.0, 1.0], inertia=0.5, speed=2.0, torque=torque)
        got = ph.simulate(ph.Scene(INERTIA, rotors=wheel), state, TS, rtol=1e-11)
        return got.omega_body[..., 2], got.wheel_speed[..., 0]

    torque, elapsed = jnp.array([0.0, 0.3]), np.array(TS) - 0.5
    (rates, speeds), (by_rate, by_speed) = jax.jvp(moved, (torque,), (jnp.ones(2),))
    slopes = -1 / 2.0 * elapsed, (1 / 0.5 + 1 / 2.0) * elapsed
    np.testing.assert_allclose(rates, 1 + np.outer(torque, slopes[0]), rtol=0, atol=1e-10)
    np.testing.assert_allclose(speeds, 2 + np.outer(torque, slopes[1]), rtol=0, atol=1e-9)
    np.testing.assert_allclose(by_rate, np.tile(slopes[0], (2, 1)), rtol=0, atol=1e-9)
    np.testing.assert_allclose(by_speed, np.tile(slopes[1], (2, 1)), rtol=0, atol=1e-9)


def test_the_inertia_includes_the_wheels():
    with pytest.raises(ValueError, match="locked and included"):
        ph.Scene(INERTIA, rotors=Rotor([1.0, 0, 0], inertia=1.0, speed=1.0))
    ph.Scene(INERTIA, rotors=Rotor([1.0, 0, 0], inertia=0.99, speed=1.0))


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ({"momentum": 1.0, "speed": 1.0}, "exactly one"),
        ({}, "exactly one"),
        ({"speed": 1.0}, "needs inertia"),
        ({"momentum": 1.0, "torque": 0.0}, "needs inertia"),
        ({"inertia": -1.0, "speed": 1.0}, "positive"),
        ({"inertia": 1.0, "speed": 1.0, "torque": 0.0, "impulse": jnp.sin}, "not both"),
    ],
)
def test_refused_rotors(arguments, word):
    with pytest.raises(ValueError, match=word):
        Rotor([0.0, 0.0, 1.0], **arguments)
    with pytest.raises(ValueError, match="must not be zero"):
        Rotor([0.0, 0.0, 0.0], momentum=1.0)


FREE = ph.Rotor([0.0, 0.0, 1.0], inertia=0.2, speed=2.0, torque=0.0)
DRAGGED = ph.Rotor([0.0, 1.0, 0.0], 0.1, speed=3.0, coupling=ph.ViscousCoupling(0.05))
HELD = ph.Rotor([1.0, 0.0, 0.0], momentum=0.4)
BODY = ph.Inertia.from_moments([2.0, 1.4, 1.5])


@pytest.mark.slow
def test_the_last_state_continues_with_its_wheels():
    """Two successive simulations equal one; also with the scene stored in a trajectory."""
    scene = ph.Scene(BODY, rotors=FREE + HELD + DRAGGED)
    whole = ph.simulate(scene, STATE, [1.0, 2.0, 3.0], rtol=1e-12)
    first = ph.simulate(scene, STATE, [1.0, 2.0], rtol=1e-12)
    assert first.last.wheel_speed.shape == (2, 3)
    np.testing.assert_allclose(first.last.wheel_speed, first.wheel_speed[:, -1], rtol=1e-14)
    for again in (scene, first.scene):
        then = ph.simulate(again, first.last, [2.0, 3.0], rtol=1e-12)
        np.testing.assert_allclose(then.wxyz[:, -1], whole.wxyz[:, -1], rtol=0, atol=1e-11)
        np.testing.assert_allclose(then.omega_body[:, -1], whole.omega_body[:, -1], atol=1e-11)
        np.testing.assert_allclose(then.wheel_speed[:, -1], whole.wheel_speed[:, -1], atol=1e-10)
    assert ph.simulate(ph.Scene(BODY, rotors=HELD), STATE, [0.0, 1.0]).last.wheel_speed is None


@pytest.mark.slow
def test_the_speeds_of_a_state_replace_those_of_the_rotors():
    scene = ph.Scene(BODY, rotors=FREE + HELD)
    other = eqx.tree_at(lambda s: s.rotors.terms[0].speed, scene, jnp.array(-1.5))
    given = ph.State(STATE.wxyz, STATE.omega_body, [-1.5, jnp.nan])
    want = ph.simulate(other, STATE, [0.0, 1.0]).omega_body
    np.testing.assert_array_equal(ph.simulate(scene, given, [0.0, 1.0]).omega_body, want)
    np.testing.assert_array_equal(ph.simulate(scene, given, [0.0, 1.0]).omega_body, want)  # cached
    with pytest.raises(ValueError, match="speeds of 1 wheels, the scene 2"):
        ph.simulate(scene, ph.State(STATE.wxyz, STATE.omega_body, [1.0]), [0.0, 1.0])
    with pytest.raises(ValueError, match="broadcast together"):
        ph.State(STATE.wxyz, STATE.omega_body, jnp.zeros((3, 2)))


@pytest.mark.slow
def test_the_speeds_of_a_state_with_an_event_and_without_rotors():
    given = ph.State(STATE.wxyz, STATE.omega_body, [-1.5])
    scene = ph.Scene(BODY, rotors=FREE)
    want = ph.simulate(scene, given, [0.0, 1.0]).omega_body[:, -1]
    until = ph.Event(lambda wxyz, omega_body, t: t - 1.0)
    stopped = ph.simulate(scene, given, [0.0, 4.0], until=until).omega_body[:, -1]
    np.testing.assert_allclose(stopped, want, rtol=0, atol=1e-8)
    alone = ph.simulate(ph.Scene(BODY), given, [0.0, 1.0])  # the speeds are not used
    want = ph.simulate(ph.Scene(BODY), STATE, [0.0, 1.0]).omega_body
    np.testing.assert_array_equal(alone.omega_body, want)
