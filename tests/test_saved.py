"""Functions of the motion saved in place of the states, against textbook formulas and NumPy."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode import _policy

TS = jnp.linspace(0.0, 3.0, 7)
SYMMETRIC = ph.Inertia.axisymmetric(1.0, 2.0)
PUSH = ph.BodyTorque([0.0, 0.0, 0.4])
UNIT = jnp.array([1.0, 0.0, 0.0, 0.0])


def row(trajectory):
    """The transverse rates, and the number of the sample as an integer."""
    count = jnp.arange(trajectory.ts.shape[0])
    return {"rates": trajectory.omega_body[:, :2], "count": count}


SAVE = ph.Record(save=row)


def is_fast(trajectory):
    """1 or 2, also where the rate is NaN."""
    return jnp.where(trajectory.omega_body[:, 2] > 0, 1.0, 2.0)


def transverse(omega, ts):
    """Transverse rates of a free symmetric body with moments 1, 1, 2."""
    turned = np.exp(1j * omega[..., 2, None] * np.asarray(ts)) * (
        omega[..., :1] + 1j * omega[..., 1:2]
    )
    return np.stack([turned.real, turned.imag], axis=-1)


def test_transverse_rates_of_free_symmetric_bodies():
    omega = np.array([[0.3, 0.1, 2.0], [0.0, -0.4, 1.0]])
    traj = ph.simulate(ph.Scene(SYMMETRIC), ph.State(UNIT, omega), TS, record=SAVE)
    np.testing.assert_allclose(traj.saved["rates"], transverse(omega, TS), atol=1e-12)
    np.testing.assert_array_equal(traj.saved["count"], [range(7)] * 2)


@pytest.mark.parametrize("bound", [2**18, 4])
def test_integrated_bodies_in_chunks_at_times_of_their_own(monkeypatch, bound):
    # about z alone: the rate grows linearly, the angle quadratically
    monkeypatch.setattr(_policy, "SAVE_SAMPLES", bound)
    monkeypatch.setattr(_policy, "LANES", 2)
    start = jnp.linspace(0.0, 2.0, 5)
    omega = jnp.stack([0 * start, 0 * start, start], axis=-1)
    ts = np.asarray(TS) * np.linspace(0.5, 1.0, 5)[:, None]
    start = np.asarray(start)
    body = ph.Scene(ph.Inertia.from_moments([1.0, 1.5, 2.0]), torque=PUSH)

    def save(trajectory):  # a new function, hence a new program for each bound
        half = jnp.arctan2(trajectory.wxyz[:, 3], trajectory.wxyz[:, 0])
        return jnp.stack([jnp.cos(2 * half), jnp.sin(2 * half)], axis=-1), trajectory.energy

    traj = ph.simulate(body, ph.State(UNIT, omega), ts, record=ph.Record(save=save))
    direction, energy = traj.saved
    angle = start[:, None] * ts + 0.1 * ts**2
    rate = start[:, None] + 0.2 * ts
    expected = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    np.testing.assert_allclose(direction, expected, atol=1e-8)
    np.testing.assert_allclose(energy, rate**2, rtol=1e-9)
    np.testing.assert_allclose(traj.last.omega_body[:, 2], rate[:, -1], rtol=1e-9)
    np.testing.assert_allclose(traj[1].last.omega_body[2], rate[1, -1], rtol=1e-9)
    np.testing.assert_allclose(traj[1, 2:4].saved[1], rate[1, 2:4] ** 2, rtol=1e-9)


def test_jit_vmap_and_derivatives_by_state_and_module():
    omega = jnp.array([[0.3, 0.1, 2.0], [0.2, -0.4, 1.0]])
    scene = ph.Scene(SYMMETRIC)

    class Scaled(eqx.Module):
        factor: jax.Array

        def __call__(self, trajectory):
            return self.factor * trajectory.omega_body[:, 0]

    def last(omega, factor):
        record = ph.Record(save=Scaled(factor))
        return ph.simulate(scene, ph.State(UNIT, omega), TS, record=record).saved[..., -1]

    # x(t) = a cos(ct) - b sin(ct) with c = (C - A) / A omega_z
    a, b, c = omega.T
    t = TS[-1]
    here = a * jnp.cos(c * t) - b * jnp.sin(c * t)
    np.testing.assert_allclose(jax.jit(last)(omega, 3.0), 3 * here, rtol=1e-9)
    np.testing.assert_allclose(jax.vmap(last, (0, None))(omega, 3.0), 3 * here, rtol=1e-9)
    slopes, by_factor = jax.vmap(jax.grad(last, (0, 1)), (0, None))(omega, jnp.array(3.0))
    by_c = -t * (a * jnp.sin(c * t) + b * jnp.cos(c * t))
    expected = 3 * jnp.stack([jnp.cos(c * t), -jnp.sin(c * t), by_c], axis=-1)
    np.testing.assert_allclose(slopes, expected, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(by_factor, here, rtol=1e-9)


def test_functions_may_close_over_traced_numbers():
    def loss(factor):
        record = ph.Record(save=lambda x: factor * x.omega_body[:, 2])
        return ph.simulate(
            ph.Scene(SYMMETRIC), ph.State(UNIT, [0.1, 0, 2.0]), TS, record=record
        ).saved[0]

    np.testing.assert_allclose(jax.grad(loss)(3.0), 2.0, rtol=1e-12)
    np.testing.assert_allclose(jax.jit(jax.grad(loss))(3.0), 2.0, rtol=1e-12)


@pytest.mark.slow
def test_events_repeat_the_values_of_the_event():
    scene = ph.Scene(ph.Inertia.from_moments([1.0, 1.5, 2.0]), torque=PUSH)
    event = ph.Event(lambda wxyz, omega_body, t: omega_body[2] - 1.2)
    record = ph.Record(save=lambda x: x.omega_body[:, 2])
    state = ph.State(UNIT, [0.0, 0.0, 1.0])
    expected = np.minimum(1 + 0.2 * np.asarray(TS), 1.2)
    traj = ph.simulate(scene, state, TS, until=event, record=record)
    np.testing.assert_allclose(traj.saved, expected, rtol=1e-8)
    np.testing.assert_allclose(traj.event_time, 1.0, rtol=1e-8)
    np.testing.assert_allclose(traj.last.omega_body, [0, 0, 1.2], rtol=1e-8)
    traj = ph.simulate(scene, state, TS, events=event, record=record)
    np.testing.assert_allclose(traj.saved, 1 + 0.2 * np.asarray(TS), rtol=1e-8)
    np.testing.assert_allclose(traj.events.times[0], 1.0, rtol=1e-8)


def test_rows_after_a_failure_are_nan():
    blow_up = ph.BodyTorque(lambda t: jnp.where(t < 1.2, 0.4, jnp.nan) * jnp.array([0.0, 0.0, 1.0]))
    scene = ph.Scene(ph.Inertia.from_moments([1.0, 1.5, 2.0]), torque=blow_up)
    state, record = ph.State(UNIT, [0.0, 0.0, 1.0]), ph.Record(save=is_fast)
    traj = ph.simulate(scene, state, TS, record=record, throw=False)
    assert not traj.successful
    np.testing.assert_array_equal(traj.saved, np.where(np.asarray(TS) < 1.2, 1.0, np.nan))


@pytest.mark.parametrize("name", ["wxyz", "omega_body", "energy", "first", "momentum_space"])
def test_states_are_not_recorded(name):
    traj = ph.simulate(ph.Scene(SYMMETRIC), ph.State(UNIT, [0.1, 0, 2.0]), TS, record=SAVE)
    with pytest.raises(ValueError, match="not recorded"):
        getattr(traj, name)
    with pytest.raises(ValueError, match="not recorded"):
        traj.at(0.5)
    with pytest.raises(ValueError, match="Record\\(save=fn\\)"):
        _ = ph.simulate(ph.Scene(SYMMETRIC), ph.State(UNIT, [0.1, 0, 2.0]), TS).saved


@pytest.mark.parametrize(
    ("save", "error", "message"),
    [
        (lambda x: None, TypeError, "returned nothing"),
        (lambda x: {}, TypeError, "returned nothing"),
        (lambda x: {"name": "body"}, TypeError, r"\['name'\] str"),
        (lambda x: x.omega_body[-1], ValueError, r"shape \(3,\).*7 samples"),
        (lambda x: {"all": x.omega_body.mean()}, ValueError, r"\['all'\] shape \(\)"),
        (lambda x: jnp.ones((2, 7)), ValueError, "does not see other bodies"),
        (lambda x: np.sin(x.omega_body), TypeError, "jnp.sin"),
        (lambda x: 1.0 if x.omega_body[0, 0] > 0 else 0.0, TypeError, "jnp.where"),
        (lambda x: x.nutation, AttributeError, "nutation"),
    ],
)
def test_wrong_values_are_refused(save, error, message):
    omega = jnp.array([[0.1, 0, 2.0], [0.2, 0, 1.0]])
    with pytest.raises(error, match=message):
        ph.simulate(ph.Scene(SYMMETRIC), ph.State(UNIT, omega), TS, record=ph.Record(save=save))


def test_wrong_functions_are_refused():
    with pytest.raises(TypeError, match=r"fn\(trajectory\)"):
        ph.Record(save=lambda t, y, args: y)
    with pytest.raises(TypeError, match="takes a function"):
        ph.Record(save="omega_body")


@pytest.mark.slow
def test_work_wheels_and_the_last_time():
    wheel = ph.Rotor(axis_body=[0.0, 1.0, 0.0], inertia=0.05, speed=4.0, torque=0.0)
    scene = ph.Scene(ph.Inertia.from_moments([1.0, 1.5, 2.0]), torque=PUSH, rotors=wheel)
    state = ph.State(UNIT, [0.1, 0.2, 1.0])

    def save(trajectory):
        return trajectory.work, trajectory.wheel_speed

    full = ph.simulate(scene, state, TS, record=ph.Record(work=True))
    traj = ph.simulate(scene, state, TS, record=ph.Record(work=True, save=save))
    np.testing.assert_allclose(traj.saved[0], full.work, atol=1e-12)
    np.testing.assert_allclose(traj.saved[1], full.wheel_speed, rtol=1e-12)
    np.testing.assert_allclose(traj.last.wheel_speed, full.last.wheel_speed, rtol=1e-12)
    last = ph.simulate(scene, state, TS, record=ph.Record(work=True, final_only=True, save=save))
    np.testing.assert_allclose(last.saved[0], full.work[-1:], atol=1e-9)


def test_mean_over_bodies_that_finished():
    omega = jnp.array([[0.1, 0, 2.0], [0.1, jnp.nan, 2.0]])
    record = ph.Record(save=lambda x: x.omega_body[:, 2])
    traj = jax.jit(
        lambda w: ph.simulate(ph.Scene(SYMMETRIC), ph.State(UNIT, w), TS, record=record)
    )(omega)
    mean = ph.successful_mean(traj, lambda x: x.saved[:, -1])
    np.testing.assert_allclose(mean, 2.0, rtol=1e-12)


def test_work_is_known_where_rates_are_not_kept():
    inertia, state = ph.Inertia.axisymmetric(1.0, 2.0), ph.State([1.0, 0, 0, 0], [0.1, 1.0, 0.2])
    scene = ph.Scene(inertia, torque=ph.LinearDamping([0.1, 0.1, 0.2]))
    kept, left = (
        ph.simulate(scene, state, [0.0, 1.0, 2.0], record=ph.Record(rates=rates, work=True))
        for rates in (True, False)
    )
    assert left._omega_body is None
    np.testing.assert_array_equal(left.work, kept.work)
