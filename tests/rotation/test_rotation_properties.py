"""Properties of rotations over six decades of angle and near the singular attitudes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from polhode import rotation
from polhode.rotation import Sequence

# distances of 1e-6 to 1, of either sign, from no rotation, a right angle and half a turn
distances = st.builds(
    lambda decade, sign: sign * 10.0**decade, st.floats(-6, 0), st.sampled_from([-1.0, 1.0])
)
angles = st.builds(lambda at, off: at + off, st.sampled_from([0.0, np.pi / 2, np.pi]), distances)
angles = angles | st.sampled_from([0.0, np.pi / 2, np.pi])
axes = st.tuples(*[st.integers(-3, 3)] * 3).filter(any)
rotations = st.tuples(axes, angles)
DTYPES = pytest.mark.parametrize("dtype", [np.float64, np.float32], ids=["float64", "float32"])
SEQUENCES = (Sequence.ZYZ, Sequence.ZYX, Sequence.XYZ_SPACE)


def quaternion(drawn, dtype):
    axis, angle = np.array(drawn[0], float), drawn[1]
    axis = axis / np.linalg.norm(axis)
    return jnp.asarray([np.cos(angle / 2), *(np.sin(angle / 2) * axis)], dtype)


@jax.jit
def group(a, b, vector):
    """Pairs of expressions that must be equal."""
    multiply, rotate, matrix = rotation.multiply, rotation.rotate, rotation.wxyz_to_matrix
    one = rotation.identity((), a.dtype)
    return (
        (multiply(multiply(a, b), rotation.conjugate(b)), a),
        (multiply(rotation.conjugate(a), a), one),
        (
            rotation.conjugate(multiply(a, b)),
            multiply(rotation.conjugate(b), rotation.conjugate(a)),
        ),
        (rotate(multiply(a, b), vector), rotate(a, rotate(b, vector))),
        (rotate(rotation.conjugate(a), rotate(a, vector)), vector),
        (matrix(multiply(a, b)) @ vector, matrix(a) @ (matrix(b) @ vector)),
        (multiply(a, rotation.between(a, b)), b),
    )


@DTYPES
@settings(max_examples=60, deadline=None)
@given(rotations, rotations, axes)
def test_composition_and_inverse(dtype, first, second, vector):
    vector = np.array(vector, float) / np.linalg.norm(vector)
    a, b = quaternion(first, dtype), quaternion(second, dtype)
    for number, (left, right) in enumerate(group(a, b, jnp.asarray(vector, dtype))):
        np.testing.assert_allclose(
            left, right, rtol=0, atol=8 * np.finfo(dtype).eps, err_msg=number
        )


@jax.jit
def round_trips(wxyz):
    """The attitude converted to every representation and back."""
    back = [
        rotation.axis_angle_to_wxyz(*rotation.wxyz_to_axis_angle(wxyz)),
        rotation.rotation_vector_to_wxyz(rotation.wxyz_to_rotation_vector(wxyz)),
        rotation.modified_rodrigues_to_wxyz(rotation.wxyz_to_modified_rodrigues(wxyz)),
        rotation.matrix_to_wxyz(rotation.wxyz_to_matrix(wxyz)),
        rotation.xyzw_to_wxyz(rotation.wxyz_to_xyzw(wxyz)),
    ]
    for sequence in SEQUENCES:
        back.append(rotation.euler_to_wxyz(*rotation.wxyz_to_euler(wxyz, sequence), sequence))
    return jnp.stack(back)


@DTYPES
@settings(max_examples=60, deadline=None)
@given(rotations)
def test_conversions_and_back(dtype, drawn):
    wxyz = rotation.normalise(quaternion(drawn, dtype))
    back = round_trips(wxyz)
    assert back.dtype == dtype
    apart = np.asarray(rotation.angle_between(jnp.broadcast_to(wxyz, back.shape), back))
    assert apart.max() < 16 * np.finfo(dtype).eps, apart


@jax.jit
def vector_and_back(vector):
    return rotation.wxyz_to_rotation_vector(rotation.rotation_vector_to_wxyz(vector))


@DTYPES
@settings(max_examples=60, deadline=None)
@given(axes, st.floats(-6, 0))
def test_small_rotation_vectors_keep_their_relative_accuracy(dtype, axis, decade):
    vector = jnp.asarray(np.array(axis) / np.linalg.norm(axis) * 10.0**decade, dtype)
    off = np.linalg.norm(np.asarray(vector_and_back(vector), float) - np.asarray(vector, float))
    assert off < 8 * np.finfo(dtype).eps * np.linalg.norm(vector)
