"""One orbit object in several parts of a scene: same motion and derivatives as several objects."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from torques.orbit_scenes import last_rates, orbit_of, scene_of

from polhode._kernels import Distinct, jit_distinct


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
    """It is the sum of the contributions of all parts."""

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
