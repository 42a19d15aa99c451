"""Damped least squares of bodies to a light curve: in batches, robust, with exact derivatives."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from polhode.lightcurve._brightness import (
    AbstractPhase,
    Bodies,
    Points,
    apply_step,
    magnitudes_and_derivatives,
)
from polhode.lightcurve._data import BLOCK

BATCH = 32
# Priors of a body: logarithms of the axes' ratios 0 +- 0.8; those of the homogeneous ellipsoid of
# its inertia within 0.25 of those of its shape; coefficients of the phase function +- 0.3.
_SHAPE_SIGMA, _TIE_SIGMA, _PHASE_SIGMA = 0.8, 0.25, 0.3
_JITTER = 1e-12  # added to the damping
_EXPECTED = 40  # expectation-maximisation steps of ``spread_of_offsets``; 20 give three digits


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


_light_and_derivatives = jax.jit(magnitudes_and_derivatives, static_argnums=0)


def blocks_of(points: Points) -> list[Points]:
    """Blocks of `BLOCK` points, without offsets: one program of the light serves any number."""
    plain = points.without_offsets()
    return [
        jax.tree.map(lambda x, k=k: x[..., k : k + BLOCK], plain)
        for k in range(0, plain.t.shape[1], BLOCK)
    ]


def light_and_derivatives(phase: AbstractPhase, bodies: Bodies, blocks: list[Points]):
    """Magnitudes (b, n) and derivatives (b, 10 + c, n) of a batch at all points."""
    values, slopes = zip(*(_light_and_derivatives(phase, bodies, block) for block in blocks))
    return jnp.concatenate(values, axis=-1), jnp.concatenate(slopes, axis=-1)


@jax.jit
def robust_equations(value, slopes, offsets, points: Points, limit):
    """Robust cost (b,), and matrix and right side of the normal equations of the data.

    The cost of a residual of r sigma is 2 limit^2 (sqrt(1 + (r / limit)^2) - 1). Also returns the
    sum of squares (b,), and magnitudes, robust weights and derivatives by all unknowns.
    """
    rest = value + offsets @ points.columns - points.magnitude
    squared = rest * rest * points.weight / limit[:, None] ** 2
    cost = 2 * limit**2 * jnp.sum(squared / (1 + jnp.sqrt(1 + squared)), axis=-1)
    robust = 1 / jnp.sqrt(1 + squared)
    weight = points.weight * robust
    columns = jnp.broadcast_to(points.columns, (rest.shape[0], *points.columns.shape))
    whole = jnp.concatenate([slopes, columns], axis=1)
    rows = whole * weight[:, None]
    matrix = jnp.einsum("bin,bjn->bij", rows, whole)
    right = jnp.einsum("bin,bn->bi", rows, rest)
    return cost, matrix, right, jnp.sum(rest * rest * points.weight, -1), (value, robust, whole)


_apply_step = jax.jit(apply_step)


class State(NamedTuple):
    """A batch of bodies, with cost and normal equations there (priors included)."""

    bodies: Bodies
    offsets: np.ndarray
    cost: np.ndarray
    matrix: np.ndarray
    right: np.ndarray
    square: np.ndarray


class Problem:
    """The least-squares problem of a light curve, for batches of bodies."""

    def __init__(self, phase: AbstractPhase, points: Points):
        self.phase, self.points = phase, points
        self.columns = points.columns.shape[0]
        self.priors = _priors(phase, self.columns)
        self.stiffness = np.asarray(points.stiffness)
        self.blocks = blocks_of(points)

    def evaluate(self, bodies: Bodies, offsets: np.ndarray, limit: np.ndarray) -> State:
        """Cost and normal equations of bodies (b,), b a multiple of ``BATCH``."""
        return self._evaluate(bodies, lambda cut, _: offsets[cut], limit)

    def start(self, bodies: Bodies, limit: np.ndarray) -> State:
        """As ``evaluate``, with the best offsets of each body."""
        c, weight = np.asarray(self.points.columns), np.asarray(self.points.weight)
        solver = np.linalg.inv((c * weight) @ c.T + np.diag(self.stiffness + 1e-9 * weight.sum()))

        def best_offsets(_, light):
            rest = np.nan_to_num((self.points.magnitude - light) * weight, posinf=0, neginf=0)
            return rest @ c.T @ solver

        return self._evaluate(bodies, best_offsets, limit)

    def _evaluate(self, bodies: Bodies, offsets_of, limit: np.ndarray) -> State:
        """``offsets_of(cut, light)``: offsets (b, c) of a slice of the bodies with that light."""
        parts = []
        for first in range(0, len(limit), BATCH):
            cut = slice(first, first + BATCH)
            piece = jax.tree.map(jnp.asarray, select(bodies, cut))
            light, slopes = light_and_derivatives(self.phase, piece, self.blocks)
            offsets = offsets_of(cut, light)
            out = robust_equations(
                light, slopes, jnp.asarray(offsets), self.points, jnp.asarray(limit[cut])
            )
            parts.append([offsets, *(np.asarray(x) for x in out[:4])])
        offsets, cost, matrix, right, square = (np.concatenate(x) for x in zip(*parts))
        prior_cost, prior_matrix, prior_right = self.prior(bodies, offsets)
        cost, matrix, right = cost + prior_cost, matrix + prior_matrix, right + prior_right
        return State(bodies, offsets, np.nan_to_num(cost, nan=np.inf), matrix, right, square)

    def prior(self, bodies: Bodies, offsets: np.ndarray):
        """Cost (b,), matrix (u, u) and right side (b, u) of the priors."""
        rows, targets, precision = self.priors
        many = bodies.unknowns.shape[1]
        x = np.concatenate([bodies.unknowns, np.zeros((len(offsets), 3)), offsets], axis=1)
        rest = x @ rows.T - targets
        # Padding offsets, which no point has, are fixed at zero by a stiffness of 1; free offsets
        # have stiffness 0, and only the damping and `_JITTER` keep their equations regular.
        soft = np.zeros(x.shape[1])
        soft[many + 3 :] = self.stiffness
        cost = (rest**2 * precision).sum(1) + (x**2 * soft).sum(1)
        return (
            cost,
            (rows.T * precision) @ rows + np.diag(soft),
            (rest * precision) @ rows + x * soft,
        )

    def improve(self, state: State, limit: np.ndarray, steps: int, ending: float = 1e-3):
        """Levenberg-Marquardt; a body is finished after three steps that gain less than ``ending``.

        The arrays of ``state`` are changed in place.
        """
        damping = np.full(len(limit), 1e-2)
        idle_steps = np.zeros(len(limit), int)
        for _ in range(steps):
            active = np.flatnonzero(idle_steps < 3)
            if not active.size:
                break
            # Converged bodies leave the batch: the number of active ones falls to a fraction within
            # a few steps. Padding to whole batches keeps the shapes, and so the compiled programs,
            # the same.
            active = np.pad(active, (0, -active.size % BATCH), mode="edge")
            old = select(state, active)
            many = old.matrix.shape[1] - self.columns
            # all but the rates: half a unit in the logarithms and half a radian in attitude
            limited = np.delete(np.arange(many), (4, 5, 6))
            step = damped_steps(old.matrix, old.right, damping[active] + _JITTER, limited)
            bodies = stepped(old.bodies, step[:, :many])
            new = self.evaluate(bodies, old.offsets + step[:, many:], limit[active])
            better = new.cost < old.cost
            gain = np.where(better, old.cost - new.cost, 0)
            for old_array, new_array in zip(jax.tree.leaves(state), jax.tree.leaves(new)):
                old_array[active[better]] = new_array[better]
            damping[active] = next_damping(damping[active], better)
            # A rejected step counts as idle only at high damping: at low damping the next, shorter
            # step may still reduce the cost.
            small = np.where(
                better, gain < ending * np.maximum(1, 1e-3 * old.cost), damping[active] > 10
            )
            idle_steps[active] = np.where(small, idle_steps[active] + 1, 0)
        return state


def spread_of_offsets(matrix, right, offsets, stiffness, groups: slice) -> float:
    """Maximum-likelihood standard deviation of the groups' offsets [mag].

    ``matrix`` (u, u), ``right`` (u,): normal equations at a body, whose last unknowns are
    ``offsets`` (c,) with prior precisions ``stiffness`` (c,). The unknowns of the linear model are
    marginalised by expectation-maximisation: the new variance is the mean of squared estimates and
    their variances.
    """
    index = np.arange(len(matrix) - len(offsets), len(matrix))
    x = np.zeros(len(matrix))
    x[index] = offsets
    right, index, prior_precision = matrix @ x - right, index[groups], stiffness[groups]
    variance = 1 / prior_precision[0]
    for _ in range(_EXPECTED):
        precision = matrix.copy()
        precision[index, index] += 1 / variance - prior_precision
        inverse = np.linalg.pinv(precision, hermitian=True)
        variance = np.mean((inverse @ right)[index] ** 2 + np.diag(inverse)[index])
    return float(np.sqrt(variance))


def damped_steps(matrix, right, damping, limited) -> np.ndarray:
    """Levenberg-Marquardt steps (b, u) of the normal equations ``matrix`` (b, u, u), ``right``.

    ``damping`` (b,) is added to the diagonal, which is scaled to one. Steps are shortened so that
    the unknowns ``limited`` (an index) change by at most 0.5.
    """
    diagonal = np.einsum("bii->bi", matrix)
    size = np.sqrt(np.where(diagonal > 0, diagonal, 1))
    damped = matrix / size[:, :, None] / size[:, None]
    damped = np.nan_to_num(damped, posinf=0, neginf=0)
    eye = np.eye(matrix.shape[1])
    damped = damped + eye * (np.reshape(damping, (-1, 1, 1)) + (diagonal <= 0)[:, :, None])
    right = np.nan_to_num(right / size, posinf=0, neginf=0)
    step = -np.linalg.solve(damped, right[..., None])[..., 0] / size
    longest = np.abs(step[:, limited]).max(1)
    return step * np.minimum(1, 0.5 / np.maximum(longest, 1e-30))[:, None]


def next_damping(damping, better) -> np.ndarray:
    """The damping (b,) after steps that reduced the cost (``better``) or did not."""
    return np.clip(damping * np.where(better, 0.2, 5.0), 1e-9, 1e9)


def select(tree, index):
    """Elements ``index`` of every array of a tree, such as bodies."""
    return jax.tree.map(lambda x: x[index], tree)


def in_parts(function, size: int, bodies: Bodies, *arrays: np.ndarray):
    """``function`` of bodies (b,) and arrays (b, ...), in padded parts of ``size``, so that one
    program serves every number of bodies."""
    total, operands = len(bodies.wxyz), jax.tree.map(np.asarray, (bodies, *arrays))
    index = np.minimum(np.arange(total + -total % size), total - 1).reshape(-1, size)
    parts = [function(*select(operands, part)) for part in index]
    return jax.tree.map(lambda *x: np.concatenate(x)[:total], *parts)


def stepped(bodies: Bodies, step: np.ndarray) -> Bodies:
    """The bodies (b,) after the steps (b, u + 3)."""
    return in_parts(_apply_step, BATCH, bodies, step)


def select_padded(bodies: Bodies, index) -> Bodies:
    """A copy of the bodies ``index``, padded to whole batches with the last one."""
    index = np.pad(index, (0, -len(index) % BATCH), mode="edge")
    return select(jax.tree.map(np.array, bodies), index)
