"""Kinks and jumps of a field: detected in its program, ends of steps, and passed by derivatives."""

import functools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import Primitive
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import polhode as ph
from polhode import rotation
from polhode._integrate import Automatic
from polhode._integrate._explicit_step import dense_of, dense_state
from polhode._integrate._switches import switches_of
from polhode._integrate._tableau import TSIT5
from polhode._kernels import smooth

MOMENTS = np.array([1.0, 1.5, 2.0])
INERTIA = ph.Inertia.from_moments(MOMENTS)
WXYZ, OMEGA = np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.31, -0.2, 1.0])
TS = np.linspace(0.0, 10.0, 11)
TABLE = jnp.array([-0.9, -0.1, 0.3, 0.8])


def program(fn, *examples):
    """``fn`` of one moving vector, with its switches apart."""
    return switches_of(jax.make_jaxpr(fn)(*examples), [True] * len(examples), jnp.float64)


@pytest.mark.parametrize(
    ("fn", "count", "jumps"),
    [
        (lambda x: jnp.maximum(x, 0.0), 3, False),
        (lambda x: jnp.clip(x, -1.0, 1.0), 6, False),
        (jnp.abs, 3, False),
        (jax.nn.relu, 3, False),
        (jnp.sign, 3, True),
        (lambda x: jnp.where(x[0] > 0.2, x, -x), 1, True),
        (jnp.floor, 3, True),
        (lambda x: jnp.round(2 * x), 3, True),
        (lambda x: x % 1.0, 6, True),
        (lambda x: TABLE[jnp.searchsorted(TABLE[:3], x)], 6, True),
        (lambda x: jnp.interp(x, TABLE, TABLE**2), None, True),
        (lambda x: TABLE[jnp.argmax(x)] * x, 2, True),
        (lambda x: TABLE[jnp.argsort(x)], 3, True),
        (lambda x: jax.lax.top_k(x, 2)[0], 3, True),
        (jax.lax.cummax, 2, False),
        (lambda x: x.astype(jnp.int32).astype(x.dtype), 3, True),
        (jnp.max, 2, False),
        (jnp.sort, 3, False),
        (lambda x: x[jnp.argmax(x)], 2, True),
        (lambda x: jnp.arctan2(x[0], x[1]), 1, True),
        (lambda x: jax.lax.cond(x[0] > 0, jnp.sin, jnp.cos, x), 1, True),
        (jax.jit(lambda x: jnp.maximum(x, 0.0)), 3, False),
        (jax.checkpoint(lambda x: jnp.maximum(x, 0.0)), 3, False),
        (lambda x: jax.lax.scan(lambda s, row: (s + jnp.abs(row), row), 0.0, x)[0], 3, False),
        (lambda x: jnp.interp(x[0], jnp.arange(4.0), jnp.array([0.0, 1.0, 0.5, 2.0])), None, True),
        (lambda x: jnp.linalg.norm(x), 0, False),
        (lambda x: jnp.log(jax.lax.complex(x[0] - 2, x[1])).imag, 1, True),
        (lambda x: jnp.sqrt(jax.lax.complex(x[0] - 2, x[1])).imag, 1, True),
        (lambda x: (jax.lax.complex(x[0] - 2, x[1]) ** 0.3).imag, 1, True),
        (lambda x: jnp.where(jnp.clip(x, -1.0, 1.0) == x, 1.0, 0.5) + jnp.abs(x), 9, True),
        (lambda x: jax.jit(jnp.where)(jnp.maximum(x, 0.0).astype(bool), 0.5, 0.0), 3, True),
        (lambda x: jnp.where(jnp.isnan(jnp.maximum(x, 0.0)), 0.0, x), 3, False),
        (jax.grad(jnp.max), 2, True),
        (jax.grad(lambda x: jnp.sum(jnp.maximum(x, 0.2))), 3, True),
        (smooth(lambda x: jnp.where(x > 0, x, x)), 0, False),
    ],
)
def test_every_switch_of_a_program_is_found(fn, count, jumps):
    """With constant levels of a point, the program has the same values near it, and no kink."""
    x = jnp.array([0.3, -0.7, 1.4])
    found = program(fn, x)
    if count is not None:
        assert found.count == count
    assert not found.hidden_operations
    assert bool(found.jumps.any()) == jumps or count is None
    levels = found.levels(x)
    (value, *_), margins, _ = found.frozen(levels, x)
    np.testing.assert_allclose(value, fn(x), atol=1e-15)
    assert (np.asarray(margins) >= 0).all()
    line = jax.vmap(lambda s: found.frozen(levels, x + s)[0][0])(jnp.linspace(-1.0, 1.0, 9))
    bends = np.diff(np.asarray(line), 2, axis=0)
    assert np.abs(bends).max() < 0.5


def test_differences_of_clipped_values_do_not_consist_of_rounding():
    """Compilers may round only one of the products in u - clip(u), u = a b: its sign is noise."""

    def excess(x):
        return jnp.clip(x, -1.0, 1.0) - x * (1 + jnp.finfo(x.dtype).eps)

    x = jnp.array([0.3, -0.7, 1.4])
    found = program(excess, x)
    (value, *_), *_ = found.frozen(found.levels(x), x)
    np.testing.assert_allclose(value, [0, 0, -0.4], rtol=1e-14)
    slope = jax.jacfwd(lambda x: found.frozen(found.levels(x), x)[0][0])(x)
    np.testing.assert_allclose(slope, jax.jacfwd(excess)(x), rtol=0, atol=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_law_that_asks_whether_it_is_clipped_does_not_slide(dtype):
    """Until it is, the difference is the rounding of a product, whose sign changes in each step."""

    def law(lib, rates):
        command = dtype(-1.03) * rates
        limited = lib.clip(command, dtype(-0.2), dtype(0.2))
        return lib.where(lib.isclose(command, limited), dtype(-0.05), dtype(0.1)) + limited

    torque = ph.FeedbackTorque(lambda t, wxyz, omega: law(jnp, omega))
    scene = ph.Scene(ph.Inertia.from_moments(MOMENTS.astype(dtype)), torque=torque)
    omega = np.array([[0.2, 0.5, -0.1], [-0.6, 0.3, 0.5], [0.05, -0.3, 0.9]], dtype)
    traj = ph.simulate(scene, ph.State(WXYZ.astype(dtype), omega), np.array([0, 4], dtype))
    for start, end in zip(omega.astype(float), traj.last.omega_body):

        def field(t, rates):
            return (law(np, rates) - np.cross(rates, MOMENTS * rates)) / MOMENTS

        want = solve_ivp(field, (0, 4), start, max_step=2e-3).y[:, -1]
        np.testing.assert_allclose(end, want, rtol=0, atol=3e-4)


def test_samples_of_an_attitude_are_no_switches():
    """The pieces of the interpolant join with two continuous derivatives. The two switches are
    those of the sine of a small angle.
    """
    lead = ph.simulate(ph.Scene(INERTIA), ph.State(WXYZ, OMEGA), TS)
    attitude = ph.frames.RotatingFrame.from_trajectory(lead).attitude
    assert program(attitude, jnp.zeros(())).count == 2


def test_what_cannot_be_looked_into_is_named():
    def halved(x):
        return jax.lax.while_loop(lambda s: jnp.sum(s * s) > 1, lambda s: s / 2, x)

    assert program(halved, jnp.ones(3)).hidden_operations == ("while",)
    found = program(lambda x: jnp.arccos(jax.lax.complex(x, x)).real, jnp.ones(3))
    assert found.hidden_operations == ("acos",)
    scene = ph.Scene(INERTIA, None, ph.FeedbackTorque(lambda t, wxyz, omega: halved(omega)))
    state = ph.State(WXYZ, OMEGA)
    assert "contains while" in str(ph.explain(scene, state, TS))
    assert ph.simulate(scene, state, TS[:3]).successful


def test_an_unknown_operation_that_makes_integers_is_named():
    """Newer versions of JAX may add operations, whose jumps must not be missed."""
    counted = Primitive("counted")
    counted.def_impl(lambda x: jnp.sum(x > 0))
    counted.def_abstract_eval(lambda x: jax.core.ShapedArray((), jnp.int32))
    found = program(lambda x: counted.bind(x).astype(x.dtype) * x, jnp.ones(3))
    assert found.hidden_operations == ("counted",)
    among = Primitive("among")
    among.def_impl(lambda k, x: jnp.sum(x > k))
    among.def_abstract_eval(lambda k, x: jax.core.ShapedArray((), jnp.int32))
    found = program(lambda x: among.bind(jnp.int32(1), x).astype(x.dtype) * x, jnp.ones(3))
    assert found.hidden_operations == ("among",)
    # pivots are integers, too, but what is solved with them does not jump
    solved = program(lambda x: jnp.linalg.solve(jnp.outer(x, x) + jnp.eye(3), x), jnp.ones(3))
    assert not solved.hidden_operations


class HiddenJump(eqx.Module):
    """A torque about z that doubles above a rate of 1 rad/s, computed inside a loop."""

    torque: jax.Array

    def __call__(self, t, wxyz, omega):
        above = jax.lax.while_loop(
            lambda x: (omega[2] > 1) & (x == 0), lambda x: x + 1.0, 0 * omega[2]
        )
        return -self.torque * (1 + above) * jnp.eye(3)[2]


@pytest.mark.parametrize("torque", [1e-2, pytest.param(1e-3, marks=pytest.mark.slow)])
def test_jumps_that_a_loop_hides_are_found(torque):
    """A ball is decelerated by 2 ``torque`` until its rate passes 1 rad/s, then by ``torque``:
    small compared with the rates, so that the jump is difficult to detect.
    """
    span, rtol = 20.0, 1e-8
    passing = np.random.default_rng(6).uniform(1, 19, 48)
    omega = jnp.zeros((48, 3)).at[:, 2].set(1 + 2 * torque * passing)
    later = span - passing
    angle = (1 + torque * passing) * passing + (1 - torque * later / 2) * later
    state = ph.State(jnp.tile(jnp.eye(4)[0], (48, 1)), omega)
    law = ph.FeedbackTorque(HiddenJump(jnp.asarray(torque)))
    scene = ph.Scene(ph.Inertia.spherical(1.0), torque=law)
    last = ph.simulate(scene, state, [0.0, span], rtol=rtol).last
    error = 2 * np.arctan2(last.wxyz[:, 3], last.wxyz[:, 0]) - angle
    error = np.abs((error + np.pi) % (2 * np.pi) - np.pi)
    assert error.max() < 3 * rtol


def test_of_equal_numbers_the_first_is_the_largest():
    x = jnp.array([0.0, 2.0, 2.0, 1.0, 2.0])
    found = program(jnp.argmax, x)
    assert found.frozen(found.levels(x), x)[0][0] == jnp.argmax(x) == 1


def test_steps_end_at_the_knots_of_a_table():
    """A torque linear between 101 times: two integrals of the table, exactly."""
    times = jnp.linspace(0.0, 10.0, 101)
    values = jnp.asarray(np.random.default_rng(8).normal(size=101))
    law = lambda t, q, w: jnp.interp(t, times, values) * jnp.eye(3)[2]  # noqa: E731
    scene = ph.Scene(ph.Inertia.spherical(1.0), torque=ph.FeedbackTorque(law))
    trajectory = ph.simulate(scene, ph.State(WXYZ, np.zeros(3)), [0.0, 10.0], rtol=1e-4)
    start, stop = np.asarray(values[:-1]), np.asarray(values[1:])
    rates = np.concatenate([[0.0], np.cumsum(0.1 * (start + stop) / 2)])
    angle = np.sum(0.1 * rates[:-1] + 0.1**2 * (2 * start + stop) / 6)
    q = trajectory.last.wxyz
    np.testing.assert_allclose(trajectory.last.omega_body[2], rates[-1], atol=1e-12)
    np.testing.assert_allclose(np.cos(2 * np.arctan2(q[3], q[0]) - angle), 1, atol=1e-16)
    assert trajectory.steps < 110


def looked_up(p, rate):
    """Deceleration in five ranges of the rate, from a table with the knots ``p`` times ..."""
    knots = p * jnp.array([0.2, 0.4, 0.6, 0.8])
    return jnp.array([0.3, 0.05, 0.2, 0.1, 0.15])[jnp.digitize(rate, knots)]


def largest(p, rate):
    """The same in two ranges, from the index of the largest of three numbers."""
    return jnp.array([0.1, 0.2, 0.3])[jnp.argmax(jnp.stack([p, rate, 0.1 * p]))]


@pytest.mark.slow  # the switches themselves: test_every_switch_of_a_program_is_found
def test_derivatives_through_a_kink_of_a_potential():
    """A constant torque from an angle on: the derivative of ``maximum`` compares for equality."""

    def final_rate(rate, torque):
        def energy(R, t):
            return torque * jnp.maximum(jnp.arctan2(R[1, 0], R[0, 0]) - 0.5, 0.0)

        scene = ph.Scene(ph.Inertia.spherical(1.0), ph.Potential(energy))
        state = ph.State([1.0, 0, 0, 0], rate * jnp.eye(3)[2])
        return ph.simulate(scene, state, [0.0, 2.0]).last.omega_body[2]

    value, slopes = jax.jit(jax.value_and_grad(final_rate, (0, 1)))(1.0, 0.1)
    np.testing.assert_allclose(value, 1 - 0.1 * 1.5, rtol=1e-9)
    np.testing.assert_allclose(slopes, (1 - 0.1 * 0.5, -1.5), rtol=1e-8)


@pytest.mark.parametrize(
    "mode",
    [jax.jacfwd, pytest.param(jax.jacrev, marks=pytest.mark.slow)],
    ids=["forward", "reverse"],
)
@pytest.mark.parametrize(
    ("law", "p", "span", "slope"),
    [
        pytest.param(
            *(looked_up, 1.1, 4.0, 0.6 + 0.2 * (0.2 / 0.1 - 0.8 / 0.15)), marks=pytest.mark.slow
        ),
        (largest, 0.7, 3.0, 0.5),
    ],
    ids=["digitize", "argmax"],
)
def test_derivatives_through_a_table(law, p, span, slope, mode):
    """A search in a table changes several comparisons at once. In reverse mode: a jump below."""

    def final_rate(p):
        scene = ph.Scene(
            ph.Inertia.spherical(1.0),
            torque=ph.FeedbackTorque(lambda t, q, w: -law(p, w[2]) * jnp.eye(3)[2]),
        )
        state = ph.State([1.0, 0, 0, 0], [0.0, 0, 1.0])
        return ph.simulate(scene, state, [0.0, span], rtol=1e-9).last.omega_body[2]

    np.testing.assert_allclose(jax.jit(mode(final_rate))(p), slope, rtol=1e-7)


def test_derivatives_that_would_miss_jumps_are_refused():
    def signed(x, rate):
        negative = jax.lax.bitcast_convert_type(rate - x, jnp.int64) < 0
        return jnp.where(negative, 0.1, 0.2)

    def final_rate(x):
        law = lambda t, q, w: -signed(x, w[2]) * jnp.eye(3)[2]  # noqa: E731
        scene = ph.Scene(ph.Inertia.spherical(1.0), torque=ph.FeedbackTorque(law))
        state = ph.State([1.0, 0, 0, 0], [0.0, 0, 1.0])
        return ph.simulate(scene, state, [0.0, 3.0]).last.omega_body[2]

    with pytest.raises(NotImplementedError, match="bitcast_convert_type in a torque"):
        jax.grad(final_rate)(0.7)


def test_a_torque_that_calls_python_is_explained():
    def braking(t, wxyz, omega):
        return jax.pure_callback(lambda w: -0.1 * np.asarray(w), omega, omega)

    scene = ph.Scene(INERTIA, None, ph.FeedbackTorque(braking))
    assert "contains pure_callback" in str(ph.explain(scene, ph.State(WXYZ, OMEGA), TS))


@pytest.mark.parametrize(("rate", "jumps"), [(0.0, True), (1e-4, True), (0.0, False)])
def test_no_window_is_passed_by_a_body_that_hardly_turns(rate, jumps):
    """Torque within windows of time: between them, and within them, steps could have any length."""
    period, torque, size = 300.0, 1e-9, 2.0

    def law(t, wxyz, omega):
        wave = jnp.cos(2 * jnp.pi * t / period) - 0.9
        push = jnp.where(wave > 0, 1.0, 0.0) if jumps else jnp.maximum(wave, 0)
        return torque * push * jnp.eye(3)[2]

    scene = ph.Scene(ph.Inertia.spherical(size), torque=ph.FeedbackTorque(law))
    event = ph.Event(lambda wxyz, omega, t: jnp.cos(2 * jnp.pi * t / period) - 0.9)
    motion = ph.simulate(
        scene, ph.State([1.0, 0, 0, 0], [0.0, 0, rate]), [0.0, 30 * period], events=event
    )
    half = np.arccos(0.9)
    width = 2 * half if jumps else 2 * (np.sin(half) - 0.9 * half)
    push = 30 * width * period / (2 * np.pi) * torque / size
    np.testing.assert_allclose(motion.omega_body[-1, 2] - rate, push, rtol=1e-8)
    assert int(motion.events.count) == 60


class Checked(eqx.Module):
    """A brake that prints the time and raises an error above a rate about z."""

    limit: jax.Array

    def __call__(self, t, wxyz, omega):
        jax.debug.print("t={}", t)
        return -0.1 * eqx.error_if(omega, omega[2] > self.limit, "too fast")


def test_checks_and_prints_in_a_torque_do_as_they_say(capfd):
    """A check raises if its condition is violated, and a print shows its argument."""

    def rates(limit):
        scene = ph.Scene(ph.Inertia.spherical(1.0), None, ph.FeedbackTorque(Checked(limit)))
        return ph.simulate(scene, ph.State(WXYZ, [0.1, 0.2, 0.3]), [0.0, 1.0]).omega_body

    expected = np.exp(-0.1) * np.array([0.1, 0.2, 0.3])
    np.testing.assert_allclose(rates(jnp.asarray(100.0))[-1], expected, rtol=1e-8)
    jax.effects_barrier()
    assert "t=0.0" in capfd.readouterr().out
    with pytest.raises(RuntimeError, match="too fast"):
        jax.block_until_ready(rates(jnp.asarray(0.2)))


LAWS = {
    "clip": lambda p: lambda t, q, w: jnp.clip(-p[0] * w - p[1] * q[1:], -0.2, 0.2),
    "dead band": lambda p: (
        lambda t, q, w: -p[0] * jnp.where(jnp.abs(w) > p[1], w - jnp.sign(w) * p[1], 0.0)
    ),
    "short way": lambda p: lambda t, q, w: -p[0] * jnp.sign(q[0]) * q[1:] - p[1] * w,
    "pulse": lambda p: (
        lambda t, q, w: jnp.where(
            (t > p[1]) & (t < p[1] + 2), p[0] * jnp.array([1.0, -0.5, 0.2]), 0.0
        )
    ),
}


@functools.partial(jax.jit, static_argnums=2)
def moved(p, omega, law, rtol):
    scene = ph.Scene(INERTIA, None, ph.FeedbackTorque(LAWS[law](p)))
    return ph.simulate(scene, ph.State(WXYZ, omega), TS, rtol=rtol)


def truth(p, omega, law):
    """SciPy's motion, in pieces that end where a level of the law's program changes.

    The pieces are located by bisection on the law's own conditions, without polhode.
    """
    torque = jax.jit(LAWS[law](p))

    def field(t, y):
        q, w = y[:4], y[4:]
        n = np.asarray(torque(t, q, w))
        turn = np.concatenate([[-q[1:] @ w], q[0] * w + np.cross(q[1:], w)]) / 2
        return np.concatenate([turn, (n - np.cross(w, MOMENTS * w)) / MOMENTS])

    start = np.concatenate([WXYZ, np.asarray(omega)])
    return solve_ivp(
        field, (0, 10), start, method="DOP853", rtol=1e-11, atol=1e-11, max_step=1e-2
    ).y[:, -1]


@pytest.mark.parametrize(
    "law", [pytest.param("clip", marks=pytest.mark.slow), "pulse", "short way"]
)
def test_states_through_switches(law):
    """Without a declaration, at every tolerance; SciPy's steps of 0.01 s miss a jump by 1e-5."""
    p = jnp.array([0.4, 0.3])
    fine = moved(p, OMEGA, law, 1e-12)
    end = np.concatenate([fine.wxyz[-1], fine.omega_body[-1]])
    np.testing.assert_allclose(end, truth(p, OMEGA, law), atol=1e-8 if law == "clip" else 2e-5)
    for rtol in (1e-4, 1e-7, 1e-10):
        apart = ph.rotation.angle_between(moved(p, OMEGA, law, rtol).wxyz, fine.wxyz)
        assert float(apart.max()) < max(rtol, 1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("law", ["dead band", "short way", "pulse"])
def test_gradients_through_switches(law):
    """Both modes, against differences of the values; the error decreases with rtol. A kink of the
    rates, and jumps that depend on the attitude and on time.
    """
    p = jnp.array([0.4, 0.3])
    given = jnp.concatenate([p, OMEGA])

    def loss(given, rtol):
        found = moved(given[:2], given[2:], law, rtol)
        return jnp.sum(found.wxyz[-1] * jnp.arange(1.0, 5)) + jnp.sum(found.omega_body[5] ** 2)

    at, h = jax.jit(lambda x: loss(x, 1e-12)), 1e-5
    want = np.zeros(5)
    for i in range(5):
        a, b, c, d = (float(at(given.at[i].add(k * h))) for k in (-2, -1, 1, 2))
        want[i] = (8 * (c - b) - (d - a)) / (12 * h)
    size = np.linalg.norm(want)
    for rtol in (1e-5, 1e-8):
        for mode in (jax.grad, jax.jacfwd)[: 2 if rtol == 1e-8 else 1]:
            found = mode(lambda x, rtol=rtol: loss(x, rtol))(given)
            assert np.linalg.norm(found - want) < max(2 * rtol, 1e-8) * size


# w = w0 exp(p0 t) down to p1 < w0, then 0.1 t less
RATE, LEVEL, BEGIN = -0.2, 0.7, 1.0
MET = np.log(LEVEL / BEGIN) / RATE
FALLING = jnp.array([RATE, LEVEL]), jnp.array([0.0, 0.0, BEGIN])
# d MET / d RATE = -MET / RATE, d MET / d LEVEL = 1 / (RATE LEVEL), d MET / d BEGIN likewise
FALLING_SLOPES = np.array([-0.1 * MET / RATE, 1 + 0.1 / (RATE * LEVEL), -0.1 / (RATE * BEGIN)])


def falling(p, omega, max_steps=128):
    def law(t, wxyz, omega):
        return jnp.where(omega[2] > p[1], p[0] * omega, -0.1)

    scene = ph.Scene(ph.Inertia.spherical(1.0), None, ph.FeedbackTorque(law))
    method = ph.LiePoisson(Automatic(), max_steps=max_steps)
    return ph.simulate(scene, ph.State(WXYZ, omega), [0.0, 5.0], method).omega_body[-1, 2]


@pytest.mark.parametrize(
    "max_steps",
    [
        pytest.param(128, id="integrated again", marks=pytest.mark.slow),
        pytest.param(2**16, id="recorded"),
    ],
)
def test_a_gradient_through_a_jump(max_steps):
    """The time of a jump depends on the state and on the threshold, a parameter. Only 1/256 of the
    allowed steps is recorded: if more steps are taken, they are integrated again.
    """
    slope = jax.jit(jax.value_and_grad(lambda *x: falling(*x, max_steps), (0, 1)))
    value, (by_p, by_omega) = slope(*FALLING)
    np.testing.assert_allclose(value, LEVEL - 0.1 * (5 - MET), rtol=1e-9)
    np.testing.assert_allclose([*by_p, by_omega[2]], FALLING_SLOPES, rtol=1e-8)


def test_the_gradient_through_a_kink_keeps_a_tight_tolerance():
    """A kink located less accurately than ``rtol`` of a step causes an error of this size.
    w' = -k (w - p) - c above p, then w' = -c.
    """
    k, c, rtol = 2.0, 0.1, 1e-10

    def last(p, w):
        law = ph.FeedbackTorque(lambda t, wxyz, omega: -k * jax.nn.relu(omega - p) - c)
        scene, state = (
            ph.Scene(ph.Inertia.spherical(1.0), None, law),
            ph.State(WXYZ, w * jnp.ones(3)),
        )
        return ph.simulate(scene, state, [0.0, 5.0], rtol=rtol).omega_body[-1, 2]

    value, found = jax.jit(jax.value_and_grad(last, (0, 1)))(0.7, 1.0)
    above = 0.3 + c / k
    np.testing.assert_allclose(value, 0.7 - c * (5 - np.log(above * k / c) / k), rtol=1e-9)
    share = c / (k * above)
    np.testing.assert_allclose(found, [1 - share, share], rtol=0, atol=20 * rtol)


@pytest.mark.slow  # faster: a single body, test_a_gradient_through_a_jump
@pytest.mark.parametrize("how", ["batch", "grad of vmap", "vmap of grad"])
def test_recorded_steps_and_those_integrated_again_have_the_same_derivatives(how):
    starts = jnp.array(np.outer([1.0, 0.7, 1.3], OMEGA))
    gains = jnp.array([0.3, 0.8])

    def loss(gains, omega, max_steps):
        def law(t, wxyz, omega):
            return -gains[0] * jax.nn.relu(omega) - 0.1 * jnp.where(wxyz[0] > gains[1], 1, 0)

        wxyz = jnp.broadcast_to(jnp.array(WXYZ), (*omega.shape[:-1], 4))
        scene = ph.Scene(INERTIA, None, ph.FeedbackTorque(law))
        method = ph.LiePoisson(Automatic(), max_steps=max_steps)
        path = ph.simulate(scene, ph.State(wxyz, omega), [0.0, 3.0, 6.0], method)
        return jnp.sum(path.omega_body**2) + jnp.sum(path.wxyz[..., 1])

    def slopes(max_steps):
        one = lambda gains, omega: loss(gains, omega, max_steps)  # noqa: E731
        all_of = {
            "batch": jax.grad(one, (0, 1)),
            "grad of vmap": jax.grad(
                lambda gains, omega: jnp.sum(jax.vmap(one, (None, 0))(gains, omega)), (0, 1)
            ),
            "vmap of grad": jax.vmap(jax.grad(one, (0, 1)), (None, 0)),
        }[how]
        by_gains, by_omega = jax.jit(all_of)(gains, starts)
        return jnp.sum(by_gains.reshape(-1, 2), axis=0), by_omega

    for found, again in zip(slopes(2**16), slopes(128), strict=True):
        assert np.all(np.abs(found) > 1e-3)
        np.testing.assert_allclose(found, again, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("mode", [pytest.param(jax.jacfwd, marks=pytest.mark.slow), jax.grad])
def test_switches_that_turn_together_have_times_of_their_own(mode):
    """A relay on each axis, all three at the same rate: w' = -0.2 above a half, -0.05 below, so
    that a quarter of a change of the rate remains.
    """

    weights = jnp.array([1.0, -2.0, 0.5])

    def weighted(rates):
        law = lambda t, q, w: jnp.where(w > 0.5, -0.2, -0.05)  # noqa: E731
        scene = ph.Scene(ph.Inertia.spherical(1.0), torque=ph.FeedbackTorque(law))
        return weights @ ph.simulate(scene, ph.State(WXYZ, rates), [0.0, 4.0]).last.omega_body

    np.testing.assert_allclose(jax.jit(mode(weighted))(jnp.ones(3)), weights / 4, atol=2e-9)


@pytest.mark.slow
@pytest.mark.parametrize("bodies", [1, 5])
@pytest.mark.parametrize("ts", [[0.0, 3.0], [3.0, 0.0], [0.0, 0.25, 1.0, 1.7, 3.0]])
def test_a_pulse_may_begin_where_another_ends(bodies, ts):
    first, second = (jnp.array(n) for n in ([0.3, 0.0, 0.1], [0.0, 0.4, -0.2]))
    state = ph.State(WXYZ, jnp.tile(jnp.array([0.1, 0.2, 0.3]), (bodies, 1)))

    @jax.jit
    def final_rates(edges):
        pulses = (
            ph.Pulses(ph.BodyTorque(n), edges[2 * k, None], edges[2 * k + 1, None])
            for k, n in enumerate((first, second))
        )
        scene = ph.Scene(INERTIA, torque=sum(pulses, start=ph.BodyTorque(jnp.zeros(3))))
        return ph.simulate(scene, state, ts).omega_body[0, -1]

    edges, h = jnp.array([0.5, 1.0, 1.0, 2.0]), 1e-5
    moves = h * jnp.eye(4)
    expected = [(final_rates(edges + d) - final_rates(edges - d)) / (2 * h) for d in moves]
    for mode in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(mode(final_rates)(edges).T, expected, atol=1e-7)


@pytest.mark.slow  # faster: forward mode through jumps, test_derivatives_through_a_table
def test_a_tangent_through_a_jump():
    along = jnp.array([0.3, -0.2]), jnp.array([0.0, 0.0, 0.5])
    _, change = jax.jvp(falling, FALLING, along)
    np.testing.assert_allclose(change, FALLING_SLOPES @ [0.3, -0.2, 0.5], rtol=1e-8)


class Relay(eqx.Module):
    """A torque about x opposite to the rate, and a constant torque, both in units of 0.3 N m."""

    push: jax.Array

    def __call__(self, t, wxyz, omega):
        return 0.3 * (jnp.where(omega[0] > 0, -1, 1) + self.push) * jnp.eye(3, dtype=omega.dtype)[0]


@pytest.mark.parametrize("push", [0.0, 0.7])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_relay_that_slides_says_so(dtype, push):
    """Single precision has no digits left before 16 reversals."""

    relay = ph.FeedbackTorque(Relay(jnp.asarray(push, dtype)))
    scene = ph.Scene(ph.Inertia.from_moments(MOMENTS.astype(dtype)), None, relay)
    state = ph.State(WXYZ.astype(dtype), np.array([[0.2, 0.3, 0.1], [1.0, 0.2, -0.5]], dtype))
    found = ph.simulate(scene, state, TS.astype(dtype), rtol=1e-5, throw=False)
    np.testing.assert_array_equal(found.status, ph.Status.SLIDING)
    assert found.wxyz.dtype == dtype
    with pytest.raises(ph.SimulationError, match="slides along a switch"):
        ph.simulate(scene, state, TS.astype(dtype), rtol=1e-5)


@pytest.mark.slow
def test_second_derivatives_through_a_jump():
    """With respect to rate and level, of ``level - 0.1 (5 - log(level) / rate)``."""

    def end(p):
        def law(t, wxyz, omega):
            return jnp.where(omega[2] > p[1], p[0] * omega, -0.1)

        scene = ph.Scene(ph.Inertia.spherical(1.0), None, ph.FeedbackTorque(law))
        return ph.simulate(scene, ph.State(WXYZ, [0.0, 0.0, 1.0]), [0.0, 5.0]).omega_body[-1, 2]

    def exact(p):
        return p[1] - 0.1 * (5 - jnp.log(p[1]) / p[0])

    p, along = jnp.array([-0.2, 0.7]), jnp.array([0.3, 0.2])
    found, want = (jax.jvp(jax.grad(f), (p,), (along,))[1] for f in (end, exact))
    np.testing.assert_allclose(found, want, rtol=1e-7)


def test_a_side_beyond_which_the_field_is_no_number():
    """Steps use the side of a square root before the switch until its time, and do not pass it."""

    def law(t, wxyz, omega):
        size = 1 + jnp.where(omega[2] > 0, jnp.sqrt(omega[2]), 0.0)
        return -0.3 * size * jnp.array([0.0, 0, 1])

    scene = ph.Scene(ph.Inertia.spherical(1.0), None, ph.FeedbackTorque(law))
    found = ph.simulate(scene, ph.State(WXYZ, [0.0, 0.0, 1.0]), [0.0, 5.0])
    met = 2 / 0.3 * (1 - np.log(2))  # dw/dt = -0.3 (1 + sqrt(w)), then -0.3
    np.testing.assert_allclose(found.omega_body[1, 2], -0.3 * (5 - met), rtol=1e-8)


def _root_time(s):
    """Time in which dw/dt = -(1 + sqrt(abs(w))) leads from w = s^2 to 0."""
    return 2 * (s - np.log1p(s))


FIRST, SPAN = np.sqrt(0.5), 3.0
REST = SPAN - _root_time(FIRST)
LAST = brentq(lambda s: _root_time(s) - REST, 0, 10, xtol=1e-15)
ROOTS = {
    "root": (lambda t, w, x: -(1 + jnp.sqrt(jnp.abs(w))), -(LAST**2), (1 + LAST) / (1 + FIRST)),
    "jump": (
        lambda t, w, x: -jnp.where(w > 0, 1 + jnp.sqrt(jnp.where(w > 0, w, 1)), 0.5),
        -0.5 * REST,
        0.5 / (1 + FIRST),
    ),
    "time": (lambda t, w, x: jnp.sqrt(jnp.abs(t - 2 * x)), 0.5 + (2 + 4 * 2**0.5) / 3, 3 - 8**0.5),
}
"""Rates of change, which no step can continue beyond the switch: w at the end from 0.5, and its
derivative by x, the start and a parameter."""


@pytest.mark.slow  # faster: a root of the state, test_a_side_beyond_which_the_field_is_no_number
@pytest.mark.parametrize("kind", ROOTS)
def test_roots_of_a_size_that_passes_zero(kind):
    """Neither branch can be continued past the switch, where the derivative is infinite."""
    rate, last, slope = ROOTS[kind]

    def end(x):
        law = ph.FeedbackTorque(lambda t, q, w: rate(t, w[2], x) * jnp.array([0.0, 0, 1]))
        scene = ph.Scene(ph.Inertia.spherical(1.0), None, law)
        state = ph.State(WXYZ, x * jnp.array([0.0, 0, 1]))
        return ph.simulate(scene, state, [0.0, SPAN], rtol=1e-8).last.omega_body[2]

    value, reverse = jax.jit(jax.value_and_grad(end))(0.5)
    np.testing.assert_allclose(value, last, rtol=1e-8)
    np.testing.assert_allclose(reverse, slope, atol=1e-4)
    np.testing.assert_allclose(jax.jvp(end, (0.5,), (1.0,))[1], slope, atol=1e-4)


def test_tangents_of_a_failed_body_are_no_zeros():
    """A zero would look like a minimum. In reverse mode only the others contribute."""

    def last(gain, omega):
        brake = ph.FeedbackTorque(lambda t, q, w: -gain * w * jnp.sqrt(4 - w @ w))
        scene, state = ph.Scene(INERTIA, None, brake), ph.State(WXYZ, omega)
        return ph.simulate(scene, state, [0.0, 5.0]).last.omega_body[..., 2]

    both = jnp.array([[0.3, 0.6, 3.0], [0.1, 0.2, 0.3]])
    forward = jax.jit(jax.jacfwd(last))(0.3, both)
    np.testing.assert_array_equal(jnp.isnan(forward), [True, False])
    reverse = jax.jit(jax.grad(lambda gain: jnp.sum(last(gain, both))))(0.3)
    np.testing.assert_allclose(reverse, forward[1], rtol=1e-6)


@pytest.mark.slow
def test_gradients_of_a_batch_through_switches():
    """Wider than a fused kernel, and in segments of four steps, as for one body."""

    def law(t, wxyz, omega):
        return jnp.clip(-0.5 * omega, -0.1, 0.2) + 0.05 * jnp.sin(3 * t)

    scene = ph.Scene(INERTIA, torque=ph.FeedbackTorque(law))
    omega = jnp.stack([(1 + 0.1 * k) * jnp.asarray(OMEGA) for k in range(10)])

    def end(omega, max_steps):
        method = ph.LiePoisson(Automatic(), max_steps=max_steps)
        return jnp.sum(ph.simulate(scene, ph.State(WXYZ, omega), TS, method).last.wxyz[..., 1])

    few, one = jax.grad(end)(omega, 256), jax.grad(end)(omega[3], 2**16)
    np.testing.assert_allclose(few[3], one, atol=1e-9)


@pytest.mark.slow
def test_a_torque_that_points_along_an_orbit():
    """The frame's quaternion changes sign, and with it the shorter way of ``ph.Pointing``; the
    checks of a rotation matrix compare rounding errors. The body ends at rest in the frame.
    """
    orbit = ph.KeplerOrbit(3.986004418e14, 6.871e6, inclination=np.deg2rad(97.4))
    frame = ph.LVLH(orbit)
    torque = ph.RelativeTorque(ph.Pointing(2e-4, 5e-3), frame)
    scene = ph.Scene(ph.Inertia.from_moments([0.15, 0.185, 0.063]), None, torque)
    state = ph.State(frame.attitude(0.0), [0.0, 0.01, 0.0])
    last = ph.simulate(scene, state, [0.0, 6000.0], rtol=1e-7).last  # an orbit takes 5,668 s
    wxyz, omega = frame.to_frame(last.wxyz, last.omega_body, 6000.0)
    np.testing.assert_allclose(abs(wxyz[0]), 1, atol=1e-12)
    np.testing.assert_allclose(omega, 0, atol=1e-9)


@pytest.mark.parametrize("start", [-690.2, 1e4])
def test_switches_at_times_far_from_zero(start):
    """Where a margin in time is exactly zero between two representable times."""
    torque = ph.Pulses(ph.BodyTorque([0.0, 0, 1]), [start + 0.3], [start + 100])
    limited = ph.FeedbackTorque(lambda t, wxyz, omega: -1e-9 * jnp.maximum(omega, 0))
    scene = ph.Scene(ph.Inertia.spherical(1.0), None, torque + limited)
    found = ph.simulate(scene, ph.State(WXYZ, [0.0, 0, 1]), [start, start + 0.8], rtol=1e-10)
    np.testing.assert_allclose(found.omega_body[-1, 2], 1.5, atol=2e-9)


def test_single_precision_turns_no_switch_late_and_rounds_no_weight():
    """170 rad and 11 jumps. If all switches were late, or weights off by the same amount in every
    step, the attitude would have errors of 4e-4 and more.
    """

    def last(dtype, rtol):
        kp, kd = ([1.8e-2, 1.3e-2, 0.9e-2], [2e-4, 2e-4, 2e-4])
        law = ph.Pointing(*(np.asarray(x, dtype) for x in (kp, kd, [0.4, 0.1, -0.9, 0.1])))
        scene = ph.Scene(ph.Inertia.from_moments(np.asarray([1.0, 1.6, 1.65], dtype)), None, law)
        state = ph.State(*(np.asarray(x, dtype) for x in ([1, 0, 0, 0], [-1.15, -0.23, 0.6])))
        found = ph.simulate(scene, state, np.asarray([0, 150], dtype), rtol=rtol)
        assert found.step_counts.at_switches == 11
        return found.wxyz[-1].astype(float)

    assert rotation.angle_between(last(np.float32, 1e-5), last(np.float64, 1e-9)) < 1e-4


def test_switches_that_change_the_sides_of_others():
    """The first one exchanges the arguments of two more; together they do not change the torque."""

    def law(t, wxyz, omega):
        flipped = jnp.where(omega[2] > 0.5, 1.0, -1.0) * (1 + omega[2] ** 2)
        size = jnp.where(flipped < 0, -flipped, flipped)
        return -0.1 * jnp.where(size > 0, 1.0, -1.0) * jnp.array([0.0, 0, 1])

    scene = ph.Scene(ph.Inertia.spherical(1.0), None, ph.FeedbackTorque(law))
    found = ph.simulate(scene, ph.State(WXYZ, [0.0, 0.0, 1.0]), [0.0, 4.0, 8.0])
    np.testing.assert_allclose(found.omega_body[1:, 2], [0.6, 0.2], atol=1e-9)


@pytest.mark.slow
def test_a_side_that_changes_with_another_switch_shortly_before_its_root():
    """The frame's quaternion changes sign at 3.064 s, and with it the side of the shorter way to
    the target. Between this time and the next root of that side, at 3.100 s, the side must not be
    treated as one that has just switched at a root, which caused errors of 20 rtol and more without
    a warning.
    """
    wxyz = [-0.30543534, 0.13632259, -0.85229906, 0.40213395]
    target = [0.012701, 0.22738476, -0.77803086, -0.58549367]
    orbit = ph.KeplerOrbit(
        8.4010332e22, 7077466.20256302, None, 0.01226143, 2.2636944, 2.88249187, 0.17332346, 0.0421
    )
    law = ph.Pointing([3451216.7, 2547202.9, 3974568.0], [13436.4, 20334.4, 18584.4], target)
    torque = ph.RelativeTorque(law, ph.LVLH(orbit))
    body = ph.Inertia.from_moments([4938647.99110217, 3763113.89017482, 4233159.01750205])
    scene = ph.Scene(body, None, torque)
    state = ph.State(wxyz, [-7.06042819, -6.40969284, 16.43749738])
    coarse, fine = (ph.simulate(scene, state, [0.0, 3.2], rtol=r).last for r in (1e-4, 1e-8))
    assert float(ph.rotation.angle_between(coarse.wxyz, fine.wxyz)) < 1e-4


WEIGHTS = jax.random.normal(jax.random.key(0), (48, 3)), jax.random.normal(jax.random.key(1), (48,))


def by_network(scale, rtol, method=None):
    """The last state under a network of 48 relu, whose weights have a common factor."""

    def law(t, wxyz, omega):
        hidden = jax.nn.relu(WEIGHTS[0] @ (3 * omega) + WEIGHTS[1])
        return -0.02 * scale * WEIGHTS[0].T @ hidden

    scene = ph.Scene(INERTIA, torque=ph.FeedbackTorque(law))
    state = ph.State(WXYZ, OMEGA)
    plan = ph.explain(scene, state, [0.0, 5.0], method, rtol=rtol)
    return ph.simulate(scene, state, [0.0, 5.0], method, rtol=rtol).last.omega_body[2], plan


@pytest.mark.slow
def test_many_switches_are_passed_by_steps_of_lower_order():
    """From an rtol of 1e-7 on, where order 8 needs more evaluations for as many steps."""
    want, gradient = (f(lambda s: by_network(s, 1e-11)[0])(1.0) for f in (lambda f: f, jax.grad))
    for rtol, order in ((1e-5, 5), (1e-8, 8)):
        value, plan = by_network(1.0, rtol)
        assert f"steps of order {order}, each ending" in str(plan)
        assert abs(value - want) < 2 * rtol
        if order == 5:  # of order 8: test_gradients_through_switches
            found = jax.grad(lambda s, rtol=rtol: by_network(s, rtol)[0])(1.0)
            assert abs(found - gradient) < 5 * rtol * abs(gradient)


@pytest.mark.slow
def test_coarse_steps_pass_switches():
    """The state has an error below rtol, the gradient one of about its square root."""
    coarse = ph.CoarseSteps()

    def loss(scale):
        return by_network(scale, 1e-5, coarse)[0]

    fine, low, high = (by_network(scale, 1e-9)[0] for scale in (1.0, 0.999, 1.001))
    assert 1e-9 < abs(loss(1.0) - fine) < 1e-4
    np.testing.assert_allclose(jax.grad(loss)(1.0), (high - low) / 0.002, rtol=0.05)


def test_coarse_steps_say_what_they_are():
    """Options that do not apply are rejected."""
    coarse, state, ts = ph.CoarseSteps(), ph.State(WXYZ, OMEGA), [0.0, 1.0]

    def scene(limit):
        law = ph.FeedbackTorque(lambda t, wxyz, omega: jnp.clip(-omega, -limit, limit))
        return ph.Scene(INERTIA, torque=law)

    plan = str(ph.explain(scene(0.2), state, ts, coarse))
    assert "6 switches" in plan
    assert "sqrt(rtol)" in plan

    def loss(limit):
        return ph.simulate(scene(limit), state, ts, coarse).last.omega_body[2]

    with pytest.raises(NotImplementedError, match=r"leave method=ph\.CoarseSteps"):
        jax.hessian(loss)(0.2)
    event = ph.Event(lambda wxyz, omega, t: omega[2] - 0.8)
    with pytest.raises(ValueError, match="does not search for events"):
        ph.simulate(scene(0.2), state, ts, coarse, events=event)


def test_the_rule_of_lower_order():
    """The coefficients are those of diffrax, and dense output is exact for a quartic."""
    tableau = diffrax.Tsit5.tableau
    for i, row in enumerate(tableau.a_lower):
        np.testing.assert_array_equal(TSIT5.weights[i + 1, : len(row)], row)
    np.testing.assert_array_equal(TSIT5.nodes[1:], tableau.c)
    np.testing.assert_array_equal(TSIT5.errors[0], tableau.b_error)
    x, h = jnp.linspace(0.0, 1.0, 11), 0.7
    rates = jnp.asarray((TSIT5.nodes * h) ** 3)[:, None, None]
    dense = dense_of(jnp.array([h]), rates, TSIT5)
    found = jnp.stack([dense_state(jnp.zeros((1, 1)), dense, x[None, i])[0, 0] for i in range(11)])
    np.testing.assert_allclose(found, (x * h) ** 4 / 4, atol=1e-14)


def test_a_heading_that_passes_half_a_turn_has_its_derivative():
    """The angle jumps by a full turn there, and so does the torque; also in reverse mode."""

    def heading(t, wxyz, omega_body):
        angle = jnp.arctan2(2 * wxyz[0] * wxyz[3], wxyz[0] ** 2 - wxyz[3] ** 2)
        return jnp.array([0.0, 0.0, -0.4]) * angle

    def end(rate):
        scene = ph.Scene(ph.Inertia.spherical(1.0), torque=ph.FeedbackTorque(heading))
        state = ph.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3).at[2].set(rate))
        return ph.simulate(scene, state, jnp.array([0.0, 4.0])).omega_body[-1, 2]

    value, step = jax.jit(jax.value_and_grad(end)), 1e-5
    slope = value(2.2)[1]
    ends = (value(2.2 + s * step)[0] for s in (1, -1))
    np.testing.assert_allclose(slope, np.subtract(*ends) / (2 * step), rtol=1e-5)
