"""A small ensemble for the tests, also a script that is killed while it runs."""

import itertools
import os
import signal
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import polhode as ph
from polhode import ensemble as ens

TS = np.array([0.0, 1.0, 4.0])
CHUNK = 8192


def make(bodies=40_000, seed=7, rate=0.3, dtype=jnp.float64):
    """Axisymmetric bodies, which compile fast."""
    scene = ph.Scene(ph.Inertia.axisymmetric(dtype(1.0), dtype(1.5)))
    state = ph.State(jnp.array([1.0, 0, 0, 0], dtype), jnp.array([0.1, 1.0, 0.2], dtype))
    spreads = (ens.AnyAttitude(), ens.SpreadRates(ens.Deviate(jnp.full(3, rate, dtype))))
    return ens.Ensemble(scene, state, bodies, spreads, seed)


def main(path, kill_at, part="1/1"):
    """Run the case. With ``kill_at`` k above 0 the process is killed when the k-th file of a chunk
    is complete; below 0, just before, when only its temporary file exists.
    """
    jax.config.update("jax_enable_x64", True)
    count_files(int(kill_at))
    i, n = map(int, part.split("/"))
    ens.stream(make(), TS, path, chunk=CHUNK, part=(i, n) if n > 1 else None)


def count_files(kill_at):
    replace, count = Path.replace, itertools.count(1)

    def counted(self, target):
        k = next(count) if "c" in Path(target).parts else 0
        if k and k == -kill_at:
            os.kill(os.getpid(), signal.SIGKILL)
        replace(self, target)
        if k and k == kill_at:
            os.kill(os.getpid(), signal.SIGKILL)

    Path.replace = counted


if __name__ == "__main__":
    main(*sys.argv[1:])
