"""Order, accuracy, conservation, derivatives and dense output against 40-digit Taylor series."""

import json
from functools import cache

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from solvers import make_integrators_truth as bodies

from benchmarks.integrators import heavy_top
from polhode._integrate import Accuracy, Extrapolation, Splitting
from polhode._integrate._extrapolation import order_for
from polhode._kernels import kernel

WXYZ, OMEGA = np.array(bodies.WXYZ), np.array(bodies.OMEGA)
MOMENTS, STRENGTH, END = bodies.MOMENTS, bodies.STRENGTH, bodies.TIMES[-1]
TRUTH = json.loads(bodies.FILE.read_text())
TERM = diffrax.ODETerm(heavy_top)


def exact(times=(END,)):
    """(bodies, times, 7): wxyz and momentum_body, correct in every digit of float64."""
    at = [TRUTH["times"].index(t) for t in times]
    return np.array(TRUTH["states"], dtype=float)[:, at]


def start(dtype=jnp.float64):
    momentum = tuple(jnp.asarray(MOMENTS[i] * OMEGA[:, i], dtype) for i in range(3))
    return momentum, tuple(jnp.asarray(WXYZ[:, i], dtype) for i in range(4))


def parameters(dtype=jnp.float64, strength=STRENGTH):
    inverse = tuple(jnp.full(3, 1 / i, dtype) for i in MOMENTS)
    return inverse, jnp.full(3, strength, dtype)


def solve(solver, steps, y=None, args=None, **options):
    y = start() if y is None else y
    # times in the precision of the state: diffrax promotes the state to that of the times
    t0, t1 = (jnp.asarray(t, y[0][0].dtype) for t in (0, END))
    dt0 = None if "stepsize_controller" in options else t1 / steps
    return diffrax.diffeqsolve(
        TERM, solver, t0, t1, dt0, y, parameters() if args is None else args, **options
    )


def stacked(ys):
    """(times, bodies, 7) of the components of a solution."""
    momentum, wxyz = ys
    return np.stack([np.asarray(x) for x in (*wxyz, *momentum)], axis=-1)


def worst(solution, truth):
    return np.abs(stacked(solution.ys) - np.moveaxis(truth, 1, 0)).max()


@cache
def stepper(solver):
    """Final state after a number of steps that is not known when compiling."""

    @jax.jit
    def run(steps):
        dt = END / steps

        def body(i, carry):
            y, memory = carry
            t = i * dt
            y, _, _, memory, _ = solver.step(TERM, t, t + dt, y, parameters(), memory, False)
            return y, memory

        y = start()
        carry = (y, solver.init(TERM, 0.0, dt, y, parameters()))
        return jax.lax.fori_loop(0, steps, body, carry)[0]

    return run


def measured_order(solver, coarse, fine):
    truth = exact()[:, 0]
    errors = [
        np.abs(stacked(stepper(solver)(jnp.asarray(n))) - truth).max() for n in (coarse, fine)
    ]
    return np.log(errors[0] / errors[1]) / np.log(fine / coarse), errors


EXTRAPOLATION_STEPS = {
    4: (40, 80),
    6: (20, 40),
    8: (12, 24),
    10: (5, 10),
    12: (1, 2),
    14: (1, 2),
    16: (1, 2),
    18: (1, 2),
    20: (1, 2),
}


@pytest.mark.parametrize("order", EXTRAPOLATION_STEPS)
def test_extrapolation_has_its_order(order):
    found, errors = measured_order(Extrapolation(order), *EXTRAPOLATION_STEPS[order])
    assert errors[1] > 1e-14  # above rounding: the slope means something
    assert abs(found - order) < 0.1 * order


@pytest.mark.parametrize(
    ("order", "whole", "steps"),
    [(2, None, 60), (4, None, 30), (6, None, 20), (8, None, 16), (4, 10, 15), (6, 10, 8)],
)
def test_splitting_has_its_order(order, whole, steps):
    solver = Splitting(order, moser_veselov=whole)
    found, errors = measured_order(solver, steps, 2 * steps)
    assert errors[1] > 1e-14
    assert abs(found - order) < 0.08 * order
    assert solver.order(TERM) == order
    assert Splitting(8, moser_veselov=6).order(TERM) == 6


@pytest.mark.parametrize("middle", [0, 2])
def test_any_axis_may_be_taken_out(middle):
    solution = solve(Splitting(6, middle=middle), 600)
    assert worst(solution, exact()) < 1e-7


def _invariants(y, args):
    momentum, (w, x, y_, z) = y
    inverse, strength = args
    rows = (2 * (x * z - w * y_), 2 * (y_ * z + w * x), 1 - 2 * (x * x + y_ * y_))
    energy = sum(m * m * i for m, i in zip(momentum, inverse)) / 2 + strength * rows[2]
    vertical = sum(m * r for m, r in zip(momentum, rows))
    return energy, vertical, w * w + x * x + y_ * y_ + z * z


@pytest.mark.parametrize("solver", [Splitting(4), Splitting(4, moser_veselov=10)])
def test_splitting_conserves(solver):
    args, y0 = parameters(), start()
    reference = _invariants(y0, args)

    def record(carry, _):
        y, memory = carry
        y, _, _, memory, _ = solver.step(TERM, 0.0, 0.1, y, args, memory, False)
        return (y, memory), [abs(a - b) for a, b in zip(_invariants(y, args), reference)]

    carry = (y0, solver.init(TERM, 0.0, 0.1, y0, args))
    _, (energy, vertical, norm) = jax.jit(
        lambda carry: jax.lax.scan(record, carry, None, length=20_000)
    )(carry)
    assert np.max(vertical) < 3e-14
    assert np.max(norm) < 3e-15
    assert np.max(energy) > 1e-10  # the bound below is not met by solving exactly
    assert np.max(energy[1000:]) < 1.2 * np.max(energy[:1000])


def test_splitting_keeps_the_momentum_of_a_free_body():
    solution = solve(Splitting(2), 30_000, args=parameters(strength=0.0), max_steps=30_000)
    before = np.sqrt(sum(m * m for m in start()[0]))
    after = np.sqrt(sum(m[0] * m[0] for m in solution.ys[0]))
    np.testing.assert_allclose(after, before, rtol=2e-15)


@pytest.mark.parametrize("solver", [Extrapolation(8), Splitting(4)], ids=lambda s: type(s).__name__)
def test_float32(solver):
    solution = solve(solver, 30, start(jnp.float32), parameters(jnp.float32))
    assert all(x.dtype == jnp.float32 for x in jax.tree.leaves(solution.ys))
    assert worst(solution, exact()) < 1e-5


TIMES = (0.1, 0.75, 1.3, 2.95)


@pytest.mark.parametrize(
    ("solver", "steps", "bound"),
    [(Extrapolation(12), 12, 2e-10), (Splitting(6), 80, 2e-9)],
    ids=lambda s: type(s).__name__,
)
def test_dense_output_has_the_accuracy_of_the_step(solver, steps, bound):
    solution = solve(solver, steps, saveat=diffrax.SaveAt(ts=jnp.asarray(TIMES)))
    assert worst(solution, exact(TIMES)) < bound


def marched(order, rtol):
    """To each time in one step of diffrax, divided by the solver itself."""
    solver = Extrapolation(order, accuracy=Accuracy(rtol, END))
    controller = diffrax.StepTo(jnp.asarray((0.0, *TIMES, END)))
    saveat = diffrax.SaveAt(steps=True, solver_state=True)
    return solve(solver, None, stepsize_controller=controller, saveat=saveat, max_steps=5)


def test_marching_keeps_the_accuracy_asked_for():
    """At every time, of every body, by an estimate; more is asked for with more work."""
    run, work = jax.jit(marched, static_argnums=0), []
    for rtol in (1e-4, 1e-7, 1e-10, 1e-12):
        found = run(None, jnp.asarray(rtol))
        assert worst(found, exact((*TIMES, END))) < 10 * rtol
        assert np.all(found.solver_state.ended == 0)
        order = int(order_for(jnp.asarray(rtol)))
        steps = np.asarray(found.solver_state.steps)
        work.append(float(np.sum(steps)) * Extrapolation(order).evaluations)
    assert len(set(steps.tolist())) > 1  # the field does not ask for the time: own steps
    assert work == sorted(work)
    assert work[-1] > 2 * work[0]
    fixed = run(14, jnp.asarray(1e-10))
    assert worst(fixed, exact((*TIMES, END))) < 1e-9


def test_a_march_out_of_steps_ends_as_no_number():
    solver = Extrapolation(8, accuracy=Accuracy(1e-10, END), max_steps=2)
    controller = diffrax.StepTo(jnp.asarray((0.0, END)))
    saveat = diffrax.SaveAt(t1=True, solver_state=True)
    found = solve(solver, None, stepsize_controller=controller, saveat=saveat, max_steps=1)
    assert np.all(np.isnan(stacked(found.ys)))
    assert np.all(found.solver_state.ended == 1)
    assert np.all(found.solver_state.steps == 2)


def _largest(tree):
    return jnp.max(jnp.stack([jnp.abs(x).max() for x in jax.tree.leaves(tree)]))


@pytest.mark.parametrize("rtol", [1e-5, 1e-10])
def test_step_control_and_error_estimate(rtol):
    control = diffrax.PIDController(rtol=0.0, atol=rtol, norm=_largest)
    solution = solve(Extrapolation(10), None, stepsize_controller=control)
    assert worst(solution, exact()) < 10 * rtol
    solver = Extrapolation(10)
    y1, error, *_ = solver.step(TERM, 0.0, 1.0, start(), parameters(), None, False)
    actual = np.abs(stacked(y1) - exact((1.0,))[:, 0]).max(axis=1)
    claimed = stacked(error).max(axis=1)
    assert np.all(claimed > 0.3 * actual)
    assert np.all(claimed < 1e3 * actual)


def test_event_stops_the_solve():
    event = diffrax.Event(lambda t, y, args, **_: t > 1.0)
    solution = solve(Extrapolation(8), 12, event=event)
    assert solution.event_mask
    assert 1.0 < float(solution.ts[0]) < 1.6


def _loss(first, strength, solver, steps, adjoint):
    inverse = (1 / first, *(jnp.asarray(1 / i) for i in MOMENTS[1:]))
    args = (tuple(jnp.broadcast_to(i, 3) for i in inverse), jnp.broadcast_to(strength, 3))
    ys = solve(solver, steps, args=args, adjoint=adjoint).ys
    return sum(jnp.sum(x * (i + 1)) for i, x in enumerate((*ys[1], *ys[0])))


@pytest.mark.parametrize(
    ("solver", "steps", "modes"),
    [
        (Extrapolation(8), 30, "forward"),
        (Splitting(4), 240, "forward"),
        pytest.param(Splitting(6, moser_veselov=10), 120, "reverse", marks=pytest.mark.slow),
    ],
    ids=["extrapolation", "rotations", "moser_veselov"],
)
def test_gradients(solver, steps, modes):
    point = (jnp.asarray(MOMENTS[0]), jnp.asarray(STRENGTH))
    truth = [float(x) for x in TRUTH["slopes"]]
    if "reverse" in modes:
        reverse = jax.jit(
            jax.grad(
                lambda *p: _loss(*p, solver, steps, diffrax.RecursiveCheckpointAdjoint()), (0, 1)
            )
        )(*point)
        np.testing.assert_allclose(reverse, truth, rtol=1e-9)
    if "forward" in modes:
        forward = jax.jit(
            jax.jacfwd(lambda *p: _loss(*p, solver, steps, diffrax.ForwardMode()), argnums=(0, 1))
        )(*point)
        np.testing.assert_allclose(forward, truth, rtol=1e-9)


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: Extrapolation(7), "order"),
        (lambda: Splitting(3), "order"),
        (lambda: Splitting(4, middle=3), "middle"),
        (lambda: Splitting(4, moser_veselov=3), "moser_veselov"),
    ],
)
def test_options_are_checked(make, named):
    with pytest.raises(ValueError, match=named):
        make()


def test_kernel_with_unused_operands_and_other_operations():
    x = jnp.arange(5.0)
    add = kernel(lambda a, unused, b: a + b)
    np.testing.assert_array_equal(jax.jit(add)(x, x * 2, x), 2 * x)
    np.testing.assert_array_equal(jax.jit(kernel(lambda a: jnp.sort(-a)))(x), -x[::-1])
    assert jax.jit(jax.grad(lambda a: add(a, a, a * a).sum()))(x)[2] == 5.0
    np.testing.assert_array_equal(jax.vmap(add)(x, x, x), 2 * x)


def test_a_compiled_unit_takes_constants():
    """XLA would move them inside, and abort the process over the operand then left unused."""
    table = np.random.default_rng(0).normal(size=(1000, 4))

    def motion(x, table):
        for k in (1, 2, 3):
            x = x / 2 + table[:, 0] * np.pi * k + table[:, k]
        return x, 2 * x

    x = np.linspace(0.0, 1.0, 1000)
    found = jax.jit(lambda x: kernel(motion)(x * x, jnp.asarray(table)))(x)
    np.testing.assert_allclose(found, motion(x * x, table), rtol=1e-14, atol=1e-14)
