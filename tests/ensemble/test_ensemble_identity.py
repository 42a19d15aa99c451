"""What makes two runs the same: numbers, static fields and functions count, addresses do not."""

import functools
import os
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import polhode as ph
from polhode import ensemble as ens
from polhode.ensemble._identity import digest

SCALE = 2.0


def spread(key, scene, state):
    return scene, ph.State(state.wxyz, SCALE * state.omega_body)


def other(key, scene, state):
    return scene, ph.State(state.wxyz, 3.0 * state.omega_body)


def shifted(by):
    return lambda key, scene, state: (scene, ph.State(state.wxyz, state.omega_body + by))


def things():
    """Things that must all differ."""
    normal = ens.SpreadRates(ens.Deviate(jnp.ones(3)))
    return {
        "normal": normal,
        "uniform": ens.SpreadRates(ens.Deviate(jnp.ones(3), uniform=True)),
        "attitude": ens.SpreadAttitude(ens.Deviate(jnp.ones(3))),
        "float32": ens.SpreadRates(ens.Deviate(jnp.ones(3, jnp.float32))),
        "two": (normal, normal),
        "function": spread,
        "other": other,
        "closure": shifted(1.0),
        "closure of another number": shifted(2.0),
        "closure of an array": shifted(jnp.ones(3)),
        "partial": functools.partial(shifted, 1.0),
        "lambda": lambda t: jnp.sin(t) * jnp.ones(3),
        "lambda of another sign": lambda t: -jnp.sin(t) * jnp.ones(3),
        "axisymmetric": ph.Inertia.axisymmetric(1.0, 1.5),
        "the same moments": ph.Inertia.from_moments([1.0, 1.0, 1.5]),
        "chunk": ph.LiePoisson(chunk=7),
        "chunk of another size": ph.LiePoisson(chunk=8),
        "rows": {"wxyz": np.ones((3, 4))},
        "other rows": {"wxyz": np.ones((4, 3))},
        "words": {"in", "a", "set"},
    }


def test_everything_counts(monkeypatch):
    found = {name: digest(thing) for name, thing in things().items()}
    assert len(set(found.values())) == len(found)
    assert found == {name: digest(thing) for name, thing in things().items()}
    before = digest(spread)
    monkeypatch.setitem(globals(), "SCALE", 2.5)
    assert digest(spread) != before


def test_another_process_finds_the_same():
    code = (
        "import jax; jax.config.update('jax_enable_x64', True);"
        "import test_ensemble_identity as t; from polhode.ensemble._identity import digest;"
        "print(digest(t.things()))"
    )
    here = Path(__file__).parent
    path = os.pathsep.join([str(here), *sys.path])
    found = [
        subprocess.run(
            [sys.executable, "-c", code], env=os.environ | {"PYTHONPATH": path,
            "PYTHONHASHSEED": seed}, capture_output=True, text=True, check=True,
        ).stdout
        for seed in ("1", "2")
    ]  # fmt: skip
    assert found[0] == found[1]


def test_rows_of_arrays_are_read_bit_by_bit(monkeypatch):
    from polhode.ensemble import _identity

    rows = np.arange(3000.0).reshape(1000, 3)
    before = digest(rows)
    monkeypatch.setattr(_identity, "_BYTES", 1000)
    assert digest(rows) == before
    rows[999, 2] += 1
    assert digest(rows) != before
