"""Ensembles into a store: speed beside pure computing and raw writing, memory, and kills.

    python -m benchmarks.scale [--bodies 1000000] [--times 100] [--folder DIR]
    python -m benchmarks.scale --kills 20

The first prints one JSON line; both need free disk of twice the store. Kills are at random moments
of a run in its own process; every resumed store is compared with an undisturbed one, bit by bit.
"""

import argparse
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import polhode as ph
from polhode import ensemble as ens
from polhode.ensemble._program import Block

ARRAYS = ("wxyz", "omega_body", "status")


def make(bodies: int) -> ens.Ensemble:
    """Free triaxial bodies of any attitude."""
    scene = ph.Scene(ph.Inertia.from_moments([1.0, 2.0, 2.5]))
    state = ph.State([1.0, 0.0, 0.0, 0.0], [0.1, 1.0, 0.2])
    spreads = (ens.AnyAttitude(), ens.SpreadRates(ens.Deviate(jnp.full(3, 0.1))))
    return ens.Ensemble(scene, state, bodies, spreads, 1)


def measure(bodies: int, times: int, folder: Path) -> dict:
    ensemble, ts = make(bodies), np.linspace(0.0, 100.0, times)
    began = time.perf_counter()
    block = Block(ensemble, ts, None, None, True, (), jax.devices()[:1])
    found = jax.block_until_ready(block(0))
    compiling = time.perf_counter() - began
    starts = range(0, bodies, block.size)
    began = time.perf_counter()
    for first in starts:
        jax.block_until_ready(block(first))
    computing = time.perf_counter() - began
    whole = [np.asarray(found[name]) for name in ARRAYS]
    began = time.perf_counter()
    for k in range(len(starts)):
        with open(folder / f"raw{k}", "wb") as file:
            for part in whole:
                file.write(part.data)
            file.flush()
            os.fsync(file.fileno())
    writing = time.perf_counter() - began
    for k in range(len(starts)):
        (folder / f"raw{k}").unlink()
    began = time.perf_counter()
    ens.stream(ensemble, ts, folder / "run.zarr")
    whole_run = time.perf_counter() - began
    slower = max(computing, writing)
    return {
        "bodies": bodies,
        "times": times,
        "compile_s": compiling,
        "compute_s": computing,
        "raw_write_s": writing,
        "store_s": whole_run,
        "efficiency_with_compiling": slower / whole_run,
        "efficiency": slower / (whole_run - compiling),
        "peak_memory_MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3,
    }


def _child(path: Path) -> subprocess.Popen:
    return subprocess.Popen([sys.executable, "-m", "benchmarks.scale", "--child", str(path)])


def kills(count: int, folder: Path) -> dict:
    """Kill and restart one run after another; how many of the stores came out equal."""
    import zarr

    began = time.perf_counter()
    assert _child(folder / "whole.zarr").wait() == 0
    usual = time.perf_counter() - began
    done = equal = 0
    while done < count:
        path = folder / f"killed{done}.zarr"
        for _ in range(4):
            child = _child(path)
            try:
                child.wait(random.uniform(0.2, 0.8) * usual)
                break
            except subprocess.TimeoutExpired:
                child.send_signal(signal.SIGKILL)
                child.wait()
                done += 1
        assert _child(path).wait() == 0
        equal_now = all(
            np.array_equal(
                zarr.open_array(folder / "whole.zarr" / name, mode="r")[:],
                zarr.open_array(path / name, mode="r")[:],
            )
            for name in ARRAYS
        )
        equal += equal_now
        print(f"{done} kills, equal: {equal_now}", flush=True)
        assert equal_now
        shutil.rmtree(path)
    return {"kills": done, "stores_equal": equal}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--bodies", type=int, default=1_000_000)
    parser.add_argument("--times", type=int, default=100)
    parser.add_argument("--kills", type=int)
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if options.child:
        ens.stream(make(300_000), np.linspace(0.0, 10.0, 10), options.child, chunk=16384)
        return
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        if options.kills:
            print(json.dumps(kills(options.kills, Path(folder))))
        else:
            print(json.dumps(measure(options.bodies, options.times, Path(folder))))


if __name__ == "__main__":
    main()
