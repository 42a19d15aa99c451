"""Contents of programs: evaluations of the field, and nothing that is not requested."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from xla.operations import operations

import polhode as ph
from polhode._closed_forms import free_motion
from polhode.frames import RotatingFrame

OMEGA, SLOPE = np.array([0.3, -0.5, 0.7]), np.array([0.1, 0.2, -0.3])
POSITION, VELOCITY, TIME = np.array([1.0, -2.0, 0.5]), np.array([0.4, 0.3, -0.2]), 0.4


class Marked(eqx.Module):
    """A user-defined torque with an operation that occurs nowhere else."""

    def __call__(self, t, wxyz, omega):
        return -0.1 * jax.scipy.special.erf(omega)


def places(scene, bodies):
    """Number of evaluations of the torque in the program for a batch."""

    def end(omega):
        state = ph.State([1.0, 0, 0, 0], omega)
        return ph.simulate(
            scene, state, [0.0, 1.0], record=ph.Record(final_only=True), rtol=1e-8
        ).omega_body

    omega = jnp.broadcast_to(jnp.array([0.1, 0.3, 0.2]), (bodies, 3))
    return jax.jit(end).lower(omega).as_text().count("chlo.erf ")


def test_the_field_stands_in_few_places():
    """Few bodies: once, in the loop over the stages of a step. A batch: one evaluation at the
    start, which determines the order of the steps, one to sort the bodies, three in the columns of
    a step, and one after it.
    """
    scene = ph.Scene(ph.Inertia.from_moments([1.0, 1.5, 2.0]), None, ph.FeedbackTorque(Marked()))
    assert places(scene, 1) == 1
    assert places(scene, 100) == 6


def test_rates_alone_compile_to_less():
    shapes = jnp.ones((8, 3)), jnp.ones((8, 3)), jnp.ones(8)

    def operations(**wanted):
        def motion(moments, omega, t):
            wxyz = jnp.ones((8, 4)) if wanted.get("attitude", True) else None
            return free_motion(moments, wxyz, omega, t, **wanted)

        return jax.jit(motion).lower(*shapes).as_text().count("\n")

    assert operations(attitude=False) < 0.6 * operations()


def _multiplications(frame, moving: bool) -> int:
    """Products in the traced program, including nested calls."""

    def program(t, position, velocity):
        return frame.apparent_acceleration(t, position, velocity if moving else None)

    args = jnp.asarray(TIME), jnp.asarray(POSITION), jnp.asarray(VELOCITY)
    found = operations(jax.make_jaxpr(program)(*args).jaxpr)
    return found["mul"] + found["dot_general"]


def test_absent_terms_are_not_computed():
    """One cross product of two vectors counts six."""
    steady = RotatingFrame.from_rate(OMEGA)
    assert _multiplications(steady, moving=False) == 2 * 6
    # Coriolis shares its cross product with the centrifugal force: only 2 v is new
    assert _multiplications(steady, moving=True) == 2 * 6 + 1
    slope = jnp.asarray(SLOPE)
    varying = RotatingFrame.from_rate(lambda t: jnp.asarray(OMEGA) + slope * t)
    # the given rate and its derivative cost two, the Euler term one cross product
    assert _multiplications(varying, moving=True) == 2 * 6 + 1 + 2 + 6
    moving = RotatingFrame.from_rate(OMEGA, lambda t: jnp.stack([jnp.sin(t), t * t, 0.3 * t**3]))
    assert _multiplications(moving, moving=True) > 2 * 6 + 1 + 12
