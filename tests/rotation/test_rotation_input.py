"""Invalid rotations are rejected if they are not traced, and never read as other rotations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode import rotation
from polhode.rotation import Sequence

OF_QUATERNION = [
    rotation.normalise,
    rotation.wxyz_to_matrix,
    rotation.wxyz_to_euler,
    rotation.wxyz_to_rotation_vector,
    rotation.wxyz_to_axis_angle,
    rotation.wxyz_to_shadow,
    rotation.wxyz_to_modified_rodrigues,
    rotation.wxyz_to_scipy,
    lambda q: rotation.rotate(q, [1.0, 2.0, 3.0]),
    lambda q: rotation.angle_between(q, [1, 0, 0, 0]),
]


@pytest.mark.parametrize("take", OF_QUATERNION)
def test_quaternions_that_are_none(take):
    with pytest.raises(ValueError, match="must not be zero"):
        take(np.zeros(4))
    with pytest.raises(ValueError, match="must not be zero"):
        take(jnp.array([[1.0, 0, 0, 0], [0, 0, 0, 0]]))
    for odd in ([1.0, 0, 0], np.ones((4, 3)), 1.0):
        with pytest.raises(ValueError, match=r"shape \(\.\.\., 4\)"):
            take(odd)
    for odd in ("abcd", None, [1j, 0, 0, 0], [True, False, False, False]):
        with pytest.raises(TypeError, match="real numbers"):
            take(odd)
    take([1, 0, 0, 0])


def test_half_precision_is_looked_at_as_any_other():
    for dtype in (jnp.float16, jnp.bfloat16):
        assert rotation.normalise(jnp.array([2, 0, 0, 0], dtype)).dtype == dtype
        with pytest.raises(ValueError, match="must not be zero"):
            rotation.normalise(jnp.zeros(4, dtype))


@pytest.mark.parametrize(
    ("take", "word"),
    [
        (lambda: rotation.rotate([2.0, 0, 0, 0], [1.0, 2, 3]), "unit length.*normalise"),
        (lambda: rotation.wxyz_to_matrix([0.0, 0.5, 0, 0]), "unit length, got length 0.5"),
        (lambda: rotation.axis_angle_to_wxyz([0.0, 0, 2], 1.0), "divide the axis by its length"),
        (lambda: rotation.axis_angle_to_wxyz([0.0, 0, 0], 1.0), "must not be zero"),
        (
            lambda: rotation.rotate([1.0, 0, 0, 0], [1.0, 2]),
            r"vector must have shape \(\.\.\., 3\)",
        ),
        (lambda: rotation.euler_to_wxyz(np.ones(2), np.ones(3), 0.1), "broadcast together"),
        (
            lambda: rotation.rotate(np.ones((3, 4)) / 2, np.ones((2, 3))),
            r"broadcast together, got wxyz \(3, 4\), vector \(2, 3\)",
        ),
        (lambda: rotation.multiply(np.ones((3, 4)), np.ones((2, 4))), r"left \(3, 4\), right"),
        (
            lambda: rotation.axis_angle_to_wxyz(np.eye(3)[:2], np.ones(3)),
            r"axis \(2, 3\), angle \(3,\)",
        ),
    ],
)
def test_wrong_lengths_and_shapes(take, word):
    with pytest.raises(ValueError, match=word):
        take()


@pytest.mark.parametrize(
    "matrix",
    [
        np.diag([1.0, 1, -1]),
        -np.eye(3),
        2 * np.eye(3),
        np.zeros((3, 3)),
        np.ones((3, 3)),
        np.diag([1.0, 1, 1.01]),
        np.eye(3)[[1, 0, 2]],
        np.diag([1.0, 0, 0]),
    ],
)
def test_matrices_that_are_no_rotations(matrix):
    for take in (rotation.matrix_to_wxyz, rotation.matrix_to_euler):
        with pytest.raises(ValueError, match=r"determinant \+1"):
            take(matrix)
        with pytest.raises(ValueError, match=r"determinant \+1"):
            take(np.stack([np.eye(3), matrix]))
    traced = jax.jit(rotation.matrix_to_wxyz)(jnp.stack([jnp.eye(3), jnp.asarray(matrix)]))
    np.testing.assert_array_equal(jnp.isnan(traced).all(axis=-1), [False, True])


def test_rounded_matrices_pass():
    wxyz = rotation.normalise(np.random.default_rng(1).normal(size=(200, 4)))
    matrix = np.round(np.asarray(rotation.wxyz_to_matrix(wxyz)), 4)
    back = rotation.matrix_to_wxyz(matrix)
    assert float(jnp.max(rotation.angle_between(wxyz, back))) < 3e-4
    assert jnp.isnan(rotation.matrix_to_wxyz(np.full((3, 3), np.nan))).all()


def test_known_matrices_are_looked_at_inside_jit():
    turn, mirror = jnp.eye(3)[jnp.array([1, 2, 0])], -jnp.eye(3)
    inside = jax.jit(lambda: rotation.matrix_to_wxyz(turn))()
    np.testing.assert_allclose(inside, [0.5, -0.5, -0.5, -0.5], rtol=1e-15)
    with pytest.raises(ValueError, match=r"determinant \+1"):
        jax.jit(lambda: rotation.matrix_to_wxyz(mirror))()


def test_quaternions_whose_squares_are_no_numbers_are_seen():
    """Squares of 1e-200 underflow, those of 1e200 overflow."""
    for size in (1e-200, 1e200):
        np.testing.assert_allclose(
            rotation.normalise([size, 0, 0, size]), [0.5**0.5, 0, 0, 0.5**0.5]
        )
        with pytest.raises(ValueError, match="must be of unit length"):
            rotation.rotate([0, size, 0, 0], [1.0, 2, 3])
    with pytest.raises(ValueError, match="must not be zero"):
        rotation.normalise([[1e-200, 0, 0, 0], [0, 0, 0, 0]])
    assert np.isnan(rotation.rotate([np.nan, 0, 0, 0], [1.0, 2, 3])).all()


@pytest.mark.parametrize(
    "take", [rotation.wxyz_to_euler, rotation.wxyz_to_axis_angle, rotation.wxyz_to_rotation_vector]
)
def test_a_traced_zero_has_no_angles(take):
    assert all(jnp.isnan(x).all() for x in jax.tree.leaves(jax.jit(take)(jnp.zeros(4))))


@pytest.mark.parametrize("sequence", [Sequence.ZYX, Sequence.XYZ_SPACE, Sequence.ZYZ])
def test_euler_angles_of_a_quaternion_of_any_size(sequence):
    unit = jnp.array([0.8, 0.3, -0.2, 0.4])
    want = jnp.stack(rotation.wxyz_to_euler(unit, sequence))
    for dtype, sizes, rtol in (
        (jnp.float64, (1e-200, 1e200), 1e-14),
        (jnp.float32, (1e-20, 1e20), 1e-6),
    ):
        for size in sizes:
            got = rotation.wxyz_to_euler((size * unit).astype(dtype), sequence)
            np.testing.assert_allclose(jnp.stack(got), want, rtol=rtol)


@pytest.mark.parametrize(
    ("call", "word"),
    [
        (lambda: Sequence.of(("Z", "Y", "X")), "axes must be a string"),
        (lambda: rotation.matrix_to_wxyz(jnp.eye(3, dtype=bool)), "real numbers, got dtype bool"),
    ],
)
def test_what_holds_no_numbers_is_named(call, word):
    with pytest.raises(TypeError, match=word):
        call()


@pytest.mark.parametrize(
    ("odd", "error", "word"),
    [
        (None, TypeError, r"a ph\.rotation\.Sequence, got NoneType"),
        (3, TypeError, r"a ph\.rotation\.Sequence, got int"),
        (Sequence, TypeError, r"a ph\.rotation\.Sequence"),
        ("ZYy", ValueError, "no sequence is called 'ZYy'"),
    ],
)
def test_a_sequence_is_one(odd, error, word, unchecked):
    with pytest.raises(error, match=word):
        rotation.euler_to_wxyz(0.1, 0.2, 0.3, odd)
    with pytest.raises(error, match=word):
        rotation.wxyz_to_euler([1.0, 0, 0, 0], odd)


def test_a_sequence_is_written_in_letters_too():
    for letters, sequence in (("ZYX", Sequence.ZYX), ("zyx", Sequence.ZYX_SPACE)):
        wxyz = rotation.euler_to_wxyz(0.1, 0.2, 0.3, letters)
        np.testing.assert_array_equal(wxyz, rotation.euler_to_wxyz(0.1, 0.2, 0.3, sequence))
        angles = rotation.matrix_to_euler(rotation.wxyz_to_matrix(wxyz), letters)
        np.testing.assert_allclose(angles, [0.1, 0.2, 0.3], rtol=1e-14)


def test_a_scipy_rotation_is_named_with_its_converter(unchecked):
    from scipy.spatial.transform import Rotation

    for turn in (Rotation.identity(), Rotation.identity(2)):
        for call in (
            lambda turn: rotation.angle_between(turn, turn),
            lambda turn: ph.Pointing(1.0, 1.0, turn),
            lambda turn: ph.LVLH(ph.KeplerOrbit(1.0, 5.0)).from_frame(turn, np.zeros(3), 0.0),
        ):
            with pytest.raises(TypeError, match=r"by ph\.rotation\.scipy_to_wxyz"):
                call(turn)


def test_lists_and_integers_are_arrays():
    quarter = [0.5**0.5, 0, 0, 0.5**0.5]
    np.testing.assert_allclose(rotation.rotate(quarter, [1, 2, 3]), [-2, 1, 3], atol=1e-15)
    np.testing.assert_allclose(
        rotation.matrix_to_wxyz([[0, -1, 0], [1, 0, 0], [0, 0, 1]]), quarter, atol=1e-15
    )
    np.testing.assert_allclose(rotation.multiply([0, 1, 0, 0], [0, 0, 1, 0]), [0, 0, 0, 1])
    np.testing.assert_allclose(rotation.axis_angle_to_wxyz([0, 0, 1], np.pi / 2), quarter)
    np.testing.assert_allclose(rotation.rotation_vector_to_wxyz([0, 0, np.pi / 2]), quarter)
    several = rotation.axis_angle_to_wxyz([[[0, 0, 1]], [[0, 1, 0]]], [0, np.pi / 2, np.pi])
    assert several.shape == (2, 3, 4)
    np.testing.assert_allclose(several[0, 1], quarter)
    single = rotation.rotate(jnp.array([1, 0, 0, 0], jnp.float32), jnp.ones(3, jnp.float32))
    assert single.dtype == jnp.float32


def test_lists_follow_the_dtype_of_arrays_and_mixed_arrays_the_wider_one():
    axis, turn = jnp.array([0, 0, 1], jnp.float32), jnp.array([1, 0, 0, 0], jnp.float32)
    with jax.numpy_dtype_promotion("standard"):
        for got, dtype in (
            (rotation.axis_angle_to_wxyz([0, 0, 1], jnp.float32(0.5)), jnp.float32),
            (rotation.axis_angle_to_wxyz(axis, [0.5]), jnp.float32),
            (rotation.axis_angle_to_wxyz(axis, np.ones(2)), jnp.float64),
            (rotation.multiply([1, 0, 0, 0], turn), jnp.float32),
            (rotation.multiply(np.ones(4), turn), jnp.float64),
            (rotation.rotate(turn, [1, 2, 3]), jnp.float32),
            (rotation.between([1, 0, 0, 0], turn), jnp.float32),
            (rotation.between(turn, [1, 0, 0, 0]), jnp.float32),
            (rotation.angle_between([1, 0, 0, 0], turn), jnp.float32),
        ):
            assert got.dtype == dtype


def test_no_quaternions_are_no_rotations_of_scipy():
    assert len(rotation.wxyz_to_scipy(jnp.zeros((0, 4)))) == 0


def test_a_state_from_scipy_has_the_precision_of_its_rates(recwarn):
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec([0.1, 0.2, 0.3])
    for rates in (np.zeros(3), np.zeros(3, int), np.zeros(3, np.float32), [0, 0, 0]):
        for x64 in (True, False):
            with jax.enable_x64(x64):
                state = ph.State(turn, rates)
                assert state.wxyz.dtype == state.omega_body.dtype
                np.testing.assert_allclose(state.wxyz[1:], turn.as_quat()[:3], rtol=1e-6)
    assert not recwarn.list
