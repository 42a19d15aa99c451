"""Gradients of a mean cost with respect to all weights of a network controller, and to a few gains.

    python -m benchmarks.controllers [--quick] [--many] [--lines FILE] [--output FILE]

A network with layers of 7, 32, 32 and 3 units (1,411 parameters, relu or tanh) maps the attitude
and rates of a body to a torque of at most 2 along each axis, for 5 s. The mean cost of the last
states of all bodies is differentiated in reverse mode: by an ordinary call of polhode, and by
diffrax as a user would write it (``jax.vmap``, ``PIDController``, ``RecursiveCheckpointAdjoint``).
Errors are norms relative to that of the gradient. The reference is polhode at a tolerance of 1e-11,
which is compared with central differences of SciPy's DOP853 along two directions. Times are
processor times of one core: the minimum of several runs, or the only run of a program that takes
longer than 4 s. ``--many`` adds 4,096 bodies. ``--lines``: a file to which each result is appended
when it is computed; results that the file already contains are not computed again.
"""

import argparse
import functools
import json
import time
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks import _report

if __name__ == "__main__":
    _report.one_thread()

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

import polhode as ph

MOMENTS = (1.0, 1.5, 2.0)
HORIZON = 5.0
TORQUE = 2.0
BODIES = (4, 32, 256)
TOLERANCES = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10)
SINGLE = (1e-3, 1e-4, 1e-5, 2e-6)
REFERENCE = 1e-11
LEVELS = (1e-2, 1e-3, 1e-4, 1e-6)
BUDGET = 4.0
"""Seconds of processor time after which a program is not run again."""


class Network(eqx.Module):
    """A network from attitude and rates to a bounded torque."""

    layers: eqx.nn.MLP

    def __init__(self, activation: str, hidden: int = 32, dtype: Any = np.float64):
        function = {"relu": jax.nn.relu, "tanh": jnp.tanh}[activation]
        layers = eqx.nn.MLP(7, 3, hidden, 2, function, key=jax.random.key(2), dtype=jnp.float64)
        # the same weights, rounded: another dtype would draw different random numbers
        self.layers = jax.tree.map(
            lambda x: x.astype(dtype) if eqx.is_inexact_array(x) else x, layers
        )

    def __call__(self, t, wxyz, omega):
        return TORQUE * jnp.tanh(self.layers(jnp.concatenate([wxyz, omega])))


class Linear(eqx.Module):
    """A linear controller with gains (3, 7), whose torque is limited according to ``limit``."""

    gains: jax.Array
    limit: Callable = eqx.field(static=True)

    def __call__(self, t, wxyz, omega):
        return self.limit(self.gains @ jnp.concatenate([wxyz, omega]))


def states(bodies: int, dtype: Any = np.float64) -> ph.State:
    """The first ``bodies`` of a fixed sequence of random attitudes and rates."""
    numbers = np.random.default_rng(0).normal(size=(max(bodies, 4096), 7))[:bodies]
    wxyz = numbers[:, :4] / np.linalg.norm(numbers[:, :4], axis=1, keepdims=True)
    return ph.State(jnp.asarray(wxyz, dtype), jnp.asarray(0.5 * numbers[:, 4:], dtype))


def cost(wxyz, omega):
    """Squared sine of half the angle of attitudes (..., 4), plus a tenth of the squared rates
    (..., 3).
    """
    return 1 - wxyz[..., 0] ** 2 + 0.1 * (omega**2).sum(axis=-1)


def polhode_loss(state: ph.State, rtol: float) -> Callable:
    """Mean cost of a controller, simulated by ``ph.simulate``."""
    dtype = state.wxyz.dtype
    inertia, ts = ph.Inertia.from_moments(jnp.asarray(MOMENTS, dtype)), jnp.array([0.0, HORIZON])

    def loss(controller):
        scene = ph.Scene(inertia, torque=ph.FeedbackTorque(controller))
        end = ph.simulate(scene, state, ts.astype(dtype), rtol=rtol).last
        return jnp.mean(cost(end.wxyz, end.omega_body))

    return loss


def diffrax_loss(state: ph.State, solver: Any) -> Callable:
    """Mean cost of a controller, simulated by diffrax at a tolerance."""
    import diffrax

    dtype = state.wxyz.dtype
    moments, end = jnp.asarray(MOMENTS, dtype), jnp.asarray(HORIZON, dtype)

    def field(t, y, controller):
        q, w = y[:4], y[4:]
        turn = jnp.concatenate([-(q[1:] @ w)[None], q[0] * w + jnp.cross(q[1:], w)]) / 2
        torque = controller(t, q / jnp.linalg.norm(q), w)
        return jnp.concatenate([turn, (torque - jnp.cross(w, moments * w)) / moments])

    def loss(controller, tolerance):
        def one(y):
            y = diffrax.diffeqsolve(
                diffrax.ODETerm(field),
                solver,
                0 * end,
                end,
                end / 100,
                y,
                controller,
                max_steps=4096,
                stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
                adjoint=diffrax.RecursiveCheckpointAdjoint(),
            ).ys[-1]
            return cost(y[:4] / jnp.linalg.norm(y[:4]), y[4:])

        return jnp.mean(jax.vmap(one)(jnp.concatenate([state.wxyz, state.omega_body], axis=1)))

    return loss


class Program:
    """A compiled gradient, the processor time of its compilation [s], and its memory [MB]."""

    def __init__(self, loss: Callable, controller: Any, *more: Any, slope: bool = True):
        arrays, rest = eqx.partition(controller, eqx.is_inexact_array)

        def of_arrays(arrays, *more):
            return loss(eqx.combine(arrays, rest), *more)

        begin = time.process_time()
        function = jax.value_and_grad(of_arrays) if slope else of_arrays
        self.compiled = jax.jit(function).lower(arrays, *more).compile()
        self.compile_s = time.process_time() - begin
        about = self.compiled.memory_analysis()
        self.memory = None if about is None else about.temp_size_in_bytes / 1e6
        self.arrays = arrays

    def __call__(self, *more: Any) -> tuple[float, np.ndarray]:
        value, slope = jax.block_until_ready(self.compiled(self.arrays, *more))
        return float(value), np.asarray(ravel_pytree(slope)[0], float)


def seconds(calls: dict[Any, Callable], repeats: int) -> tuple[dict[Any, float], dict[Any, Any]]:
    """Minimum processor time of each program over alternating runs, and the results. The first run
    counts only if there is no second one.
    """
    least, spent, results = {}, dict.fromkeys(calls, 0.0), {}
    for turn in range(1 + repeats):
        for name, call in calls.items():
            if spent[name] < BUDGET:
                begin = time.process_time()
                results[name] = jax.block_until_ready(call())
                took = time.process_time() - begin
                least[name] = took if turn < 2 else min(least[name], took)
                spent[name] += took
    return least, results


def apart(slope: np.ndarray, exact: np.ndarray) -> float:
    """Norm of the error relative to that of the gradient."""
    return float(np.linalg.norm(slope - exact) / np.linalg.norm(exact))


def differences(activation: str, exact: np.ndarray, bodies: int, step: float = 1e-4) -> list[float]:
    """Differences between the gradient and SciPy's derivatives, along the gradient and along a
    random direction.
    """
    from scipy.integrate import solve_ivp

    network, state = Network(activation), states(bodies)
    flat, unravel = ravel_pytree(eqx.filter(network, eqx.is_inexact_array))
    act = {"relu": lambda x: np.maximum(x, 0), "tanh": np.tanh}[activation]
    start, moments = np.concatenate([state.wxyz, state.omega_body], axis=1), np.array(MOMENTS)

    def value(flat) -> float:
        network = unravel(jnp.asarray(flat)).layers
        layers = [(np.asarray(x.weight), np.asarray(x.bias)) for x in network.layers]

        def field(t, y):
            q, w = y[:4], y[4:]
            x = np.concatenate([q / np.linalg.norm(q), w])
            for weight, bias in layers[:-1]:
                x = act(weight @ x + bias)
            torque = TORQUE * np.tanh(layers[-1][0] @ x + layers[-1][1])
            turn = np.array([-(q[1:] @ w), *(q[0] * w + np.cross(q[1:], w))]) / 2
            return np.concatenate([turn, (torque - np.cross(w, moments * w)) / moments])

        ends = [
            solve_ivp(field, (0.0, HORIZON), y, "DOP853", rtol=1e-12, atol=1e-13, max_step=0.05)
            for y in start
        ]
        last = np.stack([end.y[:, -1] for end in ends])
        wxyz = last[:, :4] / np.linalg.norm(last[:, :4], axis=1, keepdims=True)
        return float(np.mean(cost(wxyz, last[:, 4:])))

    rough = np.random.default_rng(1).normal(size=exact.size)
    found = []
    for along in (exact, rough):
        along = along / np.linalg.norm(along)
        flat = np.asarray(flat)
        slope = (value(flat + step * along) - value(flat - step * along)) / (2 * step)
        found.append(float(abs(slope - exact @ along) / np.linalg.norm(exact)))
    return found


def measure(
    activation: str,
    bodies: int,
    dtype: Any,
    tolerances: Iterable[float],
    exact: np.ndarray,
    repeats: int = 3,
) -> list[dict]:
    """Rows of one network and one number of bodies."""
    import diffrax

    network, state = Network(activation, dtype=dtype), states(bodies, dtype)
    programs, calls = {}, {}
    for rtol in tolerances:
        key = "polhode", rtol
        programs[key] = calls[key] = Program(polhode_loss(state, rtol), network)
    for solver in (diffrax.Tsit5(), diffrax.Dopri8()):
        name = f"diffrax {type(solver).__name__}"
        program = Program(diffrax_loss(state, solver), network, jnp.asarray(1e-4, dtype))
        for tolerance in tolerances:
            programs[name, tolerance] = program
            calls[name, tolerance] = partial(program, jnp.asarray(tolerance, dtype))
    least, results = seconds(calls, repeats)
    return [
        {
            "activation": activation,
            "bodies": bodies,
            "dtype": np.dtype(dtype).name,
            "program": name,
            "tolerance": tolerance,
            "seconds": least[name, tolerance],
            "error": apart(results[name, tolerance][1], exact),
            "compile_s": programs[name, tolerance].compile_s,
            "memory_MB": programs[name, tolerance].memory,
        }
        for name, tolerance in calls
    ]


KINDS: dict[str, Callable] = {
    "linear": lambda: Linear(_gains(), lambda x: x),
    "linear, clipped": lambda: Linear(_gains(), lambda x: jnp.clip(x, -0.3, 0.3)),
    "linear, on and off": lambda: Linear(_gains(), lambda x: jnp.where(x > 0.2, 0.3, 0.0)),
    "network of tanh": lambda: Network("tanh"),
    "network of relu": lambda: Network("relu"),
    "larger network of tanh": lambda: Network("tanh", 64),
    "larger network of relu": lambda: Network("relu", 64),
}


def _gains():
    return jnp.asarray(0.4 * np.random.default_rng(3).normal(size=(3, 7)))


def measure_kind(kind: str, bodies: int, rtol: float = 1e-6, repeats: int = 3) -> dict:
    """The gradient of an ordinary call of polhode, compared with the value alone."""
    controller, state = KINDS[kind](), states(bodies)
    value = Program(polhode_loss(state, rtol), controller, slope=False)
    both = Program(polhode_loss(state, rtol), controller)
    _, exact = Program(polhode_loss(state, REFERENCE), controller)()
    calls = {"value": lambda: value.compiled(value.arrays), "both": both}
    least, results = seconds(calls, repeats)
    return {
        "kind": kind,
        "parameters": exact.size,
        "bodies": bodies,
        "rtol": rtol,
        "value_s": least["value"],
        "gradient_s": least["both"],
        "ratio": least["both"] / least["value"],
        "error": apart(results["both"][1], exact),
        "compile_s": both.compile_s,
        "memory_MB": both.memory,
    }


def time_to_error(rows: list[dict]) -> list[dict]:
    """For each program the minimum time [ms] over the tolerances whose error is below a level; None
    if no tolerance reaches the level.
    """
    names = "activation", "bodies", "dtype", "program"
    groups: dict[tuple, list[dict]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in names), []).append(row)

    def least(group: list[dict], level: float) -> float | None:
        reached = (row for row in group if row["error"] is not None and row["error"] <= level)
        return min((1e3 * row["seconds"] for row in reached), default=None)

    return [
        dict(zip(names, key)) | {f"ms_to_{level:.0e}": least(group, level) for level in LEVELS}
        for key, group in groups.items()
    ]


def _exact(activation: str, bodies: int) -> Callable[[], np.ndarray]:
    """The gradient at the reference tolerance, computed at its first use."""
    return functools.cache(
        lambda: Program(polhode_loss(states(bodies), REFERENCE), Network(activation))()[1]
    )


def _check(activation: str, bodies: int, exact: np.ndarray) -> dict:
    along, across = differences(activation, exact, bodies)
    return {"activation": activation, "along": along, "across": across}


def _known(lines: Path | None) -> dict[tuple, list[dict]]:
    """Results that a file contains, by table and key."""
    if lines is None or not lines.exists():
        return {}
    entries = [json.loads(line) for line in lines.read_text().splitlines()]
    return {(table, *key): found for table, key, found in entries}


def _line(row: dict) -> str:
    if "tolerance" not in row:
        return str(row)
    return (
        f"{row['activation']} {row['bodies']:>5} {row['dtype']} {row['program']:<14}"
        f"{row['tolerance']:>8.0e}{row['seconds']:>10.4f} s{row['error']:>9.1e}"
        f"{row['compile_s']:>7.1f} s{row['memory_MB'] or 0:>9.2f} MB"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--many", action="store_true", help="4,096 bodies too")
    parser.add_argument("--lines", type=Path)
    parser.add_argument("--output", type=Path)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    sizes = BODIES[:1] if options.quick else BODIES + ((4096,) if options.many else ())
    few = options.quick
    numbers: dict[str, Any] = {"horizon": HORIZON, "rows": [], "checks": [], "kinds": []}
    known = _known(options.lines)

    def results(table: str, key: list, compute: Callable[[], list[dict]]) -> None:
        found = known.get((table, *key))
        if found is None:
            found = compute()
            if options.lines is not None:
                with options.lines.open("a") as file:
                    file.write(json.dumps([table, key, found]) + "\n")
        for row in found:
            numbers[table].append(row)
            print(_line(row), flush=True)

    for bodies in sizes:
        for activation in ("relu",) if few else ("tanh", "relu"):
            exact = _exact(activation, bodies)
            if bodies == sizes[0]:
                results("checks", [activation], lambda: [_check(activation, bodies, exact())])  # noqa: B023
            runs = [(np.float64, TOLERANCES[4:5] if few else TOLERANCES)]
            if not few and bodies == 32:
                runs.append((np.float32, SINGLE))
            for dtype, tolerances in runs:
                results(
                    "rows",
                    [activation, bodies, np.dtype(dtype).name],
                    lambda: measure(activation, bodies, dtype, tolerances, exact()),  # noqa: B023
                )
    for kind in list(KINDS)[:1] if few else KINDS:
        results("kinds", [kind], lambda: [measure_kind(kind, 4 if few else 32)])  # noqa: B023
    numbers["time_to_error"] = time_to_error(numbers["rows"])
    path = _report.write("controllers", numbers, path=options.output, packages=("scipy",))
    print(f"written: {path.name}")


if __name__ == "__main__":
    main()
