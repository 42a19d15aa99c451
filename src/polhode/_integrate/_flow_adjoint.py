"""Derivatives of the exact flow as a diffrax adjoint.

They are not derivatives of the steps: forward mode integrates the variational equations together
with the state, reverse mode the adjoint equations from the end back to the start, both in steps of
their own with their own error control. Neither stores the solution between saved times.
"""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from polhode._hamiltonian import Dynamics
from polhode._integrate._diffrax_solve import is_one_step, one_step
from polhode._integrate._extrapolation import Extrapolation
from polhode._integrate._field import FixedArguments
from polhode._integrate._flow_derivative import Equations, equations_of
from polhode._integrate._midpoint import Progress
from polhode._kernels import jvp_of_nonzero, kernel, with_derivative_rule


class FlowAdjoint(diffrax.AbstractAdjoint):
    r"""Derivatives of the exact flow, in forward and in reverse mode, for any solver.

    Reverse mode solves $y' = f$, $\lambda' = -\lambda\,\partial f/\partial y$,
    $\mu' = -\lambda\,\partial f/\partial c$ backwards, where $c$ are those coefficients of the
    field that depend on the differentiated inputs. The derivatives are accurate to ``rtol``,
    whatever steps the solver took, and memory does not grow with the number of steps.

    - ``rtol``: error of the derivatives relative to their size; None: that of the solver's
      ``accuracy``, or else 1e-9 in float64 and 1e-5 in float32.
    - If the field contracts, as with drag, errors of the backward integration grow by
      exp(rate of contraction * time). The integration restarts at every saved time; if torques
      act, ``ph.simulate`` divides the motion into at least eight intervals.
    - The state: arrays of one shape, whose entries are bodies that the field treats separately.
    - Saved: the state itself, at the start, at given times, at the steps of ``diffrax.StepTo``, or
      at the end. Of several ``SubSaveAt`` the first is differentiated. Not for events.

    ??? cite "Reference"
        L. S. Pontryagin et al., The Mathematical Theory of Optimal Processes (1962), chapter 1;
        E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I,
        section I.14, on the variational equations.
    """

    rtol: Array | float | None = None

    def loop(
        self,
        *,
        args: PyTree,
        terms: PyTree,
        solver: Any,
        stepsize_controller: Any,
        event: Any,
        saveat: Any,
        t0: Any,
        t1: Any,
        init_state: Any,
        **loop_arguments: Any,
    ) -> Any:
        times = _saved_times(saveat, stepsize_controller, event, t0, t1)
        leaves, tree = jax.tree.flatten(init_state.y)
        rtol = self._accuracy(solver, leaves[0].dtype)
        midpoint = isinstance(solver, Extrapolation)
        compensated = midpoint and solver.compensated
        keeps_rtol = midpoint and solver.accuracy is not None
        equations, c = equations_of(terms, args, init_state.y, t0, rtol, compensated, keeps_rtol)

        coefficients, rates, _ = equations.prepare(c, t0, leaves)
        rates = kernel(rates)  # for diffrax's solvers; polhode's own are units as a whole

        def field(t, y, fixed_arguments):
            return jax.tree.unflatten(tree, rates(fixed_arguments.arrays, t, *jax.tree.leaves(y)))

        # The steps are not differentiated: all their inputs are constants to JAX, including the
        # arrays over which the user's functions close.
        fixed_arguments = FixedArguments(
            coefficients, args.units if isinstance(args, Dynamics) else None
        )
        inputs = (
            fixed_arguments,
            solver,
            stepsize_controller,
            saveat,
            t0,
            t1,
            init_state,
            loop_arguments,
        )
        fixed_arguments, solver, controller, saveat, begin, end, state, loop_arguments = (
            _stop_gradient(inputs)
        )
        steps = isinstance(controller, diffrax.StepTo) and _first_sub(saveat.subs).steps == 1
        if midpoint and steps:
            solver, controller, state = solver.spanning(controller, state)
        term, outputs = diffrax.ODETerm(field), [{}]
        if is_one_step(controller, saveat, event, loop_arguments["progress_meter"]):
            state = one_step(term, fixed_arguments, solver, saveat, state)
        else:
            state, *outputs = diffrax.ForwardMode().loop(
                args=fixed_arguments,
                terms=term,
                solver=solver,
                stepsize_controller=controller,
                event=event,
                saveat=saveat,
                t0=begin,
                t1=end,
                init_state=state,
                **loop_arguments,
            )
        if times is None:  # the ends of the steps that the controller chose
            times = _first_sub(state.save_state).ts
        saved_states = jax.tree.leaves(_first_sub(state.save_state).ys)
        progress = state.solver_state
        if isinstance(progress, Progress) and progress.rows is not None:  # all times in one step
            rows = progress.rows
            count, saved_times = times.shape[0], _first_sub(state.save_state).ts
            rows = jnp.transpose(rows[:, -1 - count : -1], (2, 1, 0))
            saved_states = [jnp.concatenate([x, y[count:]]) for x, y in zip(rows, saved_states)]
            ts = jnp.concatenate([_stop_gradient(times), saved_times[count:]])
            state = eqx.tree_at(lambda s: _first_sub(s.save_state).ts, state, ts)
        count = min(
            times.shape[0], saved_states[0].shape[0]
        )  # rows for further steps are not changed
        states = [x[:count] for x in saved_states]
        path = path_with_derivatives(equations, c, leaves, t0, times[:count], states)
        path = [jnp.concatenate([x, s[count:]]) for x, s in zip(path, saved_states)]
        ys = jax.tree.unflatten(tree, path)
        state = eqx.tree_at(lambda s: _first_sub(s.save_state).ys, state, ys)
        return (state, *outputs)

    def _accuracy(self, solver, dtype) -> Array:
        if self.rtol is not None:
            return jax.lax.stop_gradient(jnp.asarray(self.rtol, dtype))
        if isinstance(solver, Extrapolation) and solver.accuracy is not None:
            return jax.lax.stop_gradient(jnp.asarray(solver.accuracy.rtol, dtype))
        return jnp.asarray(1e-9 if jnp.finfo(dtype).eps < 1e-9 else 1e-5, dtype)


def _first_sub(subs: Any) -> Any:
    """The first ``SubSaveAt``, or the corresponding state, of one or several."""
    return subs[0] if isinstance(subs, list | tuple) and not hasattr(subs, "_fields") else subs


def _stop_gradient(tree: Any) -> Any:
    arrays, static = eqx.partition(tree, eqx.is_array)
    return eqx.combine(jax.lax.stop_gradient(arrays), static)


def _saved_times(saveat, controller, event, t0, t1) -> Array | None:
    """The saved times, in order; None if the controller chooses them during the solution."""
    sub = _first_sub(saveat.subs)
    if event is not None or not isinstance(sub, diffrax.SubSaveAt):
        raise ValueError(
            "FlowAdjoint differentiates states at saved times, of one SubSaveAt and without"
            " events: use another adjoint of diffrax for the rest."
        )
    if sub.steps:
        if not isinstance(controller, diffrax.StepTo):
            return None
        step_ends = controller.ts[1:]
        return jnp.concatenate([jnp.stack([t0]), step_ends]) if sub.t0 else step_ends
    times = [jnp.stack([t0])] if sub.t0 else []
    times += [] if sub.ts is None else [sub.ts]
    times += [jnp.stack([t1])] if sub.t1 else []
    return jnp.concatenate(times)


def path_with_derivatives(equations: Equations, c, y0, t0, times, states):
    """The saved states (components (T, N)) with the derivatives of the flow."""
    size = len(y0)

    def rule(operands, tangents, states):
        def saved_path(inputs):
            t0, times, start, c = inputs[0], inputs[1], inputs[2 : 2 + size], inputs[2 + size :]
            # times that were not reached are inf; the interval to them is replaced by an empty one
            times = jnp.where(jnp.isfinite(times), times, jax.lax.stop_gradient(t0))
            horizon = jax.lax.stop_gradient(jnp.max(jnp.abs(times - t0)))
            starts = jnp.concatenate([jnp.stack([t0]), times[:-1]])

            def one_interval(y, interval):
                start, end, end_state = interval
                y = equations.attach_derivatives(c, y, start, end, horizon, end_state)
                return y, y

            _, end_states = jax.lax.scan(one_interval, start, (starts, times, list(states)))
            return end_states

        return jvp_of_nonzero(saved_path, operands, tangents)

    return with_derivative_rule(rule, [t0, times, *y0, *c], states)
