"""Motions of scenes in fits: known torques, rotors, potentials and damping."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode._integrate import LiePoisson
from polhode._method import AbstractMethod
from polhode._scene import Scene, State, Table
from polhode._simulate import simulate
from polhode.fit._model import AbstractMotion, Predicted, entries_of
from polhode.fit._numerics import to_bounded, to_unbounded
from polhode.frames import gyroscope
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
    """The motion by ``ph.simulate`` from ``wxyz``, else ``attitude``, else the identity."""
    axes = jnp.asarray([1, 0, 0, 0])
    start = next(x for x in (wxyz, attitude, axes) if x is not None).astype(omega.dtype)
    trajectory = simulate(scene, State(start, omega), times, method, rtol=rtol, throw=False)
    return Predicted(gyroscope(trajectory), None, None if wxyz is None else trajectory.wxyz)


class SceneMotion(AbstractMotion):
    """Motion of the scene ``build(inertia, unknown)``, by ``ph.simulate``.

    **Fields:** ``build`` makes a ``ph.Scene`` of an inertia and the motion's own unknowns;
    ``unknown``: a pytree of their starting values, or None (the magnitudes of nonzero values are
    the optimiser's units); ``shows_scale``: whether rates depend on the absolute size of the
    inertia, true for known torques, rotors with known momentum and potentials; ``method``: one
    with forward-mode derivatives, by default ``LiePoisson()``; ``rtol`` as in ``ph.simulate``.

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
        acceleration: bool = True,
    ) -> Predicted:
        scene = self.build(Inertia(full=tensor), unknown)
        return simulated(scene, omega, wxyz, times, self.method, self.rtol)


class LeafMotion(AbstractMotion):
    """Motion of a scene with some unknown arrays, by ``ph.simulate``.

    The unknowns of an inertia tensor (``Inertia.full``) are its six entries.

    **Fields:** ``scene``, with the starting values; ``places`` (static): which of its leaves are
    unknown; ``bounds``: lower and upper ends of each, infinite where there is none, or None;
    ``widths``: standard deviations of normal priors about the start; ``attitude`` (4,): initial
    attitude for recordings without attitudes; ``method`` and ``rtol`` as in ``ph.simulate``.
    """

    scene: Scene
    places: tuple[int, ...] = eqx.field(static=True)
    attitude: Float[Array, " 4"] | None = None
    method: AbstractMethod | None = None
    rtol: float | None = eqx.field(static=True, default=None)
    bounds: tuple[tuple[Array, Array] | None, ...] | None = None
    widths: tuple[Array | None, ...] | None = None

    @property
    def has_bounds(self) -> bool:
        return self.bounds is not None

    def bounded(self, unknown: list[Array]) -> list[Array]:
        if self.bounds is None:
            return unknown
        pairs = zip(unknown, self.start(), self.bounds, strict=True)
        return [x if ends is None else to_bounded(x, at, *ends) for x, at, ends in pairs]

    def unbounded(self, values: list[Array]) -> list[Array]:
        if self.bounds is None:
            return values
        pairs = zip(values, self.start(), self.bounds, strict=True)
        return [x if ends is None else to_unbounded(x, at, *ends) for x, at, ends in pairs]

    def prior_std(self) -> list[Array | None]:
        return super().prior_std() if self.widths is None else list(self.widths)

    def at_bound(self, values: list[Array]) -> Array:
        """Whether a value has come within a thousandth of the start's distance to a bound."""
        is_near = jnp.asarray(False)
        for x, at, ends in zip(values, self.start(), self.bounds or (), strict=False):
            for end in ends or ():
                is_near = is_near | jnp.any(jnp.abs(x - end) < 1e-3 * jnp.abs(at - end))
        return is_near

    def start(self) -> list[Array]:
        leaves = jax.tree.leaves(self.scene)
        arrays = [leaves[i] for i in self.places]
        return [x if n is None else entries_of(x, n) for x, n in zip(arrays, self.entry_counts)]

    @property
    def entry_counts(self) -> list[int | None]:
        parts = jax.tree.leaves(self.scene, is_leaf=lambda part: isinstance(part, Inertia))
        tensors = [id(part.full) for part in parts if isinstance(part, Inertia)]
        leaves = jax.tree.leaves(self.scene)
        return [6 if id(leaves[i]) in tensors else None for i in self.places]

    def fixes_scale(self) -> bool:
        return True

    def with_values(self, values: Sequence[Array]) -> Scene:
        """The scene with these arrays in place of the unknown ones."""
        leaves, tree = jax.tree.flatten(self.scene)
        for i, value in zip(self.places, values, strict=True):
            leaves[i] = value.astype(leaves[i].dtype)
        scene = jax.tree.unflatten(tree, leaves)
        # derivatives of tables follow from the values, as in their constructor
        return jax.tree.map(
            lambda part: part.updated() if isinstance(part, Table) else part,
            scene,
            is_leaf=lambda part: isinstance(part, Table),
        )

    def __call__(
        self,
        tensor: Float[Array, "3 3"],
        omega: Float[Array, " 3"],
        wxyz: Float[Array, " 4"] | None,
        times: Float[Array, " t"],
        wheel: Float[Array, " t"] | None,
        unknown: Any,
        acceleration: bool = True,
    ) -> Predicted:
        scene = self.with_values(self.arrays_of(unknown))
        return simulated(scene, omega, wxyz, times, self.method, self.rtol, self.attitude)
