"""Dense output and error estimates of the explicit rules, against SciPy and steps of 1/64."""

from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from polhode._integrate import _error_control as control
from polhode._integrate._explicit_step import dense_of, dense_state, in_parts
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
    """Geometric mean over bodies and step sizes, of the mean over positions in the step."""
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


def narrow_fields(rng, bodies):
    """Scalar rates with a narrow feature within or near a step from 0 to 1."""
    width = 10 ** rng.uniform(-1.3, 0.5, bodies)
    place, drive = rng.uniform(-0.2, 1.2, bodies), rng.uniform(1.2, 4, bodies)
    return (
        lambda t, y: -drive - np.tanh((y + 3 * place) / width),  # passes a band of friction
        lambda t, y: np.tanh((t - place) / width),
        lambda t, y: 1 / (1 + ((t - place) / width) ** 2),
    )


def one_step(field, t, y, width):
    stages = np.zeros((DOP853.stages, y.size))
    for k in range(DOP853.stages):
        change = DOP853.weights[k, : DOP853.stages] @ stages
        stages[k] = field(t + DOP853.nodes[k] * width, y + width * change)
    return y + width * DOP853.weights[DOP853.stages - 1, : DOP853.stages] @ stages, width * stages


def test_steps_that_pass_something_narrow_are_noticed():
    """Error over estimate, with and without the sixth divided difference."""
    rng = np.random.default_rng(0)
    found = {True: [], False: []}
    for field in narrow_fields(rng, 5000):
        begin = np.zeros(5000)
        end, stages = one_step(field, 0, begin, 1)
        exact = begin
        for k in range(64):
            exact, _ = one_step(field, k / 64, exact, 1 / 64)
        error, lower, difference = (
            np.abs(row @ stages) for row in (*DOP853.errors, DOP853.difference)
        )
        estimate = error**2 / np.sqrt(error**2 + 0.01 * lower**2)
        counts = np.abs(end - exact) > 1e-11
        for with_difference, values in found.items():
            extra = control.SIXTH_DIFFERENCE * difference * with_difference
            with np.errstate(divide="ignore"):  # without the difference some estimates vanish
                values.append(np.abs(end - exact)[counts] / (estimate + extra)[counts])
    without, with_it = (np.concatenate(found[key]) for key in (False, True))
    assert np.mean(without > 10) > 0.05, "the difference is not needed"
    assert np.mean(with_it > 10) < 0.01
    assert np.quantile(without, 0.999) > 1000
    assert np.quantile(with_it, 0.999) < 50


@cache
def order_conditions(order):
    """For every rooted tree with this number of nodes, the weights of its order condition: factors
    of one stage, which are products of those of its subtrees (Hairer, Norsett & Wanner, section
    II.2).
    """

    def forests(nodes, largest):
        """Products of trees with this total number of nodes, each of at most ``largest``."""
        if nodes == 0:
            return [np.ones(DOP853.stages)]
        table = DOP853.weights[: DOP853.stages, : DOP853.stages]
        return [
            (table @ tree) * rest
            for size in range(1, min(nodes, largest) + 1)
            for tree in order_conditions(size)
            for rest in forests(nodes - size, size)
        ]

    return forests(order - 1, order - 1)


def test_the_difference_is_the_only_combination_of_the_seventh_order():
    """It satisfies all order conditions up to the sixth, and no other combination of stages does.

    Trees that differ in the order of their branches occur repeatedly, which does not matter.
    """
    conditions = np.array([row for order in range(1, 7) for row in order_conditions(order)])
    size = np.linalg.norm(DOP853.difference)
    np.testing.assert_allclose(conditions @ DOP853.difference / size, 0, atol=1e-13)
    values = np.linalg.svd(conditions, compute_uv=False)
    assert np.sum(values > 1e-9) == DOP853.stages - 1
    assert np.max(np.abs(np.array(order_conditions(7)) @ DOP853.difference)) / size > 1e-6


@pytest.mark.parametrize("rule", [DOP853, TSIT5], ids=["DOP853", "Tsit5"])
def test_weights_in_single_precision_are_those_of_the_rule(rule):
    for dtype in (np.float32, np.float64):
        parts = in_parts(rule.weights, np.dtype(dtype))
        assert all(part.dtype == dtype for part in parts)
        total = sum(np.asarray(part, float) for part in parts)
        np.testing.assert_allclose(total, rule.weights, rtol=0, atol=1e-13)
