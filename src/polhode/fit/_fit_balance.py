"""``fit_balance``: inertia in absolute size from throws with a wheel aboard, in real air."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode._checks import is_concrete, require
from polhode.fit._balance import Noise, balance_of, solve_balance, start_of
from polhode.fit._compiled import compiled
from polhode.fit._fit import FitError
from polhode.fit._instrument import Instrument, Tolerance
from polhode.fit._linear import entries_of, whole_of
from polhode.fit._recording import Recording, needed, stack
from polhode.inertia import Inertia, principal


class BalanceFit(eqx.Module):
    """Result of ``fit_balance``, bodies on the leading axis n.

    **Fields:** ``inertia``: tensors in sensor axes about the centre of mass, the wheel locked,
    kg m^2; ``moments`` (n, 3), ascending, and ``axes`` (n, 4), ``wxyz`` principal -> sensor axes,
    with standard deviations ``moments_std`` and ``axes_std`` (n, 3), rad, about each principal
    axis;
    ``covariance`` (n, 6, 6) of xx, yy, zz, yz, zx, xy; ``instrument`` as it was found; ``noise``
    found of the balance (``omega``, rad/s) and of the torque (``torque``, N m s^(1/2)) per body;
    ``residuals`` (r, t, 3) over their noise; ``converged``.
    """

    inertia: Inertia
    moments: Float[Array, "n 3"]
    axes: Float[Array, "n 4"]
    moments_std: Float[Array, "n 3"]
    axes_std: Float[Array, "n 3"]
    covariance: Float[Array, "n 6 6"]
    instrument: Instrument
    noise: Noise
    residuals: Float[Array, "r t 3"]
    converged: Array
    knots: int = eqx.field(static=True)
    block: int = eqx.field(static=True)

    def each(self, recordings: Sequence[Recording], body: int = 0) -> "BalanceFit":
        """Every recording of a body by itself, with this instrument and the noise of that body."""
        noise = Noise(self.noise.omega[body], self.noise.torque[body])
        tensor = self.inertia.tensor[body]
        given = stack(recordings)
        found = [
            _alone(
                jax.tree.map(lambda x, k=k: x[k : k + 1], given),
                self.instrument, noise, tensor, self.knots, self.block,
            )
            for k in range(len(recordings))
        ]  # fmt: skip
        joined = jax.tree.map(lambda *x: jnp.concatenate([jnp.atleast_1d(y) for y in x]), *found)
        return eqx.tree_at(lambda fit: fit.instrument, joined, self.instrument)


def fit_balance(
    recordings: Sequence[Recording],
    instrument: Instrument,
    *,
    bodies: Sequence[int] | None = None,
    tolerance: Tolerance | None = None,
    knot: float = 0.02,
    block: int = 1,
    throw: bool = True,
) -> BalanceFit:
    """Inertia tensors by the balance of angular momentum, the gyroscope turning the frame itself.

    For throws in air with a wheel of measured speed. ``I omega + h - R^T L = 0`` with the attitude
    R integrated from the rates; L, constant in space without torques, wanders as Brownian motion
    between knots ``knot`` seconds apart, by as much as the data say. Nothing need be known of the
    drag, and errors do not build up along the flight as those of a simulated one do.

    **Arguments:** ``recordings``: with rates and ``wheel_speed``, of free flight only (leave the
    hands out); NaN where a reading is not to be believed: the speed of a motor just switched on,
    say, without which the balance does as well. ``instrument``: as the data sheet has it;
    ``tolerance``: how far it may be off, fitted to all recordings together (None: taken as given).
    ``bodies``: number of the body that each recording shows, from 0 on (None: one body).
    ``block``: how many samples give one residual: so many that their noise is white. Readings much
    faster than the motion are best ``averaged`` first.

    The noise is found by maximum evidence (MacKay, Neural Computation 4 (1992) 415). Every tensor
    is physical. Raises ValueError for recordings without rates or wheel, and FitError when a fit is
    not finite or did not converge, unless ``throw=False``.
    """
    given = stack(recordings)
    require(
        given.omega is not None and given.wheel is not None,
        "a balance needs omega_body and wheel_speed in every recording.",
    )
    numbers = np.zeros(len(recordings), int) if bodies is None else np.asarray(bodies)
    count = int(numbers.max()) + 1
    require(
        numbers.shape == (len(recordings),) and set(numbers.tolist()) == set(range(count)),
        f"bodies must number the body of each of {len(recordings)} recordings from 0 on without "
        f"leaving one out, got {numbers.tolist()}.",
    )
    require(is_concrete(given.times) and knot > 0, "fit_balance takes arrays, not traced values.")
    present = np.asarray(given.present * needed("wheel_known", given.wheel_known)) > 0
    require(
        present.sum(axis=1) >= 8,
        "each recording needs at least 8 samples with rates and wheel, got "
        f"{present.sum(axis=1).min()}.",
    )
    times = np.asarray(given.times)
    span = max(float(t[p][-1] - t[0]) for t, p in zip(times, present, strict=True))
    knots = max(round(span / knot), 1) + 1
    free = tolerance is not None
    found = _together(
        given, jnp.asarray(numbers), instrument, tolerance or Tolerance(), count, knots, block, free
    )
    if throw and not bool(found.converged & jnp.all(jnp.isfinite(found.covariance))):
        raise FitError(
            "the balance of momentum did not converge or is not finite: look for recordings with "
            "samples outside free flight, wrong units or signs of the wheel, or too little "
            "rotation; pass throw=False to get the result as it is."
        )
    return found


@compiled
def _together(recording, numbers, instrument, tolerance, count, knots, block, free):
    data = balance_of(recording, numbers, knots, block)
    start, noise = start_of(data, instrument, count)
    found = solve_balance(data, start, instrument, tolerance, noise, free)
    return _concluded(found, knots, block)


@compiled
def _alone(recording, instrument, noise, tensor, knots, block):
    start = (jnp.trace(tensor) / 2 * jnp.eye(3, dtype=tensor.dtype) - tensor)[None]
    data = balance_of(recording, jnp.zeros(1, int), knots, block)
    noise = jax.tree.map(lambda x: x[None], noise)
    found = solve_balance(data, start, instrument, Tolerance(), noise, False)
    return _concluded(found, knots, block)


def _concluded(found, knots, block) -> BalanceFit:
    def one(tensor, covariance):
        moments, axes, _ = principal(tensor)

        def derived(entries):
            values, _, products = principal(whole_of(entries, 6))
            return jnp.concatenate([values, products])

        slope = jax.jacfwd(derived)(entries_of(tensor, 6))
        spread = jnp.sqrt(jnp.maximum(jnp.sum((slope @ covariance) * slope, axis=1), 0))
        gaps = jnp.stack(
            [moments[2] - moments[1], moments[2] - moments[0], moments[1] - moments[0]]
        )
        turn = jnp.where(gaps > 0, spread[3:] / jnp.where(gaps > 0, gaps, 1), jnp.inf)
        return moments, axes, spread[:3], turn

    moments, axes, spread, turn = jax.vmap(one)(found.tensors, found.covariance)
    return BalanceFit(
        Inertia(full=found.tensors), moments, axes, spread, turn, found.covariance,
        found.instrument, found.noise, found.rest, found.converged, knots, block,
    )  # fmt: skip
