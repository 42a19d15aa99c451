"""Programs contain no operations that a scene does not need."""

import jax
import jax.numpy as jnp
import pytest

import polhode as ph
from benchmarks.scene_cost import counts, program, scenes, states
from polhode._hamiltonian import Dynamics, lie_poisson_field

N = 64


@pytest.fixture(scope="module")
def costs():
    """Operations, transcendental functions, bytes and text of the program of each free scene."""
    found = {}
    for name, (scene, record, times) in scenes().items():
        if scene.is_free and "100" not in name:
            compiled, _ = program(scene, states(N), jnp.linspace(0.0, 100.0, times), record)
            found[name] = {**counts(compiled), "text": compiled.compiled.as_text()}
    return found


def test_rates_alone_carry_no_attitude_and_no_third_kind(costs):
    both, rates = costs["free, final state"], costs["free, rates only, final state"]
    assert rates["flops"] < 0.5 * both["flops"]
    assert rates["transcendentals"] < 0.5 * both["transcendentals"]
    assert f"f64[{N},4]" not in rates["text"].split("ENTRY")[1].split("ROOT")[1]


def test_symmetric_bodies_evaluate_no_elliptic_function(costs):
    """No arithmetic-geometric mean: almost no square roots, and few transcendental functions."""
    general = costs["free, final state"]
    for name in ("free, axisymmetric, final state", "free, spherical, final state"):
        assert costs[name]["flops"] < 0.15 * general["flops"]
        assert costs[name]["transcendentals"] <= 8 * N
    assert (
        costs["free, spherical, final state"]["flops"]
        < costs["free, axisymmetric, final state"]["flops"]
    )


def test_principal_axes_are_found_only_for_general_tensors(costs):
    general, principal = costs["free, general tensor, final state"], costs["free, final state"]
    assert general["flops"] > principal["flops"]


def field_operations(scene):
    """Floating-point operations of one evaluation of the field for one body."""
    y = (tuple(jnp.ones(N) for _ in range(3)), tuple(jnp.ones(N) for _ in range(4)))
    system = Dynamics(scene.hamiltonian, scene.torque)
    # before fusion, since XLA then repeats shared parts in every output
    return jax.jit(lie_poisson_field).lower(0.0, y, system).cost_analysis()["flops"] / N


def test_absent_parts_cost_no_operation():
    """The free field has the operations of Euler's equations and the quaternion rate: 39."""
    inertia = ph.Inertia.from_moments([1.0, 2.0, 3.0])
    free = field_operations(ph.Scene(inertia))
    by_hand = 3 + 9 + 3 + 24  # L/I; L x w; w/2; the quaternion product (negations count)
    assert free <= by_hand + 9  # jax.grad of the squares
    up = ph.UniformGravity(1.0, [0.0, 0.0, 0.5], [0.0, 0.0, -2.0])
    damping = ph.LinearDamping(0.1)
    assert field_operations(ph.Scene(inertia, up)) > free
    assert free + 3 <= field_operations(ph.Scene(inertia, torque=damping)) <= free + 9


def test_final_state_keeps_no_trajectory_buffer():
    scene, state = ph.Scene(ph.Inertia.from_moments([1.0, 2.0, 3.0])), states(N)
    ts = jnp.linspace(0.0, 100.0, 500)
    last, _ = program(scene, state, ts, ph.Record(final_only=True))
    every, _ = program(scene, state, ts, ph.Record())
    memory = [p.compiled.memory_analysis() for p in (last, every)]
    assert memory[0].output_size_in_bytes < 0.02 * memory[1].output_size_in_bytes
    assert memory[0].temp_size_in_bytes < 0.2 * memory[1].temp_size_in_bytes
