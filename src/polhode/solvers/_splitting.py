"""Structure-preserving compositions of the exact flows that a Lie-Poisson system is made of."""

from typing import ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polhode._kernel import kernel
from polhode.solvers._blocks import check_layout, map_blocks
from polhode.solvers._dense import CollocationInterpolation, collocate
from polhode.solvers._problem import Problem
from polhode.solvers._schemes import SCHEMES, Scheme

Vector = tuple[Array, Array, Array]
Quaternion = tuple[Array, Array, Array, Array]


class Splitting(diffrax.AbstractSolver):
    r"""Composition of exactly solvable flows; order 2, 4, 6 or 8 with constant steps.

    The Hamiltonian is taken apart into
    - the kick: $L$ changes by the torque of the potential, the attitude rests;
    - one rotation about each body axis, by what $1/I_i$ differs from the middle one, $1/I_b$;
    - the symmetric part $|L|^2 / 2 I_b$, which turns the attitude about a constant $L$.
    All three are exact, and for an axisymmetric body so is the free motion.

    State: ``(momentum, wxyz)``, three and four component arrays, body axes principal. The vector
    field must have the Lie-Poisson form with $\omega_i$ a function of $L_i$ only and a torque
    that depends on attitude and time alone; flows and rates are read off from it.

    - Order: that of the scheme (Strang; Blanes and Moan 4, 6; Kahan and Li 8), cost 1, 6, 10, 17
      kicks and rotations about each axis per step.
    - Exact up to rounding: $|q|$; $|L|$ without torque; the momentum along an axis of symmetry
      of the potential in space; time reversal. The energy error stays bounded.
    - No error estimate. Dense output: collocation polynomial.
    - ``middle``: the axis (0, 1, 2) whose moment is the middle one; for an axisymmetric body
      either transverse axis. Another choice costs accuracy only.
    - ``block``, ``substeps``: as in ``Extrapolation``.

    ??? cite "Reference"
        R. I. McLachlan, Phys. Rev. Lett. 71 (1993) 3043; E. Hairer, C. Lubich, G. Wanner,
        Geometric Numerical Integration, sections II.4, V.3 and VII.5; the tables' sources stand
        with the schemes.
    """

    formal_order: int = eqx.field(static=True, default=4)
    middle: int = eqx.field(static=True, default=1)
    block: int | None = eqx.field(static=True, default=None)
    substeps: int = eqx.field(static=True, default=1)

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar = CollocationInterpolation

    def __check_init__(self):
        if self.formal_order not in SCHEMES:
            raise ValueError(
                f"Splitting({self.formal_order}): the order must be one of {tuple(SCHEMES)}."
            )
        if self.middle not in (0, 1, 2):
            raise ValueError(f"middle={self.middle}: give a body axis 0, 1 or 2.")
        check_layout(self.block, self.substeps)

    @property
    def scheme(self) -> Scheme:
        return SCHEMES[self.formal_order]

    def order(self, terms) -> int:
        return self.formal_order

    def init(self, terms, t0, t1, y0, args) -> Vector:
        """The momentum in space axes: from step to step it passes unrounded."""
        return _rotate(y0[1], y0[0])

    def func(self, terms, t0, y0, args) -> tuple[Vector, Quaternion]:
        return terms.vf(t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        momentum_space = jax.tree.map(
            lambda kept, fresh: jnp.where(made_jump, fresh, kept),
            solver_state,
            _rotate(y0[1], y0[0]),
        )

        def advance(state, rest):
            def run(*operands):
                return _steps(self.scheme, self.middle, self.substeps, *operands)

            return kernel(run)(*rest, state)

        problem = Problem.of(terms, args)
        rest = (problem, (t0, t1 - t0), problem.control(t0, t1, y0))
        state, nodes = map_blocks(advance, self.block, (momentum_space, tuple(y0[1])), rest)
        y1 = (_rotate_back(state[1], state[0]), state[1])
        nodes = (_rotate_back(nodes[1], nodes[0]), nodes[1])
        dense = collocate(terms, t0, t1, nodes, y1, args, self.formal_order)
        return y1, None, dense, state[0], diffrax.RESULTS.successful


def _cross(a, b):
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def _rotate(wxyz, vector):
    """Space components of a vector given in body axes."""
    twice = tuple(2 * x for x in _cross(wxyz[1:], vector))
    return tuple(v + (wxyz[0] * a + b) for v, a, b in zip(vector, twice, _cross(wxyz[1:], twice)))


def _rotate_back(wxyz, vector):
    """Body components of a vector given in space axes."""
    return _rotate((wxyz[0], *(-x for x in wxyz[1:])), vector)


def _turn(wxyz, axis: int, half: Array):
    """Rotation of the body by the angle ``2 half`` about one of its own axes."""
    j, k = (axis + 1) % 3, (axis + 2) % 3
    c, s = jnp.cos(half), jnp.sin(half)
    w, v = wxyz[0], wxyz[1:]
    turned = [v[axis] * c + w * s] * 3
    turned[j] = v[j] * c + v[k] * s
    turned[k] = v[k] * c - v[j] * s
    return (w * c - v[axis] * s, *turned)


def _spin(wxyz, momentum, inverse: Array):
    """Rotation of the body about the momentum, fixed in space, by the angle ``|L| inverse``."""
    half = [m * (inverse / 2) for m in momentum]
    square = half[0] * half[0] + half[1] * half[1] + half[2] * half[2]
    resting = square == 0  # the root has no slope there, but cos and sin(x) / x have one: zero
    angle = jnp.sqrt(jnp.where(resting, 1, square))
    c = jnp.where(resting, 1, jnp.cos(angle))
    sinc = jnp.where(resting, 1, jnp.sin(angle) / angle)
    axis = tuple(sinc * h for h in half)
    w, v = wxyz[0], wxyz[1:]
    along = axis[0] * v[0] + axis[1] * v[1] + axis[2] * v[2]
    turned = (c * x + (w * a + b) for x, a, b in zip(v, axis, _cross(axis, v)))
    return (w * c - along, *turned)


def _normalise(wxyz):
    """Takes off what rounding has added to ``|q|``, by one Newton step towards length one."""
    scale = (3 - sum((x * x for x in wxyz[1:]), wxyz[0] * wxyz[0])) / 2
    return tuple(scale * x for x in wxyz)


def _rates(problem: Problem, t, momentum):
    """Body rates dH/dL, read off from the attitude's rate at the identity."""
    zero = jnp.zeros_like(momentum[0])
    _, (_, *half) = problem.field(t, (tuple(momentum), (zero + 1, zero, zero, zero)))
    return [2 * h for h in half]


def _along(axis: int, value: Array) -> list[Array]:
    return [value if i == axis else jnp.zeros_like(value) for i in range(3)]


def _steps(scheme: Scheme, middle: int, count: int, problem: Problem, times, control, state):
    """Space momentum and attitude after ``count`` equal steps, and those they started from."""
    t0, width = times

    def one(state, i):
        inner = (t0 + i * (width / count), width / count)
        return _step(scheme, middle, problem, inner, control / count, state), state

    return jax.lax.scan(one, state, jnp.arange(count, dtype=jnp.result_type(width)))


def _step(scheme: Scheme, middle: int, problem: Problem, times, control, state):
    """One step. The momentum is carried in space axes, where only the kick changes it: turned
    with the body, equal steps would round alike and shift a conserved component steadily."""
    t0, width = times
    momentum, wxyz = state
    one = jnp.ones_like(momentum[0])
    inverse = (
        _rates(problem, t0, _along(middle, one))[middle]
        - _rates(problem, t0, _along(middle, 0 * one))[middle]
    )

    @kernel
    def kick(problem, t, span, momentum, wxyz):
        zero = jnp.zeros_like(momentum[0])
        torque, _ = problem.field(t, ((zero,) * 3, wxyz))
        push = _rotate(wxyz, tuple(span * n for n in torque))
        return tuple(m + p for m, p in zip(momentum, push))

    def turn(axis):
        @kernel
        def flow(problem, t, inverse, span, momentum, wxyz):
            along = _rotate_back(wxyz, momentum)[axis]
            excess = _rates(problem, t, _along(axis, along))[axis] - inverse * along
            return _turn(wxyz, axis, excess * (span / 2))

        return flow

    turns = [turn((middle + 1) % 3), turn(middle), turn((middle + 2) % 3)]
    spin = kernel(lambda inverse, span, momentum, wxyz: _spin(wxyz, momentum, inverse * span))

    def pair(state, shares):
        """chi, then its adjoint; the kick that ended the pair before is merged into the first."""
        momentum, wxyz = state
        time, before, first, second = shares
        momentum = kick(problem, t0 + time * width, (before + first) * control, momentum, wxyz)
        for flow in turns:
            wxyz = flow(problem, t0, inverse, first * control, momentum, wxyz)
        wxyz = spin(inverse, (first + second) * control, momentum, wxyz)
        for flow in reversed(turns):
            wxyz = flow(problem, t0, inverse, second * control, momentum, wxyz)
        return (momentum, wxyz), None

    pairs = np.reshape(scheme.coefficients, (-1, 2))
    time = np.concatenate([[0.0], np.cumsum(pairs.sum(axis=1))[:-1]])
    before = np.concatenate([[0.0], pairs[:-1, 1]])
    weights = (jnp.asarray(x, one.dtype) for x in (before, pairs[:, 0], pairs[:, 1]))
    shares = (jnp.asarray(time, jnp.result_type(width)), *weights)
    (momentum, wxyz), _ = jax.lax.scan(pair, state, shares)
    momentum = kick(problem, t0 + width, float(pairs[-1, 1]) * control, momentum, wxyz)
    return momentum, _normalise(wxyz)
