"""Memory of programs that save a function of the motion in place of the states."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph

UNIT = jnp.array([1.0, 0.0, 0.0, 0.0])
PUSH = ph.BodyTorque([0.0, 0.0, 0.4])


@pytest.mark.parametrize("torque", [None, pytest.param(PUSH, marks=pytest.mark.slow)])
def test_memory_of_a_program_holds_the_states_of_a_chunk_only(torque):
    scene = ph.Scene(ph.Inertia.from_moments([1.0, 1.5, 2.0]), torque=torque)
    bodies, times = 2_000, 1_000

    def bytes_of(record):
        def values(omega):
            traj = ph.simulate(
                scene, ph.State(UNIT, omega), np.linspace(0, 9, times), record=record
            )
            return traj._saved if record.save else (traj.wxyz, traj.omega_body)

        shape = jax.ShapeDtypeStruct((bodies, 3), jnp.float64)
        memory = jax.jit(values).lower(shape).compile().memory_analysis()
        return memory.temp_size_in_bytes + memory.output_size_in_bytes

    states = bodies * times * 7 * 8
    saved = bytes_of(ph.Record(save=lambda x: x.omega_body[:, 0]))
    assert saved < states / 2 < bytes_of(ph.Record())
