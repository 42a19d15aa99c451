"""Run by the tests with 8 host devices: prints what each comparison gave, as JSON."""

import json
import re
import sys

import jax

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 8)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

import numpy as np
import zarr
from ensemble_case import CHUNK, TS, make
from jax.sharding import Mesh, NamedSharding, PartitionSpec

import polhode as ph
from polhode import ensemble as ens
from polhode.ensemble import _sharded
from polhode.ensemble._program import Block

COLLECTIVES = r"all-gather|all-reduce|all-to-all|collective-permute|reduce-scatter"


def sharded():
    """Bodies placed by hand: results, sharding and exchanges of `simulate_sharded`."""
    place = NamedSharding(Mesh(np.array(jax.devices()), ("body",)), PartitionSpec("body"))
    scene, state = make(80_000).draw(np.arange(80_000))
    spread = jax.device_put(state, place)
    one, eight = ph.simulate(scene, state, TS), ens.simulate_sharded(scene, spread, TS)
    scene = jax.device_put(scene, place)
    inputs = _sharded.prepare(scene, spread, TS, None, None, None)
    text = _sharded.program.lower(*inputs).compile().compiled.as_text()
    return {
        "same": float(np.abs(np.asarray(one.wxyz) - np.asarray(eight.wxyz)).max()) < 1e-14,
        "kept": eight.wxyz.sharding.is_equivalent_to(place, 3),
        "each": eight.wxyz.addressable_shards[3].data.shape[0],
        "exchanges": re.findall(COLLECTIVES, text),
    }


def main(folder):
    found = {"devices": len(jax.devices())}
    ensemble = make(100_000)
    for count in (1, 8):
        path = f"{folder}/{count}.zarr"
        ens.stream(ensemble, TS, path, chunk=CHUNK * 8, devices=jax.devices()[:count])
    for name in ("wxyz", "omega_body", "status"):
        one, eight = (zarr.open_array(f"{folder}/{n}.zarr/{name}", mode="r")[:] for n in (1, 8))
        found[name] = bool(np.array_equal(one, eight))
    block = Block(ensemble, TS, None, None, True, (), jax.devices())
    inputs = block.inputs(0)
    compiled = block.program.lower(*inputs).compile()
    text = compiled.compiled.as_text()
    found["collectives"] = re.findall(COLLECTIVES, text)
    found["shards"] = len(block(0)["wxyz"].addressable_shards)
    found["rows"] = {s.data.shape[0] for s in block(0)["wxyz"].addressable_shards}.pop()
    found |= sharded()
    print(json.dumps(found))


if __name__ == "__main__":
    main(sys.argv[1])
