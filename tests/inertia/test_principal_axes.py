"""The batched eigendecomposition against 50 digits, and its derivatives at equal moments."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from polhode import inertia
from polhode.inertia import Inertia, inertia_of_second_moments, principal, second_moments

DTYPES = [jnp.float32, jnp.float64]


def turns(count, seed=0):
    q = np.random.default_rng(seed).normal(size=(count, 4))
    q /= np.linalg.norm(q, axis=-1, keepdims=True)
    w, x, y, z = q.T
    return np.moveaxis(
        np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        ),
        -1,
        0,
    )


def matrix(wxyz):
    """R of unit quaternions in float64, implemented independently of the package."""
    w, v = wxyz[..., 0], wxyz[..., 1:]
    hat = np.zeros((*w.shape, 3, 3))
    hat[..., 2, 1], hat[..., 0, 2], hat[..., 1, 0] = v[..., 0], v[..., 1], v[..., 2]
    hat = hat - np.swapaxes(hat, -1, -2)
    return np.eye(3) + 2 * w[..., None, None] * hat + 2 * hat @ hat


def tensors(dtype):
    """Difficult spectra: random, clustered to rounding, needles, plates; random axes."""
    rng = np.random.default_rng(3)
    n = 60
    spectra = np.concatenate(
        [
            rng.uniform(0.5, 1, (n, 3)),
            1 + 1e-9 * rng.normal(size=(n, 3)),
            np.stack([np.ones(n), 1 + 10.0 ** rng.uniform(-17, 0, n), np.full(n, 1.7)], -1),
            np.stack([10.0 ** rng.uniform(-12, 0, n), np.ones(n), np.ones(n)], -1),
            np.ones((n, 3)),
        ]
    )
    axes = turns(len(spectra))
    scale = 10.0 ** rng.uniform(-12, 12, (len(spectra), 1, 1))
    full = np.einsum("nij,nj,nkj->nik", axes, spectra, axes) * scale
    full = ((full + np.swapaxes(full, -1, -2)) / 2).astype(dtype)
    special = np.stack([np.diag(p) for p in ([3, 2, 1], [2, 3, 1], [1, 1, 2], [2, 1, 1])])
    return np.concatenate([full, special.astype(dtype)])


@pytest.mark.parametrize("dtype", DTYPES)
def test_against_fifty_digits(dtype):
    full = tensors(dtype)
    eps = float(jnp.finfo(dtype).eps)
    moments, wxyz, products = (
        np.asarray(part, np.float64) for part in jax.jit(principal)(jnp.asarray(full))
    )
    assert np.all(np.diff(moments, axis=-1) >= -4 * eps * moments[:, 2:])
    np.testing.assert_array_equal(products, 0)
    assert np.abs(np.linalg.norm(wxyz, axis=-1) - 1).max() < 3 * eps
    axes = matrix(wxyz)
    np.testing.assert_allclose(np.linalg.det(axes), 1, atol=20 * eps)
    with mpmath.workdps(50):
        for one, values, turn in zip(full[::3], moments[::3], axes[::3], strict=True):
            exact = mpmath.eigsy(mpmath.matrix(one.astype(float).tolist()), eigvals_only=True)
            exact = np.array([float(value) for value in exact])
            scale = exact.max()
            assert np.abs(values - exact).max() <= 6 * eps * scale
            rest = turn.T @ one.astype(float) @ turn - np.diag(values)
            assert np.abs(rest).max() <= 20 * eps * scale


@pytest.mark.parametrize("batch", [(), (3, 1, 2, 1), (0,)])
def test_batch_shapes(batch):
    full = jnp.broadcast_to(jnp.diag(jnp.asarray([3.0, 1.0, 2.0])), (*batch, 3, 3))
    moments, wxyz, products = principal(full)
    assert (moments.shape, wxyz.shape, products.shape) == ((*batch, 3), (*batch, 4), (*batch, 3))


def test_identity_axes_for_a_sorted_diagonal_tensor():
    moments, wxyz, _ = principal(jnp.diag(jnp.asarray([1.0, 2.0, 3.0])))
    np.testing.assert_array_equal(wxyz, [1, 0, 0, 0])
    np.testing.assert_array_equal(moments, [1, 2, 3])


def whole(tensor):
    """The tensor reassembled from moments, products and the constant axes."""
    moments, wxyz, (p, q, r) = principal(tensor)
    a, b, c = moments
    inner = jnp.stack([jnp.stack([a, r, q]), jnp.stack([r, b, p]), jnp.stack([q, p, c])])
    w, x, y, z = wxyz
    axes = jnp.stack(
        [
            jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]),
            jnp.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]),
            jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]),
        ]
    )
    return axes @ inner @ axes.T


@pytest.mark.parametrize("spectrum", [(1, 2, 2.5), (1, 1, 1.5), (1, 1.5, 1.5), (1, 1, 1)])
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_what_depends_on_the_tensor_alone_has_its_derivative(spectrum, mode):
    axes = turns(1, seed=5)[0]
    full = jnp.asarray(axes @ np.diag(np.asarray(spectrum, float)) @ axes.T)
    jacobian = np.asarray(mode(whole)(full)).reshape(9, 9)
    mirrored = np.eye(9).reshape(3, 3, 3, 3)
    exact = (mirrored + mirrored.transpose(1, 0, 2, 3)).reshape(9, 9) / 2
    np.testing.assert_allclose(jacobian, exact, atol=2e-15)


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_symmetric_functions_of_equal_moments(mode):
    # det and tr(I^2) are smooth functions of the tensor; their derivatives through the moments
    # must be the cofactor matrix and 2 I, also where moments coincide
    for full in (jnp.eye(3) * 2.0, jnp.diag(jnp.asarray([1.0, 1.0, 1.5])), jnp.asarray(whole0())):
        det = mode(lambda t: jnp.prod(Inertia.from_tensor(t).moments))(full)
        np.testing.assert_allclose(
            det, np.linalg.det(full) * np.linalg.inv(full), rtol=1e-13, atol=1e-14
        )
        square = mode(lambda t: jnp.sum(Inertia.from_tensor(t).moments ** 2))(full)
        np.testing.assert_allclose(square, 2 * full, rtol=1e-13, atol=1e-14)


def whole0():
    axes = turns(1, seed=6)[0]
    return axes @ np.diag([1.0, 1.4, 2.0]) @ axes.T


def test_derivative_of_separate_moments_against_fifty_digits():
    full = whole0()
    jacobian = np.asarray(jax.jacfwd(lambda t: principal(t)[0])(jnp.asarray(full)))
    with mpmath.workdps(50):
        step = mpmath.mpf(10) ** -20
        for i, j in ((0, 0), (1, 2), (0, 2)):
            change = mpmath.zeros(3)
            change[i, j] += step / 2
            change[j, i] += step / 2
            base = mpmath.matrix(full.tolist())
            high = mpmath.eigsy(base + change, eigvals_only=True)
            low = mpmath.eigsy(base - change, eigvals_only=True)
            for k in range(3):
                exact = float((high[k] - low[k]) / (2 * step))
                assert abs(jacobian[k, i, j] - exact) < 1e-14


def test_second_moments_and_back():
    full = jnp.asarray(whole0())
    np.testing.assert_allclose(
        inertia_of_second_moments(second_moments(full)), full, rtol=1e-15, atol=1e-15
    )
    np.testing.assert_allclose(
        second_moments(full), np.trace(full) / 2 * np.eye(3) - full, atol=1e-15
    )


def test_lists_are_tensors_and_others_are_named():
    tensor = [[2, 0, 0], [0, 2, 0], [0, 0, 3]]
    array = jnp.array(tensor, float)
    for function in (
        inertia.principal,
        inertia.second_moments,
        inertia.inertia_of_second_moments,
        inertia.physical_margin,
        inertia.is_physical,
        inertia.inertia_to_log_cholesky,
    ):
        got, want = jax.tree.leaves(function(tensor)), jax.tree.leaves(function(array))
        for x, y in zip(got, want, strict=True):
            np.testing.assert_array_equal(x, y)
        with pytest.raises(ValueError, match=r"must have shape \(\.\.\., 3, 3\)"):
            function([1, 2, 3])
    np.testing.assert_array_equal(inertia.inertia_from_log_cholesky([0] * 6), 2 * jnp.eye(3))
