"""From the [ensemble] of a scene file to an `Ensemble` and its statistics."""

from typing import TYPE_CHECKING

import jax.numpy as jnp
from jaxtyping import DTypeLike

from polhode import rotation
from polhode.ensemble._ensemble import Ensemble
from polhode.ensemble._spreads import (
    AnyAttitude,
    Deviate,
    SpreadAttitude,
    SpreadEuler,
    SpreadMoments,
    SpreadMomentum,
    SpreadRates,
    SpreadTorque,
)
from polhode.ensemble._statistics import QUANTITIES, Statistic

if TYPE_CHECKING:
    from polhode.files import SceneFile


def build_ensemble(file: "SceneFile", dtype: DTypeLike) -> tuple[Ensemble, tuple[Statistic, ...]]:
    """The ensemble and the statistics to keep. Raises SceneFileError for impossible numbers and
    ValueError for a file without [ensemble].
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
    kept = tuple(
        Statistic(k.quantity, *QUANTITIES[k.quantity], k.low, k.high, k.bins)
        for k in plan.statistics
    )
    return ensemble, kept


def _spread(quantity: str, draw, file: "SceneFile", dtype: DTypeLike):
    if getattr(draw, "any", False):
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
    kinds = {"moments": SpreadMoments, "attitude": SpreadAttitude, "omega_body": SpreadRates,
             "torque": SpreadTorque}  # fmt: skip
    return kinds[quantity](deviate)
