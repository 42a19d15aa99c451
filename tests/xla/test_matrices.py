"""LAPACK is called for one matrix at a time: batched calls may deadlock."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode.fit._numerics as matrices
from polhode.fit import (
    FitOptions,
    FreeMotion,
    FullTensor,
    Recording,
    _fit,
    stack,
)

BATCH = np.random.default_rng(3).normal(size=(2, 5, 4, 4))
SPD = BATCH @ np.swapaxes(BATCH, -1, -2) + np.eye(4)


@pytest.fixture
def affected(monkeypatch):
    """Behave as with a jaxlib that distributes the matrices of a batch over threads."""
    monkeypatch.setattr(matrices, "_AFFECTED", True)


def largest_batch(function, *args):
    """Largest number of matrices in a LAPACK call of the program, and number of calls."""
    text = jax.jit(lambda *args: function(*args)).lower(*args).as_text()  # not cached
    calls = [line for line in text.splitlines() if "@lapack_" in line]
    shapes = [
        [int(size) for size in shape.split("x")[:-1]]
        for line in calls
        for shape in re.findall(
            r"tensor<([0-9x]+x[fi][0-9]+)>", line.rpartition("} : (")[2].split("->")[0]
        )
    ]
    return max((int(np.prod(x[:-2])) for x in shapes if len(x) > 2), default=1), len(calls)


def recordings(count):
    times = np.linspace(0, 0.5, 20)
    rates = np.stack([np.sin(3 * times), np.cos(4 * times), 1 + times], axis=-1)
    return stack([Recording.of(times, k + rates, wheel_speed=100 * times) for k in range(count)])


@pytest.mark.slow  # faster: the matrices alone, below
@pytest.mark.parametrize("fit", ["fit_each", "fit_together"])
def test_the_fits_hand_over_no_batch(affected, fit):
    options = FitOptions(FreeMotion(), FullTensor())
    batch, calls = largest_batch(getattr(_fit, fit).__wrapped__, recordings(6), options)
    assert (batch, calls > 4) == (1, True)


def test_plain_calls_would_be_found():
    assert largest_batch(jnp.linalg.eigh, SPD)[0] == 10
    assert largest_batch(jax.vmap(jnp.linalg.cholesky), SPD)[0] == 10


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_values_are_those_of_numpy(affected, dtype):
    bound = 300 * np.finfo(dtype).eps
    given, right = SPD.astype(dtype), BATCH[..., 0].astype(dtype)
    values, axes = matrices.eigh(given)
    np.testing.assert_allclose(
        axes * values[..., None, :] @ np.swapaxes(axes, -1, -2), given, atol=bound
    )
    left, sizes, other = matrices.svd(given)
    np.testing.assert_allclose(left * sizes[..., None, :] @ other, given, atol=bound)
    want = np.linalg.solve(SPD, BATCH[..., :1])[..., 0]
    np.testing.assert_allclose(matrices.solve(given, right), want, atol=bound)
    np.testing.assert_allclose(matrices.inverse(given) @ given, np.eye(4) + 0 * SPD, atol=bound)
    tall = np.concatenate([SPD, BATCH], axis=-2).astype(dtype)
    factor = matrices.triangle(tall)
    np.testing.assert_allclose(
        np.swapaxes(factor, -1, -2) @ factor, np.swapaxes(tall, -1, -2) @ tall, atol=10 * bound
    )
    ahead = np.concatenate([right, 2 * right], axis=-1)
    want = [np.linalg.lstsq(a, b)[0] for a, b in zip(tall.reshape(10, 8, 4), ahead.reshape(10, 8))]
    got = matrices.least_squares(tall, ahead).reshape(10, 4)
    np.testing.assert_allclose(got, want, atol=10 * bound)


def test_an_inverse_has_derivatives_in_both_modes(affected):
    want = -np.einsum("ai,jb->abij", np.linalg.inv(SPD[0, 0]), np.linalg.inv(SPD[0, 0]))
    for mode in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(mode(matrices.inverse)(jnp.asarray(SPD[0, 0])), want, atol=1e-13)
