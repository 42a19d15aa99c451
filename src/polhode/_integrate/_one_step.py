"""One step of a solver, where no more are to be made: what diffrax's loop would do, without it."""

import dataclasses
from typing import Any

import diffrax
import jax
import jax.numpy as jnp


def is_one_step(controller: Any, saveat: diffrax.SaveAt, event: Any, meter: Any) -> bool:
    """Whether a solve consists of one step, of which nothing but the state is saved."""
    subs = jax.tree.leaves(saveat.subs, is_leaf=_is_sub)
    return (
        isinstance(controller, diffrax.StepTo)
        and controller.ts.shape[0] == 2
        and event is None
        and isinstance(meter, diffrax.NoProgressMeter)
        and not saveat.dense
        and all(sub.ts is None and sub.steps in (0, 1) for sub in subs)
    )


def one_step(terms, args, solver, saveat: diffrax.SaveAt, state: Any) -> Any:
    """diffrax's ``state`` after the step from its ``tprev`` to its ``tnext``.

    A loop of one turn carries all of its arrays as copies, and is compiled as a loop.
    """
    end = state.tnext
    y, _, _, solver_state, result = solver.step(
        terms, state.tprev, end, state.y, args, state.solver_state, state.made_jump
    )

    def save(sub, found):
        seen = [(state.tprev, state.y)] * sub.t0 + [(end, y)] * (sub.steps == 1 or sub.t1)
        rows = [(t, sub.fn(t, now, args)) for t, now in seen]
        ts, ys = (jax.tree.map(lambda *x: jnp.stack(x), *some) for some in zip(*rows))
        count = len(rows)  # rooms for more steps stay as they are
        ts, ys = jax.tree.map(
            lambda new, room: jnp.concatenate([new, room[count:]]), (ts, ys), (found.ts, found.ys)
        )
        return dataclasses.replace(found, ts=ts, ys=ys, save_index=count)

    return dataclasses.replace(
        state,
        y=y,
        tprev=end,
        solver_state=solver_state,
        result=result,
        num_steps=1,
        num_accepted_steps=1,
        save_state=jax.tree.map(save, saveat.subs, state.save_state, is_leaf=_is_sub),
    )


def _is_sub(x: Any) -> bool:
    return isinstance(x, diffrax.SubSaveAt)
