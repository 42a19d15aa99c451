"""Order and step of the extrapolation from an asked accuracy, by measured errors."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode.solvers._extrapolation import SEQUENCES, Extrapolation

ERROR_CONSTANTS = {8: -8.1, 10: -10.4, 12: -12.9, 14: -15.6, 16: -18.3, 18: -21.0, 20: -23.5}
"""log10 of C in: error of attitude = C x^order (rate horizon), x = rate * step; beyond 650 radians
the last factor grows like a square.

Fitted to the median body of 200 asymmetric and 200 fast Lagrange tops over about 300 to 650
radians (``benchmarks/integrators.py``); the two kinds lie within a factor 10 of the fit.
"""

ROUNDING = {8: 4, 10: 9, 12: 13, 14: 17, 16: 18, 18: 28, 20: 41}
"""Amplification of rounding, sqrt(sum w_j^2 n_j), of each order's columns."""


def _summed(turned, xp):
    """What errors of the steps add up to: beyond the fit, those of the rates turn the body on."""
    return xp.maximum(turned, 1) * xp.maximum(turned / _FITTED, 1)


_FITTED = 650
"""Angle [rad] up to which the errors were fitted."""


class Choice(NamedTuple):
    """What ``choose`` settled on.

    ``solver``: an ``Extrapolation``; ``steps``: steps (diffrax steps times ``substeps``) for each
    body; ``expected``: error that rounding and step let expect for the fastest body [rad].
    """

    solver: Extrapolation
    steps: np.ndarray
    expected: float


def natural_rate(
    momentum: Sequence[Array], inverse_moments: Sequence[Array], torque: Array
) -> Float[Array, "..."]:
    """Rate [rad/s] on whose scale a body's state changes: sqrt(|omega|^2 + 8 N / I_min).

    **Arguments**: body momentum [kg m^2/s] and inverse principal moments as triples of component
    arrays, and a bound on the torque [N m], all of one shape.
    """
    square = sum((m * i) ** 2 for m, i in zip(momentum, inverse_moments))
    stiffest = jnp.maximum(jnp.maximum(*inverse_moments[:2]), inverse_moments[2])
    return jnp.sqrt(square + 8 * torque * stiffest)


def steps_for(order: int, rtol: Array, rate: Array, horizon: Array) -> Float[Array, "..."]:
    """Equal steps (whole, but a float) of ``Extrapolation(order)`` for an error of ``rtol`` [rad].

    The rule of ``choose`` on arrays that may be traced; see there.
    """
    turned = rate * horizon
    constant = 10.0 ** ERROR_CONSTANTS[order]
    step = (rtol / (constant * _summed(turned, jnp))) ** (1 / order)
    return jnp.ceil(jnp.maximum(turned / step, 1))


def choose(
    rtol: float,
    horizon: float,
    rate: np.ndarray | float,
    *,
    interval: float | None = None,
    block: int | None = 128,
    dtype: type = np.float64,
) -> Choice:
    """Order and number of equal steps with least work for an attitude error of ``rtol`` [rad].

    **Arguments**

    - ``horizon``: time to go [s]; ``interval``: longest step allowed, such as the distance of
      the times to record [s].
    - ``rate``: ``natural_rate`` of each body, concrete. The order suits the fastest; ``steps``
      are given for each, so that bodies can be grouped.
    - ``block``: handed to the solver.

    Raises ValueError when ``rtol``, ``horizon`` or a rate is not positive and finite.
    """
    rates = np.asarray(rate, float)
    given = {"rtol": rtol, "horizon": horizon, "rate": rates, "interval": interval or horizon}
    for name, value in given.items():
        if not (np.all(np.isfinite(value)) and np.all(np.asarray(value) > 0)):
            raise ValueError(f"choose: {name} = {value} must be positive and finite.")
    longest = min(interval or horizon, horizon)

    def steps(order, rate):
        constant = 10.0 ** ERROR_CONSTANTS[order]
        x = (rtol / (constant * _summed(rate * horizon, np))) ** (1 / order)
        whole = math.ceil(horizon / longest)
        return whole * np.ceil(np.maximum(rate * horizon / (x * whole), 1)).astype(int)

    def rounding(order, rate):
        """Random errors of the steps, which the phase sums up once more."""
        eps = float(np.finfo(dtype).eps)
        return eps / 32 * ROUNDING[order] * math.sqrt(steps(order, rate)) * max(rate * horizon, 1)

    fastest = float(rates.max())
    # where rounding leaves no room the order that suffers least from it is as good as can be
    floors = {order: rounding(order, fastest) for order in ERROR_CONSTANTS}
    allowed = [o for o in floors if floors[o] <= max(rtol, 4 * min(floors.values()))]
    order = min(allowed, key=lambda o: steps(o, fastest) * (sum(SEQUENCES[o]) - len(SEQUENCES[o])))
    return Choice(Extrapolation(order, block), steps(order, rates), max(rtol, floors[order]))
