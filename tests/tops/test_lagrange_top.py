import dataclasses
import itertools
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))

import top_cases

import polhode as ph
from polhode import LagrangeTop, Rotor, UniformGravity
from polhode._closed_forms._lagrange_top import Top, lagrange_motion

NAMES = list(top_cases.CASES)
NUMBERS = np.array(list(top_cases.CASES.values())).T  # (10, cases): cases are lanes


def moved(numbers, t):
    """State (7, N) after t (N,), from ten numbers for each of N lanes."""
    a, c, pull, *rest = numbers
    omega = jnp.stack(rest[:3], axis=-1)
    q = jnp.stack(rest[3:], axis=-1)
    q = q / jnp.sqrt(jnp.sum(q * q, axis=-1, keepdims=True))
    zero = jnp.zeros_like(pull)
    force = jnp.stack([zero, zero, -pull], axis=-1)
    top = Top.of(a, force, jnp.ones_like(pull), q, omega, c * omega[:, 2])
    wxyz, rates = lagrange_motion(top, t[:, None])
    return jnp.concatenate([rates[:, 0], wxyz[:, 0]], axis=-1).T


VALUE = jax.jit(moved)
SLOPE = jax.jit(lambda x, d, t: jax.jvp(lambda y: moved(y, t), (x,), (d,))[1])
SENSITIVITY = jax.jit(lambda x, d, t: jax.vjp(lambda y: moved(y, t), x)[1](d)[0])
# Not jnp.full, whose weak type would be another program.
TIMES = np.full(len(NAMES), top_cases.TIME)


@pytest.fixture(scope="module")
def exact():
    return [top_cases.truth(name) for name in NAMES]


@pytest.mark.parametrize(
    ("dtype", "bound"),
    [(jnp.float64, 2e-14), pytest.param(jnp.float32, 2e-5, marks=pytest.mark.slow)],
)
def test_every_regime_is_exact(exact, dtype, bound):
    x = jnp.asarray(NUMBERS, dtype)
    got = np.array(VALUE(tuple(x), jnp.full(len(NAMES), top_cases.TIME, dtype)), float).T
    for name, state, entry in zip(NAMES, got, exact):
        error = np.abs(state - entry["state"]).max() / max(1, np.abs(entry["state"]).max())
        # an unstable equilibrium or separatrix amplifies the rounding of the input
        growth = max(1.0, np.abs(entry["gradient"]).max() / 10)
        assert error < bound * growth, (name, error)


def bound_of(name):
    """Bound on the relative error of a gradient: with three equal roots only the value is exact."""
    return 1e-2 if name == "marginal_sleeping" else 1e-11


@pytest.mark.parametrize("unit", [1e-160, 1e160])
def test_the_motion_does_not_depend_on_the_unit_of_mass(unit):
    """Squares of moments and torques in this unit are not numbers of the dtype."""
    other = NUMBERS * np.where(np.arange(10) < 3, unit, 1)[:, None]
    got, want = (VALUE(tuple(jnp.asarray(x)), TIMES) for x in (other, NUMBERS))
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("unit", [1.0, 1e-110, 1e110])  # of mass: 1e330 is not a number
def test_every_gradient_is_exact(exact, unit):
    units = np.where(np.arange(10) < 3, unit, 1)
    x = jnp.asarray(NUMBERS * units[:, None])
    rows = np.stack(
        [SENSITIVITY(x, jnp.zeros((7, len(NAMES))).at[k].set(1.0), TIMES) for k in range(7)]
    )  # (7, 10, cases), in reverse mode
    for j, (name, entry) in enumerate(zip(NAMES, exact)):
        want = np.array(entry["gradient"])
        error = np.abs(rows[:, :, j] * units - want).max() / np.abs(want).max()
        assert error < bound_of(name), (name, error)


@pytest.mark.slow  # faster: derivatives at rest, test_at_rest
def test_every_forward_derivative_is_exact(exact):
    x, direction = jnp.asarray(NUMBERS), np.random.default_rng(4).normal(size=10)
    forward = np.array(SLOPE(x, jnp.asarray(direction[:, None] * np.ones_like(NUMBERS)), TIMES))
    for j, (name, entry) in enumerate(zip(NAMES, exact)):
        want = np.array(entry["gradient"])
        gap = np.abs(forward[:, j] - want @ direction).max() / np.abs(want).max()
        assert gap < 10 * bound_of(name), (name, gap)


def test_within_a_hair_of_the_marginal_sleeping_top(exact):
    """Three roots of the cubic nearly coincide: states remain near that of the sleeping top."""
    case = np.array(top_cases.CASES["marginal_sleeping"])
    want = exact[NAMES.index("marginal_sleeping")]
    near = np.repeat(case[:, None], len(NAMES), axis=1)
    hairs = np.zeros(len(NAMES))
    for j, (k, h) in enumerate(itertools.product((2, 3, 5, 7), (1e-15, 1e-12, -1e-9, 1e-7, -1e-5))):
        near[k, j] += h
        hairs[j] = abs(h)
    got = np.array(VALUE(tuple(near), TIMES))
    error = np.abs(got - np.array(want["state"])[:, None]).max(axis=0)
    assert np.all(error < 20 * hairs + 1e-14), error


def test_a_top_that_leaves_the_upright_and_comes_back():
    """Almost on the separatrix: energy and vertical momentum at every time of the excursion."""
    a, c, pull, *_ = top_cases.CASES["sleeping_slow"]
    hairs = np.resize([1e-4, 1e-5, 1e-6, 1e-7], len(NAMES))
    numbers = np.repeat(np.array(top_cases.CASES["sleeping_slow"])[:, None], len(NAMES), axis=1)
    numbers[3] += hairs
    late = np.linspace(10, 40, len(NAMES))
    w1, w2, w3, *q = np.array(VALUE(tuple(numbers), jnp.asarray(late)))
    q = np.array(q) / np.linalg.norm(q, axis=0)
    u1, u2 = 2 * (q[1] * q[3] - q[0] * q[2]), 2 * (q[2] * q[3] + q[0] * q[1])
    below = 2 * (q[1] ** 2 + q[2] ** 2)
    energy = a * (w1 * w1 + w2 * w2) / 2 - pull * below  # relative to the sleeping top
    vertical = a * (u1 * w1 + u2 * w2) - c * w3 * below  # likewise
    assert below.max() > 0.5
    assert np.abs(energy).max() < 1e-7
    assert np.abs(energy - a * hairs**2 / 2).max() < 1e-13
    assert np.abs(vertical).max() < 1e-13


@pytest.mark.slow
def test_the_error_does_not_depend_on_the_horizon(shared):
    truth = np.load(shared / "peers" / "truth" / "J3_lag.npz")
    q, w = truth["q0"], truth["w0"]
    scene = ph.Scene(
        ph.Inertia.axisymmetric(1.0, 0.5), UniformGravity.axial(1.0, 0.5, (0, 0, -2.0))
    )
    ts = np.concatenate([[0.0], truth["times"]])
    got = ph.simulate(scene, ph.State(q, w), ts, LagrangeTop())
    for k in (0, len(truth["times"]) // 2, -1):
        a, b = np.array(got.wxyz)[:, 1:][:, k], truth["q"][:, k]
        a = a * np.sign(np.sum(a * b, -1, keepdims=True))
        angle = 2 * np.linalg.norm((a - b) - truth["q_lo"][:, k], axis=-1)
        assert np.median(angle) < 1e-13, (k, np.median(angle))
        assert angle.max() < 1e-12


def test_any_direction_of_gravity_and_wheels_on_the_axis():
    scene = ph.Scene(
        ph.Inertia.axisymmetric(1.3, 0.5),
        UniformGravity(1.2, (0, 0, -0.5), (1.0, -2.0, 0.7)),
        rotors=Rotor.axial(inertia=0.1, speed=3.0, torque=0.0) + Rotor.axial(momentum=0.7),
    )
    state = ph.State([0.5, 0.5, 0.5, -0.5], [[0.3, 0.2, 0.7], [0.0, -1.0, -2.0]])
    got = ph.simulate(scene, state, [0.0, 1.0, 7.0], LagrangeTop())
    want = ph.simulate(scene, state, [0.0, 1.0, 7.0], ph.LiePoisson(), rtol=1e-12)
    assert np.abs(np.array(got.omega_body - want.omega_body)).max() < 1e-9
    assert np.abs(np.array(got.energy - got.energy[:, :1])).max() < 1e-13
    vertical = np.array(scene.potential.gravity_space)
    about = np.array(got.momentum_space) @ vertical
    assert np.abs(about - about[:, :1]).max() < 1e-13
    assert np.abs(np.array(got.wxyz - want.wxyz)).max() < 1e-9


def test_gni_lagrange_top():
    """Hairer, Lubich & Wanner, Geometric Numerical Integration, VII.5, example 5.4, to t = 30."""
    momentum, q = np.array([0.2, 1.0, 0.4]), np.array([0.4, 0.2, 0.4, 0.8])
    moments = np.array([0.5, 0.5, 1.0])
    numbers = (0.5, 1.0, 1.0, *(momentum / moments), *q)
    lanes = tuple(np.full(len(NAMES), x) for x in numbers)
    got = np.array(VALUE(lanes, np.full(len(NAMES), 30.0)))[:, 0]
    want = [0.9599571778198639, -0.36416972569944916, 0.4]
    assert np.abs(got[:3] * moments - want).max() < 1e-13
    wxyz = np.array(
        [
            -0.43556098558439443,
            -0.3700636549040742,
            0.26480479131047296,
            -0.7766710639999446,
        ]
    )
    assert np.abs(got[3:] * np.sign(got[3:] @ wxyz) - wxyz).max() < 1e-13


def test_what_the_solution_is_valid_for():
    """Chosen by type; a body whose numbers violate the condition is NaN, never a wrong number."""
    state = ph.State([1.0, 0, 0, 0], [0.0, 0.1, 1.0])
    axial = UniformGravity.axial(1.0, 0.5)
    top = ph.Scene(ph.Inertia.axisymmetric(1.0, 0.5), axial)
    method = LagrangeTop()
    assert method.why_not(top) is None
    differ = ph.Scene(ph.Inertia.from_moments([1.0, 1.1, 0.5]), axial)
    refused = {
        "ph.Inertia.axisymmetric": ph.Scene(ph.Inertia.from_moments([1.0, 1.0, 0.5]), axial),
        "ph.UniformGravity.axial": dataclasses.replace(
            top, potential=UniformGravity(1.0, (0.0, 0.0, 0.5))
        ),
        "uniform gravity": ph.Scene(ph.Inertia.axisymmetric(1.0, 0.5)),
        "torque": dataclasses.replace(top, torque=ph.BodyTorque([0.0, 0.0, 1.0])),
        "ph.Rotor.axial": dataclasses.replace(top, rotors=Rotor([0, 0, 1.0], momentum=1.0)),
        "motor": dataclasses.replace(top, rotors=Rotor.axial(0.1, speed=1.0, torque=0.1)),
    }
    for word, scene in refused.items():
        assert word in method.why_not(scene)
    equal = refused["ph.Inertia.axisymmetric"]  # valid for its numbers
    assert ph.simulate(equal, state, [0.0, 1.0], method).successful
    with pytest.raises(ph.SimulationError, match="not valid for its numbers"):
        ph.simulate(differ, state, [0.0, 1.0], method)
    traj = ph.simulate(differ, state, [0.0, 1.0], method, throw=False)
    assert np.all(np.isnan(traj.omega_body[-1]))
    with pytest.raises(ValueError, match="torque acts"):
        ph.simulate(refused["torque"], state, [0.0, 1.0], method)
