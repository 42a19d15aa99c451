"""Steps that carry along what rounding takes from them."""

from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import pytest

import polhode as ph
from polhode.hamiltonian import Dynamics, lie_poisson_field


def _tops(dtype):
    """Heavy tops in components, moving slowly against their steps; single precision holds all."""
    moments = jnp.array([[1.0, 1.5, 2.0], [2.0, 1.0, 1.5], [1.0, 1.25, 0.5]], dtype)
    numbers = (jnp.array(x, dtype) for x in (0.0625, (0.125, 0.0, 0.5), (0.0, 0.0, -1.0)))
    scene = ph.Scene(ph.Inertia.from_moments(moments), ph.UniformGravity(*numbers))
    y = [[0.125, -0.25, 0.3125], [0.3125, 0.125, 0.0625], [-0.125, 0.25, 0.1875]]
    wxyz = [[0.6, 0.8, 0.0, 0.0], [0.5, -0.5, 0.5, 0.5], [0.6, 0.0, 0.0, 0.8]]
    y, wxyz = (jnp.array(x, jnp.float32).astype(dtype) for x in (y, wxyz))
    return Dynamics(scene.hamiltonian), (tuple(y.T), tuple(wxyz.T))


def _by_flow(dynamics, y, compensated):
    span = tuple(jnp.array(t, y[0][0].dtype) for t in (0.0, 40.0))
    return ph.solvers.flow(lie_poisson_field, dynamics, y, span, 400, 10, compensated)


def _by_diffrax(dynamics, y, compensated):
    solver = ph.solvers.Extrapolation(10, compact=True, compensated=compensated, substeps=2)
    term, dtype = diffrax.ODETerm(lie_poisson_field), y[0][0].dtype
    end = diffrax.diffeqsolve(
        term, solver, jnp.array(0.0, dtype), jnp.array(40.0, dtype), jnp.array(0.2, dtype), y,
        dynamics, stepsize_controller=diffrax.ConstantStepSize(),
    )  # fmt: skip
    return jax.tree.map(lambda x: x[-1], end.ys)


@pytest.mark.parametrize("run", [_by_flow, _by_diffrax], ids=["flow", "diffrax"])
def test_compensated_steps_lose_less_to_rounding(run):
    """Single precision against double; over 400 steps plain ones lose 10 to 40 times more."""
    exact = jax.jit(partial(run, compensated=False))(*_tops(jnp.float64))
    lost = []
    for compensated in (False, True):
        end = jax.jit(partial(run, compensated=compensated))(*_tops(jnp.float32))
        gaps = jax.tree.map(lambda a, b: jnp.max(jnp.abs(a.astype(b.dtype) - b)), end, exact)
        lost.append(max(float(x) for x in jax.tree.leaves(gaps)))
    assert lost[1] < 2e-6
    assert lost[0] > 6 * lost[1]
