"""Residuals and their Jacobian in one pass, kept in the blocks that recordings make of it.

What all recordings share (the tensor, a bias, a drag) fills one block per recording, what is its
own (initial rates and attitude) another: the zeros between them are never computed.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from polhode.fit._matrices import triangle
from polhode.fit._parameters import Parameters, entries_of, whole_of
from polhode.fit._recording import Recording
from polhode.fit._residuals import Model, residuals


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


def unknowns(parameters: Parameters, model: Model) -> tuple[Array, Array, Callable]:
    """Shared (s,) and own (r, o) unknowns as numbers, and the way back for one recording.

    Shared: the tensor's entries, then bias, mounting, lever and the motion's own; own: rates, then
    attitude. The tensor's entries are regular unknowns for flat bodies too.
    """
    count = model.entries
    entries = entries_of(model.tensor(parameters), count)
    common = (parameters.bias, parameters.mounting, parameters.lever, parameters.motion)
    rest, back = ravel_pytree(common)
    shared = jnp.concatenate([entries, rest.astype(entries.dtype)])
    own = parameters.omega
    if parameters.attitude is not None:
        own = jnp.concatenate([own, parameters.attitude], axis=1)
    none = jnp.zeros(0, entries.dtype)

    def one(shared, own):
        bias, mounting, lever, motion = back(shared[count:])
        attitude = None if parameters.attitude is None else own[None, 3:]
        found = Parameters(none, own[None, :3], attitude, bias, mounting, lever, motion)
        return found, whole_of(shared[:count], count)

    return shared, own, one


def linearise(
    shared: Array, own: Array, one: Callable, recording: Recording, model: Model
) -> Linear:
    """Residuals and Jacobian of all recordings: the motion appears once in the program."""

    def misfit(shared, own, single, attitude):
        parameters, tensor = one(shared, own)
        lone = jax.tree.map(lambda leaf: leaf[None], single)
        start = None if attitude is None else attitude[None]
        parts = residuals(parameters, lone, dataclasses.replace(model, attitude=start), tensor)
        rest = jnp.concatenate([part[0] for part in parts.values()], axis=-1)
        return rest, rest

    slopes = jax.jacfwd(misfit, argnums=(0, 1), has_aux=True)
    (by_shared, by_own), rest = jax.vmap(slopes, in_axes=(None, 0, 0, 0))(
        shared, own, recording, model.attitude
    )
    columns = jnp.concatenate([by_shared, by_own, rest[..., None]], axis=-1)
    columns = columns.reshape(rest.shape[0], -1, columns.shape[-1])
    factor = triangle(columns)
    count = shared.shape[0]
    return Linear(rest, factor[..., :count], factor[..., count:-1], factor[..., -1], shared)
