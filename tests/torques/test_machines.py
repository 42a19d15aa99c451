"""Motors with limits, friction, control laws, dipoles and pulses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import polhode as ph
from polhode._hamiltonian import from_quaternion
from polhode._integrate._stepped import may_jump

INERTIA = ph.Inertia.from_moments([1.0, 1.5, 2.0])
REST = ph.State([1.0, 0, 0, 0], [0.0, 0.0, 0.1])
WORK = ph.Record(work=True)
STARTS, ENDS = [1.0, 5.0, 8.0, 20.0], [1.05, 5.00001, 8.5, 21.0]


def spun(ends, ts, record=None):
    burn = ph.Pulses(ph.BodyTorque([0.0, 0.0, 2.0]), STARTS, ends)
    return ph.simulate(ph.Scene(INERTIA, torque=burn), REST, ts, rtol=1e-11, record=record)


def test_no_pulse_is_missed():
    """A pulse of 10 microseconds, one that is on at the end, one after the end; edges among the
    samples.
    """
    ts = jnp.array([0.0, 3.0, 8.0, 8.25])
    got = spun(ENDS, ts, WORK)
    gain = np.array([0, 0.05, 0.05001, 0.30001])  # torque 2 on a moment of 2
    np.testing.assert_allclose(got.omega_body[:, 2], 0.1 + gain, rtol=0, atol=1e-14)
    np.testing.assert_allclose(got.energy - got.energy[0], got.work, rtol=0, atol=1e-14)
    assert int(got.steps) < 40


@pytest.mark.slow  # faster: derivatives through a jump, solvers/test_switches
def test_slopes_by_the_edges_of_pulses():
    """Final rate and angle with respect to the length of the first pulse; also backward in time."""

    def end(first, ts):
        got = spun([first, *ENDS[1:]], ts, ph.Record(final_only=True))
        angle = 2 * jnp.arctan2(got.wxyz[-1, 3], got.wxyz[-1, 0])
        return jnp.stack([got.omega_body[-1, 2], angle])

    ts = jnp.array([0.0, 9.0])
    value, slope = jax.jit(lambda x: (end(x, ts[::-1]), jax.jacrev(end)(x, ts)))(1.05)
    np.testing.assert_allclose(slope, [1.0, 9.0 - 1.05], rtol=1e-10)
    np.testing.assert_allclose(value[0], 0.1 - 0.55001, rtol=0, atol=1e-13)


def test_a_motor_within_its_limits():
    """Against SciPy: a command of state and time, saturated, on the torque-speed line of a DC
    motor, with dry friction; the work of motor and bearing.
    """
    c, j, stall, top = 2.0, 0.02, 0.05, 8.0
    ts = np.linspace(0.0, 12.0, 5)

    def command(t, wxyz, omega_body, speed):
        return 0.2 * jnp.sin(0.5 * t) + 0.3 * omega_body[2] + 0.1 * wxyz[3]

    drive = ph.Motor(command, stall, top) + ph.CoulombFriction(0.004, 0.5)
    wheel = ph.Rotor([0, 0, 1.0], j, speed=1.0, coupling=drive)
    got = ph.simulate(ph.Scene(INERTIA, rotors=wheel), REST, ts, rtol=1e-10, record=WORK)

    def torque(t, y):
        angle, rate, speed = y[:3]
        wanted = 0.2 * np.sin(0.5 * t) + 0.3 * rate + 0.1 * np.sin(angle / 2)
        low, high = -stall * np.clip(1 + speed / top, 0, 1), stall * np.clip(1 - speed / top, 0, 1)
        return np.clip(wanted, low, high) - 0.004 * np.tanh(speed / 0.5)

    def field(t, y):
        n = torque(t, y)
        return [y[1], -n / (c - j), n / j + n / (c - j), n * y[2]]

    start = [0.0, 0.1, 1.0, 0.0]
    exact = solve_ivp(
        field, ts[[0, -1]], start, "DOP853", ts, rtol=1e-11, atol=1e-13, max_step=0.01
    )
    assert np.max(np.abs(exact.y[2])) > 0.5 * top  # it reaches its limits
    np.testing.assert_allclose(got.omega_body[:, 2], exact.y[1], rtol=0, atol=1e-8)
    np.testing.assert_allclose(got.wheel_speed[:, 0], exact.y[2], rtol=0, atol=1e-6)
    np.testing.assert_allclose(got.motor_work[:, 0], exact.y[3], rtol=0, atol=1e-7)
    np.testing.assert_allclose(got.energy - got.energy[0], got.work, rtol=0, atol=1e-9)


def test_pulses_within_other_parts_keep_their_edges():
    """In a sum, within each other, relative to an orbit frame."""
    inner = ph.Pulses(ph.EnergySink(0.1) + ph.BodyTorque([0.0, 0, 1]), [1.0], [2.0])
    outer = ph.Pulses(inner + ph.LinearDamping(0.1), [0.5], [4.0])
    frame = ph.LVLH(ph.KeplerOrbit(4e14, 7e6))
    whole = ph.RelativeTorque(outer, frame) + ph.LinearDamping(0.1)
    assert sorted(np.asarray(whole.edges).tolist()) == [0.5, 1.0, 2.0, 4.0]
    momentum, omega = (jnp.ones(()),) * 3, (jnp.zeros(()), jnp.ones(()), jnp.zeros(()))
    want = 0.1 * np.cross(np.ones(3), [0, 1, 0])
    for t, on in ((0.7, 0), (1.5, 1), (3.0, 0)):
        for torque in (whole, whole.during(t)):
            slip = torque.slip(jnp.array(t), momentum, omega)
            np.testing.assert_allclose(slip, on * want, atol=1e-16)
    # between the edges nothing depends on time
    np.testing.assert_allclose(whole.during(1.5).slip(jnp.array(9.0), momentum, omega), want)
    np.testing.assert_array_equal(whole.during(3.0).slip(jnp.array(1.5), momentum, omega), 0)


def components_of(torque, wxyz, omega, t=0.5):
    seen = from_quaternion(tuple(jnp.asarray(wxyz)))
    return np.stack(torque.body_components(jnp.array(t), seen, tuple(jnp.asarray(omega))))


def test_pointing_and_rate_damping():
    """-2 kp times the vector part of the shorter error rotation; both signs of a quaternion."""
    target, off = [0.5, 0.5, -0.5, 0.5], np.array([0.3, -0.2, 0.1])
    angle = np.linalg.norm(off)
    turn = np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * off / angle])
    wxyz = ph.rotation.multiply(jnp.array(target), jnp.asarray(turn))
    law = ph.Pointing([1.0, 2.0, 3.0], 0.5, target)
    want = -2 * np.array([1.0, 2, 3]) * turn[1:] - 0.5 * np.array([0.1, 0.2, 0.3])
    for sign in (1, -1):
        np.testing.assert_allclose(
            components_of(law, sign * wxyz, [0.1, 0.2, 0.3]), want, rtol=1e-14
        )
    damping = ph.RateDamping(0.5, [0.1, 0.0, 0.0])
    np.testing.assert_allclose(components_of(damping, wxyz, [0.3, 0.2, 0.0]), [-0.1, -0.1, 0])


def test_a_dipole_in_a_field_of_place_and_time():
    """m x B with B from the position on an orbit, by NumPy; B-dot damps within its limit."""
    earth, place = np.array([0.0, 0.0, -7.8e22]), np.array([7e6, 1e6, 2e6])
    r = np.linalg.norm(place)
    b = 1e-7 * (3 * place * (place @ earth) / r**5 - earth / r**3)
    field = ph.DipoleField(earth)
    np.testing.assert_allclose(field(jnp.asarray(place), 0.0), b, rtol=1e-14)
    wxyz = np.array([0.5, 0.5, -0.5, 0.5])
    seen = np.asarray(ph.rotation.wxyz_to_matrix(jnp.asarray(wxyz))).T @ b
    rods = ph.MagneticDipole([0.1, 0.2, 0.3], field, lambda t: t * jnp.asarray(place) / 0.5)
    got = components_of(rods, wxyz, [0.1, 0.2, 0.3])
    np.testing.assert_allclose(got, np.cross([0.1, 0.2, 0.3], seen), rtol=1e-13)
    omega = np.array([0.1, -0.2, 0.3])
    moment = 1e5 * np.cross(omega, seen)
    free = components_of(ph.MagneticDipole(ph.BDot(1e5), field, place), wxyz, omega)
    np.testing.assert_allclose(free, np.cross(moment, seen), rtol=1e-13)
    assert free @ omega < 0
    most = np.abs(moment).max() / 2
    held = components_of(ph.MagneticDipole(ph.BDot(1e5, most), field, place), wxyz, omega)
    np.testing.assert_allclose(held, np.cross(np.clip(moment, -most, most), seen), rtol=1e-13)
    still = components_of(ph.MagneticDipole([0.1, 0.2, 0.3], b), wxyz, omega)
    np.testing.assert_allclose(still, got, rtol=1e-13)


@pytest.mark.parametrize(
    ("make", "error", "word"),
    [
        (lambda: ph.Pulses(ph.BodyTorque([0.0, 0, 1]), [1.0], [1.0]), ValueError, "end after"),
        (lambda: ph.Pulses(ph.BodyTorque([0.0, 0, 1]), [1.0, 2], [3.0]), ValueError, "one length"),
        (lambda: ph.Pulses(lambda t: t, [1.0], [2.0]), TypeError, "takes a torque"),
        (lambda: ph.Motor(0.1, max_speed=3.0), ValueError, "needs max_torque"),
        (lambda: ph.Motor(0.1, -1.0), ValueError, "must be positive"),
        (lambda: ph.Motor(lambda t: t), TypeError, "t, wxyz, omega_body, speed"),
        (lambda: ph.CoulombFriction(0.1, 0.0), ValueError, "must be positive"),
        (lambda: ph.Pointing(-1.0, 1.0), ValueError, "must not be negative"),
        (lambda: ph.Pointing(1.0, 1.0, [0.0] * 4), ValueError, "must not be zero"),
        (lambda: ph.MagneticDipole(lambda t: t, [0.0, 0, 1]), TypeError, "omega_body, field_body"),
        (lambda: ph.MagneticDipole([0.0, 0, 1], lambda t: t), TypeError, "position, t"),
    ],
)
def test_what_is_refused(make, error, word):
    with pytest.raises(error, match=word):
        make()


def test_limits_of_a_motor_with_a_constant_command_in_a_batch():
    """Its torque has a kink where the wheel reaches ``max_speed``: steps end there, for single
    bodies and in a batch.
    """

    def wheel(speed):
        motor = ph.Motor(0.05, max_torque=0.1, max_speed=5.0)
        return ph.Rotor([0.0, 0.0, 1.0], 0.1, speed=speed, coupling=motor)

    assert may_jump(ph.Scene(INERTIA, rotors=wheel(0.0)))
    states = ph.State(np.tile(REST.wxyz, (8, 1)), np.tile([0.1, 1.0, 0.2], (8, 1)))
    many = ph.simulate(ph.Scene(INERTIA, rotors=wheel(jnp.zeros(8))), states, [0.0, 30.0])

    def newton(t, y):
        omega, spin = y[:3], y[3]
        speed = spin / 0.1 - omega[2]
        torque = np.clip(
            0.05, -0.1 * np.clip(1 + speed / 5, 0, 1), 0.1 * np.clip(1 - speed / 5, 0, 1)
        )
        momentum = np.array([1.0, 1.5, 2.0]) * omega + [0, 0, 0.1 * speed]
        pull = np.cross(momentum, omega) - [0, 0, torque]
        return [*(pull / [1.0, 1.5, 1.9]), torque]

    start = [0.1, 1.0, 0.2, 0.1 * 0.2]
    truth = solve_ivp(newton, (0, 30), start, "DOP853", rtol=1e-12, atol=1e-13, max_step=0.02)
    np.testing.assert_allclose(many.omega_body[:, -1], [truth.y[:3, -1]] * 8, atol=1e-8)


def test_without_a_field_there_is_no_torque():
    wheel = ph.Rotor([0.0, 0.0, 1.0], 0.1, speed=100.0)
    torque = ph.MomentumDumping(1e-3, field=[0.0, 0.0, 0.0])
    got = ph.simulate(ph.Scene(INERTIA, torque=torque, rotors=wheel), REST, [0.0, 1.0])
    assert got.status == ph.Status.SUCCESSFUL
    np.testing.assert_allclose(got.omega_body[-1], REST.omega_body, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("final_only", [False, True])
def test_derivatives_by_times_within_a_pulse_of_a_batch(final_only):
    """A pulse that is on at an end of the span, for bodies integrated from edge to edge."""
    burn = ph.Pulses(ph.BodyTorque([0.0, 0.0, 2.0]), [-1.0, 1.2], [0.5, 5.0])
    states = ph.State(np.tile(REST.wxyz, (6, 1)), np.tile([0.1, 1.0, 0.2], (6, 1)))
    record = ph.Record(final_only=final_only)

    def end(ts):
        motion = ph.simulate(ph.Scene(INERTIA, torque=burn), states, ts, record=record)
        return jnp.sum(motion.omega_body[:, -1] @ jnp.array([1.0, -0.5, 0.7]))

    ts, step = jnp.array([0.0, 1.0, 2.0]), 1e-5
    found = jax.jit(jax.grad(end))(ts)
    for k in (0, 2):
        ends = (float(end(ts.at[k].add(s * step))) for s in (1, -1))
        np.testing.assert_allclose(found[k], np.subtract(*ends) / (2 * step), rtol=1e-6)
