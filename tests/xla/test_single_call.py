"""Fused kernels: whatever XLA simplifies, the process survives and the values are unchanged."""

import functools
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from xla import fuzz

import polhode as ph
from polhode import _policy
from polhode._kernels import _fused, kernel, linear, opaque_ones, specialise, spread, staged

HERE = Path(__file__).parent


@pytest.mark.slow  # faster: random ones, test_a_seeded_slice_of_the_fuzz
def test_units_that_fold_away():
    """In its own process; `folding_units.py each` names the kernel that ends it."""
    ran = subprocess.run(
        [sys.executable, HERE / "folding_units.py"],
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert ran.returncode == 0, ran.stdout[-500:] + ran.stderr[-2000:]
    lines = dict(line.rsplit(": ", 1) for line in ran.stdout.splitlines())
    assert len(lines) > 250
    refused = {name: away for name, away in lines.items() if away.endswith("Error")}
    assert set(refused) <= {"its own reverse rule, second"}
    off = {
        name: away for name, away in lines.items() if name not in refused and float(away) > 1e-14
    }
    assert not off


def _lowered():
    return jax.jit(kernel(lambda a: jnp.sin(a) * a)).lower(jnp.ones(3)).as_text()


def test_one_variable_switches_all_off(monkeypatch):
    monkeypatch.setenv("POLHODE_PLAIN", "0")
    assert "xla_cpu_small_call" in _lowered()
    closed = jax.make_jaxpr(lambda p, x: p * 2 * x)(1.0, 2.0)
    assert len(specialise(closed, [jnp.array(3.0)]).coefficients) == 1
    assert float(specialise(closed, [jnp.array(3.0)]).coefficients[0]) == 6
    monkeypatch.setenv("POLHODE_PLAIN", "1")
    assert "xla_cpu_small_call" not in _lowered()
    held, run, *_ = specialise(closed, [jnp.array(3.0)])
    assert float(held[0]) == 3
    assert float(run(held, jnp.array(2.0))[0]) == 12


def test_no_operation_of_an_orbit_keeps_it_out_of_a_unit():
    """Kepler's equation uses cube roots and inverse hyperbolic functions."""
    orbits = {
        "ellipse": ph.KeplerOrbit(1.0, 2.0, 0.1),
        "fly-by": ph.HyperbolicOrbit(1.0, -2.0, 1.4),
    }
    for orbit in orbits.values():
        drag = ph.RelativeTorque(ph.LinearDamping(0.1), ph.LVLH(orbit))
        scene = ph.Scene(ph.Inertia.from_moments([1.0, 1.5, 2.0]), None, drag)

        def end(omega, scene=scene):
            return ph.simulate(scene, ph.State([1.0, 0.0, 0.0, 0.0], omega), [0.0, 1.0]).wxyz

        assert "xla_cpu_small_call" in jax.jit(end).lower(jnp.ones(3)).as_text()


def test_a_linear_map_is_compiled_as_asked_and_differentiated_as_written():
    def forward(constants, operands):
        return [constants[0] * operands[0] + jnp.sin(constants[1]) * operands[1]]

    def backward(constants, slopes):
        return [constants[0] * slopes[0], jnp.sin(constants[1]) * slopes[0]]

    def by(compiled):
        def result(a, b, x, y):
            return jnp.sum(linear(forward, backward, [a, b], [x, y], [x], compiled)[0] ** 3)

        return result

    arguments = [jnp.array([0.3, -1.2, 0.7]) + k for k in range(4)]
    everything = tuple(range(4))
    for take in (
        lambda f: f(*arguments),
        lambda f: jax.grad(f, everything)(*arguments),
        lambda f: jax.hessian(f, everything)(*arguments),
        lambda f: jax.vmap(jax.grad(f, everything))(*(x[:, None] for x in arguments)),
        lambda f: jax.jvp(f, arguments, arguments)[1],
    ):
        got, expected = (
            jax.tree.leaves(jax.jit(take, static_argnums=0)(by(c))) for c in (kernel, None)
        )
        for x, y in zip(got, expected, strict=True):
            np.testing.assert_allclose(x, y, rtol=1e-13)
    marked = jax.jit(jax.grad(by(kernel))).lower(*arguments).as_text()
    plain = jax.jit(jax.grad(by(None))).lower(*arguments).as_text()
    assert "xla_cpu_small_call" in marked
    assert "xla_cpu_small_call" not in plain


def test_what_bodies_share_stays_shared_in_a_batch_of_units():
    """With unshared times each body would take its own backward steps: 1.7 times as long."""
    batched = jnp.ones((4, 3)), jnp.ones(3)
    depends = _fused._batched_results(
        lambda x, t: [x * t, jnp.sin(t), jax.lax.cond(t[0] > 0, lambda: x, lambda: 2 * x), t],
        batched,
        (0, None),
    )
    assert depends == [True, False, True, False]

    whole = kernel(lambda x, t: x * jnp.sin(t), linearised=True, of_units=True)
    slopes = jax.vmap(jax.grad(lambda x, t: jnp.sum(whole(x, t))), (0, None))
    np.testing.assert_allclose(slopes(*batched), np.sin(np.ones((4, 3))), rtol=1e-15)


def test_the_field_that_a_stock_solver_asks_for_is_a_unit():
    """A task for each of its arrays took 2.6 times as long."""
    top = ph.Scene(ph.Inertia.from_moments([1.0, 1.5, 2.0]), ph.UniformGravity(1.0, [0, 0.1, 0.2]))

    def end(omega):
        return ph.simulate(top, ph.State([1.0, 0, 0, 0], omega), [0.0, 1.0], ph.LiePoisson()).wxyz

    text = jax.jit(end).lower(jnp.ones((20, 3))).as_text()
    body = text[text.index("stablehlo.while") :]
    assert 'xla_cpu_small_call = "true"' in body


@pytest.mark.parametrize(
    "name", ["acos", "acosh", "asin", "asinh", "atanh", "cbrt", "erf", "erf_inv", "erfc"]
)
def test_special_functions_in_units(name):
    def fn(x):
        return getattr(jax.lax, name)(x + 1 if name == "acosh" else x) * x

    x = jnp.linspace(0.1, 0.9, 7)
    unit = jax.jit(kernel(fn))
    assert "xla_cpu_small_call" in unit.lower(x).as_text()
    assert jnp.allclose(unit(x), fn(x), rtol=1e-15, atol=0)


@pytest.mark.parametrize("kind", ["free", "lagrange", "damped"])
@pytest.mark.slow
def test_no_traced_value_outlives_its_program(kind):
    """For closed forms and integrated motions."""
    force = ph.UniformGravity.axial(1.0, 0.5) if kind == "lagrange" else None
    drag = ph.LinearDamping(0.1) if kind == "damped" else None
    state = ph.State([1.0, 0.0, 0.0, 0.0], [0.1, 1.0, 0.1])

    @jax.jit
    def end(moments):
        body = ph.Inertia.from_moments(moments)
        if kind == "lagrange":
            body = ph.Inertia.axisymmetric(moments[0], moments[2])
        scene = ph.Scene(body, force, drag)
        return ph.simulate(scene, state, [0.0, 0.5], rtol=1e-3).wxyz

    with jax.checking_leaks():
        assert jnp.all(jnp.isfinite(end(jnp.array([1.0, 1.5, 2.0]))))


@pytest.mark.parametrize("times", [2, 20])
def test_one_body_is_few_tasks_of_the_processor(times):
    """XLA distributes more than eight tasks with arrays above 512 bytes over several threads, which
    takes longer than the motion.
    """
    drag = ph.LinearDamping(0.1)
    scene = ph.Scene(
        ph.Inertia.from_moments([1.0, 1.5, 2.0]), ph.UniformGravity(1, [0, 0, 1]), drag
    )

    def end(state):
        found = ph.simulate(scene, state, jnp.linspace(0, 1, times), rtol=1e-3)
        return found.wxyz, found.omega_body, found.status

    state = ph.State([1.0, 0.0, 0.0, 0.0], [0.1, 1.0, 0.1])
    program = jax.jit(end).lower(state).compile().as_text()
    main = program[program.index("\nENTRY") :]
    kinds = ("fusion", "call", "while", "copy", "sort", "conditional", "custom-call", "reduce")
    tasks = [line for line in main.splitlines() if any(f" {k}(" in line for k in kinds)]
    assert any(" call(" in line for line in tasks)
    assert len(tasks) <= 8, tasks


def test_a_batch_of_batches_is_too_wide_for_a_unit():
    """XLA sums many numbers by a library call, which a fused kernel cannot contain: nested batches
    whose sums become too wide are not fused.
    """

    def power(weights, rows):
        def step(_, rows):
            total = jnp.sum(weights[:, None, None] * rows, axis=0)
            return jax.lax.dynamic_update_index_in_dim(rows, total, 3, 0)

        return jax.lax.fori_loop(0, 5, step, rows)

    weights, rows = jnp.linspace(0.0, 1.0, 14), jnp.ones((240, 2, 14, 8, 4))

    def batch(rows):
        return jax.vmap(jax.vmap(functools.partial(kernel(power), weights)))(rows)

    one = functools.partial(kernel(power), weights)
    assert "xla_cpu_small_call" in jax.jit(one).lower(rows[0, 0]).as_text()
    assert "xla_cpu_small_call" in jax.jit(jax.vmap(one)).lower(rows[0]).as_text()
    assert "xla_cpu_small_call" not in jax.jit(batch).lower(rows).as_text()
    expected = power(weights, rows[0, 0])
    np.testing.assert_allclose(jax.jit(batch)(rows)[-1, -1], expected, rtol=1e-12)


def _units(jaxpr):
    """Leading axes of the results of every fused kernel in a program."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "unit":
            yield {v.aval.shape[0] for v in equation.outvars if v.aval.ndim}
        for value in jax.tree.leaves(
            list(equation.params.values()), is_leaf=lambda v: hasattr(v, "eqns")
        ):
            nested = getattr(value, "jaxpr", value)
            if hasattr(nested, "eqns"):
                yield from _units(nested)


TRIAXIAL = ph.Inertia.from_moments([1.0, 1.5, 2.0])
SYMMETRIC = ph.Inertia.axisymmetric(1.0, 1.5)


def large_batch(inertia, torque):
    """Motion of one body, and attitudes and rates of more bodies than a fused kernel contains."""
    bodies = 2 * _policy.KERNEL_BATCH + 1
    scene = ph.Scene(inertia, torque=torque)
    keys = jax.random.split(jax.random.key(0))
    wxyz, omega = (jax.random.normal(k, (bodies, n)) for k, n in zip(keys, (4, 3)))

    def motion(wxyz, omega):
        return ph.simulate(scene, ph.State(wxyz, omega), jnp.linspace(0.0, 2.0, 9)).wxyz

    return motion, wxyz, omega


@pytest.mark.parametrize(
    ("inertia", "torque"),
    [(SYMMETRIC, None), (TRIAXIAL, None), (TRIAXIAL, ph.LinearDamping(0.1))],
    ids=["symmetric", "free", "damped"],
)
def test_a_large_batch_is_a_loop_of_units(inertia, torque):
    """Unfused, XLA repeats arithmetic: 256 free bodies under vmap took 300 ms, not 3."""
    motion, wxyz, omega = large_batch(inertia, torque)
    sizes = set().union(*_units(jax.make_jaxpr(jax.vmap(motion))(wxyz, omega).jaxpr))
    assert -(-len(wxyz) // 3) in sizes
    assert len(wxyz) not in sizes
    assert jax.vmap(motion)(wxyz[:0], omega[:0]).shape == (0, 9, 4)


@pytest.mark.parametrize(
    ("inertia", "torque"),
    [
        (SYMMETRIC, None),
        pytest.param(TRIAXIAL, None, marks=pytest.mark.slow),
        pytest.param(TRIAXIAL, ph.LinearDamping(0.1), marks=pytest.mark.slow),
    ],
    ids=["symmetric", "free", "damped"],
)
def test_values_and_gradients_of_a_loop_of_units(inertia, torque):
    """They equal those of the same bodies as one batch."""
    motion, wxyz, omega = large_batch(inertia, torque)

    def slopes(motion):
        def cubes(omega):
            found = motion(wxyz, omega)
            return jnp.sum(found**3), found

        slope, found = jax.jit(jax.grad(cubes, has_aux=True))(omega)
        return found, slope

    for found, want, atol in zip(slopes(jax.vmap(motion)), slopes(motion), (1e-6, 1e-5)):
        np.testing.assert_allclose(found, want, atol=atol)


def test_tops_at_rest_or_without_weight_are_corrected_body_by_body():
    """In parallel, that branch would be a third of the compiled program of a batch of tops."""
    scene = ph.Scene(SYMMETRIC, ph.UniformGravity.axial(1.0, 0.5))
    state = ph.State(jnp.ones((5, 4)), jnp.ones((5, 3)))
    program = jax.make_jaxpr(lambda s: ph.simulate(scene, s, jnp.array([0.0, 1.0])).wxyz)(state)
    programs = list(_fused.nested_jaxprs(program.jaxpr))
    (cond,) = (e for p in programs for e in p.eqns if e.primitive.name == "cond")
    corrected = [e for b in cond.params["branches"] for e in b.jaxpr.eqns]
    assert [e.params["length"] for e in corrected if e.primitive.name == "scan"] == [5]
    assert not [e for e in corrected if e.primitive.name == "unit"]


def test_stages_stay_under_vmap_and_in_derivatives():
    """A division by broadcast ones would become a multiplication, and be repeated."""

    def plain(x):
        return jnp.sin(x) * jnp.cos(x) + jnp.exp(jnp.cos(x))

    def in_stages(x):
        one = opaque_ones(x)
        sine, cosine = staged((jnp.sin(x), jnp.cos(x)), one)
        return sine * cosine + staged(jnp.exp(cosine), one)

    x = jnp.linspace(0.1, 1.0, 5)
    for way in (lambda f: f, jax.jacfwd, jax.jacrev, jax.hessian):
        np.testing.assert_allclose(way(in_stages)(x), way(plain)(x), rtol=1e-14, atol=1e-14)
    rows = jnp.outer(jnp.arange(1.0, 4.0), x)
    np.testing.assert_allclose(
        jax.vmap(jax.jacfwd(in_stages))(rows), jax.vmap(jax.jacfwd(plain))(rows), atol=1e-14
    )
    _, slope = jax.linearize(in_stages, x)
    directions = jax.jit(jax.vmap(slope)).lower(jnp.eye(5)).compile().as_text()
    assert " divide(" in directions


def test_a_derivative_that_no_unit_can_hold_is_none():
    """Fused kernels cannot contain a sort, which may occur only in a derivative rule."""

    @jax.custom_jvp
    def total(x):
        return jnp.sum(x)

    @total.defjvp
    def rule(primals, tangents):
        return total(*primals), jnp.dot(jnp.sort(primals[0]), tangents[0])

    x = jnp.array([0.7, 0.3, 0.5])
    for way in (jax.grad, jax.jacfwd, lambda f: jax.jit(jax.grad(f))):
        np.testing.assert_array_equal(way(jax.jit(kernel(total, linearised=True)))(x), jnp.sort(x))


@pytest.mark.parametrize("how", [{"linearised": True}, {"repeated": True}, {"of_units": True}])
def test_second_derivatives_of_units_in_a_loop(how):
    """JAX traces the first derivative of a loop's body without knowing of a second one."""

    def plain(x):
        return jnp.sin(x) ** 2 * jnp.exp(x)

    def total(fn):
        return lambda x: jnp.sum(jax.lax.map(fn, jnp.stack([x, 2 * x])) ** 2)

    x = jnp.array([0.3, 0.5])
    for outer, inner in ((jax.jacfwd, jax.jacrev), (jax.jacrev, jax.jacfwd)):
        found, want = (jax.jit(outer(inner(total(fn))))(x) for fn in (kernel(plain, **how), plain))
        np.testing.assert_allclose(found, want, rtol=1e-13)


@pytest.mark.parametrize("bodies", [4, 20])
def test_a_batch_of_units_updates_slices_at_places_of_its_own(bodies):
    """``vmap`` turns these into a scatter, which a fused kernel cannot contain."""

    def updated(x, place):
        return jax.lax.dynamic_update_slice(jnp.sin(x), 2 * x[:1], (place,))

    x, places = jnp.linspace(0.0, 1.0, 100).reshape(20, 5)[:bodies], jnp.arange(bodies) % 5
    found, want = (jax.jit(jax.vmap(fn))(x, places) for fn in (kernel(updated), updated))
    np.testing.assert_allclose(found, want, rtol=1e-14)


def test_units_within_a_unit():
    """Nested kernels remain fused, also in derivatives; a constant table is inside."""
    table, wide = jnp.arange(3.0), jnp.arange(2000.0)
    inner = kernel(lambda x: jnp.sin(x) * table)
    outer = kernel(lambda x: inner(x) + 2 * inner(x * x) + wide[7], of_units=True)

    def plain(x):
        return jnp.sin(x) * table + 2 * jnp.sin(x * x) * table + 7

    x = jnp.array([0.3, 0.5, 0.7])
    value, slope = jax.jit(outer), jax.jit(jax.grad(lambda x: jnp.sum(outer(x))))
    assert value.lower(x).as_text().count('xla_cpu_small_call = "true"') >= 2
    assert (
        "xla_cpu_small_call"
        not in jax.jit(jax.grad(lambda x: jnp.sum(plain(x)))).lower(x).as_text()
    )
    assert jnp.allclose(value(x), plain(x), rtol=1e-15, atol=0)
    expected = jax.grad(lambda x: jnp.sum(plain(x)))(x)
    assert jnp.allclose(slope(x), expected, rtol=1e-15, atol=0)
    assert jnp.allclose(jax.vmap(value)(x[None])[0], plain(x), rtol=1e-15, atol=0)


@pytest.mark.parametrize(("bodies", "times"), [(3, 2), (100, 61)])
def test_units_that_repeat_their_work_in_derivatives(bodies, times):
    """Gradients of any size are fused: sums over the times of the samples are inside."""

    def motion(a, b, t):
        a, b, c = *spread((a, (jnp.sin(a * b), b > 0)), -1, times), spread(b, -1, times)
        return jnp.where(b[1], jnp.cos(a * t) * b[0], a) * c, jnp.arange(bodies)

    unit = kernel(motion, repeated=True)
    a, b = jnp.linspace(0.3, 0.9, bodies), jnp.linspace(-0.5, 1.0, bodies)
    t = jnp.linspace(0, 1, bodies * times).reshape(bodies, times)

    def plain(a, b, t):
        a, b = a[:, None], b[:, None]
        return jnp.where(b > 0, jnp.cos(a * t) * jnp.sin(a * b), a) * b

    def slope(fn):
        return jax.jit(jax.grad(lambda *x: jnp.sum(jnp.exp(fn(*x))), argnums=(0, 1, 2)))

    def agree(got, want):
        jax.tree.map(
            lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-13, atol=1e-14), got, want
        )

    own = slope(lambda *x: unit(*x)[0])
    lines = own.lower(a, b, t).as_text().splitlines()
    assert sum(" call @" in line and "xla_cpu_small_call" in line for line in lines) == 2
    agree(own(a, b, t), slope(plain)(a, b, t))
    along = a, b, t
    for f, g in ((lambda *x: unit(*x)[0], plain), (own, slope(plain))):  # forward, over reverse too
        agree(*(jax.jit(lambda x, h=h: jax.jvp(h, x, x)[1])(along) for h in (f, g)))
    many = jnp.stack([a, 2 * a])
    agree(*(jax.vmap(f, (0, None, None))(many, b, t) for f in (own, slope(plain))))


@pytest.mark.parametrize(
    "derivative", [jax.grad, pytest.param(jax.hessian, marks=pytest.mark.slow)]
)
def test_derivatives_of_a_free_body_are_units(derivative):
    """Unfused, work that several results need is repeated: Hessians took minutes to compile."""

    def end(x):
        inertia = ph.Inertia.from_moments(x[:3])
        last = ph.simulate(ph.Scene(inertia), ph.State([1.0, 0, 0, 0], x[3:]), [0.0, 10.0]).last
        return jnp.sum(last.omega_body) + last.wxyz @ jnp.arange(4.0)

    x = jnp.array([1.0, 1.5, 2.0, 0.3, 0.2, 1.1])
    functions = jax.jit(derivative(end)).lower(x).as_text().split("func.func ")
    lines = [line for function in functions for line in function.splitlines()]
    calls = [line for line in lines if " call @" in line and "xla_cpu_small_call" in line]
    units = {line.split("call @")[1].split("(")[0] for line in calls}
    sizes = {f.split("(")[0].split("@")[-1]: len(f.splitlines()) for f in functions if "@" in f}
    assert len(units) == 2
    assert sum(sizes[name] for name in units) > 4000
    # functions that others call are inside fused kernels too, but are short
    assert max(size for name, size in sizes.items() if name not in units) < 500


def test_a_seeded_slice_of_the_fuzz():
    """`fuzz.py` runs thousands."""
    ran, refused, largest, ends = fuzz.hunt_units(8, seed=7, each=8)
    assert not ends
    assert ran + refused == 8 * len(fuzz.WAYS)
    assert ran > 26
    assert largest < 1e-14


def test_a_thrust_of_zero():
    """XLA recognises that the torque is zero, which the traced program does not show."""
    torque = ph.BodyTorque(lambda t: jnp.where(t < 1, 0.0, 0.0) * jnp.array([0.0, 0.0, 1.0]))
    inertia = ph.Inertia.from_moments([1.0, 2.0, 3.0])
    state = ph.State([1.0, 0.0, 0.0, 0.0], [0.1, 1.0, 0.1])
    ts = [0.0, 0.5]
    found = ph.simulate(ph.Scene(inertia, torque=torque), state, ts, rtol=1e-6)
    free = ph.simulate(ph.Scene(inertia), state, ts)
    assert jnp.max(jnp.abs(found.wxyz - free.wxyz)) < 1e-6
