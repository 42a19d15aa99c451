"""Frames of tumbling bodies, and sensors fixed in them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import polhode as ph
from polhode import rotation
from polhode.frames import (
    RotatingFrame,
    accelerometer,
    angular_acceleration,
    gyroscope,
)

MOMENTS = np.array([2.0, 2.0, 1.0])
POSITION = np.array([0.3, -0.2, 0.5])


@pytest.fixture(scope="module")
def tumble():
    """An axisymmetric free body, exact: R(t) = Exp(L t/I) Exp(z s t), s = (1 - I_z/I) omega_z."""
    ts = jnp.linspace(0.0, 8.0, 321)
    omega = np.array([0.3, 0.9, 1.4])
    momentum = jnp.asarray(MOMENTS * omega)
    spin = jnp.asarray([0.0, 0.0, (1 - MOMENTS[2] / MOMENTS[0]) * omega[2]])

    @jax.jit
    def exact(times):
        in_space = rotation.rotation_vector_to_wxyz(times[:, None] * momentum[None] / MOMENTS[0])
        in_body = rotation.rotation_vector_to_wxyz(times[:, None] * spin[None])
        wxyz = rotation.multiply(in_space, in_body)
        back = rotation.conjugate(wxyz)
        body = rotation.rotate(back, jnp.broadcast_to(momentum, (times.size, 3)))
        return wxyz, body / MOMENTS[None]

    scene = ph.Scene(ph.Inertia.from_moments(MOMENTS))
    return ph.Trajectory(ts, *exact(ts), jnp.asarray(0), jnp.asarray(0), scene)


def test_angular_acceleration_is_that_of_eulers_equation(tumble):
    omega = np.asarray(tumble.omega_body)
    expected = -np.cross(omega, MOMENTS * omega) / MOMENTS
    np.testing.assert_allclose(angular_acceleration(tumble), expected, rtol=0, atol=1e-15)


def test_sensors_read_what_a_differentiated_path_tells(tumble):
    """Second differences of the point's path in space, rotated into body axes."""
    np.testing.assert_array_equal(gyroscope(tumble), tumble.omega_body)
    path = np.asarray(rotation.rotate(tumble.wxyz, jnp.broadcast_to(POSITION, (321, 3))))
    step = 8.0 / 320
    weights = np.array([-1 / 560, 8 / 315, -1 / 5, 8 / 5, -205 / 72])
    stencil = np.concatenate([weights, weights[-2::-1]])
    spans = np.stack([path[shift : shift + 313] for shift in range(9)])
    acceleration = np.tensordot(stencil, spans, 1) / step**2
    middle = tumble.wxyz[4:-4]
    expected = rotation.rotate(rotation.conjugate(middle), jnp.asarray(acceleration))
    reading = accelerometer(tumble, POSITION)
    np.testing.assert_allclose(reading[4:-4], expected, rtol=0, atol=2e-9)


def test_gravity_is_read_when_the_body_does_not_fall(tumble):
    gravity = np.array([0.0, 0.0, -9.81])
    reading = accelerometer(tumble, np.zeros(3), gravity)
    expected = [-np.asarray(rotation.wxyz_to_matrix(q)).T @ gravity for q in tumble.wxyz]
    np.testing.assert_allclose(reading, np.stack(expected), rtol=0, atol=1e-14)


def test_particle_fixed_in_the_body_feels_what_its_accelerometer_reads(tumble):
    """The apparent acceleration in the frame of the body is minus the reading, at every sample."""
    frame = RotatingFrame.from_trajectory(tumble)
    where = jnp.broadcast_to(POSITION, (321, 3))
    felt = eqx.filter_jit(frame.apparent_acceleration)(tumble.ts, where)
    np.testing.assert_allclose(felt, -accelerometer(tumble, POSITION), rtol=0, atol=1e-11)


def test_interpolated_attitude_converges_with_sixth_order(tumble):
    """Interpolated from every sixteenth and every eighth sample, compared at omitted samples."""
    errors = []

    @eqx.filter_jit
    def everything(frame, ts):
        return frame.attitude(ts), frame.omega_body(ts), frame.angular_acceleration(ts)

    for stride in (16, 8):
        fine, coarse = slice(0, 20 * stride + 1, stride // 8), slice(0, 20 * stride + 1, stride)
        kept = ph.Trajectory(
            tumble.ts[coarse],
            tumble.wxyz[coarse],
            tumble.omega_body[coarse],
            tumble.status,
            tumble.steps,
            tumble.scene,
        )
        frame = RotatingFrame.from_trajectory(kept)
        attitude, omega, bend = everything(frame, tumble.ts[fine])
        apart = rotation.angle_between(attitude, tumble.wxyz[fine])
        rates = jnp.abs(omega - tumble.omega_body[fine])
        bends = jnp.abs(bend - angular_acceleration(tumble)[fine])
        for exact_at_samples in (rates, bends):
            assert exact_at_samples[::8].max() < 1e-11
        errors.append([float(part.max()) for part in (apart, rates, bends)])
    orders = np.log2(np.array(errors[0]) / np.array(errors[1]))
    assert errors[1][0] < 1e-7
    np.testing.assert_allclose(orders, [6, 5, 4], atol=0.5)


def test_axes_that_slip_are_interpolated_by_the_rates_at_which_they_rotate(tumble):
    """An energy sink turns the axes in addition to I^-1 L; the motion is SciPy's."""
    moments, k, times = np.array([1.0, 2.0, 2.5]), 0.3, np.linspace(0.0, 2.0, 161)

    def motion(_, y):
        momentum, (w, *v) = y[4:], y[:4]
        axes_rate = momentum / moments + k * np.cross(momentum, momentum / moments)
        turning = w * axes_rate + np.cross(v, axes_rate)
        return [-np.dot(v, axes_rate) / 2, *turning / 2, *np.cross(momentum, axes_rate)]

    start = [0.5, 0.5, 0.5, 0.5, 0.4, 2.0, 0.75]
    y = solve_ivp(motion, (0, 2), start, "DOP853", times, rtol=1e-12, atol=1e-13).y.T
    wxyz, omega = rotation.normalise(y[:, :4]), jnp.asarray(y[:, 4:] / moments)
    scene = ph.Scene(ph.Inertia.from_moments(moments), torque=ph.EnergySink(k))
    samples = jnp.asarray(times[::4]), wxyz[::4], omega[::4]
    frame = RotatingFrame.from_trajectory(
        ph.Trajectory(*samples, tumble.status, tumble.steps, scene)
    )
    apart = rotation.angle_between(eqx.filter_jit(frame.attitude)(times), wxyz)
    assert apart.max() < 1e-10
    slip = k * np.cross(y[8, 4:], omega[8])
    np.testing.assert_allclose(frame.omega_body(times[8]), omega[8] + slip, rtol=1e-9)
    # sensors rotate with the axes, as the path of the accelerometer in space shows
    made = ph.Trajectory(jnp.asarray(times), wxyz, omega, tumble.status, tumble.steps, scene)
    np.testing.assert_allclose(gyroscope(made)[8], omega[8] + slip, rtol=1e-12)
    path = np.asarray(rotation.rotate(wxyz, jnp.broadcast_to(POSITION, (161, 3))))
    stencil = np.array([1 / 90, -3 / 20, 3 / 2, -49 / 18, 3 / 2, -3 / 20, 1 / 90])
    expected = stencil @ path[5:12] / (times[1] - times[0]) ** 2
    reading = rotation.rotate(wxyz[8], accelerometer(made, POSITION)[8])
    np.testing.assert_allclose(reading, expected, atol=1e-6)


def test_a_torqued_body_and_a_batch_of_bodies():
    top = ph.Scene(
        ph.Inertia.from_moments([2.0, 2.0, 1.0]), ph.UniformGravity(1.0, np.array([0.0, 0.0, 0.5]))
    )
    state = ph.State(wxyz=[0.9, 0.4, 0.1, 0.0], omega_body=[[0.3, 0.1, 5.0], [0.0, 0.0, 1.0]])
    made = ph.simulate(top, state, np.linspace(0.0, 0.02, 9), rtol=1e-12)
    measured = np.gradient(np.asarray(made.omega_body), np.asarray(made.ts), axis=-2, edge_order=2)
    bend = angular_acceleration(made)
    np.testing.assert_allclose(bend[:, 1:-1], measured[:, 1:-1], atol=1e-4)
    assert np.abs(bend).max() > 0.5
    assert accelerometer(made, POSITION).shape == (2, 9, 3)
    with pytest.raises(ValueError, match="batch of bodies"):
        RotatingFrame.from_trajectory(made)


def test_several_accelerometers_on_one_body(tumble):
    places = jnp.array([POSITION, 2 * POSITION, [0.0, 0.0, 1.0], [0.1, 0.0, 0.0]])
    gravity = [0.0, 0.0, -9.8]
    readings = accelerometer(tumble, places, gravity)
    for reading, place in zip(readings, places, strict=True):
        np.testing.assert_allclose(reading, accelerometer(tumble, place, gravity), atol=1e-14)
    several = ph.simulate(
        ph.Scene(ph.Inertia.spherical(1.0)), ph.State([1.0, 0, 0, 0], np.ones((2, 3))), [0.0, 1.0]
    )
    with pytest.raises(ValueError, match=r"broadcast together, got position_body \(4, 3\)"):
        accelerometer(several, places)


def test_missing_records_and_coarse_samples_are_named(tumble):
    lacking = ph.Trajectory(tumble.ts, None, None, tumble.status, tumble.steps, tumble.scene)
    with pytest.raises(ValueError, match="record"):
        RotatingFrame.from_trajectory(lacking)
    with pytest.raises(ValueError, match="record"):
        gyroscope(lacking)
    coarse = ph.Trajectory(
        20 * tumble.ts[::8],
        tumble.wxyz[::8],
        tumble.omega_body[::8],
        tumble.status,
        tumble.steps,
        tumble.scene,
    )
    with pytest.raises(ValueError, match="more times"):
        RotatingFrame.from_trajectory(coarse)


def test_angular_acceleration_with_a_driven_wheel():
    """Free rotation about one axis: the body takes the reaction of the motor's torque."""
    inertia = ph.Inertia.from_moments(jnp.array([[1.0, 1.5, 2.0], [1.0, 1.5, 2.5]]))
    wheel = ph.Rotor([0.0, 0.0, 1.0], inertia=0.25, speed=3.0, torque=0.125)
    state = ph.State([1.0, 0.0, 0.0, 0.0], jnp.array([[0.0, 0.0, 0.5]] * 2))
    traj = ph.simulate(ph.Scene(inertia, rotors=wheel), state, jnp.linspace(0.0, 2.0, 3))
    slope = angular_acceleration(traj)
    want = jnp.array([-0.125 / (2.0 - 0.25), -0.125 / (2.5 - 0.25)])
    np.testing.assert_allclose(slope[..., 2], jnp.broadcast_to(want[:, None], (2, 3)), rtol=1e-12)
    step = (traj.omega_body[:, -1, 2] - traj.omega_body[:, 0, 2]) / 2.0
    np.testing.assert_allclose(step, want, rtol=1e-7)
