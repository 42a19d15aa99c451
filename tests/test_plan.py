"""The choice of the method: by types only, the same in every call, and explained."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from benchmarks.scene_cost import states
from polhode import rotation
from polhode._batch import common_batch
from polhode._plan import choose


def test_the_choice_follows_the_structure():
    inertia = ph.Inertia.from_moments([1.0, 2.0, 3.0])
    assert isinstance(choose(ph.Scene(inertia))[0], ph.ClosedForm)
    pushed = ph.Scene(inertia, torque=ph.BodyTorque(lambda t: jnp.stack([t, 0 * t, 0 * t])))
    assert not isinstance(choose(pushed)[0], ph.ClosedForm)
    with pytest.raises(ValueError, match="free bodies only"):
        ph.simulate(pushed, ph.State([1.0, 0, 0, 0], [0.0, 0, 1]), [0.0, 1.0], ph.ClosedForm())


EQUAL = ph.Inertia.from_moments([1.0, 1.0, 1.5])
SYMMETRIC = ph.Inertia.axisymmetric(1.0, 1.5)
TRIAXIAL = ph.Inertia.from_moments([1.0, 1.5, 2.0])
AXIAL = ph.UniformGravity.axial(1.0, 0.3)
ON_AXIS = ph.UniformGravity(1.0, [0.0, 0.0, 0.3])
WHEEL = ph.Rotor.axial(0.1, speed=0.3)
ALIKE = {
    "free": (ph.Scene(TRIAXIAL), "ClosedForm"),
    "free, symmetric": (ph.Scene(SYMMETRIC), "ClosedForm"),
    "free, tensor": (ph.Scene(ph.Inertia.from_tensor(TRIAXIAL.tensor)), "ClosedForm"),
    "Lagrange's top": (ph.Scene(SYMMETRIC, AXIAL), "LagrangeTop"),
    "sphere on its axis": (ph.Scene(ph.Inertia.spherical(1.0), AXIAL), "LagrangeTop"),
    "with a wheel": (ph.Scene(SYMMETRIC, AXIAL, rotors=WHEEL), "LagrangeTop"),
    "gyrostat": (ph.Scene(SYMMETRIC, rotors=WHEEL), "SymmetricTop"),
    "equal moments": (ph.Scene(EQUAL, AXIAL), "LiePoisson"),
    "centre of mass on the axis": (ph.Scene(SYMMETRIC, ON_AXIS), "LiePoisson"),
    "no weight": (ph.Scene(SYMMETRIC, ph.UniformGravity(0.0, [0.0, 0.1, 0.3])), "LiePoisson"),
    "no gravity": (ph.Scene(TRIAXIAL, ph.UniformGravity(1, [0.1, 0, 0], [0.0] * 3)), "LiePoisson"),
    "wheel on z": (
        ph.Scene(SYMMETRIC, AXIAL, rotors=ph.Rotor([0.0, 0.0, 1.0], 0.1, speed=0.3)),
        "LiePoisson",
    ),
    "free wheel": (
        ph.Scene(SYMMETRIC, rotors=ph.Rotor.axial(0.1, speed=0.3, torque=0.0)),
        "LiePoisson",
    ),
    "axial damping": (ph.Scene(SYMMETRIC, torque=ph.LinearDamping([0.1, 0.1, 0.15])), "LiePoisson"),
    "spin about an axis": (ph.Scene(TRIAXIAL, torque=ph.BodyTorque([0.0, 0.0, 0.1])), "LiePoisson"),
    "gradient": (ph.Scene(TRIAXIAL, ph.GravityGradient(1.0, [0.0, 0.0, 2.0])), "LiePoisson"),
    "orbit": (
        ph.Scene(TRIAXIAL, ph.GravityGradient(1.0, ph.KeplerOrbit(1.0, 2.0, 0.0))),
        "LiePoisson",
    ),
}


ALIKE_FAST = (  # one of each method, and bodies that are symmetric by their numbers only
    *("free", "free, symmetric", "with a wheel", "gyrostat", "equal moments", "no weight"),
    *("no gravity", "wheel on z", "axial damping"),
)


@pytest.mark.parametrize(
    ("name", "rtol"),
    [
        *(
            (x, None) if x in ALIKE_FAST else pytest.param(x, None, marks=pytest.mark.slow)
            for x in ALIKE
        ),
        ("free", 1e-12),
        ("gradient", 1e-12),
    ],
)
def test_plain_calls_jit_vmap_and_grad_choose_alike(name, rtol):
    """No number of scene, state or times affects the choice. Nothing is simulated."""
    scene, expected = ALIKE[name]
    state, ts = ph.State([1.0, 0, 0, 0], [0.0, 0.0, 0.7]), jnp.array([0.0, 1e9])

    def run(scene, state, ts):
        return ph.simulate(scene, state, ts, rtol=rtol)

    def loss(scene, state, ts):
        trajectory = run(scene, state, ts)
        return jnp.sum(trajectory.omega_body), trajectory

    several = [jax.tree.map(lambda x: jnp.stack([x, x]), x) for x in (scene, state, ts)]
    traced = [
        jax.eval_shape(run, scene, state, ts),
        jax.eval_shape(lambda ts: run(scene, state, ts), ts),
        jax.eval_shape(jax.vmap(run), *several),
        jax.eval_shape(jax.grad(loss, has_aux=True), scene, state, ts)[1],
    ]
    method = ph.explain(scene, state, ts, rtol=rtol).method
    assert type(method).__name__ == expected
    for trajectory in traced:
        assert jax.tree.structure(trajectory.propagator.method) == jax.tree.structure(method)


def test_specialise_says_by_constructors_what_numbers_say():
    """The specialised scene has the same motion, in closed form; explain names its constructors for
    the original scene.
    """
    wheels = ph.Rotor([0.0, 0.0, 2.0], 0.1, speed=0.3) + ph.Rotor([0.0, 0.0, 1.0], momentum=0.1)
    scene = ph.Scene(EQUAL, ON_AXIS, rotors=wheels)
    state, ts = ph.State([0.6, 0, 0.8, 0], [0.2, 0.1, 3.0]), [0.0, 1.0, 2.0]
    plan = ph.explain(scene, state, ts)
    assert not plan.method.exact
    for constructor in ("ph.Inertia.axisymmetric", "ph.UniformGravity.axial", "ph.Rotor.axial"):
        assert constructor in str(plan)
    special = ph.specialise(scene)
    assert ph.explain(special, state, ts).closed_form == "LagrangeTop"
    assert ph.explain(special, state, ts).narrower == ()
    exact, stepped = (ph.simulate(x, state, ts, rtol=1e-11) for x in (special, scene))
    np.testing.assert_allclose(exact.wxyz, stepped.wxyz, atol=1e-9)
    np.testing.assert_allclose(exact.wheel_speed, stepped.wheel_speed, atol=1e-9)


@pytest.mark.parametrize(
    ("inertia", "symmetry"),
    [
        (ph.Inertia([2.0, 2.0, 2.0]), "SPHERICAL"),
        (ph.Inertia.axisymmetric(2.0, 2.0), "SPHERICAL"),
        (ph.Inertia.from_tensor(np.diag([2.0, 2.0, 3.0])), "AXISYMMETRIC"),
        (ph.Inertia([[2.0, 2.0, 3.0], [2.0, 2.5, 3.0]]), "NONE"),
        (ph.Inertia.from_tensor(np.diag([2.0, 2.5, 3.0])), "NONE"),
        (ph.Inertia([2.0, 3.0, 3.0]), "NONE"),
    ],
)
def test_specialised_inertia_holds_the_same_moments(inertia, symmetry):
    special = ph.specialise(ph.Scene(inertia)).inertia
    assert special.symmetry.name == symmetry
    np.testing.assert_array_equal(special.tensor, inertia.tensor)
    assert special.is_principal


def test_specialise_keeps_the_batch():
    axes = np.outer([1.0, 2.0, 3.0], [0.0, 0.0, 1.0])
    orbit = ph.KeplerOrbit(1.0, 2.0, np.zeros(3))
    scene = ph.Scene(TRIAXIAL, ph.GravityGradient(1.0, orbit))
    assert common_batch(ph.specialise(scene).potential) == (3,)
    for wheel in (ph.Rotor(axes, momentum=0.1), ph.Rotor(axes, 0.1, speed=[0.1, 0.2, 0.3])):
        assert common_batch(ph.specialise(ph.Scene(TRIAXIAL, rotors=wheel)).rotors) == (3,)


def test_specialise_keeps_what_is_no_narrower_and_refuses_traced_numbers():
    orbit = ph.GravityGradient(1.0, ph.KeplerOrbit(1.0, 2.0, 0.0))
    others = ph.UniformGravity(1.0, [0.0, 0.1, 0.3]) + ph.Potential(lambda R, t: R[2, 2])
    scene = ph.Scene(TRIAXIAL, others + orbit, rotors=ph.Rotor([0.0, 0.0, -1.0], momentum=0.1))
    special = ph.specialise(scene)
    assert special.potential.terms[0].centre_body is not None
    assert special.potential.terms[2].position_space.eccentricity is None
    assert special.rotors.axis is None
    with pytest.raises(ValueError, match="outside of jit and grad"):
        jax.jit(ph.specialise)(scene)
    with pytest.raises(TypeError, match=r"a ph\.Scene"):
        ph.specialise(TRIAXIAL)


@pytest.mark.slow
def test_gradients_across_absent_gravity_are_nan_and_those_along_the_axis_right():
    """Zero gravity has no direction: such derivatives are NaN, never wrong numbers."""
    state, ts = ph.State([1.0, 0, 0, 0], [0.1, 0.2, 0.3]), [0.0, 1.0]

    def loss(gravity, mass=1.0):
        scene = ph.Scene(TRIAXIAL, ph.UniformGravity(mass, [0.1, 0.2, 0.3], gravity))
        return ph.simulate(scene, state, ts, rtol=1e-10).omega_body[-1, 0]

    slope = jax.grad(loss)(jnp.zeros(3))
    assert np.all(np.isnan(slope[:2]))
    up, down = (loss(jnp.array([0.0, 0.0, s])) for s in (1e-4, -1e-4))
    np.testing.assert_allclose(slope[2], (up - down) / 2e-4, rtol=1e-6)
    side = jnp.array([0.0, 1.0, 0.0])
    heavy, none = (loss(side, m) for m in (1e-4, 0.0))
    by_mass = jax.grad(lambda m: loss(side, m))(0.0)
    np.testing.assert_allclose(by_mass, (heavy - none) / 1e-4, rtol=1e-3)


def test_a_tolerance_near_rounding_has_compensated_frequencies():
    """After 1e6 rad the error of the rounded phase is 2e-10 rad: above 1e-12 and below 1e-9."""
    scene = ph.Scene(ph.Inertia.from_moments([1.0, 2.0, 3.0]))
    state, ts = ph.State([1.0, 0, 0, 0], [0.0, 0.6, 0.8]), jnp.array([0.0, 1e6])
    assert choose(scene, 1e-12)[0].compensated
    assert not choose(scene, 1e-9)[0].compensated
    assert "sums of two floats" in str(ph.explain(scene, state, ts, rtol=1e-12))
    chosen, plain = (
        ph.simulate(scene, state, ts, rtol=rtol, record=ph.Record(final_only=True))
        for rtol in (1e-12, 1e-9)
    )
    apart = float(rotation.angle_between(chosen.wxyz[-1], plain.wxyz[-1]))
    assert 1e-13 < apart < 1e-9


@pytest.mark.slow  # faster: random bodies, solvers/test_error_control
def test_many_bodies_under_a_potential_reach_the_error_asked_for():
    """The default method for 40 heavy tops against the exact state of the table of systems."""
    from systems.table import BY_NAME, truth

    system, exact = BY_NAME["heavy_asymmetric_top"], truth("heavy_asymmetric_top")
    weight, centre = system.acts["gravity"]
    # the same top, in space axes rotated by a quarter turn
    side = rotation.axis_angle_to_wxyz(jnp.array([0.6, 0.8, 0.0]), jnp.array(1.25))
    down = rotation.rotate(side, jnp.array([0.0, 0.0, -1.0]))
    scene = ph.Scene(
        ph.Inertia.from_moments(system.moments), ph.UniformGravity(weight, centre, down)
    )
    wxyz = rotation.multiply(side, rotation.normalise(jnp.array(system.wxyz)))
    state = ph.State(jnp.tile(wxyz, (40, 1)), jnp.array(system.omega))
    ts = jnp.array([0.0, 2.5, 6.0])
    for rtol in (1e-6, 1e-10):
        method, _ = choose(scene, rtol)
        assert isinstance(method.solver, ph.Extrapolation)
        assert method.chart.upright
        traj = ph.simulate(scene, state, ts, rtol=rtol)
        back = rotation.multiply(rotation.conjugate(side), traj.wxyz[:, -1])
        error = rotation.angle_between(back, jnp.array(exact["state"][3:])[None])
        assert float(jnp.max(error)) < 10 * rtol
        first = jnp.broadcast_to(traj.energy[:, :1], (40, 3))
        np.testing.assert_allclose(traj.energy, first, rtol=10 * rtol)


def test_one_body_reaches_the_error_asked_for():
    from systems.table import BY_NAME, truth

    system, exact = BY_NAME["driven_and_damped"], truth("driven_and_damped")
    torque = ph.BodyTorque(system.acts["body"]) + ph.LinearDamping(system.acts["damping"])
    scene = ph.Scene(ph.Inertia.from_moments(system.moments), torque=torque)
    state = ph.State(np.array(system.wxyz, float), system.omega)
    end = ph.simulate(scene, state, jnp.array(system.span, float), rtol=1e-10)
    error = rotation.angle_between(end.wxyz[-1], jnp.array(exact["state"][3:]))
    assert float(error) < 1e-9


def test_explain_says_what_runs_what_is_skipped_and_why():
    scene = ph.Scene(ph.Inertia.from_moments([1.0, 2.0, 3.0]))
    state, ts = states(1000), [0.0, 50.0, 100.0]
    text = str(ph.explain(scene, state, ts))
    for part in (
        "1,000 bodies x 3 samples, float64",
        "runs    ClosedForm",
        "nothing acts",
        "skips   ",
        "potential, torque",
        "not in the scene",
        "error   rounding only",
    ):
        assert part in text, text
    exact = ph.explain(scene, state, [0.0, 1e6], ph.ClosedForm(compensated=True))
    assert "at any time" in exact.error
    assert "at the last time" in ph.explain(scene, state, [0.0, 1e6]).error
    asked = str(ph.explain(scene, state, ts, ph.LiePoisson(), record=ph.Record(final_only=True)))
    assert "LiePoisson(Dopri8): as requested" in asked
    assert "only the last time is recorded" in asked
    with pytest.raises(ValueError, match="strictly"):
        ph.explain(scene, state, [0.0, 0.0])


class Own(ph.AbstractMethod):
    """A user-defined integrating method without coordinates, solver or controller."""

    def run(self, scene, state, ts, rtol, record):
        raise NotImplementedError


def test_explain_knows_the_method_of_a_user():
    """explain uses only attributes of every method, and states no error for it."""
    plan = ph.explain(ph.Scene(ph.Inertia.from_moments([1.0, 2, 3])), states(1), [0.0, 1.0], Own())
    assert "runs    Own: as requested" in str(plan)
    assert plan.error == "unknown: the requested steps do not follow from rtol"


def test_explain_says_that_steps_of_another_solver_pass_jumps():
    body, ts = ph.Inertia.from_moments([1.0, 2.0, 3.0]), [0.0, 1.0]
    relay = ph.FeedbackTorque(lambda t, wxyz, omega: -jnp.sign(omega))
    for torque, passes in ((relay, True), (ph.LinearDamping(0.1), False)):
        scene = ph.Scene(body, torque=torque)
        plan = ph.explain(scene, states(1), ts, ph.LiePoisson(diffrax.Tsit5()))
        assert ("pass jumps of a torque" in str(plan)) == passes
        assert "pass jumps" not in str(ph.explain(scene, states(1), ts))


def test_explain_says_why_no_exact_law_holds():
    """Every closed form is named once with its reason; none is named if a closed form runs."""
    scene = ph.Scene(ph.Inertia.from_moments([1.0, 2.0, 3.0]), ph.UniformGravity(1.0, [0, 0, 1.0]))
    stepped = ph.explain(scene, states(1), [0.0, 1.0])
    assert [line.partition(":")[0] for line in stepped.refused] == [
        "free body",
        "Lagrange's top",
        "symmetric top",
        "fixed axis",
    ]
    for reason in ("has a potential", "not one of ph.Inertia.axisymmetric", "a potential acts"):
        assert reason in str(stepped)
    assert ph.explain(ph.Scene(scene.inertia), states(1), [0.0, 1.0]).refused == ()


@pytest.mark.parametrize(
    "inertia",
    [ph.Inertia.axisymmetric(2.0, 0.5), ph.Inertia.spherical(2.0)],
    ids=["axial", "sphere"],
)
@pytest.mark.slow  # faster: other symmetric bodies, tests/systems and tests/free
def test_static_symmetry_gives_the_same_motion_and_slope(inertia):
    """The programs for declared symmetry agree with the general one, which is tested against 50
    digits.
    """
    general = ph.Inertia.from_moments(inertia.moments)
    state, ts = states(5), jnp.linspace(0.0, 20.0, 4)

    def last(omega, inertia):
        end = ph.simulate(ph.Scene(inertia), ph.State(state.wxyz, omega), ts)
        return jnp.sum(end.omega_body[:, -1, 0] + end.wxyz[:, -1, 1] ** 2), end

    (slope, one), (want, other) = (
        jax.grad(last, has_aux=True)(state.omega_body, i) for i in (inertia, general)
    )
    assert float(jnp.max(rotation.angle_between(one.wxyz, other.wxyz))) < 1e-13
    np.testing.assert_allclose(one.omega_body, other.omega_body, atol=1e-13)
    np.testing.assert_allclose(slope, want, atol=1e-11)
    only = ph.simulate(ph.Scene(inertia), state, ts, record=ph.Record(attitude=False))
    np.testing.assert_allclose(only.omega_body, one.omega_body, atol=1e-15)


@pytest.mark.parametrize("bodies", [1, pytest.param(5_000, marks=pytest.mark.slow)])
def test_known_states_and_times_may_be_closed_over_under_jit(bodies):
    """The choice inspects values, which operations under ``jit`` would turn into tracers."""
    rng = np.random.default_rng(3)
    state = ph.State(rng.normal(size=(bodies, 4)), rng.normal(size=(bodies, 3)))
    ts = jnp.array([0.0, 3.0])
    scene = ph.Scene(ph.Inertia.from_moments([1.0, 1.5, 2.0]))
    free, pushed = [], []

    @jax.jit
    def last():
        free.append(str(ph.explain(scene, state, ts)))
        torqued = ph.Scene(scene.inertia, None, ph.BodyTorque([0.1, 0, 0]))
        pushed.append(str(ph.explain(torqued, state, ts)))
        return ph.simulate(scene, state, ts).wxyz[:, -1]

    want = ph.simulate(scene, state, ts).wxyz[:, -1]
    np.testing.assert_allclose(last(), want, atol=1e-14)
    assert free == [str(ph.explain(scene, state, ts))]
    assert "about 1e-09 rad at every saved time" in pushed[0]


def test_exact_laws_in_one_chunk():
    """``chunk=None``: all bodies at once, the same motion."""
    scene, ts = ph.Scene(ph.Inertia.axisymmetric(1.0, 2.0)), [0.0, 0.5, 1.0]
    whole, parts = (ph.simulate(scene, states(3), ts, ph.SymmetricTop(chunk=n)) for n in (None, 2))
    # Last bits depend on how the compiler vectorises three bodies and two.
    np.testing.assert_allclose(whole.wxyz, parts.wxyz, rtol=0, atol=1e-15)


def test_weights_of_a_batch_share_one_direction_of_gravity():
    """Masses, centres or strengths of many bodies, including a body without weight."""
    state, ts = ph.State([1.0, 0, 0, 0], [0.0, 0.1, 1.0]), [0.0, 1.0]
    down, masses = [0.1, 0.2, -9.0], np.array([1.0, 0.0])
    weights = ph.UniformGravity(masses, [0.1, 0.0, 0.3], down)
    both = ph.simulate(ph.Scene(TRIAXIAL, weights), state, ts, rtol=1e-10)
    for k, mass in enumerate(masses):
        alone = ph.Scene(TRIAXIAL, ph.UniformGravity(mass, [0.1, 0.0, 0.3], down))
        one = ph.simulate(alone, state, ts, rtol=1e-10)
        np.testing.assert_allclose(both.wxyz[k], one.wxyz, atol=1e-9)
    np.testing.assert_allclose(both.energy[:, 1], both.energy[:, 0], rtol=1e-9)


def test_explain_names_what_decays_too_fast():
    """Narrow friction relaxes at the rate torque / speed (1 / J + 1 / (I - J)), which limits
    explicit steps; for a batch explain states the rate of the worst body.
    """
    friction = ph.CoulombFriction(1e-3, 1e-4)
    wheel = ph.Rotor([0.0, 0.0, 1.0], inertia=1e-3, speed=50.0, coupling=friction)
    scene = ph.Scene(ph.Inertia.from_moments([1.0, 1.5, 2.0]), rotors=wheel)
    state = ph.State([1.0, 0, 0, 0], [0.0, 0.0, 0.1])
    plan = ph.explain(scene, state, [0.0, 10.0])
    assert "Kvaerno5" in str(plan)
    rate = 1e-3 / 1e-4 * (1 / 1e-3 + 1 / (2 - 1e-3))
    assert f"{rate:.1e}/s" in plan.stiff
    assert ph.explain(scene, state, [0.0, 0.1]).stiff is None
    assert ph.explain(scene, state, [0.0, 10.0], ph.LiePoisson()).stiff is None
    drag = ph.Scene(ph.Inertia.from_moments([1.0, 1.5, 2.0]), torque=ph.LinearDamping([1.0, 1, 80]))
    batch = ph.State([[1.0, 0, 0, 0]] * 2, [[0.0, 0.0, 0.1]] * 2)
    assert "4.0e+01/s" in ph.explain(drag, batch, [0.0, 1000.0]).stiff


def test_explain_while_a_function_of_the_scene_closes_over_what_is_traced():
    """The rate of decay is then unknown."""

    def stiff(gain):
        law = ph.FeedbackTorque(lambda t, wxyz, omega: -gain * omega)
        scene = ph.Scene(TRIAXIAL, torque=law)
        plan = ph.explain(scene, ph.State([1.0, 0, 0, 0], [0.1, 0.2, 0.3]), [0.0, 10.0])
        assert (plan.stiff is None) == isinstance(gain, jax.core.Tracer)
        return gain

    stiff(1e5)
    jax.eval_shape(stiff, 1e5)


def test_orbits_of_torques_become_circles_too():
    orbit = ph.KeplerOrbit(3.986e14, 6.9e6, 0.0)
    field = ph.DipoleField([0.0, 0.0, 7.8e22])
    torque = ph.MagneticDipole([1.0, 0, 0], field=field, position=orbit) + ph.LinearDamping(0.1)
    scene = ph.Scene(ph.Inertia.from_moments([1.0, 2.0, 3.0]), torque=torque)
    special = ph.specialise(scene).torque
    assert special.terms[0].position.eccentricity is None
    assert torque.terms[0].position.eccentricity is not None


def test_an_orbit_of_plain_numbers_has_no_precision_of_its_own():
    gravity = ph.GravityGradient(3.986e14, ph.KeplerOrbit(3.986e14, 6.9e6, 0.1))
    single = [np.float32([1, 2, 3]), np.float32([1, 0, 0, 0]), np.float32([0.1, 1, 0.2])]
    scene = ph.Scene(ph.Inertia.from_moments(single[0]), gravity)
    traj = ph.simulate(scene, ph.State(*single[1:]), np.float32([0, 10]))
    assert traj.omega_body.dtype == np.float32
