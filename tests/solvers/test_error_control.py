"""Errors stay within the requested tolerance: random bodies over six decades, default method.

The reference is an independent integrator in long double: ``make_error_control_truth.py``.
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


def given(kind, dtype, made=None):
    """Scene, state and times (N, 2) of one kind of field, all bodies in one batch."""
    made = {name: jnp.asarray(x, dtype) for name, x in (made or MADE[kind]).items()}
    if kind == "gravity":
        field = ph.UniformGravity(made["mass"], made["centre"], made["field"])
    else:
        field = ph.GravityGradient(made["mu"], made["field"])
    ts = jnp.stack([jnp.zeros_like(made["end"]), made["end"]], axis=-1)
    scene = ph.Scene(ph.Inertia.from_moments(made["moments"]), field)
    return scene, ph.State(made["wxyz"], made["omega"]), ts


def run(kind, dtype, rtol, made=None):
    record = ph.Record(final_only=True)
    return ph.simulate(*given(kind, dtype, made), rtol=rtol, record=record)


def rounded(kind, draw):
    """The numbers of the bodies in single precision, up to two units of rounding off at random."""
    rng, eps = np.random.default_rng(draw), np.finfo(np.float32).eps
    made = MADE[kind].items()
    return {n: np.float32(x * (1 + eps * rng.uniform(-2, 2, x.shape))) for n, x in made}


@cache
def exact(kind, draw):
    """Last attitudes of the rounded bodies: the result of float64 at 1e-12."""
    return np.asarray(run(kind, jnp.float64, 1e-12, rounded(kind, draw)).wxyz[:, -1])


def errors(found, wxyz):
    return np.asarray(rotation.angle_between(found.wxyz[:, -1].astype(float), jnp.asarray(wxyz)))


@pytest.mark.parametrize(
    "kind", [k if k == "gravity" else pytest.param(k, marks=pytest.mark.slow) for k in MADE]
)
def test_no_body_is_far_beyond_the_error_asked_for(kind):
    """And the steps are not much smaller than necessary."""
    assert len(MADE[kind]["end"]) >= COUNT
    for rtol in (1e-3, 1e-6, 1e-9, 1e-12):
        found = run(kind, jnp.float64, rtol)
        assert np.all(found.status == ph.Status.SUCCESSFUL)
        off = errors(found, MADE[kind]["wxyz_end"])
        assert np.max(off) < 10 * rtol, (rtol, np.argmax(off), np.max(off) / rtol)
        usual = np.median(off[MADE[kind]["angle"] > 10])  # several steps
        assert 0.01 * rtol < usual < 3 * rtol, (rtol, usual / rtol)


@pytest.mark.parametrize(
    "kind", [k if k == "gravity" else pytest.param(k, marks=pytest.mark.slow) for k in MADE]
)
def test_nor_in_single_precision(kind):
    """Up to rounding, against float64 with the same rounded numbers.

    A single draw of the last digits decides how rounding errors add up: the root mean square of
    eight draws counts.
    """
    for rtol in (1e-3, 1e-4, 1e-5):
        squares = []
        for draw in range(8):
            found = run(kind, jnp.float32, rtol, rounded(kind, draw))
            assert found.wxyz.dtype == jnp.float32
            assert np.all(found.status == ph.Status.SUCCESSFUL)
            squares.append(errors(found, exact(kind, draw)) ** 2)
        off = np.sqrt(np.mean(squares, axis=0))
        angle = MADE[kind]["angle"]
        lost = 6 * np.finfo(np.float32).eps * np.maximum(angle, 1)  # rounding errors accumulate
        assert np.all(off < 10 * (rtol + lost)), (rtol, np.max(off / (rtol + lost)))
        assert np.median(off) > 0.005 * rtol
        assert np.all(off[angle < 10] < 10 * rtol), (rtol, np.max(off[angle < 10] / rtol))
        assert np.sum(angle < 10) > 5


@pytest.mark.parametrize(("kind", "count"), [("top", 600), ("gradient", 3)])
@pytest.mark.slow  # faster: the last time, above
def test_saved_times_are_as_accurate_however_many_they_are(kind, count):
    """Bodies of a batch proceed to their next saved times independently, with an order of the steps
    that suits the distance between these.
    """
    rng = np.random.default_rng(count)
    moments = 10 ** rng.uniform(0, 1, (100, 1)) * rng.uniform(1, 1.9, (100, 3))
    if kind == "top":
        field = ph.UniformGravity(1.0, jnp.asarray(10 ** rng.uniform(-3, -0.7, (100, 3))))
    else:
        field = ph.GravityGradient(jnp.asarray(10 ** rng.uniform(-2, 0.5, 100)), [1.0, 0.0, 0.0])
    scene = ph.Scene(ph.Inertia.from_moments(jnp.asarray(moments)), field)
    state = ph.State(
        jnp.asarray(rng.normal(size=(100, 4))),
        jnp.asarray(10 ** rng.uniform(-2, 0.5, (100, 1)) * rng.normal(size=(100, 3))),
    )
    ts = jnp.linspace(0.0, 20.0, count)
    fine = ph.simulate(scene, state, ts, rtol=1e-12)
    for rtol in (1e-3, 1e-6, 1e-9):
        found = ph.simulate(scene, state, ts, rtol=rtol)
        assert np.all(found.status == ph.Status.SUCCESSFUL)
        off = np.max(np.asarray(rotation.angle_between(found.wxyz, fine.wxyz)), axis=1)
        assert np.max(off) < 10 * rtol, (rtol, np.max(off) / rtol)
        assert np.max(off) > 1e-3 * rtol or count == 600  # which has short steps


def test_few_steps_of_a_body_that_comes_to_rest_are_refused():
    """It rotates ever less in a step, whose error is finally that of rounding."""
    rng = np.random.default_rng(3)
    state = ph.State(rng.normal(size=(16, 4)), rng.normal(size=(16, 3)))
    torque = ph.FeedbackTorque(lambda t, wxyz, omega: -30 * omega)
    scene = ph.Scene(ph.Inertia.from_moments([1.0, 1.6, 2.1]), torque=torque)
    counts = ph.simulate(scene, state, [0.0, 5.0], rtol=1e-10).step_counts
    assert int(counts.refused.sum()) < 0.3 * int(counts.accepted.sum())


def test_a_wheel_keeps_the_tolerance_through_its_band_of_friction():
    """At every ``rtol``: without a third estimate, steps across the band have errors of 100
    ``rtol``.
    """
    friction = ph.CoulombFriction(0.0443, 0.00164)
    wheel = ph.Rotor([0.606, 0.751, 0.261], inertia=1060.0, speed=0.0152, coupling=friction)
    scene = ph.Scene(ph.Inertia.from_moments([6503.0, 15672.0, 11624.0]), rotors=wheel)
    start = ph.State([-0.65, -0.26, 0.69, 0.18], [-0.009, -0.11, -0.037])

    def last(rtol):
        return ph.simulate(scene, start, [0.0, 284.0], rtol=rtol).wxyz[-1]

    exact = last(1e-13)
    ratios = [
        2 * float(jnp.linalg.norm(last(rtol) - exact)) / rtol
        for rtol in np.geomspace(1e-5, 1e-9, 17)
    ]
    assert max(ratios) < 10, ratios
