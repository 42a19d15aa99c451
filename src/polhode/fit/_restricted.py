"""Noise that is found beside a body: by restricted likelihood, and what not knowing it costs.

A body that is found from readings bends to their noise, and the scatter that is left is too small:
the likelihood alone makes the noise of a single throw too little. The restricted likelihood counts
the directions that are used up, by half the log-determinant of the information about all but the
noise (Patterson and Thompson, Biometrika 58 (1971) 545). What the uncertainty of the noise adds to
the covariances of the rest is to first order that of Kackar and Harville (J. Am. Stat. Assoc. 79
(1984) 853): for a single scale found from n residuals, ``1 + 2 / n`` as in Student's distribution.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from polhode.fit._matrices import inverse


class Places(NamedTuple):
    """Among all u unknowns: ``loud`` says which are the noise's; ``rest`` (r, p) and ``noise``
    (r, m) where those of a recording stand that are not, and that are."""

    loud: Bool[np.ndarray, " u"]
    rest: Int[Array, "r p"]
    noise: Int[Array, "r m"]


def _were_it_known(information: Float[Array, "u u"], places: Places) -> Float[Array, "u u"]:
    """Covariance of all but the noise, were that known; nothing in the places of the noise."""
    loud = jnp.asarray(places.loud, information.dtype)
    quiet = (1 - loud) * (1 - loud)[:, None]
    return quiet * inverse(quiet * information + jnp.diag(loud))


def used_up(
    information: Float[Array, "u u"], bends: Float[Array, "r p p m"], places: Places
) -> Float[Array, " u"]:
    """Slopes of half the log-determinant of the information about all but the noise.

    ``bends``: slopes by a recording's noise of what it tells about all else.
    """
    covariance = _were_it_known(information, places)
    covariance = covariance[places.rest[:, :, None], places.rest[:, None, :]]
    found = jnp.einsum("rpq,rpqm->rm", covariance, bends) / 2
    return jnp.zeros_like(information[0]).at[places.noise].add(found)


def unsure(
    information: Float[Array, "u u"],
    bends: Float[Array, "r p p m"],
    places: Places,
    bodies: Int[Array, "n k"],
) -> Float[Array, "n k k"]:
    """What not knowing the noise adds to the covariances of the unknowns in places ``bodies``."""
    covariance = _were_it_known(information, places)
    louds = np.flatnonzero(places.loud)
    number = jnp.zeros(places.loud.size, int).at[louds].set(np.arange(louds.size))
    slopes = jnp.zeros((*information.shape, louds.size), information.dtype)
    rows, columns = places.rest[:, :, None, None], places.rest[:, None, :, None]
    slopes = slopes.at[rows, columns, number[places.noise][:, None, None]].add(bends)
    turned = jnp.einsum("up,pqm->uqm", covariance, slopes)
    # the scatter that is left tells the noise, not what was used up
    shown = information[louds[:, None], louds] - jnp.einsum("uqm,qun->mn", turned, turned) / 2
    noise = inverse(shown)
    moved = -jnp.einsum("uqm,qv->uvm", turned, covariance)

    def one(body):
        part = moved[body[:, None], body[None]]
        weight = inverse(covariance[body[:, None], body[None]])
        return jnp.einsum("mn,abm,bc,cdn->ad", noise, part, weight, part)

    return jax.vmap(one)(bodies)
