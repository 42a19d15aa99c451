"""The error asked for is the error reached: random bodies over six decades, the planner's method.

Truth by an integrator of its own in long double, see ``make_error_control_truth.py``.
"""

import json
from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest
from solvers.make_error_control_truth import COUNT, FILE

import polhode as ph
from polhode import rotation

MADE = {
    kind: {name: np.array(x) for name, x in made.items()}
    for kind, made in json.loads(FILE.read_text(encoding="utf-8")).items()
}


def given(kind, dtype):
    """Scene, state and times (N, 2) of one kind of field, all bodies in one batch."""
    made = {name: jnp.asarray(x, dtype) for name, x in MADE[kind].items()}
    if kind == "gravity":
        field = ph.UniformGravity(made["mass"], made["centre"], made["field"])
    else:
        field = ph.GravityGradient(made["mu"], made["field"])
    ts = jnp.stack([jnp.zeros_like(made["end"]), made["end"]], axis=-1)
    scene = ph.Scene(ph.Inertia.from_moments(made["moments"]), field)
    return scene, ph.State(made["wxyz"], made["omega"]), ts


def run(kind, dtype, rtol, method=None):
    record = ph.Record(final_only=True)
    return ph.simulate(*given(kind, dtype), method, rtol=rtol, record=record)


@cache
def exact(kind, rounded):
    """Last attitudes: the truth, or what float64 at 1e-12 makes of the rounded input."""
    if not rounded:
        return MADE[kind]["wxyz_end"]
    made = {name: jnp.asarray(x, jnp.float32) for name, x in MADE[kind].items()}
    kept, MADE[kind] = MADE[kind], {name: np.asarray(x, float) for name, x in made.items()}
    try:
        return np.asarray(run(kind, jnp.float64, 1e-12).wxyz[:, -1])
    finally:
        MADE[kind] = kept


def errors(found, wxyz):
    return np.asarray(rotation.angle_between(found.wxyz[:, -1].astype(float), jnp.asarray(wxyz)))


@pytest.mark.parametrize("kind", MADE)
def test_no_body_is_far_beyond_the_error_asked_for(kind):
    """Nor is the work of steps much finer than asked for done."""
    assert len(MADE[kind]["end"]) >= COUNT
    for rtol in (1e-3, 1e-6, 1e-9, 1e-12):
        found = run(kind, jnp.float64, rtol)
        assert np.all(found.status == ph.Status.SUCCESSFUL)
        off = errors(found, exact(kind, False))
        assert np.max(off) < 10 * rtol, (rtol, np.argmax(off), np.max(off) / rtol)
        assert 0.005 * rtol < np.median(off) < 3 * rtol, (rtol, np.median(off) / rtol)


@pytest.mark.parametrize("kind", MADE)
def test_nor_in_single_precision(kind):
    """Up to what rounding takes, beside float64 on the same rounded numbers."""
    for rtol in (1e-3, 1e-4, 1e-5):
        found = run(kind, jnp.float32, rtol)
        assert found.wxyz.dtype == jnp.float32
        assert np.all(found.status == ph.Status.SUCCESSFUL)
        off = errors(found, exact(kind, True))
        angle = MADE[kind]["angle"]
        lost = 6 * np.finfo(np.float32).eps * np.maximum(angle, 1)  # rounding turns a body on
        assert np.all(off < 10 * (rtol + lost)), (rtol, np.max(off / (rtol + lost)))
        assert np.median(off) > 0.005 * rtol
        assert np.all(off[angle < 10] < 10 * rtol), (rtol, np.max(off[angle < 10] / rtol))
        assert np.sum(angle < 10) > 5
