"""The closed-form free motion against 50-digit states and derivatives, in every regime."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

from polhode._closed_forms import free_motion
from polhode._closed_forms._free import evaluate, prepare

CASES = json.loads(Path(__file__).with_name("free_cases.json").read_text())
FAMILIES = sorted({case["family"] for case in CASES})
# Largest errors: attitude [rad], rates and derivatives relative to the largest of their block.
BOUNDS = {"float64": (5e-15, 5e-15, 1e-13), "float32": (2e-6, 2e-6, 3e-5)}


MOTION = jax.jit(free_motion)
BODIES = 50
"""Bodies of a batch, common to several tests, which therefore share programs."""


@jax.jit
def compensated_motion(moments, wxyz, omega, t):
    return free_motion(moments, wxyz, omega, t, compensated=True)


def _fits_single(case: dict) -> bool:
    numbers = np.array([*case["moments"], *case["omega"], *case["wxyz"], case["t"]])
    size = np.abs(numbers)
    if np.any((size > 0) & ((size < 1e-15) | (size > 1e15))):
        return False
    return bool(np.all(numbers.astype(np.float32) == numbers))


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(("float64", jax.jacfwd), id="float64"),
        # reverse mode: test_second_derivatives; for hundreds of bodies tests/stress; in single
        # precision in tests/systems
        pytest.param(("float32", jax.jacfwd), id="float32", marks=pytest.mark.slow),
    ],
)
def solved(request):
    """States and derivatives in one mode, of all cases that the dtype represents."""
    dtype, mode = request.param
    table = [c for c in CASES if dtype == "float64" or _fits_single(c)]

    def state(moments, products, omega, t, wxyz):
        rates, attitude = free_motion(moments, wxyz, omega, t, products)
        return jnp.stack([*attitude, *rates])

    def everything(*given):
        parts = (0, 1, 2, 3)
        jacobian = [x.reshape(7, -1) for x in mode(state, parts)(*given)]
        return state(*given), jnp.concatenate(jacobian, 1)

    def column(name):
        return jnp.asarray(np.array([c[name] for c in table]), dtype)

    products = jnp.zeros((len(table), 3), dtype)
    given = column("moments"), products, column("omega"), column("t"), column("wxyz")
    found = jax.jit(jax.vmap(everything))(*given)
    assert all(x.dtype == dtype for x in found)
    rows = zip(table, *(np.asarray(x, float) for x in found), strict=True)
    return BOUNDS[dtype], list(rows)


def _attitude_error(found, exact) -> float:
    sign = np.sign(np.dot(found, exact))
    return 2 * np.linalg.norm(sign * found - exact)


def _size(vector) -> float:
    largest = np.abs(vector).max()
    return largest * np.linalg.norm(vector / largest) if largest > 0 else 1.0


@pytest.mark.parametrize("family", FAMILIES)
def test_states(solved, family):
    (attitude, rate, _), rows = solved
    for case, value, *_ in rows:
        if case["family"] != family:
            continue
        exact = np.array(case["omega_t"])
        assert _attitude_error(value[:4], np.array(case["wxyz_t"])) < attitude, case["name"]
        assert abs(np.linalg.norm(value[:4]) - 1) < attitude, case["name"]
        assert _size((value[4:] - exact) / _size(exact)) * np.any(value[4:] != exact) < rate, case[
            "name"
        ]


@pytest.mark.parametrize("family", FAMILIES)
def test_derivatives(solved, family):
    (_, _, bound), rows = solved
    for case, value, jacobian in rows:
        if case["family"] != family:
            continue
        exact = np.array(case["jacobian"]).T
        sign = np.sign(np.dot(value[:4], case["wxyz_t"]))
        scaled = jacobian * np.array(case["unit"])
        for block, factor in ((slice(0, 4), sign), (slice(4, 7), 1)):
            largest = np.abs(exact[block]).max()
            off = np.abs(factor * scaled[block] - exact[block]).max()
            assert off <= bound * largest, (case["name"], block)


def test_initial_state_is_returned_at_time_zero():
    moments, wxyz = jnp.array([1.0, 2.0, 3.0]), jnp.array([0.5, -0.5, 0.5, 0.5])
    omega = jnp.array([0.3, -0.2, 0.9])
    rates, attitude = MOTION(moments, wxyz, omega, jnp.array(0.0))
    np.testing.assert_allclose(np.stack(rates), omega, rtol=3e-16)
    np.testing.assert_allclose(np.stack(attitude), wxyz, atol=3e-16)


def test_initial_attitude_carries_its_derivative():
    moments, omega, t = jnp.array([1.0, 2.0, 3.0]), jnp.array([0.3, -0.2, 0.9]), jnp.array(3.0)
    wxyz, change = jnp.array([0.6, -0.5, 0.7, 0.1]), np.array([0.3, 0.1, -0.2, 0.4])

    def attitude(q):
        return jnp.stack(free_motion(moments, q, omega, t, rates=False)[1])

    slope = jax.jit(lambda q, dq: jax.jvp(attitude, (q,), (dq,)))
    _, found = slope(wxyz, jnp.asarray(change))
    # The rotation from the start does not depend on the initial attitude: q(t) = q(0) p.
    turn = np.asarray(slope(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.asarray(change))[0])
    unit = np.asarray(wxyz) / np.linalg.norm(wxyz)
    moved = (change - unit * (unit @ change)) / np.linalg.norm(wxyz)
    a, b, c, d = turn
    right = np.array([[a, -b, -c, -d], [b, a, d, -c], [c, -d, a, b], [d, c, -b, a]])
    np.testing.assert_allclose(np.asarray(found), right @ moved, atol=1e-14)


def _random_bodies(seed: int, count: int) -> tuple:
    rng = np.random.default_rng(seed)
    moments = jnp.asarray(rng.uniform(0.5, 1.0, (count, 3)))
    return moments, *(jnp.asarray(rng.normal(size=(count, n))) for n in (4, 3))


@pytest.mark.slow  # faster: values, test_layouts
def test_many_times_agree_with_single_ones_in_value_and_gradient():
    moments, wxyz, omega = _random_bodies(5, 7)
    ts = jnp.linspace(-3.0, 8.0, 4)

    def together(moments):
        rates, attitude = free_motion(moments, wxyz, omega, ts[None, :])
        return jnp.stack([*rates, *attitude])

    def one_by_one(moments):
        motion = prepare(moments, wxyz, omega)
        columns = jax.lax.map(lambda t: evaluate(motion, t), ts)
        return jnp.moveaxis(jnp.stack([x for part in columns for x in part]), 1, -1)

    for fn in (together, one_by_one):
        assert jax.eval_shape(fn, moments).shape == (7, 7, 4)
    weights = jnp.asarray(np.random.default_rng(1).normal(size=(7, 7, 4)))
    found, exact = (
        jax.jit(jax.value_and_grad(lambda m, f=f: jnp.sum(f(m) * weights)))(moments)
        for f in (together, one_by_one)
    )
    for x, y in zip(found, exact, strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-12, atol=1e-12)


def test_long_batches_are_cut_without_a_trace():
    moments, wxyz, omega = _random_bodies(6, 16411)  # prime: the last chunk is padded
    t = jnp.linspace(-5.0, 5.0, 16411)
    found = MOTION(moments, wxyz, omega, t)
    whole = jax.jit(lambda *a: evaluate(prepare(*a), t))(moments, wxyz, omega)
    for part, other in zip(found, whole, strict=True):
        for x, y in zip(part, other, strict=True):
            np.testing.assert_allclose(x, y, atol=1e-14)


def test_a_sphere_has_no_axis_that_the_momentum_may_not_be_across():
    """Any direction of the rates, along and across every axis, is a permanent rotation."""
    rates = np.array(np.meshgrid(*[(-1.0, 0.0, 0.5)] * 3)).reshape(3, -1).T
    rates = np.resize(rates, (BODIES, 3))
    for dtype in (np.float64, np.float32):
        omega, t = jnp.asarray(rates, dtype), jnp.full(BODIES, 1.5, dtype)
        moments, wxyz = (
            jnp.full(omega.shape, 2, dtype),
            jnp.tile(jnp.eye(4, dtype=dtype)[0], (BODIES, 1)),
        )
        found, turned = MOTION(moments, wxyz, omega, t)
        np.testing.assert_array_equal(np.stack(found, -1), omega)
        size = np.linalg.norm(rates, axis=-1, keepdims=True)
        axis = rates / np.where(size > 0, size, 1)
        exact = np.concatenate([np.cos(0.75 * size), axis * np.sin(0.75 * size)], -1)
        turned = np.stack(turned, -1)
        turned = turned * np.sign(np.sum(turned * exact, -1, keepdims=True))
        np.testing.assert_allclose(turned, exact, atol=2 * np.finfo(dtype).eps)


@pytest.mark.parametrize(
    ("x64", "over_bodies"),
    [
        pytest.param(True, False, id="x64-batch"),
        pytest.param(True, True, id="x64-vmap", marks=pytest.mark.slow),
        pytest.param(False, False, id="default-batch", marks=pytest.mark.slow),
        pytest.param(False, True, id="default-vmap"),
    ],
)
def test_single_precision_keeps_its_digits_over_long_times(x64, over_bodies):
    """Against double precision after 1e4 rad, with and without x64: in the latter, JAX's
    transformations drop double precision.
    """
    rng = np.random.default_rng(7)
    moments, omega, wxyz = (rng.normal(size=(BODIES, n)).astype(np.float32) for n in (3, 3, 4))
    moments = 1 + np.abs(moments)
    t = (1e4 / np.linalg.norm(omega, axis=1)).astype(np.float32)
    given = moments, wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True), omega, t
    exact = compensated_motion(*(jnp.asarray(x, jnp.float64) for x in given))
    with jax.enable_x64(x64):
        given = [jnp.asarray(x, jnp.float32) for x in given]
        found = (jax.jit(jax.vmap(compensated_motion)) if over_bodies else compensated_motion)(
            *given
        )
    (rates, attitude), (exact_rates, exact_attitude) = (
        (np.stack(x, -1) for x in pair) for pair in (found, exact)
    )
    assert rates.dtype == attitude.dtype == np.float32
    sign = np.sign(np.sum(attitude * exact_attitude, -1, keepdims=True))
    np.testing.assert_allclose(attitude * sign, exact_attitude, atol=5e-7)
    np.testing.assert_allclose(rates, exact_rates, atol=2e-6)


def test_compensated_phases_next_to_the_separatrix():
    """After 1e5 periods of the rates, whose length is computed with 50 digits."""
    moments, omega = (1.0, 2.0, 3.0), (1.1, 0.7, 1.1 / 3**0.5 * (1 + 1e-12))
    with mp.workdps(50):
        (a, b, c), (u, v, w) = ([mp.mpf(x) for x in triple] for triple in (moments, omega))
        outer = (c - b) * (b * v * v * (b - a) + c * w * w * (c - a))
        inner = (b - a) * (a * u * u * (c - a) + b * v * v * (c - b))
        period = 4 * mp.ellipk(inner / outer) / mp.sqrt(outer / a / b / c)
        elapsed = float(100_000 * period)
        times = jnp.array([elapsed, float(elapsed - 100_000 * period)])
    wxyz = jnp.array([1.0, 0, 0, 0])
    rates = free_motion(jnp.array(moments), wxyz, jnp.array(omega), times, compensated=True)[0]
    late, early = np.stack(rates, axis=-1)
    np.testing.assert_allclose(late, early, rtol=0, atol=1e-11)


def test_conserved_over_long_times():
    rng = np.random.default_rng(6)
    moments = jnp.asarray(rng.uniform(0.5, 1.0, (BODIES, 3)))
    wxyz, omega = (jnp.asarray(rng.normal(size=(BODIES, n))) for n in (4, 3))
    rates, attitude = MOTION(moments, wxyz, omega, jnp.full(BODIES, 1e7))
    now, before = np.stack(rates, -1) * moments, np.asarray(omega * moments)
    np.testing.assert_allclose((now**2).sum(-1), (before**2).sum(-1), rtol=1e-14)
    energy = (now**2 / moments).sum(-1)
    np.testing.assert_allclose(energy, (before**2 / moments).sum(-1), rtol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(np.stack(attitude, -1), axis=-1), 1, rtol=1e-15)


def test_wrong_use_is_explained():
    motion = prepare(jnp.ones((2, 3)), None, jnp.ones((2, 3)))
    with pytest.raises(ValueError, match="prepared without wxyz"):
        evaluate(motion, jnp.zeros(2))
    with pytest.raises(ValueError, match="one more"):
        evaluate(motion, jnp.zeros((2, 3, 4)), attitude=False)


def _published(shared):
    table = json.loads((shared / "data" / "published_cases.json").read_text())
    return {case["id"]: case for case in table["cases"]}


def test_published_states(shared):
    cases = _published(shared)

    def run(case, t):
        moments = np.array(case["inertia"], float)
        if "omega0_body" in case:
            omega = np.array(case["omega0_body"], float)
        else:
            omega = np.array(case["momentum0_body"], float) / moments
        given = (moments, np.array(case["q0"], float), omega, np.array(t, float))
        rates, attitude = MOTION(*map(jnp.asarray, given))
        return np.stack(rates), np.stack(attitude), moments

    def check(found, omega, wxyz, tolerance=2e-15):
        rates, attitude, _ = found
        np.testing.assert_allclose(rates, omega, atol=tolerance * np.linalg.norm(omega))
        unit = np.array(wxyz) / np.linalg.norm(wxyz)
        assert _attitude_error(attitude, unit) < 2 * tolerance

    dzhanibekov = cases["principia_dzhanibekov"]
    for t, key in ((5, "state_t5"), (100, "state_t100")):
        exact = dzhanibekov["expected"][key]
        check(run(dzhanibekov, t), exact["omega"], exact["q"], 4e-14)
    cylinder = cases["drake_free_body_cylinder"]
    for key in ("t1", "t2"):
        exact = cylinder["expected"][key]
        check(run(cylinder, exact["t"]), exact["omega"], exact["q"], 2e-14)
    top = cases["jsbsim_vanzon_schofield_top"]
    check(run(top, top["t"]), top["expected"]["omega"], top["expected"]["q"], 5e-14)
    problem = cases["hipparchus_problem8"]["expected"]
    found = run(cases["hipparchus_problem8"], 20.0)
    check(found, problem["omega"], problem["q_if_q0_is_body_to_space"], 5e-14)
    for name in ("hairer_vilmart_asymmetric", "gni_example_5_4_free"):
        case = cases[name]
        rates, attitude, moments = run(case, case["t"])
        exact = np.array(case["expected"]["momentum_body"]) / moments
        check((rates, attitude, moments), exact, case["expected"]["q"], 2e-14)
    sphere = dict(cases["principia_sphere"], q0=[1, 0, 0, 0])
    np.testing.assert_allclose(run(sphere, 10)[0], sphere["expected"]["omega_body"], rtol=1e-15)


def test_principal_spins_keep_their_rates_to_the_bit():
    for axis, (size, angle) in enumerate(((5.0, 25.0), (6.0, 20.0), (7.0, 14.0))):
        moments = np.array([2.0, 3.0, 5.0])
        omega = np.zeros(3)
        omega[axis] = size / moments[axis]
        given = moments, np.array([1.0, 0, 0, 0]), omega, np.array(10.0)
        rates, attitude = MOTION(*map(jnp.asarray, given))
        exact = np.zeros(4)
        exact[0], exact[1 + axis] = np.cos(angle / 2), np.sin(angle / 2)
        np.testing.assert_allclose(np.stack(rates), omega, rtol=2.3e-16)
        assert _attitude_error(np.stack(attitude), exact) < 17 * 2.0**-52 * angle
