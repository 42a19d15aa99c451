"""Script for tests with 8 host devices: prints the results of several comparisons as JSON."""

import json
import re
import sys

import equinox as eqx
import jax

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 8)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

import numpy as np
import zarr
from ensemble_case import CHUNK, TS, make
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

import polhode as ph
from polhode import _simulate, ensemble as ens
from polhode.ensemble._stream import Block, program

COLLECTIVES = r"all-gather|all-reduce|all-to-all|collective-permute|reduce-scatter"


def exchanges(compiled):
    return re.findall(COLLECTIVES, compiled.compiled.as_text())


def compare(scene, state, spread, place, method=None):
    """Result of `simulate` for a manually sharded batch, compared with the batch on one device."""
    calls = []
    run = _simulate.run
    _simulate.run = lambda *given: calls.append(given) or run(*given)
    one = ph.simulate(scene, state, TS, method)
    eight = ph.simulate(scene, spread, TS, method)
    _simulate.run = run
    return {
        "away": float(np.abs(np.asarray(one.wxyz) - np.asarray(eight.wxyz)).max()),
        "kept": eight.wxyz.sharding.is_equivalent_to(place, eight.wxyz.ndim),
        "energy": eight.energy.sharding.is_equivalent_to(place, eight.wxyz.ndim - 1),
        "each": eight.omega_body.addressable_shards[3].data.shape,
        "exchanges": exchanges(eqx.filter_jit(run.__wrapped__).lower(*calls[-1]).compile()),
    }


def sharded():
    mesh = Mesh(np.array(jax.devices()).reshape(4, 2), ("a", "b"))
    place = NamedSharding(mesh, PartitionSpec(("a", "b")))
    scene, state = make(80_000).draw(np.arange(80_000))
    found = {"closed": compare(scene, state, jax.device_put(state, place), place)}
    # two batch axes, and a torque of its own for each row; the moments are shared
    place = NamedSharding(mesh, PartitionSpec("a", "b"))
    rows = jax.tree.map(lambda x: x[:48].reshape(8, 6, -1), state)
    torque = ph.BodyTorque(np.linspace(0, 0.1, 24).reshape(8, 1, 3))
    scene = ph.Scene(ph.Inertia.from_moments([1.0, 1.5, 2.0]), torque=torque)
    placed = ph.State(jax.device_put(rows.wxyz, place), rows.omega_body)
    found["stepped"] = compare(scene, rows, placed, place, ph.LiePoisson(chunk=1))
    other = NamedSharding(mesh, PartitionSpec("b", None))
    mixed = ph.State(placed.wxyz, jax.device_put(rows.omega_body, other))
    try:
        ph.simulate(scene, mixed, TS)
    except ValueError as error:
        found["mixed"] = str(error)
    explicit = jax.make_mesh((8,), ("body",), axis_types=(AxisType.Explicit,))
    place = NamedSharding(explicit, PartitionSpec("body"))
    _, state = make(80_000).draw(np.arange(80_000))
    found["explicit"] = compare(
        ph.Scene(ph.Inertia.axisymmetric(1.0, 1.5)), state, jax.device_put(state, place), place
    )
    return found


def main(folder):
    found = {"devices": len(jax.devices())}
    ensemble = make(100_000)
    for count in (1, 2, 4, 8):
        path = f"{folder}/{count}.zarr"
        ens.stream(ensemble, TS, path, chunk=CHUNK * 8, devices=jax.devices()[:count])
    for name in ("wxyz", "omega_body", "status"):
        one, *more = (
            zarr.open_array(f"{folder}/{n}.zarr/{name}", mode="r")[:] for n in (1, 2, 4, 8)
        )
        found[name] = [bool(np.array_equal(one, other)) for other in more]
    block = Block(ensemble, TS, None, None, True, (), jax.devices())
    found["collectives"] = exchanges(program.lower(*block.inputs(0)).compile())
    found["used"] = len({block(k * CHUNK)["wxyz"].device for k in range(8)})
    found["layouts"] = [
        dict(zarr.open_group(f"{folder}/{n}.zarr").attrs)["devices"] for n in (1, 8)
    ]
    found |= sharded()
    print(json.dumps(found))


if __name__ == "__main__":
    main(sys.argv[1])
