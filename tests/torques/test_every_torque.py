"""All torques, potentials and wheels, together and batched, against Newton-Euler's equations.

The reference is implemented in NumPy and integrated by SciPy's DOP853; its derivatives with respect
to every number of the scene are complex-step derivatives.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import polhode as ph
from polhode import FeedbackTorque, KeplerOrbit, QuadraticDamping
from polhode._batch import PARTS, flatten
from polhode._hamiltonian import Dynamics, lie_poisson_field

SPAN, BODIES = (0.5, 2.5), 2
NUMBERS = {
    "moments": [[1.0, 1.5, 2.0], [2.0, 1.25, 1.5]],
    "rates": [[0.5, -0.75, 0.25], [0.25, 0.5, -0.5]],
    "weight": [[1.0, 0.125, -0.25, 0.5, 0.25, 0.5, -1.0], [0.5, 0.25, 0.0, 0.25, 0.0, 0.5, -1.0]],
    "resting centre": [[0.5, 1.5, 0.5, 2.0], [0.25, 1.0, 0.0, 1.0]],
    "moving centre": [[0.5, 2.0, 0.25, 0.5, 0.75, 1.0, 0.5, 0.25]] * 2,
    "potential of attitude and time": [0.25, 0.125, 0.5],
    "body torque": [[0.125, -0.0625, 0.03125], [0.0, 0.25, 0.125]],
    "body torque of time": [0.125, 0.5, -0.25],
    "space torque": [[-0.125, 0.0625, 0.25], [0.125, 0.0, 0.25]],
    "space torque of time": [0.25, 0.75, 0.125],
    "torque of the state": [0.125, 0.0625],
    "linear damping": [[0.125, 0.25, 0.0625], [0.25, 0.125, 0.125]],
    "quadratic damping": [[0.25, 0.125, 0.0625], [0.125, 0.125, 0.25]],
    "wheel held": [0.25, 0.5],
    "wheel driven": [[0.25, 2.0, 0.125], [0.125, -1.0, 0.25]],
    "wheel of an impulse": [0.125, 1.5, 0.25],
}
"""What acts and its numbers: a list of two belongs to the bodies, but for functions and wheels."""

WXYZ = np.array([[0.5, 0.5, -0.5, 0.5], [0.8, 0.0, 0.6, 0.0]])
OBLIQUE = np.array([0.6, 0.0, 0.8])
START = {name: np.array(x) for name, x in NUMBERS.items()}


def scene_of(p, dtype):
    def a(x):
        return jnp.asarray(x, dtype)

    p = {name: a(x) for name, x in p.items()}
    f, g = p["potential of attitude and time"], p["body torque of time"]
    h, s, d = (p[k] for k in ("space torque of time", "torque of the state", "wheel driven"))
    weight, still, orbit = p["weight"], p["resting centre"], p["moving centre"]
    kick = p["wheel of an impulse"]
    potential = (
        ph.UniformGravity(weight[:, 0], weight[:, 1:4], weight[:, 4:])
        + ph.GravityGradient(still[:, 0], still[:, 1:])
        + ph.GravityGradient(orbit[:, 0], KeplerOrbit(*orbit.T))
        + ph.Potential(lambda r, t: f[0] * r[0, 1] * r[2, 2] + f[1] * r[1, 0] * jnp.cos(f[2] * t))
    )
    torque = (
        ph.BodyTorque(p["body torque"])
        + ph.BodyTorque(lambda t: jnp.stack([g[0] * jnp.sin(t), g[1] + 0 * t, g[2] * t]))
        + ph.SpaceTorque(p["space torque"])
        + ph.SpaceTorque(lambda t: jnp.stack([h[0] * t, h[1] * jnp.cos(t), h[2] + 0 * t]))
        + FeedbackTorque(lambda t, q, w: -s[0] * q[0] * q[1:] - s[1] * w * jnp.sum(w * w))
        + ph.LinearDamping(p["linear damping"])
        + QuadraticDamping(p["quadratic damping"])
    )
    rotors = (
        ph.Rotor(a([1.0, 0, 0]), momentum=p["wheel held"])
        + ph.Rotor(a([0, 1.0, 0]), inertia=d[:, 0], speed=d[:, 1], torque=d[:, 2])
        + ph.Rotor(
            a(OBLIQUE), inertia=kick[0], speed=kick[1], impulse=lambda t: kick[2] * jnp.sin(t)
        )
    )
    scene = ph.Scene(ph.Inertia.from_moments(p["moments"]), potential, torque, rotors)
    return scene, ph.State(a(WXYZ), p["rates"]), a(SPAN)


def newton(t, y, p, wheels):
    """d(wxyz, omega)/dt and d(wxyz, momentum)/dt of one body; accepts complex numbers."""
    w, x, v, z = y[:4] / np.sqrt(np.sum(y[:4] ** 2))
    rate = y[4:]
    rows = np.array(
        [
            [1 - 2 * (v * v + z * z), 2 * (x * v - w * z), 2 * (x * z + w * v)],
            [2 * (x * v + w * z), 1 - 2 * (x * x + z * z), 2 * (v * z - w * x)],
            [2 * (x * z - w * v), 2 * (v * z + w * x), 1 - 2 * (x * x + v * v)],
        ]
    )
    moments = p["moments"]
    m, centre, field = p["weight"][0], p["weight"][1:4], p["weight"][4:]
    push = np.cross(centre, rows.T @ (m * field))
    orbit = p["moving centre"]
    still = p["resting centre"]
    for mu, place in ((still[0], still[1:]), (orbit[0], ellipse(t, orbit))):
        r = np.sqrt(np.sum(place**2))
        n = rows.T @ place / r
        push = push + 3 * mu / r**3 * np.cross(n, moments * n)
    f = p["potential of attitude and time"]
    slopes = np.zeros((3, 3), complex)
    slopes[0, 1], slopes[2, 2] = f[0] * rows[2, 2], f[0] * rows[0, 1]
    slopes[1, 0] = f[1] * np.cos(f[2] * t)
    push = push + sum(np.cross(r, s) for r, s in zip(rows, slopes))
    g, h, s = (p[k] for k in ("body torque of time", "space torque of time", "torque of the state"))
    push = push + p["body torque"] + np.array([g[0] * np.sin(t), g[1], g[2] * t])
    push = push + rows.T @ (p["space torque"] + np.array([h[0] * t, h[1] * np.cos(t), h[2]]))
    square = np.sum(rate**2)
    push = push - s[0] * w * np.array([x, v, z]) - s[1] * rate * square
    push = push - p["linear damping"] * rate - p["quadratic damping"] * np.sqrt(square) * rate
    # wheels: L = carrier omega + the axial momenta, whose change the motors take from the body
    carrier, own, motors = np.diag(moments).astype(complex), 0j, 0j
    for axis, inertia, momentum, change in wheels:
        carrier = carrier - inertia * np.outer(axis, axis)
        own = own + axis * momentum(t)
        motors = motors + axis * change(t)
    momentum = carrier @ rate + own
    push = push + np.cross(momentum, rate)
    turn = np.linalg.solve(carrier, push - motors)
    a, b, c = rate / 2
    wxyz = [-x * a - v * b - z * c, w * a + v * c - z * b]
    wxyz += [w * b + z * a - x * c, w * c + x * b - v * a]
    return np.concatenate([wxyz, turn]), np.concatenate([wxyz, push])


def ellipse(t, orbit):
    """Position on a Kepler orbit."""
    mu, a, e, inclination, node, periapsis, mean, epoch = orbit
    mean = mean + np.sqrt(mu / a**3) * (t - epoch)
    u = mean
    for _ in range(50):
        u = u - (u - e * np.sin(u) - mean) / (1 - e * np.cos(u))
    x, y = a * (np.cos(u) - e), a * np.sqrt(1 - e * e) * np.sin(u)
    x, y = turned(periapsis, x, y)
    y, z = turned(inclination, y, 0 * y)
    return np.array([*turned(node, x, y), z])


def turned(angle, x, y):
    return np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y


def of_body(p, body):
    """The numbers of one body, and its wheels: axis, inertia, momentum and torque of the motor."""
    of = {name: x[body] if x.ndim == 2 or name == "wheel held" else x for name, x in p.items()}
    rate = of["rates"]
    j, speed, tau = of["wheel driven"]
    i, spin, kick = of["wheel of an impulse"]
    driven, kicked = j * (rate[1] + speed), i * (OBLIQUE @ rate + spin)
    return of, (
        (np.eye(3)[0], 0.0, lambda t: of["wheel held"], lambda t: 0.0),
        (np.eye(3)[1], j, lambda t: driven + tau * (t - SPAN[0]), lambda t: tau),
        (
            OBLIQUE,
            i,
            lambda t: kicked + kick * (np.sin(t) - np.sin(SPAN[0])),
            lambda t: kick * np.cos(t),
        ),
    )


def end_of(p, body):
    """State (wxyz, omega) of one body at the end."""
    of, wheels = of_body(p, body)

    def field(t, y):
        return newton(t, y, of, wheels)[0].real

    start = np.concatenate([WXYZ[body], of["rates"]])
    end = solve_ivp(field, SPAN, start, "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    return np.concatenate([end[:4] / np.linalg.norm(end[:4]), end[4:]])


@cache
def truth():
    """States at the end."""
    return np.array([end_of(START, k) for k in range(BODIES)])


@pytest.mark.parametrize(
    ("method", "bound"),
    [
        pytest.param(None, 1e-9, id="planned"),
        pytest.param(ph.EulerAngles(), 1e-7, id="euler_angles", marks=pytest.mark.slow),
    ],
)
def test_the_motion(method, bound):
    rtol = 1e-11 if method is None else 1e-9
    record = ph.Record(work=True)
    end = ph.simulate(*scene_of(START, jnp.float64), method, rtol=rtol, record=record)
    wxyz, omega = (np.asarray(x[:, -1]) for x in (end.wxyz, end.omega_body))
    balance = np.asarray(end.energy - end.work)
    np.testing.assert_allclose(balance[:, 1], balance[:, 0], rtol=0, atol=bound)
    assert np.all(np.abs(end.work[:, -1]) > 0.1)
    exact = truth()
    wxyz = wxyz * np.sign(np.sum(wxyz * exact[:, :4], axis=1, keepdims=True))
    np.testing.assert_allclose(wxyz, exact[:, :4], rtol=0, atol=bound)
    np.testing.assert_allclose(omega, exact[:, 4:], rtol=0, atol=bound)


TIME, WEIGHTS = 1.75, np.array([[1.0, 2, -1, 3, 1, -2, 0.5], [-1.0, 1, 2, 1, 3, 1, -0.5]])


def fields(p, dtype):
    """d(wxyz, momentum)/dt of both bodies some time after the start, as in simulate."""
    scene, state, ts = scene_of(p, dtype)
    scene = scene.settled(state, ts[0])
    lanes = {name: flatten(getattr(scene, name), (BODIES,)) for name in PARTS}
    scene = ph.Scene(**lanes)
    momentum = scene.momentum(state.omega_body, jnp.asarray(TIME, dtype))
    y = tuple(tuple(jnp.moveaxis(x, -1, 0)) for x in (momentum, state.wxyz))
    rate, turn = lie_poisson_field(
        jnp.asarray(TIME, dtype), y, Dynamics(scene.hamiltonian, scene.torque)
    )
    return jnp.stack([*turn, *rate], axis=-1)


def test_the_field_and_its_slope_by_every_number():
    def loss(p):
        found = fields(p, jnp.float64)
        return jnp.sum(found * WEIGHTS), found

    def exact(p):
        of = (of_body(p, k) for k in range(BODIES))
        starts = (np.concatenate([WXYZ[k], p["rates"][k]]) for k in range(BODIES))
        return np.array([newton(TIME, y, *x)[1] for y, x in zip(starts, of)])

    slopes, found = jax.jit(jax.grad(loss, has_aux=True))(START)
    want = exact(START)
    np.testing.assert_allclose(found, want.real, rtol=0, atol=4e-15)
    for name, slope in slopes.items():
        step = np.zeros(START[name].shape, complex)
        for at in np.ndindex(step.shape):
            step[:] = 0
            step[at] = 1e-30j
            want = np.sum(exact({**START, name: START[name] + step}).imag * WEIGHTS) / 1e-30
            np.testing.assert_allclose(slope[at], want, rtol=1e-12, atol=1e-13, err_msg=name)
    single = jax.jit(lambda p: fields(p, jnp.float32))(START)
    assert single.dtype == jnp.float32
    np.testing.assert_allclose(np.asarray(single), found, rtol=0, atol=4e-6)
