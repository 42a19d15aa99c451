"""Wheel clusters, momentum dumping and gyroscopes against NumPy and SciPy."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import polhode as ph
from polhode._hamiltonian import components
from polhode._hamiltonian._energy import from_quaternion

MOMENTS = np.array([1.0, 1.5, 2.0])
CORNERS = np.array([[1.0, 1, 1], [-1, 1, 1], [-1, -1, 1], [1, -1, 1]]) / np.sqrt(3)
J, SPEEDS, BIAS, NULL = 0.02, np.array([10.0, -4.0, 7.0, 3.0]), 5.0, 0.3
START = [0.7, 0.1, -0.5, 0.5], [0.02, 0.05, -0.03]
FIELD, K, LIMIT = np.array([1.0, 0.5, -2.0]), 0.2, 0.4
STILL = from_quaternion([jnp.asarray(x) for x in (1.0, 0.0, 0.0, 0.0)])


def law(t, wxyz, omega_body):
    return -0.4 * wxyz[1:] * jnp.sign(wxyz[0]) - 0.9 * omega_body


def matrix(q):
    return Rotation.from_quat(np.roll(q, -1)).as_matrix()


def torques_of(rotors, speeds, wxyz, omega):
    """Motor torques (n,) of the wheels at these speeds."""
    wheels = rotors.settle(jnp.asarray(omega), jnp.zeros(()), jnp.asarray(speeds))
    wheels = wheels.at([wheels.momentum[i] for i in wheels.coupled])
    seen = from_quaternion([jnp.asarray(x) for x in wxyz])
    return np.array(wheels.motor_torques(jnp.zeros(()), seen, components(jnp.asarray(omega))))


def test_wheels_share_the_command_and_null_motion_exerts_no_torque():
    wxyz, omega = np.array(START[0]), np.array(START[1])
    free = ph.wheel_cluster(CORNERS, J, law)
    motors = torques_of(free, SPEEDS, wxyz, omega)
    np.testing.assert_allclose(-CORNERS.T @ motors, law(0.0, wxyz, omega), rtol=1e-12)
    np.testing.assert_allclose(motors, -np.linalg.pinv(CORNERS.T) @ law(0.0, wxyz, omega))
    biased = ph.wheel_cluster(CORNERS, J, law, null_gain=NULL, bias=BIAS)
    extra = torques_of(biased, SPEEDS, wxyz, omega) - motors
    assert np.abs(extra).max() > 1e-2
    np.testing.assert_allclose(CORNERS.T @ extra, 0, atol=1e-15)
    assert np.dot(extra, SPEEDS - BIAS) < 0  # towards the bias


def test_a_cluster_has_one_limit_or_one_for_each_motor():
    wxyz, omega = np.array(START[0]), np.array(START[1])
    free = torques_of(ph.wheel_cluster(CORNERS, J, law), SPEEDS, wxyz, omega)
    for limit in (0.05, [0.01, 0.02, 0.03, 0.5]):
        cluster = ph.wheel_cluster(CORNERS, J, law, max_torque=limit)
        motors = torques_of(cluster, SPEEDS, wxyz, omega)
        np.testing.assert_allclose(motors, np.clip(free, -np.array(limit), limit), rtol=1e-12)
    assert (
        ph.simulate(
            ph.Scene(ph.Inertia.from_moments(MOMENTS), rotors=cluster), ph.State(*START), [0.0, 0.1]
        ).batch_shape
        == ()
    )


def test_clusters_that_are_none_are_refused():
    with pytest.raises(ValueError, match=r"axes must have shape \(n, 3\), got \(2, 4, 3\)"):
        ph.wheel_cluster(np.stack([CORNERS, CORNERS]), J, law)
    for name in ("max_torque", "speed"):
        with pytest.raises(ValueError, match=rf"{name} must be one number or one for each of 4"):
            ph.wheel_cluster(CORNERS, J, law, **{name: [0.1, 0.2]})
    with pytest.raises(ValueError, match="max_torque must be positive"):
        ph.wheel_cluster(CORNERS, J, law, max_torque=[0.1, 0.1, 0.1, -0.1])
    with pytest.raises(ValueError, match="span space"):
        ph.wheel_cluster([[1.0, 0, 0], [0, 1, 0], [1, 1, 0]], J, law)
    with pytest.raises(ValueError, match="command"):
        ph.wheel_cluster(CORNERS, J, lambda t, q, w: w[:2])
    with pytest.raises(ValueError, match="normal to the gimbal"):
        ph.ControlMomentGyro(1.0, [0, 0, 1.0], [0, 1, 1.0], lambda t: t)


def test_a_gyroscope_exerts_the_change_of_its_momentum():
    gimbal, spin, omega = np.array([0.0, 0, 2.0]), np.array([3.0, 0, 0]), np.array([0.3, -0.2, 0.5])
    gyro = ph.ControlMomentGyro(1.5, gimbal, spin, lambda t: 0.4 * jnp.sin(2 * t))
    t = 0.7
    angle, rate = 0.4 * np.sin(2 * t), 0.8 * np.cos(2 * t)
    h = 1.5 * np.array([np.cos(angle), np.sin(angle), 0])
    change = 1.5 * rate * np.array([-np.sin(angle), np.cos(angle), 0])
    found = gyro.body_components(t, STILL, components(jnp.asarray(omega)))
    np.testing.assert_allclose(np.stack(found), -change - np.cross(omega, h), rtol=1e-12)


def test_dumping_is_normal_to_the_field_and_limited():
    unload, h = ph.MomentumDumping(K, FIELD), np.array([0.3, -0.2, 0.1])
    omega = components(jnp.zeros(3))
    assert not np.any(np.stack(unload.body_components(0.0, STILL, omega)))  # no wheels
    found = np.stack(
        unload.with_wheels(components(jnp.asarray(h))).body_components(0.0, STILL, omega)
    )
    normal = h - FIELD * (FIELD @ h) / (FIELD @ FIELD)
    np.testing.assert_allclose(found, -K * normal, rtol=1e-12)
    limited = ph.MomentumDumping(K, FIELD, max_moment=1e-3).with_wheels(components(jnp.asarray(h)))
    moment = np.clip(-K * np.cross(FIELD, h) / (FIELD @ FIELD), -1e-3, 1e-3)
    found = np.stack(limited.body_components(0.0, STILL, omega))
    np.testing.assert_allclose(found, np.cross(moment, FIELD), rtol=1e-12)


# at t = 0 the axes x, y, z of the orbit frame are along space y, -z, -x
FRAME = ph.LVLH(ph.KeplerOrbit(1.0, 1.0))
IN_FRAME = np.array([[0, 0, -1.0], [1, 0, 0], [0, -1, 0]]) @ FIELD


@pytest.mark.parametrize(
    ("wrapped", "field"),
    [
        (lambda x: ph.Pulses(x, [-1.0], [1.0]), FIELD),
        (lambda x: ph.RelativeTorque(x, FRAME), IN_FRAME),
        (lambda x: ph.Pulses(ph.RelativeTorque(x, FRAME), [-1.0], [1.0]), IN_FRAME),
        (lambda x: ph.RelativeTorque(ph.Pulses(x, [-1.0], [1.0]), FRAME), IN_FRAME),
        (lambda x: ph.Pulses(x + ph.BodyTorque([0.0, 0, 0]), [-1.0], [1.0]), FIELD),
    ],
    ids=["pulses", "frame", "pulses in the frame", "frame of pulses", "sum in pulses"],
)
def test_dumping_within_another_torque_knows_the_wheels(wrapped, field):
    h = np.array([0.3, -0.2, 0.1])
    torque = wrapped(ph.MomentumDumping(K, FIELD)).with_wheels(components(jnp.asarray(h)))
    found = np.stack(torque.body_components(jnp.array(0.0), STILL, components(jnp.zeros(3))))
    expected = -K * (h - field * (field @ h) / (field @ field))
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-15)


@pytest.mark.slow
def test_dumping_in_pulses_is_that_between_two_parts_without_it():
    body, wheel = ph.Inertia.from_moments(MOMENTS), ph.Rotor([0.0, 0, 1], momentum=0.3)
    unload, state = ph.MomentumDumping(K, FIELD), ph.State([1.0, 0, 0, 0], [0.2, 0.1, -0.3])
    scene = ph.Scene(body, torque=ph.Pulses(unload, [1.0], [2.5]), rotors=wheel)
    found = ph.simulate(scene, state, [0.0, 4.0], rtol=1e-10).last
    for torque, span in [(None, (0.0, 1.0)), (unload, (1.0, 2.5)), (None, (2.5, 4.0))]:
        state = ph.simulate(ph.Scene(body, torque=torque, rotors=wheel), state, span, rtol=1e-10)
        state = state.last
    np.testing.assert_allclose(found.omega_body, state.omega_body, atol=1e-9)


@pytest.mark.slow
def test_a_controlled_satellite_is_that_of_scipy():
    """Cluster with null motion and limits, dumping and a gyroscope, integrated by SciPy."""
    wheels = ph.wheel_cluster(
        CORNERS,
        J,
        law,
        speed=SPEEDS,
        max_torque=LIMIT,
        null_gain=NULL,
        bias=BIAS,
        friction=ph.ViscousCoupling(1e-3),
    )
    gyro = ph.ControlMomentGyro(0.2, [0, 0, 1.0], [1.0, 0, 0], lambda t: 0.3 * jnp.sin(t))
    torque = ph.MomentumDumping(K, FIELD) + gyro
    scene = ph.Scene(ph.Inertia.from_moments(MOMENTS), torque=torque, rotors=wheels)
    traj = ph.simulate(
        scene, ph.State(*START), [0.0, 4.0, 8.0], rtol=1e-9, record=ph.Record(work=True)
    )
    share = np.linalg.pinv(CORNERS.T)
    null = np.eye(4) - share @ CORNERS.T

    def rates(t, y):
        q, w, speed = y[:4], y[4:7], y[7:]
        command = -0.4 * q[1:] * np.sign(q[0]) - 0.9 * w
        u = -share @ command - NULL * J * null @ (speed - BIAS)
        u = np.clip(u, -LIMIT, LIMIT) - 1e-3 * speed
        c = J * (CORNERS @ w + speed)
        h = CORNERS.T @ c
        carrier = np.diag(MOMENTS) - J * CORNERS.T @ CORNERS
        momentum = carrier @ w + h
        B = matrix(q).T @ FIELD
        push = np.cross(-K * np.cross(B, h) / (B @ B), B)
        angle, rate = 0.3 * np.sin(t), 0.3 * np.cos(t)
        g = 0.2 * np.array([np.cos(angle), np.sin(angle), 0])
        push = push - 0.2 * rate * np.array([-np.sin(angle), np.cos(angle), 0]) - np.cross(w, g)
        total = push - np.cross(w, momentum)
        dw = np.linalg.solve(carrier, total - CORNERS.T @ u)
        turn = np.array([-q[1:] @ w, *(q[0] * w + np.cross(q[1:], w))]) / 2
        return np.concatenate([turn, dw, u / J - CORNERS @ dw])

    y = np.concatenate([*START, SPEEDS])
    y[:4] /= np.linalg.norm(y[:4])
    exact = solve_ivp(rates, (0, 8), y, "DOP853", rtol=1e-11, atol=1e-13, max_step=0.01).y[:, -1]
    np.testing.assert_allclose(traj.wxyz[-1], exact[:4], atol=1e-8)
    np.testing.assert_allclose(traj.omega_body[-1], exact[4:7], atol=1e-8)
    np.testing.assert_allclose(traj.wheel_speed[-1], exact[7:], atol=1e-5)
    balance = traj.energy - traj.work
    np.testing.assert_allclose(balance, balance[0], rtol=1e-8)
