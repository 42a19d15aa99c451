"""Every public method on every system to which it applies: value and gradient.

Bodies whose scenes have the same structure are one batch, so each row of ``METHODS`` is one
compiled program per dtype.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from diffrax import Dopri8
from systems.table import BY_NAME, truth

import polhode as ph
from polhode import Extrapolation

ACTING: dict[frozenset, list[str]] = {}
for _name, _system in BY_NAME.items():
    ACTING.setdefault(frozenset(_system.acts), []).append(_name)
FREE = ACTING[frozenset()]
ALL = [name for name, system in BY_NAME.items() if system.is_simple]
# Sunlight alone and wheels without dumping act in sunlight_and_shadow and momentum_dumping too;
# states and derivatives with tables and held commands are in test_tables and test_sampled.
ELSEWHERE = "sunlight", "cluster_of_wheels", "torque_from_a_table", "commands_held"
PARTS = [name for name in BY_NAME if name not in (*ALL, *ELSEWHERE)]
SYMMETRIC = ["symmetric_prolate", "symmetric_fading"]
FEW = [name for name in ALL if {"gravity", "body", "damping"}.issuperset(BY_NAME[name].acts)]


@dataclass(frozen=True)
class Way:
    """A method, the systems that it simulates together, and its error bounds in float64: value,
    gradient.

    ``axial``: the bodies are declared axisymmetric, with two moments each.
    """

    method: ph.AbstractMethod | None
    names: Sequence[str]
    bars: tuple[float, float] = (2e-11, 2e-9)
    axial: bool = False


EXACT = (1e-14, 2e-12)
METHODS = {
    **{  # the other fields, with the same steps, are in the rows of ALL
        f"planner {' and '.join(sorted(acts))}": Way(None, names)
        for acts, names in ACTING.items()
        if acts in ({"gravity"}, {"body", "damping"})
    },
    **{f"planner of {name}": Way(None, [name]) for name in PARTS},
    "planner axisymmetric": Way(None, ["symmetric_prolate"], EXACT, axial=True),
    "ClosedForm": Way(ph.ClosedForm(), FREE, EXACT),
    "LagrangeTop": Way(ph.LagrangeTop(), ["lagrange_top"], EXACT, axial=True),
    "SymmetricTop": Way(ph.SymmetricTop(), SYMMETRIC, EXACT, axial=True),
    "FixedAxis": Way(ph.FixedAxis(), ["spin_about_one_axis"], EXACT),
    "Dopri8": Way(ph.LiePoisson(Dopri8()), ALL),
    "Extrapolation compensated": Way(ph.LiePoisson(Extrapolation(8, compensated=True)), FEW),
    "CoarseSteps": Way(ph.CoarseSteps(), FEW),
    "CoarseSteps without a potential": Way(
        ph.CoarseSteps(), [name for name in FEW if "gravity" not in BY_NAME[name].acts]
    ),
    "EulerAngles of few": Way(ph.EulerAngles(Dopri8()), FEW),
    "Dopri8 of sunlight_and_shadow": Way(ph.LiePoisson(Dopri8()), ["sunlight_and_shadow"]),
}

# Rotation of the space axes in which the systems are simulated, so that no motion passes a pole of
# the Euler angles; the motions are otherwise the same.
TILT = np.array([0.51, 0.48, -0.71, 0.0])
TILT = TILT / np.linalg.norm(TILT)


def acting(names: Sequence[str], moments):
    """Potential and torque of the systems as objects of the package; absent if there are none."""
    dtype, systems = moments.dtype, [BY_NAME[name] for name in names]

    def vectors(part):
        return jnp.array([system.acts.get(part, (0, 0, 0)) for system in systems], dtype)

    def strengths_and_vectors(part):
        found = [system.acts.get(part, (0, (0, 0, 1))) for system in systems]
        return tuple(jnp.array(x, dtype) for x in zip(*found))

    acts = {part for system in systems for part in system.acts}
    tilt = jnp.broadcast_to(jnp.array(TILT, dtype), (len(names), 4))
    potentials, torques = [], []
    if "gravity" in acts:
        weight, centre = strengths_and_vectors("gravity")
        down = ph.rotation.rotate(tilt, jnp.array([[0, 0, -1]], dtype))
        potentials.append(ph.UniformGravity(weight, centre, down))
    if "gradient" in acts:
        strength, along = strengths_and_vectors("gradient")
        potentials.append(ph.GravityGradient(strength / 3, ph.rotation.rotate(tilt, along)))
    if "body" in acts:
        torques.append(ph.BodyTorque(vectors("body")))
    if "space" in acts:
        torques.append(ph.SpaceTorque(ph.rotation.rotate(tilt, vectors("space"))))
    if "damping" in acts:
        torques.append(ph.LinearDamping(vectors("damping")))
    if "fading" in acts:
        rate = jnp.array([system.acts.get("fading", 0) for system in systems], dtype)
        torques.append(ph.LinearDamping(rate[:, None] * moments))
    if "sink" in acts:
        torques.append(ph.EnergySink(jnp.array([system.sink for system in systems], dtype)))
    potential = sum(potentials[1:], start=potentials[0]) if potentials else None
    torque = sum(torques[1:], start=torques[0]) if torques else None
    return potential, torque


def with_parts(system, moments):
    """Inertia, torque and rotors of a system with more than simple torques; a batch of one."""
    ((kind, numbers),) = system.acts.items()
    dtype, ends = moments.dtype, jnp.array(system.span, moments.dtype)
    inertia = ph.Inertia.from_moments(moments)

    def array(x):
        return jnp.array(x, dtype)

    def space(x):
        return ph.rotation.rotate(array(np.broadcast_to(TILT, (*np.shape(x)[:-1], 4))), array(x))

    def plates(some):
        return ph.Plates(*(array(np.array([plate[k] for plate in some])) for k in range(3)))

    if kind == "table":
        rows = np.array(numbers)
        powers = [float(t) ** np.arange(4) for t in system.span]
        slopes = [np.arange(4) * float(t) ** np.array([0, 0, 1, 2]) for t in system.span]
        table = ph.Table(ends, array(powers @ rows), derivatives=array(slopes @ rows))
        return inertia, ph.BodyTorque(table), None
    if kind == "drag":
        some, density, velocity, coefficient = numbers
        torque = ph.Drag(plates(some), array(density), space(velocity), array(coefficient))
        return inertia, torque, None
    if kind == "light":
        some, direction, *others, shadow = numbers
        lit, sun = array(1.0), space(direction)
        if shadow is not None:
            places, radius = ph.Table(ends, space(shadow[:2]), order=1), shadow[2]
            lit = ph.Eclipse(places, sun, array(radius))
        return inertia, ph.SolarPressure(plates(some), sun, lit, *map(array, others)), None
    if kind == "growth":
        later = moments + array([numbers]) * (ends[1] - ends[0])
        table = ph.Table(ends, jnp.stack([moments, later], axis=-2), order=1)
        return ph.VariableInertia(table), None, None
    if kind == "gyro":
        momentum, rate = numbers
        angle = ph.Table(ends, rate * ends, order=1)
        x, z = array([1, 0, 0]), array([0, 0, 1])
        return inertia, ph.ControlMomentGyro(array(momentum), z, x, angle), None
    if kind == "sampled":
        gains = array(numbers)
        return inertia, ph.SampledTorque(lambda t, wxyz, omega: -gains * omega, 0.5), None
    axes, wheel, speeds, gains, dumping = numbers
    gains = array(gains)
    wheels = ph.wheel_cluster(
        array(axes), array(wheel), lambda t, wxyz, omega: -gains * omega, speed=array(speeds)
    )
    torque = None
    if dumping is not None:
        torque = ph.MomentumDumping(array(dumping[0]), space(dumping[1]))
    return inertia, torque, wheels


def final_states(way: Way, moments, rtol):
    """(omega, wxyz) (N, 7) at the last times, wxyz with the sign of the reference."""
    dtype, systems = moments.dtype, [BY_NAME[name] for name in way.names]
    if way.axial:
        inertia = ph.Inertia.axisymmetric(*moments.T)
        moments = moments[:, [0, 0, 1]]
    else:
        inertia = ph.Inertia.from_moments(moments)
    tilt = jnp.array(TILT, dtype)
    wxyz = ph.rotation.multiply(tilt, jnp.array([system.wxyz for system in systems], dtype))
    state = ph.State(wxyz, jnp.array([system.omega for system in systems], dtype))
    times = jnp.array([system.span for system in systems], dtype)
    if systems[0].is_simple:
        scene = ph.Scene(inertia, *acting(way.names, moments))
    else:
        inertia, torque, rotors = with_parts(systems[0], moments)
        scene = ph.Scene(inertia, torque=torque, rotors=rotors)
        times = np.array(systems[0].span, dtype)
    record = ph.Record(final_only=True)
    end = ph.simulate(scene, state, times, way.method, rtol=rtol, record=record)
    exact = jnp.array([truth(name)["state"][3:] for name in way.names], dtype)
    wxyz = ph.rotation.multiply(ph.rotation.conjugate(tilt), end.wxyz[:, 0])
    wxyz = wxyz * jnp.sign(jnp.sum(wxyz * exact, axis=-1, keepdims=True))
    return jnp.concatenate([end.omega_body[:, 0], wxyz], axis=-1)


def check(way: Way, dtype):
    """Values and gradients at the last times, of all systems of a method in one program."""
    exact = [truth(system) for system in way.names]
    moments = np.array([BY_NAME[system].moments for system in way.names])
    states = np.array([entry["state"] for entry in exact])
    slopes = np.array([entry["gradient"] for entry in exact])
    if way.axial:
        moments = moments[:, [0, 2]]
        slopes = np.stack([slopes[..., 0] + slopes[..., 1], slopes[..., 2]], axis=-1)
    double = dtype == jnp.float64

    def value(moments):
        return final_states(way, moments, 1e-13 if double else 1e-6)

    @jax.jit
    def both(moments):
        found, pull = jax.vjp(value, moments)
        each = jnp.broadcast_to(jnp.eye(7, dtype=dtype)[:, None], (7, *found.shape))
        return found, jax.vmap(pull)(each)[0]

    found, jacobian = both(jnp.array(moments, dtype))
    assert found.dtype == jacobian.dtype == dtype
    found, jacobian = np.asarray(found, float), np.moveaxis(np.asarray(jacobian, float), 0, 1)
    steep = np.abs(slopes).max(axis=(1, 2))
    unstable = np.array([BY_NAME[system].unstable for system in way.names])
    of_value, of_gradient = way.bars if double else (4e-6 * np.maximum(steep, unstable), 1e-3)
    error = np.abs(found - states).max(axis=1)
    assert np.all(error < of_value), dict(zip(way.names, error / of_value))
    error = np.abs(jacobian - slopes).max(axis=(1, 2)) / steep
    assert np.all(error < of_gradient), dict(zip(way.names, error / of_gradient))


def rows(*heavy: str):
    """Names of all methods; ``heavy``: those whose programs take long to compile (slow tests)."""
    slow = pytest.mark.slow
    return [pytest.param(name, marks=slow) if name in heavy else name for name in METHODS]


# Methods with tests of their own of values and gradients, in tops and in solvers; and rows whose
# fields and coordinates act in the others.
COVERED = (
    *(name for name, way in METHODS.items() if set(way.names) <= set(PARTS)),
    *("LagrangeTop", "Extrapolation compensated", "Dopri8"),
    "EulerAngles of few",  # values: tests/hamiltonian
    *("planner axisymmetric", "planner body and damping"),  # as ClosedForm and CoarseSteps
    "CoarseSteps",  # without a potential; with one: planner gravity
)
# In single precision every method and all coordinates, and wheels; other rows differ only in the
# field or the solver.
SINGLE = ("ClosedForm",)
SINGLE_SLOW = (
    *("planner gravity", "planner axisymmetric", "LagrangeTop", "SymmetricTop", "FixedAxis"),
    *("Extrapolation compensated", "CoarseSteps", "EulerAngles of few"),
    "planner of momentum_dumping",
)


@pytest.mark.parametrize("name", rows(*COVERED))
def test_state_and_gradient(name):
    check(METHODS[name], jnp.float64)


@pytest.mark.parametrize(
    "name", [*SINGLE, *(pytest.param(name, marks=pytest.mark.slow) for name in SINGLE_SLOW)]
)
def test_state_and_gradient_in_single_precision(name):
    check(METHODS[name], jnp.float32)


def test_the_table_runs_every_public_method():
    """Each is named here, so that a new method cannot be forgotten."""
    public = {
        getattr(ph, name)
        for name in dir(ph)
        if isinstance(getattr(ph, name), type)
        and issubclass(getattr(ph, name), ph.AbstractMethod)
        and getattr(ph, name) is not ph.AbstractMethod
    }
    run = {type(way.method) for way in METHODS.values()}
    assert public <= run, public - run
