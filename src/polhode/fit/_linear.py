"""Residuals and their Jacobian in one pass, kept in the blocks that recordings make of it.

What all recordings share (the tensor, a bias, a drag) fills one block per recording, what is its
own (initial rates and attitude) another: the zeros between them are never computed.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from polhode.fit._matrices import triangle
from polhode.fit._parameters import Parameters, entries_of, whole_of
from polhode.fit._recording import Recording
from polhode.fit._residuals import Model, compared, predict


class Linear(NamedTuple):
    """Residuals (c channels side by side) and what their derivatives amount to.

    ``shared``, ``own``, ``left``: the triangular factor of a recording's derivatives by shared and
    own unknowns and of its residuals, column block by column block. Sums of squares and products
    are those of all samples, so that an optimiser works on a handful of rows. ``at``: the shared
    unknowns of the place.
    """

    rest: Float[Array, "r t c"]
    shared: Float[Array, "r q s"]
    own: Float[Array, "r q o"]
    left: Float[Array, "r q"]
    at: Float[Array, " s"]

    def shifted(self, shared: Float[Array, " s"], own: Float[Array, "r o"]) -> Float[Array, "r q"]:
        """``left`` after small changes of the unknowns, to first order."""
        return (
            self.left
            + jnp.einsum("rqs,s->rq", self.shared, shared)
            + jnp.einsum("rqo,ro->rq", self.own, own)
        )

    def information(self) -> Float[Array, "p p"]:
        """``J^T J`` in the order shared, then own unknowns recording by recording."""
        recordings, size = self.own.shape[0], self.own.shape[-1]
        corner = jnp.einsum("rqs,rqz->sz", self.shared, self.shared)
        side = jnp.einsum("rqs,rqo->sro", self.shared, self.own)
        side = side.reshape(corner.shape[0], recordings * size)
        blocks = jnp.einsum("rqo,rqz->roz", self.own, self.own)
        each = jnp.eye(recordings, dtype=corner.dtype)[:, None, :, None] * blocks[:, :, None, :]
        below = each.reshape(recordings * size, recordings * size)
        return jnp.block([[corner, side], [side.T, below]])


class Unknowns(NamedTuple):
    """The unknowns of a fit as numbers, and the way back.

    ``shared`` (s,): the tensor's entries, bias, mounting, lever, the motion's own, gain and delay;
    ``own`` (r, o): rates, attitude and the walk of the bias of each recording. ``of_motion``,
    ``of_own`` (static): which of them the motion depends on; all others belong to the sensors.
    ``parameters``: those of one recording, and the tensor, of its numbers.
    """

    shared: Float[Array, " s"]
    own: Float[Array, "r o"]
    of_motion: np.ndarray
    of_own: np.ndarray
    parameters: Callable[[Array, Array], tuple[Parameters, Array]]


def unknowns(parameters: Parameters, model: Model) -> Unknowns:
    """See ``Unknowns``. The tensor's entries are regular unknowns for flat bodies too."""
    count = model.entries
    entries = entries_of(model.tensor(parameters), count)
    sensors = (parameters.bias, parameters.mounting, parameters.lever)
    calibration = (parameters.gain, parameters.delay)
    rest, back = ravel_pytree((sensors, parameters.motion, calibration))
    shared = jnp.concatenate([entries, rest.astype(entries.dtype)])
    own = [parameters.omega]
    if parameters.attitude is not None:
        own.append(parameters.attitude)
    moving = sum(part.shape[1] for part in own)
    if parameters.walk is not None:
        own.append(parameters.walk.reshape(parameters.walk.shape[0], -1))
    own = jnp.concatenate(own, axis=1)
    none = jnp.zeros(0, entries.dtype)
    sizes = [
        sum(leaf.size for leaf in jax.tree.leaves(part))
        for part in (sensors, parameters.motion, calibration)
    ]
    of_motion = np.repeat([True, False, True, False], [count, *sizes])
    of_own = np.arange(own.shape[1]) < moving

    def one(shared, own):
        (bias, mounting, lever), motion, (gain, delay) = back(shared[count:])
        attitude = None if parameters.attitude is None else own[None, 3:6]
        walk = None if parameters.walk is None else own[moving:].reshape(1, -1, 3)
        found = Parameters(
            none, own[None, :3], attitude, bias, mounting, lever, motion, gain, delay, walk
        )
        return found, whole_of(shared[:count], count)

    return Unknowns(shared, own, of_motion, of_own, one)


def linearise(
    shared: Array, own: Array, layout: Unknowns, recording: Recording, model: Model
) -> Linear:
    """Residuals and Jacobian of all recordings: the motion appears once in the program.

    ``layout`` gives the order of ``shared`` and ``own``. The motion, which is the expensive part,
    is differentiated by the unknowns that it depends on; those of the sensors act on the motion
    that was predicted, which costs next to nothing for each of them.
    """
    place, own_place = np.flatnonzero(layout.of_motion), np.flatnonzero(layout.of_own)
    other, own_other = np.flatnonzero(~layout.of_motion), np.flatnonzero(~layout.of_own)

    def at(own, single, attitude):
        lone = jax.tree.map(lambda leaf: leaf[None], single)
        start = None if attitude is None else attitude[None]
        here = dataclasses.replace(model, attitude=start)

        def flat(motion, parameters):
            parts = compared(motion, parameters, lone, here)
            return jnp.concatenate([part[0] for part in parts.values()], axis=-1)

        def moved(some, some_own):
            parameters, tensor = layout.parameters(
                shared.at[place].set(some), own.at[own_place].set(some_own)
            )
            motion = predict(parameters, lone, here, tensor)
            rest = flat(motion, parameters)
            return rest, (rest, motion)

        def sensed(some, some_own):
            parameters, _ = layout.parameters(
                shared.at[other].set(some), own.at[own_other].set(some_own)
            )
            return flat(motion, parameters)

        slopes = jax.jacfwd(moved, argnums=(0, 1), has_aux=True)
        (by_shared, by_own), (rest, motion) = slopes(shared[place], own[own_place])
        if other.size or own_other.size:
            also, own_also = jax.jacfwd(sensed, argnums=(0, 1))(shared[other], own[own_other])
            by_shared = jnp.concatenate([by_shared, also], axis=-1)
            by_own = jnp.concatenate([by_own, own_also], axis=-1)
            by_shared = by_shared[..., np.argsort(np.concatenate([place, other]))]
            by_own = by_own[..., np.argsort(np.concatenate([own_place, own_other]))]
        return by_shared, by_own, rest

    by_shared, by_own, rest = jax.vmap(at)(own, recording, model.attitude)
    columns = jnp.concatenate([by_shared, by_own, rest[..., None]], axis=-1)
    columns = columns.reshape(rest.shape[0], -1, columns.shape[-1])
    factor = triangle(columns)
    count = shared.shape[0]
    return Linear(rest, factor[..., :count], factor[..., count:-1], factor[..., -1], shared)
