"""Work-precision of the integrators on heavy tops, compared with heyoka and diffrax.

    python -m benchmarks.integrators [--quick] [--output out/integrators.json]

Two heavy tops about a fixed point (mass 1, g = 2, centre of mass 0.5 along body z): a fast Lagrange
top, I = (1, 1, 0.5), and an asymmetric one, I = (1, 1.5, 2), some of whose bodies are chaotic; and
the free asymmetric body (1, 2, 3). "simulate" is an entire call of ``ph.simulate`` with the
extrapolation that it chooses; "Extrapolation" is only a diffrax solve of a field written by hand.
Attitudes and rates are random, the horizon is 100 s. The reference is ../shared/peers/truth if
present, otherwise a 30-digit Taylor series that is computed and cached here. All programs are timed
alternately in one process; ratios to heyoka are more robust than times.
"""

import argparse
import math
import time
from functools import reduce
from pathlib import Path

from benchmarks import _report

if __name__ == "__main__":
    _report.one_thread()

import diffrax
import jax
import jax.numpy as jnp
import mpmath
import numpy as np

import polhode as ph
from polhode._integrate import Accuracy

HORIZON = 100.0
TORQUE = 1.0  # mass * g * distance
CASES = {
    "asymmetric": ((1.0, 1.5, 2.0), 0.0, TORQUE, 22, "J3_asy"),
    "lagrange": ((1.0, 1.0, 0.5), 5.0, TORQUE, 21, "J3_lag"),
    "free": ((1.0, 2.0, 3.0), 0.0, 0.0, 11, "J1_A"),
}


def heavy_top(t, y, parameters):
    """Lie-Poisson field of a heavy top with its centre of mass on body z, by components."""
    inverse, strength = parameters
    momentum, (w, x, y_, z) = y
    a, b, c = (m * i for m, i in zip(momentum, inverse))
    l, m, n = momentum
    torque_x, torque_y = 2 * strength * (y_ * z + w * x), 2 * strength * (w * y_ - x * z)
    rate = (m * c - n * b + torque_x, n * a - l * c + torque_y, l * b - m * a)
    a, b, c = a / 2, b / 2, c / 2
    turn = (
        -x * a - y_ * b - z * c,
        w * a + y_ * c - z * b,
        w * b + z * a - x * c,
        w * c + x * b - y_ * a,
    )
    return rate, turn


def taylor_truth(moments, strength, wxyz, omega, times, digits=30):
    """States (wxyz, omega_body) at ``times`` of one heavy top, by Taylor series in mpmath.

    The step is chosen such that the last two terms are below ``10^-digits``. Floats are treated as
    exact.
    """
    with mpmath.workdps(digits + 8):
        i1, i2, i3 = (mpmath.mpf(i) for i in moments)
        k = ((i2 - i3) / i1, (i3 - i1) / i2, (i1 - i2) / i3)
        g = (2 * mpmath.mpf(strength) / i1, 2 * mpmath.mpf(strength) / i2)
        order = int(1.2 * digits)
        state = [mpmath.mpf(v) for v in (*wxyz, *omega)]
        now, out = mpmath.mpf(0), []
        for target in times:
            target = mpmath.mpf(float(target))
            while now < target:
                series = _series(state, k, g, order)
                last = max(abs(s[-1]) for s in series), max(abs(s[-2]) for s in series)
                step = min(
                    (mpmath.mpf(10) ** -digits / size) ** (mpmath.mpf(1) / (order - j))
                    for j, size in enumerate(last)
                )
                step = min(step, target - now)
                state = [reduce(lambda value, c: value * step + c, reversed(s)) for s in series]
                now = target if step == target - now else now + step
            out.append(list(state))
        return out


def _series(state, k, g, order):
    """Taylor coefficients of (wxyz, omega) up to ``order``."""
    w, x, y, z, a, b, c = series = [[v] for v in state]
    for n in range(order):

        def product(u, v, n=n):
            return mpmath.fdot(u[: n + 1], v[n::-1])

        rate = (
            -(product(x, a) + product(y, b) + product(z, c)) / 2,
            (product(w, a) + product(y, c) - product(z, b)) / 2,
            (product(w, b) + product(z, a) - product(x, c)) / 2,
            (product(w, c) + product(x, b) - product(y, a)) / 2,
            k[0] * product(b, c) + g[0] * (product(y, z) + product(w, x)),
            k[1] * product(c, a) - g[1] * (product(x, z) - product(w, y)),
            k[2] * product(a, b),
        )
        for s, r in zip(series, rate):
            s.append(r / (n + 1))
    return series


def initial_states(case, n):
    """Attitudes uniform on SO(3), rates isotropic with length uniform in [1, 2) plus spin."""
    _, spin, _, seed, _ = CASES[case]
    draws = np.random.Generator(np.random.PCG64(seed)).standard_normal((n, 8))
    wxyz = draws[:, :4] / np.linalg.norm(draws[:, :4], axis=1, keepdims=True)
    axis = draws[:, 4:7] / np.linalg.norm(draws[:, 4:7], axis=1, keepdims=True)
    length = 1 + (1 + np.vectorize(math.erf)(draws[:, 7] / math.sqrt(2))) / 2
    return wxyz, axis * length[:, None] + np.array([0, 0, spin])


def truth(case, cache: Path, bodies=16):
    """Final attitudes of the first bodies, each as an unevaluated sum of two float64 (n, 4)."""
    moments, _, strength, _, name = CASES[case]
    shared = Path(__file__).resolve().parents[2] / "shared/peers/truth" / f"{name}.npz"
    if shared.exists():
        data = np.load(shared)
        return data["q"][:, -1], data["q_lo"][:, -1]
    file = cache / f"truth_{case}_{bodies}.npz"
    if not file.exists():
        wxyz, omega = initial_states(case, bodies)
        states = [taylor_truth(moments, strength, *s, [HORIZON])[0][:4] for s in zip(wxyz, omega)]
        high = np.array([[float(v) for v in s] for s in states])
        low = np.array([[float(v - mpmath.mpf(h)) for v, h in zip(*p)] for p in zip(states, high)])
        cache.mkdir(parents=True, exist_ok=True)
        np.savez(file, q=high, q_lo=low)
    data = np.load(file)
    return data["q"], data["q_lo"]


def attitude_errors(wxyz, exact):
    """Angle [rad] between attitudes (n, 4) and the reference, without cancellation."""
    high, low = exact
    n = min(len(wxyz), len(high))
    q = wxyz[:n] / np.linalg.norm(wxyz[:n], axis=1, keepdims=True)
    sign = np.sign(np.sum(q * high[:n], axis=1, keepdims=True))
    gap = (sign * q - high[:n]) - low[:n]
    return 4 * np.arcsin(np.minimum(np.linalg.norm(gap, axis=1) / 2, 1))


class Polhode:
    """A diffrax solve with one solver, in which the bodies of a batch share the steps."""

    def __init__(self, case, n, solver, steps, controller=None, label=None):
        moments, _, strength, _, _ = CASES[case]
        wxyz, omega = initial_states(case, n)
        self.label, self.steps = label or repr(solver), steps
        shape = () if n == 1 else (n,)
        self.state = (
            tuple(jnp.reshape(moments[i] * omega[:, i], shape) for i in range(3)),
            tuple(jnp.reshape(wxyz[:, i], shape) for i in range(4)),
        )
        self.parameters = (
            tuple(jnp.full(shape, 1 / i) for i in moments),
            jnp.full(shape, strength),
        )

        @jax.jit
        def run(state, parameters):
            return diffrax.diffeqsolve(
                diffrax.ODETerm(heavy_top),
                solver,
                0.0,
                HORIZON,
                HORIZON / steps if controller is None else None,
                state,
                parameters,
                stepsize_controller=controller or diffrax.ConstantStepSize(),
                max_steps=2**18,
            ).ys

        start = time.perf_counter()
        self.program = run.lower(self.state, self.parameters).compile()
        self.compile_s = time.perf_counter() - start

    def __call__(self):
        _, wxyz = jax.block_until_ready(self.program(self.state, self.parameters))
        return np.stack([np.reshape(x, -1) for x in wxyz], axis=1)


class Simulated:
    """``ph.simulate`` with the method for a general body, final state only."""

    def __init__(self, case, n, rtol, dtype=jnp.float64):
        moments, _, strength, _, _ = CASES[case]
        wxyz, omega = (jnp.asarray(x, dtype) for x in initial_states(case, n))
        weight = ph.UniformGravity(*(jnp.asarray(x, dtype) for x in weight_of(strength)))
        scene = ph.Scene(ph.Inertia.from_moments(jnp.asarray(moments, dtype)), weight)
        self.given = scene, ph.State(wxyz, omega), jnp.array([0.0, HORIZON], dtype)
        self.record, self.rtol = ph.Record(final_only=True), rtol
        self.method = stepped(*self.given, rtol)
        start = time.perf_counter()
        self()
        self.compile_s = time.perf_counter() - start
        name = "" if dtype == jnp.float64 else " float32"
        self.label = f"simulate{name} {rtol:.0e}"

    def __call__(self):
        found = ph.simulate(*self.given, self.method, rtol=self.rtol, record=self.record)
        self.steps = int(np.max(found.steps))
        return np.asarray(found.wxyz[:, -1], float)


def weight_of(strength):
    """Mass, centre of mass and gravity of the tops."""
    return 1.0, (0.0, 0.0, 0.5), (0.0, 0.0, -2.0 * strength)


def stepped(scene, state, ts, rtol):
    """The integrator that ``ph.simulate`` chooses, even if the scene has a closed form."""
    general = ph.Scene(ph.Inertia.from_moments(jnp.array([1.0, 1.5, 2.0])), scene.potential)
    return ph.explain(general, state, ts, rtol=rtol).method


class Heyoka:
    """heyoka's adaptive Taylor integrator, eight bodies at a time."""

    def __init__(self, case, n, tolerance):
        import heyoka

        moments, _, strength, _, _ = CASES[case]
        i1, i2, i3 = moments
        w, x, y, z, a, b, c = names = heyoka.make_vars(*"wxyzabc")
        rates = [
            -0.5 * (x * a + y * b + z * c),
            0.5 * (w * a + y * c - z * b),
            0.5 * (w * b + z * a - x * c),
            0.5 * (w * c + x * b - y * a),
            (i2 - i3) / i1 * b * c,
            (i3 - i1) / i2 * c * a,
            (i1 - i2) / i3 * a * b,
        ]
        if strength:
            rates[4] = rates[4] + 2 * strength / i1 * (y * z + w * x)
            rates[5] = rates[5] - 2 * strength / i2 * (x * z - w * y)
        self.label, self.batch = f"heyoka {tolerance:.0e}", 1 if n == 1 else 8
        start = time.perf_counter()
        system = list(zip(names, rates))
        if self.batch == 1:
            self.ta = heyoka.taylor_adaptive(system, [0.0] * 7, tol=tolerance)
        else:
            self.ta = heyoka.taylor_adaptive_batch(system, np.zeros((7, 8)), tol=tolerance)
        self.compile_s, self.steps = time.perf_counter() - start, None
        self.start = np.concatenate(initial_states(case, n), axis=1)

    def __call__(self):
        out = np.empty_like(self.start)
        if self.batch == 1:
            self.ta.time, self.ta.state[:] = 0.0, self.start[0]
            self.ta.propagate_until(HORIZON)
            return self.ta.state[None, :4].copy()
        for i in range(0, len(out), 8):
            m = min(8, len(out) - i)
            self.ta.set_time(0.0)
            self.ta.state[:, :m] = self.start[i : i + m].T
            self.ta.state[:, m:] = self.start[i : i + 1].T
            self.ta.propagate_until(np.full(8, HORIZON))
            out[i : i + m] = self.ta.state[:, :m].T
        return out[:, :4]


def measure(programs, case, n, exact, repeats):
    """Rows with time and error; the programs run alternately, and the minimum of repeats counts."""
    outputs = [p() for p in programs]
    best = [math.inf] * len(programs)
    for _ in range(repeats):
        for i, program in enumerate(programs):
            start = time.perf_counter()
            program()
            best[i] = min(best[i], time.perf_counter() - start)
    rows = []
    for program, wxyz, seconds in zip(programs, outputs, best):
        errors = attitude_errors(wxyz, exact)
        rows.append(
            {
                "case": case,
                "bodies": n,
                "solver": program.label,
                "steps": program.steps,
                "ns_per_body_second": seconds / n / HORIZON * 1e9,
                "median": float(np.median(errors)),
                "p90": float(np.quantile(errors, 0.9)),
                "compile_s": program.compile_s,
            }
        )
        r = rows[-1]
        print(
            f"{case:11s} N={n:<6d} {r['solver'][:58]:58s} {r['ns_per_body_second']:9.1f} ns"
            f"  median {r['median']:.1e}  p90 {r['p90']:.1e}",
            flush=True,
        )
    return rows


def marched(case, n, rtol):
    """polhode's solver with the same error control, applied to the field written by hand."""
    solver = ph.Extrapolation(None, accuracy=Accuracy(rtol, HORIZON))
    whole = diffrax.StepTo(jnp.array([0.0, HORIZON]))
    return Polhode(case, n, solver, None, whole, f"Extrapolation {rtol:.0e}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--output", type=Path, default=None)
    parser.add_argument("--quick", action="store_true", help="heavy tops, N = 1000 only")
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows = []
    for case in CASES:
        if options.quick and case == "free":
            continue
        exact = truth(case, _report.OUT / ".cache")
        for n in (1000,) if options.quick else (1000, 1, 100_000):
            programs = [marched(case, n, rtol) for rtol in (1e-6, 1e-9, 1e-12)]
            if n > 1 and CASES[case][2]:
                programs += [Simulated(case, n, rtol) for rtol in (1e-6, 1e-9, 1e-12)]
            if n == 1000 and CASES[case][2]:
                programs.append(Simulated(case, n, 1e-5, jnp.float32))
            if n != 100_000:
                try:
                    programs += [Heyoka(case, n, t) for t in (1e-6, 1e-8, 1e-10, 1e-12, 1e-15)]
                except ImportError:
                    print("heyoka is not installed: no ratios")
            if n == 1000 and not options.quick:
                control = diffrax.PIDController(rtol=1e-9, atol=1e-9)
                programs.append(Polhode(case, n, diffrax.Dopri8(), 1, control))
            rows += measure(programs, case, n, exact, 1 if n == 100_000 else options.repeats)
    _report.write("integrators", {"rows": rows}, path=options.output, packages=("heyoka",))


if __name__ == "__main__":
    main()
