"""How often the field of a scene stands in the program of its motion."""

import equinox as eqx
import jax
import jax.numpy as jnp

import polhode as ph


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


class Marked(eqx.Module):
    """A torque of the user's with an operation that nothing else has."""

    def __call__(self, t, wxyz, omega):
        return -0.1 * jax.scipy.special.erf(omega)


def test_the_field_stands_in_few_places():
    """One evaluation at the start, of which the order follows; three in the columns of a step, one
    after it and one in the search for jumps."""
    scene = ph.Scene(ph.Inertia.from_moments([1.0, 1.5, 2.0]), None, ph.FeedbackTorque(Marked()))

    def end(omega):
        state = ph.State([1.0, 0, 0, 0], omega)
        return ph.simulate(
            scene, state, [0.0, 1.0], record=ph.Record(final_only=True), rtol=1e-8
        ).omega_body

    program = jax.make_jaxpr(end)(jnp.array([0.1, 0.3, 0.2]))
    assert count(program.jaxpr, "erf") == 6
