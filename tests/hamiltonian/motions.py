"""Integrated motions and their gradients, for ``test_one_hamiltonian.py``.

``python motions.py values`` (or ``gradients``) prints those of the package on the Python path.
"""

import json
import sys

import jax
import jax.numpy as jnp

import polhode as ph

MOMENTS = (1.0, 1.5, 2.25)
OMEGA = (0.5, -1.0, 0.75)
WXYZ = (0.6, 0.48, 0.64, 0.0)
TIMES = (0.0, 0.75, 1.5)
MASSES = (2.0, 0.0)
"""Two bodies: a heavy top, and the same without weight, whose motion is free."""
START = (*MOMENTS, *(i * w for i, w in zip(MOMENTS, OMEGA)))
"""Moments of inertia [kg m^2], and the momentum [kg m^2/s] in body axes at the first time."""


def heavy(moments) -> ph.Scene:
    """Potential: the extrapolated midpoint rule, and derivatives of the exact flow."""
    gravity = ph.UniformGravity(jnp.array(MASSES), [0.125, 0.0, 0.5], [0, 0, -1.0])
    return ph.Scene(ph.Inertia.from_moments(moments), gravity)


def limited(moments) -> ph.Scene:
    """Torque with a limit: Runge-Kutta steps that end at switches, and derivatives of the steps."""

    def torque(t, wxyz, omega_body):
        return jnp.array([jnp.clip(-0.75 * omega_body[0], -0.25, 0.25), 0.0, 0.25 * wxyz[1]])

    return ph.Scene(ph.Inertia.from_moments(moments), torque=ph.FeedbackTorque(torque))


CASES = {
    "Lie-Poisson": (heavy, None),
    "Euler angles": (heavy, ph.EulerAngles(ph.Extrapolation())),
    "limited torque": (limited, None),
}


def values(case: str, x, scale: float = 1.0):
    """Attitudes and momenta (..., T, 7); ``scale``: divisor of the inertia."""
    scene, method = CASES[case]
    moments = x[:3] / scale
    state = ph.State(jnp.array(WXYZ), x[3:] / moments)
    trajectory = ph.simulate(scene(moments), state, jnp.array(TIMES), method, rtol=1e-11)
    return jnp.concatenate([trajectory.wxyz, trajectory.momentum_body], axis=-1)


def gradients(case: str, x, scale: float = 1.0):
    """The gradient (6,) of a weighted sum of the values."""

    def weighted_sum(x):
        samples = values(case, x, scale)
        return jnp.sum(samples * jnp.cos(jnp.arange(samples.size)).reshape(samples.shape))

    return jax.grad(weighted_sum)(x)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    quantity, *cases = sys.argv[1:]
    compiled = jax.jit({"values": values, "gradients": gradients}[quantity], static_argnums=0)
    print(json.dumps({case: compiled(case, jnp.array(START)).tolist() for case in cases}))
