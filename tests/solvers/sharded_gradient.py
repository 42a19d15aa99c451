"""Script for tests with 2 host devices: gradients of a sharded batch and of one device, as JSON.

Arguments: the scenes.
"""

import json
import sys

import jax

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 2)

import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

import polhode as ph

INERTIA = ph.Inertia.axisymmetric(1.0, 1.5)
SCENES = {
    "free": lambda x: ph.Scene(INERTIA),
    "top": lambda x: ph.Scene(INERTIA, ph.UniformGravity(1.0, [0.1, 0.0, 0.5], [0, 0, -x])),
    "damped": lambda x: ph.Scene(INERTIA, None, ph.LinearDamping(x)),
}
METHODS = {
    "free": None,
    "top": ph.LiePoisson(ph.Extrapolation(8), chunk=1),
    "damped": ph.LiePoisson(ph.Extrapolation(8), chunk=1),
}


def main():
    mesh = Mesh(np.array(jax.devices()), ("body",))
    place = NamedSharding(mesh, PartitionSpec("body"))
    draws = np.random.default_rng(0).standard_normal((8, 7))
    wxyz = jnp.asarray(draws[:, :4] / np.linalg.norm(draws[:, :4], axis=1, keepdims=True))
    omega, found = jnp.asarray(draws[:, 4:]), {"devices": len(jax.devices())}
    for name in sys.argv[1:]:
        scene = SCENES[name]

        def loss(omega, strength, wxyz, scene=scene, method=METHODS[name]):
            record = ph.Record(final_only=True)
            state = ph.State(wxyz, omega)
            end = ph.simulate(scene(strength), state, [0.0, 2.0], method, rtol=1e-8, record=record)
            return jnp.sum(jnp.sin(end.omega_body)) + jnp.sum(end.wxyz**3)

        slope = jax.grad(loss, (0, 1))
        one = slope(omega, jnp.array(0.7), wxyz)
        two = slope(
            *(jax.device_put(x, place) if x.ndim else x for x in (omega, jnp.array(0.7))),
            jax.device_put(wxyz, place),
        )
        found[name] = {
            "away": [float(jnp.max(jnp.abs(a - np.asarray(b)))) for a, b in zip(one, two)],
            "size": [float(jnp.max(jnp.abs(a))) for a in one],
            "kept": two[0].sharding.is_equivalent_to(place, 2),
        }
    print(json.dumps(found))


if __name__ == "__main__":
    main()
