"""All twenty-four sequences of Euler angles: SciPy, round trips, ranges, ends of the ranges."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import polhode.rotation as rotation
from polhode.rotation import Sequence

SEQUENCES = list(Sequence)


def _scipy_name(sequence: Sequence) -> str:
    name = "".join("XYZ"[axis] for axis in sequence.axes)
    return name.lower() if sequence.is_extrinsic else name


def _angles(sequence: Sequence) -> np.ndarray:
    rng = np.random.default_rng(3)
    low, high = (0.01, np.pi - 0.01) if sequence.is_proper else (-1.56, 1.56)
    outer = rng.uniform(-np.pi, np.pi, (2, 64))
    return np.stack([outer[0], rng.uniform(low, high, 64), outer[1]])


def test_there_are_twelve_orders_each_about_body_and_space_axes():
    assert len({(sequence.axes, sequence.is_extrinsic) for sequence in SEQUENCES}) == 24
    assert all(sequence.name[:3] == _scipy_name(sequence).upper() for sequence in SEQUENCES)
    assert sum(sequence.is_proper for sequence in SEQUENCES) == 12


@pytest.fixture(scope="module")
def converted():
    """Matrices of each sequence, and the angles back: one program, which takes less than half the
    time of twenty-four.
    """

    @jax.jit
    def run(angles):
        wxyz = [rotation.euler_to_wxyz(*x, s) for x, s in zip(angles, SEQUENCES)]
        back = [rotation.wxyz_to_euler(q, s) for q, s in zip(wxyz, SEQUENCES)]
        return [rotation.wxyz_to_matrix(q) for q in wxyz], back

    return dict(zip(SEQUENCES, zip(*run([_angles(s) for s in SEQUENCES]))))


@pytest.mark.parametrize("sequence", SEQUENCES, ids=lambda sequence: sequence.name)
def test_agreement_with_scipy_and_round_trip(converted, sequence):
    angles, (matrix, back) = _angles(sequence), converted[sequence]
    theirs = Rotation.from_euler(_scipy_name(sequence), angles.T)
    np.testing.assert_allclose(matrix, theirs.as_matrix(), rtol=0, atol=2e-15)
    # near an end of the range the error of the outer angles is eps/sin
    np.testing.assert_allclose(np.stack(back), angles, rtol=0, atol=1e-13)
    np.testing.assert_allclose(np.stack(back).T, theirs.as_euler(_scipy_name(sequence)), atol=1e-12)


@pytest.mark.parametrize("sequence", [Sequence.ZYZ, Sequence.XYZ, Sequence.ZYX_SPACE])
def test_ends_of_the_range_keep_the_rotation(sequence):
    grid = np.linspace(-np.pi, np.pi, 9)
    first, third = (jnp.asarray(part.ravel()) for part in np.meshgrid(grid, grid))

    @jax.jit
    def run(first, second, third):
        wxyz = rotation.euler_to_wxyz(first, second, third, sequence)
        angles, pull = jax.vjp(lambda q: rotation.wxyz_to_euler(q, sequence), wxyz)
        return wxyz, angles, rotation.euler_to_wxyz(*angles, sequence), pull(angles)[0]

    for second in (0.0, np.pi) if sequence.is_proper else (-np.pi / 2, np.pi / 2):
        wxyz, angles, again, gradient = run(first, second, third)
        assert rotation.angle_between(wxyz, again).max() < 2e-15
        assert all(jnp.abs(outer).max() <= jnp.pi for outer in (angles[0], angles[2]))
        np.testing.assert_allclose(angles[1], second, atol=3e-16)
        assert jnp.isfinite(gradient).all()


def test_angles_may_be_plain_numbers_and_broadcast():
    wxyz = rotation.euler_to_wxyz(0, jnp.asarray([[0.5], [1.0]]), jnp.asarray([0.1, 0.2, 0.3]))
    assert wxyz.shape == (2, 3, 4)
    single = rotation.euler_to_wxyz(0.0, jnp.float32(1.0), 0.2)
    assert single.dtype == jnp.float32
    np.testing.assert_allclose(single, wxyz[1, 1], atol=1e-7)
