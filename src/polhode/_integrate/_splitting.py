"""Structure-preserving compositions of the exact flows that a Lie-Poisson system is made of."""

from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from polhode._hamiltonian import cross, dot, from_quaternion
from polhode._integrate._bound_term import BoundTerm, uses
from polhode._integrate._dense import CollocationInterpolation, collocate
from polhode._integrate._equal_steps import EqualSteps
from polhode._integrate._moser_veselov import ORDERS, paced, prepare, tangents
from polhode._integrate._schemes import KICK_SCHEMES, SCHEMES, Scheme
from polhode._kernels import kernel
from polhode._method._base import Record
from polhode._scene import Scene

Vector = tuple[Array, Array, Array]
Quaternion = tuple[Array, Array, Array, Array]


class Splitting(diffrax.AbstractSolver):
    r"""Composition of exactly solvable flows; order 2, 4, 6 or 8 with constant steps.

    The Hamiltonian is taken apart into the kick, by which $L$ changes by the torque of the
    potential while the attitude rests, and the free motion, which is moved in one of two ways:

    - ``moser_veselov=None``: by exact flows of its parts. One rotation about each body axis, by
      what $1/I_i$ differs from the middle one, $1/I_b$, and the symmetric part $|L|^2 / 2 I_b$,
      which turns the attitude about a constant $L$. For an axisymmetric body the free motion is
      exact. $\omega_i$ may be any function of $L_i$ and time: wheels along body axes.
    - ``moser_veselov=p``: whole, by the preprocessed discrete Moser-Veselov step of order $p$ (2,
      4, 6, 8 or 10). That takes a sixth of the time and leaves no error but that of $p$ and of the
      kicks: the way to go for bodies without wheels. A part of a step must not turn the body by
      much more than 1 rad; beyond 1.5 rad the state is NaN.

    State: ``(momentum, wxyz)``, three and four component arrays, body axes principal. The vector
    field must have the Lie-Poisson form with $\omega_i$ a function of $L_i$ only and a torque
    that depends on attitude and time alone; flows and rates are read off from it, and the state is
    NaN where axes are not principal.

    - Order: that of the scheme, ``formal_order``, or $p$ if that is less. Parts of a step (kick and
      free motion): 1, 6, 10, 17 (Strang; Blanes and Moan 4, 6; Kahan and Li 8), with
      ``moser_veselov`` 1, 6, 14, 17 (Runge-Kutta-Nyström schemes of Blanes and Moan).
    - Exact up to rounding: $|q|$; $|L|$ without torque; the momentum along an axis of symmetry
      of the potential in space; time reversal. The energy error stays bounded.
    - No error estimate. Dense output: collocation polynomial.
    - ``middle``: the axis (0, 1, 2) whose moment is the middle one; for an axisymmetric body
      either transverse axis. Another choice costs accuracy only.

    ??? cite "Reference"
        R. I. McLachlan, Phys. Rev. Lett. 71 (1993) 3043; E. Hairer, C. Lubich, G. Wanner,
        Geometric Numerical Integration, sections II.4, V.3 and VII.5; E. Hairer, G. Vilmart,
        J. Phys. A: Math. Gen. 39 (2006) 13225; the tables' sources stand with the schemes.
    """

    formal_order: int = eqx.field(static=True, default=4)
    middle: int = eqx.field(static=True, default=1)
    moser_veselov: int | None = eqx.field(static=True, default=None)

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar = CollocationInterpolation

    def __check_init__(self):
        if self.formal_order not in SCHEMES:
            raise ValueError(
                f"Splitting({self.formal_order}): the order must be one of {tuple(SCHEMES)}."
            )
        if self.middle not in (0, 1, 2):
            raise ValueError(f"middle={self.middle}: give a body axis 0, 1 or 2.")
        if self.moser_veselov not in (None, *ORDERS):
            raise ValueError(
                f"moser_veselov={self.moser_veselov}: the order of the free motion's step must be"
                f" one of {ORDERS}, or None for rotations about the axes."
            )

    @property
    def scheme(self) -> Scheme:
        return (SCHEMES if self.moser_veselov is None else KICK_SCHEMES)[self.formal_order]

    def check(self, method: Any, scene: Scene, record: Record) -> None:
        """Raises ValueError, saying what to do, unless it can move the scene as asked."""
        name = "ph.LiePoisson(Splitting(...))"

        def require(good: bool, message: str) -> None:
            if not good:
                raise ValueError(f"{name} {message}")

        require(
            not method.chart.canonical, "is the only form: its flows are not those of EulerAngles."
        )
        require(
            method.dt0 is not None
            and (
                method.controller is None or isinstance(method.controller, diffrax.ConstantStepSize)
            ),
            "has no error estimate: give the longest step, dt0=..., and no controller.",
        )
        require(not record.work, "does not integrate the work: use Extrapolation for work=True.")
        require(
            scene.carrier.is_principal,
            "needs principal body axes: state the body in them (Inertia.principal_axes), wheels"
            " that are not held along them.",
        )
        require(
            scene.torque is None or not _depends_on_rates(scene.torque),
            "moves bodies under torques of attitude and time only; for damping and other torques of"
            " the rates use Extrapolation, or leave the method to the library.",
        )
        require(
            scene.rotors is None or self.moser_veselov is None,
            "with moser_veselov moves bodies without rotors: leave it out.",
        )
        require(
            not scene.dynamics.coupled,
            "moves no wheels with a coupling: use Extrapolation, or leave the method open.",
        )

    def stepping(self, asked: Any) -> Any:
        """How ``ph.LiePoisson`` steps with it: equal steps from each time to the next."""
        steps = EqualSteps(asked.ts, jnp.abs(jnp.asarray(asked.dt0, asked.ts.dtype)))
        return asked.given(self, steps)

    def order(self, terms: PyTree) -> int:
        return min(self.formal_order, self.moser_veselov or self.formal_order)

    def init(self, terms: PyTree, t0: Any, t1: Any, y0: PyTree, args: PyTree) -> Vector:
        """The momentum in space axes: from step to step it passes unrounded."""
        return _rotate(y0[1], y0[0])

    def func(self, terms: PyTree, t0: Any, y0: PyTree, args: PyTree) -> tuple[Vector, Quaternion]:
        return terms.vf(t0, y0, args)

    def step(
        self,
        terms: PyTree,
        t0: Any,
        t1: Any,
        y0: PyTree,
        args: PyTree,
        solver_state: PyTree,
        made_jump: Any,
    ) -> tuple:
        momentum_space = jax.tree.map(
            lambda kept, fresh: jnp.where(made_jump, fresh, kept),
            solver_state,
            _rotate(y0[1], y0[0]),
        )

        def advance(*operands):
            return _advanced(self, *operands)

        problem = BoundTerm.of(terms, args)
        control = problem.control(t0, t1, y0[0][0].dtype)
        # a call of each piece costs as much as the few operations on hardly any body
        whole = self.moser_veselov is None or y0[0][0].size < 8
        state = (kernel(advance) if whole else advance)(
            problem, (t0, t1 - t0), control, (momentum_space, tuple(y0[1]))
        )
        y1 = (_rotate_back(state[1], state[0]), state[1])
        nodes = jax.tree.map(lambda x: x[None], y0)
        dense = collocate(terms, t0, t1, nodes, y1, args, self.order(terms))
        return y1, None, dense, state[0], diffrax.RESULTS.successful


def _depends_on_rates(torque) -> bool:
    one = jnp.ones((1,))

    def push(omega, wxyz):
        slip = torque.slip(jnp.zeros(()), (one,) * 3, omega)
        if slip is not None:
            return slip
        return torque.body_components(jnp.zeros(()), from_quaternion(wxyz), omega)

    with jax.numpy_dtype_promotion("standard"):
        jaxpr = jax.make_jaxpr(push)((one,) * 3, (one,) * 4).jaxpr
    return any(uses(jaxpr, k) for k in range(3))


def _rotate(wxyz, vector):
    """Space components of a vector given in body axes."""
    twice = tuple(2 * x for x in cross(wxyz[1:], vector))
    return tuple(v + (wxyz[0] * a + b) for v, a, b in zip(vector, twice, cross(wxyz[1:], twice)))


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
    turned = (c * x + (w * a + b) for x, a, b in zip(v, axis, cross(axis, v)))
    return (w * c - along, *turned)


def _normalise(wxyz):
    """Takes off what rounding has added to ``|q|``, by one Newton step towards length one."""
    scale = (3 - sum((x * x for x in wxyz[1:]), wxyz[0] * wxyz[0])) / 2
    return tuple(scale * x for x in wxyz)


def _rates(problem: BoundTerm, t, momentum):
    """Body rates dH/dL, read off from the attitude's rate at the identity."""
    zero = jnp.zeros_like(momentum[0])
    _, (_, *half) = problem.field(t, (tuple(momentum), (zero + 1, zero, zero, zero)))
    return [2 * h for h in half]


def _along(axis: int, value: Array) -> list[Array]:
    return [value if i == axis else jnp.zeros_like(value) for i in range(3)]


def _inverse_moments(problem: BoundTerm, t, like: Array) -> tuple[list[Array], Array]:
    """1/I_i, read off from the rates of unit momenta, and which bodies have rates without one.

    NaN where the axes are not principal.
    """
    at_rest = _rates(problem, t, _along(0, jnp.zeros_like(like)))
    inverse, oblique = [], jnp.zeros_like(like)
    for i in range(3):
        rates = [x - y for x, y in zip(_rates(problem, t, _along(i, jnp.ones_like(like))), at_rest)]
        inverse.append(rates.pop(i))
        oblique = jnp.maximum(oblique, jnp.maximum(*(abs(x) for x in rates)) / inverse[i])
    principal = oblique <= jnp.sqrt(jnp.finfo(like.dtype).eps)
    wheels = (at_rest[0] != 0) | (at_rest[1] != 0) | (at_rest[2] != 0)
    return [jnp.where(principal, x, jnp.nan) for x in inverse], wheels


def _advanced(solver: Splitting, problem: BoundTerm, times, control, state):
    """Space momentum and attitude after a step."""
    inverse, wheels = _inverse_moments(problem, times[0], state[0][0])
    if solver.moser_veselov is None:
        move = _rotations(solver.middle, problem, inverse[solver.middle])
    else:
        inverse = [jnp.where(wheels, jnp.nan, x) for x in inverse]
        move = _whole(solver.moser_veselov, inverse)
    return _step(solver.scheme, move, problem, times, control, state)


def _rotations(middle: int, problem: BoundTerm, inverse: Array):
    """The free motion by rotations about the axes, the last ones undone in opposite order."""

    def about(axis):
        @kernel
        def flow(problem, t, inverse, span, momentum, wxyz):
            along = _rotate_back(wxyz, momentum)[axis]
            excess = _rates(problem, t, _along(axis, along))[axis] - inverse * along
            return _turn(wxyz, axis, excess * (span / 2))

        return flow

    turns = [about((middle + 1) % 3), about(middle), about((middle + 2) % 3)]
    spin = kernel(lambda inverse, span, momentum, wxyz: _spin(wxyz, momentum, inverse * span))

    def move(times, spans, momentum, wxyz):
        first, second = spans
        for flow in turns:
            wxyz = flow(problem, times[0], inverse, first, momentum, wxyz)
        wxyz = spin(inverse, first + second, momentum, wxyz)  # time passes with it
        for flow in reversed(turns):
            wxyz = flow(problem, times[1], inverse, second, momentum, wxyz)
        return wxyz

    return move


def _whole(order: int, inverse: list[Array]):
    """The free motion in one step of Moser and Veselov. One unit for all of it would work out the
    shared parts again for each component."""
    prepared = kernel(lambda *inverse: prepare(inverse, order))(*inverse)

    @kernel
    def pace(prepared, span, momentum, wxyz):
        return paced(prepared, span, _rotate_back(wxyz, momentum))

    @kernel
    def turned(wxyz, along, square):
        cosine = 1 / jnp.sqrt(square)
        w, *v = (cosine * x for x in wxyz)
        rest = (x + (w * f + c) for x, f, c in zip(v, along, cross(v, along)))
        return (w - dot(v, along), *rest)

    def move(times, spans, momentum, wxyz):
        angle, inverse = pace(prepared, spans[0] + spans[1], momentum, wxyz)
        return turned(wxyz, *kernel(tangents)(angle, inverse))

    return move


def _step(scheme: Scheme, move, problem: BoundTerm, times, control, state):
    """One step. The momentum is carried in space axes, where only the kick changes it: turned
    with the body, equal steps would round alike and shift a conserved component steadily."""
    t0, width = times
    momentum, wxyz = state

    @kernel
    def torque_of(problem, t, wxyz):
        zero = jnp.zeros_like(wxyz[0])
        return tuple(problem.field(t, ((zero,) * 3, wxyz))[0])

    @kernel
    def push(torque, span, momentum, wxyz):
        return tuple(m + span * n for m, n in zip(momentum, _rotate(wxyz, torque)))

    def kick(problem, t, span, momentum, wxyz):
        return push(torque_of(problem, t, wxyz), span, momentum, wxyz)

    def pair(state, shares):
        """chi, then its adjoint; the kick that ended the pair before is merged into the first."""
        momentum, wxyz = state
        time, after, before, first, second = shares
        times = (t0 + time * width, t0 + after * width)
        momentum = kick(problem, times[0], (before + first) * control, momentum, wxyz)
        return (momentum, move(times, (first * control, second * control), momentum, wxyz)), None

    pairs = np.reshape(scheme.coefficients, (-1, 2))
    after = np.cumsum(pairs.sum(axis=1))
    time = np.concatenate([[0.0], after[:-1]])
    before = np.concatenate([[0.0], pairs[:-1, 1]])
    places = (jnp.asarray(x, jnp.result_type(width)) for x in (time, after))
    weights = (jnp.asarray(x, momentum[0].dtype) for x in (before, pairs[:, 0], pairs[:, 1]))
    (momentum, wxyz), _ = jax.lax.scan(pair, state, (*places, *weights))
    momentum = kick(problem, t0 + width, float(pairs[-1, 1]) * control, momentum, wxyz)
    return momentum, _normalise(wxyz)
