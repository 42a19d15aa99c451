"""The adjoint equations of the Lie-Poisson coordinates: cotangents integrated backwards.

A variation of the state is dL with a rotation vector eta in body axes, dR = R [eta]x. The costate
(a, m), with a . dL + m . eta the variation of the result, follows from one scalar,

K = a . (L x dH/dL + sum_j r_j x dH/dr_j + N) + m . dH/dL,
da/dt = -dK/dL,   dm/dt = m x dH/dL - (derivative of K by a rotation eta),

and the derivative of the result by a parameter p is the integral of dK/dp. Of the attitude only the
rows that H and N depend on are integrated. L. S. Pontryagin et al., The Mathematical Theory of
Optimal Processes (1962), chapter 1; on the group: A. A. Agrachev, Y. L. Sachkov, Control Theory
from the Geometric Viewpoint (2004), section 18.2.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from polhode._hamiltonian._energy import cross, dot, from_quaternion, from_rows
from polhode._hamiltonian._lie_poisson import Dynamics, momentum_rate, quaternion_rate, relative

_AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class LiePoissonCostate(NamedTuple):
    """The equations for ``ph.FlowAdjoint``; ``row``: the only row of R that matters, or None.

    The motion conserves the quaternion's length: a cotangent along it is returned unchanged.
    """

    row: int | None

    @classmethod
    def of(cls, dynamics: Dynamics, y, t) -> "LiePoissonCostate":
        """The smallest equations for these dynamics."""
        rows = dynamics.hamiltonian.rows_used(from_quaternion(y[1]), t)
        one_row = dynamics.torque is None and len(rows) == 1
        return cls(rows[0] if one_row else None)

    def begin(self, y, cotangents):
        """State to integrate backwards, (L, attitude, a, m), of the end and its cotangents."""
        momentum, wxyz = y
        turn = tuple(_inner(cotangents[1], quaternion_rate(wxyz, axis)) for axis in _AXES)
        place = wxyz if self.row is None else from_quaternion(wxyz).row(self.row)
        return tuple(momentum), tuple(place), tuple(cotangents[0]), turn

    def rates(self, t, z, dynamics):
        """Rates of this state and K."""
        momentum, place, by_momentum, turn = z

        def pairing(momentum, place):
            rate, omega = momentum_rate(t, momentum, self._attitude(place), dynamics)
            k = dot(by_momentum, rate) + dot(turn, omega)
            return jnp.sum(k), (rate, omega, k)

        cotangents = jax.grad(pairing, argnums=(0, 1), has_aux=True)
        (by_L, by_place), (rate, omega, k) = cotangents(momentum, place)
        if self.row is None:
            place_rate = quaternion_rate(place, omega)
            energy_by_turn = tuple(_inner(by_place, quaternion_rate(place, axis)) for axis in _AXES)
        else:
            place_rate, energy_by_turn = cross(place, omega), cross(by_place, place)
        turn_rate = tuple(a - b for a, b in zip(cross(turn, omega), energy_by_turn))
        return (rate, place_rate, tuple(-x for x in by_L), turn_rate), k

    def finish(self, z, start, end, cotangents):
        """Cotangents of the initial state; ``cotangents``: those of the state at its ``end``."""
        _, place, by_momentum, turn = z
        wxyz = place if self.row is None else start[1]  # not integrated back: the start is known
        along_wxyz = _inner(cotangents[1], end[1])
        by_wxyz = quaternion_rate(wxyz, tuple(4 * x for x in turn))
        return by_momentum, tuple(a + along_wxyz * q for a, q in zip(by_wxyz, wxyz))

    def units(self, weights_of_state, z, rates):
        """Weights of the components of the state integrated backwards, and the natural rate."""
        (momentum, place, by_momentum, turn), (momentum_rates, place_rate, *cotangents) = z, rates
        padding = (place[0],) * (4 - len(place))
        if padding:  # a row turns by the whole angle, a quaternion by half of it
            place_rate = tuple(x / 2 for x in place_rate)
        y = (*momentum, *place, *padding)
        state_rates = (*momentum_rates, *place_rate, *(jnp.zeros_like(x) for x in padding))
        weights, rate = weights_of_state(y, state_rates)
        if padding:  # one row does not change by a rotation about itself
            rate = rate + jnp.sqrt(dot(momentum, momentum)) / weights_of_state.size
        scale = weights[3] / 2
        place_weights = [scale if padding else weights[3]] * len(place)
        dual = [*(1 / w for w in weights[:3]), *[jnp.ones_like(rate)] * 3]
        dual_weights = relative(dual, (*by_momentum, *turn), (*cotangents[0], *cotangents[1]), rate)
        return [*weights[:3], *place_weights, *dual_weights], rate

    def _attitude(self, place):
        return from_quaternion(place) if self.row is None else from_rows({self.row: place})


def _inner(a: Sequence[Array], b: Sequence[Array]) -> Array:
    return sum((x * y for x, y in zip(a[1:], b[1:])), start=a[0] * b[0])
