"""Hoisting state-independent operations out of a field: same values and derivatives, less work."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import Literal, jaxpr_as_fun
from solvers.heavy_top import heavy_top

import polhode as ph
from polhode._hamiltonian import Dynamics, lie_poisson_field
from polhode._integrate._field import BoundTerm
from polhode._kernels import is_fusible, specialise, without_repeats
from polhode._kernels._programs import nested_jaxprs
from polhode._scene import AlongZ

N = 5
KEYS = jax.random.split(jax.random.key(1), 2)
Y = jax.random.normal(KEYS[0], (7, N))
Y = (tuple(Y[:3]), tuple(Y[3:]))


def scenes():
    principal = ph.Inertia.from_moments([1.0, 1.5, 2.0])
    tilted = ph.Inertia.from_tensor([[1.0, 0.1, 0.0], [0.1, 1.5, -0.2], [0.0, -0.2, 2.0]])
    gravity = ph.UniformGravity(1.0, [0.1, -0.2, 0.5], [0.3, 0.0, -2.0])
    gradient = ph.GravityGradient(4.0, lambda t: jnp.stack([jnp.cos(t), jnp.sin(t), 2.0 + 0 * t]))
    odd = ph.Potential(lambda R, t: jnp.where(R[2, 2] > 0, R[2, 2], 2 * R[2, 2]) ** 3 + t * R[0, 1])
    push = ph.BodyTorque(lambda t: jnp.stack([t, 0 * t, jnp.sin(t)])) + ph.LinearDamping(0.1)
    wheel = ph.Rotor([0.0, 0.0, 1.0], 0.1, momentum=0.3)
    return {
        "gravity": ph.Scene(principal, gravity),
        "tensor": ph.Scene(tilted, gravity + gradient),
        "potential": ph.Scene(principal, odd, push),
        "gyrostat": ph.Scene(principal, gravity, push, wheel),
    }


def dynamics(scene):
    settled = scene.settled(ph.State([1.0, 0, 0, 0], [0.1, 0.2, 0.3]), jnp.array(0.0))
    return Dynamics(settled.hamiltonian, settled.torque)


def prepared(system, t, y, control):
    problem = BoundTerm.of(diffrax.ODETerm(lie_poisson_field), system)
    leaves, tree = jax.tree.flatten(y)
    ready = problem.prepare(t, y, jnp.float64)
    return jax.tree.unflatten(
        tree, [control * x for x in ready.rates(ready.coefficients, t, leaves)]
    )


@pytest.mark.parametrize("name", scenes())
def test_value_and_slope_stay_those_of_the_field(name):
    system = dynamics(scenes()[name])
    t, h = jnp.array(0.7), jnp.array(0.3)

    def plain(t, y):
        return jax.tree.map(lambda x: h * x, lie_poisson_field(t, y, system))

    def folded(t, y):
        return prepared(system, t, y, h)

    close = {"rtol": 1e-13, "atol": 1e-14}
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, **close), folded(t, Y), plain(t, Y))
    ones = jax.tree.map(jnp.ones_like, Y)
    slopes = [
        jax.jit(lambda f=f: jax.jvp(f, (t, Y), (jnp.array(1.0), ones))[1])()
        for f in (folded, plain)
    ]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, **close), *slopes)


def _arithmetic(closed):
    """Number of operations on arrays of bodies."""
    names = ("mul", "add", "sub", "neg", "div", "add_any")
    return sum(
        e.primitive.name in names and e.outvars[0].aval.shape == (N,) for e in closed.jaxpr.eqns
    )


def test_the_derived_field_costs_what_the_one_written_by_hand_does():
    gravity = AlongZ(ph.UniformGravity.axial(1.0, 0.5), jnp.array(-2.0))
    derived = dynamics(ph.Scene(ph.Inertia.from_moments([1.0, 1.5, 2.0]), gravity))
    by_hand = (tuple(jnp.array([1.0, 1 / 1.5, 0.5])), jnp.array(1.0))
    counts = []
    for field, args in ((lie_poisson_field, derived), (heavy_top, by_hand)):

        @jax.jit
        def count(y, args, field=field):
            problem = BoundTerm.of(diffrax.ODETerm(field), args)
            ready = problem.prepare(jnp.zeros(()), y, jnp.float64)
            closed = jax.make_jaxpr(lambda *y: ready.rates(ready.coefficients, 0.0, y))(
                *jax.tree.leaves(y)
            )
            counts.append(_arithmetic(closed))
            return y

        count(Y, args)
    assert counts[0] <= 1.1 * counts[1]  # unfolded it is twice as much


def test_folds():
    """Zeros, ones, powers of two, chains of factors, calls, and values that do not fold."""

    def fn(a, b, x, y):
        zero, one = jnp.zeros_like(x), jnp.ones_like(x)
        s = zero * x + one * y * a * 2.0 - zero
        u = (-x) * b / 4.0 - (zero - y)
        v = jnp.where(x > 0, x * a + x * b, jnp.sin(a) * x) * y
        w = jnp.exp(x) / (a + b) + jnp.sum(x * b)
        return s, u, v, w, a * b * one, zero, x

    a, b = jnp.array(1.5), jnp.array([0.5, -2.0, 1.0])
    x, y = jnp.array([0.3, -1.0, 2.0]), jnp.array([1.0, 4.0, -0.2])
    closed = jax.make_jaxpr(fn)(a, b, x, y)
    held, run, *_ = specialise(closed, [a, b])
    for got, want in zip(run(held, x, y), fn(a, b, x, y), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-15, atol=1e-16)
        assert got.shape == want.shape


def test_what_results_share_is_worked_out_once():
    def rates(known, *state):
        shared = known
        for x in state:
            shared = shared * (x - shared * x)
        return [shared * x for x in state]

    given = jnp.full(N, 0.3), *Y[0], *Y[1]
    closed = jax.make_jaxpr(rates)(*given)

    def multiplications(stage):
        held, run, *_ = specialise(closed, given[:1], stage=stage)
        program = jax.jit(lambda *state: run(held, *state)).lower(*given[1:]).compile()
        np.testing.assert_allclose(program(*given[1:]), rates(*given), rtol=1e-12)
        return program.as_text().count(" multiply(")

    assert multiplications(True) < 4 * len(given)
    assert multiplications(False) > 12 * len(given)


def test_what_rests_on_the_same_arrays_is_worked_out_once():
    """Including calls of compiled functions; numbers that differ only in sign are different."""

    @jax.jit
    def wave(a, t):
        return jnp.sinh(jnp.sin(a * t) / (2 + jnp.cos(a * t)))

    def field(a, b, t, y):
        signs = jnp.arctan2(0.0, -jnp.abs(y)) + jnp.arctan2(-0.0, -jnp.abs(y))
        return wave(a, t) * y + wave(b, t) + signs

    t, y = jnp.array(0.3), jnp.arange(1.0, 4.0)
    for a, b, waves in ((2 * t, None, 1), (2 * t, 3 * t, 2)):
        b = a if b is None else b
        ready = specialise(jax.make_jaxpr(field)(a, b, t, y), [a, b])
        program = jax.make_jaxpr(ready.run)(ready.coefficients, t, y)
        names = [eqn.primitive.name for eqn in program.jaxpr.eqns]
        assert [names.count(name) for name in ("sin", "cos", "sinh")] == [waves] * 3
        assert names.count("atan2") == 2
        np.testing.assert_allclose(
            ready.run(ready.coefficients, t, y)[0], field(a, b, t, y), rtol=1e-14
        )


@pytest.mark.parametrize(
    "fn",
    [
        lambda o: 0.01 * (jnp.sum(jnp.ones(3)) * o[0] - jnp.sum(jnp.ones(8)) * o[1]) * o,
        lambda o: o.at[0:2].set(0.0) - 0.5 * o.at[0:1].set(0.0),
        lambda o: 0.3 * jnp.real(1j * jax.lax.complex(o[0], o[1])) * o,
        lambda o: jnp.imag(jax.lax.complex(o[0], o[1]) / 2) * o,
    ],
    ids=["sums", "updates", "imaginary unit", "complex half"],
)
def test_fields_are_folded_to_the_same_numbers(fn):
    """Operations on one number that is broadcast to different shapes are different; complex factors
    have no sign.
    """
    torque = ph.FeedbackTorque(lambda t, wxyz, omega_body: fn(omega_body))
    scene = ph.Scene(ph.Inertia.from_moments([1.0, 1.5, 2.0]), torque=torque)
    system = dynamics(scene)
    omega = np.array([0.3, -0.2, 0.5])
    momentum = tuple(jnp.asarray(x)[None] for x in np.array([1.0, 1.5, 2.0]) * omega)
    y = (momentum, tuple(jnp.asarray(x)[None] for x in (1.0, 0.0, 0.0, 0.0)))
    folded = prepared(system, jnp.array(0.0), y, 1.0)
    plain = lie_poisson_field(jnp.array(0.0), y, system)
    for a, b in zip(jax.tree.leaves(folded), jax.tree.leaves(plain)):
        np.testing.assert_allclose(a, b, rtol=1e-14, atol=1e-15)


LAWS = {
    "matrix times vector": lambda x, t: jnp.arange(9.0).reshape(3, 3) @ jnp.sin(x),
    "vector times matrix": lambda x, t: jnp.cos(x) @ (t * jnp.arange(9.0).reshape(3, 3)),
    "batch of products": lambda x, t: jnp.einsum(
        "kij,kj->ki", t * jnp.arange(18.0).reshape(2, 3, 3), jnp.stack([x, x * x])
    ).sum(axis=0),
    "layers of a network": lambda x, t: (
        jnp.cos(jnp.arange(48.0).reshape(3, 16))
        @ jnp.tanh(jnp.sin(t * jnp.arange(48.0).reshape(16, 3)) @ x)
    ),
    "one entry set": lambda x, t: jnp.zeros(3).at[1].set(t * x[0]),
    "entries set": lambda x, t: (x * x).at[jnp.array([2, 0])].set(t * x[:2]),
    "entries added": lambda x, t: (x * x).at[jnp.array([1, 1])].add(t * x[:2]),
    "an index beyond the end": lambda x, t: x.at[jnp.array([7, 1])].set(t * x[:2], mode="drop"),
    "indices": lambda x, t: t * x[jnp.array([1, 2, 0])] * x,
    "an index that varies": lambda x, t: x * x[jnp.floor(4 * t).astype(int) - 1],
    "reversed": lambda x, t: t * jnp.flip(x) * x,
    "cumulative sums": lambda x, t: jnp.cumsum(x * x) + t * jax.lax.cumsum(x, reverse=True),
}


@pytest.mark.parametrize("name", LAWS)
def test_laws_in_few_numbers_run_in_the_kernel_with_their_derivatives(name):
    """Matrix products, indices and updates are library calls or scatters, which it cannot hold."""
    x, t = jnp.array([0.5, 2.0, -0.25]), jnp.array(0.75)
    law = jax.make_jaxpr(LAWS[name])(x, t)

    def field(x, t):
        ready = specialise(law, [])
        return ready.run(ready.coefficients, x, t)[0]

    def derivative(f):
        return lambda x, t, bar: jax.vjp(f, x, t)[1](bar)

    bar = jnp.array([1.0, -2.0, 4.0])
    close = {"rtol": 1e-14, "atol": 1e-14}
    np.testing.assert_allclose(field(x, t), LAWS[name](x, t), **close)
    pairs = zip(derivative(field)(x, t, bar), derivative(LAWS[name])(x, t, bar))
    for found, expected in pairs:
        np.testing.assert_allclose(found, expected, **close)
    rows = [jnp.stack([a, 2 * a]) for a in (x, t, bar)]
    for program in (field, derivative(field)):
        given = rows if program is not field else rows[:2]
        assert is_fusible(_without_preparation(jax.make_jaxpr(jax.vmap(program))(*given)))
    plain = jax.make_jaxpr(jax.vmap(derivative(LAWS[name])))(*rows)
    assert name == "reversed" or not is_fusible(plain.jaxpr)


def test_a_function_of_an_entry_is_no_update():
    """``apply`` is a scatter as ``set`` is, but of a function; JAX does not differentiate it."""
    x = jnp.array([0.5, 2.0, -0.25])
    law = jax.make_jaxpr(lambda x: x.at[jnp.array([2, 0])].apply(jnp.sin))(x)
    ready = specialise(law, [])
    found = ready.run(ready.coefficients, x)[0]
    np.testing.assert_array_equal(found, [np.sin(0.5), 2.0, np.sin(-0.25)])


@pytest.mark.parametrize("size", [3, 40, 70])
def test_products_keep_their_rules(size):
    """A product of matrices is a sum or a library call, as the size of the whole batch decides."""
    weights = jnp.sin(jnp.arange(2.0 * size * size)).reshape(2, size, size)

    def law(weights, x):
        hidden = jnp.sin(jnp.einsum("kij,jk->ki", weights, jnp.stack([x, x * x], axis=1)))
        return weights[0] @ hidden[1] + jnp.outer(hidden[0], x) @ hidden[0]

    x = jnp.linspace(-1.0, 1.0, size)
    ready = specialise(jax.make_jaxpr(law)(weights, x), [])

    def prepared(weights, x):
        return ready.run(ready.coefficients, weights, x)[0]

    def results(law):
        def of_one(weights, x):
            value, tangent = jax.jvp(law, (weights, x), (weights * weights, 1 - x))
            cotangents = jax.vjp(law, weights, x)[1](value)
            slope = jax.grad(lambda x: jnp.sum(jax.vjp(law, weights, x)[1](x)[1] ** 2))(x)
            return value, tangent, *cotangents, slope

        rows = jnp.linspace(0.5, 1.0, 3)[:, None] * x[None]
        of_all = jax.vmap(of_one, (None, 0))
        return jax.jit(of_all)(weights, rows), jax.jit(jax.vmap(of_all, (0, None)))(
            jnp.stack([weights, 2 * weights]), rows
        )

    for a, b in zip(jax.tree.leaves(results(prepared)), jax.tree.leaves(results(law))):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12 * np.max(np.abs(b)))


def test_products_of_few_numbers_are_sums_for_any_number_of_bodies():
    """Accelerators round the factors of library products in single precision."""
    gain = jnp.arange(21.0).reshape(3, 7)
    ready = specialise(jax.make_jaxpr(lambda x: gain @ jnp.sin(x))(jnp.ones(7)), [])
    program = jax.make_jaxpr(jax.vmap(lambda x: ready.run(ready.coefficients, x)[0]))
    names = {e.primitive.name for e in program(jnp.ones((10_000, 7))).jaxpr.eqns}
    assert "reduce_sum" in names
    assert not names & {"product", "dot_general"}


def test_half_precision_keeps_indices():
    """bfloat16 does not represent every whole number above 256."""
    x = jnp.arange(400.0).astype(jnp.bfloat16)

    def picked(x):
        return (2 * x)[jnp.array([256, 257])]

    ready = specialise(jax.make_jaxpr(picked)(x), [])
    bar = jnp.array([1.0, 8.0], jnp.bfloat16)
    (slope,) = jax.vjp(lambda x: ready.run(ready.coefficients, x)[0], x)[1](bar)
    np.testing.assert_array_equal(slope, jnp.zeros_like(x).at[256:258].set(2 * bar))


def _without_preparation(closed):
    """The operations that depend on the inputs: the others are done once, before the loop."""
    jaxpr = closed.jaxpr
    known = set(jaxpr.invars)
    for equation in (equations := list(jaxpr.eqns)):
        if any(not isinstance(v, Literal) and v in known for v in equation.invars):
            known.update(equation.outvars)
    kept = [e for e in equations if set(e.outvars) & known]
    return jaxpr.replace(eqns=kept, constvars=[], effects=set())


def test_equal_operations_occur_once():
    """A law that several wheels ask is one law; 0.0 and -0.0 are two numbers."""

    def law(x):
        return jnp.where(x > 0, jnp.sin(x), 2.0 * x)

    def several(x):
        a, b = x / 0.0, x / -0.0
        return law(x) + law(x) * law(x), a, b

    closed = jax.make_jaxpr(several)(1.5)
    single = without_repeats(closed)
    counts = [
        sum(e.primitive.name == "sin" for p in nested_jaxprs(j.jaxpr) for e in p.eqns)
        for j in (closed, single)
    ]
    assert counts == [3, 1]
    assert jaxpr_as_fun(single)(1.5) == jaxpr_as_fun(closed)(1.5)
    assert jaxpr_as_fun(single)(1.5)[1:] == [jnp.inf, -jnp.inf]
