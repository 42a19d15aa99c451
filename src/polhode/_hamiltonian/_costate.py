"""Slopes of a motion carried back along it: the adjoint of the Lie-Poisson chart.

A small change of the state is dL with a small turn eta in body axes, dR = R [eta]x. What belongs to
them, (a, m) with a . dL + m . eta the change of the result, follows from one scalar,

K = a . (L x dH/dL + sum_j r_j x dH/dr_j + N) + m . dH/dL,
da/dt = -dK/dL,   dm/dt = m x dH/dL - (slope of K by a turn eta),

and the slope of the result by a parameter p is the integral of dK/dp. Of the attitude only what H
and N look at moves along. L. S. Pontryagin et al., The Mathematical Theory of Optimal Processes
(1962), chapter 1; on the group: A. A. Agrachev, Y. L. Sachkov, Control Theory from the Geometric
Viewpoint (2004), section 18.2.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from polhode._hamiltonian._attitude import cross, dot, from_quaternion, from_rows
from polhode._hamiltonian._lie_poisson import Dynamics, momentum_rate, quaternion_rate
from polhode._hamiltonian._units import relative

_AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class LiePoissonCostate(NamedTuple):
    """The equations for ``solvers.FlowAdjoint``; ``row``: the only row of R that matters, or None.

    The quaternion's length is taken to be kept: a slope along it is handed back as it came.
    """

    row: int | None

    @classmethod
    def of(cls, dynamics: Dynamics, y, t) -> "LiePoissonCostate":
        """The smallest equations for these dynamics."""
        rows = dynamics.hamiltonian.rows_used(from_quaternion(y[1]), t)
        alone = dynamics.torque is None and len(rows) == 1
        return cls(rows[0] if alone else None)

    def begin(self, y, slopes):
        """State to integrate backwards, from the end and the slopes there: (L, place, a, m)."""
        momentum, wxyz = y
        turn = tuple(_inner(slopes[1], quaternion_rate(wxyz, axis)) for axis in _AXES)
        place = wxyz if self.row is None else from_quaternion(wxyz).row(self.row)
        return tuple(momentum), tuple(place), tuple(slopes[0]), turn

    def rates(self, t, z, dynamics):
        """Rates of this state and K."""
        momentum, place, push, turn = z

        def pairing(momentum, place):
            rate, omega = momentum_rate(t, momentum, self._attitude(place), dynamics)
            k = dot(push, rate) + dot(turn, omega)
            return jnp.sum(k), (rate, omega, k)

        slopes = jax.grad(pairing, argnums=(0, 1), has_aux=True)
        (along, across), (rate, omega, k) = slopes(momentum, place)
        if self.row is None:
            onward = quaternion_rate(place, omega)
            by_turn = tuple(_inner(across, quaternion_rate(place, axis)) for axis in _AXES)
        else:
            onward, by_turn = cross(place, omega), cross(across, place)
        turned = tuple(a - b for a, b in zip(cross(turn, omega), by_turn))
        return (rate, onward, tuple(-x for x in along), turned), k

    def finish(self, z, start, end, slopes):
        """Slopes by the state that the motion started from; ``slopes``: those at its ``end``."""
        _, place, push, turn = z
        wxyz = place if self.row is None else start[1]  # found anew: the start need not be kept
        kept = _inner(slopes[1], end[1])
        wide = quaternion_rate(wxyz, tuple(4 * x for x in turn))
        return push, tuple(a + kept * q for a, q in zip(wide, wxyz))

    def units(self, own, z, rates):
        """Weights of the components of the state integrated backwards, and the natural rate."""
        (momentum, place, push, turn), (torque, onward, *slopes) = z, rates
        still = (place[0],) * (4 - len(place))
        onward = tuple(x / 2 for x in onward) if still else onward  # a row turns by the whole angle
        y = (*momentum, *place, *still)
        moved = (*torque, *onward, *(jnp.zeros_like(x) for x in still))
        weights, rate = own(y, moved)
        if still:  # one row does not see the turn about itself
            rate = rate + jnp.sqrt(dot(momentum, momentum)) / own.size
        scale = weights[3] / 2
        place_weights = [scale if still else weights[3]] * len(place)
        dual = [*(1 / w for w in weights[:3]), *[jnp.ones_like(rate)] * 3]
        own_size = relative(dual, (*push, *turn), (*slopes[0], *slopes[1]), rate)
        return [*weights[:3], *place_weights, *own_size], rate

    def _attitude(self, place):
        return from_quaternion(place) if self.row is None else from_rows({self.row: place})


def _inner(a: Sequence[Array], b: Sequence[Array]) -> Array:
    return sum((x * y for x, y in zip(a[1:], b[1:])), start=a[0] * b[0])
