"""Triangle meshes: exact integrals, derivatives by vertices, holes and inverted faces, files."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from polhode.inertia import Inertia, MassProperties

CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
# two triangles a side, counter-clockwise from outside
FACES = np.array(
    [
        [0, 1, 3],
        [0, 3, 2],
        [4, 6, 7],
        [4, 7, 5],
        [0, 4, 5],
        [0, 5, 1],
        [2, 3, 7],
        [2, 7, 6],
        [0, 2, 6],
        [0, 6, 4],
        [1, 5, 7],
        [1, 7, 3],
    ]
)
SIDES = np.array([1.0, 2.0, 3.0])
SHIFT = np.array([5.0, -3.0, 2.0])


def test_a_box_is_a_box():
    body = MassProperties.from_mesh(CORNERS * SIDES + SHIFT, FACES, density=2.0)
    np.testing.assert_allclose(body.mass, 12.0, rtol=1e-14)
    np.testing.assert_allclose(body.centre, SHIFT + SIDES / 2, rtol=1e-14)
    exact = Inertia.from_box(12.0, SIDES).tensor
    np.testing.assert_allclose(body.inertia.tensor, exact, atol=1e-13)
    by_mass = MassProperties.from_mesh(CORNERS * SIDES, FACES, mass=12.0)
    np.testing.assert_allclose(by_mass.inertia.tensor, exact, atol=1e-13)


def test_a_tetrahedron_against_its_known_integrals():
    # corners 0, x, y, z: mean of x^2 is 1/10, of x y 1/20, centre 1/4
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    body = MassProperties.from_mesh(np.vstack([np.zeros(3), np.eye(3)]), faces, mass=1.0)
    same, mixed = 1 / 10 - 1 / 16, 1 / 20 - 1 / 16
    exact = np.where(np.eye(3) > 0, 2 * same, -mixed)
    np.testing.assert_allclose(body.centre, 0.25, rtol=1e-15)
    np.testing.assert_allclose(body.inertia.tensor, exact, rtol=1e-13)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_far_from_the_origin_nothing_is_lost_but_the_input(dtype):
    eps = float(jnp.finfo(dtype).eps)
    near = MassProperties.from_mesh(jnp.asarray(CORNERS * SIDES, dtype), FACES, mass=12.0)
    far = MassProperties.from_mesh(jnp.asarray(CORNERS * SIDES + 1024, dtype), FACES, mass=12.0)
    assert far.central.tensor.dtype == dtype
    np.testing.assert_allclose(far.central.tensor, near.central.tensor, atol=100 * eps)


def test_derivative_by_vertices():
    def volume_and_moments(stretch):
        body = MassProperties.from_mesh(jnp.asarray(CORNERS) * stretch[None], FACES, density=1.0)
        return body.mass, body.central.tensor, body.centre

    mass, tensor, centre = jax.jit(jax.jacfwd(volume_and_moments))(jnp.asarray(SIDES))
    a, b, c = SIDES
    np.testing.assert_allclose(mass, [b * c, a * c, a * b], rtol=1e-14)
    np.testing.assert_allclose(centre, np.eye(3) / 2, atol=1e-14)
    # Ixx = abc (b^2 + c^2)/12
    np.testing.assert_allclose(
        tensor[0, 0],
        [
            b * c * (b * b + c * c) / 12,
            a * c * (3 * b * b + c * c) / 12,
            a * b * (b * b + 3 * c * c) / 12,
        ],
        rtol=1e-13,
    )
    # derivative by a vertex: a third of the vector area of its faces
    by_vertex = jax.grad(lambda v: MassProperties.from_mesh(v, FACES, density=1.0).mass)(
        jnp.asarray(CORNERS)
    )
    area = np.zeros((8, 3))
    for face in FACES:
        p, q, r = CORNERS[face]
        area[face] += np.cross(q - p, r - p) / 6
    np.testing.assert_allclose(by_vertex, area, atol=1e-15)


def test_batch_of_shapes():
    sizes = np.array([1.0, 2.0])[:, None, None]
    body = MassProperties.from_mesh(CORNERS * sizes, FACES, density=[1.0, 2.0])
    np.testing.assert_allclose(body.mass, [1.0, 16.0])
    assert body.inertia.moments.shape == (2, 3)


def test_a_cavity_is_a_second_surface_facing_inwards():
    inner = CORNERS * 0.5 + 0.25
    body = MassProperties.from_mesh(
        np.vstack([CORNERS, inner]), np.vstack([FACES, FACES[:, ::-1] + 8]), density=1.0
    )
    exact = Inertia.from_box(0.875, [1, 1, 1], [0.5, 0.5, 0.5])
    np.testing.assert_allclose(body.inertia.tensor, exact.tensor, atol=1e-15)


def with_small_box(shift, inverted):
    """The box, and one of half its size as a second shell."""
    faces = FACES[:, ::-1] if inverted else FACES
    return np.vstack([CORNERS, CORNERS / 2 + shift]), np.vstack([FACES, faces + 8])


@pytest.mark.parametrize("shift", [[0.0, 0.25, 0.5], [0.25, 0.25, 0.25]])
def test_shells_may_touch(shift):
    hollow = MassProperties.from_mesh(*with_small_box(shift, True), density=1.0)
    np.testing.assert_allclose(hollow.mass, 0.875)
    beside = MassProperties.from_mesh(*with_small_box([1.0, *shift[1:]], False), density=1.0)
    np.testing.assert_allclose(beside.mass, 1.125)


@pytest.mark.parametrize(
    ("vertices", "faces", "error", "message"),
    [
        (*with_small_box([1.0, 0.25, 0.25], True), ValueError, "1 of 2 separate shells"),
        (*with_small_box([1.5, 0.25, 0.25], True), ValueError, "1 of 2 separate shells"),
        (CORNERS, np.vstack([FACES, FACES]), ValueError, "12 faces more than once"),
        (CORNERS, FACES[:-1], ValueError, "3 of 18 edges with a hole"),
        (CORNERS, FACES[:, ::-1], ValueError, "all faces are inverted"),
        (CORNERS, np.vstack([FACES[:-1], FACES[-1:, ::-1]]), ValueError, "3 of 18 edges between"),
        (CORNERS, FACES + 1, ValueError, "counts? from 1"),
        (CORNERS, FACES * 1.0, TypeError, "integers"),
        (CORNERS, FACES[:, :2], ValueError, r"\(f, 3\)"),
        (CORNERS, FACES[:0], ValueError, "f > 0"),
        (CORNERS[:, :2], FACES, ValueError, "shape"),
        (CORNERS * [1, 1, 0], FACES, ValueError, "positive volume"),
        (CORNERS * np.nan, FACES, ValueError, "NaN"),
    ],
)
def test_bad_meshes_are_refused(vertices, faces, error, message):
    with pytest.raises(error, match=message):
        MassProperties.from_mesh(vertices, faces, density=1.0)


def test_mass_or_density_not_both_and_faces_static():
    with pytest.raises(ValueError, match="either density"):
        MassProperties.from_mesh(CORNERS, FACES)
    with pytest.raises(ValueError, match="either density"):
        MassProperties.from_mesh(CORNERS, FACES, mass=1.0, density=1.0)
    with pytest.raises(ValueError, match="density must be positive"):
        MassProperties.from_mesh(CORNERS, FACES, density=-1.0)
    with pytest.raises(TypeError, match="traced"):
        jax.jit(lambda f: MassProperties.from_mesh(CORNERS, f, mass=1.0).mass)(FACES)


OBJ = "".join("v {} {} {}\n".format(*corner) for corner in CORNERS * SIDES * 1000) + "".join(
    "f {} {} {}\n".format(*(face + 1)) for face in FACES
)


def test_files(tmp_path):
    pytest.importorskip("trimesh")
    path = tmp_path / "box.obj"
    path.write_text(OBJ)
    body = MassProperties.from_mesh_file(path, density=2.0, unit=0.001)
    np.testing.assert_allclose(body.inertia.moments, [5.0, 10.0, 13.0], rtol=1e-12)
    for unit, error in (("mm", TypeError), (-0.001, ValueError)):
        with pytest.raises(error, match=r"^unit must be"):
            MassProperties.from_mesh_file(path, density=2.0, unit=unit)
    with pytest.raises(FileNotFoundError):
        MassProperties.from_mesh_file(tmp_path / "none.obj", mass=1.0)
    broken = tmp_path / "broken.obj"
    broken.write_text("nothing here\n")
    with pytest.raises(ValueError, match=r"broken\.obj"):
        MassProperties.from_mesh_file(broken, mass=1.0)
    holed = tmp_path / "holed.obj"
    holed.write_text("\n".join(OBJ.splitlines()[:-1]) + "\n")
    with pytest.raises(ValueError, match="hole"):
        MassProperties.from_mesh_file(holed, mass=1.0)


def test_without_trimesh_the_message_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(ImportError, match=r"pip install 'polhode\[mesh\]'"):
        MassProperties.from_mesh_file(tmp_path / "box.obj", mass=1.0)
