"""Script for tests with 2 host devices: bodies that stop, sharded and on one device, as JSON."""

import json

import jax

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 2)

import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

import polhode as ph

SCENE = ph.Scene(ph.Inertia.spherical(2.0))
METHODS = {"stepped": ph.LiePoisson()}


def level(wxyz, omega_body, t):
    return ph.rotation.rotate(wxyz, jnp.array([1.0, 0.0, 0.0]))[2] - 0.4


def main():
    mesh = Mesh(np.array(jax.devices()), ("body",))
    place = NamedSharding(mesh, PartitionSpec("body"))
    rates = jnp.array([0.6, 1.3, 0.01, 1.7])
    omega = jnp.stack([0 * rates, rates, 0 * rates], axis=-1)
    found = {"devices": len(jax.devices())}
    for name, method in METHODS.items():

        def stop(omega, method=method):
            state = ph.State([1.0, 0.0, 0.0, 0.0], omega)
            return ph.simulate(SCENE, state, [0.0, 3.0, 10.0], method, until=ph.Event(level))

        one, two = stop(omega), stop(jax.device_put(omega, place))
        met = np.isfinite(one.event_time)
        away = [
            np.max(np.abs(np.asarray(a)[met] - np.asarray(b)[met]))
            for a, b in zip(
                (one.event_time, one.ts, one.wxyz, one.omega_body),
                (two.event_time, two.ts, two.wxyz, two.omega_body),
            )
        ]
        found[name] = {
            "away": float(max(away)),
            "same": bool(
                np.array_equal(met, np.isfinite(two.event_time))
                and np.array_equal(one.status, two.status)
            ),
            "met": met.tolist(),
            "kept": two.last.wxyz.sharding.is_equivalent_to(place, 2),
        }
    print(json.dumps(found))


if __name__ == "__main__":
    main()
