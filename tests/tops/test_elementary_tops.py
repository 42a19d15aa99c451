import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mpmath import mp, mpf

import polhode as ph
from polhode._closed_forms import FixedAxis, SymmetricTop, lawful, tops
from polhode._scene import Rotor

SYMMETRIC = ph.Inertia.axisymmetric(1.25, 0.5)
STATE = ph.State([0.5, 0.5, 0.5, -0.5], [[0.3, 0.2, 0.7], [0.0, 0.0, -1.0]])
ONE_AXIS = ph.State([0.5, 0.5, 0.5, -0.5], [[0.0, 0.25, 0.0], [0.0, 0.0, 0.0]])
RATES_ONLY = ph.Record(attitude=False)


@pytest.mark.parametrize(("dtype", "bound"), [(jnp.float64, 4e-16), (jnp.float32, 2e-7)])
def test_decay_on_both_sides_of_the_series(dtype, bound):
    rates = np.array([0.0, 1e-12, -1e-3, 0.2499, 0.2501, -0.2499, -0.2501, 3.0, 40.0], dtype)
    for got, slope, rule in (
        (tops.decay, jax.grad(tops.decay), lambda k, t: (1 - mp.exp(-k * t)) / k),
        (
            tops.decay_twice,
            jax.grad(tops.decay_twice),
            lambda k, t: (t - (1 - mp.exp(-k * t)) / k) / k,
        ),
    ):
        for k in rates:
            with mp.workdps(150):
                nearby = mpf(float(k)) + mpf(10) ** -25
                want = rule(nearby, mpf(2))
                want_slope = mp.diff(lambda x, rule=rule: rule(x, mpf(2)), nearby)
            k, t = jnp.asarray(k, dtype), jnp.asarray(2.0, dtype)
            assert abs(float(got(k, t)) - float(want)) <= 8 * bound * abs(float(want)), k
            assert abs(float(slope(k, t)) - float(want_slope)) <= 40 * bound * abs(
                float(want_slope)
            ), k


CASES = {
    "wheel": (ph.Scene(SYMMETRIC, rotors=Rotor([0, 0, 1.0], momentum=0.4)), STATE, None),
    "free_wheel": (
        ph.Scene(SYMMETRIC, rotors=Rotor([0, 0, 1.0], 0.1, speed=4.0, torque=0.0)), STATE, None,
    ),
    "damped": (ph.Scene(SYMMETRIC, torque=ph.LinearDamping([0.25, 0.25, 0.1])), STATE, None),
    "driven": (
        ph.Scene(SYMMETRIC, torque=ph.LinearDamping([0.2, 0.2, 0.2]) + ph.BodyTorque([0, 0, 0.3])),
        STATE,
        RATES_ONLY,
    ),
    "one_axis": (
        ph.Scene(
            ph.Inertia.from_moments([1.3, 0.9, 1.0]),
            torque=ph.LinearDamping([0.25, 0.25, 0.2]) + ph.BodyTorque([0, 0.2, 0]),
        ),
        ONE_AXIS,
        None,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", list(CASES))
def test_exact_against_integration(name):
    scene, state, record = CASES[name]
    law, _ = lawful(scene, state, record or ph.Record())
    method = law.method
    assert isinstance(method, FixedAxis if name == "one_axis" else SymmetricTop)
    ts = [0.5, 1.0, 7.0]
    got = ph.simulate(scene, state, ts, method, record=record)
    want = ph.simulate(scene, state, ts, ph.LiePoisson(), rtol=1e-12, record=record)
    assert np.abs(np.array(got.omega_body - want.omega_body)).max() < 1e-10
    if record is None:
        assert np.abs(np.array(got.wxyz - want.wxyz)).max() < 1e-10
    assert int(got.steps.max()) == 0


def test_what_the_laws_ask_for():
    record, laws = ph.Record(), (SymmetricTop(), FixedAxis())
    for word, torque in (
        ("not elementary", ph.BodyTorque([0, 0, 0.1])),
        ("proportional", ph.LinearDamping([0.25, 0.25, 0.2])),
        ("not symmetric", ph.LinearDamping([0.25, 0.2, 0.2])),
        ("neither constant", ph.SpaceTorque([0, 0, 0.2])),
    ):
        scene = ph.Scene(SYMMETRIC, torque=torque)
        assert word in laws[0].why_not(scene, STATE, record)
        assert laws[1].why_not(scene, STATE, record) is not None
    driven = ph.Scene(SYMMETRIC, torque=ph.BodyTorque([0, 0, 0.1]))
    with pytest.raises(ph.SimulationError):
        ph.simulate(driven, STATE, [0.0, 1.0], SymmetricTop())
    with pytest.raises(ph.SimulationError, match="law"):
        ph.simulate(driven, STATE, [0.0, 1.0], FixedAxis())
