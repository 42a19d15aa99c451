"""Identity of two runs: it depends on structure, static fields and numbers, not on addresses."""

import os
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode import ensemble as ens
from polhode.ensemble._store import digest, has_user_code


def things():
    """Objects that must all have different identities."""
    normal = ens.SpreadRates(ens.Deviate(jnp.ones(3)))
    return {
        "normal": normal,
        "uniform": ens.SpreadRates(ens.Deviate(jnp.ones(3), uniform=True)),
        "attitude": ens.SpreadAttitude(ens.Deviate(jnp.ones(3))),
        "other numbers": ens.SpreadAttitude(ens.Deviate(2 * jnp.ones(3))),
        "float32": ens.SpreadRates(ens.Deviate(jnp.ones(3, jnp.float32))),
        "two": (normal, normal),
        "axisymmetric": ph.Inertia.axisymmetric(1.0, 1.5),
        "the same moments": ph.Inertia.from_moments([1.0, 1.0, 1.5]),
        "chunk": ph.LiePoisson(chunk=7),
        "chunk of another size": ph.LiePoisson(chunk=8),
        "rows": {"wxyz": np.ones((3, 4))},
        "other rows": {"wxyz": np.ones((4, 3))},
        "statistic": ens.Statistic("tilt", jnp.sin, low=0.0, high=1.0),
        "other range": ens.Statistic("tilt", jnp.sin, low=0.0, high=2.0),
    }


def test_everything_counts():
    digests = {name: digest(thing) for name, thing in things().items()}
    assert len(set(digests.values())) == len(digests)
    assert digests == {name: digest(thing) for name, thing in things().items()}


def test_another_process_computes_the_same():
    code = (
        "import jax; jax.config.update('jax_enable_x64', True);"
        "import test_ensemble_identity as t; from polhode.ensemble._store import digest;"
        "print(digest(t.things()))"
    )
    path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    environment = os.environ | {"PYTHONPATH": path, "PYTHONHASHSEED": "1"}
    other = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    ).stdout
    assert other.strip() == digest(things())


def test_rows_of_arrays_are_read_in_parts(monkeypatch):
    from polhode.ensemble import _store

    rows = np.arange(3000.0).reshape(1000, 3)
    before = digest(rows)
    monkeypatch.setattr(_store, "_DIGEST_BYTES", 1000)
    assert digest(rows) == before
    rows[999, 2] += 1
    assert digest(rows) != before


class Mine(ens.SpreadRates):
    """A user-defined spread."""


def function(key, scene, state):
    return scene, state


@pytest.mark.parametrize("spread", [function, lambda *x: x, Mine(ens.Deviate(jnp.ones(3)))])
def test_code_of_the_user_is_noticed(spread):
    scene = ph.Scene(
        ph.Inertia.from_moments([1.0, 1.5, 2.0]),
        torque=ph.BodyTorque([0.0, 0.1, 0.0]) + ph.LinearDamping([0.1, 0.1, 0.1]),
        potential=ph.UniformGravity(1.0, [0.0, 0.0, 0.1]),
    )
    state = ph.State([1.0, 0, 0, 0], [0.0, 0.0, 0.0])
    plain = ens.Ensemble(scene, state, 3, (ens.AnyAttitude(),))
    assert not has_user_code((plain, ph.LiePoisson()))
    assert has_user_code(ens.Ensemble(scene, state, 3, (ens.AnyAttitude(), spread)))
    torque = ph.Scene(scene.inertia, torque=ph.BodyTorque(lambda t: jnp.sin(t) * jnp.ones(3)))
    assert has_user_code(ens.Ensemble(torque, state, 3))
