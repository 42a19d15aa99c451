"""Every method on every system: exact final state and exact gradient (see README.md)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from diffrax import Dopri8
from systems.table import BY_NAME, SYSTEMS, System, truth

import polhode as ph

FREE = [s.name for s in SYSTEMS if not s.acts]
ALL = [s.name for s in SYSTEMS]
METHODS = {
    "closed_form": (ph.ClosedForm(), FREE),
    "lie_poisson": (
        ph.LiePoisson(Dopri8()),
        [name for name in ALL if name not in ("gravity_gradient", "pushed_in_space")],
    ),
    "extrapolated": (ph.Extrapolated(14), [s.name for s in SYSTEMS if s.acts]),
    "euler_angles": (ph.EulerAngles(Dopri8()), ["free_short_axis_mode", "heavy_asymmetric_top"]),
}
VALUE = [(method, name) for method, (_, names) in METHODS.items() for name in names]


def scene_of(system: System, moments) -> ph.Scene:
    """The system in the package's words."""
    dtype = moments.dtype
    acts = system.acts
    potential, torques = None, []
    if "gravity" in acts:
        weight, centre = acts["gravity"]
        gravity = jnp.array([0, 0, -1], dtype)
        potential = ph.UniformGravity(jnp.array(weight, dtype), jnp.array(centre, dtype), gravity)
    if "gradient" in acts:
        strength, along = acts["gradient"]
        potential = ph.GravityGradient(jnp.array(strength / 3, dtype), jnp.array(along, dtype))
    if "body" in acts:
        torques.append(ph.BodyTorque(jnp.array(acts["body"], dtype)))
    if "space" in acts:
        torques.append(ph.SpaceTorque(jnp.array(acts["space"], dtype)))
    if "damping" in acts:
        torques.append(ph.LinearDamping(jnp.array(acts["damping"], dtype)))
    torque = sum(torques[1:], start=torques[0]) if torques else None
    return ph.Scene(ph.Inertia.from_moments(moments), potential, torque)


def final_state(system: System, moments, method, rtol):
    """(omega, q) at the last time, q with the sign of the truth."""
    dtype = moments.dtype
    state = ph.State(jnp.array(system.wxyz, dtype), jnp.array(system.omega, dtype))
    times = jnp.array(system.span, dtype)
    scene = scene_of(system, moments)
    end = ph.simulate(scene, state, times, method, rtol=rtol, record=ph.Record(final_only=True))
    exact = jnp.array(truth(system.name)["state"][3:], dtype)
    wxyz = end.wxyz[0] * jnp.sign(jnp.sum(end.wxyz[0] * exact))
    return jnp.concatenate([end.omega_body[0], wxyz])


@pytest.mark.parametrize(("method", "name"), VALUE)
def test_state_and_gradient(method, name):
    system, exact = BY_NAME[name], truth(name)
    solver = METHODS[method][0]
    value, pull = jax.vjp(
        lambda m: final_state(system, m, solver, 1e-13), jnp.array(system.moments)
    )
    jacobian = jax.vmap(pull)(jnp.eye(7))[0]
    of_value, of_gradient = (1e-14, 2e-12) if method == "closed_form" else (2e-11, 2e-9)
    np.testing.assert_allclose(value, exact["state"], rtol=0, atol=of_value)
    scale = np.abs(exact["gradient"]).max()
    np.testing.assert_allclose(jacobian, exact["gradient"], rtol=0, atol=of_gradient * scale)


@pytest.mark.parametrize("name", ["free_long_axis_mode", "heavy_asymmetric_top"])
def test_float32(name):
    system, exact = BY_NAME[name], truth(name)
    moments = jnp.array(system.moments, jnp.float32)
    value = final_state(system, moments, ph.LiePoisson(), 1e-6)
    assert value.dtype == jnp.float32
    np.testing.assert_allclose(value, exact["state"], rtol=0, atol=2e-4)
