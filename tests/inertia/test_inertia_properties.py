"""Properties of inertias of random point clouds, over six decades of size."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import polhode as ph
from polhode.inertia import principal

COUNT = 5
coordinates = st.tuples(*[st.integers(-4, 4)] * (3 * COUNT)).map(
    lambda x: np.array(x, float).reshape(COUNT, 3)
)


def spread(points):
    """Whether the points span a volume, so that no moment is zero and no body is flat."""
    return np.linalg.matrix_rank(points - points.mean(axis=0)) == 3


clouds = st.tuples(
    coordinates.filter(spread), st.tuples(*[st.integers(1, 4)] * COUNT), st.floats(-3, 3)
)
quaternions = st.tuples(*[st.integers(-3, 3)] * 4).filter(any)
DTYPES = pytest.mark.parametrize("dtype", [np.float64, np.float32], ids=["float64", "float32"])


def drawn(cloud, dtype):
    points, masses, decade = cloud
    return jnp.asarray(masses, dtype), jnp.asarray(points * 10.0**decade, dtype)


@jax.jit
def tensors(masses, points, wxyz, shift):
    """Tensors of a cloud, of the shifted and of the rotated cloud, and the expected tensors."""
    rows = jnp.broadcast_to(wxyz, (COUNT, 4))
    body = ph.MassProperties.from_points(masses, points)
    moved = ph.MassProperties.from_points(masses, points + shift[None])
    rotated = ph.MassProperties.from_points(masses, ph.rotation.rotate(rows, points))
    matrix = ph.rotation.wxyz_to_matrix(wxyz)
    about = ph.Inertia.from_points(masses, points).tensor
    return {
        "centre of the moved body": (moved.centre, body.centre + shift),
        "tensor of the moved body": (moved.central.tensor, body.central.tensor),
        "tensor of the rotated body": (
            rotated.central.tensor,
            matrix @ body.central.tensor @ matrix.T,
        ),
        "turned": (body.central.turned(wxyz).tensor, rotated.central.tensor),
        "parallel axis": (
            about,
            body.central.tensor
            + body.mass
            * (
                body.centre @ body.centre * jnp.eye(3, dtype=masses.dtype)
                - jnp.outer(body.centre, body.centre)
            ),
        ),
        "about": (body.about(jnp.zeros(3, masses.dtype)).tensor, about),
        "principal moments": (
            rotated.central.to_principal()[0].moments,
            body.central.to_principal()[0].moments,
        ),
    }, body.central.is_possible


@DTYPES
@settings(max_examples=60, deadline=None)
@given(clouds, quaternions, st.tuples(*[st.integers(-2, 2)] * 3))
def test_clouds_of_points(dtype, cloud, wxyz, shift):
    """Parallel axes, rotation covariance and the triangle inequality."""
    masses, points = drawn(cloud, dtype)
    size = 10.0 ** cloud[2]
    wxyz = ph.rotation.normalise(jnp.asarray(wxyz, dtype))
    pairs, is_possible = tensors(masses, points, wxyz, jnp.asarray(shift, dtype) * dtype(size))
    assert bool(is_possible)
    for name, (found, true) in pairs.items():
        scale = size * (10 if "centre" in name else 2000 * size)  # |x| < 10, m x^2 < 2000
        bound = 8 * np.finfo(dtype).eps * scale
        np.testing.assert_allclose(found, true, rtol=0, atol=bound, err_msg=name)
    a, b, c = np.asarray(pairs["principal moments"][1], float)
    assert a <= b <= c
    assert a + b >= c * (1 - 32 * np.finfo(dtype).eps)
    tensor = np.asarray(pairs["parallel axis"][0], float)
    np.testing.assert_array_equal(tensor, tensor.T)


FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])


@jax.jit
def tetrahedra(corners, wxyz, density):
    """Tetrahedra of density one, of another density, and rotated; five points with the same second
    moments.
    """
    one = ph.MassProperties.from_mesh(corners, FACES, density=1.0)
    dense = ph.MassProperties.from_mesh(corners, FACES, density=density)
    turned = ph.rotation.rotate(jnp.broadcast_to(wxyz, (4, 4)), corners)
    rotated = ph.MassProperties.from_mesh(turned, FACES, density=1.0)
    points = jnp.concatenate([corners, jnp.mean(corners, axis=0, keepdims=True)])
    masses = jnp.array([0.05] * 4 + [0.8]) * one.mass
    return one, dense, rotated, ph.MassProperties.from_points(masses, points)


@settings(max_examples=40, deadline=None)
@given(clouds, quaternions, st.floats(-3, 3))
def test_density_scales_mass_and_inertia(cloud, wxyz, decade):
    """Both are proportional to the density of a tetrahedron, and rotate as points do."""
    corners = cloud[0][:4]
    volume = np.linalg.det(corners[1:] - corners[0]) / 6
    if abs(volume) < 0.01:
        corners, volume = np.eye(4, 3), -1 / 6
    corners = corners if volume > 0 else corners[[1, 0, 2, 3]]
    wxyz = ph.rotation.normalise(jnp.array(wxyz, float))
    one, dense, rotated, points = tetrahedra(corners, wxyz, 10.0**decade)
    tensor = one.central.tensor
    close = {"rtol": 0, "atol": 1e-11 * float(jnp.max(tensor))}
    np.testing.assert_allclose(one.mass, abs(volume), rtol=1e-12)
    np.testing.assert_allclose(one.centre, corners.mean(axis=0), atol=1e-12)
    np.testing.assert_allclose(dense.mass, one.mass * 10.0**decade, rtol=1e-14)
    np.testing.assert_allclose(dense.central.tensor / 10.0**decade, tensor, **close)
    np.testing.assert_allclose(points.central.tensor, tensor, **close)
    np.testing.assert_allclose(rotated.central.tensor, one.central.turned(wxyz).tensor, **close)


@settings(max_examples=60, deadline=None)
@given(st.tuples(*[st.floats(-3, 3)] * 3), quaternions)
def test_moments_of_second_moments(decades, wxyz):
    """Non-negative second moments, from needles to plates, belong to a body; others do not."""
    second = 10.0 ** np.array(decades)
    moments = second.sum() - second
    body = ph.Inertia.from_moments(moments)
    assert bool(body.is_possible)
    wxyz = ph.rotation.normalise(jnp.array(wxyz, float))
    back, axes = body.turned(wxyz).to_principal()
    np.testing.assert_allclose(
        np.sort(moments), back.moments, rtol=1e-13, atol=1e-14 * moments.max()
    )
    again = back.turned(axes).tensor
    want = body.turned(wxyz).tensor
    np.testing.assert_allclose(again, want, rtol=0, atol=1e-14 * moments.max())
    impossible = np.array([moments[0], moments[1], 1.01 * (moments[0] + moments[1])])
    with pytest.raises(ValueError, match="triangle inequality"):
        ph.Inertia.from_moments(impossible)


def test_principal_axes_half_a_turn_from_those_of_the_body():
    """The scalar part of the quaternion is zero up to rounding; alone and in a batch."""
    moments = np.array([11.0, 18.7827941003892276, 27.7827941003892276])
    axes = np.random.default_rng(5).integers(-3, 4, (400, 3))
    axes = np.concatenate([[[1.0, -3.0, 0.0]], axes[np.any(axes != 0, axis=1)]])
    real = np.where(np.arange(len(axes)) == 0, -2.0, 0.0)  # the first needs -2 for half a turn
    quaternions = ph.rotation.normalise(jnp.asarray(np.column_stack([real, axes])))
    tensors = ph.Inertia.from_moments(moments).turned(quaternions).full
    np.testing.assert_allclose(principal(tensors)[0], np.tile(moments, (len(axes), 1)), rtol=1e-12)
    one = jax.jit(principal)
    for tensor in [tensors[0], *tensors[1:60]]:
        values, wxyz, _ = one(tensor)
        np.testing.assert_allclose(values, moments, rtol=1e-12)
        rotation = ph.rotation.wxyz_to_matrix(wxyz)
        np.testing.assert_allclose(rotation @ np.diag(moments) @ rotation.T, tensor, atol=1e-11)
