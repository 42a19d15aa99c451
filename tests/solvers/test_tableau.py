"""Dense output of the explicit rules against SciPy."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from polhode._integrate._explicit_step import dense_of, dense_state
from polhode._integrate._tableau import DOP853, TSIT5

MOMENTS = np.array([1.0, 1.7, 2.1])
PLACES = (0.1, 0.3, 0.5, 0.7, 0.9)


def field(t, y):
    """Quaternion and body momentum of a body under a torque fixed in it."""
    (w, x, y_, z), momentum = y[:4], y[4:]
    a, b, c = momentum / MOMENTS
    turn = [
        -x * a - y_ * b - z * c,
        w * a + y_ * c - z * b,
        w * b + z * a - x * c,
        w * c + x * b - y_ * a,
    ]
    torque = np.cross(momentum, momentum / MOMENTS) + np.array([0.1, 0.2, -0.1])
    return np.concatenate([np.array(turn) / 2, torque])


@pytest.mark.parametrize("rule", [DOP853, TSIT5], ids=["DOP853", "Tsit5"])
def test_the_error_of_dense_output_is_that_many_times_the_one_at_the_end(rule):
    """In the geometric mean over bodies and widths, and the mean over places in the step."""
    rng = np.random.default_rng(1)
    logs = []
    for width in (0.3, 0.6, 1.0):
        for _ in range(6):
            start = rng.normal(size=7)
            start[:4] /= np.linalg.norm(start[:4])
            start[4:] /= np.linalg.norm(start[4:] / MOMENTS)  # 1 rad/s
            stages = []
            for row, node in zip(rule.weights, rule.nodes):
                change = sum((a * k for a, k in zip(row, stages)), np.zeros(7))
                stages.append(field(node * width, start + width * change))
            dense = dense_of(jnp.array([width]), jnp.asarray(stages)[:, :, None], rule)
            exact = solve_ivp(
                field,
                (0, width),
                start,
                "DOP853",
                [x * width for x in (*PLACES, 1)],
                rtol=3e-14,
                atol=1e-15,
            ).y
            *within, end = (
                np.linalg.norm(dense_state(jnp.asarray(start)[:, None], dense, x)[:, 0] - y)
                for x, y in zip(jnp.array((*PLACES, 1.0))[:, None], exact.T)
            )
            logs.append(np.log(np.array(within) / end))
    ratio = float(np.mean(np.exp(np.mean(logs, axis=0))))
    assert rule.dense_error / 2 < ratio < 2 * rule.dense_error, ratio
    # what the steps themselves end with is more accurate than what lies within
    assert ratio > 2
