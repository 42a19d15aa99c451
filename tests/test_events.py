"""Events: times in closed form, pairs between samples, derivatives, and motions that stop."""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from devices import told_by
from scipy.special import ellipk

import polhode as ph
from polhode import rotation
from polhode._events._search import minima_of

RATE = 1.7
BALL = ph.Scene(ph.Inertia.spherical(2.0))
STATE = ph.State([1.0, 0.0, 0.0, 0.0], [0.0, RATE, 0.0])  # body x falls: its height is -sin(rate t)
TS = jnp.array([0.0, 3.0, 10.0])
PENDULUM = ph.Scene(ph.Inertia.from_moments([0.8, 0.9, 0.5]), ph.UniformGravity(0.7, [0, 0, -0.3]))


class Height(eqx.Module):
    """Height of body x over a level; the level is a leaf, so that its value does not recompile."""

    level: jax.Array

    def __call__(self, wxyz, omega_body, t):
        return ph.rotation.rotate(wxyz, jnp.array([1.0, 0.0, 0.0]))[2] - self.level


def height(level):
    return Height(jnp.asarray(level, float))


def known(level, rate=RATE, last=10.0):
    """Times at which -sin(rate t) = level, by NumPy."""
    base = np.arcsin(-level)
    times = [(x + 2 * np.pi * k) / rate for k in range(40) for x in (base, np.pi - base)]
    return np.sort([t for t in times if 1e-3 < t < last])


def test_crossings_of_a_turning_ball():
    """To a relative error of 1e-12 in closed form; integrated motions: the pendulum below."""
    traj = ph.simulate(BALL, STATE, TS)
    for level in (0.0, 0.4, -0.9):
        found = ph.crossings(traj, height(level))
        want = known(level)
        assert int(found.count) == want.size == found.times.size
        assert bool(found.complete)
        np.testing.assert_allclose(found.times, want, rtol=1e-12)
        np.testing.assert_allclose(found.slope, -RATE * np.cos(RATE * want), rtol=1e-8)
    assert ph.crossings(traj, height(1.1)).times.shape == (0,)
    # a pair much closer than the samples, and a maximum just below the level
    top = 1.5 * np.pi / RATE + 2 * np.pi / RATE * np.arange(2)
    pair = ph.crossings(traj, height(1 - 1e-8))
    apart = np.arccos(1 - 1e-8) / RATE
    want = np.sort(np.concatenate([top - apart, top + apart]))
    np.testing.assert_allclose(pair.times, want, rtol=0, atol=1e-7)
    assert ph.crossings(traj, height(1 + 1e-8)).count == 0


@pytest.mark.slow
def test_directions_and_time_that_runs_backwards():
    traj = ph.simulate(BALL, STATE, -TS)
    for direction in (-1, 1):
        found = ph.crossings(traj, height(0.4), direction)
        every = ph.crossings(traj, height(0.4))
        wanted = np.sign(every.slope) == direction
        np.testing.assert_allclose(found.times, np.asarray(every.times)[wanted], rtol=1e-14)
        assert np.all(np.sign(found.slope) == direction)
        assert np.all(np.diff(found.times) < 0)  # in the order of the motion


@pytest.mark.slow  # faster: events of a simulation, below
def test_each_body_of_a_batch_has_times_of_its_own():
    rates = np.array([0.05, 0.6, 1.3])
    state = ph.State(STATE.wxyz, jnp.stack([jnp.zeros(3), jnp.asarray(rates), jnp.zeros(3)], -1))
    traj = ph.simulate(BALL, state, TS)
    found = ph.crossings(traj, height(0.4))
    for k, rate in enumerate(rates):
        want = known(0.4, rate)
        assert found.count[k] == want.size
        np.testing.assert_allclose(found.times[k, : want.size], want, rtol=1e-12)
        assert np.all(np.isinf(found.times[k, want.size :]))
    one = ph.crossings(traj, height(0.4), capacity=1)  # too small a capacity is reported
    np.testing.assert_array_equal(one.complete, found.count <= 1)
    np.testing.assert_allclose(one.times[2, 0], known(0.4, 1.3)[0], rtol=1e-12)


def test_event_times_have_derivatives():
    """t = x / rate at a fixed phase x: dt/drate = -t/rate; with respect to the level, 1/slope."""

    @jax.jit
    @jax.value_and_grad
    def second(given):
        rate, level = given
        state = ph.State(STATE.wxyz, jnp.stack([0 * rate, rate, 0 * rate]))
        traj = ph.simulate(BALL, state, TS)  # integrated motions: below
        return ph.crossings(traj, Height(level), capacity=3, samples=64).times[1]

    time, (in_rate, in_level) = second((jnp.asarray(RATE), jnp.asarray(0.4)))
    np.testing.assert_allclose(time, known(0.4)[1], rtol=1e-8)
    np.testing.assert_allclose(in_rate, -time / RATE, rtol=1e-8)
    np.testing.assert_allclose(in_level, -1 / (RATE * np.cos(RATE * time)), rtol=1e-7)


def test_a_pendulum_passes_below_after_a_quarter_period():
    """From rest at 1 rad: 4 K(sin^2(1/2)) / sqrt(m g l / I) by SciPy, for the same gravity."""
    state = ph.State([np.cos(0.5), np.sin(0.5), 0.0, 0.0], [0.0, 0.0, 0.0])
    traj = ph.simulate(PENDULUM, state, [0.0, 6.0], rtol=1e-11)
    found = ph.crossings(traj, lambda wxyz, omega_body, t: wxyz[1] * wxyz[0])
    quarter = ellipk(np.sin(0.5) ** 2) / np.sqrt(0.7 * 9.80665 * 0.3 / 0.8)
    want = quarter * np.arange(1, 40, 2)
    np.testing.assert_allclose(found.times, want[want < 6], rtol=1e-9)


class Rate(eqx.Module):
    """Rate about body y minus a level; the level is a leaf."""

    level: jax.Array

    def __call__(self, wxyz, omega_body, t):
        return omega_body[1] - self.level


def test_a_motion_stops_at_its_event_and_goes_on_with_another_scene():
    """A thruster accelerates the body to one rate, w = a t, a stronger one to a second rate."""
    inertia = ph.Inertia.from_moments([1.0, 2.0, 2.5])

    def pushed(torque, state, ts, rate):  # one program for both calls
        scene = ph.Scene(inertia, None, ph.BodyTorque(torque * jnp.array([0.0, 1.0, 0.0])))
        return ph.simulate(scene, state, ts, until=ph.Event(Rate(jnp.asarray(rate)), 1))

    rest = ph.State([1.0, 0, 0, 0], jnp.zeros((2, 3)).at[1, 1].set(0.75))
    ts = np.linspace(0.0, 6.0, 4) + np.zeros((2, 1))
    on = pushed(0.5, rest, ts, 1.0)  # 0.25 rad/s^2
    np.testing.assert_allclose(on.event_time, [4.0, 1.0], rtol=1e-12)
    np.testing.assert_allclose(on.ts, [[0, 2, 4, 4], [0, 1, 1, 1]], rtol=1e-12)
    np.testing.assert_allclose(on.last.omega_body[:, 1], 1.0, rtol=1e-12)
    np.testing.assert_allclose(on.omega_body[0, :2, 1], [0.0, 0.5], atol=1e-14)
    ts = np.asarray(on.event_time)[:, None] + np.array([0.0, 1.0, 2.0, 3.0]) * [[1.0], [0.25]]
    off = pushed(1.0, on.last, ts, 2.0)  # 0.5 rad/s^2
    np.testing.assert_allclose(off.event_time, [6.0, np.inf], rtol=1e-11)
    turned = np.array(
        [0.25 * 4**2 / 2 + 2 + 0.5 * 2**2 / 2, 0.75 + 0.25 / 2 + 0.75 + 0.5 * 0.75**2 / 2]
    )
    np.testing.assert_allclose(np.abs(off.last.wxyz[:, 0]), np.abs(np.cos(turned / 2)), atol=1e-11)
    # the motion starts where the event function is zero: that is not a crossing
    again = pushed(0.5, on.last, ts, 1.0)
    assert np.all(np.isinf(again.event_time))


@pytest.mark.slow  # faster: one scene after another, integrated, above
def test_a_motion_in_steps_goes_on_in_closed_form():
    """A thruster accelerates the body to a rate, w = a t; then it rotates freely to an attitude."""
    inertia = ph.Inertia.from_moments([1.0, 2.0, 2.5])
    burning = ph.Scene(inertia, None, ph.BodyTorque([0.0, 0.5, 0.0]))  # 0.25 rad/s^2 about y
    rest = ph.State([1.0, 0, 0, 0], jnp.zeros((2, 3)).at[1, 1].set(0.75))
    reached = ph.Event(Rate(jnp.asarray(1.0)), 1)
    ts = np.linspace(0.0, 6.0, 4) + np.zeros((2, 1))
    on = ph.simulate(burning, rest, ts, until=reached)
    ts = np.asarray(on.event_time)[:, None] + np.array([0.0, 1.0, 2.0, 5.0])
    off = ph.simulate(ph.Scene(inertia), on.last, ts, until=ph.Event(height(0.0), -1))
    # angles at the switch; the height of body x falls through zero at 2 pi k
    turned = np.array([0.25 * 4**2 / 2, 0.75 + 0.25 / 2])
    want = np.array([4.0, 1.0]) + (2 * np.pi - turned)
    reached_again = want < np.asarray(ts[:, -1])
    assert reached_again.tolist() == [True, False]
    np.testing.assert_allclose(off.event_time, [want[0], np.inf], rtol=1e-11)


@pytest.mark.parametrize("side", [1, -1])
def test_intervals_with_a_minimum_near_zero_are_searched(side):
    """The cubics through the ends of [0, 1] of (t - 0.3)^2 + lowest and of its negative."""
    lowest = np.array([-0.05, 0.0, 0.04, 0.05, 0.2])
    ends, slopes = np.array([0.09, 0.49]) + lowest[:, None], np.array([[-0.6, 1.4]])
    times, sides = np.array([[0.0, 1.0]]), np.full((5, 2), side)
    searched = minima_of(*map(jnp.asarray, (times, side * ends, side * slopes, sides)))
    np.testing.assert_array_equal(searched[:, 0], lowest <= ends[:, 0] / 2)


@pytest.mark.slow
def test_the_work_follows_from_the_event_and_not_from_the_last_time():
    """Two pendulums from rest with a last time of 1e9 s, which would take far too many steps. The
    events are at a quarter of their periods (SciPy).
    """
    angles = np.array([1.0, 2.5])
    wxyz = np.stack([np.cos(angles / 2), np.sin(angles / 2), 0 * angles, 0 * angles], axis=-1)
    below = ph.Event(lambda wxyz, omega_body, t: wxyz[1] * wxyz[0])
    found = ph.simulate(
        PENDULUM, ph.State(wxyz, jnp.zeros(3)), [0.0, 1.0, 1e9], rtol=1e-11, until=below
    )
    want = ellipk(np.sin(angles / 2) ** 2) / np.sqrt(0.7 * 9.80665 * 0.3 / 0.8)
    np.testing.assert_allclose(found.event_time, want, rtol=1e-10)
    assert np.all(found.steps < 100)
    np.testing.assert_allclose(found.ts[:, 1], np.minimum(want, 1.0))
    np.testing.assert_allclose(found.last.wxyz[:, 1], 0, atol=1e-10)
    energy = found.energy
    np.testing.assert_allclose(energy, energy[:, :1] + 0 * energy, rtol=1e-9)


@pytest.mark.slow
def test_bodies_that_are_set_in_motion_are_looked_at_often_enough():
    """From rest with w = a t, and from rest by a pulse within a span a thousand times as long."""
    scene = ph.Scene(ph.Inertia.spherical(2.0), None, ph.BodyTorque([0.0, 1.0, 0.0]))
    rest = ph.State([1.0, 0, 0, 0], jnp.zeros(3))
    high = ph.Event(height(0.5), 1)  # -sin(t^2/4) = 1/2 for the first time rising
    found = ph.simulate(scene, rest, [0.0, 1e5], until=high)
    np.testing.assert_allclose(found.event_time, np.sqrt(4 * 7 * np.pi / 6), rtol=1e-12)
    pushed = ph.Pulses(ph.BodyTorque([0.0, 50.0, 0.0]), [50.0], [50.1])
    scene = ph.Scene(scene.inertia, None, pushed)
    found = ph.simulate(scene, rest, [0.0, 1e3], until=high)  # turns by 2.5 (t - 50.05)
    np.testing.assert_allclose(found.event_time, 50.05 + 7 * np.pi / 6 / 2.5, rtol=1e-9)


@pytest.mark.parametrize("way", [1.0, -1.0])
@pytest.mark.slow
def test_beyond_its_event_a_body_holds_the_state_of_the_event(way):
    """Balls with rates of both signs: two of three bodies have the event."""
    rates = jnp.array([0.6, 1.3, 0.0])
    state = ph.State(STATE.wxyz, jnp.stack([0 * rates, way * rates, 0 * rates], axis=-1))
    traj = ph.simulate(BALL, state, [0.0, way * 20.0], until=ph.Event(Height(jnp.asarray(0.4))))
    inside, outside = way * jnp.array([0.5, 1.0]), way * jnp.array([30.0, 1e4])
    at = traj.at(jnp.concatenate([inside, outside]))
    met = np.isfinite(np.asarray(traj.event_time))
    assert met.tolist() == [True, True, False]
    for name in ("wxyz", "omega_body"):
        held = np.broadcast_to(getattr(traj.last, name)[:2, None], getattr(at, name)[:2, 2:].shape)
        np.testing.assert_allclose(getattr(at, name)[:2, 2:], held, atol=1e-13)
    np.testing.assert_allclose(at.ts[:2, 2:], np.asarray(traj.event_time)[:2, None] + np.zeros(2))
    np.testing.assert_array_equal(at.ts[2], np.concatenate([inside, outside]))
    free = ph.simulate(BALL, state, [0.0, way * 20.0]).at(inside)
    np.testing.assert_allclose(at.wxyz[:, :2], free.wxyz, atol=1e-13)
    np.testing.assert_allclose(at.at(outside).wxyz[:2], at.wxyz[:2, 2:], atol=1e-13)
    one = jax.jit(lambda t: traj[0].at(t).wxyz)(outside)
    np.testing.assert_allclose(one, at.wxyz[0, 2:], atol=1e-13)
    wait = jax.grad(lambda t: traj[0].at(t[None]).wxyz.sum())(outside[0])
    assert float(wait) == 0


@pytest.mark.slow  # faster: test_event_times_have_derivatives
def test_derivatives_of_a_motion_that_stops():
    """At a fixed phase x = rate t: dt/drate = -t/rate. The attitude is that of the phase, which
    does not depend on the rate, and changes with the level.
    """

    def stop(rate, level):
        state = ph.State(STATE.wxyz, jnp.stack([0 * rate, rate, 0 * rate]))
        span = jnp.array([0.0, 1000.0])
        found = ph.simulate(BALL, state, span, until=ph.Event(Height(level)))
        return (found.event_time, found.last.wxyz), found.event_time

    rates, level = jnp.array([RATE, 0.6, 1.3]), jnp.asarray(0.4)
    slopes = jax.jit(jax.vmap(jax.jacrev(stop, (0, 1), has_aux=True), (0, None)))
    slopes, times = slopes(rates, level)
    (by_rate, by_level), (q_rate, q_level) = jax.tree.map(lambda x: x[0], slopes)
    time = times[0]
    np.testing.assert_allclose(by_rate, -time / RATE, rtol=1e-12)
    slope = -RATE * np.cos(RATE * time)
    np.testing.assert_allclose(by_level, 1 / slope, rtol=1e-12)
    np.testing.assert_allclose(q_rate, 0, atol=1e-14)
    half = RATE * time / 2
    change = np.array([-np.sin(half), 0, np.cos(half), 0]) * RATE / 2 / slope
    np.testing.assert_allclose(q_level, change, rtol=1e-11, atol=1e-15)
    np.testing.assert_allclose(times[1:], [known(0.4, 0.6)[0], known(0.4, 1.3)[0]], rtol=1e-12)


@pytest.mark.slow  # faster: second derivatives of states, tests/free
@pytest.mark.parametrize(("call", "modes"), [("crossings", "fff"), ("until", "ffr")])
def test_third_derivatives_of_events_are_refused(call, modes):
    def time_of(rate):
        state = ph.State(STATE.wxyz, jnp.stack([0 * rate, rate, 0 * rate]))
        event = ph.Event(Height(jnp.asarray(0.4)))
        if call == "until":
            return ph.simulate(BALL, state, jnp.array([0.0, 20.0]), until=event).event_time
        traj = ph.simulate(BALL, state, jnp.array([0.0, 20.0]))
        return ph.crossings(traj, event, capacity=2, samples=64).times[0]

    derivative = time_of
    for mode in modes[1:]:
        derivative = {"f": jax.jacfwd, "r": jax.jacrev}[mode](derivative)
    rate = jnp.asarray(0.6)
    second, time = jax.jit(lambda rate: (derivative(rate), time_of(rate)))(rate)
    np.testing.assert_allclose(second, 2 * time / rate**2, rtol=1e-9)
    third = {"f": jax.jacfwd, "r": jax.jacrev}[modes[0]](derivative)
    with pytest.raises(NotImplementedError, match="first and second derivatives"):
        jax.eval_shape(third, rate)


@pytest.mark.slow
def test_second_derivatives_of_events():
    """Of times, states and slopes, against the closed form of a ball."""

    def known_of(given):
        rate, level = given
        phase = jnp.pi + jnp.arcsin(level)
        half = jnp.cos(phase / 2), 0 * phase, jnp.sin(phase / 2), 0 * phase
        return jnp.stack([phase / rate, *half, -rate * jnp.cos(phase)])

    def found(given):
        rate, level = given
        state = ph.State(STATE.wxyz, jnp.stack([0 * rate, rate, 0 * rate]))
        event, span = ph.Event(Height(level), 1, samples=64), jnp.array([0.0, 10.0])
        held = ph.simulate(BALL, state, span, until=event)
        crossed = ph.crossings(ph.simulate(BALL, state, span), event, capacity=2)
        last = [held.event_time[None], held.last.wxyz, crossed.slope[:1]]
        return jnp.concatenate(last), crossed.times[0]

    given = jnp.array([RATE, 0.4])
    want = jax.hessian(known_of)(given)
    of_held, of_crossed = jax.jit(jax.hessian(found))(given)
    np.testing.assert_allclose(of_held, want, atol=1e-13)
    np.testing.assert_allclose(of_crossed, want[0], atol=1e-13)


@pytest.mark.slow
def test_second_derivatives_of_the_event_of_a_stepped_top():
    """Of time and attitude, against central differences of first derivatives."""

    def stop(rate):
        state = ph.State([np.cos(0.5), np.sin(0.5), 0.0, 0.0], jnp.stack([0.1, rate, 0.3]))
        across = ph.Event(lambda wxyz, omega_body, t: wxyz[1] - 0.4, -1)
        held = ph.simulate(PENDULUM, state, [0.0, 10.0], rtol=1e-11, until=across)
        return held.event_time + held.last.wxyz @ jnp.array([3.0, 0.0, 2.0, 1.0])

    def slope(rate):
        first = jax.grad(stop)(rate)
        return first, first

    both = jax.jit(jax.jacfwd(slope, has_aux=True))
    (second, _), step = both(0.2), 1e-4
    want = (both(0.2 + step)[1] - both(0.2 - step)[1]) / (2 * step)
    assert abs(want) > 0.1
    np.testing.assert_allclose(second, want, rtol=1e-6)


class Edge(eqx.Module):
    """Edge of a dead zone of yaw and rate; ``side`` is a leaf, which a scan may change."""

    side: jax.Array

    def __call__(self, wxyz, omega_body, t):
        return self.side * (2 * jnp.arctan2(wxyz[3], wxyz[0]) + omega_body[2]) - 0.1


def switching_times(leak, pushes, sides):
    """Roots of a + b s + c s^2 for each leg, by NumPy."""
    yaw, rate, t, times = 0.0, 0.0, 0.0, []
    for push, side in zip(pushes, sides):
        gain = (leak + push) / 2.5
        roots = np.roots([gain / 2, rate + gain, yaw + rate - side * 0.1])
        leg = min(x.real for x in roots if abs(x.imag) < 1e-12 and x.real > 1e-6)
        yaw, rate, t = yaw + rate * leg + gain * leg**2 / 2, rate + gain * leg, t + leg
        times.append(t)
    return np.array(times)


@pytest.mark.slow
def test_switching_in_a_scan_has_derivatives():
    """On, off, on, off under jit, lax.scan and reverse mode, with respect to the leak."""
    pushes, sides = jnp.array([0.0, -0.1] * 2), jnp.array([1.0, -1.0] * 2)

    @jax.jit
    def times(leak):
        def leg(carry, given):
            (state, t), (push, side) = carry, given
            torque = ph.BodyTorque(jnp.stack([0 * push, 0 * push, leak + push]))
            scene = ph.Scene(ph.Inertia.from_moments([1.0, 2.0, 2.5]), None, torque)
            span, event = t + jnp.array([0.0, 1e4]), ph.Event(Edge(side), 1)
            found = ph.simulate(scene, state, span, until=event)
            return (found.last, found.event_time), found.event_time

        start = ph.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3)), jnp.zeros(())
        _, found = jax.lax.scan(leg, start, (pushes, sides))
        return found, found

    slopes, found = jax.jit(jax.jacrev(times, has_aux=True))(0.02)
    np.testing.assert_allclose(found, switching_times(0.02, pushes, sides), rtol=1e-12)
    ends = (switching_times(0.02 + x, pushes, sides) for x in (1e-6, -1e-6))
    np.testing.assert_allclose(slopes, np.subtract(*ends) / 2e-6, rtol=1e-7)
    many, _ = jax.jit(jax.vmap(times))(jnp.array([0.02, 0.03]))
    for leak, row in zip((0.02, 0.03), many):
        np.testing.assert_allclose(row, switching_times(leak, pushes, sides), rtol=1e-12)


@pytest.mark.slow
def test_a_batch_on_two_devices_stops_as_on_one():
    found = told_by(Path(__file__).with_name("sharded_until.py"))
    assert set(found) == {"stepped"}
    for name, case in found.items():
        assert case["away"] < 1e-12, name
        assert case["same"], name  # status, and which bodies meet their event
        assert case["met"] == [True, True, False, True], name
        assert case["kept"], name  # the sharding is unchanged


def test_what_is_never_met_is_given_up(monkeypatch):
    monkeypatch.setattr("polhode._events._simulation._MAX_WINDOWS", 10)
    never = ph.Event(lambda wxyz, omega_body, t: omega_body[1] - 3.5)
    with pytest.raises(ph.SimulationError, match="steps"):
        ph.simulate(BALL, STATE, [0.0, 1e6], until=never)
    assert ph.simulate(BALL, STATE, [0.0, 1.0], until=never).event_time == np.inf


def test_what_cannot_be_searched_is_told():
    traj = ph.simulate(BALL, STATE, TS)
    with pytest.raises(ValueError, match="direction"):
        ph.Event(height(0.0), 2)
    with pytest.raises(ValueError, match="samples"):
        ph.Event(height(0.0), samples=1)
    with pytest.raises(TypeError, match="omega_body"):
        ph.Event(lambda t: t)
    with pytest.raises(ValueError, match="single number"):
        ph.Event(lambda wxyz, omega_body, t: omega_body)
    with pytest.raises(TypeError, match=r"ph\.Event"):
        ph.simulate(BALL, STATE, TS, until=height(0.0))
    with pytest.raises(ValueError, match="leave record"):
        ph.simulate(BALL, STATE, TS, until=ph.Event(height(0.0)), record=ph.Record(rates=False))
    for given, match in (({"capacity": 3}, "samples="), ({"samples": 30}, "capacity=")):
        with pytest.raises(ValueError, match=match):
            jax.jit(lambda traj, given=given: ph.crossings(traj, height(0.0), **given))(traj)
    fast = ph.simulate(BALL, ph.State([1.0, 0, 0, 0], [0.0, 1e7, 0]), [0.0, 10.0])
    with pytest.raises(ValueError, match="samples of each body"):
        ph.crossings(fast, height(0.0))


@pytest.mark.slow
def test_a_search_that_runs_out_of_steps_is_told():
    few = ph.simulate(BALL, STATE, [0.0, 20.0], ph.LiePoisson(max_steps=120))
    with pytest.raises(ValueError, match="a body reached the limit of steps"):
        ph.crossings(few, height(0.0))


def slowing(*, rate=0.1):
    """A sphere that spins about z and slows down as exp(-rate t)."""
    law = ph.FeedbackTorque(lambda t, wxyz, omega: -rate * omega)
    return ph.Scene(ph.Inertia.spherical(1.0), None, law)


def below(limit, **options):
    return ph.Event(lambda wxyz, omega, t: omega[2] - limit, -1, **options)


def test_events_of_a_simulation_in_order_of_time():
    """The times are known; a terminal event ends the motion and all later samples repeat it."""
    state = ph.State([1.0, 0, 0, 0], jnp.array([[0.0, 0, 1.0], [0.0, 0, 2.0]]))
    events = [below(0.5), below(0.8), below(0.3, terminal=True), below(0.2)]
    traj = ph.simulate(slowing(), state, jnp.linspace(0.0, 15.0, 16), events=events)
    found = traj.events
    want = 10 * np.log([1 / 0.8, 1 / 0.5, 1 / 0.3])
    np.testing.assert_allclose(found.times[0, :3], want, rtol=1e-9)
    np.testing.assert_array_equal(found.which[0, :4], [1, 0, 2, -1])
    np.testing.assert_array_equal(found.which[1, :3], [1, 0, -1])
    np.testing.assert_array_equal(found.count, [3, 2])
    np.testing.assert_allclose(found.omega_body[1, :2, 2], [0.8, 0.5], rtol=1e-9)
    assert np.all(np.isnan(found.wxyz[0, 3]))
    assert np.isinf(found.times[1, 2])
    np.testing.assert_allclose(traj.event_time, [want[2], np.inf], rtol=1e-9)
    np.testing.assert_allclose(traj.ts[0, -2:], want[2], rtol=1e-9)
    np.testing.assert_allclose(traj.omega_body[0, -1, 2], 0.3, rtol=1e-9)
    np.testing.assert_allclose(found.times[1, 1], 10 * np.log(4), rtol=1e-9)
    assert traj[1].events.count == 2


@pytest.mark.slow  # faster: one event, where a relay turns, below
def test_times_of_events_of_a_motion_in_steps_have_derivatives():
    events = [below(0.5), below(0.8), below(0.3, terminal=True), below(0.2)]
    state = ph.State([1.0, 0, 0, 0], jnp.array([[0.0, 0, 1.0], [0.0, 0, 2.0]]))
    ts = jnp.linspace(0.0, 15.0, 16)

    @jax.jit
    @jax.value_and_grad
    def time(rate):
        traj = ph.simulate(slowing(rate=rate), state, ts, events=events)
        return traj.events.times[1, 1]

    value, slope = time(0.1)
    np.testing.assert_allclose(value, 10 * np.log(4), rtol=1e-9)
    np.testing.assert_allclose(slope, -100 * np.log(4), rtol=1e-7)


@pytest.mark.slow  # faster: integrated motions, above
def test_events_of_a_motion_in_closed_form():
    """The merged events of searches for each event alone, up to the terminal one."""
    state = ph.State([1.0, 0, 0, 0], [0.3, 0.2, 6.0])
    rises = ph.Event(lambda wxyz, omega, t: omega[0], 1)
    falls = ph.Event(lambda wxyz, omega, t: omega[1], -1)
    last = ph.Event(lambda wxyz, omega, t: t - 7.0, 1, terminal=True)
    ts = jnp.linspace(0.0, 10.0, 11)
    scene = ph.Scene(ph.Inertia.axisymmetric(1.0, 1.5))
    traj = ph.simulate(scene, state, ts, events=[rises, falls, last])
    whole = ph.simulate(scene, state, ts)
    alone = [np.asarray(ph.crossings(whole, x).times) for x in (rises, falls)]
    assert all(1 < np.sum(x < 7) < x.size for x in alone)
    want = np.sort(np.concatenate([*(x[x < 7] for x in alone), [7.0]]))
    found = traj.events
    np.testing.assert_allclose(found.times[: want.size], want, atol=1e-12)
    assert int(found.count) == want.size
    assert float(traj.event_time) == pytest.approx(7.0)
    np.testing.assert_allclose(traj.ts[-3:], 7.0)
    np.testing.assert_allclose(found.omega_body[want.size - 1], traj.last.omega_body)


@pytest.mark.slow
def test_more_events_than_are_stored_are_reported():
    """The count is the true one, and a status reports the excess."""
    state = ph.State([1.0, 0, 0, 0], [0.3, 0.2, 3.0])
    scene = ph.Scene(ph.Inertia.from_moments([1.0, 1.5, 2.0]), None, ph.LinearDamping(1e-3))
    few = ph.Event(lambda wxyz, omega, t: omega[0], 0, capacity=2)
    with pytest.raises(ph.SimulationError, match="capacity"):
        ph.simulate(scene, state, [0.0, 20.0], events=few)
    traj = ph.simulate(scene, state, [0.0, 20.0], events=few, throw=False)
    assert int(traj.status) == ph.Status.TOO_MANY_EVENTS
    many = ph.crossings(ph.simulate(scene, state, [0.0, 20.0]), few)
    assert int(traj.events.count) == many.times.size > 2
    np.testing.assert_allclose(traj.events.times, many.times[:2], rtol=1e-9)
    np.testing.assert_allclose(traj.at([1.0]).omega_body[0, 2], 3 * np.exp(-1e-3 / 2), rtol=1e-2)


@pytest.mark.parametrize(
    "torque", [pytest.param(None, marks=pytest.mark.slow), ph.LinearDamping(1e-3)]
)
def test_a_terminal_event_is_stored_when_the_places_are_taken(torque):
    scene = ph.Scene(ph.Inertia.from_moments([1.0, 1.5, 2.0]), None, torque)
    state = ph.State([1.0, 0, 0, 0], [0.3, 0.2, 3.0])
    events = [
        ph.Event(lambda wxyz, omega, t: omega[0], capacity=1),
        ph.Event(lambda wxyz, omega, t: t - 15.0, capacity=1, terminal=True),
    ]
    traj = ph.simulate(scene, state, [0.0, 10.0, 20.0], events=events, throw=False)
    assert int(traj.status) == ph.Status.TOO_MANY_EVENTS
    assert traj.events.which.tolist() == [0, 1]
    np.testing.assert_allclose([traj.event_time, traj.ts[-1], traj.events.times[1]], 15.0)
    assert np.isfinite(traj.omega_body).all()


@pytest.mark.parametrize("mode", [pytest.param(jax.jacfwd, marks=pytest.mark.slow), jax.grad])
def test_an_event_where_a_relay_turns_has_the_derivatives_of_the_motion_before(mode):
    """w' = (0.3, 0, 0.05) up to the event at w_0 = 1/2, beyond which the torque is different.

    Without ``jit``, as in a user's first call.
    """

    weights = jnp.array([1.0, -2.0, 0.5, 3.0])

    def end(rates):
        below, above = jnp.array([0.3, 0.0, 0.05]), jnp.array([-0.6, 0.1, 0.0])
        relay = ph.FeedbackTorque(lambda t, wxyz, omega: jnp.where(omega[0] > 0.5, above, below))
        scene = ph.Scene(ph.Inertia.spherical(1.0), torque=relay)
        event = ph.Event(lambda wxyz, omega, t: omega[0] - 0.5)
        motion = ph.simulate(scene, ph.State([1.0, 0, 0, 0], rates), [0.0, 6.0], until=event)
        return weights @ jnp.append(motion.last.omega_body, motion.event_time)

    found = mode(end)(jnp.array([0.1, 0.2, 0.3]))
    expected = np.array([[0, 0, 0], [0, 1, 0], [-1 / 6, 0, 1], [-1 / 0.3, 0, 0]])
    np.testing.assert_allclose(found, weights @ expected, atol=5e-9)


def test_bad_input_is_told_where_events_are_searched_for():
    """Under jit, where a wrong state raises no error."""
    event = ph.Event(lambda wxyz, omega, t: t - 1.5, samples=20)

    @jax.jit
    def statuses(moments, ts):
        scene = ph.Scene(ph.Inertia.from_moments(moments), None, ph.LinearDamping(0.01))
        state = ph.State([1.0, 0, 0, 0], [0.1, 0.2, 1.3])
        runs = [{"events": event}, {"until": event}]
        return jnp.stack([ph.simulate(scene, state, ts, **run).status for run in runs])

    unsorted = statuses(jnp.array([1.0, 1.5, 2.0]), jnp.array([0.0, 2.0, 1.0, 3.0]))
    assert (unsorted == ph.Status.BAD_TIMES).all()
    needle = statuses(jnp.array([1.0, 1.0, 3.0]), jnp.arange(4.0))
    assert (needle == ph.Status.NOT_PHYSICAL).all()


@pytest.mark.parametrize(
    ("events", "more", "message"),
    [
        ([lambda wxyz, omega, t: t], {}, "ph.Event objects"),
        ([], {}, "empty"),
        (below(1.0), {"until": below(1.0)}, "terminal=True"),
        (below(1.0), {"record": ph.Record(final_only=True)}, "leave record"),
    ],
)
def test_bad_events_are_refused(events, more, message):
    state = ph.State([1.0, 0, 0, 0], [0.0, 0, 1.0])
    with pytest.raises((TypeError, ValueError), match=message):
        ph.simulate(slowing(), state, [0.0, 1.0], events=events, **more)


def test_an_empty_batch_has_no_events_to_search_for():
    scene = ph.Scene(ph.Inertia.spherical(2.0))
    nobody = ph.State(jnp.ones((0, 4)), jnp.ones((0, 3)))
    for more in ({"until": below(0.5)}, {"events": [below(0.5)]}):
        with pytest.raises(ValueError, match="one body at least"):
            ph.simulate(scene, nobody, [0.0, 1.0], **more)
    with pytest.raises(ValueError, match="one body at least"):
        ph.crossings(ph.simulate(scene, nobody, [0.0, 1.0]), below(0.5))


def test_options_of_an_event_are_checked():
    with pytest.raises(TypeError, match="terminal"):
        below(1.0, terminal=1)
    with pytest.raises(ValueError, match="capacity"):
        below(1.0, capacity=0)


@pytest.mark.parametrize(("capacities", "terminal"), [((1, 10), False), ((1, 2), True)])
def test_events_share_their_places_in_closed_form_too(capacities, terminal):
    """An event may use storage that the capacity of others leaves free; all events are counted."""
    events = [
        ph.Event(lambda wxyz, omega, t: jnp.sin(3 * t), capacity=capacities[0], samples=200),
        ph.Event(lambda wxyz, omega, t: t - 4.5, capacity=capacities[1], terminal=terminal),
    ]
    scene = ph.Scene(ph.Inertia.spherical(2.0))
    state = ph.State([1.0, 0.2, 0.1, 0.3], [0.6, 1.1, -0.4])
    traj = ph.simulate(scene, state, [0.0, 6.0], events=events, throw=False)
    times = [*(np.arange(1, 5) * np.pi / 3), 4.5, *([] if terminal else [5 * np.pi / 3])]
    places = sum(capacities)
    kept = np.array(times[:places])
    if terminal:
        kept[-1] = 4.5  # the terminal event is always stored
    np.testing.assert_allclose(traj.events.times[: kept.size], kept, atol=1e-12)
    assert not np.isfinite(traj.events.times[kept.size :]).any()
    assert traj.events.times.shape == (places,)
    if len(times) <= places:
        assert int(traj.status) == ph.Status.SUCCESSFUL
        assert int(traj.events.count) == len(times)
    else:
        assert int(traj.status) == ph.Status.TOO_MANY_EVENTS
        assert int(traj.events.count) > places


def test_an_event_at_the_time_of_a_terminal_one_is_listed():
    """Also if the terminal event is the first in the list."""
    ends = ph.Event(lambda wxyz, omega, t: t - 2.5, samples=50, terminal=True)
    same = ph.Event(lambda wxyz, omega, t: 2.5 - t, samples=50)
    scene = ph.Scene(ph.Inertia.spherical(2.0))
    state = ph.State([1.0, 0.2, 0.1, 0.3], [0.6, 1.1, -0.4])
    found = ph.simulate(scene, state, [0.0, 6.0], events=[ends, same]).events
    np.testing.assert_allclose(found.times[:2], 2.5, atol=1e-12)
    assert sorted(found.which[:2].tolist()) == [0, 1]


# Two balls, forward and backward in time, at the same heights: tests that follow share the program.
WAYS = np.array([1.0, -1.0])
BOTH = ph.State(jnp.tile(STATE.wxyz, (2, 1)), jnp.array([[0, RATE, 0], [0, -RATE, 0]]))
BOTH_TIMES = jnp.stack([TS, -TS])


@pytest.mark.parametrize("level", [-0.5, 0.3, 0.999999])
def test_bodies_that_go_either_way_stop_each_at_its_first_event(level):
    """Also at one of two crossings between two samples, which only the turning point reveals."""
    traj = ph.simulate(BALL, BOTH, BOTH_TIMES, until=ph.Event(height(level)))
    np.testing.assert_allclose(traj.event_time, WAYS * known(level)[0], rtol=0, atol=1e-8)
    at = traj.at([[0.1, 9.0], [-0.1, -9.0]])
    np.testing.assert_allclose(at.ts[:, 0], [0.1, -0.1])
    np.testing.assert_allclose(at.ts[:, 1], traj.event_time)


def test_pairs_of_events_that_no_sample_shows_have_their_states():
    """A direction that is below a plane for a three-thousandth of a revolution."""
    scene, depth = ph.Scene(ph.Inertia.spherical(2.0)), 1 - 5e-7
    below = ph.Event(
        lambda wxyz, omega, t: rotation.rotate(wxyz, jnp.array([1.0, 0.0, 0.0]))[0] + depth,
        capacity=3,
    )
    for speed in np.linspace(0.9, 1.1, 12):
        state = ph.State([1.0, 0, 0, 0], [0.0, 0.0, speed])
        events = ph.simulate(scene, state, [0.0, 7.0], events=below).events
        assert int(events.count) == 2
        half = (np.pi + np.array([-1, 1]) * np.arccos(depth)) / 2
        np.testing.assert_allclose(events.times[:2], 2 * half / speed, atol=1e-9)
        turned = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=-1)
        np.testing.assert_allclose(events.wxyz[:2], turned, atol=1e-9)


@pytest.mark.parametrize("torque", [None, ph.LinearDamping(0.0)], ids=["closed form", "steps"])
def test_times_before_an_event_are_known_from_any_samples(torque):
    """Samples in another order, or only at the event, do not determine the direction of time."""
    scene = ph.Scene(BALL.inertia, torque=torque)
    traj = ph.simulate(scene, BOTH, BOTH_TIMES, until=ph.Event(height(-0.5)))
    event, time = np.asarray(traj.event_time), WAYS * 0.2
    np.testing.assert_allclose(event, WAYS * np.pi / 6 / RATE, rtol=1e-8)
    want = np.stack([np.cos(0.1 * RATE) + 0 * WAYS, 0 * WAYS, np.sin(0.1 * RATE) + 0 * WAYS], -1)
    early = traj.at(np.stack([time, time / 2, 0 * time], axis=-1))
    for samples in (traj, traj[..., ::-1], traj[..., :1], traj[..., -1:], early):
        np.testing.assert_allclose(samples.at(time[:, None]).wxyz[:, 0, :3], want, atol=1e-8)
        np.testing.assert_allclose(samples.at(9 * WAYS[:, None]).ts[:, 0], event)


def test_the_direction_of_an_event_and_that_of_the_search_agree():
    traj = ph.simulate(BALL, STATE, TS)
    want = ph.crossings(traj, height(0.4), -1).times
    for event, given in ((ph.Event(height(0.4)), -1), (ph.Event(height(0.4), -1), 0)):
        np.testing.assert_array_equal(ph.crossings(traj, event, given).times, want)
    with pytest.raises(ValueError, match="direction=1, and crossings was given direction=-1"):
        ph.crossings(traj, ph.Event(height(0.4), 1), -1)
    with pytest.raises(TypeError, match=r"must be ph\.Event objects, got Height"):
        ph.simulate(BALL, STATE, TS, events=height(0.4))


@pytest.mark.slow
def test_functions_that_vanish_together_have_one_event_each():
    """The same height by four formulas that differ by rounding, at every crossing."""
    up = jnp.array([0.0, 0.0, 1.0])
    functions = [
        lambda wxyz, omega_body, t: ph.rotation.rotate(wxyz, up)[2],
        lambda q, omega_body, t: q[0] ** 2 - q[1] ** 2 - q[2] ** 2 + q[3] ** 2,
        lambda q, omega_body, t: 1 - 2 * (q[1] ** 2 + q[2] ** 2),
        lambda wxyz, omega_body, t: ph.rotation.rotate(wxyz, 3 * up)[2],
    ]

    def damping(t, wxyz, omega_body):
        return jnp.where(ph.rotation.rotate(wxyz, up)[2] > 0, -0.05, 0.03) * omega_body

    inertia = ph.Inertia.from_moments([1.0, 1.5, 2.0])
    scene = ph.Scene(inertia, torque=ph.FeedbackTorque(damping))
    state = ph.State([1.0, 0.0, 0.0, 0.0], [0.3, 1.0, 0.2])
    ts = jnp.linspace(0.0, 60.0, 31)
    alone = ph.simulate(scene, state, ts, events=[ph.Event(functions[0])]).events
    together = ph.simulate(scene, state, ts, events=[ph.Event(fn) for fn in functions]).events
    want = alone.times[: int(alone.count)]
    assert want.size == 19
    for k in range(len(functions)):
        found = together.times[together.which == k]
        np.testing.assert_allclose(found, want, rtol=1e-8)
