"""Steps from one given time to the next, and a solve of a single step without diffrax's loop."""

import dataclasses
from typing import Any

import diffrax
import jax
import jax.numpy as jnp


class GivenTimes(diffrax.StepTo):
    """``diffrax.StepTo`` for times that are in order and whose ends are those of the solve.

    Its checks raise from inside the program, by callbacks of the host, which keep the program out
    of JAX's persistent cache and from being exported for other platforms. ``ph.simulate`` checks
    times before, or marks them in its status.
    """

    def wrap(self, direction):
        return GivenTimes(self.ts * direction)

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        del terms, t0, t1, y0, dt0, args, func, error_order
        return self.ts[1], 2


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
