"""A trajectory at any time, its bodies and samples, against SciPy and numerical differences."""

import pickle

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import polhode as ph

MOMENTS = (1.0, 1.5, 2.0)
STATE = ph.State([0.9, 0.1, 0.2, 0.3], [0.2, 0.1, 3.0])
TS = jnp.linspace(0.0, 6.0, 13)
ASKED = jnp.array([5.21, 0.0, 6.0, 3.123, 2.5, -0.7, 6.4])  # unsorted, some saved, some outside
CENTRE = (0.0, 0.1, 0.2)


def push(t):
    return jnp.stack([0.3 * jnp.sin(2 * t), jnp.zeros_like(t), 0.1 + 0 * t])


INERTIA = ph.Inertia.from_moments(MOMENTS)
WHEEL = ph.Rotor(axis_body=[0.0, 1.0, 0.0], inertia=0.05, speed=4.0)
SCENES = {
    "free": ph.Scene(INERTIA),
    "top": ph.Scene(INERTIA, ph.UniformGravity(1.0, CENTRE)),
    "pushed": ph.Scene(INERTIA, None, ph.BodyTorque(push)),
    "wheel": ph.Scene(INERTIA, ph.UniformGravity(1.0, CENTRE), rotors=WHEEL),
}


def truth(name, times, rates=STATE.omega_body):
    """Euler's equations written by hand, solved by SciPy's DOP853 at 1e-13."""
    moments = np.array(MOMENTS)
    wheel = np.array([0.0, 0.05 * 4.0, 0.0]) if name == "wheel" else np.zeros(3)

    def field(t, y):
        q, w = y[:4], y[4:]
        torque = np.zeros(3)
        if name in ("top", "wheel"):
            a, b, c, d = q
            down = [b * d - a * c, c * d + a * b, a * a + d * d - q @ q / 2]  # space z, halved
            torque = -2 * 9.80665 * np.cross(CENTRE, down) / (q @ q)
        if name == "pushed":
            torque = np.array([0.3 * np.sin(2 * t), 0, 0.1])
        turned = np.concatenate([[-q[1:] @ w], q[0] * w + np.cross(q[1:], w)]) / 2
        return np.concatenate([turned, (torque - np.cross(w, moments * w + wheel)) / moments])

    times = np.asarray(times, float)
    found = {0.0: np.concatenate([STATE.wxyz, rates])}
    for side in (times[times > 0], times[times < 0]):  # away from 0, from one to the next
        last = 0.0
        for t in sorted(side, key=abs):
            way = solve_ivp(field, (last, t), found[last], "DOP853", rtol=1e-13, atol=1e-13)
            found[t], last = way.y[:, -1], t
    return np.array([found[t] for t in times])


@pytest.mark.parametrize(
    "name", ["free", *(pytest.param(x, marks=pytest.mark.slow) for x in ("pushed", "wheel"))]
)
def test_at_any_time(name):
    """Within rtol for integrated motions, within rounding for closed forms."""
    traj = ph.simulate(SCENES[name], STATE, TS, rtol=1e-10)
    found = traj.at(ASKED)
    want = truth(name, ASKED)
    angle = ph.rotation.angle_between(found.wxyz, jnp.asarray(want[:, :4]))
    tolerance = 1e-12 if name == "free" else 3e-10
    assert float(angle.max()) < tolerance
    np.testing.assert_allclose(found.omega_body, want[:, 4:], rtol=0, atol=4 * tolerance)
    np.testing.assert_allclose(found.ts, ASKED)
    assert bool(found.successful)
    saved = traj.state_at(2.5)  # reproduces the sample to rounding
    np.testing.assert_allclose(saved.omega_body, traj.omega_body[5], rtol=0, atol=2e-14)
    with_nan = traj.at(jnp.array([1.0, jnp.nan]))
    assert np.isfinite(with_nan.wxyz[0]).all()
    assert np.isnan(with_nan.wxyz[1]).all()


def test_records_of_a_trajectory_are_attributes_where_they_were_made():
    traj = ph.simulate(SCENES["free"], STATE, TS)
    for name in ("work", "spins", "event_time", "wheel_speed"):
        assert not hasattr(traj, name)
        assert getattr(traj, name, None) is None
    for error in (AttributeError, ValueError):
        with pytest.raises(error, match=r"no spins, .* only where a wheel has a coupling"):
            _ = traj.spins
    want = traj.to_scipy().apply(np.array(traj.omega_body))
    np.testing.assert_allclose(traj.omega_space, want, atol=1e-14)
    assert len(list(traj[:3])) == 3


def between_samples(scene):
    return ph.simulate(scene, STATE, [0.0, 1.0, 2.0]).at([1.6, 0.7]).omega_body


def legs(scene):
    def leg(state, _):
        end = ph.simulate(scene, state, [0.0, 1.0]).last
        return end, end.omega_body

    return jax.lax.scan(leg, STATE, None, length=2)[1]


@pytest.mark.slow  # faster: tests/xla/test_single_call.py
@pytest.mark.parametrize("rates", [between_samples, legs])
def test_second_derivatives_in_loops(rates):
    def total(moments):
        damping = ph.LinearDamping(0.1)
        return jnp.sum(rates(ph.Scene(ph.Inertia.from_moments(moments), torque=damping)))

    slope, moments = jax.jit(jax.grad(total)), jnp.array(MOMENTS)
    steps = 1e-4 * np.eye(3)
    want = np.stack([(slope(moments + d) - slope(moments - d)) / 2e-4 for d in steps])
    found = jax.jit(jax.hessian(total))(moments)
    np.testing.assert_allclose(found, want, rtol=0, atol=1e-6 * np.abs(want).max())


@pytest.mark.slow  # faster: derivatives at saved times, tests/systems
@pytest.mark.parametrize("name", ["free", "top"])
def test_derivatives_of_a_motion_at_a_time(name):
    """With respect to time, initial rates and moments: SciPy's rates, and differences of SciPy's
    motion.
    """
    potential = SCENES[name].potential

    @jax.jit
    @jax.value_and_grad
    def rate(given):
        t, omega, moments = given
        scene = ph.Scene(ph.Inertia(diagonal=moments), potential)
        return ph.simulate(scene, ph.State(STATE.wxyz, omega), TS).at(t[None]).omega_body[0, 0]

    for time in (3.3, 3.5, 0.0):  # between samples, at one, at the first
        given = (jnp.asarray(time), STATE.omega_body, jnp.array(MOMENTS))
        value, (in_time, in_rates, in_moments) = rate(given)
        step = 1e-4
        times = np.array([-1, 1]) * step + time
        before, after = truth(name, times)[:, 4]
        np.testing.assert_allclose(in_time, (after - before) / (2 * step), rtol=1e-6)
        sides = [
            truth(name, [time], np.add(STATE.omega_body, [0, s * step, 0]))[0, 4] for s in (-1, 1)
        ]
        np.testing.assert_allclose(in_rates[1], (sides[1] - sides[0]) / (2 * step), atol=1e-6)
        assert np.isfinite(in_moments).all()
        later = rate((given[0], given[1], given[2] + jnp.array([0, step, 0])))[0]
        np.testing.assert_allclose(in_moments[1], (later - value) / step, rtol=2e-3, atol=2e-3)


@pytest.fixture(scope="module")
def batch():
    rates = STATE.omega_body[None] * jnp.linspace(1, 2, 6)[:, None]
    wxyz = jnp.broadcast_to(STATE.wxyz, (2, 3, 4))
    mass = jnp.array([[1.0], [0.5]])  # a batch axis that broadcasts
    potential = ph.UniformGravity(mass, CENTRE)
    return ph.simulate(
        ph.Scene(INERTIA, potential), ph.State(wxyz, rates.reshape(2, 3, 3)), TS, rtol=1e-11
    )


@pytest.mark.slow
def test_bodies_and_samples_are_chosen_as_from_an_array(batch):
    wxyz, energy = np.asarray(batch.wxyz), np.asarray(batch.energy)
    mask = np.array([[True, False, True], [False, True, False]])
    for key in (0, -1, (1, 2), (slice(None), [0, 2]), mask, (..., slice(2, 9, 3)), (0, slice(1))):
        chosen = batch[key]
        kept = np.stack([wxyz[..., c][key] for c in range(4)], axis=-1)
        np.testing.assert_array_equal(chosen.wxyz, kept)
        np.testing.assert_allclose(chosen.energy, energy[key], rtol=1e-15)
        assert chosen.batch_shape == kept.shape[:-2]
        assert chosen.ts.shape[-1] == kept.shape[-2]
    one = batch[1, 2]
    assert [body.batch_shape for body in batch] == [(3,), (3,)]
    np.testing.assert_array_equal(one[-1].ts, TS[-1:])  # the axis of time stays
    np.testing.assert_array_equal(batch[..., -1].wxyz, wxyz[..., -1:, :])
    np.testing.assert_array_equal(batch.between(2.0, 3.0).ts, [2.0, 2.5, 3.0])
    assert batch.last.wheel_speed is None
    np.testing.assert_array_equal(batch.last.wxyz, batch.wxyz[..., -1, :])
    np.testing.assert_array_equal(batch.last.omega_body, batch.omega_body[..., -1, :])
    # each body continues with its own numbers
    np.testing.assert_allclose(one.at(ASKED).wxyz, batch.at(ASKED).wxyz[1, 2], atol=1e-11)
    own = jnp.broadcast_to(ASKED, (2, 3, ASKED.size)) + 0.1 * jnp.arange(3.0)[None, :, None]
    np.testing.assert_allclose(batch.at(own).wxyz[1, 2], one.at(ASKED + 0.2).wxyz, atol=1e-11)


def test_samples_between_two_times_where_times_are_in_any_order():
    traj = ph.simulate(SCENES["free"], STATE, TS).at([3.0, 1.0, 2.0, 5.0])
    chosen = traj.between(2.5, 5.5)
    np.testing.assert_array_equal(chosen.ts, [3.0, 5.0])
    np.testing.assert_array_equal(chosen.wxyz, traj.wxyz[..., np.array([0, 3]), :])
    np.testing.assert_array_equal(traj.between(1.0, 2.0).ts, [1.0, 2.0])


def test_what_no_sample_has_is_refused(batch):
    for key in (2, (0, 3), (0, 0, 13), (0, 0, 0, 0), "x", None, 1.5):
        with pytest.raises(IndexError):
            batch[key]
    with pytest.raises(ValueError, match="between samples use"):
        batch.between(2.1, 2.2)
    with pytest.raises(ValueError, match=r"\(2, 3\)"):
        batch.at(jnp.zeros((3, 2, 1)))
    with pytest.raises(ValueError, match="no samples"):
        batch[..., 3:3].at(1.0)
    rates = ph.simulate(SCENES["free"], STATE, TS, record=ph.Record(attitude=False))
    with pytest.raises(ValueError, match="no wxyz"):
        rates.at(1.0)


@pytest.mark.slow
def test_a_trajectory_is_data_everywhere():
    """After jit, vmap, pickling and reassembly it can still be evaluated at any time."""
    scene = SCENES["top"]

    def moved(omega):
        return ph.simulate(scene, ph.State(STATE.wxyz, omega), TS)

    want = moved(STATE.omega_body).at(ASKED).wxyz
    both = jax.vmap(moved)(jnp.stack([STATE.omega_body, 2 * STATE.omega_body]))
    for traj in (
        jax.jit(moved)(STATE.omega_body),
        both[0],
        jax.tree.map(lambda x: x, moved(STATE.omega_body)),
        pickle.loads(pickle.dumps(moved(STATE.omega_body))),
    ):
        np.testing.assert_allclose(traj.at(ASKED).wxyz, want, rtol=0, atol=1e-9)


def test_euler_angles_of_any_sequence_are_those_of_scipy():
    traj = ph.simulate(SCENES["free"], STATE, TS)
    scipy = Rotation.from_quat(np.asarray(ph.rotation.wxyz_to_xyzw(traj.wxyz)))
    for axes in ("ZYX", "zyx", "XYZ", "yxz", "ZXZ", "zyz"):
        np.testing.assert_allclose(np.stack(traj.euler(axes), -1), scipy.as_euler(axes), atol=1e-12)
    np.testing.assert_array_equal(traj.euler(), traj.euler(ph.rotation.Sequence.ZYZ))
    for wrong in ("ZZX", "ZyX", "abc", ""):
        with pytest.raises(ValueError, match="no sequence is called"):
            traj.euler(wrong)


def test_a_printed_trajectory_shows_size_status_and_steps():
    """For a batch: how many bodies have each status, and the range of their steps."""
    body = ph.Inertia.from_moments([1.0, 1.5, 2.0])
    free = ph.simulate(ph.Scene(body), ph.State([1.0, 0, 0, 0], [0.3, 0.2, 1.0]), [0.0, 2.5])
    assert str(free).split("\n") == [
        "1 body x 2 samples, float64",
        "times   0 to 2.5 s",
        "status  1 SUCCESSFUL",
        "steps   none: a closed form",
    ]
    scene = ph.Scene(body, torque=ph.LinearDamping(0.1))
    states = ph.State([1.0, 0, 0, 0], [[0.3, 0.2, 1.0], [3.0, 20.0, 10.0]])
    few = ph.LiePoisson(diffrax.Dopri8(), max_steps=16, chunk=1)
    found = ph.simulate(scene, states, [0.0, 5.0], few, throw=False)
    text, most = str(found), int(found.steps.max())
    assert "2 bodies x 2 samples" in text
    assert "1 SUCCESSFUL, 1 MAX_STEPS" in text
    assert f", at most {most}" in text
    assert most + int(found.step_counts.refused.max()) == 16  # attempts are limited
    shown = jax.jit(lambda s: [str(ph.simulate(scene, s, [0.0, 5.0])), 0][1])(states)
    assert shown == 0


TURNED_BODY = ph.Inertia.from_moments([2.0, 2.0, 2.0])


def test_steps_that_end_at_switches_and_events_are_counted():
    """The counts are printed if they are not zero.

    The number of sign changes is known: a torque of constant size about one axis, opposite to the
    angle so far, makes the body oscillate.
    """

    def against(t, wxyz, omega):
        return jnp.array([0.0, 0.0, jnp.where(wxyz[0] * wxyz[3] > 0, -1.0, 1.0)])

    swing = ph.Scene(TURNED_BODY, torque=ph.FeedbackTorque(against))
    # the angle 0.16 + t / 2 - t^2 / 4 is zero at t = 2.28, then every 2.561 s, at last at 17.65
    start = ph.State([np.cos(0.08), 0, 0, np.sin(0.08)], [0, 0, 0.5])
    found = ph.simulate(swing, start, [0.0, 18.5])
    counts = found.step_counts
    assert int(counts.at_switches) == 7
    assert int(counts.accepted) == int(found.steps) > 7
    assert int(counts.at_times) == 0
    assert "ended at a switch or event: 7" in str(found)
    event = ph.Event(lambda wxyz, omega, t: omega[2])  # at t = 1, 3.56, 6.12, ... 16.37
    both = ph.simulate(swing, start, [0.0, 18.5], events=[event])
    assert int(both.step_counts.at_switches) == 7 + 7


def test_steps_limited_by_stability_are_counted():
    def counts_of(damping):
        scene = ph.Scene(TURNED_BODY, torque=ph.LinearDamping(damping))
        start = ph.State([1.0, 0, 0, 0], [0.3, 0.4, 0.5])
        return ph.simulate(scene, start, [0.0, 20.0], rtol=1e-6)

    slow, fast = counts_of(0.01), counts_of(1e3)
    assert int(slow.step_counts.at_stability) == 0
    assert "stability" not in str(slow)
    assert int(fast.step_counts.at_stability) > 0.9 * int(fast.steps)
    assert f"limited by stability: {int(fast.step_counts.at_stability):,}" in str(fast)


@pytest.mark.slow  # faster: the other counts, above
def test_steps_that_end_at_saved_times_or_are_refused_are_counted():
    gravity = ph.UniformGravity(1.0, [0.1, 0.2, 0.3], [0.0, 0.0, -9.81])
    top = ph.Scene(ph.Inertia.from_moments([1.0, 1.5, 2.0]), gravity)
    states = ph.State([1.0, 0, 0, 0], np.linspace(0.1, 2.0, 40)[:, None] * np.ones(3))
    often = ph.simulate(top, states, np.linspace(0.0, 2.0, 401))
    np.testing.assert_array_equal(often.step_counts.at_times, 400)
    seldom = ph.simulate(top, states, [0.0, 20.0])
    assert np.all(seldom.step_counts.at_times <= 3)  # the last step, and halved steps before it
    assert "ended at a saved time: 400" in str(often)
    assert often[3].step_counts.at_times == 400
    ends = often.at([1.001, 1.0])
    assert ends.step_counts.accepted.shape == (40,)

    def spun(t):
        return jnp.array([0.0, 0.0, 5.0 / (1e-4 + (t - 3.0) ** 2)])

    pushed = ph.Scene(TURNED_BODY, torque=ph.BodyTorque(spun))
    sudden = ph.simulate(pushed, ph.State([1.0, 0, 0, 0], [0.1, 0.1, 0.1]), [0.0, 6.0])
    assert int(sudden.step_counts.refused) > 0
    assert "refused" in str(sudden)
