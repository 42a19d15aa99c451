"""Group axioms, batch shapes, dtypes, smoothness across thresholds and half turns."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode.rotation as rotation
from polhode.rotation import _quaternion
from polhode.rotation._conversions import shadow

SHAPE = (3, 1, 2, 1)


def _samples(shape, seed, dtype=np.float64):
    """Unit quaternions: random ones, some close to the identity or to a half turn."""
    rng = np.random.default_rng(seed)
    angles = rng.choice([0.0, 1e-9, 1e-3, 1.0, 2.5, np.pi - 1e-9, np.pi], (*shape, 1))
    axes = rng.normal(size=(*shape, 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    wxyz = np.concatenate([np.cos(angles / 2), np.sin(angles / 2) * axes], axis=-1)
    return jnp.asarray(wxyz, dtype)


@pytest.mark.parametrize("dtype", [np.float64, np.float32], ids=["float64", "float32"])
def test_group_axioms_for_awkward_batches(dtype):
    close = {"rtol": 0, "atol": 8 * np.finfo(dtype).eps}
    a, b, c = (_samples(SHAPE, seed, dtype) for seed in range(3))
    vector = jnp.asarray(np.random.default_rng(9).uniform(-1, 1, (*SHAPE, 3)), dtype)
    one = rotation.identity(SHAPE, dtype)
    multiply, rotate, matrix = rotation.multiply, rotation.rotate, rotation.wxyz_to_matrix

    @jax.jit
    def sides(a, b, c, vector):
        column = vector[..., None]
        return [
            (multiply(multiply(a, b), c), multiply(a, multiply(b, c))),
            (multiply(a, one), a),
            (multiply(one, a), a),
            (multiply(a, rotation.conjugate(a)), one),
            (multiply(rotation.conjugate(a), a), one),
            (rotate(multiply(a, b), vector), rotate(a, rotate(b, vector))),
            (rotate(a, vector)[..., None], matrix(a) @ column),
            (matrix(multiply(a, b)), matrix(a) @ matrix(b)),
            (matrix(rotation.conjugate(a)), jnp.swapaxes(matrix(a), -1, -2)),
            (
                matrix(a) @ jnp.swapaxes(matrix(a), -1, -2),
                jnp.broadcast_to(jnp.eye(3, dtype=dtype), (*SHAPE, 3, 3)),
            ),
            (jnp.linalg.det(matrix(a)), jnp.ones(SHAPE, dtype)),
            (multiply(a, rotation.between(a, b)), b),
            (jnp.sum(rotation.normalise(dtype(1e-30) * a) ** 2, axis=-1), jnp.ones(SHAPE, dtype)),
        ]

    for number, (left, right) in enumerate(sides(a, b, c, vector)):
        assert left.dtype == dtype
        assert left.shape == right.shape
        np.testing.assert_allclose(left, right, **close, err_msg=f"axiom {number}")


@pytest.mark.parametrize("dtype", [np.float64, np.float32], ids=["float64", "float32"])
def test_round_trips_keep_shape_and_dtype(dtype):
    wxyz = rotation.canonical(_samples(SHAPE, 4, dtype))

    @jax.jit
    def run(wxyz):
        axis, angle = rotation.wxyz_to_axis_angle(wxyz)
        vector = rotation.wxyz_to_rotation_vector(wxyz)
        parameters = rotation.wxyz_to_modified_rodrigues(wxyz)
        matrix = rotation.wxyz_to_matrix(wxyz)
        through = [
            rotation.axis_angle_to_wxyz(axis, angle),
            rotation.rotation_vector_to_wxyz(vector),
            rotation.modified_rodrigues_to_wxyz(parameters),
            rotation.matrix_to_wxyz(matrix),
        ]
        angles = [
            rotation.wxyz_to_euler(wxyz),
            rotation.matrix_to_euler(matrix),
            rotation.rotation_vector_to_euler(vector),
            rotation.axis_angle_to_euler(axis, angle),
            rotation.modified_rodrigues_to_euler(parameters),
        ]
        axis, angle = rotation.euler_to_axis_angle(*angles[0])
        through += [rotation.euler_to_wxyz(*triple) for triple in angles]
        through += [
            rotation.axis_angle_to_wxyz(axis, angle),
            rotation.matrix_to_wxyz(rotation.euler_to_matrix(*angles[0])),
            rotation.rotation_vector_to_wxyz(rotation.euler_to_rotation_vector(*angles[0])),
            rotation.modified_rodrigues_to_wxyz(rotation.euler_to_modified_rodrigues(*angles[0])),
        ]
        return through

    for number, back in enumerate(run(wxyz)):
        assert back.dtype == dtype
        assert back.shape == (*SHAPE, 4)
        turned = np.asarray(rotation.angle_between(wxyz, back))
        assert turned.max() < 16 * np.finfo(dtype).eps, number


def test_shadow_set_is_the_other_description_of_the_same_rotation():
    wxyz = rotation.canonical(_samples((40,), 5))[1:]
    wxyz = wxyz[rotation.angle_between(wxyz, rotation.identity((1,))) > 0]
    inner, outer = rotation.wxyz_to_modified_rodrigues(wxyz), rotation.wxyz_to_shadow(wxyz)
    np.testing.assert_allclose(shadow(inner), outer, rtol=1e-14)
    np.testing.assert_allclose(shadow(outer), inner, rtol=1e-14)
    assert jnp.all(jnp.sum(inner**2, -1) <= 1 + 1e-15)
    assert jnp.all(jnp.sum(outer**2, -1) >= 1 - 1e-15)
    back = rotation.modified_rodrigues_to_wxyz(outer)
    np.testing.assert_allclose(back, -wxyz, atol=1e-15)
    huge = rotation.modified_rodrigues_to_wxyz(jnp.asarray([1e200, 0.0, 0.0]))
    np.testing.assert_allclose(huge, [-1, 2e-200, 0, 0], rtol=1e-15)


@pytest.mark.parametrize("dtype", [np.float64, np.float32], ids=["float64", "float32"])
def test_no_jump_at_the_threshold_of_the_series(dtype):
    """(a - sin a)/a^3 switches from series to closed form at a^2 = 4 (constants: 50 digits)."""
    exact = 0.13633782164678979  # (2 - sin 2)/8
    at = dtype(4)
    below, above = np.nextafter(at, dtype(0)), at
    values = [_quaternion._cubic_ratio(jnp.asarray(x)) for x in (below, above)]
    slopes = [jax.grad(_quaternion._cubic_ratio)(jnp.asarray(x)) for x in (below, above)]
    eps = np.finfo(dtype).eps
    for value in values:
        assert abs(float(value) - exact) < 2 * eps * exact
    slope = -0.0068720944754479709
    for value in slopes:
        assert abs(float(value) - slope) < 16 * eps * abs(slope)


def test_derivatives_at_the_identity_are_right():
    """Log and exp at the identity: q = (1, v/2) to first order, w = 1 - v.v/8 to second."""
    zero = jnp.zeros(3)
    one = rotation.identity()
    exp, log = rotation.rotation_vector_to_wxyz, rotation.wxyz_to_rotation_vector
    expected = np.concatenate([np.zeros((1, 3)), np.eye(3) / 2])
    hessian = np.zeros((4, 3, 3))
    hessian[0] = -np.eye(3) / 4

    @jax.jit
    def run(zero, one):
        first = [(outer(exp)(zero), outer(log)(one)) for outer in (jax.jacfwd, jax.jacrev)]
        return first, jax.jacfwd(jax.jacrev(exp))(zero), jax.jacrev(jax.jacfwd(log))(one)

    first, of_exp, of_log = run(zero, one)
    for exp_slope, log_slope in first:
        np.testing.assert_array_equal(exp_slope, expected)
        np.testing.assert_array_equal(log_slope[:, 1:], 2 * np.eye(3))
    np.testing.assert_allclose(of_exp, hessian, atol=1e-16)
    # log(w, v) = 2 v/w + ...: mixed second derivative -2
    np.testing.assert_allclose(of_log[:, 1:, 0], -2 * np.eye(3), atol=1e-15)
    through = jax.jit(jax.jacrev(jax.jacfwd(lambda v: log(exp(v)))))(zero)
    np.testing.assert_allclose(through, np.zeros((3, 3, 3)), atol=1e-15)


@pytest.mark.parametrize("scale", [1e-18, 1e18])
def test_the_derivative_of_a_rotation_vector_follows_the_scale(scale):
    """For quaternions in single precision, powers of whose length would overflow."""
    wxyz = jnp.array([0.1, -0.5, 0.3, 0.8], jnp.float32)
    slopes = jax.jit(jax.jacfwd(rotation.wxyz_to_rotation_vector))
    np.testing.assert_allclose(scale * slopes(scale * wxyz), slopes(wxyz), rtol=2e-6)


def test_an_euler_angle_gradient_is_smooth_at_no_rotation():
    """From ZYZ angles at theta = 0 to the rotation vector and to a scalar: right, and not NaN."""
    jacobian = jax.jacrev(rotation.euler_to_rotation_vector, argnums=(0, 1, 2))
    columns = np.stack(jax.jit(jacobian)(0.0, 0.0, 0.0), axis=-1)
    np.testing.assert_allclose(columns, [[0, 0, 0], [0, 1, 0], [1, 0, 1]], atol=1e-16)


def test_interchange_goes_through_named_converters():
    from scipy.spatial.transform import Rotation

    wxyz = _samples((5,), 6)
    theirs = rotation.wxyz_to_scipy(wxyz)
    assert isinstance(theirs, Rotation)
    vector = np.array([0.1, -0.2, 0.3])
    ours = rotation.rotate(wxyz, jnp.broadcast_to(vector, (5, 3)))
    np.testing.assert_allclose(theirs.apply(vector), ours, atol=1e-15)
    back = rotation.scipy_to_wxyz(theirs)
    assert rotation.angle_between(back, wxyz).max() < 1e-15
    assert rotation.scipy_to_wxyz(theirs[0], jnp.float32).dtype == jnp.float32
    np.testing.assert_array_equal(rotation.wxyz_to_xyzw(wxyz)[0], np.roll(wxyz[0], -1))
    np.testing.assert_array_equal(rotation.xyzw_to_wxyz(rotation.wxyz_to_xyzw(wxyz)), wxyz)
    with pytest.raises(TypeError, match="outside jit"):
        jax.jit(lambda q: rotation.wxyz_to_scipy(q) and q)(wxyz)


def test_the_angle_between_quaternions_of_any_size():
    tiny = [[1e-200, 0, 0, 0], [0, 1e-200, 0, 0]]
    np.testing.assert_allclose(rotation.angle_between(*tiny), np.pi, rtol=1e-15)
    with pytest.raises(ValueError, match=r"start \(2, 4\), end \(3, 4\)"):
        rotation.angle_between(np.ones((2, 4)), np.ones((3, 4)))
