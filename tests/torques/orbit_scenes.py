"""Scenes in which one orbit, or several equal ones, appear in several parts."""

import jax.numpy as jnp

import polhode as ph

_BODY = ph.Inertia.from_moments([1.0, 1.5, 2.0])
_FIELD = ph.DipoleField([0.0, 0.0, -1e7])
_STATE = ph.State([1.0, 0, 0, 0], [0.1, 0.3, 0.2])
_LAST = ph.Record(final_only=True)


def orbit_of(e, axis=2.0):
    return ph.KeplerOrbit(2.0, axis, e, 0.3)


def scene_of(first, second, third=None):
    torque = ph.MagneticDipole(ph.BDot(0.2), _FIELD, second)
    if third is not None:
        torque = torque + ph.RelativeTorque(ph.LinearDamping(0.01), ph.LVLH(third))
    return ph.Scene(_BODY, ph.GravityGradient(2.0, first), torque)


def last_rates(scene, t=1.0, times=2):
    """Body rates at time ``t``; another number of ``times`` traces the program again."""
    ts = jnp.linspace(0.0, t, times)
    return ph.simulate(scene, _STATE, ts, record=_LAST, rtol=1e-8).omega_body
