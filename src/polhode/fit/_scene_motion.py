"""The motion of any scene as the model of a fit: known torques, rotors, potentials, damping."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode._integrate import LiePoisson
from polhode._method import AbstractMethod
from polhode._scene import Scene, State
from polhode._simulate import simulate
from polhode.fit._motion import AbstractMotion, Predicted
from polhode.inertia import Inertia


def simulated(
    scene: Scene,
    omega: Float[Array, " 3"],
    wxyz: Float[Array, " 4"] | None,
    times: Float[Array, " t"],
    method: AbstractMethod | None,
    rtol: float | None,
    attitude: Float[Array, " 4"] | None = None,
) -> Predicted:
    """The motion by ``ph.simulate``; without ``wxyz`` from ``attitude``, or from the space axes."""
    axes = jnp.asarray([1, 0, 0, 0])
    start = next(x for x in (wxyz, attitude, axes) if x is not None).astype(omega.dtype)
    found = simulate(scene, State(start, omega), times, method, rtol=rtol, throw=False)
    return Predicted(found.omega_body, None, None if wxyz is None else found.wxyz)


class SceneMotion(AbstractMotion):
    """Motion of the scene ``build(inertia, unknown)``, by ``ph.simulate``.

    **Fields:** ``build`` makes a ``ph.Scene`` of an inertia and the motion's own unknowns;
    ``unknown``: a pytree of their starting values, not zero where their size matters (it sets the
    optimiser's unit), or None; ``shows_scale``: whether rates depend on the absolute size of the
    inertia, true for known torques, rotors with known momentum and potentials; ``method``: one
    that forward derivatives pass, by default steps of LiePoisson; ``rtol`` as in ``ph.simulate``.

    A scene whose forces depend on the attitude needs attitudes in the recording, or starts from
    the space axes. Accelerometer readings are not modelled.
    """

    build: Callable[[Inertia, Any], Scene] = eqx.field(static=True)
    unknown: Any = None
    shows_scale: bool = eqx.field(static=True, default=True)
    method: AbstractMethod = LiePoisson()
    rtol: float | None = eqx.field(static=True, default=None)

    def start(self) -> Any:
        return self.unknown

    def fixes_scale(self) -> bool:
        return self.shows_scale

    def __call__(
        self,
        tensor: Float[Array, "3 3"],
        omega: Float[Array, " 3"],
        wxyz: Float[Array, " 4"] | None,
        times: Float[Array, " t"],
        wheel: Float[Array, " t"] | None,
        unknown: Any,
    ) -> Predicted:
        scene = self.build(Inertia(full=tensor), unknown)
        return simulated(scene, omega, wxyz, times, self.method, self.rtol)


def _inside(number: Array, start: Array, low: Array, high: Array) -> Array:
    """A value between its bounds; any number may be given, and an inner one hardly changes.

    At one bound the smooth maximum ``low + (d + sqrt(d^2 + s^2)) / 2``, at two a sigmoid.
    """
    half, middle = (high - low) / 2, (high + low) / 2
    both = jnp.isfinite(half)
    half, middle = jnp.where(both, half, 1), jnp.where(both, middle, 0)
    y = (number - middle) / half
    between = middle + half * y / jnp.sqrt(1 + y**2)
    # one bound: the distance from it, mirrored for an upper one
    some = jnp.isfinite(low) | jnp.isfinite(high)
    side = jnp.where(jnp.isfinite(low), 1, -1)
    end = jnp.where(jnp.isfinite(low), low, jnp.where(jnp.isfinite(high), high, 0))
    # any positive number where there is no bound, for finite derivatives of what is not chosen
    soft = jnp.where(some, jnp.abs(start - end), 1)
    d = side * (number - end)
    root = jnp.sqrt(d**2 + soft**2)
    # without cancellation far beyond the bound
    beyond = jnp.where(d > 0, (d + root) / 2, soft**2 / (2 * (root - jnp.where(d > 0, 0, d))))
    return jnp.where(both, between, jnp.where(some, end + side * beyond, number))


def _outside(value: Array, start: Array, low: Array, high: Array) -> Array:
    """The inverse of ``_inside``."""
    half, middle = (high - low) / 2, (high + low) / 2
    both = jnp.isfinite(half)
    half, middle = jnp.where(both, half, 1), jnp.where(both, middle, 0)
    y = jnp.where(both, (value - middle) / half, 0)
    between = middle + half * y / jnp.sqrt(1 - y**2)
    side = jnp.where(jnp.isfinite(low), 1, -1)
    some = jnp.isfinite(low) | jnp.isfinite(high)
    end = jnp.where(jnp.isfinite(low), low, jnp.where(jnp.isfinite(high), high, 0))
    d = jnp.where(some, side * (value - end), 1)
    beyond = end + side * (d - (start - end) ** 2 / (4 * d))
    return jnp.where(both, between, jnp.where(some, beyond, value))


class LeafMotion(AbstractMotion):
    """Motion of a scene some of whose arrays are unknown, by ``ph.simulate``.

    **Fields:** ``scene``, with the starting values; ``places`` (static): which of its leaves are
    unknown; ``bounds``: lower and upper ends of each, infinite where there is none, or None;
    ``widths``: standard deviations of normal priors about the start; ``attitude`` (4,): initial one
    for recordings without attitudes; ``method`` and
    ``rtol`` as in ``ph.simulate``.
    """

    scene: Scene
    places: tuple[int, ...] = eqx.field(static=True)
    attitude: Float[Array, " 4"] | None = None
    method: AbstractMethod | None = None
    rtol: float | None = eqx.field(static=True, default=None)
    bounds: tuple[tuple[Array, Array] | None, ...] | None = None
    widths: tuple[Array | None, ...] | None = None

    def bounded(self, unknown: list[Array]) -> list[Array]:
        if self.bounds is None:
            return unknown
        pairs = zip(unknown, self.start(), self.bounds, strict=True)
        return [x if ends is None else _inside(x, at, *ends) for x, at, ends in pairs]

    def unbounded(self, values: list[Array]) -> list[Array]:
        if self.bounds is None:
            return values
        pairs = zip(values, self.start(), self.bounds, strict=True)
        return [x if ends is None else _outside(x, at, *ends) for x, at, ends in pairs]

    def prior_std(self) -> list[Array | None]:
        return super().prior_std() if self.widths is None else list(self.widths)

    def at_bound(self, values: list[Array]) -> Array:
        """Whether a value has come within a thousandth of the start's distance to a bound."""
        near = jnp.asarray(False)
        for x, at, ends in zip(values, self.start(), self.bounds or (), strict=False):
            for end in ends or ():
                near = near | jnp.any(jnp.abs(x - end) < 1e-3 * jnp.abs(at - end))
        return near

    def start(self) -> list[Array]:
        leaves = jax.tree.leaves(self.scene)
        return [leaves[i] for i in self.places]

    def fixes_scale(self) -> bool:
        return True

    def with_values(self, values: Sequence[Array]) -> Scene:
        """The scene with these numbers in place of the unknown ones."""
        leaves, tree = jax.tree.flatten(self.scene)
        for i, value in zip(self.places, values, strict=True):
            leaves[i] = value.astype(leaves[i].dtype)
        return jax.tree.unflatten(tree, leaves)

    def __call__(
        self,
        tensor: Float[Array, "3 3"],
        omega: Float[Array, " 3"],
        wxyz: Float[Array, " 4"] | None,
        times: Float[Array, " t"],
        wheel: Float[Array, " t"] | None,
        unknown: Any,
    ) -> Predicted:
        scene = self.with_values(unknown)
        return simulated(scene, omega, wxyz, times, self.method, self.rtol, self.attitude)
