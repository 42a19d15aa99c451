"""Scenes with generated user functions, parts of which XLA may simplify to constants.

``python tests/xla/fuzz.py COUNT [SEED]`` draws COUNT functions and runs each in five ways (value,
gradient, jit, vmap, and under jit with a solver of diffrax) in child processes; it prints which of
them ended abnormally. A child writes down each case before it starts it, so that an abnormal end is
attributed to one function; the next child continues after it. A ValueError or TypeError is an
accepted result.

``python tests/xla/fuzz.py units COUNT [SEED]`` runs only the functions as fused kernels, 25 in one
program, without a scene: a hundred times as many in the same time, with even more simplification.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np

import polhode as ph
from polhode._kernels import kernel

WAYS = ("value", "gradient", "jit", "vmap")
OF_SCENES = (*WAYS, "stock")


def number(rng, x, depth):
    """A random function of time ``t`` and a list of numbers ``x``, with one result.

    Returned with its description.
    """
    made = list(_MADE.items())
    name, make = made[rng.integers(len(made))]
    if depth == 0:
        name, make = made[rng.integers(_LEAVES)]
    inner = [number(rng, x, depth - 1) for _ in range(2)] if depth else []
    fn = make(rng, *(f for f, _ in inner))
    return fn, f"{name}({', '.join(words for _, words in inner)})" if inner else name


def _leaf_constant(rng, *_):
    c = float(rng.choice([0.0, 1.0, -0.3, 1e-3]))
    return lambda t, x: jnp.asarray(c, float)


def _leaf_numpy(rng, *_):
    c = np.asarray(rng.choice([0.0, 0.2]))
    return lambda t, x: jnp.asarray(c) + 0 * t


def _leaf_array(rng, *_):
    c = jnp.asarray(rng.choice([0.0, 0.2]))
    return lambda t, x: c


def _leaf_state(rng, *_):
    k = int(rng.integers(9))
    return lambda t, x: x[k % len(x)] if x else jnp.sin(t)


def _leaf_power(rng, *_):
    k = int(rng.integers(3))
    return lambda t, x: jnp.asarray(0.1 * t**k, float)


def _leaf_integer(rng, *_):
    n = jnp.arange(3)
    k = int(rng.integers(2))
    return lambda t, x: (k * n[1] * jnp.floor(t).astype(int)).astype(float) / 10


def _leaf_interp(rng, *_):
    table = np.zeros(3) if rng.integers(2) else np.array([0.0, 0.1, 0.05])
    return lambda t, x: jnp.interp(t, jnp.arange(3.0), jnp.asarray(table))


def _leaf_table(rng, *_):
    table = jnp.zeros(4) if rng.integers(2) else jnp.array([0.0, 0.1, 0.0, 0.2])
    return lambda t, x: table[jnp.clip(jnp.floor(4 * t).astype(int), 0, 3)]


def _leaf_scan(rng, *_):
    length = int(rng.integers(2))
    return lambda t, x: jax.lax.scan(
        lambda c, _: (c / 2, None), jnp.asarray(t, float), None, length=length
    )[0]


def _cast(rng, f, g):
    return lambda t, x: f(t, x).astype(jnp.float32).astype(float)


def _where_same(rng, f, g):
    return lambda t, x: jnp.where(t < 0.1, f(t, x), f(t, x))


def _where(rng, f, g):
    return lambda t, x: jnp.where(t < 0.1, f(t, x), g(t, x))


def _where_never(rng, f, g):
    return lambda t, x: jnp.where((t > 0.1) & False, f(t, x), g(t, x))


def _cond(rng, f, g):
    return lambda t, x: jax.lax.cond(t < 0.1, lambda: 0.1 * f(t, x), lambda: 0.1 * g(t, x))


def _cond_known(rng, f, g):
    return lambda t, x: jax.lax.cond(True, lambda: 0.1 * f(t, x), lambda: 0.1 * g(t, x))


def _switch(rng, f, g):
    return lambda t, x: jax.lax.switch(
        jnp.floor(9 * t).astype(int), [lambda: f(t, x), lambda: g(t, x), lambda: 0.0 * f(t, x)]
    )


def _sum(rng, f, g):
    return lambda t, x: f(t, x) + g(t, x)


def _difference(rng, f, g):
    return lambda t, x: f(t, x) - f(t, x) + 0.1 * g(t, x)


def _product(rng, f, g):
    return lambda t, x: f(t, x) * g(t, x)


def _times_zero(rng, f, g):
    return lambda t, x: 0.0 * f(t, x) + 0.1 * g(t, x)


def _to_nought(rng, f, g):
    return lambda t, x: f(t, x) ** 0 + g(t, x) * 0


def _loop(rng, f, g):
    turns = int(rng.integers(3))
    return lambda t, x: jax.lax.fori_loop(
        0, turns, lambda i, c: c / 2 + 0.1 * g(t, x), jnp.asarray(f(t, x), float)
    )


def _jitted(rng, f, g):
    return lambda t, x: jax.jit(lambda t: 0.1 * f(t, x))(t)


def _checkpointed(rng, f, g):
    return lambda t, x: jax.checkpoint(lambda t: jnp.tanh(f(t, x)))(t)


def _special(rng, f, g):
    within = lambda x: 0.9 * jnp.tanh(x)  # noqa: E731
    functions = (
        lambda a, b: jnp.cbrt(1 + within(a)),
        lambda a, b: jnp.arcsin(within(a)),
        lambda a, b: jnp.arctanh(within(a)),
        lambda a, b: jnp.arccosh(2 + within(a)),
        lambda a, b: jnp.arctan2(a, 2 + within(b)),
        lambda a, b: jnp.tan(within(a)),
        lambda a, b: jax.scipy.special.erf(a),
        lambda a, b: jnp.hypot(1 + within(a), b),
        jnp.logaddexp,
    )
    fn = functions[rng.integers(len(functions))]
    return lambda t, x: 0.1 * fn(f(t, x), g(t, x))


_MADE = {
    name.removeprefix("_leaf").strip("_"): make
    for name, make in list(globals().items())
    if callable(make) and name.startswith("_") and getattr(make, "__module__", None) == __name__
}
_LEAVES = sum("_leaf" in make.__name__ for make in _MADE.values())
KINDS = ("body torque", "space torque", "feedback", "potential", "rotor", "orbit", "spun drag")


def scene(kind, functions, scale):
    """A scene whose part of this ``kind`` uses three functions, all multiplied by ``scale``."""
    inertia = ph.Inertia.from_moments([1.0, 1.5, 2.0])

    def vector(t, x):
        return jnp.stack([scale * f(t, x) for f in functions])

    if kind == "body torque":
        return ph.Scene(inertia, torque=ph.BodyTorque(lambda t: vector(t, [])))
    if kind == "space torque":
        return ph.Scene(inertia, torque=ph.SpaceTorque(lambda t: vector(t, [])))
    if kind == "spun drag":
        drag = ph.LinearDamping(0.1 * scale)
        return ph.Scene(inertia, torque=drag + ph.BodyTorque(lambda t: vector(t, [])))
    if kind == "feedback":

        def law(t, wxyz, omega):
            return vector(t, [omega[0], omega[1], omega[2], wxyz[0], wxyz[3]])

        return ph.Scene(inertia, torque=ph.FeedbackTorque(law))
    if kind == "potential":

        def energy(R, t):
            return scale * functions[0](t, [R[2, 2], R[0, 1], 0.1 * R[2, 0]])

        return ph.Scene(inertia, ph.Potential(energy))
    if kind == "rotor":
        wheel = ph.Rotor(
            [0.0, 0.0, 1.0], 0.1, momentum=0.1, impulse=lambda t: scale * functions[0](t, [])
        )
        return ph.Scene(inertia, rotors=wheel)
    place = jnp.array([2.0, 0.0, 0.5])
    return ph.Scene(inertia, ph.GravityGradient(0.1, lambda t: place + 0.1 * vector(t, [])))


def draw(seed, index):
    rng = np.random.default_rng([seed, index])
    kind = KINDS[index % len(KINDS)]
    drawn = [number(rng, None, int(rng.integers(3))) for _ in range(3)]
    return kind, [f for f, _ in drawn], "; ".join(words for _, words in drawn)


def run(kind, functions, way):
    wxyz = jnp.array([0.8, 0.0, 0.6, 0.0])

    def end(scale, omega):
        state = ph.State(wxyz, omega)
        found = ph.simulate(
            scene(kind, functions, scale),
            state,
            [0.0, 0.3],
            ph.LiePoisson() if way == "stock" else None,
            rtol=1e-3,
            record=ph.Record(final_only=True),
        )
        return found.wxyz[..., 0, :], found.omega_body[..., 0, :]

    def total(scale, omega):
        return sum(jnp.sum(jnp.sin(x)) for x in end(scale, omega))

    one, omega = jnp.array(0.7), jnp.array([0.3, 1.0, -0.4])
    if way == "value":
        return end(0.7, omega)
    if way in ("jit", "stock"):
        return jax.jit(end)(one, omega)
    if way == "vmap":
        return jax.vmap(end)(jnp.array([0.0, 1.0]), jnp.stack([omega, 2 * omega]))
    return jax.grad(total, (0, 1))(one, omega)


def child(seed, start, stop, log):
    """Run cases, and write down each before it starts."""
    for case in range(start, stop):
        kind, functions, _ = draw(seed, case // len(OF_SCENES))
        way = OF_SCENES[case % len(OF_SCENES)]
        with Path(log).open("a") as file:
            file.write(f"{case} ")
            file.flush()
            try:
                found = jax.tree.leaves(jax.block_until_ready(run(kind, functions, way)))
                good = all(bool(jnp.all(jnp.isfinite(x))) for x in found)
                verdict = "ok" if good else "NOT FINITE"
                verdict += " " + ",".join(f"{x:.9g}" for f in found for x in np.ravel(f)[:4])
            except (ValueError, TypeError) as error:
                verdict = f"refused {type(error).__name__}: {str(error)[:80]!r}"
            except Exception as error:
                verdict = f"FAILED {type(error).__name__}: {str(error)[:200]!r}"
            file.write(verdict + "\n")
        if case % 40 == 39:
            jax.clear_caches()


DERIVATIVES = ({}, {"linearised": True}, {"repeated": True})


def unit(f, ways, how):
    """Values and derivatives of one fused function of time, two arrays and an integer."""

    def whole(t, a, b, n):
        first = jnp.asarray(f(t, [a[0], b[1]]), float)
        return first, jnp.asarray(f(t, []), float) * a, 0 * n, first * 0 + b[0]

    marked = kernel(whole, **how) if ways else whole
    t, a, b, n = jnp.array(0.3), jnp.array([0.2, 0.4]), jnp.array([0.5, 0.1]), jnp.arange(3)

    def total(t, a, b):
        return sum(jnp.sum(x) for x in marked(t, a, b, n) if x.dtype == float)

    return {
        "value": lambda u: marked(t * u, a * u, b * u, n + u.astype(int)),
        "gradient": lambda u: jax.grad(total, (0, 1, 2))(t * u, a * u, b * u),
        "jit": lambda u: jax.jit(marked)(t * u, a, b * u, n),
        "vmap": lambda u: jax.vmap(marked, in_axes=(0, None, 0, None))(
            u * jnp.array([0.0, 0.9]), a, jnp.stack([b * u, b]), n
        ),
    }


def units(seed, start, stop, log):
    """Fused functions compared with plain ones, one program for each transformation."""
    functions = [draw(seed, index)[1][0] for index in range(start, stop)]
    for way in WAYS:
        with Path(log).open("a") as file:
            file.write(f"{way} ")
            file.flush()
            refused = set()

            def both(u, way=way, refused=refused):
                found = {}
                for index, f in enumerate(functions):
                    try:
                        how = DERIVATIVES[index % 3]
                        of = [unit(f, marked, how)[way] for marked in (True, False)]
                        found[index] = [one(u) for one in of]
                    except (TypeError, ValueError):
                        refused.add(index)
                return found

            found = jax.jit(both)(jnp.array(1.0))
            away = 0.0
            for pair in found.values():
                for x, y in zip(*map(jax.tree.leaves, pair), strict=True):
                    assert jnp.all(jnp.isfinite(x)), way
                    away = max(away, float(jnp.max(jnp.abs(x - y))))
            file.write(f"{len(found)} {len(refused)} {away}\n")


def _quickly():
    """An environment in which LLVM does not optimise: abnormal ends happen earlier."""
    flags = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
    return {**os.environ, "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {flags}".strip()}


def hunt_units(count, seed, each=25):
    """Numbers of combinations, of rejected ones, largest difference, and abnormal ends."""
    environment = _quickly() | {"POLHODE_PLAIN": "0"}
    ran = refused = 0
    largest, ends = 0.0, []
    for start in range(0, count, each):
        stop = min(count, start + each)
        with tempfile.TemporaryDirectory() as folder:
            log = Path(folder) / "log"
            command = [sys.executable, __file__, "--units", seed, start, stop, log]
            done = subprocess.run([*map(str, command)], env=environment, capture_output=True)
            for line in log.read_text().splitlines() if log.exists() else []:
                words = line.split()
                if len(words) == 4:
                    ran, refused = ran + int(words[1]), refused + int(words[2])
                    largest = max(largest, float(words[3]))
            if done.returncode != 0:
                ends.append((start, stop, done.returncode, done.stderr.decode()[-400:]))
    return ran, refused, largest, ends


def hunt(count, seed, *, each=200, patience=120, plain=False):
    """Results of all cases: ``{case: words}``; ``ENDED`` or ``STUCK`` for an unfinished child."""
    total, start, found = count * len(OF_SCENES), 0, {}
    environment = _quickly() | {"POLHODE_PLAIN": "1" if plain else "0"}
    with tempfile.TemporaryDirectory() as folder:
        while start < total:
            stop, log = min(total, start + each), Path(folder) / f"log{start}"
            command = [sys.executable, __file__, "--child", seed, start, stop, log]
            try:
                ran = subprocess.run(
                    [*map(str, command)],
                    env=environment,
                    capture_output=True,
                    timeout=patience * (stop - start),
                )
                how = f"ENDED {ran.returncode}"
            except subprocess.TimeoutExpired:
                how = "STUCK"
            lines = log.read_text().splitlines() if log.exists() else []
            for line in lines:
                case, _, verdict = line.partition(" ")
                found[int(case)] = verdict or how
            if not lines:
                raise RuntimeError(f"the child process did not begin: {ran.stderr.decode()[-500:]}")
            start = max(found) + 1
    return found


def main():
    if sys.argv[1] == "--child":
        seed, start, stop, log = sys.argv[2:]
        return child(int(seed), int(start), int(stop), log)
    if sys.argv[1] == "--units":
        seed, start, stop, log = sys.argv[2:]
        return units(int(seed), int(start), int(stop), log)
    if sys.argv[1] == "units":
        seed = int(sys.argv[3]) if len(sys.argv) > 3 else 0
        ran, refused, largest, ends = hunt_units(int(sys.argv[2]), seed)
        for end in ends:
            print(*end)
        print(
            f"{ran} combinations of marked functions ({refused} refused), {len(ends)} processes"
            f" ended; largest difference to the plain functions {largest:.1e}"
        )
        return int(bool(ends))
    count, seed = int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0
    found = hunt(count, seed)
    for case, verdict in found.items():
        if not verdict.startswith(("ok", "refused")):
            kind, _, words = draw(seed, case // len(OF_SCENES))
            way = OF_SCENES[case % len(OF_SCENES)]
            print(f"case {case}, {kind}, {way}: {verdict}\n    {words}")
    ended = sum(v.startswith(("ENDED", "STUCK")) for v in found.values())
    heads = [v.split()[0] for v in found.values()]
    print(
        f"{len(found)} combinations, {ended} ended the process;",
        {head: heads.count(head) for head in sorted(set(heads))},
    )
    return int(ended > 0)


if __name__ == "__main__":
    sys.exit(main())
