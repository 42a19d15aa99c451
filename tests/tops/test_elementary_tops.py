import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mpmath import mp, mpf

import polhode as ph
from polhode import FixedAxis, Rotor, SymmetricTop
from polhode._closed_forms._elementary import decay, decay_twice

SYMMETRIC = ph.Inertia.axisymmetric(1.25, 0.5)
STATE = ph.State([0.5, 0.5, 0.5, -0.5], [[0.3, 0.2, 0.7], [0.0, 0.0, -1.0]])
ONE_AXIS = ph.State([0.5, 0.5, 0.5, -0.5], [[0.0, 0.25, 0.0], [0.0, 0.0, 0.0]])
RATES_ONLY = ph.Record(attitude=False)


@pytest.mark.parametrize(("dtype", "bound"), [(jnp.float64, 4e-16), (jnp.float32, 2e-7)])
def test_decay_on_both_sides_of_the_series(dtype, bound):
    rates = np.array([0.0, 1e-12, -1e-3, 0.2499, 0.2501, -0.2499, -0.2501, 3.0, 40.0], dtype)
    for got, slope, rule in (
        (decay, jax.grad(decay), lambda k, t: (1 - mp.exp(-k * t)) / k),
        (
            decay_twice,
            jax.grad(decay_twice),
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
    "wheel": (ph.Scene(SYMMETRIC, rotors=Rotor.axial(momentum=0.4)), STATE, None),
    "free_wheel": (
        ph.Scene(SYMMETRIC, rotors=Rotor.axial(0.1, speed=4.0, torque=0.0)),
        STATE,
        None,
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
}


@pytest.mark.parametrize(
    "name",
    [  # damping also in tests/systems
        x if x in ("free_wheel", "one_axis") else pytest.param(x, marks=pytest.mark.slow)
        for x in CASES
    ],
)
def test_exact_against_integration(name):
    scene, state, record = CASES[name]
    method = FixedAxis() if name == "one_axis" else SymmetricTop()
    ts = [0.5, 1.0, 7.0]
    got = ph.simulate(scene, state, ts, method, record=record)
    want = ph.simulate(scene, state, ts, ph.LiePoisson(), rtol=1e-12, record=record)
    assert np.abs(np.array(got.omega_body - want.omega_body)).max() < 1e-10
    if record is None:
        assert np.abs(np.array(got.wxyz - want.wxyz)).max() < 1e-10
    assert int(got.steps.max()) == 0


def test_what_the_solutions_are_valid_for():
    """Chosen by type; a body whose numbers violate the condition is NaN, never a wrong number."""
    wheel = Rotor.axial(momentum=0.3)
    assert SymmetricTop().why_not(ph.Scene(SYMMETRIC, rotors=wheel)) is None
    for word, parts in (
        ("only numbers can be symmetric", {"torque": ph.BodyTorque([0, 0, 0.1])}),
        ("neither constant", {"torque": ph.SpaceTorque([0, 0, 0.2])}),
        ("ph.Rotor.axial", {"rotors": Rotor([0.0, 0.0, 1.0], momentum=0.3)}),
        ("spins freely", {"rotors": Rotor.axial(0.1, speed=0.3, torque=0.0)}),
    ):
        scene = ph.Scene(SYMMETRIC, **parts)
        assert word in SymmetricTop().why_not(scene)
        assert FixedAxis().why_not(scene) is not None
    off = ph.Scene(SYMMETRIC, rotors=Rotor([0.0, 0.0, 1.0], momentum=0.3))
    with pytest.raises(ValueError, match=r"ph\.Rotor\.axial"):
        ph.simulate(off, STATE, [0.0, 1.0], SymmetricTop())
    driven = ph.Scene(SYMMETRIC, torque=ph.BodyTorque([0, 0, 0.1]))
    for method in (SymmetricTop(), FixedAxis()):
        with pytest.raises(ph.SimulationError, match="not valid for its numbers"):
            ph.simulate(driven, STATE, [0.0, 1.0], method)
        traj = ph.simulate(driven, STATE, [0.0, 1.0], method, throw=False)
        lost = np.asarray(traj.status == ph.Status.NOT_FINITE)
        np.testing.assert_array_equal(np.isnan(traj.wxyz[..., -1, 0]), lost)
        assert np.any(lost)


RESTING = {
    "symmetric, damping": (
        SymmetricTop(),
        lambda x: ph.Scene(SYMMETRIC, torque=ph.LinearDamping(0.1 * SYMMETRIC.moments)),
    ),
    "symmetric, wheel": (
        SymmetricTop(),
        lambda x: ph.Scene(SYMMETRIC, rotors=Rotor.axial(momentum=x)),
    ),
    "symmetric": (SymmetricTop(), lambda x: ph.Scene(SYMMETRIC, torque=ph.LinearDamping(0.0))),
    "axis, damping": (
        FixedAxis(),
        lambda x: ph.Scene(SYMMETRIC, torque=ph.LinearDamping([0.1, 0.2, 0.3])),
    ),
    "axis, torque": (
        FixedAxis(),
        lambda x: ph.Scene(SYMMETRIC, torque=ph.BodyTorque(x * jnp.array([1.0, 2.0, 3.0]))),
    ),
    "free": (ph.ClosedForm(), lambda x: ph.Scene(SYMMETRIC)),
    "free sphere": (ph.ClosedForm(), lambda x: ph.Scene(ph.Inertia.spherical(2.0))),
    "free tensor": (
        ph.ClosedForm(),
        lambda x: ph.Scene(
            ph.Inertia(full=jnp.array([[2.0, 0.1, 0.2], [0.1, 3.0, -0.1], [0.2, -0.1, 4.0]]))
        ),
    ),
}


@pytest.mark.parametrize("method", [SymmetricTop(), FixedAxis()])
def test_derivatives_at_rest(method):
    """Damped at the rate k: the rates by exp(-k t), the attitude by half of its integral."""
    scene = ph.Scene(SYMMETRIC, torque=ph.LinearDamping(0.1 * SYMMETRIC.moments))
    start = jnp.array([0.5, 0.5, 0.1, -0.7])

    def last(rates):
        traj = ph.simulate(scene, ph.State(start, rates), [0.0, 2.0], method)
        return traj.wxyz[-1], traj.omega_body[-1]

    for jacobian in (jax.jacfwd, jax.jacrev):
        wxyz, omega = jax.jit(jacobian(last))(jnp.zeros(3))
        np.testing.assert_allclose(omega, np.exp(-0.2) * np.eye(3), rtol=0, atol=1e-14)
        for k in range(3):
            turn = ph.rotation.multiply(start, jnp.eye(4)[k + 1] * (1 - np.exp(-0.2)) / 0.1 / 2)
            np.testing.assert_allclose(wxyz[:, k], turn, rtol=0, atol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("name", RESTING)
def test_derivatives_at_rest_of_every_closed_form(name):
    check_at_rest(*RESTING[name])


def check_at_rest(method, scene):
    """With respect to the rates and a number of the scene, against integration."""

    def last(both, method):
        state = ph.State([0.5, 0.5, 0.1, -0.5], both[:3])
        traj = ph.simulate(scene(both[3]), state, [0.0, 2.0], method, throw=False)
        return jnp.concatenate([traj.wxyz[-1], traj.omega_body[-1]])

    rest = jnp.zeros(4)
    want = jax.jacfwd(lambda x: last(x, ph.LiePoisson()))(rest)
    assert jnp.max(jnp.abs(want)) > 0.5
    for jacobian in (jax.jacfwd, jax.jacrev):
        got = jax.jit(jacobian(lambda x: last(x, method)))(rest)
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-9)


def test_derivatives_across_a_fixed_axis_are_those_of_this_motion():
    """Zero for a rotating body; for one at rest the second derivatives are NaN."""

    def last(rates):
        scene = ph.Scene(ph.Inertia.from_moments([2.0, 3.0, 4.0]), torque=ph.LinearDamping(0.1))
        traj = ph.simulate(scene, ph.State([1.0, 0, 0, 0], rates), [0.0, 2.0], FixedAxis())
        return jnp.concatenate([traj.wxyz[-1], traj.omega_body[-1]])

    spin = jnp.array([0.0, 0.0, 1.5])
    for jacobian in (jax.jacfwd, jax.jacrev):
        got = jax.jit(jacobian(last))(spin)
        np.testing.assert_array_equal(got[:, :2], 0)
        assert jnp.all(jnp.isfinite(got[:, 2]))
    second = jax.jit(jax.jacfwd(jax.jacrev(last)))(jnp.zeros(3))
    assert jnp.all(jnp.isnan(second[6]))


def test_strong_damping_has_a_derivative_in_single_precision():
    """The series for weak damping is not evaluated where it would overflow."""
    state = ph.State(np.float32([1, 0, 0, 0]), np.float32([0, 0, 1]))

    @jax.jit
    def end(c):
        scene = ph.Scene(
            ph.Inertia.from_moments(np.float32([1, 2, 2])),
            torque=ph.LinearDamping(c * jnp.ones(3, c.dtype))
            + ph.BodyTorque(np.float32([0, 0, 1])),
        )
        motion = ph.simulate(scene, state, np.float32([0, 2e4]), ph.FixedAxis())
        return motion.omega_body[-1, 2]

    value, slope = jax.value_and_grad(end)(jnp.float32(2.0))
    np.testing.assert_allclose([value, slope], [0.5, -0.25], rtol=1e-5)


def test_derivatives_that_turn_the_momentum_are_nan_in_the_attitude_alone():
    """With respect to axial torque, to a wheel's momentum with damping, and to damping with a
    wheel.
    """

    def end(torque, momentum, damping):
        acting = ph.LinearDamping(damping * SYMMETRIC.moments)
        acting = acting + ph.BodyTorque(torque * jnp.array([0.0, 0.0, 1.0]))
        scene = ph.Scene(SYMMETRIC, torque=acting, rotors=Rotor.axial(momentum=momentum))
        state = ph.State([0.5, 0.5, 0.5, -0.5], [0.3, 0.2, 0.7])
        traj = ph.simulate(scene, state, [0.0, 1.5], SymmetricTop())
        return traj.wxyz[-1], traj.omega_body[-1]

    for jacobian in (jax.jacfwd, jax.jacrev):
        by_all = jax.jit(jacobian(end, argnums=(0, 1, 2)))
        for momentum, damping, want in (
            (0.0, 0.0, [True, False, False]),
            (0.0, 0.25, [True, True, False]),
            (0.5, 0.0, [True, False, True]),
        ):
            attitude, rates = by_all(0.0, momentum, damping)
            assert [bool(jnp.all(jnp.isnan(x))) for x in attitude] == want
            assert [bool(jnp.all(jnp.isfinite(x))) for x in attitude] == [not x for x in want]
            assert all(bool(jnp.all(jnp.isfinite(x))) for x in rates)
