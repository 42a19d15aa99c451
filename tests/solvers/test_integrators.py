"""Order, accuracy, derivatives and dense output against 40-digit Taylor series."""

import json
from functools import cache

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from solvers import make_integrators_truth as bodies
from solvers.heavy_top import heavy_top

from polhode import Extrapolation
from polhode._integrate import Accuracy
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
    """Final state after a number of steps that is traced."""

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
    assert errors[1] > 1e-14  # above rounding, so that the order is meaningful
    assert abs(found - order) < 0.1 * order


def test_float32():
    solution = solve(Extrapolation(8), 30, start(jnp.float32), parameters(jnp.float32))
    assert all(x.dtype == jnp.float32 for x in jax.tree.leaves(solution.ys))
    assert worst(solution, exact()) < 1e-5


TIMES = (0.1, 0.75, 1.3, 2.95)


def test_dense_output_has_the_accuracy_of_the_step():
    solution = solve(Extrapolation(12), 12, saveat=diffrax.SaveAt(ts=jnp.asarray(TIMES)))
    assert worst(solution, exact(TIMES)) < 2e-10


def marched(order, rtol):
    """To each time in one step of diffrax, which the solver divides."""
    solver = Extrapolation(order, accuracy=Accuracy(rtol, END))
    controller = diffrax.StepTo(jnp.asarray((0.0, *TIMES, END)))
    saveat = diffrax.SaveAt(steps=True, solver_state=True)
    return solve(solver, None, stepsize_controller=controller, saveat=saveat, max_steps=5)


def test_marching_keeps_the_accuracy_asked_for():
    """At every time, of every body, by an estimate; smaller tolerances need more work."""
    run, work = jax.jit(marched, static_argnums=0), []
    for rtol in (1e-4, 1e-7, 1e-10, 1e-12):
        found = run(None, jnp.asarray(rtol))
        assert worst(found, exact((*TIMES, END))) < 10 * rtol
        assert np.all(found.solver_state.reason == 0)
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
    assert np.all(found.solver_state.reason == 1)
    assert np.all(found.solver_state.steps == 2)


def _largest(tree):
    return jnp.max(jnp.stack([jnp.abs(x).max() for x in jax.tree.leaves(tree)]))


@pytest.mark.parametrize("rtol", [1e-5, pytest.param(1e-10, marks=pytest.mark.slow)])
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


def test_gradients():
    point = (jnp.asarray(MOMENTS[0]), jnp.asarray(STRENGTH))
    truth = [float(x) for x in TRUTH["slopes"]]
    forward = jax.jit(
        jax.jacfwd(
            lambda *p: _loss(*p, Extrapolation(8), 30, diffrax.ForwardMode()), argnums=(0, 1)
        )
    )(*point)
    np.testing.assert_allclose(forward, truth, rtol=1e-9)


def test_an_odd_order_is_refused():
    with pytest.raises(ValueError, match="order"):
        Extrapolation(7)


def test_kernel_with_unused_operands_and_other_operations():
    x = jnp.arange(5.0)
    calls = []
    jax.jit(kernel(lambda a: calls.append(0) or jnp.sort(-a)))(jnp.ones(3))
    assert len(calls) == 1  # a function that cannot be fused is not traced again
    add = kernel(lambda a, unused, b: a + b)
    np.testing.assert_array_equal(jax.jit(add)(x, x * 2, x), 2 * x)
    np.testing.assert_array_equal(jax.jit(kernel(lambda a: jnp.sort(-a)))(x), -x[::-1])
    assert jax.jit(jax.grad(lambda a: add(a, a, a * a).sum()))(x)[2] == 5.0
    np.testing.assert_array_equal(jax.vmap(add)(x, x, x), 2 * x)


def test_a_compiled_unit_takes_constants():
    """XLA would move them into the kernel, and abort the process because of the unused operand."""
    table = np.random.default_rng(0).normal(size=(1000, 4))

    def motion(x, table):
        for k in (1, 2, 3):
            x = x / 2 + table[:, 0] * np.pi * k + table[:, k]
        return x, 2 * x

    x = np.linspace(0.0, 1.0, 1000)
    found = jax.jit(lambda x: kernel(motion)(x * x, jnp.asarray(table)))(x)
    np.testing.assert_allclose(found, motion(x * x, table), rtol=1e-14, atol=1e-14)
