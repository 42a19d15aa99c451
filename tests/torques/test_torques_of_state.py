import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode import FeedbackTorque, QuadraticDamping


@pytest.mark.slow
def test_quadratic_damping_about_one_axis():
    """I domega/dt = -c omega^2: omega = w/(1 + c w t/I), with its derivative; zero at rest."""
    state = ph.State([1.0, 0, 0, 0], [[0.0, 2.0, 0.0], [0.0, 0.0, 0.0]])
    ts = jnp.array([0.0, 3.0])

    def last(c):
        scene = ph.Scene(ph.Inertia.from_moments([1.0, 2.0, 2.5]), torque=QuadraticDamping(c))
        return ph.simulate(scene, state, ts, rtol=1e-11).omega_body[:, -1, 1]

    got, slope = last(0.3), jax.jacfwd(last)(0.3)
    assert abs(got[0] - 2 / (1 + 0.3 * 2 * 3 / 2)) < 1e-10
    assert abs(slope[0] + 2 * 3 / (1 + 0.9) ** 2) < 1e-9
    assert got[1] == 0
    assert slope[1] == 0
    with pytest.raises(ValueError, match="must not be negative"):
        QuadraticDamping([0.1, -0.1, 0.1])


def test_feedback_is_a_function_of_time_attitude_and_rates():
    """A restoring and damping torque brings the body to rest at the target."""

    def law(t, wxyz, omega):
        assert wxyz.shape == (4,)
        return -0.3 * jnp.sign(wxyz[0]) * wxyz[1:] - 0.5 * omega + 0.0 * jnp.sin(t)

    scene = ph.Scene(ph.Inertia.from_moments([1.0, 1.25, 1.5]), torque=FeedbackTorque(law))
    state = ph.State([0.8, 0.3, 0.4, 0.2], [[0.1, 0.2, 0.3], [0.4, -0.5, 0.1]])
    end = ph.simulate(scene, state, [0.0, 200.0], record=ph.Record(final_only=True))
    assert np.abs(np.array(end.omega_body)).max() < 1e-8
    assert np.abs(np.array(end.wxyz[..., 1:])).max() < 1e-8
    with pytest.raises(TypeError, match="fn\\(t, wxyz, omega_body\\)"):
        FeedbackTorque([1.0, 0.0, 0.0])


def test_kovalevskaya_top():
    """A = B = 2 C, centre of mass in the equator: |(w1 + i w2)^2 - (mu/C)(u1 + i u2)|^2 is
    constant.
    """
    c, mu = 0.5, 0.7
    inertia = ph.Inertia.from_moments([2 * c, 2 * c, c])
    scene = ph.Scene(inertia, ph.UniformGravity(1.0, (mu, 0.0, 0.0), (0.0, 0.0, -1.0)))
    state = ph.State([0.8, 0.3, 0.4, 0.2], [[0.1, 0.2, 0.3], [0.4, -0.5, 1.5]])
    got = ph.simulate(scene, state, jnp.linspace(0, 8, 9), ph.LiePoisson(), rtol=1e-12)
    w, u = np.array(got.omega_body), np.array(ph.rotation.wxyz_to_matrix(got.wxyz))[..., 2, :]
    xi = (w[..., 0] + 1j * w[..., 1]) ** 2 + mu / c * (u[..., 0] + 1j * u[..., 1])
    minus = (w[..., 0] + 1j * w[..., 1]) ** 2 - mu / c * (u[..., 0] + 1j * u[..., 1])
    spread = min(np.ptp(np.abs(x), axis=-1).max() for x in (xi, minus))
    assert spread < 1e-9
    assert max(np.ptp(np.abs(x), axis=-1).max() for x in (xi, minus)) > 0.1  # the sign matters


@pytest.mark.parametrize("wrap", ["alone", pytest.param("in pulses", marks=pytest.mark.slow)])
@pytest.mark.slow  # faster: a shorter way, solvers/test_switches
def test_pointing_through_half_a_turn_keeps_rtol(wrap):
    """The law jumps there; the reference is Dopri8 at a tight tolerance."""
    rng = np.random.default_rng(3)
    state = ph.State(rng.normal(size=(8, 4)), rng.normal(size=(8, 3)))
    law = ph.Pointing(0.6, 0.05)
    torque = law if wrap == "alone" else ph.Pulses(law, [0.0], [20.0])
    inertia = ph.Inertia.from_moments([1.0, 1.5, 2.0])
    got = ph.simulate(ph.Scene(inertia, torque=torque), state, [0.0, 10.0], rtol=1e-6)
    tight = ph.LiePoisson(diffrax.Dopri8(), chunk=1)
    want = ph.simulate(ph.Scene(inertia, torque=law), state, [0.0, 10.0], tight, rtol=1e-11)
    error = ph.rotation.angle_between(got.wxyz[:, -1], want.wxyz[:, -1])
    assert float(error.max()) < 1e-5, error
