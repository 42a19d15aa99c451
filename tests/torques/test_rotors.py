import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode._scene import Rotor

INERTIA = ph.Inertia.from_moments([1.0, 2.0, 2.5])
STATE = ph.State([0.8, 0.3, 0.4, 0.2], [[0.1, 0.2, 0.3], [0.4, -0.5, 0.1]])
TS = jnp.array([0.5, 2.0, 6.0])
ROTORS = {
    "held": Rotor([0.0, 0.0, 1.0], momentum=0.4),
    "free": Rotor([0.0, 1.0, 0.0], inertia=0.2, speed=3.0, torque=0.0),
    "oblique": Rotor([1.0, 1.0, 0.0], inertia=0.2, speed=[3.0, -1.0], torque=0.0)
    + Rotor([0.0, 0.0, 2.0], inertia=0.1, speed=2.0),
    "driven": Rotor([1.0, 1.0, 0.0], inertia=0.2, speed=3.0, torque=0.05)
    + Rotor([0.0, 0.0, 1.0], inertia=0.1, speed=2.0, impulse=lambda t: jnp.sin(t)),
}


@pytest.mark.parametrize("name", list(ROTORS))
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


def test_a_wheel_against_newton():
    """One axis: (C - J) domega/dt = -tau; held wheels do not change a spin about their axis."""
    wheel = Rotor([0.0, 0.0, 1.0], inertia=0.5, speed=2.0, torque=[0.0, 0.3])
    scene = ph.Scene(INERTIA, rotors=wheel)
    state = ph.State([1.0, 0, 0, 0], [0.0, 0.0, 1.0])

    def last(torque):
        driven = Rotor([0.0, 0.0, 1.0], inertia=0.5, speed=2.0, torque=torque)
        got = ph.simulate(ph.Scene(INERTIA, rotors=driven), state, TS, rtol=1e-11)
        return got.omega_body[-1, 2]

    got = ph.simulate(scene, state, TS, ph.LiePoisson(), rtol=1e-11)
    want = 1 - np.array([[0.0], [0.3]]) / 2.0 * (np.array(TS) - 0.5)
    assert np.abs(np.array(got.omega_body)[..., 2] - want).max() < 1e-10
    assert abs(jax.jacfwd(last)(0.3) + 5.5 / 2.0) < 1e-9


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
