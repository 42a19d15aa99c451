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


class LeafMotion(AbstractMotion):
    """Motion of a scene some of whose arrays are unknown, by ``ph.simulate``.

    **Fields:** ``scene``, with the starting values; ``places`` (static): which of its leaves are
    unknown; ``attitude`` (4,): initial one for recordings without attitudes; ``method`` and
    ``rtol`` as in ``ph.simulate``.
    """

    scene: Scene
    places: tuple[int, ...] = eqx.field(static=True)
    attitude: Float[Array, " 4"] | None = None
    method: AbstractMethod | None = None
    rtol: float | None = eqx.field(static=True, default=None)

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
