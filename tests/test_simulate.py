"""simulate: batches, times, records, status per body, derivatives, labelled output."""

import functools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems.table import BY_NAME, truth

import polhode as ph
from polhode import rotation

MOMENTS = jnp.array([1.0, 1.5, 2.0])
STATE = ph.State([0.5, 0.5, 0.5, -0.5], [0.5, -1.0, 0.75])
METHOD = ph.LiePoisson()
TS = jnp.linspace(0, 2, 5)


def free(moments=MOMENTS):
    return ph.Scene(ph.Inertia.from_moments(moments))


@pytest.mark.slow  # faster: chunks and vmap, below
def test_batch_equals_single_bodies_in_any_shape():
    """Leaves (3, 1, 3) of inertia, (2, 4) of attitude and (3,) of gravity: 3 x 2 bodies."""
    moments = jnp.array([[[1.0, 1.5, 2.0]], [[2.0, 1.5, 1.0]], [[0.5, 0.5, 0.75]]])
    wxyz = rotation.normalise(jnp.array([[1.0, 0, 0, 0.25], [0.5, -0.5, 0.5, 0.5]]))
    omega = jnp.array([0.5, -1.0, 0.75])
    weight = ph.UniformGravity(1.0, jnp.array([[0.1, 0, 0.2], [0.0, 0.3, 0.1]]), [0.0, 0, -1.0])
    scene = ph.Scene(ph.Inertia.from_moments(moments), weight, ph.LinearDamping(0.1))
    batch = ph.simulate(scene, ph.State(wxyz, omega), TS, METHOD, rtol=1e-12)
    assert batch.wxyz.shape == (3, 2, 5, 4)
    assert batch.omega_body.shape == (3, 2, 5, 3)
    assert batch.status.shape == batch.steps.shape == (3, 2)
    assert batch.energy.shape == (3, 2, 5)
    for i, j in ((0, 1), (2, 0)):
        alone = ph.UniformGravity(1.0, weight.centre_body[j], [0.0, 0, -1.0])
        scene = ph.Scene(ph.Inertia.from_moments(moments[i, 0]), alone, ph.LinearDamping(0.1))
        single = ph.simulate(scene, ph.State(wxyz[j], omega), TS, METHOD, rtol=1e-12)
        np.testing.assert_allclose(batch.wxyz[i, j], single.wxyz, atol=1e-10)
        np.testing.assert_allclose(batch.energy[i, j], single.energy, atol=1e-10)
        np.testing.assert_allclose(batch.momentum_space[i, j], single.momentum_space, atol=1e-10)


def test_chunks_with_a_remainder_and_vmap_agree():
    rng = np.random.default_rng(0)
    wxyz, omega = jnp.asarray(rng.normal(size=(7, 4))), jnp.asarray(rng.normal(size=(7, 3)))
    state = ph.State(wxyz, omega)
    chunked = ph.simulate(free(), state, TS, ph.LiePoisson(chunk=3), rtol=1e-11)
    mapped = jax.vmap(lambda s: ph.simulate(free(), s, TS, METHOD, rtol=1e-11).wxyz)(state)
    assert len(set(np.asarray(chunked.steps).tolist())) > 1  # chunks choose their own steps
    np.testing.assert_allclose(chunked.wxyz, mapped, atol=1e-8)


@pytest.mark.slow  # faster: two chunks and a remainder, above
def test_one_chunk_and_several_agree():
    rng = np.random.default_rng(0)
    state = ph.State(rng.normal(size=(7, 4)), rng.normal(size=(7, 3)))
    chunked, whole = (
        ph.simulate(free(), state, TS, ph.LiePoisson(chunk=n), rtol=1e-11).wxyz for n in (3, 7)
    )
    np.testing.assert_allclose(chunked, whole, atol=1e-8)


@pytest.mark.slow  # faster: values under vmap, test_chunks_with_a_remainder_and_vmap_agree
def test_one_attitude_for_many_rates_under_vmap():
    """Unmapped arrays are batched in the same way for values and derivatives; small batches within
    small batches are integrated by one fused program, in which no scatter may occur.
    """
    omega = np.random.default_rng(5).normal(size=(2, 3, 3))
    inertia = ph.Inertia.from_moments([1.0, 1.5, 2.0])

    def length(scene, omega):
        traj = ph.simulate(scene, ph.State([1.0, 0, 0, 0], omega), [0.0, 0.5, 2.0], rtol=1e-8)
        return jnp.sum(jnp.sin(traj.omega_body)) + traj.wxyz[-1, 0]

    def total(omega):
        return jnp.sum(jax.vmap(functools.partial(length, ph.Scene(inertia)))(omega))

    each = jax.vmap(jax.grad(functools.partial(length, ph.Scene(inertia))))(omega[0])
    gradients = jax.vmap(jax.grad(total))(omega)
    np.testing.assert_allclose(gradients[0], each, atol=1e-12)
    np.testing.assert_allclose(jax.grad(total)(omega[0]), each, atol=1e-12)

    damped = ph.Scene(inertia, torque=ph.LinearDamping([0.1, 0.2, 0.3]))
    nested = jax.vmap(jax.vmap(functools.partial(length, damped)))(omega)
    batch = jax.vmap(functools.partial(length, damped))(omega[1])
    np.testing.assert_allclose(nested[1], batch, atol=1e-8)


@pytest.mark.slow
def test_times_per_body_and_backwards():
    ts = jnp.stack([TS, TS[::-1], -2 * TS])
    state = ph.State(jnp.tile(STATE.wxyz, (3, 1)), STATE.omega_body)
    traj = ph.simulate(free(), state, ts, METHOD, rtol=1e-12)
    there = ph.simulate(free(), STATE, TS, METHOD, rtol=1e-12)
    np.testing.assert_allclose(traj.wxyz[0], there.wxyz, atol=1e-11)
    back = ph.State(there.wxyz[-1], there.omega_body[-1])
    again = ph.simulate(free(), back, TS[::-1], METHOD, rtol=1e-12)
    np.testing.assert_allclose(again.wxyz[-1], STATE.wxyz, atol=1e-10)
    momentum = jnp.broadcast_to(there.momentum_space[:1], (5, 3))
    np.testing.assert_allclose(traj.momentum_space[2], momentum, atol=1e-10)
    assert traj.to_xarray()["ts"].dims == ("body", "time")


def test_samples_are_as_accurate_as_steps():
    """The energy at 50 samples is as accurate as at the ends of the steps."""
    ts = jnp.linspace(0, 20, 50)
    traj = ph.simulate(free(), STATE, ts, METHOD, rtol=1e-12)
    np.testing.assert_allclose(traj.energy, traj.energy[0], rtol=1e-11)


def test_record_keeps_what_is_asked():
    rates = ph.simulate(free(), STATE, TS, record=ph.Record(attitude=False))
    assert rates._wxyz is None
    assert rates.energy.shape == (5,)
    with pytest.raises(ValueError, match="no wxyz"):
        rates.euler()
    last = ph.simulate(free(), STATE, TS, record=ph.Record(final_only=True))
    assert last.wxyz.shape == (1, 4)
    assert last.ts.tolist() == [2.0]
    with pytest.raises(ValueError, match="would save nothing"):
        ph.Record(attitude=False, rates=False)


def test_step_limit_is_reported_per_body():
    wxyz = jnp.tile(STATE.wxyz, (2, 1))
    omega = jnp.array([[0.1, 0.1, 0.1], [300.0, -200.0, 100.0]])
    method = ph.LiePoisson(chunk=1, max_steps=64)
    with pytest.raises(
        ph.SimulationError, match=r"1 of 2 bodies \(first: index \(1,\)\).*max_steps"
    ):
        ph.simulate(free(), ph.State(wxyz, omega), TS, method)
    traj = ph.simulate(free(), ph.State(wxyz, omega), TS, method, throw=False)
    assert traj.status.tolist() == [ph.Status.SUCCESSFUL, ph.Status.MAX_STEPS]
    assert traj.successful.tolist() == [True, False]
    assert bool(jnp.isnan(traj.last.wxyz[1]).all())
    assert bool(jnp.isfinite(traj.last.wxyz[0]).all())


def test_nan_is_reported_per_body():
    state = ph.State(jnp.tile(STATE.wxyz, (2, 1)), STATE.omega_body)
    poisoned = ph.BodyTorque(lambda t: jnp.full(3, jnp.nan))
    scene = ph.Scene(ph.Inertia.from_moments(MOMENTS), torque=poisoned)
    fixed = ph.LiePoisson(controller=diffrax.ConstantStepSize(), dt0=0.5)
    traj = ph.simulate(scene, state, TS, fixed, throw=False)
    assert (traj.status == ph.Status.NOT_FINITE).all()
    with pytest.raises(ph.SimulationError, match="NaN or infinity"):
        ph.simulate(scene, state, TS, fixed)


def test_the_poles_of_the_chart_are_reported_per_body():
    wxyz = jnp.stack([STATE.wxyz, jnp.array([1.0, 0, 0, 0]), jnp.array([0.0, 1.0, 0, 0])])
    state = ph.State(wxyz, STATE.omega_body)
    traj = ph.simulate(free(), state, TS, ph.EulerAngles(max_steps=256), throw=False)
    singular = ph.Status.CHART_SINGULAR
    assert traj.status.tolist() == [ph.Status.SUCCESSFUL, singular, singular]
    assert bool(jnp.all(jnp.isnan(traj.wxyz[1:])))
    assert bool(jnp.all(jnp.isfinite(traj.wxyz[0])))
    with pytest.raises(ph.SimulationError, match=r"use ph\.LiePoisson"):
        ph.simulate(free(), state, TS, ph.EulerAngles(max_steps=256))


@pytest.mark.parametrize(
    "solver",
    [
        pytest.param(diffrax.Tsit5(), marks=pytest.mark.slow),
        pytest.param(diffrax.Kvaerno5(), marks=pytest.mark.slow),
        diffrax.Heun(),
    ],
)
def test_any_diffrax_solver_and_controller(solver):
    """Adaptive, implicit and constant steps, passed through unchanged; constant ones also backward
    in time.
    """
    constant = isinstance(solver, diffrax.Heun)
    ts = TS[::-1] if constant else TS
    controller = diffrax.ConstantStepSize() if constant else None
    method = ph.LiePoisson(solver, controller, dt0=1e-3 if constant else None)
    traj = ph.simulate(free(), STATE, ts, method, rtol=1e-8)
    want = ph.simulate(free(), STATE, ts)
    assert float(jnp.max(rotation.angle_between(traj.wxyz, want.wxyz))) < 1e-5


@pytest.mark.slow  # faster: one body, above
def test_a_batch_by_a_solver_and_a_controller_of_diffrax():
    """16 heavy tops with steps of the user's controller: as accurate as its tolerance."""
    rng = np.random.default_rng(3)
    state = ph.State(jnp.asarray(rng.normal(size=(16, 4))), jnp.asarray(rng.normal(size=(16, 3))))
    gravity = ph.UniformGravity(1.0, [0.125, 0.0, 0.5], [0.0, 0.0, -9.81])
    scene = ph.Scene(ph.Inertia.from_moments(MOMENTS), gravity)
    want = ph.simulate(scene, state, TS)
    errors, steps = [], []
    for tolerance in jnp.array([1e-4, 1e-9]):
        controller = diffrax.PIDController(rtol=tolerance, atol=tolerance)
        found = ph.simulate(scene, state, TS, ph.LiePoisson(diffrax.Tsit5(), controller))
        assert found.successful.all()
        assert found.wxyz.shape == (16, 5, 4)
        errors.append(float(jnp.max(rotation.angle_between(found.wxyz, want.wxyz))))
        steps.append(int(found.steps.max()))
    assert 1e-5 < errors[0] < 1e-2
    assert errors[1] < 1e-7
    assert steps[0] < steps[1] / 3


@pytest.mark.slow  # faster: derivatives with respect to states, tests/systems
def test_forward_mode_and_times():
    """d/dt of the samples is the field; jvp by diffrax.ForwardMode, grad by the default."""
    forward = ph.LiePoisson(adjoint=diffrax.ForwardMode())

    def last_rates(end, method):
        return ph.simulate(
            free(), STATE, jnp.stack([0.0 * end, end]), method, rtol=1e-12
        ).omega_body[-1]

    end = jnp.array(2.0)
    rate = jax.jvp(lambda t: last_rates(t, forward), (end,), (jnp.ones_like(end),))[1]
    omega, pull = jax.vjp(lambda t: last_rates(t, METHOD), end)
    (back,) = jax.vmap(pull)(jnp.eye(3))
    want = jnp.cross(MOMENTS * omega, omega) / MOMENTS
    np.testing.assert_allclose(rate, want, atol=1e-9)
    np.testing.assert_allclose(back, want, atol=1e-9)


@pytest.mark.slow  # faster: derivatives with respect to moments, tests/systems
def test_gradient_with_respect_to_the_initial_state():
    """Reversed time: d(end)/d(start) times d(start)/d(end) is the identity."""
    name = "free_short_axis_mode"
    system, exact = BY_NAME[name], truth(name)
    scene = free(jnp.array(system.moments))
    span = jnp.array(system.span, dtype=float)

    def flow(omega, wxyz, ts):
        end = ph.simulate(scene, ph.State(wxyz, omega), ts, METHOD, rtol=1e-13)
        return end.omega_body[-1]

    start = jnp.array(system.omega)
    there = jax.jacrev(flow)(start, jnp.array(system.wxyz, dtype=float), span)
    end, wxyz = jnp.array(exact["state"][:3]), jnp.array(exact["state"][3:])
    back = jax.jacrev(flow)(end, wxyz, span[::-1])
    np.testing.assert_allclose(back @ there, np.eye(3), atol=1e-8)


@pytest.mark.slow
def test_progress_meter_does_not_break_the_gradient(capfd):
    method = ph.LiePoisson(progress_meter=diffrax.TextProgressMeter())
    slope = jax.grad(lambda m: ph.simulate(free(m), STATE, TS, method).energy[-1])(MOMENTS)
    assert bool(jnp.all(jnp.isfinite(slope)))
    assert "100.00%" in capfd.readouterr().out


def test_to_xarray_names_dimensions_and_units():
    state = ph.State(jnp.tile(STATE.wxyz, (2, 1)), STATE.omega_body)
    data = ph.simulate(free(), state, TS).to_xarray()
    assert data["wxyz"].dims == ("body", "time", "quaternion")
    assert data["omega_body"].attrs["units"] == "rad s-1"
    assert data["energy"].dims == ("body", "time")
    assert list(data["quaternion"].values) == ["w", "x", "y", "z"]
    assert "body -> space" in data.attrs["convention"]
    alone = ph.simulate(free(), STATE, TS, record=ph.Record(rates=False)).to_xarray()
    assert set(alone.data_vars) == {"wxyz", "status"}


_MOMENTS = ph.Inertia.from_moments([1.0, 1.5, 2.0])


@pytest.mark.parametrize(
    "scene",
    [
        ph.Scene(_MOMENTS),
        ph.Scene(_MOMENTS, ph.UniformGravity(1.0, [0.1, 0.2, 0.3], [0.0, 0.0, -1.0])),
        ph.Scene(ph.Inertia.axisymmetric(1.0, 0.5), ph.UniformGravity.axial(9.81, 0.1)),
        ph.Scene(_MOMENTS, torque=ph.FeedbackTorque(lambda t, wxyz, omega_body: -omega_body)),
    ],
)
def test_no_bodies_give_an_empty_trajectory(scene):
    state = ph.State(np.zeros((2, 0, 4)), np.zeros((2, 0, 3)))
    record = ph.Record(work=True)
    got = ph.simulate(scene, state, [0.0, 1.0, 2.0], record=record)
    assert got.wxyz.shape == (2, 0, 3, 4)
    assert got.work.shape == (2, 0, 3)
    assert got.status.shape == (2, 0)


# Bodies that fail, in a batch with others

FAST = ph.LiePoisson(max_steps=40, chunk=1)


class Brake(eqx.Module):
    """A torque against the rates, whose domain a fast body leaves at once."""

    gains: jax.Array

    def __call__(self, t, wxyz, omega):
        return -self.gains * omega * jnp.sqrt(4.0 - jnp.sum(omega**2))


GAINS = jnp.array([0.1, 0.2, 0.3])


def braked(gains, sizes, **options):
    sizes = jnp.asarray(sizes)
    omega = jnp.stack([0.3 * sizes, 0.2 * sizes, sizes], axis=-1)
    wxyz = jnp.broadcast_to(jnp.array([1.0, 0.0, 0.0, 0.0]), (*sizes.shape, 4))
    scene = ph.Scene(ph.Inertia.from_moments(MOMENTS), torque=ph.FeedbackTorque(Brake(gains)))
    return ph.simulate(scene, ph.State(wxyz, omega), [0.0, 1.0], rtol=1e-7, **options)


def energy_of(weight):
    return lambda t: weight * jnp.linalg.norm(t.last.omega_body, axis=-1)


@pytest.mark.slow
def test_the_mean_over_the_bodies_that_finished_is_theirs_alone():
    """With derivatives with respect to shared parameters of the torque and of the cost."""

    def loss(gains, weight, sizes, **options):
        return ph.successful_mean(braked(gains, sizes, **options), energy_of(weight))

    slope = jax.jit(jax.value_and_grad(loss, (0, 1)))
    mixed, alone = (slope(GAINS, 2.0, jnp.array(x)) for x in ([0.5, 9.0], [0.5, 0.5]))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), mixed, alone)
    assert np.all(mixed[1][0] < 0)
    mapped = jax.vmap(lambda size: braked(GAINS, size))(jnp.array([0.5, 9.0]))
    np.testing.assert_allclose(ph.successful_mean(mapped, energy_of(2.0)), alone[0], rtol=1e-6)
    np.testing.assert_allclose(ph.successful_mean(mapped[0], energy_of(2.0)), alone[0], rtol=1e-6)
    value, (gains, weight) = slope(GAINS, 2.0, jnp.array([9.0, 9.0]))
    assert np.isnan(value)
    assert np.isnan(gains).all()
    assert np.isnan(weight)
    with pytest.raises(ValueError, match="one row for each body"):
        ph.successful_mean(mapped, lambda t: jnp.ones(3))


@pytest.mark.parametrize(
    "method",
    [
        pytest.param(None, id="default"),
        # status and NaN of a body out of steps: test_step_limit_is_reported_per_body, test_stepping
        pytest.param(FAST, id="diffrax", marks=pytest.mark.slow),
    ],
)
def test_states_are_nan_where_a_body_failed(method):
    traj = braked(GAINS, [0.5, 9.0], method=method, throw=False)
    assert traj.successful.tolist() == [True, False]
    assert np.isfinite(traj.omega_body[0]).all()
    assert np.isnan(traj.omega_body[1, -1]).all()
    assert np.isnan(traj.wxyz[1, -1]).all()


def braked_sum(size, throw):
    return jnp.sum(braked(GAINS, size, throw=throw).omega_body)


def mapped_sum(size, throw):
    return jax.vmap(lambda x: braked_sum(x, throw))(size)


slow = pytest.mark.slow


@pytest.mark.parametrize(
    "function",
    [
        jax.grad(braked_sum),
        pytest.param(braked_sum, marks=slow),
        pytest.param(mapped_sum, marks=slow),
    ],
    ids=["grad", "value", "vmap"],
)
def test_throw_raises_in_a_compiled_program_where_it_is_written(function):
    run = jax.jit(function, static_argnums=1)
    assert np.isfinite(run(jnp.array([0.5]), True)).all()
    # of jax.jit a ValueError or JaxRuntimeError, of equinox.filter_jit its own RuntimeError
    with pytest.raises((RuntimeError, ValueError), match="a body did not finish: "):
        jax.block_until_ready(run(jnp.array([9.0]), True))


def test_nothing_is_raised_in_a_compiled_program_by_default():
    traj = jax.jit(lambda sizes: braked(GAINS, sizes))(jnp.array([0.5, 9.0]))
    assert traj.successful.tolist() == [True, False]
    assert np.isnan(traj.omega_body[:, -1]).all(axis=-1).tolist() == [False, True]
    with pytest.raises(ph.SimulationError):
        braked(GAINS, [9.0])
