"""Rotating frames: published forces, transformations both ways, terms that are skipped."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode import rotation
from polhode.frames import RotatingFrame, SampledAttitude

# theory section 8.3
OMEGA, SLOPE = np.array([0.3, -0.5, 0.7]), np.array([0.1, 0.2, -0.3])
POSITION, VELOCITY, MASS = np.array([1.0, -2.0, 0.5]), np.array([0.4, 0.3, -0.2]), 2.0
TIME = 0.4


def variable_frame(dtype=np.float64, **more):
    """A frame whose rate and its derivative are those of theory 8.3 at ``TIME``."""
    omega, slope = OMEGA.astype(dtype), SLOPE.astype(dtype)
    start = jnp.asarray([0.5, -0.5, 0.1, 0.7], dtype)
    rate = lambda t: omega + slope * (t - dtype(TIME))  # noqa: E731
    return RotatingFrame.from_rate(rate, wxyz=start, **more)


def wobbling_attitude(t):
    return rotation.euler_to_matrix(0.3 + 0.7 * t, 1.1 + 0.4 * jnp.sin(t), jnp.cos(2 * t))


def wobbling_origin(t):
    return jnp.stack([jnp.sin(t), t * t, 0.3 * t**3])


@pytest.mark.parametrize("dtype", [np.float64, np.float32], ids=["float64", "float32"])
def test_published_forces(dtype):
    frame = variable_frame(dtype)
    t, position, velocity = dtype(TIME), POSITION.astype(dtype), VELOCITY.astype(dtype)
    position, velocity, t = (jnp.asarray(x) for x in (position, velocity, t))
    tolerance = {"rtol": 0, "atol": 8 * np.finfo(dtype).eps}
    centrifugal = frame.centrifugal(t, position, MASS)
    coriolis, euler = frame.coriolis(t, velocity, MASS), frame.euler(t, position, MASS)
    np.testing.assert_allclose(centrifugal, [0.67, -1.67, -1.48], **tolerance)
    np.testing.assert_allclose(coriolis, [0.44, -1.36, -1.16], **tolerance)
    np.testing.assert_allclose(euler, [1.0, 0.7, 0.8], **tolerance)
    total = (centrifugal + coriolis + euler) / MASS
    np.testing.assert_allclose(
        frame.apparent_acceleration(t, position, velocity), total, **tolerance
    )
    assert total.dtype == dtype


def test_published_velocity():
    frame = RotatingFrame.from_rate(OMEGA)
    zero = jnp.zeros(())
    moved = frame.velocity_to_space(zero, jnp.asarray(POSITION), jnp.asarray(VELOCITY))
    np.testing.assert_allclose(moved, [1.55, 0.85, -0.3], atol=1e-15)


def test_forces_vanish_where_they_must():
    frame = RotatingFrame.from_rate(OMEGA)
    on_axis, t = jnp.asarray(3 * OMEGA), jnp.zeros(())
    assert np.abs(frame.centrifugal(t, on_axis)).max() < 1e-15
    assert np.abs(frame.coriolis(t, on_axis)).max() < 1e-15
    assert not frame.euler(t, on_axis).any()
    assert not frame.origin_force(t).any()


@pytest.mark.parametrize(
    "with_origin",
    [
        pytest.param(False, id="fixed", marks=pytest.mark.slow),
        pytest.param(True, id="moving origin"),
    ],
)
def test_transformations_against_differentiated_paths(with_origin):
    """x_space(t) = origin + R x(t), differentiated directly, and transformed back."""
    origin = wobbling_origin if with_origin else None
    frame = RotatingFrame.from_attitude(wobbling_attitude, origin)

    def path(t):
        return jnp.stack([jnp.cos(3 * t), t - 1, 0.2 * t * t])

    def in_space(t):
        moved = wobbling_attitude(t) @ path(t)
        return moved + wobbling_origin(t) if with_origin else moved

    @jax.jit
    def run(t):
        def twice(function):
            first = jax.jacfwd(function)
            return function(t), first(t), jax.jacfwd(first)(t)

        here, there = twice(path), twice(in_space)
        space = (
            frame.position_to_space(t, here[0]),
            frame.velocity_to_space(t, *here[:2]),
            frame.acceleration_to_space(t, *here),
        )
        back = (
            frame.position_to_frame(t, there[0]),
            frame.velocity_to_frame(t, *there[:2]),
            frame.acceleration_to_frame(t, *there),
        )
        return here, there, space, back

    here, there, space, back = run(jnp.asarray(0.83))
    for made, true in zip((*space, *back), (*there, *here), strict=True):
        np.testing.assert_allclose(made, true, rtol=0, atol=3e-14)


def test_attitude_as_matrix_or_as_quaternion_of_any_scale():
    def quaternion(t):
        return (1 + t * t) * rotation.matrix_to_wxyz(wobbling_attitude(t))

    times = jnp.linspace(-1.0, 2.0, 7)
    one = RotatingFrame.from_attitude(wobbling_attitude)
    other = RotatingFrame.from_attitude(quaternion)

    @jax.jit
    def run(times):
        return [
            (frame.omega_body(times), frame.angular_acceleration(times), frame.attitude(times))
            for frame in (one, other)
        ]

    made = run(times)
    for left, right in zip(*made, strict=True):
        np.testing.assert_allclose(left, right, rtol=0, atol=1e-13)


def test_attitude_of_a_constant_rate_is_exact_and_of_a_variable_one_integrated():
    start = np.array([0.5, -0.5, 0.1, 0.7]) / 1.0
    steady = RotatingFrame.from_rate(OMEGA, wxyz=start, t0=0.2)
    varying = RotatingFrame.from_rate(lambda t: jnp.asarray(OMEGA), wxyz=start, t0=0.2)
    for t in (jnp.asarray(0.2), jnp.asarray(5.0), jnp.asarray(-3.0)):
        apart = rotation.angle_between(steady.attitude(t), eqx.filter_jit(varying.attitude)(t))
        assert apart < 1e-12
    speed = np.linalg.norm(OMEGA)
    period = jnp.asarray(0.2 + 2 * np.pi / speed)
    assert (
        rotation.angle_between(steady.attitude(period), steady.attitude(jnp.asarray(0.2))) < 1e-15
    )


def test_times_broadcast_against_particles():
    frame = RotatingFrame.from_attitude(wobbling_attitude)
    times = jnp.linspace(0.0, 1.0, 5)
    positions = jnp.asarray(np.random.default_rng(0).normal(size=(3, 1, 5, 3)))
    move = eqx.filter_jit(frame.position_to_space)
    together, alone = move(times, positions), move(times[2], positions[1, 0, 2])
    assert together.shape == (3, 1, 5, 3)
    np.testing.assert_allclose(together[1, 0, 2], alone, atol=1e-15)
    masses = jnp.asarray([[[1.0]], [[2.0]], [[3.0]]]) * jnp.ones((3, 1, 5))
    forces = frame.coriolis(times, positions, masses)
    np.testing.assert_allclose(forces[2], 3 * frame.coriolis(times, positions[2]), atol=1e-14)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: RotatingFrame.from_rate([1.0, 2.0]), ValueError, "omega_body must have shape"),
        (lambda: RotatingFrame.from_rate(np.zeros((2, 3))), ValueError, "one frame"),
        (lambda: RotatingFrame.from_rate([1.0, np.nan, 0]), ValueError, "NaN"),
        (lambda: RotatingFrame.from_rate(OMEGA, wxyz=np.zeros(4)), ValueError, "zero"),
        (lambda: RotatingFrame.from_attitude(np.eye(3)), TypeError, "function of time"),
    ],
)
def test_bad_input_is_named(make, error, message):
    with pytest.raises(error, match=message):
        make()


def test_the_attitude_of_a_given_rate_has_its_derivatives_by_time():
    """Also at the first time, where nothing is integrated; in forward and reverse mode."""
    frame = RotatingFrame.from_rate(lambda t: jnp.array([0.1, 0.2 * t, 1.0 + t]))

    @jax.jit
    def rates(t):
        """By the given rate, in forward and in reverse mode, and their derivative."""
        turn = rotation.multiply(frame.attitude(t), jnp.stack([0 * t, 0.1 + 0 * t, 0.2 * t, 1 + t]))
        reverse = jax.jacrev(frame.attitude)
        return turn / 2, jax.jacfwd(frame.attitude)(t), reverse(t), jax.jacfwd(reverse)(t)

    for t in (0.0, 0.5):
        exact, forward, reverse, bend = rates(t)
        np.testing.assert_allclose(forward, exact, atol=1e-12)
        np.testing.assert_allclose(reverse, exact, atol=1e-12)
        gap = (rates(t + 1e-4)[0] - rates(t - 1e-4)[0]) / 2e-4
        np.testing.assert_allclose(bend, gap, atol=1e-7)

    @jax.jit
    def of_strength(strength):
        frame = RotatingFrame.from_rate(lambda t: strength * jnp.array([0.1, 0.2 * t, 1.0 + t]))
        return jax.jacfwd(frame.attitude)(0.5)

    gap = (of_strength(1.001) - of_strength(0.999)) / 2e-3
    np.testing.assert_allclose(jax.jacrev(of_strength)(1.0), gap, atol=1e-6)


def test_a_frame_of_a_motion_that_stopped_at_an_event():
    """Its last times all equal that of the event."""
    times, rate = jnp.array([0.0, 0.5, 1.0, 1.2, 1.2, 1.2]), jnp.array([0.3, 0.4, 1.2])
    turns = rotation.rotation_vector_to_wxyz(jnp.outer(times, rate))
    omega = jnp.broadcast_to(rate, (6, 3))
    frame = RotatingFrame.from_attitude(SampledAttitude(times, turns, omega, 0 * omega))
    np.testing.assert_allclose(frame.attitude(times), turns, atol=1e-14)
    np.testing.assert_allclose(frame.omega_body(times), omega, atol=1e-12)


def test_a_frame_needs_two_samples():
    scene = ph.Scene(ph.Inertia.spherical(2.0))
    state, ts = ph.State([1.0, 0.2, 0.1, 0.3], [0.6, 1.1, -0.4]), jnp.linspace(0, 5, 11)
    last = ph.simulate(scene, state, ts, record=ph.Record(final_only=True))
    with pytest.raises(ValueError, match="two at least"):
        RotatingFrame.from_trajectory(last)


def test_integers_are_times_and_rates_have_the_shape_of_the_times():
    turning = RotatingFrame.from_rate(lambda t: jnp.array([0.0, 0, 2]) * t)
    np.testing.assert_allclose(turning.omega_body(3), [0, 0, 6])
    np.testing.assert_allclose(turning.attitude(1), turning.attitude(1.0))
    uniform = RotatingFrame.from_rate([0.0, 0, 2])
    for rates in (uniform.omega_body, turning.omega_body, uniform.angular_acceleration):
        assert rates(jnp.arange(3.0)).shape == (3, 3)


def test_lists_are_vectors(unchecked):
    frame = RotatingFrame.from_rate([0.0, 0, 2.0])
    want = frame.apparent_acceleration(0.0, jnp.array([1.0, 0, 0]), jnp.array([0.0, 1, 0]))
    np.testing.assert_allclose(frame.apparent_acceleration(0.0, [1.0, 0, 0], [0.0, 1, 0]), want)
    np.testing.assert_allclose(frame.velocity_to_space(0.0, [1.0, 0, 0], [0.0, 1, 0]), [0, 3, 0])


@pytest.mark.parametrize("time", [0.3, 1.1])
def test_derivative_by_the_time_of_the_start(time):
    """At that time, where nothing is integrated, and later."""

    def attitude(t0):
        rate = lambda t: jnp.array([0.1, 0.2, 1.0]) * (1 + t)  # noqa: E731
        return RotatingFrame.from_rate(rate, wxyz=[0.5, 0.5, -0.5, 0.5], t0=t0).attitude(time)

    # about one axis: the angle is an integral
    axis = jnp.array([0.1, 0.2, 1.0])

    def exact(t0):
        turn = rotation.rotation_vector_to_wxyz(axis * (time - t0) * (1 + (time + t0) / 2))
        return rotation.multiply([0.5, 0.5, -0.5, 0.5], turn)

    for jacobian in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jacobian(attitude)(0.3), jacobian(exact)(0.3), atol=1e-12)


@pytest.mark.parametrize("rate", [[0.0, 0, 2.0], lambda t: np.float32([0, 0, 2]) * t])
def test_forces_of_batches_and_no_times(rate, unchecked):
    if not callable(rate):
        rate = jnp.array(rate, jnp.float32)
    frame = RotatingFrame.from_rate(rate, wxyz=jnp.array([1, 0, 0, 0], jnp.float32))
    position, masses = jnp.ones(3, jnp.float32), jnp.ones(4, jnp.float32)
    assert frame.euler(1.0, position, masses).shape == (4, 3)
    assert frame.euler(jnp.ones(2, jnp.float32), position).shape == (2, 3)
    assert frame.origin_force(1.0, masses).shape == (4, 3)
    assert frame.attitude(jnp.zeros(0, jnp.float32)).shape == (0, 4)
    assert frame.omega_body(jnp.zeros((2, 0), jnp.float32)).shape == (2, 0, 3)
    for times in (1, [1, 2], jnp.array([1, 2]), 1.5):
        assert frame.attitude(times).dtype == jnp.float32
    for got in (  # from lists and integers
        frame.position_to_space(1.5, [1, 2, 3]),
        frame.velocity_to_frame(1.5, [1.0, 2.0, 3.0], [1, 2, 3]),
        frame.apparent_acceleration(1.5, [1.0, 2.0, 3.0], [1.0, 2.0, 3.0]),
        frame.euler(1.5, [1.0, 2.0, 3.0]),
    ):
        assert got.dtype == jnp.float32
