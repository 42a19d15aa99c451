"""Damped least squares for batches of bodies, robust, with exact derivatives."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from polhode.lightcurve._model import (
    Bodies,
    Points,
    magnitudes,
    magnitudes_and_slopes,
    stepped,
)  # fmt: skip
from polhode.lightcurve._phase import AbstractPhase

BATCH = 32
# What is held of a body before it is seen: logarithms of the axes' ratios 0 +- 0.8; those of the
# homogeneous ellipsoid of its inertia within 0.25 of its shape's; phase coefficients +- 0.3.
_SHAPE_SIGMA, _TIE_SIGMA, _PHASE_SIGMA = 0.8, 0.25, 0.3
_EXPECTED = 40  # steps to the spread of offsets; twenty reach three digits


def _priors(phase: AbstractPhase, columns: int):
    """Rows a, targets b and 1/sigma^2 of (a x - b)^2 / sigma^2 of all unknowns."""
    many = len(phase.typical)
    size = 10 + many + columns
    rows, targets, precision = [], [], []

    def add(entries, target, sigma):
        row = np.zeros(size)
        for k, value in entries:
            row[k] = value
        rows.append(row)
        targets.append(target)
        precision.append(sigma**-2.0)

    for k in range(2):
        add([(2 + k, 1.0)], 0.0, _SHAPE_SIGMA)
        add([(k, 1.0), (2 + k, -1.0)], 0.0, _TIE_SIGMA)
    for k, typical in enumerate(phase.typical):
        add([(7 + k, 1.0)], typical, _PHASE_SIGMA)
    return np.array(rows), np.array(targets), np.array(precision)


def normal_equations(phase, bodies: Bodies, offsets, points: Points, limit):
    """Robust cost (b,), and matrix and right side of the normal equations of data, all unknowns.

    The cost of a residual of r sigma is 2 limit^2 (sqrt(1 + (r / limit)^2) - 1).
    """
    value, slopes = magnitudes_and_slopes(phase, bodies, points)
    rest = value + offsets @ points.columns - points.magnitude
    squared = rest * rest * points.weight / limit[:, None] ** 2
    cost = 2 * limit**2 * jnp.sum(squared / (1 + jnp.sqrt(1 + squared)), axis=-1)
    robust = 1 / jnp.sqrt(1 + squared)
    weight = points.weight * robust
    columns = jnp.broadcast_to(points.columns, (rest.shape[0], *points.columns.shape))
    whole = jnp.concatenate([slopes, columns], axis=1)
    weighted = whole * weight[:, None]
    matrix = jnp.einsum("bin,bjn->bij", weighted, whole)
    right = jnp.einsum("bin,bn->bi", weighted, rest)
    return cost, matrix, right, jnp.sum(rest * rest * points.weight, -1), (value, robust)


normal_equations = jax.jit(normal_equations, static_argnums=0)
_light = jax.jit(magnitudes, static_argnums=0)
_stepped = jax.jit(stepped)


class State(NamedTuple):
    bodies: Bodies
    offsets: np.ndarray
    cost: np.ndarray
    matrix: np.ndarray
    right: np.ndarray
    square: np.ndarray


class Problem:
    """Damped steps for batches of bodies."""

    def __init__(self, phase: AbstractPhase, points: Points):
        self.phase, self.points = phase, points
        self.columns = points.columns.shape[0]
        self.priors = _priors(phase, self.columns)
        self.stiffness = np.asarray(points.stiffness)

    def look(self, bodies: Bodies, offsets: np.ndarray, limit: np.ndarray) -> State:
        """Cost and normal equations of bodies (b,), b a multiple of the batch."""
        parts = []
        for start in range(0, len(offsets), BATCH):
            cut = slice(start, start + BATCH)
            piece = jax.tree.map(jnp.asarray, picked(bodies, cut))
            out = normal_equations(self.phase, piece, jnp.asarray(offsets[cut]), self.points,
                          jnp.asarray(limit[cut]))  # fmt: skip
            parts.append([np.asarray(x) for x in out[:4]])
        cost, matrix, right, square = (np.concatenate(x) for x in zip(*parts))
        rows, targets, precision = self.priors
        many = bodies.unknowns.shape[1]
        x = np.concatenate([bodies.unknowns, np.zeros((len(offsets), 3)), offsets], axis=1)
        rest = x @ rows.T - targets
        # unseen offsets are held at zero, and free ones by next to nothing
        soft = np.zeros(x.shape[1])
        soft[many + 3 :] = self.stiffness
        cost = cost + (rest**2 * precision).sum(1) + (x**2 * soft).sum(1)
        matrix = matrix + (rows.T * precision) @ rows + np.diag(soft)
        right = right + (rest * precision) @ rows + x * soft
        return State(bodies, offsets, np.nan_to_num(cost, nan=np.inf), matrix, right, square)

    def start(self, bodies: Bodies, limit: np.ndarray) -> State:
        """With the offsets that fit best."""
        c, weight = np.asarray(self.points.columns), np.asarray(self.points.weight)
        solver = np.linalg.inv((c * weight) @ c.T + np.diag(self.stiffness + 1e-9 * weight.sum()))
        light = np.concatenate([
            _light(self.phase, picked(bodies, slice(k, k + BATCH)), self.points)
            for k in range(0, len(limit), BATCH)
        ])  # fmt: skip
        rest = np.nan_to_num((self.points.magnitude - light) * weight, posinf=0, neginf=0)
        return self.look(bodies, rest @ c.T @ solver, limit)

    def improve(self, state: State, limit: np.ndarray, steps: int, ending: float = 1e-3):
        """Levenberg-Marquardt; ends when no cost fell by ``ending`` in three steps."""
        damping = np.full(len(limit), 1e-2)
        quiet = np.zeros(len(limit), int)
        for _ in range(steps):
            moving = np.flatnonzero(quiet < 3)
            if not moving.size:
                break
            # whole batches, so that few programs are compiled
            moving = np.pad(moving, (0, -moving.size % BATCH), mode="edge")
            old = picked(state, moving)
            step = -_solved(old.matrix, old.right, damping[moving])
            many = step.shape[1] - self.columns
            # no step of more than half a unit in the logarithms, half a radian in attitude
            size = np.abs(np.delete(step[:, :many], (4, 5, 6), axis=1)).max(1)
            step *= np.minimum(1, 0.5 / np.maximum(size, 1e-30))[:, None]
            parts = [
                _stepped(picked(old.bodies, cut), step[cut, :many])
                for cut in (slice(k, k + BATCH) for k in range(0, len(step), BATCH))
            ]
            bodies = jax.tree.map(lambda *x: np.concatenate(x), *parts)
            new = self.look(bodies, old.offsets + step[:, many:], limit[moving])
            better = new.cost < old.cost
            gain = np.where(better, old.cost - new.cost, 0)
            for held, found in zip(jax.tree.leaves(state), jax.tree.leaves(new)):
                held[moving[better]] = found[better]
            damping[moving] = np.clip(damping[moving] * np.where(better, 0.2, 5.0), 1e-9, 1e9)
            # a step refused says nothing before the damping is great
            small = np.where(better, gain < ending * np.maximum(1, 1e-3 * old.cost),
                             damping[moving] > 10)  # fmt: skip
            quiet[moving] = np.where(small, quiet[moving] + 1, 0)
        return state


def spread_of_offsets(matrix, right, offsets, stiffness, groups: slice) -> float:
    """Standard deviation of the groups' offsets [mag] that makes the points most likely.

    ``matrix`` (u, u), ``right`` (u,): normal equations at a body, whose last unknowns are
    ``offsets`` (c,) held by ``stiffness`` (c,). All unknowns are integrated out of the linear
    model, by expectation and maximisation: the mean square is that of estimates and variances.
    """
    index = np.arange(len(matrix) - len(offsets), len(matrix))
    x = np.zeros(len(matrix))
    x[index] = offsets
    right, index, held = matrix @ x - right, index[groups], stiffness[groups]
    variance = 1 / held[0]
    for _ in range(_EXPECTED):
        precision = matrix.copy()
        precision[index, index] += 1 / variance - held
        inverse = np.linalg.pinv(precision, hermitian=True)
        variance = np.mean((inverse @ right)[index] ** 2 + np.diag(inverse)[index])
    return float(np.sqrt(variance))


def _solved(matrix, right, damping):
    """Solutions of symmetric systems, scaled to unit diagonal, with ``damping`` on it."""
    diagonal = np.einsum("bii->bi", matrix)
    size = np.sqrt(np.where(diagonal > 0, diagonal, 1))
    scaled = matrix / size[:, :, None] / size[:, None]
    scaled = np.nan_to_num(scaled, posinf=0, neginf=0)
    eye = np.eye(matrix.shape[1])
    scaled = scaled + eye * (np.reshape(damping, (-1, 1, 1)) + 1e-12 + (diagonal <= 0)[:, :, None])
    right = np.nan_to_num(right / size, posinf=0, neginf=0)
    return np.linalg.solve(scaled, right[..., None])[..., 0] / size


def picked(tree, index):
    """The bodies of these numbers."""
    return jax.tree.map(lambda x: x[index], tree)


def taken(bodies: Bodies, index) -> Bodies:
    """The same, copied, in whole batches: the last is repeated."""
    index = np.pad(index, (0, -len(index) % BATCH), mode="edge")
    return picked(jax.tree.map(np.array, bodies), index)
