"""Integrated motions: samples, failures, tolerances below rounding, gradients."""

import traceback
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode import Extrapolation, rotation
from polhode._plan import choose

INERTIA = ph.Inertia.from_moments([1.0, 1.5, 2.0])
GRAVITY = ph.UniformGravity(1.0, [0.1, 0.2, 0.5], [0.0, 0, -1.0])
SCENE = ph.Scene(INERTIA, GRAVITY, ph.LinearDamping(0.05))
STATE = ph.State(
    [[1.0, 0, 0, 0], [0.6, 0, 0.8, 0], [0.0, 0.6, 0.8, 0]],
    [[0.1, 0.2, 3.0], [1.0, -0.5, 0.3], [0.0, 0, 0]],
)


def test_every_torqued_scene_is_extrapolated():
    for scene in (SCENE, ph.Scene(INERTIA, None, ph.BodyTorque([0.1, 0, 0]))):
        method, _ = choose(scene)
        assert isinstance(method.solver, Extrapolation)
        assert not method.chart.upright
    method, _ = choose(ph.Scene(INERTIA, GRAVITY))
    assert isinstance(method.solver, Extrapolation)
    assert method.chart.upright


def test_the_field_of_a_heavy_top_stands_twelve_calls_below_simulate_at_most(monkeypatch):
    """Functions of this package from ``ph.simulate`` to the field: docs/architecture.md, ten."""
    source, found, energy = str(Path(ph.__file__).parent), [], ph.UniformGravity.height

    def watched(self, *given):
        stack = [f.name for f in traceback.extract_stack() if f.filename.startswith(source)]
        if "lie_poisson_field" in stack and "_solve" in stack:
            found.append(stack[stack.index("simulate") :])
        return energy(self, *given)

    monkeypatch.setattr(ph.UniformGravity, "height", watched)
    scene = ph.Scene(ph.Inertia.from_moments([1.0, 1.25, 2.125]), GRAVITY)
    jax.make_jaxpr(lambda w: ph.simulate(scene, ph.State([1.0, 0, 0, 0], w), [0.0, 1.0]).wxyz)(
        jnp.ones((13, 3))  # a shape that no other test traces
    )
    depths = [1 + stack.index("lie_poisson_field") for stack in found]
    assert 3 < min(depths) <= 12, min(found, key=len)


@pytest.mark.parametrize("sign", [pytest.param(1, marks=pytest.mark.slow), -1])
def test_samples_at_uneven_times_are_as_exact_as_asked(sign):
    """Many times within a step, and many steps between two times; also backward."""
    ts = sign * np.concatenate([[0.0, 1e-6, 0.5, 0.5001], np.linspace(0.6, 4, 30), [20.0]])
    got = ph.simulate(SCENE, STATE, ts)
    method = ph.LiePoisson(diffrax.Dopri8())
    want = ph.simulate(SCENE, STATE, ts, method, rtol=1e-13)
    apart = rotation.angle_between(got.wxyz, want.wxyz)
    assert np.max(apart) < 3e-9
    assert np.max(apart) > 1e-13  # two different solvers
    np.testing.assert_allclose(got.omega_body, want.omega_body, atol=1e-8)
    assert np.all(got.steps < want.steps)


def test_a_tolerance_below_rounding_is_held_as_far_as_rounding_allows():
    """Five thousand radians in float32: 1e-5 at the end would require steps accurate to 2e-9."""
    inertia = ph.Inertia.from_moments(np.array([1, 1.5, 2], np.float32))
    gravity = ph.UniformGravity(*(np.array(x, np.float32) for x in (1, [0, 0, 0.5], [0, 0, -1])))
    scene = ph.Scene(inertia, gravity, ph.LinearDamping(np.float32(1e-6)))
    state = ph.State(np.array([1, 0, 0, 0], np.float32), np.array([0.1, 0, 5], np.float32))
    got = ph.simulate(scene, state, np.array([0, 1000], np.float32))
    assert got.wxyz.dtype == jnp.float32
    assert int(got.status) == ph.Status.SUCCESSFUL
    assert "about 2e-03 rad at the last time" in str(ph.explain(scene, state, [0, 1000]))
    double = jax.tree.map(lambda x: x.astype(float), (scene, state))
    best = ph.simulate(*double, np.array([0.0, 1000.0]))
    gap = rotation.angle_between(got.wxyz[-1].astype(float), best.wxyz[-1])
    assert 1e-5 < float(gap) < 1e-2  # the stated error, not the requested one
    assert "about 1e-05 rad at every saved time" in str(ph.explain(scene, state, [0, 1]))


def test_a_body_out_of_steps_is_reported_and_the_rest_is_not_a_number():
    method = ph.LiePoisson(Extrapolation(10), max_steps=8)
    got = ph.simulate(SCENE, STATE, [0.0, 0.1, 60.0, 70.0], method, throw=False)
    assert np.all(got.status == ph.Status.MAX_STEPS)
    assert np.all(np.isfinite(got.wxyz[:, :2]))
    assert np.all(np.isnan(got.wxyz[:, 2:]))


def test_a_torque_may_close_over_what_is_differentiated():
    state = ph.State([0.6, 0, 0.8, 0], [1.0, -0.5, 0.3])

    @jax.jit
    @jax.value_and_grad
    def loss(a):
        drag = ph.FeedbackTorque(lambda t, attitude, omega: -a * omega)
        push = ph.BodyTorque(lambda t: a * jnp.stack([jnp.sin(t), jnp.cos(t), 0 * t]))
        got = ph.simulate(ph.Scene(INERTIA, None, drag + push), state, [0.0, 3.0])
        return jnp.sum(got.omega_body[-1] * jnp.array([1.0, 2.0, 3.0]))

    step = 1e-4
    want = (loss(0.3 + step)[0] - loss(0.3 - step)[0]) / (2 * step)
    np.testing.assert_allclose(loss(0.3)[1], want, rtol=1e-6)


def test_only_a_resting_centre_is_turned_upright():
    """Space axes are rotated so that the attracting centre is on z, if it does not move."""
    resting = ph.Scene(INERTIA, ph.GravityGradient(1.0, [1.0, 0, 0]))
    assert choose(resting)[0].chart.upright
    moving = ph.Scene(INERTIA, ph.GravityGradient(1.0, lambda t: jnp.stack([t, 1 + t, t])))
    assert not choose(moving)[0].chart.upright  # the direction rotates


@pytest.mark.slow
def test_a_gravity_gradient_is_the_same_seen_from_a_frame_upright_to_it():
    """Derivatives include that rotation."""

    def loss(place, mu, method):
        scene = ph.Scene(INERTIA, ph.GravityGradient(mu, place))
        got = ph.simulate(scene, STATE, [0.0, 1.0, 4.0], method, rtol=1e-12)
        return jnp.sum(jnp.sin(got.omega_body)) + jnp.sum(got.wxyz**3)

    method, _ = choose(ph.Scene(INERTIA, ph.GravityGradient(1.0, [1.0, 0, 0])))
    given = jnp.array([0.5, -0.6, -0.8]), jnp.array(2.0)
    plain = ph.LiePoisson(Extrapolation(12))

    @jax.jit
    def both(*given):
        return [jax.value_and_grad(loss, (0, 1))(*given, m) for m in (method, plain)]

    upright, general = both(*given)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9), upright, general)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["box", "bell"])
def test_a_push_after_rest_or_on_a_turning_body_is_seen(kind):
    """The estimate of the midpoint rule misses a torque that jumps near the ends of a step. Before
    a bell-shaped torque the body has almost no momentum to which the error could be relative.
    """
    state = ph.State([[1.0, 0, 0, 0]] * 2, [[0.0, 0, 0], [0.3, 0.1, -0.4]])

    def push(t):
        bell = jnp.exp(-(((t - 15) / 2) ** 2))
        size = bell if kind == "bell" else jnp.where((t >= 10) & (t < 20), 1.0, 0.0)
        return size * jnp.array([0.016, -0.008, 0.01])

    scene = ph.Scene(ph.Inertia.from_moments([1.0, 1.7, 2.2]), torque=ph.BodyTorque(push))
    got = ph.simulate(scene, state, [0.0, 60.0], rtol=1e-9)
    times = [*range(11), *np.linspace(10, 20, 41)[1:], 60]  # the jumps are ends of steps
    method = ph.LiePoisson(diffrax.Dopri8())
    want = ph.simulate(scene, state, np.array(times, float), method, rtol=1e-13)
    assert np.max(rotation.angle_between(got.wxyz[:, -1], want.wxyz[:, -1])) < 1e-8
    assert np.all(got.steps < 800)


@pytest.mark.parametrize(
    ("rates", "inclusive", "ts"),
    [([0.0, 0.5, 0.1], True, [0.0, 50.0, 100.0]), ([0.0, 0, 0], False, [0.0, 50.0, 100.0])],
    ids=["turning", "resting"],
)
def test_steps_go_on_from_a_jump_at_a_saved_time(rates, inclusive, ts):
    """Steps of a few units in the last place of the time must grow again, or shrink until they
    pass.
    """

    def push(t):
        acts = t >= 50 if inclusive else t > 50
        return jnp.where(acts, 1.0, 0.0) * jnp.array([0.0, 0.3, 0.1])

    inertia, start = ph.Inertia.from_moments([1.0, 2.0, 2.5]), ph.State([1.0, 0, 0, 0], rates)
    got = ph.simulate(ph.Scene(inertia, None, ph.BodyTorque(push)), start, ts)
    assert got.steps < 1200
    there = ph.simulate(ph.Scene(inertia), start, ts[:2]).last
    pushed = ph.Scene(inertia, None, ph.BodyTorque([0.0, 0.3, 0.1]))
    want = ph.simulate(pushed, there, ts[1:], rtol=1e-11)
    assert rotation.angle_between(got.wxyz[-1], want.wxyz[-1]) < 1e-8


def test_a_brake_that_lets_go_at_a_rate():
    """About one axis, a constant torque down to a rate of 1/2: the angle is elementary."""
    rates = np.array([0.8, -1.5])
    state = ph.State([[1.0, 0, 0, 0], [0.6, 0, 0.8, 0]], rates[:, None] * [0, 0, 1.0])

    def brake(t, attitude, omega):
        size = jnp.where(jnp.abs(omega[2]) > 0.5, -0.2, 0.0)
        return size * jnp.sign(omega[2]) * jnp.array([0.0, 0.0, 1.0])

    scene = ph.Scene(ph.Inertia.from_moments([1.0, 1.7, 2.2]), torque=ph.FeedbackTorque(brake))
    got = ph.simulate(scene, state, [0.0, 40.0])
    braked = (np.abs(rates) - 0.5) / (0.2 / 2.2)
    angle = np.sign(rates) * ((np.abs(rates) + 0.5) / 2 * braked + 0.5 * (40 - braked))
    turn = np.stack([np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)], axis=-1)
    want = rotation.multiply(state.wxyz, jnp.array(turn))
    assert np.max(rotation.angle_between(got.wxyz[:, -1], want)) < 1e-8


def test_rounding_of_smooth_torques_in_single_precision_is_carried_along():
    """Without compensation of rounding, explicit steps had an error of 2e-3."""

    def found(dtype):
        arrays = ([1, 1.5, 2], [0, 0, 0.5], [1, 0, 0, 0], [0.3, 0.2, 2.0], [0, 100])
        moments, centre, *state, ts = (np.asarray(x, dtype) for x in arrays)
        weight, drag = ph.UniformGravity(dtype(1), centre), ph.LinearDamping(dtype(1e-3))
        return ph.Scene(ph.Inertia.from_moments(moments), weight, drag), ph.State(*state), ts

    single = ph.simulate(*found(np.float32))
    exact = ph.simulate(*found(np.float64))
    gap = rotation.angle_between(single.wxyz[-1].astype(float), exact.wxyz[-1])
    assert gap < 10 * 1e-5 + float(np.finfo(np.float32).eps) * 200**1.5  # of 200 rad
    explained = str(ph.explain(*found(np.float32)))
    assert "extrapolated midpoint rule, with compensated summation\n" in explained
