"""The motion does not depend on how bodies and times are divided into chunks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph

SCENE = ph.Scene(ph.Inertia.from_moments([1.0, 1.5, 2.0]))


SLOW = (1, 1001, False), (7, 2, False), (1031, 3, True)
CASES = [(1031, 3, False), *(pytest.param(*case, marks=pytest.mark.slow) for case in SLOW)]


@pytest.mark.parametrize(("bodies", "times", "rates_only"), CASES)
def test_chunks_change_nothing(bodies, times, rates_only):
    rng = np.random.default_rng(bodies)
    wxyz, omega = jnp.array(rng.normal(size=(bodies, 4))), jnp.array(rng.normal(size=(bodies, 3)))
    ts = jnp.linspace(0.0, 30.0, times)
    record = ph.Record(attitude=not rates_only)

    def moved(omega, chunk):
        return ph.simulate(
            SCENE, ph.State(wxyz, omega), ts, ph.ClosedForm(chunk=chunk), record=record
        )

    usual, small = moved(omega, None), moved(omega, 4)
    # one body and one time: no loop, no stacking
    for i, k in ((0, 1), (bodies - 1, times // 2), (bodies - 1, times - 1)):
        state = ph.State(wxyz[i], omega[i])
        alone = ph.simulate(SCENE, state, jnp.stack([ts[0], ts[k]]), record=record)
        for traj in (usual, small):
            np.testing.assert_allclose(
                traj.omega_body[i, k], alone.omega_body[-1], rtol=0, atol=2e-15 * 30
            )
            if not rates_only:
                np.testing.assert_allclose(traj.wxyz[i, k], alone.wxyz[-1], rtol=0, atol=6e-14)
    if rates_only:
        slope = jax.grad(lambda w: jnp.sum(moved(w, None).omega_body[-1, -1]))(omega)
        want = jax.grad(lambda w: jnp.sum(moved(w, 10**6).omega_body[-1, -1]))(omega)
        np.testing.assert_allclose(slope, want, rtol=0, atol=1e-12)
