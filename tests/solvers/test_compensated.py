"""Integration steps with compensated summation of rounding errors."""

from functools import cache, partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode._hamiltonian import Dynamics, lie_poisson_field
from polhode._integrate import Accuracy


def _tops(dtype):
    """Heavy tops by components, slow compared with their steps; exact in single precision."""
    moments = jnp.array([[1.0, 1.5, 2.0], [2.0, 1.0, 1.5], [1.0, 1.25, 0.5]], dtype)
    numbers = (jnp.array(x, dtype) for x in (0.0625, (0.125, 0.0, 0.5), (0.0, 0.0, -1.0)))
    scene = ph.Scene(ph.Inertia.from_moments(moments), ph.UniformGravity(*numbers))
    y = [[0.125, -0.25, 0.3125], [0.3125, 0.125, 0.0625], [-0.125, 0.25, 0.1875]]
    wxyz = [[0.6, 0.8, 0.0, 0.0], [0.5, -0.5, 0.5, 0.5], [0.6, 0.0, 0.0, 0.8]]
    y, wxyz = (jnp.array(x, jnp.float32).astype(dtype) for x in (y, wxyz))
    return Dynamics(scene.hamiltonian), (tuple(y.T), tuple(wxyz.T))


def _marched(dynamics, y, compensated):
    """By the solver's own integration from each of 401 times to the next."""
    ends = jnp.linspace(0.0, 40.0, 401, dtype=y[0][0].dtype)
    solver = ph.Extrapolation(10, compensated=compensated, accuracy=Accuracy(1e-7, 40.0))
    return _solved(dynamics, y, solver, None, diffrax.StepTo(ends))


def _stepped(dynamics, y, compensated):
    solver = ph.Extrapolation(10, compensated=compensated)
    return _solved(dynamics, y, solver, jnp.array(0.1, y[0][0].dtype), diffrax.ConstantStepSize())


def _solved(dynamics, y, solver, dt0, controller):
    term, ends = diffrax.ODETerm(lie_poisson_field), (jnp.array(t, y[0][0].dtype) for t in (0, 40))
    end = diffrax.diffeqsolve(term, solver, *ends, dt0, y, dynamics, stepsize_controller=controller)
    return jax.tree.map(lambda x: x[-1], end.ys)


@cache
def _exact():
    return jax.jit(partial(_stepped, compensated=False))(*_tops(jnp.float64))


@pytest.mark.parametrize(
    "run",
    [
        pytest.param(_marched, id="marched", marks=pytest.mark.slow),
        pytest.param(_stepped, id="stepped"),
    ],
)
def test_compensated_steps_lose_less_to_rounding(run):
    """Single against double precision; over 400 steps, plain ones have 10 to 40 times the error."""
    exact, lost = _exact(), []
    for compensated in (False, True):
        end = jax.jit(partial(run, compensated=compensated))(*_tops(jnp.float32))
        gaps = jax.tree.map(lambda a, b: jnp.max(jnp.abs(a.astype(b.dtype) - b)), end, exact)
        lost.append(max(float(x) for x in jax.tree.leaves(gaps)))
    assert lost[1] < 2e-6
    assert lost[0] > 6 * lost[1]


def test_a_driven_body_keeps_a_tolerance_near_rounding():
    """900 rad about z, at the rate 3 + 0.05 sin(t): explicit steps would have a rounding error
    above 1e-12.
    """

    def drive(t, wxyz, omega):
        return jnp.array([0.0, 0.0, 0.05]) * jnp.cos(t)

    scene = ph.Scene(ph.Inertia.spherical(1.0), torque=ph.FeedbackTorque(drive))
    state, end = ph.State([1.0, 0, 0, 0], [0.0, 0.0, 3.0]), 300.0
    found = ph.simulate(scene, state, [0.0, end], rtol=1e-13).wxyz[-1]
    half = (3 * end + 0.05 * (1 - np.cos(end))) / 2
    want = jnp.array([np.cos(half), 0.0, 0.0, np.sin(half)])
    assert float(ph.rotation.angle_between(found, want)) < 5e-13
