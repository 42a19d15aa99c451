"""Ensembles: any number of bodies, each drawn by its index, never all in memory at once.

The bodies differ from a nominal one by spreads, each of which changes one quantity. A spread is any
callable ``(key, scene, state) -> (scene, state)`` of one body; this module has those that scene
files support.
"""

import dataclasses
import zlib
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, DTypeLike, Float, Int

from polhode import rotation
from polhode._batch import PARTS, batch_shapes, is_lane_tree
from polhode._scene import BodyTorque, Scene, SpaceTorque, State
from polhode.ensemble._statistics import QUANTITIES, Statistic
from polhode.ensemble._store import plain_number
from polhode.files._read import possible_moments
from polhode.inertia import Inertia

if TYPE_CHECKING:
    from polhode.files import SceneFile

MAX_BODIES = 2**32 - 1  # body indices are folded into the random key as 32-bit numbers
_MAX_DRAWS = 100

Spread = Callable[[Array, Scene, State], tuple[Scene, State]]

ROWS = {"moments": 3, "wxyz": 4, "omega_body": 3, "momentum_body": 3, "torque": 3}
"""Quantities that ``Ensemble.rows`` may contain, and their number of components."""


class Ensemble(eqx.Module):
    """``bodies`` bodies around a nominal scene and state.

    **Arguments:** ``scene``, ``state``: the nominal body, or arrays with one leading axis of
    length ``bodies`` in any leaf (the others are shared); ``bodies``; ``spreads``: callables
    ``(key, scene, state) -> (scene, state)`` of one body, applied in order; ``seed``; ``rows``:
    NumPy arrays (bodies, ...) of which each chunk reads its part, so that they may remain on disk
    (``np.load(file, mmap_mode="r")``): ``moments``, ``wxyz``, ``omega_body``, ``momentum_body`` or
    ``torque`` (of a constant torque). They replace the nominal ones before the spreads, the
    momentum after them.

    Body i depends on the seed and on i alone (its key is the seed's with i folded in, and each
    kind of spread has its own stream), so that no result depends on how the bodies are grouped.

    Raises ValueError for axes of another length, unknown rows, or a number of bodies outside
    1 ... 2^32 - 1, and TypeError for parts of the wrong kind.
    """

    scene: Scene
    state: State
    bodies: int = eqx.field(static=True, converter=plain_number)
    spreads: tuple[Spread, ...] = ()
    seed: int = eqx.field(static=True, default=0, converter=plain_number)
    rows: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)

    def __check_init__(self):
        if not isinstance(self.scene, Scene) or not isinstance(self.state, State):
            raise TypeError(
                "Ensemble takes a ph.Scene and a ph.State, got"
                f" {type(self.scene).__name__} and {type(self.state).__name__}."
            )
        if not 0 <= self.seed < 2**32:
            raise ValueError(f"seed must be from 0 to {2**32 - 1}, got {self.seed}.")
        if not 1 <= self.bodies <= MAX_BODIES:
            raise ValueError(f"bodies must be from 1 to {MAX_BODIES}, got {self.bodies}.")
        parts = [getattr(self.scene, name) for name in PARTS]
        shapes = {shape for part in (*parts, self.state) for shape in batch_shapes(part)}
        if other := shapes - {(), (self.bodies,)}:
            raise ValueError(
                f"arrays of an ensemble of {self.bodies} bodies have no leading axis or one of that"
                f" length, got the leading axes {sorted(other)}."
            )
        for name, array in self.rows.items():
            if name not in ROWS:
                raise ValueError(f"rows may be {', '.join(ROWS)}, got {name!r}.")
            shape = (self.bodies, ROWS[name])
            if np.shape(array) != shape or np.dtype(array.dtype).kind not in "fiu":
                raise ValueError(
                    f"rows {name} must be real numbers of shape {shape}, got {np.shape(array)} of"
                    f" {array.dtype}."
                )
        if {"omega_body", "momentum_body"} <= set(self.rows):
            raise ValueError("rows give omega_body or momentum_body of a body, not both.")
        if "torque" in self.rows:
            constant_torque(self.scene)

    def lanes(self, indices: np.ndarray) -> tuple[Any, Any]:
        """Arguments of ``draw`` for ``indices``: (leaves and rows of the bodies, shared leaves)."""
        parts = (self.scene, self.state)
        lane_parts, shared = eqx.partition(parts, is_lane_tree(parts))
        dtype = self.state.wxyz.dtype
        rows = {name: np.asarray(x[indices], dtype) for name, x in sorted(self.rows.items())}
        return (jax.tree.map(lambda x: x[indices], lane_parts), rows), shared

    def draw(self, indices: Int[np.ndarray, " n"]) -> tuple[Scene, State]:
        """Scene and state of the bodies ``indices`` (n,), with the leading axis n."""
        lane_parts, shared = self.lanes(indices)
        seed = jnp.asarray(self.seed, jnp.uint32)
        return draw(lane_parts, shared, jnp.asarray(indices, jnp.uint32), self.spreads, seed)


def draw(
    lane_parts: Any, shared: Any, indices: Array, spreads: Any, seed: Array
) -> tuple[Scene, State]:
    """Scenes and states of the bodies ``indices`` (n,), uint32, for a uint32 seed; traceable."""
    root = jax.random.key(seed, impl="threefry2x32")

    def draw_one(index, leaves_and_rows) -> tuple[Any, Any]:
        leaves, rows = leaves_and_rows
        scene, state = eqx.combine(leaves, shared)
        scene, state = _replace_rows(scene, state, rows)
        key = jax.random.fold_in(root, index)
        streams: list[int] = []
        for spread in spreads:
            stream = stream_of(spread)
            spread_key = jax.random.fold_in(key, stream)
            if stream in streams:  # several spreads of one name must draw independently
                spread_key = jax.random.fold_in(spread_key, streams.count(stream))
            streams.append(stream)
            scene, state = spread(spread_key, scene, state)
        if "momentum_body" in rows:
            state = _with_momentum(scene, state, rows["momentum_body"])
        return eqx.partition((scene, state), _may_differ((scene, state)))

    axes = (eqx.if_array(0), None)  # leaves that all bodies share have no axis of bodies
    try:
        drawn = eqx.filter_vmap(draw_one, in_axes=(0, eqx.if_array(0)), out_axes=axes)(
            indices, lane_parts
        )
    except ValueError as error:
        if "out_axes" not in str(error):
            raise
        raise ValueError(
            "a spread changes an array that all bodies share, such as the moment of a"
            " ph.DipoleField, the edges of ph.Pulses or the times of a ph.Table: let it change"
            " arrays that bodies may differ in, such as scene.inertia or the state."
        ) from error
    return eqx.combine(*drawn)


def _may_differ(parts: Any) -> Any:
    """Mask of the leaves of one body that bodies may differ in."""
    return is_lane_tree(jax.tree.map(lambda x: x[None] if eqx.is_array(x) else x, parts))


def _replace_rows(scene: Scene, state: State, rows: Mapping[str, Array]) -> tuple[Scene, State]:
    """One body with its rows in place of the nominal values."""
    if "moments" in rows:
        scene = _with_moments(scene, rows["moments"])
    if "torque" in rows:
        scene = with_torque(scene, rows["torque"])
    wxyz, omega = rows.get("wxyz", state.wxyz), rows.get("omega_body", state.omega_body)
    if "wxyz" in rows or "omega_body" in rows:
        state = State(wxyz, omega, state.wheel_speed)
    return scene, state


def _with_moments(scene: Scene, moments: Array) -> Scene:
    """The scene with these principal moments, about the principal axes that it has."""
    inertia, axes = Inertia.from_moments(moments), scene.constant_inertia.axes
    return dataclasses.replace(scene, inertia=inertia if axes is None else inertia.turned(axes))


def _with_momentum(scene: Scene, state: State, momentum: Array) -> State:
    # raises for an inertia that varies with time: the initial time is not known here
    _ = scene.constant_inertia
    return scene.with_momentum(state, momentum)


class Deviate(eqx.Module):
    """Random numbers (3,) of mean zero: normal of standard deviation ``scale`` (3,), or uniform
    in +-``scale`` with ``uniform=True``.
    """

    scale: Float[Array, " 3"]
    uniform: bool = eqx.field(static=True, default=False)

    def __call__(self, key: Array) -> Array:
        if self.uniform:
            return self.scale * jax.random.uniform(key, (3,), self.scale.dtype, -1, 1)
        return self.scale * jax.random.normal(key, (3,), self.scale.dtype)


class SpreadMoments(eqx.Module):
    """Principal moments times (1 + deviate), about the same axes; unphysical draws are repeated.

    After 100 unphysical draws the moments become NaN, which the status of the body reports.
    """

    relative: Deviate

    def __call__(self, key: Array, scene: Scene, state: State) -> tuple[Scene, State]:
        nominal = scene.constant_inertia.moments

        def draw_moments(trial):
            return nominal * (1 + self.relative(jax.random.fold_in(key, trial)))

        def is_unfinished(carry):
            trial, moments = carry
            return ~possible_moments(moments, rounded=False) & (trial < _MAX_DRAWS)

        def draw_again(carry):
            trial, _ = carry
            return trial + 1, draw_moments(trial)

        zero = jnp.zeros((), jnp.int32)
        initial_carry = (zero + 1, draw_moments(zero))
        _, moments = jax.lax.while_loop(is_unfinished, draw_again, initial_carry)
        moments = jnp.where(possible_moments(moments, rounded=False), moments, jnp.nan)
        return _with_moments(scene, moments), state


class SpreadAttitude(eqx.Module):
    """The attitude followed by a rotation about body axes by the rotation vector ``turn`` [rad]."""

    turn: Deviate

    def __call__(self, key: Array, scene: Scene, state: State) -> tuple[Scene, State]:
        turn = rotation.rotation_vector_to_wxyz(self.turn(key))
        return scene, State(
            rotation.multiply(state.wxyz, turn), state.omega_body, state.wheel_speed
        )


class AnyAttitude(eqx.Module):
    """Attitudes distributed uniformly over all rotations."""

    def __call__(self, key: Array, scene: Scene, state: State) -> tuple[Scene, State]:
        wxyz = jax.random.normal(key, (4,), state.wxyz.dtype)
        return scene, State(wxyz, state.omega_body, state.wheel_speed)


class SpreadEuler(eqx.Module):
    """Euler ``angles`` (3,) [rad] of a sequence, each plus its deviate [rad]."""

    angles: Float[Array, " 3"]
    deviate: Deviate
    sequence: rotation.Sequence = eqx.field(static=True)

    def __call__(self, key: Array, scene: Scene, state: State) -> tuple[Scene, State]:
        a = self.angles + self.deviate(key)
        wxyz = rotation.euler_to_wxyz(a[0], a[1], a[2], self.sequence)
        return scene, State(wxyz, state.omega_body, state.wheel_speed)


class SpreadRates(eqx.Module):
    """Body rates plus a deviate [rad/s]."""

    deviate: Deviate

    def __call__(self, key: Array, scene: Scene, state: State) -> tuple[Scene, State]:
        return scene, State(state.wxyz, state.omega_body + self.deviate(key), state.wheel_speed)


class SpreadMomentum(eqx.Module):
    """Body momentum ``momentum`` (3,) [kg m^2/s], wheels included, plus a deviate. The rates follow
    from the inertia after the preceding spreads.
    """

    momentum: Float[Array, " 3"]
    deviate: Deviate | None = None

    def __call__(self, key: Array, scene: Scene, state: State) -> tuple[Scene, State]:
        momentum = self.momentum if self.deviate is None else self.momentum + self.deviate(key)
        return scene, _with_momentum(scene, state, momentum)


class SpreadTorque(eqx.Module):
    """The constant torque of a scene (``BodyTorque`` or ``SpaceTorque``) plus a deviate [N m]."""

    deviate: Deviate

    def __call__(self, key: Array, scene: Scene, state: State) -> tuple[Scene, State]:
        return with_torque(scene, constant_torque(scene) + self.deviate(key)), state


def constant_torque(scene: Scene) -> Array:
    """The constant torque of a scene [N m]. Raises TypeError unless the scene has exactly one."""
    torque = scene.torque
    is_of_kind = isinstance(torque, BodyTorque | SpaceTorque)
    if not is_of_kind or not isinstance(torque.n, Array):
        kind = type(torque).__name__
        raise TypeError(
            "torques of an ensemble vary around one constant ph.BodyTorque or ph.SpaceTorque, got"
            f" {f'a {kind} that depends on time' if is_of_kind else kind}: give the scene such a"
            " torque, or write your own spread."
        )
    return torque.n


def with_torque(scene: Scene, n: Array) -> Scene:
    """The scene with its constant torque replaced."""
    return eqx.tree_at(lambda s: s.torque.n, scene, n)


def stream_of(spread: Any) -> int:
    """The number of a spread's own stream of random numbers, from its name: adding a spread does
    not change the draws of the others.
    """
    name = getattr(spread, "__name__", type(spread).__name__)
    return zlib.crc32(name.encode())


def build_ensemble(file: "SceneFile", dtype: DTypeLike) -> tuple[Ensemble, tuple[Statistic, ...]]:
    """The ensemble and the statistics of a scene file. Raises SceneFileError for impossible numbers
    and ValueError for a file without [ensemble].
    """
    from polhode.files import build_inertia, build_scene, build_state

    plan = file.ensemble
    if plan is None:
        raise ValueError(f"{file.path} has no [ensemble]: add one, with `bodies` and `seed`.")
    inertia = build_inertia(file, dtype)
    spreads = [_spread(name, draw, file, dtype) for name, draw in plan.spreads.items()]
    if file.state.rate == "momentum_body" and "momentum_body" not in {*plan.spreads, *file.rows}:
        spreads.append(SpreadMomentum(jnp.asarray(file.state.value, dtype)))
    ensemble = Ensemble(
        build_scene(file, dtype, inertia),
        build_state(file, dtype, inertia),
        plan.bodies,
        tuple(spreads),
        plan.seed,
        dict(file.rows),
    )
    statistics = tuple(
        Statistic(table.quantity, *QUANTITIES[table.quantity], table.low, table.high, table.bins)
        for table in plan.statistics
    )
    return ensemble, statistics


def _spread(quantity: str, draw, file: "SceneFile", dtype: DTypeLike):
    if quantity == "attitude" and draw.any:
        return AnyAttitude()
    uniform = draw.sigma is None
    deviate = Deviate(jnp.asarray(draw.half_width if uniform else draw.sigma, dtype), uniform)
    state = file.state
    if quantity == "euler":
        angles, sequence = jnp.asarray(state.attitude.values, dtype), state.attitude.sequence
        if sequence is None:
            raise ValueError("Euler angles spread only about Euler angles: give [state] euler.")
        return SpreadEuler(angles, deviate, rotation.Sequence[sequence.upper()])
    if quantity == "momentum_body":
        return SpreadMomentum(jnp.asarray(state.value, dtype), deviate)
    return _SPREADS[quantity](deviate)


_SPREADS = {
    "moments": SpreadMoments,
    "attitude": SpreadAttitude,
    "omega_body": SpreadRates,
    "torque": SpreadTorque,
}
