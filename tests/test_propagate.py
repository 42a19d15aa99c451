"""The prediction step of a filter: Jacobian against differences, noise against a small torque."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode import rotation

MOMENTS = (0.15, 0.14, 0.16)  # kg m^2, of a free flyer as large as a melon
STATE = ph.State([0.9, 0.1, -0.3, 0.2], [0.3, -0.2, 0.4])
PULL = ph.UniformGravity(10.0, [0.0, 0.002, 0.004])
DT = 0.7


def tangent(nominal, end):
    """Error rotation vector and rate errors of the final state (small differences in NumPy)."""
    turn = rotation.multiply(rotation.conjugate(nominal.wxyz), end.wxyz)
    turn = rotation.wxyz_to_rotation_vector(turn)
    return np.concatenate([turn, end.omega_body - nominal.omega_body])


@pytest.mark.parametrize(
    "potential",
    [pytest.param(None, id="free", marks=pytest.mark.slow), pytest.param(PULL, id="gravity")],
)
def test_jacobian_and_noise_are_those_of_the_motion(potential):
    def ends(error, push=None):
        """The motion itself, by a method and a chart that ``propagate`` does not use."""
        turn = rotation.rotation_vector_to_wxyz(jnp.asarray(error[:3]))
        start = ph.State(rotation.multiply(STATE.wxyz, turn), STATE.omega_body + error[3:6])
        inertia = ph.Inertia(diagonal=jnp.array(MOMENTS) + error[6:9])
        torque = ph.BodyTorque(jnp.zeros(3) if push is None else push)
        scene = ph.Scene(inertia, potential, torque)
        traj = ph.simulate(scene, start, jnp.array([2.0, 2.0 + DT]), ph.LiePoisson(), rtol=1e-13)
        return traj.last

    ends = jax.jit(ends)
    scene = ph.Scene(ph.Inertia(diagonal=jnp.array(MOMENTS)), potential)
    state, jacobian, noise = ph.propagate(
        scene, STATE, DT, t=2.0, free=lambda s: s.inertia.diagonal, rtol=1e-12
    )
    nominal = ends(np.zeros(9), np.zeros(3))
    assert float(rotation.angle_between(state.wxyz, nominal.wxyz)) < 1e-11
    np.testing.assert_allclose(state.omega_body, nominal.omega_body, rtol=0, atol=1e-11)

    def slope(at, step):
        """By differences of fourth order."""
        one, two = (
            (tangent(nominal, at(k * step)) - tangent(nominal, at(-k * step))) / (2 * k * step)
            for k in (1, 2)
        )
        return (4 * one - two) / 3

    for k, basis in enumerate(np.eye(9)):
        step = 1e-3 if k < 6 else 1e-4
        want = slope(lambda h, b=basis: ends(h * b, np.zeros(3)), step)
        np.testing.assert_allclose(jacobian[:6, k], want, rtol=0, atol=2e-7 * max(1, 0.1 / step))
    np.testing.assert_array_equal(jacobian[6:], np.eye(9)[6:])
    for k, basis in enumerate(np.eye(3)):
        want = slope(lambda h, b=basis: ends(np.zeros(9), h * b), 1e-3)
        np.testing.assert_allclose(noise[:6, k], want, rtol=0, atol=1e-7)
    np.testing.assert_array_equal(noise[6:], 0)


@pytest.mark.slow
def test_steps_join_and_map():
    """Two half steps equal one whole step; vmap over bodies."""
    scene = ph.Scene(ph.Inertia.from_moments(MOMENTS))
    step = jax.jit(lambda state, dt: ph.propagate(scene, state, dt))
    whole, half = step(STATE, 2 * DT), step(STATE, DT)
    again = step(half.state, DT)
    np.testing.assert_allclose(again.jacobian @ half.jacobian, whole.jacobian, rtol=0, atol=1e-12)
    joined = again.noise + again.jacobian @ half.noise
    np.testing.assert_allclose(joined, whole.noise, rtol=0, atol=1e-11)
    mapped = jax.vmap(lambda state: ph.propagate(scene, state, DT))(BOTH)
    np.testing.assert_allclose(mapped.jacobian[0], half.jacobian, rtol=0, atol=1e-12)


BOTH = ph.State(
    jnp.stack([STATE.wxyz, STATE.wxyz]), jnp.stack([STATE.omega_body, 2 * STATE.omega_body])
)


def test_what_no_step_is_made_of_is_refused():
    scene = ph.Scene(ph.Inertia.from_moments(MOMENTS))
    for free in (lambda s: s.inertia.size, lambda s: 2 * s.inertia.diagonal):
        with pytest.raises(TypeError, match="arrays that the scene holds"):
            ph.propagate(scene, STATE, DT, free=free)
    for given in ((scene, STATE.wxyz), (STATE, STATE)):
        with pytest.raises(TypeError, match=r"must be a ph\."):
            ph.propagate(*given, DT)
    with pytest.raises(ValueError, match="one body"):
        ph.propagate(scene, BOTH, DT)


# Wheels: the coordinates of those without prescribed speed follow attitude and rates.

WHEEL_STATE = ([1.0, 0.2, -0.1, 0.3], [1.0, -0.8, 0.6])
VISCOUS = ph.Rotor([1.0, 1.0, 0.0], 0.2, speed=3.0, coupling=ph.ViscousCoupling(0.4))
HELD = ph.Rotor([1.0, 0.0, 0.0], momentum=0.3)
FREE = ph.Rotor([0.0, 1.0, 1.0], 0.1, speed=1.0, torque=0.0)


def hold(t, wxyz, omega_body, speed):
    return 0.3 * wxyz[1] - 0.2 * omega_body[0] + 0.01 * speed + 0.1 * jnp.sin(t)


def wheel_scene(rotors, potential=None, torque=None):
    return ph.Scene(ph.Inertia(jnp.array([1.0, 1.5, 2.0])), potential, torque, rotors)


WHEELS = {
    "free": lambda: wheel_scene(FREE),
    "gravity, damping, viscous": lambda: wheel_scene(
        VISCOUS, ph.UniformGravity(2.0, [0.1, 0.2, 0.3]), ph.LinearDamping([0.1, 0.2, 0.3])
    ),
    "motor by the state": lambda: wheel_scene(
        ph.Rotor([0.0, 1.0, 1.0], 0.1, momentum=0.2, coupling=ph.Motor(hold))
    ),
    "driven, held, viscous": lambda: wheel_scene(
        ph.Rotor([0.0, 1.0, 1.0], 0.1, speed=1.0, torque=0.3) + HELD + VISCOUS
    ),
    "dry friction, impulse": lambda: wheel_scene(
        ph.Rotor([0.0, 1.0, 1.0], 0.1, speed=1.0, coupling=ph.CoulombFriction(0.1, 0.5))
        + ph.Rotor([1.0, 0.0, 0.0], 0.2, momentum=0.3, impulse=lambda t: 0.1 * jnp.sin(t))
    ),
    "stiff": lambda: wheel_scene(  # fades by exp(-60) in a second
        ph.Rotor([1.0, 1.0, 0.0], 0.02, speed=3.0, coupling=ph.ViscousCoupling(1.2))
    ),
}


def check_wheels(scene, dt, t):
    """Jacobian and noise against differences of ``simulate``, several steps against one."""
    state = ph.State(*WHEEL_STATE)
    wheels = scene.settled(state, jnp.asarray(t)).rotors
    loose = np.array(wheels.loose)
    speeds = [wheels.speed(i, t, tuple(state.omega_body)) for i in range(len(wheels.is_held))]
    n = 6 + len(loose)

    @jax.jit
    def end(error, push):
        wxyz = rotation.multiply(state.wxyz, rotation.rotation_vector_to_wxyz(error[:3]))
        begun = jnp.stack(speeds).at[loose].add(error[6:])
        torque = ph.BodyTorque(push) if scene.torque is None else scene.torque + ph.BodyTorque(push)
        pushed = ph.Scene(scene.inertia, scene.potential, torque, scene.rotors)
        begin = ph.State(wxyz, state.omega_body + error[3:6], begun)
        traj = ph.simulate(pushed, begin, [t, t + dt], rtol=1e-13)
        return traj.wxyz[-1], traj.omega_body[-1], traj.wheel_speed[-1]

    step = ph.propagate(scene, state, dt, t=t, rtol=1e-12)
    assert step.jacobian.shape == (n, n)
    assert step.noise.shape == (n, 3)

    def slope(error, push, size=1e-3):
        def change(k):
            (q, w, s), (q0, w0, s0) = end(k * error, k * push), end(-k * error, -k * push)
            turn = rotation.multiply(rotation.conjugate(q0), q)
            turn = rotation.wxyz_to_rotation_vector(turn)
            return np.concatenate([turn, w - w0, (s - s0)[loose]]) / (2 * k)

        return (4 * change(size) - change(2 * size)) / 3

    none = jnp.zeros(n), jnp.zeros(3)
    flow = np.stack([slope(jnp.asarray(x), none[1]) for x in np.eye(n)], axis=1)
    noise = np.stack([slope(none[0], jnp.asarray(x)) for x in np.eye(3)], axis=1)
    np.testing.assert_allclose(step.jacobian, flow, rtol=0, atol=1e-8 * abs(flow).max())
    np.testing.assert_allclose(step.noise, noise, rtol=0, atol=1e-8 * abs(noise).max())

    first = ph.propagate(scene, state, dt / 3, t=t, rtol=1e-12)
    then = ph.propagate(scene, first.state, 2 * dt / 3, t=t + dt / 3, rtol=1e-12)
    scale = max(1, abs(step.jacobian).max())
    moments = np.asarray(wheels.inertia)  # the tolerance applies to momenta, not to speeds
    wxyz, omega, speed = end(*none)
    for last in (step.state, then.state):
        np.testing.assert_allclose(last.wxyz, wxyz, rtol=0, atol=1e-11 * scale)
        np.testing.assert_allclose(last.omega_body, omega, rtol=0, atol=1e-11 * scale)
        np.testing.assert_allclose(
            (moments * last.wheel_speed)[loose],
            (moments * speed)[loose],
            rtol=0,
            atol=1e-11 * scale,
        )
    # three simulations, each with an error below 10 rtol
    units = np.concatenate([np.ones(6), moments[loose]])[:, None]
    joined = units * (then.jacobian @ first.jacobian - step.jacobian)
    np.testing.assert_allclose(joined, 0, rtol=0, atol=3e-11 * scale)
    joined = units * (then.noise + then.jacobian @ first.noise - step.noise)
    np.testing.assert_allclose(joined, 0, rtol=0, atol=3e-11 * scale)


@pytest.mark.slow  # faster: shapes with wheels, below
def test_a_free_wheel_keeps_its_momentum_under_a_disturbance():
    """Noise of its speed and of the rates against differences; a second step continues."""
    scene, dt = wheel_scene(FREE, torque=ph.BodyTorque(jnp.zeros(3))), 0.3
    state = *WHEEL_STATE, [1.0]  # the same structure as what a step returns: one program
    step = ph.propagate(scene, ph.State(*state), dt, rtol=1e-12)

    def end(push):
        pushed = wheel_scene(FREE, torque=ph.BodyTorque(push))
        return ph.simulate(pushed, ph.State(*state), [0.0, dt], rtol=1e-12)

    up, down = (end(k * jnp.array([0.0, 1e-3, 0.0])) for k in (1, -1))
    omega = (up.omega_body[-1] - down.omega_body[-1]) / 2e-3
    speed = (up.wheel_speed[-1] - down.wheel_speed[-1]) / 2e-3
    np.testing.assert_allclose(step.noise[3:6, 1], omega, rtol=0, atol=1e-6)
    np.testing.assert_allclose(step.noise[6:, 1], speed, rtol=0, atol=1e-6)
    np.testing.assert_allclose(step.state.wheel_speed, up.wheel_speed[-1], rtol=0, atol=1e-3)
    then = ph.propagate(scene, step.state, dt, t=dt, rtol=1e-12)
    whole = ph.simulate(scene, ph.State(*state), [0.0, 2 * dt], rtol=1e-12).last
    for got, want in zip(then.state.__dict__.values(), whole.__dict__.values(), strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "dt"),
    [*((name, 0.3) for name in WHEELS), ("dry friction, impulse", -0.1)],
)
def test_wheels_of_every_kind(name, dt):
    check_wheels(WHEELS[name](), dt, 1.0)


@pytest.mark.slow
def test_noise_in_closed_form_with_a_free_wheel():
    """Integrated over the step, and compared with the same scene when a zero torque forces
    integration.
    """
    scene = ph.Scene(
        ph.Inertia.axisymmetric(1.0, 1.5),
        ph.UniformGravity.axial(1.0, 0.5),
        rotors=ph.Rotor.axial(0.1, speed=5.0, torque=0.0),
    )
    state = ph.State(*WHEEL_STATE)
    closed = ph.propagate(scene, state, 0.5, method=ph.LagrangeTop())
    stepped = ph.propagate(scene, state, 0.5, method=ph.LiePoisson(), rtol=1e-12)
    assert closed.jacobian.shape == (7, 7)
    np.testing.assert_allclose(closed.jacobian, stepped.jacobian, rtol=0, atol=1e-9)
    np.testing.assert_allclose(closed.noise, stepped.noise, rtol=0, atol=1e-9)


def test_held_wheels_have_no_coordinate_and_parameters_follow():
    """Shapes only; nothing is compiled."""
    state = ph.State(*WHEEL_STATE)

    def shapes(scene, free=None, state=state):
        return jax.eval_shape(lambda s: ph.propagate(scene, s, 0.1, free=free), state)

    step = shapes(wheel_scene(HELD))
    assert step.jacobian.shape == (6, 6)
    assert step.state.wheel_speed is None
    scene = wheel_scene(HELD + FREE)
    step = shapes(scene, lambda s: s.inertia.diagonal)
    assert step.jacobian.shape == (10, 10)
    assert step.noise.shape == (10, 3)
    assert step.state.wheel_speed.shape == (2,)
    assert shapes(scene, lambda s: s.rotors.terms[0].momentum).jacobian.shape == (8, 8)
    with pytest.raises(ValueError, match="tangent coordinates already"):
        shapes(scene, lambda s: s.rotors.terms[1].speed)
    with pytest.raises(ValueError, match="speeds of 3 wheels, the scene 2"):
        shapes(scene, state=ph.State(*WHEEL_STATE, [0.0, 0.0, 0.0]))


@pytest.mark.slow
def test_a_disturbance_over_many_turns():
    """In closed form the noise is integrated over parts of the step; NaN rather than wrong."""
    scene, state, dt = ph.Scene(ph.Inertia.from_moments([1.0, 1.5, 2.2])), STATE, 40.0
    found = ph.propagate(scene, state, dt)
    want = ph.propagate(scene, state, dt, method=ph.LiePoisson(), rtol=1e-12)
    np.testing.assert_allclose(found.noise, want.noise, rtol=0, atol=1e-9 * jnp.max(want.noise))
    traced = jax.jit(lambda dt: ph.propagate(scene, state, dt))
    assert jnp.all(jnp.isnan(traced(dt).noise))
    np.testing.assert_allclose(traced(dt).jacobian, found.jacobian, atol=1e-9)
    assert jnp.all(jnp.isfinite(traced(5.0).noise))
    assert jnp.all(jnp.isnan(ph.propagate(scene, state, 1e6).noise))  # too many parts for memory


@pytest.mark.parametrize(
    "torque",
    [None, pytest.param(ph.LinearDamping(1e-9), marks=pytest.mark.slow)],
    ids=["free", "damped"],
)
def test_a_step_is_not_rounded_after_a_day_in_single_precision(torque):
    """If the scene does not depend on time: t + dt has only three digits of dt."""
    inertia = ph.Inertia.spherical(jnp.float32(1))
    state = ph.State(*(jnp.asarray(x, jnp.float32) for x in ([1, 0, 0, 0], [0, 0, 1])))
    step = jax.jit(lambda t: ph.propagate(ph.Scene(inertia, torque=torque), state, 0.01, t=t))
    jacobian = step(jnp.float32(86400.0)).jacobian
    np.testing.assert_allclose(jacobian[2, 5], 0.01, rtol=1e-6)


@pytest.mark.parametrize("traced", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_step_that_times_do_not_resolve_is_refused(traced):
    """In a scene that depends on time; under jit the result is NaN."""
    inertia = ph.Inertia.spherical(jnp.float32(1))
    scene = ph.Scene(inertia, torque=ph.BodyTorque(lambda t: jnp.sin(t) * jnp.ones(3, t.dtype)))
    plain = ph.LiePoisson(diffrax.Euler(), diffrax.ConstantStepSize(), dt0=0.01)
    state = ph.State(*(jnp.asarray(x, jnp.float32) for x in ([1, 0, 0, 0], [0, 0, 1])))
    if traced:
        step = jax.jit(lambda t: ph.propagate(scene, state, 0.01, t=t, method=plain))
        assert np.isnan(step(86400.0).jacobian).all()
        np.testing.assert_allclose(step(100.0).jacobian[2, 5], 0.01, rtol=1e-3)
        return
    with pytest.raises(ValueError, match=r"dt = 0.01 s at t = 86400 s.*later epoch"):
        ph.propagate(scene, state, 0.01, t=86400.0, method=plain)
    with pytest.raises(ValueError, match="one number each"):
        ph.propagate(scene, state, [0.1, 0.2])
    with pytest.raises(TypeError, match="dt must be"):
        ph.propagate(scene, state, "0.1")
