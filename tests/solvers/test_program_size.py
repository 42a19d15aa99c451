"""How often the field of a scene stands in the program of its motion."""

import equinox as eqx
import jax
import jax.numpy as jnp

import polhode as ph


class Marked(eqx.Module):
    """A torque of the user's with an operation that nothing else has."""

    def __call__(self, t, wxyz, omega):
        return -0.1 * jax.scipy.special.erf(omega)


def places(scene, bodies):
    """Evaluations of the torque in the program of the motion of a batch."""

    def end(omega):
        state = ph.State([1.0, 0, 0, 0], omega)
        return ph.simulate(
            scene, state, [0.0, 1.0], record=ph.Record(final_only=True), rtol=1e-8
        ).omega_body

    omega = jnp.broadcast_to(jnp.array([0.1, 0.3, 0.2]), (bodies, 3))
    return jax.jit(end).lower(omega).as_text().count("chlo.erf ")


def test_the_field_stands_in_few_places():
    """Few bodies: once, in the loop over the stages of a step. A batch: one evaluation at the
    start, of which the order follows, one that sorts the bodies, three in the columns of a step and
    one after it."""
    scene = ph.Scene(ph.Inertia.from_moments([1.0, 1.5, 2.0]), None, ph.FeedbackTorque(Marked()))
    assert places(scene, 1) == 1
    assert places(scene, 100) == 6
