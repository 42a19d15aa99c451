"""One orbit in several parts of a scene is evaluated once."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode._integrate import _field, _flow_derivative, _problem
from polhode._kernels import Distinct, jit_distinct

BODY = ph.Inertia.from_moments([1.0, 1.5, 2.0])
FIELD = ph.DipoleField([0.0, 0.0, -1e7])
STATE = ph.State([1.0, 0, 0, 0], [0.1, 0.3, 0.2])
LAST = ph.Record(final_only=True)


def orbit_of(e, axis=2.0):
    return ph.KeplerOrbit(2.0, axis, e, 0.3)


def scene_of(first, second, third=None):
    torque = ph.MagneticDipole(ph.BDot(0.2), FIELD, second)
    if third is not None:
        torque = torque + ph.RelativeTorque(ph.LinearDamping(0.01), ph.LVLH(third))
    return ph.Scene(BODY, ph.GravityGradient(2.0, first), torque)


def count(jaxpr, name):
    """Operations of a program, those of inner programs too."""
    total = 0
    for eqn in jaxpr.eqns:
        total += eqn.primitive.name == name
        for value in eqn.params.values():
            for inner in value if isinstance(value, tuple | list) else [value]:
                inner = getattr(inner, "jaxpr", inner)
                total += count(inner, name) if hasattr(inner, "eqns") else 0
    return total


def last_rates(scene, t=1.0, times=2):
    ts = jnp.linspace(0.0, t, times)  # as many that a program is traced anew
    return ph.simulate(scene, STATE, ts, record=LAST, rtol=1e-8).omega_body


@pytest.fixture
def copies(monkeypatch):
    """Of every field that is specialised the logarithms: one in each Kepler's equation."""
    found = []
    for module in (_field, _flow_derivative, _problem):
        original = module.specialise

        def recorded(closed, known, original=original, **options):
            made = original(closed, known, **options)
            shapes = [v.aval for v in closed.jaxpr.invars[len(known) :]]
            program = jax.make_jaxpr(made.run)(made.held, *shapes)
            found.append(count(program.jaxpr, "log"))
            return made

        monkeypatch.setattr(module, "specialise", recorded)
    return found


def test_one_copy_in_the_field(copies):
    """Plainly, under jit, vmap and grad, for one orbit and for one of each body."""
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


def test_the_same_motion_and_derivative_as_with_orbits_of_their_own():
    shared = orbit_of(0.1)
    np.testing.assert_allclose(
        last_rates(scene_of(shared, shared)),
        last_rates(scene_of(orbit_of(0.1), orbit_of(0.1))),
        rtol=0,
        atol=1e-15,
    )
    moved = eqx.tree_at(
        lambda s: s.potential.position_space.semi_major_axis,
        scene_of(shared, shared),
        jnp.asarray(2.3),
    )
    np.testing.assert_allclose(
        last_rates(moved), last_rates(scene_of(orbit_of(0.1, 2.3), shared)), rtol=0, atol=1e-15
    )


@pytest.mark.slow
def test_the_derivative_by_a_shared_orbit():
    """Adds what comes through each of the parts."""

    def shared(e):
        orbit = orbit_of(e)
        return jnp.sum(last_rates(scene_of(orbit, orbit)) ** 2)

    scene = scene_of(*[orbit_of(0.1)] * 2)
    slopes = jax.grad(lambda s: jnp.sum(last_rates(s) ** 2))(scene)
    parts = [slopes.potential.position_space.eccentricity, slopes.torque.position.eccentricity]
    np.testing.assert_allclose(jax.grad(shared)(0.1), sum(parts), rtol=1e-6)


def test_arrays_in_several_places():
    x, y = jnp.arange(3.0), jnp.ones(3)
    tree = {"a": x, "b": [y, x, 2], "c": None}
    distinct = Distinct(tree)
    assert [id(leaf) for leaf in jax.tree.leaves(distinct)][:2] == [id(x), id(y)]
    back = distinct.value()
    assert back["a"] is back["b"][1] is x
    assert back["b"][0] is y
    assert back["b"][2] == 2
    seen = []

    @jit_distinct
    def total(a, b, *, c):
        seen.append((a is b, a is c))
        return a + b + c

    np.testing.assert_array_equal(total(x, x, c=y), 2 * x + y)
    np.testing.assert_array_equal(total(x + 1, y, c=y), x + 1 + 2 * y)
    assert seen == [(True, False), (False, False)]
    slope = jax.grad(lambda x: total(x, x, c=y).sum())(x)
    np.testing.assert_array_equal(slope, 2 * y)
