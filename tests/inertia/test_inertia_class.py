"""The Inertia class: constructors, the two forms of the tensor, input checks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st

from polhode import GravityGradient, Scene
from polhode.inertia import (
    Inertia,
    MassProperties,
    Symmetry,
    inertia_of_second_moments,
    physical_margin,
    second_moments,
)
from polhode.rotation import normalise

DTYPES = [jnp.float32, jnp.float64]
TENSOR = [[1.008, 0.039, 0.22], [0.039, 1.211, 0.234], [0.22, 0.234, 0.793]]


@pytest.mark.parametrize("dtype", DTYPES)
def test_dtype_follows_arrays_and_lists_take_the_default(dtype):
    assert Inertia.from_moments(jnp.asarray([1, 2, 2.5], dtype)).dtype == dtype
    assert Inertia.from_tensor(jnp.asarray(TENSOR, dtype)).moments.dtype == dtype
    assert Inertia.from_moments([1, 2, 3]).dtype == jnp.result_type(float)
    assert Inertia.from_moments(jnp.asarray([1, 2, 3])).dtype == jnp.result_type(float)
    assert Inertia.axisymmetric(jnp.asarray(1, dtype), 1.5).dtype == dtype
    assert Inertia.from_box(1, jnp.asarray([1, 2, 3], dtype)).dtype == dtype


def test_leaves_are_only_the_numbers_and_structure_is_static():
    top = Inertia.axisymmetric([1.0, 2.0], 1.5)
    assert [leaf.shape for leaf in jax.tree.leaves(top)] == [(2,), (2,)]
    assert [leaf.shape for leaf in jax.tree.leaves(Inertia.spherical([2.0, 3.0]))] == [(2,)]
    assert top.symmetry is Symmetry.AXISYMMETRIC
    assert Inertia.spherical(2.0).symmetry is Symmetry.SPHERICAL
    assert Inertia.from_moments([1.0, 1.0, 1.0]).symmetry is Symmetry.NONE
    assert top.is_principal
    assert not Inertia.from_tensor(TENSOR).is_principal
    assert Inertia.from_tensor(TENSOR).batch_shape == ()
    assert Inertia.from_moments(np.ones((4, 1, 3))).batch_shape == (4, 1)


def test_exactly_one_form():
    with pytest.raises(ValueError, match="not both and not neither"):
        Inertia()
    with pytest.raises(ValueError, match="not both and not neither"):
        Inertia(jnp.ones(3), jnp.eye(3))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("batch", [(), (5,), (3, 1, 2, 1)])
def test_momentum_and_rates_are_inverse_matrix_products(dtype, batch):
    rng = np.random.default_rng(1)
    eps = jnp.finfo(dtype).eps
    tensor = np.asarray(TENSOR) * rng.uniform(1e-9, 1e9, (*batch, 1, 1))
    omega = rng.normal(size=(2, 1, *batch, 3)).astype(dtype)
    inertia = Inertia.from_tensor(jnp.asarray(tensor, dtype))
    momentum = inertia.momentum(jnp.asarray(omega))
    exact = np.einsum("...ij,...j->...i", np.asarray(inertia.full, np.float64), omega)
    scale = np.abs(exact).max(axis=-1, keepdims=True)
    assert momentum.shape == (2, 1, *batch, 3)
    assert np.all(np.abs(np.asarray(momentum) - exact) <= 4 * eps * scale)
    assert np.max(np.abs(np.asarray(inertia.rates(momentum)) - omega)) < 30 * eps
    diagonal = Inertia.from_moments(jnp.asarray([1, 2, 2.5], dtype))
    np.testing.assert_allclose(diagonal.momentum(omega), omega * np.asarray([1, 2, 2.5], dtype))
    np.testing.assert_allclose(diagonal.rates(diagonal.momentum(omega)), omega, rtol=float(2 * eps))


def test_ill_conditioned_tensor_is_solved_backward_stably():
    # a needle of aspect 1e6, turned: cond(I) = 6e11; the residual, not the error, stays small
    needle = MassProperties.from_rod(1.0, 2.0, 1e-6).moved(wxyz=[0.3, 0.2, -0.7, 0.5]).central
    momentum = jnp.asarray([0.3, -0.5, 0.7])
    residual = needle.momentum(needle.rates(momentum)) - momentum
    size = float(jnp.max(jnp.abs(needle.tensor)) * jnp.max(jnp.abs(needle.rates(momentum))))
    assert float(jnp.max(jnp.abs(residual))) < 8 * jnp.finfo(jnp.float64).eps * size


def test_turned_and_principal_axes_agree():
    body = Inertia.from_moments([1.0, 1.7, 2.1])
    turn = normalise(jnp.asarray([[0.3, -0.2, 0.8, 0.1], [-0.1, 0.0, 1e-3, 2.0]]))
    turned = body.turned(turn)
    np.testing.assert_allclose(turned.moments, np.tile([1.0, 1.7, 2.1], (2, 1)), rtol=1e-14)
    principal, axes = turned.to_principal()
    np.testing.assert_allclose(principal.turned(axes).tensor, turned.tensor, atol=1e-14)
    same, none = body.to_principal()
    assert same is body
    np.testing.assert_array_equal(none, [1, 0, 0, 0])
    assert body.axes is None
    np.testing.assert_allclose(turned.axes, axes)


def test_log_cholesky_round_trip_and_scale_direction():
    rng = np.random.default_rng(2)
    parameters = rng.normal(size=(1000, 6)) * 2
    inertia = Inertia.from_log_cholesky(parameters)
    assert bool(jnp.all(physical_margin(inertia.tensor) > -1e-12 * inertia.tensor[..., 0, 0]))
    well = rng.normal(size=(1000, 6)) * 0.3
    back = Inertia.from_log_cholesky(well).to_log_cholesky()
    np.testing.assert_allclose(back, well, atol=1e-13)
    scaled = well + np.asarray([0.7, 0.7, 0.7, 0, 0, 0])
    np.testing.assert_allclose(
        Inertia.from_log_cholesky(scaled).tensor,
        np.exp(1.4) * Inertia.from_log_cholesky(well).tensor,
        rtol=1e-13,
        atol=1e-14,
    )


@pytest.mark.parametrize("dtype", DTYPES)
def test_flat_bodies_pass_and_impossible_ones_do_not(dtype):
    slack = float(jnp.sqrt(jnp.finfo(dtype).eps))
    Inertia.from_moments(jnp.asarray([1, 2, 3], dtype))
    Inertia.from_moments(jnp.asarray([1, 1, 2 + slack], dtype))
    with pytest.raises(ValueError, match="triangle inequality"):
        Inertia.from_moments(jnp.asarray([1, 1, 2 + 4 * slack], dtype))
    Inertia.from_moments(jnp.asarray([1e-20, 1, 1], dtype))
    # scale must not matter
    with pytest.raises(ValueError, match="triangle inequality"):
        Inertia.from_moments(jnp.asarray([1, 1, 2 + 4 * slack], dtype) * 1e-12)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: Inertia.from_moments([1, 2]), ValueError, r"shape \(\.\.\., 3\)"),
        (lambda: Inertia.from_moments([1, 2, 4]), ValueError, "triangle inequality"),
        (lambda: Inertia.from_moments([1, 1, 0]), ValueError, "must be positive"),
        (lambda: Inertia.from_moments([1, 1, -1]), ValueError, "must be positive"),
        (lambda: Inertia.from_moments([1, 1, np.nan]), ValueError, "NaN"),
        (lambda: Inertia.from_moments([1, 1, np.inf]), ValueError, "infinity"),
        (lambda: Inertia.from_moments("abc"), TypeError, "real numbers"),
        (lambda: Inertia.from_moments([1j, 1, 1]), TypeError, "real"),
        (lambda: Inertia.from_moments([[1, 1, 1], [1, 1, 3]]), ValueError, r"\[1\. 1\. 3\.\]"),
        (lambda: Inertia.axisymmetric(1, 3), ValueError, "triangle inequality"),
        (lambda: Inertia.axisymmetric([1, 1], [1, 1, 1]), ValueError, "broadcast"),
        (lambda: Inertia.spherical(-1), ValueError, "must be positive"),
        (lambda: Inertia.from_tensor(np.eye(2)), ValueError, "shape"),
        (lambda: Inertia.from_tensor(np.diag([1, 1, 3.0])), ValueError, "triangle"),
        (lambda: Inertia.from_tensor(np.diag([1, 1, 0.0])), ValueError, "positive"),
        (lambda: Inertia.from_tensor(np.triu(np.ones((3, 3)))), ValueError, "symmetric"),
        (lambda: Inertia.from_points([], np.zeros((0, 3))), ValueError, "at least one point"),
        (lambda: Inertia.from_points([1, -1], np.eye(3)[:2]), ValueError, "must not be negative"),
        (lambda: Inertia.from_points([0, 0], np.eye(3)[:2]), ValueError, "sum of the masses"),
        (lambda: Inertia.from_points([1, 1], np.eye(3)), ValueError, "one n"),
        (
            lambda: Inertia.from_points([1, 2, 3], [[1, 2, 3], [0.1, 0.2, 0.3], [-3, -6, -9]]),
            ValueError,
            "thin line",
        ),
        (lambda: Inertia.from_log_cholesky(np.zeros(5)), ValueError, "shape"),
    ],
)
def test_bad_input_is_refused_with_the_reason(call, error, message):
    with pytest.raises(error, match=message):
        call()


def test_no_value_checks_while_tracing_and_gradients_flow():
    def energy(moments, omega):
        return jnp.sum(Inertia.from_moments(moments).momentum(omega) * omega) / 2

    moments, omega = jnp.asarray([[1.0, 2, 2.5], [1, 1, 1]]), jnp.asarray([[1.0, 2, 3], [4, 5, 6]])
    gradient = jax.jit(jax.vmap(jax.grad(energy)))(moments, omega)
    np.testing.assert_allclose(gradient, omega**2 / 2)
    gradient = jax.grad(lambda t: Inertia.from_tensor(t).momentum(omega[0])[0])(jnp.eye(3))
    np.testing.assert_allclose(gradient, [[1, 1, 1.5], [1, 0, 0], [1.5, 0, 0]])


def attempt(build):
    try:
        return build(), "a body of finite, positive moments"
    except (ValueError, TypeError) as error:
        return None, str(error)


numbers = st.floats(width=32) | st.integers(-3, 3) | st.none() | st.text(max_size=2)
garbage = st.recursive(numbers, lambda inner: st.lists(inner, max_size=4), max_leaves=12)


TENSOR = [[1.0, 0.1, 0.2], [0.1, 2.0, -0.3], [0.2, -0.3, 2.5]]
OMEGA, WXYZ = np.array([0.4, 1.0, 0.3]), normalise(jnp.array([0.5, 0.6, 0.1, 0.3]))
GRADIENT = GravityGradient(1.0, [1.0, 0.5, 0.2])


@pytest.mark.parametrize(
    "value",
    [
        lambda body: jnp.sum(body.momentum(OMEGA) * jnp.array([1.0, 0.3, 2.0])),
        lambda body: jnp.sum(body.rates(OMEGA) * jnp.array([1.0, 0.3, 2.0])),
        lambda body: jnp.sum(Scene(body).acceleration(None, jnp.asarray(OMEGA), 0.0) ** 3),
        lambda body: jnp.sum(Scene(body, GRADIENT).acceleration(WXYZ, jnp.asarray(OMEGA), 0.0)),
        lambda body: physical_margin(body.full),
        lambda body: jnp.sum(inertia_of_second_moments(second_moments(body.full) ** 2) ** 2),
    ],
    ids=["momentum", "rates", "free", "gravity gradient", "margin", "second moments"],
)
def test_a_step_along_a_gradient_keeps_the_tensor_symmetric(value):
    body = Inertia.from_tensor(TENSOR)
    gradient = np.asarray(jax.grad(value)(body).full)
    np.testing.assert_allclose(gradient, gradient.T, atol=1e-14)
    assert np.abs(gradient[np.triu_indices(3, 1)]).min() > 0
    for i, j in ((0, 1), (2, 2)):  # a symmetric change, against differences
        change = np.zeros((3, 3))
        change[i, j] = change[j, i] = 1e-6
        ends = (value(Inertia(full=jnp.asarray(TENSOR) + sign * change)) for sign in (1, -1))
        np.testing.assert_allclose(np.sum(gradient * change), np.subtract(*ends) / 2, rtol=1e-6)
    after = Inertia(full=body.full - 0.01 * gradient, physical=True)
    assert bool(after.is_possible)


@settings(max_examples=150, deadline=None)
@given(garbage, garbage)
@example([1.0, 1.5, 2.0], 1.0)  # what constructors accept
def test_garbage_gives_a_clear_error_or_a_physical_body(first, second):
    builders = (
        lambda: Inertia.from_moments(first),
        lambda: Inertia.from_tensor(first),
        lambda: Inertia.spherical(first),
        lambda: Inertia.axisymmetric(first, second),
        lambda: Inertia.from_points(first, second),
        lambda: Inertia.from_box(first, second),
    )
    for build in builders:
        body, message = attempt(build)
        assert len(message) > 20
        if body is not None:
            seen = np.asarray(body.tensor, np.float64)
            assert np.isfinite(seen).all()
            assert np.linalg.eigvalsh(seen).min(initial=0) >= 0
