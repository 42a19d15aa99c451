"""Derivatives of the exact flow, forward and reverse, with any solver, in ``simulate`` and outside.

Against differences of the values, 40-digit derivatives, and motions in closed form.
"""

import json
from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from solvers import make_integrators_truth as bodies
from solvers.heavy_top import heavy_top

import polhode as ph
from polhode import Extrapolation, FlowAdjoint, rotation
from polhode._hamiltonian import (
    Dynamics,
    Hamiltonian,
    LiePoissonCostate,
    LiePoissonUnits,
    lie_poisson_field,
)
from polhode._integrate import Accuracy
from polhode._kernels import linear
from polhode._scene import AlongZ

KEYS = jax.random.split(jax.random.key(7), 8)
WXYZ = rotation.normalise(jax.random.normal(KEYS[0], (3, 4)))
OMEGA = jax.random.normal(KEYS[1], (3, 3))
MOMENTS = jnp.array([[1.0, 1.5, 2.0], [1.2, 1.1, 0.9], [2.0, 1.5, 1.0]])
METHOD = ph.LiePoisson(Extrapolation(12), chunk=2)  # chunks smaller than the batch


def driven(p):
    """Gravity, a torque that depends on time and on closed-over values, and strong drag."""
    push = ph.BodyTorque(lambda t: jnp.stack([jnp.sin(p["rate"] * t), 0 * t, p["rate"] + 0 * t]))
    weight = ph.UniformGravity(p["rate"], p["centre"], 0 * p["centre"] - 2)
    drag = ph.LinearDamping(8 * p["centre"])
    return ph.Scene(ph.Inertia.from_moments(p["moments"]), weight, push + drag)


def loss(p):
    """Of three saved states, of all bodies, and of the work (which requires the equations of any
    field for the derivatives); ``last`` shifts the times.
    """
    scene, state = driven(p), ph.State(p["wxyz"], p["omega"])
    ts = jnp.stack([0.2 * p["last"], p["last"] / 2, p["last"]])
    end = ph.simulate(scene, state, ts, METHOD, rtol=1e-12, record=ph.Record(work=True))
    moved = jnp.sum(end.wxyz[:, 1:, 1] ** 2) + jnp.sum(jnp.sin(end.omega_body))
    return moved + 0.1 * jnp.sum(end.work)


def point():
    return {
        "moments": MOMENTS,
        "centre": jnp.array([0.1, 0.0, 0.5]),
        "rate": jnp.array(0.7),
        "wxyz": WXYZ,
        "omega": OMEGA,
        "last": jnp.array(3.0),
    }


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


@pytest.mark.slow  # both modes of a heavy top below, gradients of every torque: tests/systems
def test_both_modes_are_the_slope():
    p = point()
    direction = along(p, 3)
    fn = loss
    both = jax.jit(lambda p, d: jax.jvp(fn, (p,), (d,)))
    want = difference(lambda p: both(p, direction)[0], p, direction)
    slopes = jax.jit(jax.grad(fn))(p)
    products = jax.tree.map(lambda s, d: jnp.sum(s * d), slopes, direction)
    np.testing.assert_allclose(sum(jax.tree.leaves(products)), want, rtol=1e-9)
    assert all(abs(float(x)) > 1e-6 for x in jax.tree.leaves(products))  # all have an effect
    np.testing.assert_allclose(both(p, direction)[1], want, rtol=1e-9)


def value(inverse):
    """Of heavy tops; each row of ``inverse`` is the reciprocal of one moment, for all bodies."""
    dtype = inverse.dtype
    numbers = (jnp.array(x, dtype) for x in (1.0, (0.1, 0.0, 0.5), (0.0, 0.0, -1.0)))
    unit = ph.Inertia.from_moments(jnp.ones(3, dtype))
    weight = AlongZ(ph.UniformGravity(*numbers), -jnp.ones((), dtype))
    energy = Hamiltonian(tuple(inverse), unit, weight)
    units = LiePoissonUnits(jnp.ones(3, dtype), jnp.ones(3, dtype))
    dynamics = Dynamics(energy, None, units, LiePoissonCostate.of)
    y = jax.tree.map(lambda x: x.astype(dtype), (tuple(OMEGA.T), tuple(WXYZ.T)))
    assert LiePoissonCostate.of(dynamics, y, jnp.zeros((), dtype)).row == 2
    span = jnp.array([0.0, 1.0], dtype)
    solver = Extrapolation(None, accuracy=Accuracy(1e-12 if dtype == jnp.float64 else 1e-6, 1.0))
    end = diffrax.diffeqsolve(
        diffrax.ODETerm(lie_poisson_field),
        solver,
        *span,
        None,
        y,
        dynamics,
        stepsize_controller=diffrax.StepTo(span),
        adjoint=FlowAdjoint(),
        max_steps=1,
    )
    return sum(jnp.sum(jnp.sin(x)) for x in jax.tree.leaves(end.ys))


def test_an_array_as_long_as_the_batch_is_one_that_the_bodies_share():
    """The moment (3,) of a magnet in three bodies, each of which has its own steps."""
    inertia, field = ph.Inertia.from_moments([1.0, 1.5, 2.0]), jnp.array([0.0, 0.0, 0.5])
    state = ph.State(
        jnp.tile(jnp.array([0.9, 0.1, 0.4, 0.1]), (3, 1)),
        jnp.array([[0.1, 0.2, 0.3], [1.0, 2.0, 0.5], [0.3, 0.1, 3.0]]),
    )

    @jax.jit
    @jax.value_and_grad
    def loss(magnet):
        potential = ph.Potential(lambda R, t: -field @ (R @ magnet))
        motion = ph.simulate(ph.Scene(inertia, potential), state, [0.0, 5.0])
        return jnp.sum(motion.omega_body[0, -1])

    magnet, h = jnp.array([0.1, 0.4, 0.2]), 1e-4
    slopes = loss(magnet)[1]
    ends = [[loss(magnet.at[i].add(s * h))[0] for s in (1, -1)] for i in range(3)]
    expected = [(a - b) / (2 * h) for a, b in ends]
    np.testing.assert_allclose(slopes, expected, rtol=1e-6)


@pytest.mark.slow
def test_batches_of_slopes():
    """vmap over gradients, Jacobians in both modes."""
    point = 1 / MOMENTS.T
    slopes = jax.jit(jax.vmap(jax.grad(value)))(jnp.stack([point, 1.1 * point]))
    forward = jax.jit(jax.vmap(jax.jacfwd(value)))(jnp.stack([point, 1.1 * point]))
    np.testing.assert_allclose(slopes, forward, rtol=0, atol=1e-11)


@pytest.mark.parametrize("kind", ["exact equations", "recorded steps"])
@pytest.mark.parametrize("inner", [jax.jacrev, jax.jacfwd])
def test_reverse_mode_of_a_derivative_says_what_to_take(kind, inner):
    """The error names jax.hessian, not JAX's loops; for closed forms reverse mode works."""
    torque = ph.FeedbackTorque(lambda t, wxyz, omega: -jnp.maximum(omega, 0))
    pull = ph.UniformGravity(1.0, [0.1, 0.0, 0.5])
    acts = {"exact equations": (pull,), "recorded steps": (None, torque)}[kind]

    def loss(moments):
        scene = ph.Scene(ph.Inertia.from_moments(moments), *acts)
        return ph.simulate(scene, ph.State(WXYZ[0], OMEGA[0]), [0.0, 1.0]).last.omega_body[0]

    with pytest.raises(NotImplementedError, match=r"take jax.hessian\(f\)"):
        jax.make_jaxpr(jax.jacrev(inner(loss)))(MOMENTS[0])


@pytest.mark.slow
def test_second_derivatives_of_chunks():
    """For bodies in several chunks the Hessian is that of one chunk, and symmetric."""
    state, push = ph.State(WXYZ, OMEGA), ph.BodyTorque([0.1, 0.0, -0.2])

    def loss(x, chunk):
        weight = ph.UniformGravity(1.0, [0.1, 0.0, 0.5], jnp.array([0.0, 0.0, -1.0]) * x[0])
        scene = ph.Scene(ph.Inertia.from_moments(MOMENTS * x[1]), weight, push)
        method = ph.LiePoisson(Extrapolation(10), chunk=chunk)
        record = ph.Record(final_only=True)
        end = ph.simulate(scene, state, [0.0, 1.0], method, rtol=1e-11, record=record)
        return jnp.sum(jnp.sin(end.omega_body)) + jnp.sum(end.wxyz[..., 1] ** 2)

    x, step = jnp.array([1.0, 1.2]), jnp.array([0.6, -0.8])
    cut = jax.jit(jax.hessian(partial(loss, chunk=2)))(x)
    np.testing.assert_allclose(cut, cut.T, rtol=0, atol=1e-8)
    change = difference(jax.jit(jax.grad(partial(loss, chunk=3))), x, step)
    assert np.min(np.abs(change)) > 1e-2
    np.testing.assert_allclose(cut @ step, change, rtol=0, atol=1e-8)


TRUTH = json.loads(bodies.FILE.read_text())
END = bodies.TIMES[-1]
TIGHT = diffrax.PIDController(rtol=1e-12, atol=1e-12)
SOLVES = {  # solver, controller
    "marched": (Extrapolation(None, accuracy=Accuracy(1e-12, END)), None),
    "stock": (diffrax.Dopri8(), TIGHT),
    "implicit": (diffrax.Kvaerno5(), diffrax.PIDController(rtol=1e-6, atol=1e-8)),
}


def solved(name, args, ts, t0=0.0):
    """Tops in diffrax alone: (7, T, N), wxyz first."""
    solver, controller = SOLVES[name]
    saveat = diffrax.SaveAt(ts=ts)
    if controller is None:  # a march has its states at its ends only
        controller = diffrax.StepTo(jnp.concatenate([jnp.asarray(t0, ts.dtype)[None], ts]))
        saveat = diffrax.SaveAt(steps=True)
    y0 = tuple(
        tuple(jnp.array(x) for x in np.transpose(part))
        for part in (np.array(bodies.OMEGA) * bodies.MOMENTS, bodies.WXYZ)
    )
    momentum, wxyz = diffrax.diffeqsolve(
        diffrax.ODETerm(heavy_top),
        solver,
        t0,
        ts[-1],
        None,
        y0,
        args,
        saveat=saveat,
        stepsize_controller=controller,
        adjoint=FlowAdjoint(1e-12),
        max_steps=256,
    ).ys
    return jnp.stack([x[: ts.shape[0]] for x in (*wxyz, *momentum)])


def arguments(first, strength):
    inverse = (1 / first, *(jnp.asarray(1 / i) for i in bodies.MOMENTS[1:]))
    return tuple(jnp.broadcast_to(i, 3) for i in inverse), jnp.broadcast_to(strength, 3)


@pytest.mark.parametrize("name", SOLVES)
@pytest.mark.slow
def test_outside_of_simulate_any_solver_has_the_slopes_of_the_flow(name):
    """Of the last state with respect to a moment and the strength of the field, 40 digits; the
    steps of the implicit solver are coarse, its derivatives are not.
    """

    def loss(p):
        last = solved(name, arguments(*p), jnp.array([0.75, END]))[:, -1]
        return jnp.sum(jnp.array(bodies.WEIGHTS, float)[:, None] * last)

    p = jnp.array([bodies.MOMENTS[0], bodies.STRENGTH])
    want = [float(x) for x in TRUTH["slopes"]]
    rtol = 1e-4 if name == "implicit" else 1e-10  # backward from the computed end
    both = jax.jit(lambda p: (jax.jacrev(loss)(p), jax.jacfwd(loss)(p)))(p)
    for slopes in both:
        np.testing.assert_allclose(slopes, want, rtol=rtol)
    np.testing.assert_allclose(*both, rtol=1e-5 if name == "implicit" else 2e-10)


@pytest.mark.parametrize("end", [0.5, -0.5])
def test_one_step_is_what_the_loop_of_diffrax_makes_of_it(end):
    """With two times there is no loop; entries for further steps do not change."""
    ts = jnp.array([0.0, end])
    subs = [
        diffrax.SubSaveAt(t0=True, steps=1),
        diffrax.SubSaveAt(t0=True, t1=True, fn=lambda t, y, args: (t, 2 * y[0])),
        diffrax.SubSaveAt(steps=1, t1=True),
    ]

    def solved(adjoint):
        return diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, args: (args * y[1], t - y[0])),
            diffrax.Dopri5(),
            ts[0],
            ts[-1],
            None,
            (jnp.ones(2), jnp.zeros(2)),
            jnp.array(2.0),
            max_steps=3,
            saveat=diffrax.SaveAt(subs=subs),
            stepsize_controller=diffrax.StepTo(ts),
            adjoint=adjoint,
            throw=False,
        )

    ours, theirs = solved(FlowAdjoint()), solved(diffrax.ForwardMode())
    assert ours.ts[0].tolist() == [0, end, np.inf, np.inf]
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-15, atol=1e-15)


@pytest.mark.slow
def test_slopes_by_saved_times_are_the_field():
    """At each of them; a later start alone equals an earlier end."""
    args, ts = arguments(jnp.array(bodies.MOMENTS[0]), jnp.array(bodies.STRENGTH)), bodies.TIMES
    ts = jnp.array([t for t in ts if t not in (0.1, 1.0)])

    @jax.jit
    def slopes(ts, t0):
        def moved(ts, t0):
            return solved("stock", args, ts, t0)

        return moved(ts, t0), *jax.jacrev(moved, (0, 1))(ts, t0), *jax.jacfwd(moved, (0, 1))(ts, t0)

    y, *found = slopes(ts, jnp.zeros(()))
    rows = jax.tree.map(lambda x: x[None], args)
    rate, turn = heavy_top(0.0, (tuple(y[4:]), tuple(y[:4])), rows)
    field = jnp.stack([*turn, *rate])
    own = jnp.einsum("ctn,ts->ctns", field, jnp.eye(len(ts)))
    for by_ts, by_t0 in (found[:2], found[2:]):
        np.testing.assert_allclose(by_ts, own, rtol=0, atol=1e-12)
        np.testing.assert_allclose(by_t0, -field, rtol=0, atol=1e-9)


def drawn_together(t, y, args):
    """Angle x and rate v under a constant torque and quadratic drag: v' = a (c^2 - v^2)."""
    _, v = y
    a, c = args
    return v, a * (c**2 - v**2)


@pytest.mark.parametrize("mode", [jax.jacrev, jax.jacfwd])
@pytest.mark.slow
def test_saved_times_keep_the_way_back_from_states_drawn_together(mode):
    """States converge like exp(-28): backward in one part, rounding of the start would grow by
    exp(28).
    """
    span = 4.0

    def exact(p):
        a, c, v0 = p
        k = jnp.arctanh(v0 / c)
        log = [jnp.log(jnp.cosh(x)) for x in (a * c * span + k, k)]
        return (log[0] - log[1]) / a

    def angle(p, intervals):
        a, c, v0 = p
        y0 = jnp.zeros(1), v0[None]
        ts = jnp.linspace(0, span, intervals + 1)
        saved = diffrax.diffeqsolve(
            diffrax.ODETerm(drawn_together),
            Extrapolation(None, accuracy=Accuracy(1e-12, span)),
            ts[0],
            ts[-1],
            None,
            y0,
            (a, c),
            stepsize_controller=diffrax.StepTo(ts),
            saveat=diffrax.SaveAt(steps=True),
            adjoint=FlowAdjoint(),
            max_steps=intervals,
        )
        return saved.ys[0][-1, 0]

    p = jnp.array([1.75, 2.0, 0.5])
    want = jax.grad(exact)(p)
    found = [jax.jit(mode(partial(angle, intervals=n)))(p) for n in (1, 8)]
    np.testing.assert_allclose(found[1], want, rtol=1e-9)
    if mode is jax.jacrev:
        assert np.isnan(found[0]).all()  # without the saved times it is NaN


@pytest.mark.parametrize(
    ("n", "times", "final_only", "pulsed"),
    [
        (5, [0.0, 4.0], True, False),
        pytest.param(70, [0.0, 4.0], True, False, marks=pytest.mark.slow),
        pytest.param(70, [0.0, 4.0], False, False, marks=pytest.mark.slow),
        pytest.param(70, [0.0, 1.0, 2.5, 4.0], True, False, marks=pytest.mark.slow),
        pytest.param(70, [0.0, 1.0, 2.5, 4.0], False, False, marks=pytest.mark.slow),
        pytest.param(70, [0.0, 0.05, 4.0], False, True, marks=pytest.mark.slow),
    ],
)
def test_a_damped_batch_is_followed_back(n, times, final_only, pulsed):
    """Spheres that stop like exp(-28), with a gain that the torque closes over; an ordinary call
    takes no additional step. ``pulsed``: with edges in the program. With more bodies than SIMD
    lanes the program would take twice as long to compile.
    """
    ts = jnp.array(times)
    omega = 1 + jax.random.uniform(jax.random.key(1), (n, 3))
    state = ph.State(jnp.broadcast_to(jnp.array([1.0, 0, 0, 0]), (n, 4)), omega)
    record = ph.Record(final_only=final_only)

    def rates(gain):
        drag = ph.FeedbackTorque(lambda t, wxyz, omega_body: -gain * omega_body)
        if pulsed:
            drag = ph.LinearDamping(gain) + ph.Pulses(ph.BodyTorque([0.0, 0.0, 0.0]), [0.1], [0.2])
        scene = ph.Scene(ph.Inertia.from_moments([1.0, 1.0, 1.0]), torque=drag)
        trajectory = ph.simulate(scene, state, ts, record=record)
        return trajectory.omega_body[:, -1], trajectory.steps

    gain = jnp.array(7.0)
    plain, steps = jax.jit(rates)(gain)
    value, pull, steps_with_slopes = jax.jit(lambda k: jax.vjp(rates, k, has_aux=True))(gain)
    want = omega * jnp.exp(-gain * 4)
    np.testing.assert_allclose(plain, want, atol=1e-8)
    np.testing.assert_allclose(value, want, atol=1e-8)
    np.testing.assert_allclose(pull(jnp.ones((n, 3)))[0], -4 * jnp.sum(want), rtol=1e-5)
    assert jnp.all(steps_with_slopes > steps)


SHORT_SPANS = [[1e5, 1e5 + 1 / 32], [1e5, 1e5 - 1 / 128]]


def total_rate(gain, ts, n):
    """The sum of the last rates of spheres under drag with a gain."""
    omega = np.broadcast_to(np.array([0.3, 0.2, 0.5], np.float32), (n, 3))
    inertia = ph.Inertia.from_moments(jnp.ones(3, jnp.float32))
    scene = ph.Scene(inertia, torque=ph.LinearDamping(gain) + ph.BodyTorque(0 * omega))
    state = ph.State(jnp.array([1.0, 0, 0, 0], jnp.float32), omega)
    return jnp.sum(ph.simulate(scene, state, ts).omega_body[:, -1])


@partial(jax.jit, static_argnums=2)
def forward(gain, ts, n):
    return jax.jvp(lambda k: total_rate(k, ts, n), (gain,), (jnp.ones_like(gain),))


reverse = jax.jit(jax.value_and_grad(total_rate), static_argnums=2)


@pytest.mark.parametrize("ts", SHORT_SPANS)
@pytest.mark.parametrize(
    ("n", "both"),
    [
        (5, reverse),
        pytest.param(70, reverse, marks=pytest.mark.slow),
        pytest.param(70, forward, marks=pytest.mark.slow),  # of longer spans: test_work_and_error
    ],
    ids=["few", "reverse", "forward"],
)
def test_a_span_of_few_units_in_the_last_place_is_followed_back(n, both, ts):
    """Single precision resolves a 128th of a second there: restarts are impossible."""
    ts, gain = jnp.array(ts, jnp.float32), jnp.float32(0.5)
    value, slope = both(gain, ts, n)
    span = ts[1] - ts[0]
    want = n * jnp.exp(-gain * span)  # the rates of each sum to 1 rad/s
    np.testing.assert_allclose(value, want, rtol=1e-5)
    np.testing.assert_allclose(slope, -span * want, rtol=1e-4)


def test_what_cannot_be_differentiated_is_refused():
    def last(saveat, event=None):
        y0 = jnp.zeros(1), jnp.ones(1)
        return diffrax.diffeqsolve(
            diffrax.ODETerm(drawn_together),
            diffrax.Dopri8(),
            0.0,
            1.0,
            0.1,
            y0,
            (1.0, 2.0),
            saveat=saveat,
            adjoint=FlowAdjoint(),
            event=event,
        )

    both = diffrax.SaveAt(subs={"a": diffrax.SubSaveAt(t1=True), "b": diffrax.SubSaveAt(t0=True)})
    event = diffrax.Event(lambda t, y, args, **_: t > 0.5)
    for given in ((both,), (diffrax.SaveAt(t1=True), event)):
        with pytest.raises(ValueError, match="FlowAdjoint differentiates states at saved times"):
            last(*given)


WEIGHTS = jnp.array([0.7, -0.4, 0.9, 0.3, -0.5, 0.8, 0.6])
DRIVEN = {
    "moment": jnp.array(1.3),
    "drag": jnp.array(9.0),
    "push": jnp.array(7.0),
    "rate": jnp.array(2.0),
}


def held(p, method):
    """A body that a torque drives about its z axis to the terminal rate of its drag, in closed
    form.

    It forgets the initial state like exp(-28).
    """
    along = jnp.array([0.0, 0.0, 1.0])
    inertia = ph.Inertia.from_moments(jnp.array([0.8, 1.0, 0.0]) + along * p["moment"])
    act = ph.BodyTorque(along * p["push"]) + ph.LinearDamping(p["drag"] * jnp.ones(3))
    state = ph.State([0.6, 0.0, 0.8, 0.0], along * p["rate"])
    record = ph.Record(final_only=True)
    end = ph.simulate(ph.Scene(inertia, None, act), state, [0.0, 4.0], method, record=record)
    return jnp.sum(WEIGHTS[:4] * end.wxyz[0]) + jnp.sum(WEIGHTS[4:] * end.omega_body[0])


@pytest.mark.slow  # the parts themselves: test_parts_keep_the_way_back_from_states_drawn_together
def test_the_way_back_starts_anew_where_drag_draws_bodies_together():
    """By default, in ``simulate``."""
    method = ph.LiePoisson(Extrapolation(12))
    exact = jax.grad(held)(DRIVEN, ph.FixedAxis())
    found = jax.grad(held)(DRIVEN, method)
    step = {name: jnp.array(x) for name, x in zip(DRIVEN, (0.5, -1.0, 0.7, 2.0))}
    _, change = jax.jvp(lambda p: held(p, method), (DRIVEN,), (step,))
    want = sum(jax.tree.leaves(jax.tree.map(jnp.multiply, exact, step)))
    np.testing.assert_allclose(change, want, rtol=1e-9)
    for name, want in exact.items():
        np.testing.assert_allclose(found[name], want, rtol=1e-9, atol=1e-10, err_msg=name)


def test_linear_maps_transpose_by_the_other_program():
    """Including zeros, constant operands and batches."""

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
