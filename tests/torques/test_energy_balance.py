"""The energy grows by the work of what acts from outside, whatever is in the scene."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode.hamiltonian import Dynamics, external_power, from_quaternion, lie_poisson_field

INERTIA = ph.Inertia.from_tensor([[1.0, 0.1, 0.0], [0.1, 1.5, -0.2], [0.0, -0.2, 1.75]])
STATE = ph.State([0.8, 0.2, 0.4, -0.4], [0.5, -0.25, 0.75])
TIME = jnp.array(1.25)
AXIS = [0.6, 0.0, 0.8]


def turned_in_time(t):
    return jnp.stack([jnp.cos(t), jnp.sin(t), 0.5 + 0.1 * t])


PARTS = {
    "uniform gravity": {"potential": ph.UniformGravity(0.5, [0.1, 0.2, 0.5])},
    "gravity gradient": {"potential": ph.GravityGradient(2.0, [1.0, 0.5, -1.0])},
    "function of time": {"potential": ph.GravityGradient(2.0, turned_in_time)},
    "kepler orbit": {"potential": ph.GravityGradient(2.0, ph.KeplerOrbit(2.0, 1.5, 0.3, 0.4))},
    "state orbit": {
        "potential": ph.GravityGradient(2.0, ph.StateOrbit(2.0, [1.0, 0.5, 0.2], [0.1, 1.0, 0.3]))
    },
    "potential": {"potential": ph.Potential(lambda R, t: R[0, 1] * R[2, 2])},
    "potential of time": {"potential": ph.Potential(lambda R, t: R[0, 1] * jnp.sin(3 * t))},
    "body torque": {"torque": ph.BodyTorque([0.1, 0.2, -0.3])},
    "body torque of time": {"torque": ph.BodyTorque(turned_in_time)},
    "space torque": {"torque": ph.SpaceTorque([0.1, 0.2, -0.3])},
    "space torque of time": {"torque": ph.SpaceTorque(turned_in_time)},
    "feedback": {"torque": ph.FeedbackTorque(lambda t, q, w: t * q[1:] - w)},
    "linear damping": {"torque": ph.LinearDamping([0.1, 0.2, 0.3])},
    "quadratic damping": {"torque": ph.QuadraticDamping(0.3)},
    "momentum held": {"rotors": ph.Rotor(AXIS, momentum=0.4)},
    "speed held": {"rotors": ph.Rotor(AXIS, inertia=0.2, speed=3.0)},
    "wheel free": {"rotors": ph.Rotor(AXIS, inertia=0.2, speed=3.0, torque=0.0)},
    "wheel driven": {"rotors": ph.Rotor(AXIS, inertia=0.2, speed=3.0, torque=0.5)},
    "wheel of an impulse": {"rotors": ph.Rotor(AXIS, inertia=0.2, speed=3.0, impulse=jnp.sin)},
}
PASSIVE = {
    "uniform gravity", "gravity gradient", "potential", "momentum held", "speed held", "wheel free"
}  # fmt: skip


def growth(scene):
    """Slope of the energy along the motion, and the power that is said to come from outside."""
    scene = scene.settled(STATE, jnp.array(0.25))
    momentum = tuple(scene.momentum(STATE.omega_body, TIME))
    wxyz = tuple(STATE.wxyz)
    dynamics = Dynamics(scene.hamiltonian, scene.torque)
    rates = lie_poisson_field(TIME, (momentum, wxyz), dynamics)

    def energy(t, momentum, wxyz):
        return scene.hamiltonian.total(momentum, from_quaternion(wxyz), t)

    _, slope = jax.jvp(energy, (TIME, momentum, wxyz), (jnp.ones_like(TIME), *rates))
    return slope, external_power(TIME, momentum, from_quaternion(wxyz), dynamics)


@pytest.mark.parametrize("name", list(PARTS))
def test_energy_grows_by_the_power_from_outside(name):
    slope, power = growth(ph.Scene(INERTIA, **PARTS[name]))
    np.testing.assert_allclose(slope, power, rtol=0, atol=2e-15)
    assert (abs(float(power)) < 1e-15) == (name in PASSIVE)


def test_the_power_of_a_motor_is_torque_times_speed():
    _, power = growth(ph.Scene(INERTIA, **PARTS["wheel driven"]))
    axis = np.array(AXIS)
    start = 0.2 * (axis @ np.asarray(STATE.omega_body) + 3.0)
    speed = (start + 0.5 * (1.25 - 0.25)) / 0.2 - axis @ np.asarray(STATE.omega_body)
    np.testing.assert_allclose(power, 0.5 * speed, rtol=1e-14)


def test_one_time_is_shared_by_many_bodies():
    scene = ph.Scene(INERTIA, ph.Potential(lambda R, t: R[0, 1] * jnp.sin(t)))
    wxyz = ph.rotation.normalise(jnp.array([[1.0, 2, 3, 4], [-1.0, 0.5, 2, 0], [1.0, 0, 0, 0.1]]))
    lanes = tuple(wxyz.T)
    dynamics = Dynamics(scene.hamiltonian)
    power = external_power(TIME, (jnp.ones(3),) * 3, from_quaternion(lanes), dynamics)
    want = ph.rotation.to_matrix(wxyz)[:, 0, 1] * jnp.cos(TIME)
    np.testing.assert_allclose(power, want, rtol=1e-14, atol=1e-16)
