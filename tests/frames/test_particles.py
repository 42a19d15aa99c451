"""Particles in rotating frames against exact solutions."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from polhode.frames import FrameForce, RotatingFrame, SpaceForce, simulate_particles

OMEGA = np.array([0.3, -0.5, 0.7])


@eqx.filter_jit
def in_space(paths):
    return paths.position_space, paths.velocity_space


@eqx.filter_jit
def in_frame(frame, t, position_space, velocity_space):
    at = frame.position_to_frame(t, position_space)
    return at, frame.velocity_to_frame(t, position_space, velocity_space)


def test_free_particles_seen_from_a_steady_frame():
    """Straight lines in space; a batch of shape (2, 3), one particle at rest at the origin."""
    rng = np.random.default_rng(1)
    frame = RotatingFrame.from_rate(OMEGA, wxyz=rng.normal(size=4))
    start, speed = rng.normal(size=(2, 2, 3, 3))
    start[1, 2] = speed[1, 2] = 0
    ts = jnp.linspace(0.0, 5.0, 6)
    at, moving = in_frame(frame, ts[0], jnp.asarray(start), jnp.asarray(speed))
    paths = simulate_particles(frame, at, moving, ts, rtol=3e-14)
    lines = start[:, :, None, :] + np.asarray(ts)[:, None] * speed[:, :, None, :]
    position_space, velocity_space = in_space(paths)
    np.testing.assert_allclose(position_space, lines, rtol=0, atol=1e-12)
    still = np.broadcast_to(speed[:, :, None, :], lines.shape)
    np.testing.assert_allclose(velocity_space, still, rtol=0, atol=1e-12)


@pytest.mark.slow  # faster: a Kepler orbit, below
def test_free_particle_seen_from_a_varying_frame_with_accelerating_origin():
    def rate(t):
        return jnp.stack([jnp.sin(t), 0.4 * t, jnp.cos(2 * t)])

    def origin(t):
        return jnp.stack([jnp.cos(t), 0.1 * t**3, -t * t])

    frame = RotatingFrame.from_rate(rate, origin)
    start, speed = np.array([1.0, 2.0, -0.5]), np.array([0.3, -0.2, 0.8])
    ts = jnp.linspace(0.0, 3.0, 4)
    # at t = 0: space axes, origin at rest at (1, 0, 0), angular velocity along z
    at = start - [1.0, 0.0, 0.0]
    paths = simulate_particles(frame, at, speed - np.cross([0.0, 0.0, 1.0], at), ts, rtol=3e-14)
    lines = start + np.asarray(ts)[:, None] * speed
    made = eqx.filter_jit(lambda paths: paths.position_space)(paths)
    np.testing.assert_allclose(made, lines, rtol=0, atol=2e-12)


def _kepler(t: np.ndarray, eccentricity: float) -> tuple[np.ndarray, np.ndarray]:
    """Position and velocity on an orbit of semi-axis 1 with mu = 1, by Kepler's equation."""
    anomaly = t.copy()
    for _ in range(60):
        anomaly = t + eccentricity * np.sin(anomaly)
    side = np.sqrt(1 - eccentricity**2)
    rate = 1 / (1 - eccentricity * np.cos(anomaly))
    zero = np.zeros_like(t)
    position = [np.cos(anomaly) - eccentricity, side * np.sin(anomaly), zero]
    velocity = [-np.sin(anomaly) * rate, side * np.cos(anomaly) * rate, zero]
    return np.stack(position, axis=-1), np.stack(velocity, axis=-1)


def test_kepler_orbit_seen_from_a_rotating_frame():
    def attraction(t, position, velocity):
        distance = jnp.sqrt(jnp.sum(position**2, axis=-1, keepdims=True))
        return -2.5 * position / distance**3  # newtons on 2.5 kg: mu = 1

    frame = RotatingFrame.from_rate(OMEGA)
    ts = np.linspace(0.0, 2 * np.pi, 9)
    position, velocity = _kepler(ts, 0.3)
    at, moving = in_frame(frame, jnp.asarray(0.0), *jnp.asarray([position[0], velocity[0]]))
    paths = simulate_particles(frame, at, moving, ts, SpaceForce(attraction), 2.5, rtol=1e-14)
    made = in_space(paths)
    np.testing.assert_allclose(made[0], position, rtol=0, atol=1e-12)
    np.testing.assert_allclose(made[1], velocity, rtol=0, atol=1e-12)


def test_foucault_pendulum_turns_at_its_analytic_rate():
    """Axes south, east, up. A horizontal spring swings; its plane turns at -omega sin(latitude).

    The horizontal motion obeys z'' + 2 i n z' + k z = 0 with z = south + i east, n the vertical
    rate, whose solution is exp(-i n t) times a harmonic motion of frequency sqrt(k + n**2).
    """
    day_rate, latitude, stiffness = 0.05, 0.85, 4.0
    omega = day_rate * np.array([-np.cos(latitude), 0.0, np.sin(latitude)])
    frame = RotatingFrame.from_rate(omega)

    def suspension(t, position, velocity):
        """Spring in the horizontal plane; cancels the centrifugal force and fixes the height."""
        spring = -stiffness * position
        held = spring - frame.centrifugal(t, position)
        return held.at[..., 2].set(-frame.apparent_acceleration(t, position, velocity)[..., 2])

    ts = np.linspace(0.0, 60.0, 13)
    at, still = jnp.asarray([0.1, 0.0, 0.0]), jnp.zeros(3)
    paths = simulate_particles(frame, at, still, ts, FrameForce(suspension), rtol=1e-13)
    vertical = day_rate * np.sin(latitude)
    fast = np.sqrt(stiffness + vertical**2)
    exact = 0.1 * np.exp(-1j * vertical * ts)
    exact = exact * (np.cos(fast * ts) + 1j * vertical / fast * np.sin(fast * ts))
    made = np.asarray(paths.position) @ np.array([1, 1j, 0])
    np.testing.assert_allclose(made, exact, rtol=0, atol=1e-11)
    assert np.abs(np.asarray(paths.position[..., 2])).max() < 1e-11


@pytest.mark.slow  # a force in the frame: test_foucault_pendulum_turns_at_its_analytic_rate
def test_falling_body_is_deflected_east_and_a_little_south():
    """r = g t^2/2 - w x g t^3/3 + w x (w x g) t^4/8 + O(w^3 t^5): axes south, east, up."""
    rate, latitude, gravity = 1e-3, 0.8, 9.81
    omega = rate * np.array([-np.cos(latitude), 0.0, np.sin(latitude)])
    frame = RotatingFrame.from_rate(omega)
    pull = jnp.asarray([0.0, 0.0, -gravity])
    weight = FrameForce(lambda t, position, velocity: pull)
    ts = np.array([0.0, 2.0, 5.0])
    paths = simulate_particles(frame, np.zeros(3), np.zeros(3), ts, weight, rtol=1e-13)
    south, east, up = np.asarray(paths.position[-1])
    t = ts[-1]
    third = gravity * rate**3 * t**5  # size of the next term of the series
    np.testing.assert_allclose(east, gravity * rate * np.cos(latitude) * t**3 / 3, atol=third)
    expected = gravity * rate**2 * np.sin(latitude) * np.cos(latitude) * t**4 / 8
    np.testing.assert_allclose(south, expected, rtol=1e-5)
    rise = gravity * rate**2 * np.cos(latitude) ** 2 * t**4 / 8
    np.testing.assert_allclose(up + gravity * t**2 / 2, rise, rtol=1e-5)
    assert south < 1e-2 * east


def test_gradient_of_a_path_against_its_closed_form():
    """End of a free particle, differentiated by its start and by the rate of the frame."""

    def end(start, omega):
        frame = RotatingFrame.from_rate(omega)
        made = simulate_particles(frame, start, jnp.zeros(3), jnp.asarray([0.0, 1.5]), rtol=1e-12)
        return made.position[-1]

    def closed(start, omega):
        frame = RotatingFrame.from_rate(omega)
        speed = jnp.cross(omega, start)
        return frame.position_to_frame(jnp.asarray(1.5), start + 1.5 * speed)

    start, omega = jnp.asarray([1.0, 0.2, -0.4]), jnp.asarray(OMEGA)
    made = jax.jit(jax.jacrev(end, argnums=(0, 1)))(start, omega)
    true = jax.jit(jax.jacfwd(closed, argnums=(0, 1)))(start, omega)
    for left, right in zip(made, true, strict=True):
        np.testing.assert_allclose(left, right, rtol=0, atol=1e-9)


def test_float32_backwards_and_another_solver():
    frame = RotatingFrame.from_rate(jnp.asarray(OMEGA, jnp.float32))
    start = jnp.asarray([1.0, 2.0, -0.5], jnp.float32)
    ts = jnp.linspace(0.0, -2.0, 5, dtype=jnp.float32)
    made = simulate_particles(frame, start, 0 * start, ts, solver=diffrax.Tsit5())
    assert made.position.dtype == made.velocity.dtype == jnp.float32
    speed = np.cross(OMEGA, start)
    lines = np.asarray(start) + np.asarray(ts)[:, None] * speed
    np.testing.assert_allclose(in_space(made)[0], lines, atol=1e-4)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"frame": "ZYZ"}, TypeError, "RotatingFrame"),
        ({"force": lambda t, x, v: x}, TypeError, "FrameForce"),
        ({"mass": 0.0}, ValueError, "mass must be positive"),
        ({"ts": [0.0, 1.0, 1.0]}, ValueError, "strictly"),
        ({"position": [1.0, 2.0]}, ValueError, "position must have shape"),
        ({"position": np.zeros(3, np.float32)}, TypeError, "mix the dtypes"),
        ({"max_steps": 2}, RuntimeError, "was not reached"),
    ],
)
def test_bad_particles_are_named(change, error, message):
    good = {
        "frame": RotatingFrame.from_rate(OMEGA),
        "position": np.ones(3),
        "velocity": np.zeros(3),
        "ts": [0.0, 20.0],
    }
    with pytest.raises(error, match=message):
        simulate_particles(**(good | change))


def test_no_particles_have_empty_paths():
    frame = RotatingFrame.from_rate(OMEGA)
    paths = simulate_particles(frame, np.zeros((2, 0, 3)), np.zeros(3), [0.0, 1.0, 2.0])
    assert paths.position.shape == paths.velocity_space.shape == (2, 0, 3, 3)
    assert bool(paths.successful)
