"""Python numbers and defaults take the dtype of the arrays of a scene."""

import jax
import jax.numpy as jnp
import pytest

import polhode as ph


def single(*x):
    return jnp.asarray(x if len(x) > 1 else x[0], jnp.float32)


def law(t, wxyz, omega_body):
    return -0.1 * omega_body


X, Z = single(1.0, 0.0, 0.0), single(0.0, 0.0, 1.0)
PLATES = ph.Plates(single([1.0]), single([[1.0, 0, 0]]), single([[0.5, 0, 0.1]]))
ORBIT = ph.KeplerOrbit(single(1.0), single(1.0))
CORNERS = single([[1.0, 1, 1], [-1, 1, 1], [-1, -1, 1], [1, -1, 1]])
PARTS = {
    "drag": lambda: {"torque": ph.Drag(PLATES, 1e-3, X)},
    "sunlight": lambda: {"torque": ph.SolarPressure(PLATES, X, ph.Eclipse(ORBIT, X))},
    "dumping": lambda: {
        "torque": ph.MomentumDumping(1e-3, X),
        "rotors": ph.Rotor(Z, momentum=single(0.1)),
    },
    "cluster": lambda: {
        "rotors": ph.wheel_cluster(CORNERS, 1e-3, law, speed=1.0, max_torque=0.1, null_gain=0.1)
    },
    "pointing": lambda: {"torque": ph.Pointing(0.1, 0.2)},
    "rates": lambda: {"torque": ph.RateDamping(0.1)},
    "dipole": lambda: {"torque": ph.MagneticDipole(ph.BDot(1.0), X)},
    "table": lambda: {"torque": ph.BodyTorque(ph.Table([0.0, 1.0], jnp.stack([X, Z])))},
    "gravity": lambda: {"potential": ph.UniformGravity(1.0, Z)},
}


@pytest.mark.parametrize(
    "name", [pytest.param(x, marks=pytest.mark.slow) if x == "cluster" else x for x in PARTS]
)
def test_single_precision_needs_no_conversion_of_defaults(name):
    scene = ph.Scene(ph.Inertia.from_moments(single(1.0, 1.5, 2.0)), **PARTS[name]())
    state = ph.State(single(1.0, 0.0, 0.0, 0.0), single(0.1, 0.2, 1.0))
    assert ph.explain(scene, state, [0.0, 1.0]).dtype == "float32"
    shapes = jax.eval_shape(lambda s: ph.simulate(scene, s, [0.0, 1.0], throw=False).wxyz, state)
    assert shapes.dtype == jnp.float32


def test_arrays_of_two_precisions_are_refused():
    scene = ph.Scene(
        ph.Inertia.from_moments(single(1.0, 1.5, 2.0)), torque=ph.Pointing(jnp.ones(3), 1.0)
    )
    with pytest.raises(TypeError, match="mix the dtypes"):
        ph.explain(scene, ph.State(single(1.0, 0.0, 0.0, 0.0), X), [0.0, 1.0])


def test_bodies_of_python_numbers_follow_the_state():
    """Constructors compute with NumPy only where this preserves the dtype."""
    state = ph.State(single(1.0, 0.0, 0.0, 0.0), single(0.1, 0.2, 1.0))
    for body in (ph.Inertia.from_cylinder(2.0, 0.1, 0.3), ph.Inertia.from_sphere(2.0, 0.1)):
        assert ph.explain(ph.Scene(body), state, [0.0, 1.0]).dtype == "float32"
    box = ph.Inertia.from_box(2.0, single(0.1, 0.2, 0.3))
    assert box.moments.dtype == jnp.float32
    traced = jax.jit(lambda m: ph.Inertia.from_cylinder(m, 0.1, 0.3).moments)(single(2.0))
    assert traced.dtype == jnp.float32
    weak = jax.vmap(lambda m: ph.Inertia.from_sphere(m, 0.1).moments)(single(1.0, 2.0))
    assert weak.dtype == jnp.float32
