"""Programs of orbits: no loops, no Kepler equation for a circle, and one copy of each orbit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from torques.orbit_scenes import last_rates, orbit_of, scene_of
from xla.operations import operations

import polhode as ph
from polhode._checks import as_float_array
from polhode._integrate import _field, _flow_derivative, _problem
from polhode._kernels import is_fusible


@pytest.mark.parametrize(
    "orbit",
    [
        ph.KeplerOrbit(1.0, 2.0, 0.1),
        ph.HyperbolicOrbit(1.0, -2.0, 1.1),
        ph.KeplerOrbit.from_state(1.0, [1.0, 0, 0], [0, 1.1, 0]),
        ph.HyperbolicOrbit.from_state(1.0, [1.0, 0, 0], [0, 1.6, 0]),
    ],
)
def test_no_loops(orbit):
    for f in (orbit, orbit.velocity_at, jax.jacfwd(orbit.velocity_at)):
        assert not {"while", "scan", "cond"} & set(operations(jax.make_jaxpr(f)(0.3).jaxpr))


def test_a_circle_solves_no_equation():
    """One sine and one cosine of the time."""
    orbit = ph.KeplerOrbit(1.3, 2.1, inclination=0.7)
    seen = {"sin": 0, "cos": 0}

    def count(jaxpr, moving):
        moving = set(moving)
        for eqn in jaxpr.eqns:
            at = [k for k, v in enumerate(eqn.invars) if not hasattr(v, "val") and v in moving]
            if not at:
                continue
            moving.update(eqn.outvars)
            if eqn.primitive.name in seen:
                seen[eqn.primitive.name] += 1
            if "jaxpr" in eqn.params:
                inner = eqn.params["jaxpr"].jaxpr
                count(inner, [inner.invars[k] for k in at])

    jaxpr = jax.make_jaxpr(orbit)(0.3).jaxpr
    count(jaxpr, jaxpr.invars)
    assert seen == {"sin": 1, "cos": 1}


@pytest.fixture
def copies(monkeypatch):
    """Number of logarithms in every specialised field: one for each Kepler equation."""
    found = []
    for module in (_field, _flow_derivative, _problem):
        original = module.specialise

        def recorded(closed, known, original=original, **options):
            made = original(closed, known, **options)
            shapes = [v.aval for v in closed.jaxpr.invars[len(known) :]]
            program = jax.make_jaxpr(made.run)(made.coefficients, *shapes)
            found.append(operations(program.jaxpr)["log"])
            return made

        monkeypatch.setattr(module, "specialise", recorded)
    return found


@pytest.mark.slow
def test_one_copy_in_the_field(copies):
    """Eagerly, under jit, vmap and grad, for one orbit and for one orbit per body."""
    orbit, several = orbit_of(0.1), orbit_of(0.1, jnp.array([2.0, 2.1, 2.2]))
    scene, scenes = scene_of(orbit, orbit, orbit), scene_of(several, several)

    def made_inside(e, times):
        orbit = orbit_of(e)
        return jnp.sum(last_rates(scene_of(orbit, orbit), times=times) ** 2)

    def largest(run, *given):
        copies.clear()
        run(*given)
        return max(copies)

    shape = jax.eval_shape
    assert largest(last_rates, scene) == 1
    assert largest(shape, lambda t: last_rates(scene, t, 3), 1.5) == 1
    assert largest(shape, lambda t: last_rates(scenes, t, 4), 1.5) == 1
    assert largest(shape, jax.vmap(lambda e: made_inside(e, 5)), jnp.array([0.1, 0.2])) == 1
    assert largest(shape, jax.grad(lambda e: made_inside(e, 6)), 0.1) == 1
    two = scene_of(orbit_of(0.1), orbit_of(0.1))
    assert largest(shape, lambda t: last_rates(two, t, 7), 1.5) == 2


def test_a_table_fits_into_a_fused_kernel():
    """Including the search: a comparison in the total order of floats, as in ``jnp.searchsorted``,
    would run the field of a satellite unfused, eleven times as slow.
    """
    times = np.linspace(0.0, 3600.0, 61)
    for order in (1, 3):
        table = ph.Table(times, np.sin(np.outer(times, [1e-3, 2e-3, 3e-3])), order=order)
        for t in (0.0, jnp.array([-5.0, 30.0, 7200.0])):
            assert is_fusible(jax.make_jaxpr(table)(t).jaxpr)


@pytest.mark.parametrize("number", [3.0, 3, np.float64(3.0), [3.0], np.array([3.0])])
def test_a_number_in_a_traced_function_fits_into_a_fused_kernel(number):
    """``jax.device_put`` of a Python number would be a separate operation."""
    program = jax.make_jaxpr(lambda x: x * as_float_array("number", number))(1.0)
    assert is_fusible(program.jaxpr)
