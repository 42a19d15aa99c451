"""Commands that are computed at fixed times and constant in between."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import polhode as ph

MOMENTS = np.array([1.0, 1.5, 2.0])
INERTIA = ph.Inertia.from_moments(MOMENTS)
WXYZ, OMEGA = np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.3, -0.2, 0.5])
PERIOD = 0.25
TS = [0.0, 0.1, 0.25, 0.75, 1.6]
"""Inside periods, at their ends, and in one that is cut."""


def law(t, wxyz, omega):
    """A law with a kink and a jump, which a sampled command does not transfer to the field."""
    return jnp.clip(-0.8 * omega - 0.5 * wxyz[1:] * jnp.sign(wxyz[0]), -0.2, 0.2) + 0.1 * t


def truth(ts, damping=0.0):
    """SciPy's motion, period by period."""

    def field(t, y, command):
        q, w = y[:4], y[4:]
        turn = np.concatenate([[-q[1:] @ w], q[0] * w + np.cross(q[1:], w)]) / 2
        torque = command - damping * w
        return np.concatenate([turn, (torque - np.cross(w, MOMENTS * w)) / MOMENTS])

    y, rows = np.concatenate([WXYZ, OMEGA]), []
    for k in range(int(np.ceil(ts[-1] / PERIOD))):
        begin, end = k * PERIOD, min((k + 1) * PERIOD, ts[-1])
        command = np.asarray(law(begin, y[:4], y[4:]))
        options = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-13, "dense_output": True}
        solved = solve_ivp(field, (begin, end), y, args=(command,), **options)
        rows += [solved.sol(t) for t in ts if begin <= t < end]
        y = solved.y[:, -1]
    return np.array([*rows, y])


def scene(fn=law):
    return ph.Scene(INERTIA, torque=ph.SampledTorque(fn, PERIOD))


def test_a_held_command_against_scipy():
    found = ph.simulate(scene(), ph.State(WXYZ, OMEGA), TS)
    both = np.concatenate([found.wxyz, found.omega_body], axis=-1)
    np.testing.assert_allclose(both, truth(TS), atol=1e-11)
    plan = str(ph.explain(scene(), ph.State(WXYZ, OMEGA), TS))
    assert "8 segments, with a command held over every 0.25 s" in plan


def test_a_held_command_beside_a_wheel_with_friction():
    """The momentum of the wheel continues across the edges: against SciPy, by segments."""
    spin_inertia, friction, speed = 0.05, 0.02, 20.0
    carrier = np.diag(MOMENTS) - np.diag([0, 0, spin_inertia])

    def rates_of(y):
        return np.linalg.solve(carrier, y[4:7] - [0, 0, y[7]])

    def field(t, y, command):
        q, w = y[:4], rates_of(y)
        turn = np.concatenate([[-q[1:] @ w], q[0] * w + np.cross(q[1:], w)]) / 2
        motor = -friction * (y[7] / spin_inertia - w[2])
        return np.concatenate([turn, command + np.cross(y[4:7], w), [motor]])

    spin = spin_inertia * (speed + OMEGA[2])
    y = np.concatenate([WXYZ, carrier @ OMEGA + [0, 0, spin], [spin]])
    for begin in np.arange(4) * PERIOD:
        command = np.asarray(law(begin, y[:4], rates_of(y)))
        options = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-13, "args": (command,)}
        y = solve_ivp(field, (begin, begin + PERIOD), y, **options).y[:, -1]
    wheel = ph.Rotor([0, 0, 1], spin_inertia, speed=speed, coupling=ph.ViscousCoupling(friction))
    wheels = ph.Scene(INERTIA, torque=ph.SampledTorque(law, PERIOD), rotors=wheel)
    found = ph.simulate(wheels, ph.State(WXYZ, OMEGA), [0.0, 4 * PERIOD], rtol=1e-10)
    np.testing.assert_allclose(found.last.wxyz, y[:4], atol=1e-9)
    np.testing.assert_allclose(found.last.omega_body, rates_of(y), atol=1e-9)
    at_end = y[7] / spin_inertia - rates_of(y)[2]
    np.testing.assert_allclose(found.wheel_speed[-1, 0], at_end, rtol=1e-9)


@pytest.mark.slow
def test_a_held_command_beside_damping_of_a_batch():
    """Enough bodies for the midpoint rule, a sum of torques, and only one saved time."""
    torque = ph.LinearDamping(0.3) + ph.SampledTorque(law, PERIOD)
    rates = OMEGA * np.linspace(1, 2, 6)[:, None]
    states = ph.State(np.tile(WXYZ, (6, 1)), rates)
    record = ph.Record(final_only=True)
    found = ph.simulate(ph.Scene(INERTIA, torque=torque), states, TS, record=record)
    assert found.wxyz.shape == (6, 1, 4)
    last = np.concatenate([found.wxyz[0, 0], found.omega_body[0, 0]])
    np.testing.assert_allclose(last, truth(TS, 0.3)[-1], atol=1e-9)


@pytest.mark.slow
def test_derivatives_of_a_held_command():
    """With respect to the initial rates and a gain, reverse mode under ``jit``, against
    differences.
    """

    def loss(omega, gain):
        fn = jax.tree_util.Partial(lambda g, t, wxyz, w: -g * w - 0.5 * wxyz[1:], gain)
        last = ph.simulate(scene(fn), ph.State(WXYZ, omega), [0.0, 1.1], rtol=1e-11).last
        return last.omega_body[0] + last.wxyz[1]

    at = jax.jit(loss)
    by_omega, by_gain = jax.jit(jax.grad(loss, (0, 1)))(jnp.array(OMEGA), 0.8)
    h, up = 1e-4, np.array([1e-4, 0, 0])
    np.testing.assert_allclose(by_gain, (at(OMEGA, 0.8 + h) - at(OMEGA, 0.8 - h)) / (2 * h), 1e-6)
    slope = (at(OMEGA + up, 0.8) - at(OMEGA - up, 0.8)) / (2 * h)
    np.testing.assert_allclose(by_omega[0], slope, rtol=1e-6)


def test_a_sampled_torque_says_what_it_cannot():
    state = ph.State(WXYZ, OMEGA)
    event = ph.Event(lambda wxyz, omega, t: omega[0])
    with pytest.raises(ValueError, match="must be positive"):
        ph.SampledTorque(law, -0.1)
    with pytest.raises(TypeError, match="a number in seconds"):
        ph.SampledTorque(law, "fast")
    with pytest.raises(ValueError, match="events are not searched"):
        ph.simulate(scene(), state, TS, until=event)
    with pytest.raises(ValueError, match="list or a NumPy array"):
        jax.jit(lambda: ph.simulate(scene(), state, jnp.linspace(0, 1, 3)).wxyz)()
    with pytest.raises(ValueError, match="drop work"):
        ph.simulate(scene(), state, TS, record=ph.Record(work=True))
    with pytest.raises(ValueError, match="does not contain"):
        ph.propagate(scene(), state, 0.1)
    found = ph.simulate(scene(), state, TS[:2])
    with pytest.raises(ValueError, match="pass all times"):
        found.at(0.05)
    with pytest.raises(ValueError, match="events between"):
        ph.crossings(found, event)


def test_samples_at_the_ends_of_periods_are_edges_in_single_precision():
    """In float32, 100.1 is 1.5e-6 too small: no segment may be shorter than rounding."""
    fn = ph.SampledTorque(law, 0.1)
    body = ph.Inertia.from_moments(jnp.asarray(MOMENTS, jnp.float32))
    state = ph.State(jnp.asarray(WXYZ, jnp.float32), jnp.asarray(OMEGA, jnp.float32))
    plan = ph.explain(ph.Scene(body, torque=fn), state, [100.0, 100.1, 100.7, 101.0])
    assert "; 10 segments" in plan.reason
    # at 1e5 s times are 0.008 s apart: a sample in the middle of a period is no edge
    plan = ph.explain(ph.Scene(body, torque=fn), state, [1e5, 1e5 + 0.05, 1e5 + 1])
    assert "; 11 segments" in plan.reason
    with pytest.raises(ValueError, match=r"no digits for steps of 0\.1 s in float32"):
        ph.simulate(ph.Scene(body, torque=fn), state, [1e7, 1e7 + 10])


def test_a_body_that_fails_does_not_fail_the_others():
    scene = ph.Scene(INERTIA, torque=ph.SampledTorque(law, PERIOD))
    rates = jnp.array([OMEGA, [jnp.nan, 1.0, 0.0]])

    @jax.jit
    def status(rates):
        return ph.simulate(scene, ph.State(jnp.asarray(WXYZ), rates), TS).status

    np.testing.assert_array_equal(status(rates), [ph.Status.SUCCESSFUL, ph.Status.NOT_FINITE])
