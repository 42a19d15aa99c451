"""Wrong input raises a clear error: what was passed, what is expected, how to correct it."""

import re
from functools import partial

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings, strategies as st

import polhode as ph
from polhode._method import check_options

INERTIA = ph.Inertia.from_moments([1.0, 1.5, 2.0])
SCENE = ph.Scene(INERTIA)
STATE = ph.State([1.0, 0, 0, 0], [0.1, 0.2, 0.3])
TS = [0.0, 1.0]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ph.State([0.0, 0, 0, 0], [0.0, 0, 1]), r"wxyz must not be zero.*scalar first"),
        (
            lambda: ph.State([1.0, 0, 0], [0.0, 0, 1]),
            r"wxyz must have shape \(\.\.\., 4\), got \(3,\)",
        ),
        (lambda: ph.State([1.0, 0, 0, np.nan], [0.0, 0, 1]), "wxyz holds NaN or infinity"),
        (lambda: ph.State([1.0, 0, 0, 0], [np.inf, 0, 1]), "omega_body holds NaN or infinity"),
        (lambda: ph.State(np.ones((2, 4)), np.ones((3, 3))), "broadcast together"),
        (lambda: ph.State.from_euler(0.1, 0.2, 0.3), "exactly one of rates"),
        (
            lambda: ph.State.from_euler(0.1, 0.0, 0.3, momenta=[1.0, 2, 3], inertia=INERTIA),
            "theta at 0 or pi",
        ),
        (
            lambda: ph.State.from_euler(0.1, np.pi, 0.3, momenta=[1.0, 2, 3], inertia=INERTIA),
            "theta at 0 or pi",
        ),
        (lambda: ph.Inertia.from_moments([1.0, -1.0, 1.0]), "positive"),
        (lambda: ph.Inertia.from_moments([1.0, 1.0, 3.0]), "triangle inequality"),
        (lambda: ph.UniformGravity(-1.0, [0.0, 0, 1]), "mass must not be negative"),
        (lambda: ph.GravityGradient(1.0, [0.0, 0, 0]), "must not be zero"),
        (lambda: ph.LinearDamping([0.1, -0.1, 0.1]), "must not be negative"),
        (lambda: ph.BodyTorque([1.0, 2.0]), r"shape \(\.\.\., 3\)"),
        (lambda: ph.UniformGravity(1.0, 0.3), r"UniformGravity\.axial\(mass, distance\)"),
        (lambda: ph.simulate(SCENE, STATE, 10), r"got \(\): give a row of numbers, such as \[0\.0"),
        (lambda: ph.simulate(SCENE, STATE, [0.0]), "at least two times"),
        (
            lambda: jax.jit(lambda t: ph.simulate(SCENE, STATE, t).wxyz)(np.zeros(1)),
            r"at least two times, got an array of shape \(1,\)",
        ),
        (lambda: ph.simulate(SCENE, STATE, [0.0, 1.0, 1.0]), "entries 1 and 2"),
        (
            lambda: ph.simulate(SCENE, STATE, np.array([[0.0, 1, 2], [0, 5, 5]])),
            "entries 1 and 2 are 5.0 and 5.0",
        ),
        (lambda: ph.propagate(SCENE, STATE, 0.0), "dt must be a number other than zero, got 0.0"),
        (
            lambda: ph.Table(np.array([8e8, 8e8 + 10, 8e8 + 20]), np.float32([0, 1, 2])),
            r"ascend, in the dtype of its values \(float32\)",
        ),
        (lambda: ph.simulate(SCENE, STATE, [0.0, 2.0, 1.0]), "strictly increasing or strictly"),
        (lambda: ph.simulate(SCENE, STATE, [0.0, np.nan]), "ts holds NaN"),
        (lambda: ph.simulate(SCENE, STATE, TS, rtol=-1.0), "rtol must be positive"),
        (lambda: ph.simulate(SCENE, STATE, TS, rtol=1e-17), "below what float64 can reach"),
    ],
)
def test_values(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ph.Scene([1.0, 2.0, 3.0]), r"ph\.Inertia\.from_moments"),
        (lambda: ph.Scene(INERTIA, potential=ph.LinearDamping(0.1)), "must be a potential"),
        (lambda: ph.Scene(INERTIA, torque=3.0), "must be a torque"),
        (lambda: ph.Scene(INERTIA, ph.LinearDamping(0.1)), "got LinearDamping: pass it as torque="),
        (
            lambda: ph.Scene(INERTIA, torque=lambda t, q, w: -w),
            r"ph\.BodyTorque\(fn\) of fn\(t\), or ph\.FeedbackTorque\(fn\) of fn\(t, wxyz, omega",
        ),
        (lambda: ph.Scene(INERTIA, lambda R, t: R[2, 2]), r"ph\.Potential\(fn\) of fn\(R, t\)"),
        (lambda: ph.simulate(STATE, SCENE, TS), r"scene must be a ph\.Scene, got State"),
        (lambda: ph.simulate(SCENE, STATE, TS, "rk4"), "object such as"),
        (lambda: ph.simulate(SCENE, STATE, TS, record="all"), r"ph\.Record"),
        (lambda: ph.State("up", [0.0, 0, 1]), "wxyz must be an array of real numbers"),
        (lambda: ph.State([1j, 0, 0, 0], [0.0, 0, 1]), "real numbers"),
        (lambda: ph.BodyTorque([0.0, 0, 1]) + ph.Potential(lambda r, t: 0.0), "torque adds to"),
        (lambda: ph.Potential(3.0), "takes a function"),
    ],
)
def test_kinds(call, message):
    with pytest.raises(TypeError, match=message):
        call()


def test_mixed_dtypes_and_batches_that_do_not_fit():
    single = ph.State(np.array([1, 0, 0, 0], np.float32), np.array([0, 0, 1], np.float32))
    with pytest.raises(TypeError, match=r"mix the dtypes \['float32', 'float64'\]"):
        ph.simulate(SCENE, single, TS)
    three = ph.State(np.ones((3, 4)), np.ones((3, 3)))
    two = ph.Scene(ph.Inertia.from_moments(np.ones((2, 3))))
    with pytest.raises(ValueError, match="do not broadcast together"):
        ph.simulate(two, three, TS)
    scene = ph.Scene(ph.Inertia.from_moments(np.ones(3, np.float32)))
    with pytest.raises(ValueError, match="float32 can reach"):
        ph.simulate(scene, single, TS, rtol=1e-9)


def test_lists_of_single_precision_stay_so():
    """Python numbers have the default precision; NumPy numbers keep theirs."""
    for kind in (np.float32, np.float64):
        row = list(np.array([1.0, 1.5, 2.0], kind))
        assert ph.Inertia.from_moments(row).moments.dtype == kind
        assert ph.State(np.array([1, 0, 0, 0], kind), row).omega_body.dtype == kind
    assert ph.Inertia.from_moments([1, 1.5, 2]).moments.dtype == jnp.float64


def test_the_length_of_a_quaternion_keeps_its_digits_and_has_no_derivative():
    """Also for a unit quaternion, which is not normalised again."""
    rows = np.random.default_rng(0).normal(size=(100, 4))
    state = ph.State(rows, np.zeros(3))

    def normalised(wxyz):
        return eqx.tree_at(lambda s: s.wxyz, state, wxyz).as_unit().wxyz

    wxyz, change = jax.jvp(normalised, (state.wxyz,), (state.wxyz,))
    np.testing.assert_array_equal(wxyz, state.wxyz)
    np.testing.assert_allclose(change, 0, atol=1e-15)


def test_non_unit_quaternions_are_normalised_at_every_scale():
    for scale in (1e-300, 1e-5, 1.0, 1e300):
        state = ph.State(np.array([3.0, 0, 4.0, 0]) * scale, [0.0, 0, 1])
        np.testing.assert_allclose(state.wxyz, [0.6, 0, 0.8, 0], rtol=4e-16)


def _parts(box, vertices, faces):
    """One instance of every part that checks its values, from arrays that are not traced."""
    upright, up, number = jnp.array([1.0, 0, 0, 0]), jnp.array([0.0, 0, 1]), jnp.array(0.01)
    inertia = ph.Inertia.from_moments(box)
    angles = jnp.array(0.1), jnp.array(0.2), jnp.array(0.3)
    return (
        ph.State(upright, up),
        ph.State.from_euler(*angles, momenta=box, inertia=inertia),
        ph.Scene(
            inertia,
            ph.UniformGravity(number, up, -up) + ph.GravityGradient(number, up),
            ph.BodyTorque(up) + ph.LinearDamping(jnp.full(3, number)),
            ph.Rotor(up, number, speed=number),
        ),
        ph.GravityGradient(number, ph.KeplerOrbit(number, number, number)),
        ph.MassProperties.from_box(number, box, box / 2).moved(up),
        ph.MassProperties.from_sphere(number, number, number / 2).moved(wxyz=upright),
        ph.MassProperties.from_mesh(vertices, faces, density=number),
        ph.fit.Recording.of(jnp.arange(9.0), jnp.ones((9, 3)), omega_noise=number),
    )


def test_parts_are_made_of_known_arrays_under_jit():
    """A traced function closes over concrete arrays, but operations on them are traced."""
    box = jnp.array([1.0, 1.5, 2.0])
    vertices = np.concatenate([np.zeros((1, 3)), np.eye(3)])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    plain = _parts(box, jnp.asarray(vertices), faces)
    traced = eqx.filter_jit(lambda: _parts(box, jnp.asarray(vertices), faces))()
    for want, got in zip(jax.tree.leaves(plain), jax.tree.leaves(traced), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-14, atol=1e-16)
    explained = eqx.filter_jit(lambda: str(ph.explain(SCENE, STATE, TS)) and jnp.zeros(()))()
    assert explained == 0


def test_moments_near_the_largest_number_are_judged_like_others():
    moments = ph.Inertia.from_moments(np.array([1.0, 1.5, 1.7]) * 1e308).moments
    np.testing.assert_allclose(moments, np.array([1.0, 1.5, 1.7]) * 1e308)
    with pytest.raises(ValueError, match="triangle inequality"):
        ph.Inertia.from_moments(np.array([0.1, 0.2, 1.7]) * 1e308)


def test_parts_print_their_numbers_where_they_are_known_and_few():
    body = ph.MassProperties.of(3.0, [0.0, 0, 0], INERTIA)
    for part in (
        INERTIA,
        body,
        ph.Scene(INERTIA),
        ph.Scene(INERTIA, torque=ph.BodyTorque([1, 1.5, 2])),
    ):
        assert "[1. , 1.5, 2. ]" in str(part)
    assert "f64[99,3]" in str(ph.Inertia.from_moments(np.ones((99, 3))))
    top = str(ph.Scene(INERTIA, ph.UniformGravity(1.0, [0.0, 0, 1])))
    assert not any(text in top for text in ("None", "weak", ",\n)"))
    texts = []
    jax.eval_shape(lambda x: texts.append(f"{ph.State(STATE.wxyz, x)}"), STATE.omega_body)
    assert "omega_body=f64[3]" in texts[0]


METHOD = ph.LiePoisson(max_steps=64)


@pytest.mark.parametrize("odd", ["1e-6", True, [1e-6], np.array([1e-6]), 1j, object(), b"1"])
def test_a_tolerance_is_one_number(odd):
    with pytest.raises(TypeError, match=r"rtol must be one number.*got"):
        ph.simulate(SCENE, STATE, TS, rtol=odd)
    with pytest.raises(TypeError, match="rtol must be one number"):
        ph.explain(SCENE, STATE, TS, rtol=odd)


def test_a_tolerance_is_small():
    for coarse in (1.0, 100.0):
        with pytest.raises(ValueError, match="rtol must be below 1"):
            ph.simulate(SCENE, STATE, TS, rtol=coarse)
    assert ph.simulate(SCENE, STATE, TS, rtol=np.float32(1e-6)).successful


@pytest.mark.parametrize(
    ("method", "word"),
    [
        (ph.LiePoisson, r"the class LiePoisson: make an object of it, ph\.LiePoisson\(\)"),
        (ph.ClosedForm, r"the class ClosedForm: make an object of it, ph\.ClosedForm\(\)"),
        (diffrax.Tsit5, r"pass it to a coordinate system, ph\.LiePoisson\(diffrax\.Tsit5\(\)\)"),
        (diffrax.Tsit5(), r"pass it to a coordinate system, ph\.LiePoisson\(diffrax\.Tsit5\(\)\)"),
        ("Tsit5", "got str"),
    ],
)
def test_a_method_is_an_object(method, word):
    for call in (ph.simulate, ph.explain):
        with pytest.raises(TypeError, match=word):
            call(SCENE, STATE, TS, method)


@pytest.mark.parametrize(
    ("options", "error", "word"),
    [
        ({"solver": diffrax.Tsit5}, TypeError, r"the class Tsit5.*diffrax\.Tsit5\(\)"),
        ({"solver": "Tsit5"}, TypeError, "solver must be a diffrax object"),
        ({"solver": None}, TypeError, "solver must be a diffrax object"),
        ({"controller": diffrax.PIDController}, TypeError, "the class PIDController"),
        ({"controller": 1e-6}, TypeError, "controller must be a diffrax object"),
        ({"adjoint": diffrax.ForwardMode}, TypeError, "the class ForwardMode"),
        ({"adjoint": diffrax.BacksolveAdjoint()}, ValueError, "RecursiveCheckpointAdjoint"),
        ({"solver": diffrax.SemiImplicitEuler()}, ValueError, "positions from momenta"),
        ({"dt0": 0.0}, ValueError, "dt0 must be one step"),
        ({"dt0": "0.1"}, TypeError, "dt0 must be"),
        ({"max_steps": 10.5}, TypeError, "max_steps must be an integer"),
        ({"max_steps": True}, TypeError, "max_steps must be an integer"),
        ({"chunk": 0}, ValueError, "chunk must be at least 1"),
    ],
)
def test_options_of_stepped_methods(options, error, word):
    with pytest.raises(error, match=word):
        check_options(**{"solver": diffrax.Tsit5(), **options})


def test_options_that_are_right_pass():
    for solver in (diffrax.Kvaerno5(), ph.Extrapolation(12)):
        check_options(solver, diffrax.ConstantStepSize(), diffrax.ForwardMode(), dt0=-0.1)
    check_options(diffrax.Tsit5(), max_steps=np.int64(4), chunk=1)


@pytest.mark.parametrize("dtype", [jnp.float16, jnp.bfloat16])
def test_half_precision_is_refused_by_name(dtype):
    state = ph.State(jnp.array([1, 0, 0, 0], dtype), jnp.array([0, 0, 1], dtype))
    scene = ph.Scene(ph.Inertia(diagonal=jnp.array([1, 1.5, 2], dtype)))
    with pytest.raises(TypeError, match=f"of {jnp.dtype(dtype).name}.*float32 or float64"):
        ph.simulate(scene, state, TS)


def test_times_that_single_precision_does_not_resolve_are_refused():
    """Steps of 0.02 s after a day are rejected; the same steps from zero are accepted."""
    times = np.linspace(0.0, 2.0, 101)
    state = jax.tree.map(lambda x: x.astype(np.float32), STATE)
    scene = jax.tree.map(lambda x: x.astype(np.float32), SCENE)
    for late in (times + 86400, list(times + 86400), tuple((times + 86400).tolist())):
        with pytest.raises(ValueError, match=r"ts of up to 8.64e.04 s leave no digits .* float32"):
            ph.simulate(scene, state, late)
    assert ph.simulate(scene, state, times).ts.dtype == np.float32
    assert ph.simulate(SCENE, STATE, times + 86400).ts[0] == 86400


def test_unsorted_times_have_a_status_where_they_are_traced():
    @jax.jit
    def status(ts):
        return ph.simulate(SCENE, STATE, ts).status

    for times, good in (
        ([0.0, 1, 2], True),
        ([2.0, 1, 0], True),
        ([0.0, 2, 1], False),
        ([0.0, 1, 1], False),
        ([0.0, np.nan, 1], False),
    ):
        want = ph.Status.SUCCESSFUL if good else ph.Status.BAD_TIMES
        assert status(jnp.array(times)) == want
    own = jnp.array([[0.0, 1, 2], [0.0, 2, 1]])
    np.testing.assert_array_equal(status(own), [ph.Status.SUCCESSFUL, ph.Status.BAD_TIMES])


def with_motor(torque, speed):
    motor = ph.Motor(lambda t, q, w, s: 0.4 * q[1] + w[0], torque, speed)
    return ph.Scene(INERTIA, rotors=ph.Rotor.axial(0.05, speed=1.0, coupling=motor, axis=0))


def acted(torque):
    return ph.Scene(INERTIA, torque=torque)


PLATES = ph.Plates([1.0], [[1.0, 0, 0]], [[0, 0.1, 0]])
FIELD = [0.0, 0, 1e-5]
LIMITS = {  # a scene with two numbers that occur in comparisons only, and valid numbers
    "motor": (with_motor, [0.05, 10.0]),
    "pulse": (lambda a, b: acted(ph.Pulses(ph.BodyTorque([1.0, 0, 0]), a, b)), [0.2, 0.5]),
    "rods": (
        lambda a, b: ph.Scene(
            INERTIA,
            torque=ph.MagneticDipole(ph.BDot(1e9, a), FIELD)
            + ph.MomentumDumping(0.1, FIELD, max_moment=b),
            rotors=ph.Rotor.axial(0.05, speed=1.0),
        ),
        [100.0, 10.0],
    ),
    "shadow": (
        lambda a, b: acted(
            ph.SolarPressure(
                PLATES, [1.0, 0, 0], ph.Eclipse([-7e6, 0.0, 0], jnp.stack([1.0, 0 * b, b]), a)
            )
        ),
        [6.4e6, 0.1],
    ),
    "plate": (
        lambda a, b: acted(
            ph.Drag(
                ph.Plates([1.0], jnp.stack([1.0, a, b])[None], [[0, 0.1, 0]]), 1e-7, [7e3, 0, 0]
            )
        ),
        [0.2, 0.1],
    ),
    "table": (
        lambda a, b: acted(
            ph.BodyTorque(ph.Table(jnp.stack([0 * a, a, b]), np.eye(3, 3), 1, kind="vector"))
        ),
        [0.5, 2.0],
    ),
}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in ("motor", "table") else pytest.mark.slow)
        for name in LIMITS
    ],
)
def test_limits_and_edges_that_are_wrong_have_a_status_where_they_are_traced(name):
    make, good = LIMITS[name]

    @jax.jit
    @jax.vmap
    def outcome(numbers):
        motion = ph.simulate(make(*numbers), STATE, TS)
        return motion.status, motion.omega_body

    given = [good, [np.nan, good[1]], [good[0], np.nan]]
    if name in ("motor", "pulse", "rods"):
        given += [[-good[0], good[1]] if name != "pulse" else [0.5, 0.2]]
    expected = [ph.Status.SUCCESSFUL] + [ph.Status.NOT_FINITE] * (len(given) - 1)
    status, rates = outcome(jnp.array(given))
    np.testing.assert_array_equal(status, expected)
    assert np.isfinite(rates[0]).all()
    assert np.isnan(rates[1:]).all()


def test_a_body_with_a_wrong_limit_adds_nothing_to_the_gradient_of_the_others():
    """Derivatives with respect to a shared gain, a weight of the cost, and limits of each motor. If
    all limits are wrong, the mean and the derivative with respect to the weight are NaN.
    """

    @jax.jit
    @partial(jax.value_and_grad, argnums=(0, 1))
    def mean(gain, weight, limits):
        motor = ph.Motor(lambda t, q, w, s: gain * q[1] + w[0], max_torque=limits)
        wheel = ph.Rotor([1.0, 0, 0], 0.05, speed=1.0, coupling=motor)
        scene = ph.Scene(ph.Inertia.from_moments([1.0, 1.5, 2.0]), rotors=wheel)
        motion = ph.simulate(scene, STATE, TS)
        return ph.successful_mean(motion, lambda motion: weight * motion.omega_body[:, -1, 0])

    both = jax.tree.leaves(mean(0.4, 1.0, jnp.array([0.5, 0.5])))
    assert min(abs(x) for x in both) > 1e-6
    for wrong in (-0.5, np.nan):
        found = mean(0.4, 1.0, jnp.array([0.5, wrong]))
        np.testing.assert_allclose(jax.tree.leaves(found), both, rtol=1e-9)
        value, (_, by_weight) = mean(0.4, 1.0, jnp.array([wrong, wrong]))
        assert np.isnan([value, by_weight]).all()


def test_a_limit_that_is_wrong_raises_outside_of_jit():
    def end(limit):
        return ph.simulate(with_motor(limit, None), STATE, TS).omega_body[-1, 0]

    with pytest.raises(ValueError, match="max_torque must be positive"):
        end(-0.1)
    with pytest.raises(ph.SimulationError, match="limits that must be positive"):
        jax.grad(end)(-0.1)
    edited = eqx.tree_at(
        lambda s: s.rotors.coupling.max_torque, with_motor(0.1, None), jnp.array(np.nan)
    )
    with pytest.raises(ph.SimulationError, match="limits that must be positive"):
        ph.simulate(edited, STATE, TS)


class Spring(ph.AbstractTorque):
    k: jax.Array
    ranks: dict = eqx.field(static=True, default_factory=dict)

    @property
    def core_ranks(self):
        return self.ranks

    def body_components(self, t, attitude, omega):
        x, y, z = attitude.row(2)
        return -self.k * y, self.k * x, 0.0 * z


def test_fields_of_a_class_of_the_user_are_named():
    with pytest.raises(TypeError, match=r"core_ranks of Spring names kk, .* it has k, ranks"):
        ph.simulate(acted(Spring(jnp.array(1.0), {"kk": 0})), STATE, TS)
    with pytest.raises(
        ValueError, match=r"(?s)Spring.body_components returned.*\(3,\).*If k of it"
    ):
        ph.simulate(acted(Spring(jnp.array([1.0, 2.0, 3.0]))), STATE, TS)


FRAME = ph.RotatingFrame.from_rate([0.0, 0, 1])
BALL = ph.MassProperties.from_sphere(1.0, 1.0)


@pytest.mark.parametrize(
    ("call", "error", "word"),
    [
        (lambda: BALL + ph.Inertia.spherical(1.0), TypeError, "join with ph.MassProperties"),
        (lambda: BALL - 1.0, TypeError, "join with ph.MassProperties"),
        (lambda: ph.MassProperties.of(1.0, [0, 0, 0], [1, 2, 3]), TypeError, "inertia must be a"),
        (lambda: INERTIA.rates(3.0), ValueError, "momentum must have shape"),
        (lambda: INERTIA.momentum(np.ones(4)), ValueError, "omega must have shape"),
        (lambda: ph.periods(ph.Inertia(diagonal=[1.0, -1, 2]), STATE), ValueError, "a body can"),
        (lambda: ph.hamiltonian([1.0, 2, 3]), TypeError, "needs the body's ph.Inertia"),
        (lambda: ph.hamiltonian(INERTIA, lambda R, t: 1.0), TypeError, "the potential must be"),
        (lambda: FRAME.coriolis(0.0, jnp.ones(2)), ValueError, "vector must have shape"),
        (
            lambda: ph.frames.simulate_particles(
                FRAME, [1, 0, 0], [0, 0, 0], TS, solver=diffrax.Tsit5
            ),
            TypeError,
            "the class Tsit5",
        ),
    ],
)
def test_parts_in_each_other_s_place(call, error, word):
    with pytest.raises(error, match=word):
        call()


def test_lists_do_where_vectors_do(unchecked):
    np.testing.assert_allclose(INERTIA.momentum([1, 2, 3]), [1, 3, 6])
    np.testing.assert_allclose(FRAME.centrifugal(0.0, [1, 0, 0]), [1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(FRAME.position_to_space(0.0, [1, 2, 3]), [1, 2, 3])


def omega_of(scene, state=STATE):
    return ph.simulate(scene, state, TS, METHOD, rtol=1e-7).omega_body


TOP = ph.Scene(
    ph.Inertia.axisymmetric(1.0, 1.5),
    ph.UniformGravity(1.0, [0.0, 0.1, 0.5]) + ph.GravityGradient(1.0, ph.KeplerOrbit(1.0, 5.0)),
    ph.LinearDamping(0.1),
    ph.Rotor([0.0, 0.0, 1.0], 0.1, speed=1.0, coupling=ph.ViscousCoupling(0.1)),
)
FIELDS = {
    "inertia.axial": lambda s: s.inertia.axial,
    "potential.terms[0].mass": lambda s: s.potential.terms[0].mass,
    "potential.terms[1].position_space.mu": lambda s: s.potential.terms[1].position_space.mu,
    "torque.c": lambda s: s.torque.c,
    "rotors.axis_body": lambda s: s.rotors.axis_body,
    "rotors.coupling.c": lambda s: s.rotors.coupling.c,
}


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("value", [2.0, 1, [1.0, 1.5, 2.0], jnp.arange(3)], ids=type)
@pytest.mark.parametrize("use", [ph.simulate, ph.explain, lambda *a: ph.propagate(*a[:2], 1.0)])
def test_numbers_put_in_by_an_edit_raise_where_the_scene_is_used(field, value, use):
    edited = eqx.tree_at(FIELDS[field], TOP, value)
    with pytest.raises(TypeError, match=rf"scene\.{re.escape(field)} must be a floating-point"):
        use(edited, STATE, TS)


@pytest.mark.slow
def test_scenes_hold_anything_while_they_are_not_used():
    """tree_map, in_axes and optax put masks, axes and names in the place of arrays."""
    mask = jax.tree.map(lambda x: x.ndim > 0, TOP)
    assert mask.torque.c is True
    axes = jax.tree.map(lambda _: None, TOP)
    axes = eqx.tree_at(lambda s: s.torque.c, axes, 0, is_leaf=lambda x: x is None)
    batch = eqx.tree_at(lambda s: s.torque.c, TOP, jnp.ones((2, 3)))
    mapped = jax.vmap(lambda s: ph.simulate(s, STATE, TS).omega_body[-1], in_axes=(axes,))
    last = jax.eval_shape(mapped, batch)
    assert last.shape == (2, 3)
    known = eqx.tree_at(lambda s: s.torque.c, TOP, np.full(3, 0.1))
    np.testing.assert_array_equal(omega_of(known), omega_of(TOP))


@pytest.mark.parametrize(
    ("where", "made", "error", "word"),
    [
        (lambda s: s.inertia.diagonal, "abc", TypeError, r"scene\.inertia\.diagonal must be"),
        (lambda s: s.inertia.diagonal, [1.0, 2], TypeError, r"diagonal must be .*got list"),
        (lambda s: s.inertia.diagonal, jnp.ones(4), ValueError, r"diagonal must have shape"),
        (lambda s: s.inertia.diagonal, None, ValueError, "not both and not neither"),
        (lambda s: s.inertia, jnp.ones(3), TypeError, "Scene inertia must be ph.Inertia"),
        (lambda s: s.inertia, None, TypeError, "Scene inertia must be ph.Inertia"),
    ],
)
def test_edits_that_leave_no_scene(where, made, error, word):
    with pytest.raises(error, match=word):
        ph.simulate(eqx.tree_at(where, SCENE, made), STATE, TS)


def test_a_state_stepped_off_unit_length_is_a_rotation_again():
    plain = ph.simulate(SCENE, STATE, TS).wxyz
    edited = eqx.tree_at(lambda s: s.wxyz, STATE, 1.25 * STATE.wxyz)
    np.testing.assert_allclose(ph.simulate(SCENE, edited, TS).wxyz, plain, rtol=0, atol=1e-15)
    none = eqx.tree_at(lambda s: s.wxyz, STATE, 0 * STATE.wxyz)
    assert ph.simulate(SCENE, none, TS, throw=False).status == ph.Status.NOT_FINITE


garbage = st.one_of(
    st.none(),
    st.booleans(),
    st.text(max_size=3),
    st.integers(-(2**70), 2**70),
    st.floats(),
    st.complex_numbers(),
    st.lists(st.floats(), max_size=5),
    st.lists(st.lists(st.floats(), max_size=5), max_size=4),
    st.dictionaries(st.text(max_size=2), st.floats(), max_size=2),
)


@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(first=garbage, second=garbage)
@example(first=[1.0, 1.5, 2.0], second=[0.1, 0.0, 0.3])  # valid input
def test_garbage_never_passes_silently(unchecked, first, second):
    """A constructor raises ValueError or TypeError, or has finite arrays of the right rank."""
    makers = [
        lambda: ph.State(first, second),
        lambda: ph.UniformGravity(first, second),
        lambda: ph.GravityGradient(first, second),
        lambda: ph.BodyTorque(first),
        lambda: ph.SpaceTorque(second),
        lambda: ph.LinearDamping(first),
        lambda: ph.Inertia.from_moments(first),
        lambda: ph.Inertia.from_tensor(second),
        lambda: ph.State.from_euler(first, second, 0.3, rates=second),
    ]
    for make in makers:
        try:
            made = make()
        except (ValueError, TypeError):
            continue
        for name, rank in made.core_ranks.items():
            value = getattr(made, name)
            if value is not None:
                assert bool(jnp.all(jnp.isfinite(value)))
                assert value.ndim >= rank
