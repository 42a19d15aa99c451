"""Torques that act for a while: thrusters and their like, whose edges no step misses."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode._checks import ArrayLike, as_float_array, is_concrete, require
from polhode._hamiltonian import Attitude, Vector, triple
from polhode._parts import shaped
from polhode._scene._torques import AbstractTorque


class Pulses(AbstractTorque):
    """A torque that acts from each of ``starts`` to the corresponding one of ``ends``.

    **Arguments:** ``torque``: the torque during the pulses, such as ``ph.BodyTorque``; ``starts``,
    ``ends`` (k,) [s]: shared by all bodies, each end after its start. Steps end at every edge, so
    that no pulse is missed however short, and derivatives by starts and ends are exact. Pulses that
    overlap act once. A motion with k pulses is solved in 2 k + 1 parts.

        burn = ph.Pulses(ph.BodyTorque([0.0, 0.0, 2.0]), [1.0, 5.0], [1.05, 5.001])
        scene = ph.Scene(ph.Inertia.from_moments([1.0, 1.5, 2.0]), torque=burn)
        state = ph.State([1.0, 0, 0, 0], [0.0, 0.0, 0.0])
        ph.simulate(scene, state, [0.0, 9.0]).omega_body[-1]     # (0, 0, 0.051)

    Raises TypeError unless it is a torque, ValueError for ends before starts or other shapes.
    """

    starts: Float[Array, " k"]
    ends: Float[Array, " k"]
    on: Array | None
    torque: AbstractTorque = shaped()

    def __init__(self, torque: AbstractTorque, starts: ArrayLike, ends: ArrayLike):
        if not isinstance(torque, AbstractTorque):
            raise TypeError(
                "Pulses takes a torque such as ph.BodyTorque([0., 0., 1.]), got"
                f" {type(torque).__name__}."
            )
        self.torque, self.on = torque, None
        self.starts, self.ends = (
            jnp.atleast_1d(as_float_array(f"Pulses {name}", x))
            for name, x in (("starts", starts), ("ends", ends))
        )
        if self.starts.ndim != 1 or self.starts.shape != self.ends.shape:
            raise ValueError(
                "Pulses starts and ends must be two lists of times of one length, got shapes"
                f" {self.starts.shape} and {self.ends.shape}; all bodies share them."
            )
        if is_concrete(self.starts, self.ends):
            require(
                np.asarray(self.ends) > np.asarray(self.starts),
                f"each pulse must end after it starts, got {starts} and {ends}.",
            )

    @property
    def edges(self) -> Array | None:
        inner = self.torque.edges
        own = [self.starts, self.ends] + ([] if inner is None else [inner])
        return jnp.concatenate(own)

    def during(self, t: Array | float) -> AbstractTorque:
        inner = eqx.tree_at(lambda p: p.torque, self, self.torque.during(t))
        return eqx.tree_at(lambda p: p.on, inner, self._acts(t), is_leaf=lambda x: x is None)

    def _acts(self, t: Array | float) -> Array:
        """Whether a pulse acts at the times ``t`` (...): 1 or 0."""
        if self.on is not None:
            return self.on
        t = jnp.asarray(t, self.starts.dtype)
        starts, ends = (x.reshape((1,) * t.ndim + x.shape) for x in (self.starts, self.ends))
        among = (starts <= t[..., None]) & (t[..., None] < ends)
        return jnp.where(jnp.any(among, axis=-1), 1, 0).astype(self.starts.dtype)

    def body_components(
        self, t: Array | float, attitude: Attitude, omega: Sequence[Array]
    ) -> tuple[Array, Array, Array]:
        on = self._acts(t)
        return triple(on * x for x in self.torque.body_components(t, attitude, omega))

    def slip(
        self, t: Array | float, momentum: Sequence[Array], omega: Sequence[Array]
    ) -> Vector | None:
        found = self.torque.slip(t, momentum, omega)
        return None if found is None else triple(self._acts(t) * x for x in found)
