"""Bodies and scenes of benchmarks/torqued.py, and their motion in 80-bit arithmetic by heyoka.

Newton-Euler's equations are written by hand for every scene, with the body rates w, the attitude q
(body -> space), I = diag(moments), the inertia K without freely spinning wheels, and the momentum h
that wheels have along their axes a in addition to that of K:

    K dw/dt = (K w + h a) x w + N - a dh/dt,    dq/dt = q (0, w) / 2.

All numbers are multiples of powers of two that single precision represents.
"""

from functools import cache

import numpy as np

from benchmarks import _report
from benchmarks._formulas import multiply

LONG = np.longdouble
HORIZONS = (0.25, 16.0, 128.0, 1000.0)
WILD = 10.0
"""Growth of a small change of the start, over the angle turned, beyond which a body is wild."""

SCENES = (
    "asymmetric top",
    "Lagrange's top",
    "gravity gradient",
    "gravity gradient, Kepler",
    "potential of attitude",
    "body torque",
    "body torque of time",
    "space torque",
    "space torque of time",
    "linear damping",
    "quadratic damping",
    "rotor held",
    "rotor free",
    "rotor driven",
    "several",
)
_SHAPES = (
    (1.0, 1.5, 2.0),
    (1.0, 1.0078125, 0.03125),
    (1.0, 1.125, 2.0),
    (1.0, 1.00390625, 1.0078125),
)
BODIES = 24
MOMENTS = np.array([_SHAPES[i % 4] for i in range(BODIES)])


def axisymmetric(moments):
    """The moments with equal transverse ones."""
    moments = np.array(moments)
    moments[..., 1] = moments[..., 0]
    return moments


def states(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Attitudes and rates, exact in float32; the rates have sizes between 1/32 and 8 rad/s."""
    draws = np.random.default_rng(41).standard_normal((BODIES, 7))
    wxyz = draws[:, :4] / np.linalg.norm(draws[:, :4], axis=1, keepdims=True)
    axis = draws[:, 4:] / np.linalg.norm(draws[:, 4:], axis=1, keepdims=True)
    size = 2.0 ** np.linspace(-5, 3, BODIES)[:, None]
    return tuple(np.asarray(x, np.float32).astype(float) for x in (wxyz, axis * size))


def _equations(name: str):
    """heyoka's system, with the moments as parameters, and additional initial values."""
    import heyoka as hy

    w, x, y, z, *o = hy.make_vars("w", "x", "y", "z", "a", "b", "c")
    moments = [hy.par[i] for i in range(3)]
    rows = [
        [w * w + x * x - y * y - z * z, 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), w * w - x * x + y * y - z * z, 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    t = hy.time
    zero = hy.expression(0.0)
    push, carried, rate, kept = [zero] * 3, [zero] * 3, [zero] * 3, list(moments)
    more, start = [], []

    def cross(p, q):
        return [p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]]

    def add(*v):
        for i in range(3):
            push[i] = push[i] + v[i]

    def to_body(v):
        return [sum((rows[j][i] * v[j] for j in range(1, 3)), rows[0][i] * v[0]) for i in range(3)]

    def gravity(centre):
        add(*cross([hy.expression(c) for c in centre], [-r for r in rows[2]]))

    def gradient(place, strength):  # strength * place x I place, space axes, unnormalised place
        n = to_body(place)
        add(*(strength * c for c in cross(n, [m * k for m, k in zip(moments, n)])))

    wave = [0.125 * hy.sin(t), 0.0625 * hy.cos(2.0 * t), hy.expression(0.03125)]
    whole = name == "several"
    if name in ("asymmetric top", "linear damping") or whole:
        gravity((0.125, 0.0, 0.5))
    if name == "Lagrange's top":
        gravity((0.0, 0.0, 0.5))
    if name == "gravity gradient" or whole:  # |r| = 2.5: 3 mu / r^5 = 1.5 / 97.65625
        gradient([hy.expression(1.5), zero, hy.expression(2.0)], LONG(1.5) / LONG(97.65625))
    if name == "gravity gradient, Kepler":
        u, v, du, dv = hy.make_vars("u", "v", "du", "dv")
        square = u * u + v * v
        pull = -0.5 * square**-1.5
        more = [(u, du), (v, dv), (du, pull * u), (dv, pull * v)]
        start = [LONG(1.5), LONG(0), LONG(0), np.sqrt(LONG(0.25) * LONG(1.25) / LONG(0.75))]
        gradient([u, v, zero], 1.5 * square**-2.5)
    if name == "potential of attitude":
        # V = r01 r22 / 4 + r10^2 / 8; torque = -sum over entries of dV/dr_ij times (e_j x row_i)
        terms = [(0, 1, 0.25 * rows[2][2]), (2, 2, 0.25 * rows[0][1]), (1, 0, 0.25 * rows[1][0])]
        for i, j, slope in terms:
            unit = [hy.expression(1.0 if k == j else 0.0) for k in range(3)]
            add(*(-slope * c for c in cross(unit, rows[i])))
    if name == "body torque":
        add(0.03125, 0.015625, -0.0078125)
    if name == "body torque of time":
        add(*wave)
    if name == "space torque":
        add(*to_body([hy.expression(0.03125), zero, hy.expression(0.015625)]))
    if name == "space torque of time" or whole:
        add(*to_body(wave))
    if name == "linear damping" or whole:
        add(*(-c / 8 * r for c, r in zip((0.25, 0.125, 0.0625), o)))
    if name == "quadratic damping":
        size = hy.sqrt(o[0] * o[0] + o[1] * o[1] + o[2] * o[2])
        add(*(-0.03125 * size * r for r in o))
    if name == "rotor held" or whole:
        third = LONG(0.25)  # 0.75 / 3
        for i, k in enumerate((1, 2, 2)):
            carried[i] = carried[i] + third * LONG(k)
    if name == "rotor free" or whole:  # c = J (speed + w_y), constant
        kept[1] = kept[1] - 0.25
        carried[1] = carried[1] + hy.par[3]
    if name == "rotor driven":  # c = c0 + sin t
        kept[0] = kept[0] - 0.125
        carried[0] = carried[0] + hy.par[3] + hy.sin(t)
        rate[0] = hy.cos(t)
    momentum = [k * r + h for k, r, h in zip(kept, o, carried)]
    turn = cross(momentum, o)
    slopes = [(a + n - r) / k for a, n, r, k in zip(turn, push, rate, kept)]
    half = [0.5 * r for r in o]
    spin = [
        -x * half[0] - y * half[1] - z * half[2],
        w * half[0] + y * half[2] - z * half[1],
        w * half[1] + z * half[0] - x * half[2],
        w * half[2] + x * half[1] - y * half[0],
    ]
    return [*zip((w, x, y, z), spin), *zip(o, slopes), *more], start


@cache
def _integrator(name: str):
    import heyoka as hy

    system, start = _equations(name)
    given = np.array([1, 0, 0, 0, 0, 0, 1, *start], LONG)
    wheel = name in ("rotor free", "rotor driven", "several")
    pars = np.array([1, 1.5, 2, 1], LONG)[: 4 if wheel else 3]
    made = hy.taylor_adaptive(system, given, fp_type=LONG, pars=pars, tol=LONG(1e-19))
    return made, np.array(start, LONG)


def motion(name: str, moments, wxyz, omega, times) -> np.ndarray:
    """States (wxyz, omega) of one body at the times, in 80 bits."""
    made, start = _integrator(name)
    q = np.asarray(wxyz, LONG)
    omega = np.asarray(omega, LONG)
    wheel = {"rotor driven": LONG(0.125) * (2 + omega[0])}.get(name, LONG(0.25) * (3 + omega[1]))
    made.time = LONG(0)
    made.state[:] = np.concatenate([q / np.sqrt(np.sum(q * q)), omega, start])
    made.pars[:] = np.array([*moments, wheel], LONG)[: len(made.pars)]
    out = []
    for t in times:
        outcome = made.propagate_until(LONG(t))
        if "time_limit" not in str(outcome[0]):
            raise ArithmeticError(f"{name}: heyoka stopped at {made.time}: {outcome[0]}")
        out.append(np.array(made.state[:7]))
    return np.array(out)


def truth(name: str, horizon: float):
    """Attitudes (bodies, 4) in 80 bits, growth of a small change of the start, rotation angle.

    The growth is relative to the rotation angle: 1 for free rotation, whose phase error grows
    linearly.
    """
    file = _report.OUT / "truth" / f"{name.replace(' ', '_').replace(',', '')}.npz"
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        np.savez(file, **_make(name))
    data = np.load(file)
    k = HORIZONS.index(horizon)
    return data["wxyz"][:, k], data["growth"][:, k], data["turned"][:, k]


def _make(name: str) -> dict[str, np.ndarray]:
    moments = axisymmetric(MOMENTS) if name == "Lagrange's top" else MOMENTS
    times = np.unique(np.concatenate([np.linspace(0, h, 33) for h in HORIZONS]))[1:]
    steps = np.diff(times, prepend=0.0)
    kept = np.searchsorted(times, HORIZONS)
    out: dict[str, list] = {"wxyz": [], "growth": [], "turned": []}
    for i, q, w in zip(moments, *states(name)):
        path = motion(name, i, q, w, times)
        sizes = np.linalg.norm(path[:, 4:], axis=1)
        turned = np.maximum(np.cumsum(sizes * steps)[kept], 1)
        early = np.sqrt(np.mean(sizes[: kept[1]] ** 2))
        size = LONG(2) ** -44
        tilt = size / 2 * np.array([0.6, 0.64, 0.48], LONG)
        unit = np.asarray(q, LONG) / np.linalg.norm(q)
        near = np.asarray(q, LONG) + np.array(multiply(unit, (LONG(0), *tilt)))
        push = np.asarray(w, LONG) + size * early * np.array([-0.64, 0.48, 0.6], LONG)
        moved = motion(name, i, near, push, np.array(HORIZONS))
        apart = 2 * np.linalg.norm(moved[:, :4] - path[kept, :4], axis=1) / size
        out["wxyz"].append(path[kept, :4])
        out["growth"].append(np.asarray(apart / turned, float))
        out["turned"].append(np.asarray(turned, float))
    return {key: np.array(value) for key, value in out.items()}


if __name__ == "__main__":
    for scene in SCENES:
        _, growth, turned = truth(scene, HORIZONS[-1])
        print(scene, np.round(growth, 1), np.round(turned), flush=True)
