"""The energy changes by the work of external torques, for every kind of scene."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode._hamiltonian import (
    Dynamics,
    external_power,
    from_quaternion,
    lie_poisson_field,
    motor_powers,
)

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
        "potential": ph.GravityGradient(
            2.0, ph.KeplerOrbit.from_state(2.0, [1.0, 0.5, 0.2], [0.1, 1.0, 0.3])
        )
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
    "energy sink": {"torque": ph.EnergySink(0.3)},
    "energy sink of a law": {"torque": ph.EnergySink(lambda L, w: 0.1 * jnp.sum(L * w))},
    "energy sink under gravity": {
        "torque": ph.EnergySink(0.3) + ph.LinearDamping(0.1),
        "potential": ph.UniformGravity(0.5, [0.1, 0.2, 0.5]),
    },
    "ring damper": {
        "rotors": ph.Rotor(AXIS, inertia=0.2, speed=3.0, coupling=ph.ViscousCoupling(0.1))
        + ph.Rotor([1.0, 0, 0], inertia=0.1, speed=1.0, impulse=jnp.sin)
        + ph.Rotor([0, 1.0, 0], inertia=0.1, speed=1.0),
    },
    "motor and dry friction": {
        "rotors": ph.Rotor(
            AXIS,
            0.2,
            speed=3.0,
            coupling=ph.Motor(lambda t, q, w, s: jnp.sin(t) + q[1] - w[0] - 0.1 * s, 0.5, 9.0)
            + ph.CoulombFriction(0.1, 0.5),
        )
    },
    "pointing": {"torque": ph.Pointing(0.3, [0.1, 0.2, 0.3], [0.5, 0.5, 0.5, -0.5])},
    "rate damping": {"torque": ph.RateDamping(0.3, [0.1, 0.2, 0.3])},
    "dipole": {
        "torque": ph.MagneticDipole(
            ph.BDot(0.2), ph.DipoleField([0, 0, -1e8]), ph.KeplerOrbit(2.0, 1.5, 0.3, 0.4)
        )
    },
    "pulses": {"torque": ph.Pulses(ph.BodyTorque([0.1, 0.2, -0.3]), [1.0, 3.0], [2.0, 4.0])},
}
PASSIVE = {
    "uniform gravity",
    "gravity gradient",
    "potential",
    "momentum held",
    "speed held",
    "wheel free",
}


def growth(scene):
    """Derivative of the energy along the motion, and the stated external power."""
    scene = scene.settled(STATE, jnp.array(0.25))
    momentum = tuple(scene.momentum(STATE.omega_body, TIME))
    wxyz, dynamics = tuple(STATE.wxyz), scene.dynamics
    spins = ((jnp.array(0.7),),) if dynamics.coupled else ()  # arbitrary, not the initial ones
    y = (momentum, wxyz, *spins)
    rates = lie_poisson_field(TIME, y, dynamics)

    def energy(t, momentum, wxyz, *spins):
        return dynamics.at(*spins).hamiltonian.total(momentum, from_quaternion(wxyz), t)

    _, slope = jax.jvp(energy, (TIME, *y), (jnp.ones_like(TIME), *rates))
    return slope, external_power(TIME, momentum, from_quaternion(wxyz), dynamics.at(*spins))


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


def test_the_power_of_each_wheel():
    """Torque times relative speed: -c Omega^2 for a damper, the derivative of the impulse times
    Omega for a motor; a wheel with prescribed speed has none.
    """
    scene = ph.Scene(INERTIA, **PARTS["ring damper"]).settled(STATE, jnp.array(0.25))
    momentum = tuple(scene.momentum(STATE.omega_body, TIME))
    seen = momentum, from_quaternion(tuple(STATE.wxyz))
    now = scene.dynamics.at((jnp.array(0.7),))
    omega = np.asarray(scene.with_spins((jnp.array(0.7),)).rates(jnp.stack(momentum), TIME))
    speed = 0.7 / 0.2 - np.array(AXIS) @ omega
    start = 0.1 * (STATE.omega_body[0] + 1.0)
    kicked = (start + np.sin(1.25) - np.sin(0.25)) / 0.1 - omega[0]
    found = motor_powers(TIME, *seen, now, (0, 1, 2))
    np.testing.assert_allclose(found, [-0.1 * speed**2, np.cos(1.25) * kicked, 0], rtol=1e-13)


def test_one_time_is_shared_by_many_bodies():
    scene = ph.Scene(INERTIA, ph.Potential(lambda R, t: R[0, 1] * jnp.sin(t)))
    wxyz = ph.rotation.normalise(jnp.array([[1.0, 2, 3, 4], [-1.0, 0.5, 2, 0], [1.0, 0, 0, 0.1]]))
    lanes = tuple(wxyz.T)
    dynamics = Dynamics(scene.hamiltonian)
    power = external_power(TIME, (jnp.ones(3),) * 3, from_quaternion(lanes), dynamics)
    want = ph.rotation.wxyz_to_matrix(wxyz)[:, 0, 1] * jnp.cos(TIME)
    np.testing.assert_allclose(power, want, rtol=1e-14, atol=1e-16)
