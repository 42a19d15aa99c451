"""A small ensemble for the tests, also run as a program that is killed while it works."""

import os
import signal
import sys

import jax
import jax.numpy as jnp
import numpy as np

import polhode as ph
from polhode import ensemble as ens
from polhode.ensemble import _fill

TS = np.array([0.0, 1.0, 4.0])
CHUNK = 8192


def make(bodies=40_000, seed=7, rate=0.3, dtype=jnp.float64):
    """Axisymmetric bodies: they compile fast."""
    scene = ph.Scene(ph.Inertia.axisymmetric(dtype(1.0), dtype(1.5)))
    state = ph.State(jnp.array([1.0, 0, 0, 0], dtype), jnp.array([0.1, 1.0, 0.2], dtype))
    spreads = (ens.AnyAttitude(), ens.SpreadRates(ens.Deviate(jnp.full(3, rate, dtype))))
    return ens.Ensemble(scene, state, bodies, spreads, seed)


def main(path, kill_after, begun=None):
    """Run the case; with JAX_COORDINATOR_ADDRESS set as one of several processes that meet there.
    The number of each chunk that is begun goes to the file ``begun``.
    """
    jax.config.update("jax_enable_x64", True)
    process, processes = ens.join() if "JAX_COORDINATOR_ADDRESS" in os.environ else (0, 1)

    def progress(report):
        if report.done - report.reused >= int(kill_after) > 0:
            os.kill(os.getpid(), signal.SIGKILL)

    if begun is not None:
        count_chunks(begun)
    ens.stream(
        make(), TS, path, chunk=CHUNK, progress=progress, process=process, processes=processes,
        warn=lambda words: print(words, flush=True),
    )  # fmt: skip


def count_chunks(path):
    """Have each chunk that is begun leave its number in a file, whatever comes after."""
    begin = _fill._chunk

    def noted(store, block, number, *rest):
        with open(path, "a") as file:
            file.write(f"{number}\n")
        begin(store, block, number, *rest)

    _fill._chunk = noted


if __name__ == "__main__":
    main(*sys.argv[1:])
