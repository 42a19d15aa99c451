"""Trial bodies with given periods, many at a time, and their misfit."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode import free
from polhode.lightcurve._frequencies import Pairs
from polhode.lightcurve._model import Bodies, Points, magnitudes, moments_of
from polhode.lightcurve._phase import AbstractPhase

CHUNK = 2048
_BISECTIONS = 24


class Hypotheses(NamedTuple):
    """Periods that a light curve may stand for; arrays (h,)."""

    f_phi: np.ndarray
    f_psi: np.ndarray
    long_axis: np.ndarray  # bool: LAM


def hypotheses(pairs: Pairs, lattices: int = 30) -> Hypotheses:
    """What the first ``lattices`` pairs of a Fourier series can mean.

    A series tells the set of sums of multiples of two frequencies, g and h, not which of them is
    what. A body has ``i f_phi + 2 j f_psi``, of which those with odd i may be faint: f_phi is one
    of g, h, g + h, g - h or half of it, and 2 f_psi another one; in both modes, but that SAM has
    ``f_psi <= f_phi``, because no moment exceeds the sum of the other two.
    """
    sums = np.array([(1, 0), (0, 1), (1, 1), (1, -1)], float)
    found = []
    for g in np.stack([pairs.f_phi, pairs.f_psi], -1)[:lattices]:
        size = np.abs(sums @ g)
        for i in range(4):
            for f_phi in (size[i], size[i] / 2):
                for f_psi in np.delete(size, i) / 2:
                    # half a turn within the light curve at least
                    if min(f_phi, f_psi) >= 0.5 * pairs.resolution:
                        found += [(f_phi, f_psi, mode) for mode in (True, False)]
    table = np.array([row for row in found if row[2] or row[1] < row[0]], float)
    # the same within a quarter of the resolution is the same
    key = np.round(np.c_[table[:, :2] / pairs.resolution * 4, table[:, 2:]]).astype(int)
    table = table[np.sort(np.unique(key, axis=0, return_index=True)[1])]
    return Hypotheses(table[:, 0], table[:, 1], table[:, 2] > 0)


@jax.jit
def _drawn(key, f_phi, f_psi, long_axis, spread):
    """Bodies (b,) of the periods asked, and whether there are any for the inertia drawn."""
    count, tries = f_phi.shape[0], 6
    keys = jax.random.split(key, 5)
    y = jax.random.uniform(keys[0], (tries, count), minval=0.2)
    z = y * jax.random.uniform(keys[1], (tries, count), minval=0.3)
    u = jnp.log(jnp.stack([y, z], -1))
    ratio = f_psi / f_phi

    def spins(u, part):
        # From small nutation (part 0) to the separatrix (1), in the plane of axes x and z.
        a, b, c = moments_of(u)
        split = jnp.arcsin(jnp.sqrt((1 / a - 1 / b) / (1 / a - 1 / c)))
        along = jnp.broadcast_to(long_axis, split.shape)
        angle = jnp.where(along, split * part, jnp.pi / 2 - (jnp.pi / 2 - split) * part)
        omega = (jnp.cos(angle) / a, jnp.zeros_like(a), jnp.sin(angle) / c)
        return (a, b, c), omega, free.periods((a, b, c), omega)

    _, _, still = spins(u, 1e-3)
    allowed = still.P_phi / still.P_psi > ratio[None]
    pick = jnp.argmax(allowed, axis=0)
    u = jnp.take_along_axis(u, pick[None, :, None], axis=0)[0]
    allowed = jnp.any(allowed, axis=0)

    def halve(_, ends):
        low, high = ends
        middle = (low + high) / 2
        found = spins(u, middle)[2]
        fast = found.P_phi / found.P_psi > ratio
        return jnp.where(fast, middle, low), jnp.where(fast, high, middle)

    ends = (jnp.zeros_like(ratio), jnp.ones_like(ratio))
    low, high = jax.lax.fori_loop(0, _BISECTIONS, halve, ends)
    moments, omega, found = spins(u, (low + high) / 2)
    scale = found.P_phi * f_phi
    omega = tuple(x * scale for x in omega)
    late = jax.random.uniform(keys[2], ratio.shape) / f_psi
    omega, _ = free.free_motion(moments, None, omega, late, attitude=False)
    assert omega is not None  # the rates were not declined
    shape = u + spread * jax.random.normal(keys[3], u.shape)
    wxyz = jax.random.normal(keys[4], (count, 4))
    near = jnp.abs(found.P_phi / found.P_psi / ratio - 1) < 0.01
    good = allowed & near & jnp.isfinite(sum(omega))
    return Bodies(jnp.concatenate([u, shape, jnp.stack(omega, -1)], -1), wxyz), good


def draw(
    key, hypotheses: Hypotheses, each: int, phase: AbstractPhase, blur: float, spread: float = 0.15
):
    """``each`` bodies of every hypothesis; (h each,) bodies, and which exist.

    Frequencies are drawn within ``blur`` of the hypothesis, logarithms of the axes' ratios within
    ``spread`` of those that the inertia suggests, all else from everything possible.
    """
    f_phi, f_psi, long_axis = (jnp.asarray(np.repeat(x, each)) for x in hypotheses)
    shake = blur * jax.random.uniform(
        jax.random.fold_in(key, 1 << 30), (2, f_phi.size), minval=-1.0
    )
    f_phi, f_psi = (jnp.maximum(f + d, f / 2) for f, d in zip((f_phi, f_psi), shake, strict=True))
    total = f_phi.shape[0]
    parts = []
    for k, start in enumerate(range(0, total, CHUNK)):
        index = np.minimum(np.arange(start, start + CHUNK), total - 1)
        parts.append(
            _drawn(jax.random.fold_in(key, k), f_phi[index], f_psi[index], long_axis[index], spread)
        )
    bodies, good = jax.tree.map(lambda *x: jnp.concatenate(x)[:total], *parts)
    typical = jnp.broadcast_to(jnp.asarray(phase.typical, float), (total, len(phase.typical)))
    unknowns = jnp.concatenate([bodies.unknowns, typical], -1)
    unit = bodies.wxyz / jnp.linalg.norm(bodies.wxyz, axis=-1, keepdims=True)
    return Bodies(unknowns, unit), np.asarray(good)


def _misfit(phase, bodies: Bodies, points: Points, solver) -> Float[Array, " b"]:
    rest = magnitudes(phase, bodies, points) - points.magnitude
    offsets = (rest * points.weight) @ points.columns.T @ solver
    rest = (rest - offsets @ points.columns) ** 2
    # the mean of |r| where it is large: single points do not decide
    scale = jnp.sum(rest * points.weight, -1, keepdims=True) / jnp.sum(points.weight)
    return jnp.sum(points.weight * scale * jnp.log1p(rest / scale), -1) / jnp.sum(points.weight)


_scored = jax.jit(
    lambda phase, bodies, points, solver: _misfit(phase, bodies, points, solver),
    static_argnums=0,
)


def misfits(phase: AbstractPhase, bodies: Bodies, points: Points) -> np.ndarray:
    """Robust mean squares of the residuals [mag^2] of each body, offsets fitted."""
    c = np.asarray(points.columns)
    solver = np.linalg.inv((c * np.asarray(points.weight)) @ c.T + np.diag(points.stiffness))
    total = bodies.wxyz.shape[0]
    out = []
    for start in range(0, total, CHUNK):
        index = np.minimum(np.arange(start, start + CHUNK), total - 1)
        part = Bodies(bodies.unknowns[index], bodies.wxyz[index])
        out.append(np.asarray(_scored(phase, part, points, jnp.asarray(solver))))
    return np.nan_to_num(np.concatenate(out)[:total], nan=np.inf)
