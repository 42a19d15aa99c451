"""Derivatives of the extrapolated flow: adjoint and variational equations against differences."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode import rotation
from polhode.hamiltonian import Dynamics, Hamiltonian, LiePoissonCostate, lie_poisson_field
from polhode.solvers import flow
from polhode.solvers._linear import linear

KEYS = jax.random.split(jax.random.key(7), 8)
WXYZ = rotation.normalise(jax.random.normal(KEYS[0], (3, 4)))
OMEGA = jax.random.normal(KEYS[1], (3, 3))
MOMENTS = jnp.array([[1.0, 1.5, 2.0], [1.2, 1.1, 0.9], [2.0, 1.5, 1.0]])
METHODS = {  # in equal steps, and in steps of the solver's own choice
    "driven": ph.LiePoisson(ph.solvers.Extrapolation(12), chunk=2, at_end=True, adjoint=None),
    "satellite": ph.Extrapolated(12, chunk=2),
}


def driven(p):
    """Gravity, a torque that depends on time through what it closes over, drag that stops it."""
    push = ph.BodyTorque(lambda t: jnp.stack([jnp.sin(p["rate"] * t), 0 * t, p["rate"] + 0 * t]))
    weight = ph.UniformGravity(p["rate"], p["centre"], 0 * p["centre"] - 2)
    drag = ph.LinearDamping(8 * p["centre"])
    return ph.Scene(ph.Inertia.from_moments(p["moments"]), weight, push + drag)


def satellite(p):
    """A wheel, the gravity gradient of a centre that moves, a torque fixed in space."""

    def position(t):
        return jnp.stack([jnp.cos(p["rate"] * t), jnp.sin(p["rate"] * t), 0.1 + 0 * t])

    wheel = ph.Rotor([0.0, 0.6, 0.8], 0.1, momentum=p["rate"])
    pull = ph.GravityGradient(p["centre"][2], position)
    return ph.Scene(ph.Inertia.from_moments(p["moments"]), pull, ph.SpaceTorque(p["centre"]), wheel)


def loss(scene_of, p):
    """Of three saved states, of all bodies, of the work (which takes the equations of any field for
    the slopes); ``last`` moves the times."""
    scene, state = scene_of(p), ph.State(p["wxyz"], p["omega"])
    ts = jnp.stack([0.2 * p["last"], p["last"] / 2, p["last"]])
    record = ph.Record(work=scene_of is driven)
    rtol = 1e-12 if ts.dtype == jnp.float64 else 2e-6
    end = ph.simulate(scene, state, ts, METHODS[scene_of.__name__], rtol=rtol, record=record)
    work = 0 if end.work is None else jnp.sum(end.work)
    return jnp.sum(end.wxyz[:, 1:, 1] ** 2) + jnp.sum(jnp.sin(end.omega_body)) + 0.1 * work


def point():
    return {
        "moments": MOMENTS, "centre": jnp.array([0.1, 0.0, 0.5]), "rate": jnp.array(0.7),
        "wxyz": WXYZ, "omega": OMEGA, "last": jnp.array(3.0),
    }  # fmt: skip


def difference(fn, p, direction, h=0.02):
    """Eighth-order central difference."""
    weights = (4 / 5, -1 / 5, 4 / 105, -1 / 280)
    steps = [h * k * s for k in range(1, 5) for s in (1, -1)]
    values = [fn(jax.tree.map(lambda x, d, a=a: x + a * d, p, direction)) for a in steps]
    pairs = zip(weights, values[::2], values[1::2])
    return sum(w * (up - down) for w, up, down in pairs) / h


def along(p, seed):
    """A direction in which every parameter changes."""
    leaves, tree = jax.tree.flatten(p)
    keys = jax.random.split(jax.random.key(seed), len(leaves))
    moves = [0.3 * jax.random.normal(k, x.shape, x.dtype) for k, x in zip(keys, leaves)]
    return jax.tree.unflatten(tree, moves)


@pytest.mark.parametrize("scene_of", [driven, satellite], ids=lambda f: f.__name__)
def test_reverse_mode_is_the_slope(scene_of):
    p = point()
    direction = along(p, 3)
    fn = partial(loss, scene_of)
    want = difference(jax.jit(fn), p, direction)
    slopes = jax.jit(jax.grad(fn))(p)
    products = jax.tree.map(lambda s, d: jnp.sum(s * d), slopes, direction)
    np.testing.assert_allclose(sum(jax.tree.leaves(products)), want, rtol=1e-9)
    assert all(abs(float(x)) > 1e-6 for x in jax.tree.leaves(products))  # every one takes part
    if scene_of is satellite:
        return
    single = jax.tree.map(lambda x: x.astype(jnp.float32), p)
    for exact, found in zip(*map(jax.tree.leaves, (slopes, jax.jit(jax.grad(fn))(single)))):
        assert found.dtype == jnp.float32
        np.testing.assert_allclose(found, exact, rtol=0, atol=1e-4 * float(jnp.max(abs(exact))))


def value(inverse):
    """Of heavy tops; each row of ``inverse`` is the reciprocal of one moment, for all bodies."""
    dtype = inverse.dtype
    numbers = (jnp.array(x, dtype) for x in (1.0, (0.1, 0.0, 0.5), (0.0, 0.0, -1.0)))
    unit = ph.Inertia.from_moments(jnp.ones(3, dtype))
    weight = ph.UniformGravity(*numbers, vertical=True)
    dynamics = Dynamics(Hamiltonian(tuple(inverse), unit, weight))
    y = jax.tree.map(lambda x: x.astype(dtype), (tuple(OMEGA.T), tuple(WXYZ.T)))
    span = jnp.zeros((), dtype), jnp.ones((), dtype)
    costate = LiePoissonCostate.of(dynamics, y, span[0])
    assert costate.row == 2
    end = flow(lie_poisson_field, dynamics, y, span, 24, 10, costate=costate)
    return sum(jnp.sum(jnp.sin(x)) for x in jax.tree.leaves(end))


def test_batches_of_slopes_and_second_derivatives():
    """vmap over gradients, Jacobians both ways, the Hessian, which is symmetric; float32."""
    point = 1 / MOMENTS.T
    slopes = jax.jit(jax.vmap(jax.grad(value)))(jnp.stack([point, 1.1 * point]))
    forward = jax.jit(jax.jacfwd(value))
    np.testing.assert_allclose(slopes[0], forward(point), rtol=0, atol=1e-11)
    hessian = jax.jit(jax.jacfwd(jax.grad(value)))(point).reshape(9, 9)
    np.testing.assert_allclose(hessian, hessian.T, rtol=0, atol=1e-10)
    step = jax.random.normal(KEYS[2], (3, 3)) / 3
    change = difference(forward, point, step)
    np.testing.assert_allclose(hessian @ step.ravel(), change.ravel(), rtol=0, atol=1e-9)
    single = jax.jit(jax.grad(value))(point.astype(jnp.float32))
    assert single.dtype == jnp.float32
    np.testing.assert_allclose(single, slopes[0], rtol=0, atol=1e-5)


def test_linear_maps_transpose_by_the_other_program():
    """Zeros, known operands and batches included."""

    def product(a, x, y):
        forward = lambda given, v: [given[0] @ v[0] + v[1]]  # noqa: E731
        backward = lambda given, w: [given[0].T @ w[0], w[0]]  # noqa: E731
        return linear(forward, backward, [a], [x, y], [y])[0]

    keys = jax.random.split(jax.random.key(0), 3)
    a, x, y = (jax.random.normal(k, s) for k, s in zip(keys, ((2, 3), (3,), (2,))))

    def loss(fn, a, x, y):
        return jnp.sum(jnp.sin(fn(a, x, y)))

    def plain(a, x, y):
        return a @ x + y

    for argnums in (1, 2, (1, 2)):
        got, want = (
            jax.grad(lambda *v, f=f: loss(f, *v), argnums)(a, x, y) for f in (product, plain)
        )
        jax.tree.map(lambda g, w: np.testing.assert_allclose(g, w, rtol=1e-14), got, want)
    many, scales = jnp.stack([a, 2 * a]), jnp.array([0.5, 2.0])
    for axis, given in ((0, many), (None, a)):

        def over(fn, scales, axis=axis, given=given):
            return jax.vmap(lambda a, s: loss(fn, a, s * x, y), (axis, 0))(given, scales)

        for derive in (jax.jacrev, jax.jacfwd):
            got, want = (derive(partial(over, fn))(scales) for fn in (product, plain))
            np.testing.assert_allclose(got, want, rtol=1e-13, atol=1e-15)
    got, want = (
        jax.jvp(lambda a, x, f=f: loss(f, a, x, y), (a, x), (many[1], 1 + x))[1]
        for f in (product, plain)
    )
    np.testing.assert_allclose(got, want, rtol=1e-14)
