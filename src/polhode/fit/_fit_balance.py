"""``fit_balance``: inertia from throws in real air, in absolute size with a wheel aboard."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode._checks import is_concrete, require
from polhode.fit._balance import Known, solve_balance, start_of
from polhode.fit._compiled import compiled
from polhode.fit._filter import Noise, readings_of
from polhode.fit._instrument import Instrument, Tolerance
from polhode.fit._parameters import entries_of, whole_of
from polhode.fit._recording import Recording, needed, stack
from polhode.fit._result import FitError, turn_std
from polhode.inertia import Inertia, principal


class BalanceFit(eqx.Module):
    """Result of ``fit_balance``, bodies on the leading axis n.

    **Fields:** ``inertia``: tensors in sensor axes about the centre of mass, the wheel locked,
    kg m^2; without a wheel only their shape shows, and the largest moment is 1; ``moments``
    (n, 3), ascending, and ``axes`` (n, 4), ``wxyz`` principal -> sensor axes, with standard
    deviations ``moments_std`` and ``axes_std`` (n, 3), rad, about each principal axis;
    ``covariance`` (n, 6, 6) of xx, yy, zz, yz, zx, xy; ``drag`` (n, 2): torque over rate, N m s,
    and over rate times speed, N m s^2; ``instrument`` as it was found; ``noise`` found;
    ``residuals`` (r, b, 3), of the rates expected from the readings before, over their standard
    deviations ``residuals_std``, rad/s; ``surprise``: minus the logarithm of the likelihood, but
    for a constant; ``steps`` made; ``converged``.
    """

    inertia: Inertia
    moments: Float[Array, "n 3"]
    axes: Float[Array, "n 4"]
    moments_std: Float[Array, "n 3"]
    axes_std: Float[Array, "n 3"]
    covariance: Float[Array, "n 6 6"]
    drag: Float[Array, "n 2"]
    instrument: Instrument
    noise: Noise
    residuals: Float[Array, "r b 3"]
    residuals_std: Float[Array, "r b 3"]
    surprise: Float[Array, " *n"]
    steps: Array
    converged: Array
    block: int = eqx.field(static=True)

    def each(self, recordings: Sequence[Recording], body: int = 0) -> "BalanceFit":
        """Every recording of a body by itself, with this instrument and the noise of that body."""
        noise = Noise(*(x[body] if jnp.ndim(x) else x for x in self.noise))
        tensor = self.inertia.tensor[body]
        given = stack(recordings)
        found = [
            _alone(
                jax.tree.map(lambda x, k=k: x[k : k + 1], given),
                self.instrument, noise, tensor, self.block,
            )
            for k in range(len(recordings))
        ]  # fmt: skip
        joined = jax.tree.map(lambda *x: jnp.concatenate([jnp.atleast_1d(y) for y in x]), *found)
        return eqx.tree_at(
            lambda fit: (fit.instrument, fit.noise), joined, (self.instrument, noise)
        )


def fit_balance(
    recordings: Sequence[Recording],
    instrument: Instrument,
    *,
    bodies: Sequence[int] | None = None,
    tolerance: Tolerance | None = None,
    block: int = 1,
    throw: bool = True,
) -> BalanceFit:
    """Inertia tensors by the balance of angular momentum: the likeliest, and how sure they are.

    For throws in air, with a wheel of measured speed or without one (``Instrument(None)``: then
    the ratios of the moments show, not their size). The gyroscope turns the frame in which
    ``I omega + h`` is followed; drag, white torques and a torque with memory move it, by as much as
    the data say. The rates read are compared with those expected (``polhode.fit._filter``): their
    noise does not bias the moments, not even of a single short throw that hardly shows them.

    **Arguments:** ``recordings``: with rates and, for a wheel, ``wheel_speed``, of free flight only
    (leave the hands out); NaN where a reading is not to be believed: the speed of a motor just
    switched on, say, without which the balance does as well. ``instrument``: as the data sheet has
    it; ``tolerance``: how far it may be off, fitted to all recordings together (None: as given).
    ``bodies``: number of the body that each recording shows, from 0 on (None: one body).
    ``block``: how many samples give one residual: so many that their noise is white. Readings much
    faster than the motion are best ``averaged`` first.

    Noise, drag and instrument are found together with the tensors. Every tensor is physical. Raises
    ValueError for recordings without rates or the wheel's speed, and FitError when a fit is not
    finite or did not converge, unless ``throw=False``.
    """
    given = stack(recordings)
    wheel = instrument.spin_inertia is not None
    require(given.omega is not None, "a balance needs omega_body in every recording.")
    require(
        (given.wheel is not None) == wheel,
        "an instrument with a wheel needs wheel_speed in every recording."
        if wheel
        else "recordings with wheel_speed need the wheel's spin_inertia in the instrument.",
    )
    numbers = np.zeros(len(recordings), int) if bodies is None else np.asarray(bodies)
    count = int(numbers.max()) + 1
    require(
        numbers.shape == (len(recordings),) and set(numbers.tolist()) == set(range(count)),
        f"bodies must number the body of each of {len(recordings)} recordings from 0 on without "
        f"leaving one out, got {numbers.tolist()}.",
    )
    require(is_concrete(given.times), "fit_balance takes arrays, not traced values.")
    present = np.asarray(given.present) > 0
    if wheel:
        present = present & (np.asarray(needed("wheel_known", given.wheel_known)) > 0)
    require(
        present.sum(axis=1) >= 8,
        "each recording needs at least 8 samples with rates and wheel, got "
        f"{present.sum(axis=1).min()}.",
    )
    found = _together(given, jnp.asarray(numbers), instrument, tolerance, count, block)
    if throw and not bool(found.converged & jnp.all(jnp.isfinite(found.covariance))):
        raise FitError(
            "the balance of momentum did not converge or is not finite: look for recordings with "
            "samples outside free flight, wrong units or signs of the wheel, or too little "
            "rotation; pass throw=False to get the result as it is."
        )
    return found


@compiled
def _together(recording, numbers, instrument, tolerance, count, block):
    data = readings_of(recording, numbers, block)
    sigma, noise = start_of(data, instrument, count)
    known = Known(sigma, instrument, tolerance or Tolerance(), noise)
    return _concluded(solve_balance(data, known, "instrument" if tolerance else "noise"), block)


@compiled
def _alone(recording, instrument, noise, tensor, block):
    sigma = (jnp.trace(tensor) / 2 * jnp.eye(3, dtype=tensor.dtype) - tensor)[None]
    data = readings_of(recording, jnp.zeros(1, int), block)
    noise = Noise(*(x[None] for x in noise[:5]), *noise[5:])
    return _concluded(
        solve_balance(data, Known(sigma, instrument, Tolerance(), noise), "tensor"), block
    )


def _concluded(found, block) -> BalanceFit:
    sized = found.instrument.spin_inertia is not None

    def one(tensor, covariance):
        moments, axes, _ = principal(tensor)

        def derived(entries):
            values, _, products = principal(whole_of(entries))
            every = jnp.concatenate([values, products, entries])
            return every if sized else every / values[2]

        slope = jax.jacfwd(derived)(entries_of(tensor))
        covariance = slope @ covariance @ slope.T
        spread = jnp.sqrt(jnp.maximum(jnp.diagonal(covariance)[:6], 0))
        size = jnp.ones_like(moments[2]) if sized else moments[2]
        tensor, moments = tensor / size, moments / size
        turn = turn_std(moments, spread[3:])
        return tensor, moments, axes, spread[:3], turn, covariance[6:, 6:], size

    tensors, moments, axes, spread, turn, covariance, size = jax.vmap(one)(
        found.tensors, found.covariance
    )
    return BalanceFit(
        Inertia(full=tensors), moments, axes, spread, turn, covariance, found.drag / size[:, None],
        found.instrument, found.noise.grown(1 / size), found.rest, found.spread, found.surprise,
        found.steps, found.converged, block,
    )  # fmt: skip
