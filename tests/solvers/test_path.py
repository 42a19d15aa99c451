"""Derivatives of paths that a solver finds in steps of its own, and of bodies that drag holds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph

WEIGHTS = jnp.array([0.7, -0.4, 0.9, 0.3, -0.5, 0.8, 0.6])
DRIVEN = {"moment": jnp.array(1.3), "drag": jnp.array(9.0), "push": jnp.array(7.0),
          "rate": jnp.array(2.0)}  # fmt: skip


def held(p, method):
    """Of a body that a torque drives about its z axis and drag holds to one rate: law known.

    Whatever the start, it forgets it like exp(-28).
    """
    along = jnp.array([0.0, 0.0, 1.0])
    inertia = ph.Inertia.from_moments(jnp.array([0.8, 1.0, 0.0]) + along * p["moment"])
    act = ph.BodyTorque(along * p["push"]) + ph.LinearDamping(p["drag"] * jnp.ones(3))
    state = ph.State([0.6, 0.0, 0.8, 0.0], along * p["rate"])
    record = ph.Record(final_only=True)
    end = ph.simulate(ph.Scene(inertia, None, act), state, [0.0, 4.0], method, record=record)
    return jnp.sum(WEIGHTS[:4] * end.wxyz[0]) + jnp.sum(WEIGHTS[4:] * end.omega_body[0])


@pytest.mark.parametrize(
    "method",
    [ph.Extrapolated(12), ph.LiePoisson(ph.solvers.Extrapolation(12), at_end=True, adjoint=None)],
    ids=lambda m: type(m).__name__,
)
def test_the_way_back_starts_anew_where_drag_draws_states_together(method):
    """From the end alone the start would be found with exp(28) times the rounding."""
    exact = jax.grad(held)(DRIVEN, ph.FixedAxis())
    found = jax.grad(held)(DRIVEN, method)
    if isinstance(method, ph.LiePoisson):
        step = {name: jnp.array(x) for name, x in zip(DRIVEN, (0.5, -1.0, 0.7, 2.0))}
        _, change = jax.jvp(lambda p: held(p, method), (DRIVEN,), (step,))
        want = sum(jax.tree.leaves(jax.tree.map(jnp.multiply, exact, step)))
        np.testing.assert_allclose(change, want, rtol=1e-9)
    for name, want in exact.items():
        np.testing.assert_allclose(found[name], want, rtol=1e-9, atol=1e-10, err_msg=name)
