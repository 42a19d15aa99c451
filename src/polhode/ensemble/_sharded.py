"""Batches that lie on several devices: each device moves the bodies it has."""

from typing import Any

import equinox as eqx
import jax
from jax.sharding import NamedSharding, PartitionSpec
from jaxtyping import ArrayLike, Float

from polhode._lanes import is_lane_tree
from polhode._methods import AbstractMethod, Record
from polhode._plan import choose
from polhode._scene import Scene
from polhode._simulate import check_inputs, check_method, check_rtol, run
from polhode._state import State
from polhode._trajectory import Trajectory


def simulate_sharded(
    scene: Scene,
    state: State,
    ts: Float[ArrayLike, " t"],
    method: AbstractMethod | None = None,
    *,
    rtol: float | None = None,
    record: Record | None = None,
) -> Trajectory:
    """``ph.simulate(..., throw=False)`` of bodies sharded along one leading axis.

    ``state.wxyz`` (N, 4) carries a ``NamedSharding`` whose first axis is that of the bodies; other
    arrays with a leading axis are placed alike. The trajectory keeps the sharding and the compiled
    program exchanges nothing between devices (under plain ``simulate`` the splitting of the batch
    into chunks makes the compiler gather it). Raises ValueError for a state that is not sharded so.
    """
    return program(*prepare(scene, state, ts, method, rtol, record))


def prepare(scene, state, ts, method, rtol, record) -> tuple:
    """Check the input of `simulate_sharded`; the arguments of the compiled program."""
    sharding = getattr(state.wxyz, "sharding", None)
    named = isinstance(sharding, NamedSharding) and len(sharding.spec) > 0
    if not named or sharding.spec[0] is None or state.wxyz.ndim != 2:
        raise ValueError(
            f"state.wxyz must be (N, 4) with a NamedSharding along N, got {state.wxyz.shape} with"
            f" {sharding}: place it with jax.device_put(wxyz, NamedSharding(mesh, P('body')))."
        )
    check_method(method)
    scene, state, ts, record = check_inputs(scene, state, ts, record)
    method = choose(scene, state, record)[0] if method is None else method
    split = NamedSharding(sharding.mesh, PartitionSpec(sharding.spec[0]))
    each, shared = eqx.partition((scene, state), is_lane_tree((scene, state)))
    each = jax.device_put(each, split)
    return each, shared, ts, method, check_rtol(rtol, ts.dtype), record, split


@eqx.filter_jit
def program(each, shared, ts, method, rtol, record, split) -> Trajectory:
    arrays, rest = eqx.partition((shared, method), eqx.is_array)

    def local(each, arrays, ts, rtol) -> Any:
        shared, method = eqx.combine(arrays, rest)
        found = run(method, *eqx.combine(each, shared), ts, rtol, record)
        return found.wxyz, found.omega_body, found.status, found.steps

    whole = PartitionSpec()
    wxyz, omega, status, steps = jax.shard_map(
        local, mesh=split.mesh, in_specs=(split.spec, whole, whole, whole), out_specs=split.spec,
        check_vma=False,
    )(each, arrays, ts, rtol)  # fmt: skip
    scene, state = eqx.combine(each, shared)
    kept = ts[-1:] if record.final_only else ts
    return Trajectory(kept, wxyz, omega, status, steps, scene.settled(state, ts[0]))
