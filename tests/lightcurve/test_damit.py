"""Export in the format of DAMIT, read back by Kaasalainen's formulas alone."""

import csv

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

import polhode as ph
from polhode.lightcurve import Convex, _solutions, seeliger_ellipsoid

AXES = np.array([1.0, 0.75, 0.5])
ANGLES = 2 * np.pi * np.arange(20_000) / 20_000
WXYZ = np.array([0.5, 0.1, -0.7, 0.5]) / np.linalg.norm([0.5, 0.1, -0.7, 0.5])


def solution_of(moments, omega, axes=AXES, **others):
    moments, omega = np.array(moments), np.array(omega)
    inertia, state = ph.Inertia.from_moments(moments), ph.State(WXYZ, omega)
    periods = ph.periods(inertia, state)
    entries = dict.fromkeys(_solutions.Solution._fields) | {
        "moments": moments,
        "omega_body": omega,
        "wxyz": WXYZ,
        "axes": axes,
        "mode": ph.Mode(int(periods.mode)),
        "P_phi": float(periods.P_phi),
        "P_psi": float(periods.P_psi),
        "epoch": 1.5,
    }
    return _solutions.Solution(**entries | others), ph.Scene(inertia), state  # pyright: ignore[reportArgumentType]


def rates(psi, I1, I2):
    return np.sin(psi) ** 2 / I1 + np.cos(psi) ** 2 / I2


def theta_along(psi, theta0, psi0, I1, I2):
    """cos(theta) on the curve of constant energy through (theta0, psi0); L = 1, I3 = 1."""
    energy = np.sin(theta0) ** 2 * rates(psi0, I1, I2) + np.cos(theta0) ** 2
    return np.sqrt(np.maximum((rates(psi, I1, I2) - energy) / (rates(psi, I1, I2) - 1), 0))


def read(folder):
    """Attitude of body axes in space as a function of the time [day], and L over I3 [rad/day]."""
    with open(folder / "tumbler.csv") as file:
        (row,) = csv.DictReader(line for line in file if not line.startswith("#"))
    I1, I2, P_psi, P_phi = (float(row[k]) for k in ("I1", "I2", "P_psi", "P_phi"))
    phi0, psi0 = (np.radians(float(row[k])) for k in ("phi0", "psi0"))

    def speed(theta0):
        cosine = theta_along(ANGLES, theta0, psi0, I1, I2)
        return np.abs(cosine * (1 - rates(ANGLES, I1, I2)))

    def ratio(theta0):  # P_psi / P_phi
        return np.mean(rates(ANGLES, I1, I2) / speed(theta0)) - P_psi / P_phi

    # on the separatrix cos(theta) vanishes somewhere along the curve
    worst = max(rates(ANGLES, I1, I2), key=lambda g: -abs(g - 1))
    steep = (rates(psi0, I1, I2) - worst) / (rates(psi0, I1, I2) - 1)
    theta0 = brentq(ratio, 1e-6, np.arccos(np.sqrt(max(steep, 0))) - 1e-6, xtol=1e-14)
    L = 2 * np.pi * np.mean(1 / speed(theta0)) / (P_psi / 24)

    def motion(t, y):
        _, theta, psi = y
        across = L * (1 / I1 - 1 / I2) * np.sin(theta) * np.sin(psi) * np.cos(psi)
        precession = L * rates(psi, I1, I2)
        return [precession, across, np.cos(theta) * (L - precession)]

    def attitude(t):
        start = [phi0, theta0, psi0]
        days = t - float(row["JD0"])
        y = solve_ivp(motion, (0, days[-1]), start, "DOP853", days, rtol=1e-12, atol=1e-12).y
        pole = Rotation.from_euler("ZY", [float(row["lambda"]), 90 - float(row["beta"])], True)
        return pole * Rotation.from_euler("ZXZ", y.T)

    return attitude, theta0, row


def read_shape(folder):
    lines = [line.split() for line in (folder / "shape.txt").read_text().splitlines()]
    vertices, faces = (int(x) for x in lines[0])
    rows = np.array(lines[1 : 1 + vertices], float)
    return rows, np.array(lines[1 + vertices :], int).reshape(faces, 3) - 1


BODIES = {
    "short axis": ((0.6, 0.9, 1.0), (0.5, -0.3, 2.0)),
    "short axis, upside down": ((1.0, 0.6, 0.95), (-2.0, 0.5, 0.4)),
    "long axis": ((0.4, 0.9, 1.0), (2.0, -0.3, 0.4)),
    "long axis, permuted": ((0.9, 1.0, 0.5), (0.3, 0.35, -2.0)),
}


@pytest.mark.parametrize("name", BODIES)
def test_the_files_give_the_motion_back(name, tmp_path):
    moments, omega = BODIES[name]
    # the order of the semi-axes along the body axes does not matter here
    solution, scene, state = solution_of(moments, omega)
    assert solution.mode == (ph.Mode.SAM if name.startswith("short") else ph.Mode.LAM)
    assert solution.to_damit(tmp_path, jd_of_zero=2450000.0) == tmp_path
    attitude, _, row = read(tmp_path)
    assert float(row["JD0"]) == 2450001.5
    limits = (0, 1) if name.startswith("short") else (1, np.inf)
    assert all(limits[0] < float(row[k]) < limits[1] for k in ("I1", "I2"))
    ts = np.linspace(0.0, 9.0, 10)
    path = ph.simulate(scene, state, ts)
    # the vertices of the file are those of the ellipsoid in other axes of the body
    vertices, faces = read_shape(tmp_path)
    found = np.einsum("tij,vj->tvi", attitude(2450001.5 + ts).as_matrix(), vertices[::17])
    sun, observer = np.array([0.8, 0.6, 0.0]), np.array([0.0, 0.6, 0.8])
    for k in range(len(ts)):
        inside = np.asarray(ph.rotation.wxyz_to_matrix(path.wxyz[k])).T
        np.testing.assert_allclose(np.sum((found[k] @ inside.T / AXES) ** 2, axis=-1), 1, rtol=2e-7)
    turned = attitude(2450001.5 + ts).as_matrix()
    # the body axes of the file are those of the solution in another order, with other signs
    change = np.swapaxes(np.asarray(ph.rotation.wxyz_to_matrix(path.wxyz)), 1, 2) @ turned
    np.testing.assert_allclose(change, np.broadcast_to(np.round(change[0]), (10, 3, 3)), atol=1e-7)
    np.testing.assert_allclose(np.linalg.det(np.round(change[0])), 1)
    shape = Convex.from_mesh(vertices, faces)
    light = shape.brightness(np.swapaxes(turned, 1, 2) @ sun, np.swapaxes(turned, 1, 2) @ observer)
    body = np.swapaxes(np.asarray(ph.rotation.wxyz_to_matrix(path.wxyz)), 1, 2)
    exact = seeliger_ellipsoid(tuple(AXES), tuple((body @ sun).T), tuple((body @ observer).T))
    np.testing.assert_allclose(light, exact, rtol=0.01)


def test_facets_are_counterclockwise_from_outside(tmp_path):
    solution, *_ = solution_of(*BODIES["long axis, permuted"])
    vertices, faces = read_shape(solution.to_damit(tmp_path))
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    assert np.all(np.sum(normals * (a + b + c), axis=-1) > 0)
    np.testing.assert_allclose(normals.sum(axis=0), 0, atol=1e-12)
    volume = np.sum(np.sum(a * np.cross(b, c), axis=-1)) / 6
    np.testing.assert_allclose(volume, 4 / 3 * np.pi * np.prod(AXES), rtol=0.01)


def test_the_convention_is_that_of_a_published_tumbler(tmp_path):
    """(99942) Apophis: E divided by that of the basic spin state is 1.024 +- 0.013 (Pravec et al.
    2014), which follows from the published moments and periods in this convention.
    """
    I1, I2, P_psi, P_phi = 0.61, 0.965, 263.0, 27.38
    text = "lambda,beta,P_psi,P_phi,I1,I2,phi0,psi0,JD0\n"
    (tmp_path / "tumbler.csv").write_text(text + f"250,-75,{P_psi},{P_phi},{I1},{I2},152,14,0\n")
    _, theta0, _ = read(tmp_path)
    psi0 = np.radians(14)
    energy = np.sin(theta0) ** 2 * rates(psi0, I1, I2) + np.cos(theta0) ** 2
    assert abs(energy - 1.024) < 0.013


def test_what_cannot_be_exported_is_refused(tmp_path):
    solution, *_ = solution_of(*BODIES["short axis"])
    with pytest.raises(FileNotFoundError, match="make it first"):
        solution.to_damit(tmp_path / "missing")
    with pytest.raises(ValueError, match="without vertices"):
        solution._replace(harmonics=np.ones(4)).to_damit(tmp_path)
    with pytest.raises(ValueError, match="OBLATE"):
        solution._replace(mode=ph.Mode.OBLATE).to_damit(tmp_path)
    assert not list(tmp_path.iterdir())
