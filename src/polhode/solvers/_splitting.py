"""Structure-preserving compositions of the exact flows that a Lie-Poisson system is made of."""

from typing import ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polhode.solvers._dense import CollocationInterpolation, collocate
from polhode.solvers._kernel import kernel, map_blocks
from polhode.solvers._problem import Problem
from polhode.solvers._schemes import SCHEMES, Scheme

Body = tuple[tuple[Array, Array, Array], tuple[Array, Array, Array, Array]]


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
    - ``block``: as in ``Extrapolation``.

    ??? cite "Reference"
        R. I. McLachlan, Phys. Rev. Lett. 71 (1993) 3043; E. Hairer, C. Lubich, G. Wanner,
        Geometric Numerical Integration, sections II.4, V.3 and VII.5; the tables' sources stand
        with the schemes.
    """

    formal_order: int = eqx.field(static=True, default=4)
    middle: int = eqx.field(static=True, default=1)
    block: int | None = eqx.field(static=True, default=None)

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar = CollocationInterpolation

    def __check_init__(self):
        if self.formal_order not in SCHEMES:
            raise ValueError(
                f"Splitting({self.formal_order}): the order must be one of {tuple(SCHEMES)}."
            )
        if self.middle not in (0, 1, 2):
            raise ValueError(f"middle={self.middle}: give a body axis 0, 1 or 2.")

    @property
    def scheme(self) -> Scheme:
        return SCHEMES[self.formal_order]

    def order(self, terms) -> int:
        return self.formal_order

    def init(self, terms, t0, t1, y0, args) -> None:
        return None

    def func(self, terms, t0, y0, args) -> Body:
        return terms.vf(t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        del solver_state, made_jump

        def advance(y, rest):
            t, control, problem = rest
            run = kernel(lambda *operands: _step(self.scheme, self.middle, *operands))
            return run(problem, t, control, y)

        problem = Problem.of(terms, args)
        # every time inside the step is t0 plus a share of the step, as seen by the vector field
        rest = ((t0, t1 - t0), problem.control(t0, t1), problem)
        y1 = map_blocks(advance, self.block, y0, rest)
        dense = collocate(terms, t0, t1, y0, y1, args, self.formal_order)
        return y1, None, dense, None, diffrax.RESULTS.successful


def _turn(y: Body, axis: int, half: Array) -> Body:
    """Rotation of the body by the angle ``2 half`` about one of its axes.

    The momentum is moved by small differences: equal steps round sine and cosine in the same way
    each time, and ``cos^2 + sin^2 != 1`` would change its length in proportion to the steps.
    """
    momentum, wxyz = y
    j, k = (axis + 1) % 3, (axis + 2) % 3
    c, s = jnp.cos(half), jnp.sin(half)
    versine, sine = 2 * s * s, 2 * s * c
    new = [momentum[axis]] * 3
    new[j] = momentum[j] + (momentum[k] * sine - momentum[j] * versine)
    new[k] = momentum[k] - (momentum[j] * sine + momentum[k] * versine)
    w, v = wxyz[0], wxyz[1:]
    turned = [v[axis] * c + w * s] * 3
    turned[j] = v[j] * c + v[k] * s
    turned[k] = v[k] * c - v[j] * s
    return tuple(new), (w * c - v[axis] * s, *turned)


def _spin(y: Body, inverse: Array) -> Body:
    """Turn of the attitude about the constant momentum, by the angle ``|L| inverse``."""
    momentum, (w, x, y_, z) = y
    half = [m * (inverse / 2) for m in momentum]
    square = half[0] * half[0] + half[1] * half[1] + half[2] * half[2]
    resting = square == 0  # the root has no slope there, but cos and sin(x) / x have one: zero
    angle = jnp.sqrt(jnp.where(resting, 1, square))
    c = jnp.where(resting, 1, jnp.cos(angle))
    sinc = jnp.where(resting, 1, jnp.sin(angle) / angle)
    a, b, d = (sinc * h for h in half)
    return momentum, (
        w * c - x * a - y_ * b - z * d,
        x * c + w * a + y_ * d - z * b,
        y_ * c + w * b + z * a - x * d,
        z * c + w * d + x * b - y_ * a,
    )


def _normalise(y: Body) -> Body:
    """Takes off what rounding has added to ``|q|``, by one Newton step towards length one."""
    momentum, wxyz = y
    scale = (3 - sum(x * x for x in wxyz[1:]) - wxyz[0] * wxyz[0]) / 2
    return momentum, tuple(scale * x for x in wxyz)


def _step(scheme: Scheme, middle: int, problem: Problem, times, control, y: Body) -> Body:
    t0, width = times
    zero = jnp.zeros_like(y[0][0])
    identity = (zero + 1, zero, zero, zero)

    def rates(problem, momentum):
        _, (_, *half) = problem.field(t0, (tuple(momentum), identity))
        return [2 * h for h in half]

    unit = [zero] * 3
    unit[middle] = zero + 1
    inverse = rates(problem, unit)[middle] - rates(problem, [zero] * 3)[middle]

    @kernel
    def kick(problem, t, span, y):
        momentum, wxyz = y
        torque, _ = problem.field(t, ((zero,) * 3, wxyz))
        return tuple(m + span * n for m, n in zip(momentum, torque)), wxyz

    def turn(axis):
        @kernel
        def flow(problem, inverse, span, y):
            excess = rates(problem, y[0])[axis] - inverse * y[0][axis]
            return _turn(y, axis, excess * (span / 2))

        return flow

    turns = [turn((middle + 1) % 3), turn(middle), turn((middle + 2) % 3)]
    spin = kernel(lambda inverse, span, y: _spin(y, inverse * span))

    def pair(y, shares):
        """chi, then its adjoint; the kick that ended the pair before is merged into the first."""
        time, before, first, second = shares
        y = kick(problem, t0 + time * width, (before + first) * control, y)
        for flow in turns:
            y = flow(problem, inverse, first * control, y)
        y = spin(inverse, (first + second) * control, y)
        for flow in reversed(turns):
            y = flow(problem, inverse, second * control, y)
        return y, None

    pairs = np.reshape(scheme.coefficients, (-1, 2))
    time = np.concatenate([[0.0], np.cumsum(pairs.sum(axis=1))[:-1]])
    before = np.concatenate([[0.0], pairs[:-1, 1]])
    dtype = zero.dtype
    shares = [jnp.asarray(x, dtype) for x in (time, before, pairs[:, 0], pairs[:, 1])]
    y, _ = jax.lax.scan(pair, y, shares)
    y = kick(problem, t0 + width, float(pairs[-1, 1]) * control, y)
    return _normalise(y)
