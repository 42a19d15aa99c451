"""The base class of the integration methods: choice of the steps, chunks of bodies, adjoint.

``AbstractIntegration.run`` has two paths: the loop of explicit steps (``_run_by_loop``: few bodies
with torques, switches, events), and ``diffrax.diffeqsolve`` (``_solve``: the extrapolated midpoint
rule for batches, and any solver passed by the user).
"""

import inspect
from collections.abc import Sequence
from functools import partial
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from polhode import _policy
from polhode._batch import PARTS, along_time, is_lane_tree
from polhode._failed import where_lost
from polhode._hamiltonian import Dynamics
from polhode._integrate._charts import AbstractChart, natural_rates
from polhode._integrate._diffrax_solve import (
    MIN_ADJOINT_INTERVALS,
    Request,
    Solution,
    in_segments,
    with_restarts,
)
from polhode._integrate._extrapolation import Automatic, Extrapolation
from polhode._integrate._flow_adjoint import FlowAdjoint, path_with_derivatives
from polhode._integrate._flow_derivative import equations_of
from polhode._integrate._iteration import LoopOptions
from polhode._integrate._loop import LocatedEvents, Search, samples_and_events, solve
from polhode._integrate._midpoint import Progress
from polhode._integrate._problem import Problem
from polhode._integrate._step_derivative import samples, segment_iterations
from polhode._integrate._switches import raising_on_hidden_switches
from polhode._integrate._tableau import TSIT5
from polhode._kernels import Distinct, becomes_fusible, is_fusible, kernel, map_chunks
from polhode._method import AbstractMethod, Record, Samples, Status, StepCounts, check_options
from polhode._parts import AbstractPart
from polhode._scene import Scene, State

# Without the ``jit`` of diffrax, for which an array that several parts of the scene share would be
# several operands. The call is part of a compiled program anyway.
_diffeqsolve = inspect.unwrap(diffrax.diffeqsolve)


class AbstractIntegration(AbstractMethod):
    """Base of the integration methods; arguments as of ``LiePoisson``."""

    chart: AbstractChart
    solver: diffrax.AbstractSolver
    controller: diffrax.AbstractStepSizeController | None
    dt0: float | Array | None
    max_steps: int = eqx.field(static=True)
    adjoint: diffrax.AbstractAdjoint
    progress_meter: diffrax.AbstractProgressMeter
    chunk: int | None = eqx.field(static=True)

    def __init__(
        self,
        chart: AbstractChart,
        shared_chunk: int,
        solver: diffrax.AbstractSolver | None,
        controller: diffrax.AbstractStepSizeController | None,
        dt0: float | Array | None,
        max_steps: int,
        adjoint: diffrax.AbstractAdjoint | None,
        progress_meter: diffrax.AbstractProgressMeter | None,
        chunk: int | None,
    ):
        """``shared_chunk``: the default ``chunk`` where bodies share their steps."""
        solver = diffrax.Dopri8() if solver is None else solver
        check_options(solver, controller, adjoint, dt0=dt0, max_steps=max_steps, chunk=chunk)
        if chunk is None and not isinstance(solver, Extrapolation):
            chunk = shared_chunk
        self.chart, self.solver, self.controller = chart, solver, controller
        self.dt0, self.max_steps, self.chunk = dt0, max_steps, chunk
        self.adjoint = FlowAdjoint() if adjoint is None else adjoint
        no_meter = diffrax.NoProgressMeter()
        self.progress_meter = no_meter if progress_meter is None else progress_meter

    @property
    def name(self) -> str:
        """Coordinates and solver."""
        coordinates = type(self.chart).__name__.removesuffix("Chart")
        return f"{coordinates}({type(self.solver).__name__})"

    def steps_of(self, scene: Scene, state: State, ts: Array, record: Record) -> str:
        """Description of the steps for a scene, for ``ph.explain``."""
        if not self._is_automatic:
            name = f"steps of {type(self.solver).__name__}"
            if isinstance(self.solver, Extrapolation) or not may_jump(scene):
                return name
            return f"{name}, which pass jumps of a torque and may then miss rtol"
        is_few, switches, hidden_operations = self._are_few(scene, state), 0, ()
        if is_few or may_jump(scene):
            program: list[Problem] = []

            def trace(scene, state, ts):
                program.append(self._problem(scene, state, ts, record))

            eqx.filter_eval_shape(trace, scene, state, ts)
            (problem,) = program
            switches, hidden_operations = problem.switches.count, problem.switches.hidden_operations
            if problem.passed_switches:
                return (
                    f"explicit Runge-Kutta steps of order 5 that pass {problem.passed_switches}"
                    " switches (clip, where, ...): gradients are wrong by about sqrt(rtol), more at"
                    " jumps"
                )
        if hidden_operations:
            return (
                "extrapolated midpoint rule, searched for jumps: the torque contains"
                f" {', '.join(hidden_operations)}, in which kinks cannot be located"
            )
        if is_few or switches:
            ending = f", each ending where one of {switches} switches (clip, where, ...) changes"
            order = 5 if self._automatic.rule(switches) is TSIT5 else 8
            return f"explicit Runge-Kutta steps of order {order}" + (ending if switches else "")
        carried = ", with compensated summation" if self._automatic.compensated else ""
        return f"extrapolated midpoint rule{carried}"

    @property
    def keeps_rtol(self) -> bool:
        """Whether ``rtol`` determines the steps: without a controller passed by the user."""
        return self.controller is None

    def _bodies_at_once(self, scene: Scene, state: State, ts: Array, record: Record) -> int:
        """Default chunk size of a solver that takes individual steps for each body."""
        if not _policy.is_cpu():
            return _policy.ACCELERATOR_BODIES
        solver = self.solver
        if not isinstance(solver, Extrapolation):
            return 1
        if state.wxyz.shape[0] <= _policy.KERNEL_BODIES:
            return _policy.KERNEL_BODIES
        counts: list[int] = []

        def trace(scene, state):
            y0, _ = self._initial_state(scene, state, ts, record)
            term, dynamics = self._equations(scene, state, ts, record)
            counts.append(solver.bodies_at_once(term, ts[0], y0, dynamics))

        eqx.filter_eval_shape(trace, scene, state)
        return counts[0]

    def run(self, scene: Scene, state: State, ts: Array, rtol: Array, record: Record) -> Samples:
        jumps = may_jump(scene)
        by_loop = False
        if self._is_automatic:
            by_loop, jumps = self._suits_loop(scene, state, ts, record, jumps)
        if by_loop:
            result = self._run_by_loop(scene, state, ts, rtol, record)
            if result is not None:
                return result[0]
        hidden: tuple[str, ...] = ()
        if self._is_automatic and jumps:
            hidden = self._problem(scene, state, ts, record).switches.hidden_operations
        size = 1
        if ts.ndim == 1:
            size = self.chunk or self._bodies_at_once(scene, state, ts, record)
        lanes, shared = eqx.partition((scene, state), is_lane_tree((scene, state)))

        def solve_chunk(chunk):
            lanes, times = chunk.value()
            scene, state = eqx.combine(lanes, shared)
            times = ts if times is None else times[0]
            return self._solve(scene, state, times, rtol, record, jumps)

        n, times = state.wxyz.shape[0], ts if ts.ndim == 2 else None
        if n <= min(size, _policy.SORTED_BODIES):
            # With other adjoints JAX differentiates the loop itself, and ``linearised`` would make
            # it run twice.
            linearised = isinstance(self.adjoint, FlowAdjoint)
            unit = kernel(solve_chunk, linearised=linearised, of_units=True)
            solve_all = unit if n <= _policy.KERNEL_BODIES else solve_chunk
            return raising_on_hidden_switches(solve_all(Distinct((lanes, times))), hidden)
        # chunks of bodies with similar rates, those with most steps first, so that in a work queue
        # the last bodies to start need few
        order = jnp.argsort(-natural_rates(scene, state, ts))
        sorted_lanes = jax.tree.map(lambda x: x[order], Distinct((lanes, times)))
        results = map_chunks(solve_chunk, sorted_lanes, n, size)
        return raising_on_hidden_switches(
            jax.tree.map(lambda x: x[jnp.argsort(order)], results), hidden
        )

    def _initial_state(self, scene, state, ts, record: Record):
        """The initial state, with zero work if it is recorded, and whether the coordinates are
        regular there."""
        y0, is_regular = self.chart.start(scene, state, ts[..., 0])
        if record.work:
            wheels = scene.dynamics.wheels
            loose = () if wheels is None else wheels.loose
            y0 = (*y0, (jnp.zeros_like(y0[0][0]),) * (1 + len(loose)))
        return y0, is_regular

    def _equations(self, scene, state, ts, record: Record):
        """The diffrax term of the equations of motion, and its arguments."""
        dynamics = self.chart.dynamics(scene, state, ts)
        if not record.work:
            return diffrax.ODETerm(self.chart.field), dynamics
        parts = dynamics.hamiltonian, dynamics.torque, dynamics.units
        return diffrax.ODETerm(self.chart.field_and_power), Dynamics(*parts, wheels=dynamics.wheels)

    def _run_by_loop(
        self,
        scene: Scene,
        state: State,
        ts: Array,
        rtol: Array,
        record: Record,
        search: Search | None = None,
    ) -> Any:
        """Samples and events by the loop of explicit steps; None if the field contains operations
        whose switches cannot be located."""
        lanes, shared = eqx.partition((scene, state), is_lane_tree((scene, state)))

        def solve_chunk(chunk):
            lanes, times = chunk.value()
            scene, state = eqx.combine(lanes, shared)
            times = ts if times is None else times
            return self._solve_by_loop(scene, state, times, rtol, record, search, n)

        n, times = state.wxyz.shape[0], ts if ts.ndim == 2 else None
        size = self.chunk or (
            1 if n == 1 else self._lanes_of_loop(scene, state, ts, record, search)
        )
        if n <= min(size, _policy.KERNEL_BODIES):
            unit = kernel(solve_chunk, linearised=True, of_units=True)
            return unit(Distinct((lanes, times)))
        if size == 1:
            return map_chunks(solve_chunk, Distinct((lanes, times)), n, 1)
        # bodies of a chunk wait for each other: chunks of bodies with similar rates
        order = jnp.argsort(-natural_rates(scene, state, ts))
        sorted_lanes = jax.tree.map(lambda x: x[order], Distinct((lanes, times)))
        results = map_chunks(solve_chunk, sorted_lanes, n, size)
        return jax.tree.map(lambda x: x[jnp.argsort(order)], results)

    def _lanes_of_loop(self, scene, state, ts, record: Record, search) -> int:
        """Bodies that the loop integrates at the same time. A kernel for several cannot contain
        networks. If none can contain the field, more bodies amortise the calls."""
        program = self._problem(scene, state, ts, record, search).closed_jaxpr.jaxpr
        lanes = _policy.LANES
        if becomes_fusible(program):
            is_batch = state.wxyz.shape[0] > _policy.SINGLE_BODIES and is_fusible(program)
            lanes = _policy.KERNEL_BODIES if is_batch else 1
        return _policy.bodies_at_once(lanes)

    def search(
        self, scene: Scene, state: State, ts: Array, rtol: Array, search: Search, final_only: bool
    ) -> tuple[Samples, LocatedEvents] | None:
        """Samples at ``ts`` followed by those at the events, and the events; None if this method
        does not search for events during the integration."""
        if not self._is_automatic or not state.wxyz.shape[0]:
            return None
        if not self._automatic.located:
            raise ValueError("CoarseSteps does not search for events: leave method out.")
        record = Record(final_only=final_only)
        return self._run_by_loop(scene, state, ts, rtol, record, search)

    @property
    def _is_automatic(self) -> bool:
        return isinstance(self.solver, Automatic) and self.controller is None

    @property
    def _automatic(self) -> Automatic:
        assert isinstance(self.solver, Automatic)
        return self.solver

    def _are_few(self, scene: Scene, state: State) -> bool:
        """Whether torques act on few bodies and compensated summation is not needed. Explicit steps
        do not have it: in single precision their errors are up to 16 times as large."""
        few = 0 < state.wxyz.shape[0] <= _policy.EXPLICIT_BODIES
        is_uncompensated = isinstance(self.solver, Automatic) and not self.solver.compensated
        return _torques_act(scene) and few and is_uncompensated

    def _suits_loop(self, scene, state, ts, record: Record, jumps: bool) -> tuple[bool, bool]:
        """Whether the loop of explicit steps is used, because it is faster or because its steps end
        at switches; and whether steps of the midpoint rule must be searched for jumps."""
        if self._are_few(scene, state):
            return True, jumps
        if not self._automatic.located:
            return state.wxyz.shape[0] > 0, jumps
        if not jumps or not state.wxyz.shape[0]:
            return False, jumps
        switches = self._problem(scene, state, ts, record).switches
        return switches.count > 0, bool(switches.hidden_operations)

    def _problem(self, scene, state, ts, record: Record, search: Search | None = None) -> Problem:
        """The equations of one body as a program, with the functions of the events."""
        y0, _ = self._initial_state(scene, state, ts, record)

        fns = () if search is None else search.fns

        def event_values(parts, t, y):
            scene, _ = parts
            scene_over_time = Scene(**{name: along_time(getattr(scene, name), 1) for name in PARTS})
            y = jax.tree.map(lambda x: x[:, None], tuple(y))
            wxyz, omega, _ = self.chart.finish(scene_over_time, y, jnp.reshape(t, (1, 1)))
            return jnp.stack([fn(wxyz[0, 0], omega[0, 0], t) for fn in fns])

        def equations(parts):
            scene, state = parts
            return self._equations(scene, state, ts, record)

        masks = is_lane_tree((scene, state))
        values = None if search is None else event_values
        located = not self._is_automatic or self._automatic.located
        return Problem.of(equations, (scene, state), masks, y0, ts.reshape(-1)[0], values, located)

    def _solve_by_loop(
        self, scene, state, ts, rtol, record: Record, search: Search | None, n: int
    ) -> tuple[Samples, LocatedEvents | None] | None:
        """One chunk of ``n`` bodies by the loop of explicit steps; ``ts`` (T,) or (N, T)."""
        y0, is_regular = self._initial_state(scene, state, ts, record)
        term, dynamics = self._equations(scene, state, ts, record)
        problem = self._problem(scene, state, ts, record, search)
        if problem.switches.hidden_operations:
            return None
        leaves, tree = jax.tree.flatten(y0)
        rtol = jax.lax.stop_gradient(rtol)
        times = ts[..., -1:] if record.final_only else ts
        unit_data, start, y = (dynamics.units, rtol), ts[..., 0], jnp.stack(leaves)
        event_search = Search() if search is None else search
        rule = self._automatic.rule(problem.switches.count - problem.events)
        program = problem._replace(arrays=[])  # a derivative rule must not close over traced values
        without_storage = event_search.without_storage

        def make_motion(arrays, unit_data, differentiable, event_search=without_storage):
            units, rtol = unit_data
            motion = program.motion(arrays, _by_units, units, rule, differentiable)
            return motion, LoopOptions(
                rtol,
                self.max_steps,
                event_search.capacity,
                event_search.directions,
                event_search.terminal,
                differentiable,
            )

        constants = jax.lax.stop_gradient((problem.arrays, unit_data, start, times, y))
        loop_result, _ = solve(partial(make_motion, event_search=event_search), *constants)
        states, events = loop_result.states, None
        if search is not None:
            events, times, states = samples_and_events(search, loop_result, times, states)
        # If the exact equations of a damped motion are integrated backwards, errors grow. They do
        # not if the recorded steps are differentiated.
        uses_steps = problem.switches.count or not self._automatic.located
        if uses_steps or times.ndim > 1 or _torques_act(scene):
            operands = problem.arrays, unit_data, y, start, times, states, loop_result
            iterations = 0
            if search is None and times.ndim == 1:
                iterations = _policy.recorded_iterations(n, problem.note_bytes)
                iterations = min(iterations, segment_iterations(self.max_steps))
            first_order_only = problem.passed_switches > 0
            states, loop_result = samples(
                make_motion, *operands, iterations=iterations, first_order_only=first_order_only
            )
        else:
            equations, c = equations_of(term, dynamics, y0, start, rtol, False)
            path = list(jnp.unstack(jnp.swapaxes(states, 0, 1), axis=-1))
            path = path_with_derivatives(equations, c, leaves, start, times, path)
            states = jnp.swapaxes(jnp.stack(path, axis=-1), 0, 1)
        sample_states = jax.tree.unflatten(tree, jnp.unstack(jnp.swapaxes(states, 0, 1), axis=-1))
        end_state = jax.tree.map(lambda x: x[-1:], sample_states)
        status = jnp.array(_OF_LOOP)[loop_result.outcome]
        solution = Solution(sample_states, end_state, loop_result.steps, status, loop_result.error)
        return self._samples(scene, solution, times, is_regular, record), events

    def _solve(self, scene, state, ts, rtol, record: Record, jumps: bool) -> Samples:
        """One chunk of bodies by ``diffrax.diffeqsolve``, between the edges of pulses."""
        y0, is_regular = self._initial_state(scene, state, ts, record)
        save_times = ts[-1:] if record.final_only else ts
        if scene.torque is None or scene.torque.edges is None:
            solution = self._solve_smooth(scene, state, y0, ts, rtol, record, jumps)
            return self._samples(scene, solution, save_times, is_regular, record)

        def scene_with(acting):
            return Scene(scene.inertia, scene.potential, acting, scene.rotors)

        def rates(acting, t, y):
            term, dynamics = self._equations(scene_with(acting), state, ts, record)
            return term.vf(t, y, dynamics)

        def solve_segment(acting, y, times, parts):
            segment_scene = scene_with(acting)
            segment_rtol = jnp.maximum(rtol / parts, 8 * jnp.finfo(rtol.dtype).eps)
            return self._solve_smooth(segment_scene, state, y, times, segment_rtol, record, jumps)

        solution = in_segments(solve_segment, rates, y0, ts, scene.torque, record.final_only)
        return self._samples(scene, solution, save_times, is_regular, record)

    def _solve_smooth(self, scene, state, y0, ts, rtol, record, jumps: bool) -> Solution:
        """The solution from ``y0`` through ``ts``: the one call of diffrax."""
        term, dynamics = self._equations(scene, state, ts, record)
        rows, follows_flow = None, isinstance(self.adjoint, FlowAdjoint)
        if follows_flow and _torques_act(scene) and ts.shape[0] <= MIN_ADJOINT_INTERVALS:
            closed_over = ()
            if may_jump(scene):  # a user's function may close over differentiated arrays
                program = jax.make_jaxpr(partial(term.vf, args=dynamics))(ts[0], y0)
                closed_over = program.consts
            ts, rows = with_restarts(ts, record.final_only, (scene, y0, closed_over))
        final_only = record.final_only and rows is None
        dt0 = None if self.dt0 is None else jnp.copysign(self.dt0, ts[-1] - ts[0])
        request = Request(ts, rtol, dt0, self.max_steps, final_only, jumps)
        if self.controller is not None:
            stepping = request.by_controller(self.solver, self.controller)
        elif isinstance(self.solver, Extrapolation):
            stepping = self.solver.stepping(request)
        else:
            stepping = request.by_error_estimate(self.solver, y0, term, dynamics)
        solution = _diffeqsolve(
            term,
            stepping.solver,
            t0=ts[0],
            t1=ts[-1],
            dt0=stepping.dt0,
            y0=y0,
            args=dynamics,
            saveat=stepping.saveat,
            stepsize_controller=stepping.controller,
            adjoint=self.adjoint,
            max_steps=stepping.max_steps,
            progress_meter=self.progress_meter,
            throw=False,
        )
        progress = solution.solver_state
        error = progress.error if isinstance(progress, Progress) else None
        ys: Any = solution.ys
        samples, end_state = ys
        if rows is not None:
            samples = jax.tree.map(lambda x: x[rows], samples)
        steps, status = _outcome(solution, y0[0][0].shape)
        return Solution(samples, end_state, steps, status, error)

    def _samples(self, scene, solution: Solution, times, is_regular, record: Record) -> Samples:
        """Attitudes, rates and status from a solution; ``times`` of the samples (T,) or (N, T)."""
        samples, end_state = (_lanes_first(y) for y in (solution.samples, solution.end_state))
        dynamics = scene.dynamics
        work, motors, spins = None, None, None
        if record.work:
            *samples, (work, *powers) = samples
            *end_state, _ = end_state
            motors = _of_wheels(dynamics.wheels, powers) if powers else None
        if dynamics.coupled:
            spins = jnp.stack(samples[2], axis=-1)
        scene_over_time = Scene(**{name: along_time(getattr(scene, name), 1) for name in PARTS})
        times = jnp.atleast_2d(times)
        # diffrax fills the times that were not reached with inf
        reached = jnp.isfinite(sum(jax.tree.leaves(samples)))
        wxyz, omega, _ = self.chart.finish(scene_over_time, tuple(samples), times)
        *_, is_regular_at_end = self.chart.finish(scene_over_time, tuple(end_state), times[:, -1:])
        is_known = is_regular[:, None, None] & reached[..., None]
        wxyz, omega = (where_lost(x, is_known & jnp.isfinite(x)) for x in (wxyz, omega))
        outcome = solution.status
        finite = jnp.all(jnp.isfinite(wxyz), axis=(-1, -2))
        finite = finite & jnp.all(jnp.isfinite(omega), axis=(-1, -2))
        is_successful = outcome == Status.SUCCESSFUL
        status = jnp.where(is_successful & ~finite, Status.NOT_FINITE, outcome)
        is_singular = ~is_regular | (~is_regular_at_end[:, -1] & ~is_successful)
        if self.chart.canonical:  # steps become too short where the Euler angles are singular
            is_singular = is_singular | (outcome == Status.STEP_FAILED)
        return Samples(
            wxyz if record.attitude else None,
            omega if record.rates else None,
            jnp.where(is_singular, Status.CHART_SINGULAR, status),
            solution.steps,
            work,
            solution.error,
            motors,
            spins,
        )


def _by_units(units, y, rates):
    return units(y, rates)


def _of_wheels(wheels, loose: Sequence[Array]) -> Array:
    """Values of the wheels that are not held, as (..., m) for all wheels; zero for the others."""
    values = iter(loose)
    zero = jnp.zeros_like(loose[0])
    return jnp.stack([zero if is_held else next(values) for is_held in wheels.is_held], axis=-1)


def _lanes_first(y):
    """Saved states (T, N) as samples (N, T)."""
    return jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), y)


def _outcome(solution, shape) -> tuple[StepCounts, Array]:
    """Steps and status of every body."""
    progress = solution.solver_state
    if isinstance(progress, Progress):  # each body has steps of its own
        counts = progress.steps, progress.rejections, None, progress.at_times
        counts = jax.tree.map(lambda x: x.astype(jnp.int32), counts)
        return StepCounts.of(*counts), jnp.array(_OF_MIDPOINT)[progress.reason]
    limit = solution.result == diffrax.RESULTS.max_steps_reached
    status = jnp.where(limit, Status.MAX_STEPS, Status.STEP_FAILED)
    is_successful = solution.result == diffrax.RESULTS.successful
    status = jnp.where(is_successful, Status.SUCCESSFUL, status)
    accepted, rejected = (
        jnp.broadcast_to(solution.stats[f"num_{name}_steps"], shape)
        for name in ("accepted", "rejected")
    )
    return StepCounts.of(accepted, rejected), jnp.broadcast_to(status, shape)


# in the order of the outcomes of ``_iteration.py``
_OF_LOOP = (
    Status.SUCCESSFUL,
    Status.SUCCESSFUL,
    Status.MAX_STEPS,
    Status.STEP_FAILED,
    Status.NOT_FINITE,
    Status.SLIDING,
    Status.SUCCESSFUL,
)

_OF_MIDPOINT = (Status.SUCCESSFUL, Status.MAX_STEPS, Status.STEP_FAILED, Status.NOT_FINITE)


def _torques_act(scene: Scene) -> bool:
    """Whether torques act on the body, including those of coupled wheels: it may be damped."""
    return scene.torque is not None or bool(scene.dynamics.coupled)


def may_jump(scene: Scene) -> bool:
    """Whether the field may have switches: it contains a user's function or a part that is not
    smooth."""

    def is_sharp(x) -> bool:
        return not x.smooth if isinstance(x, AbstractPart) else callable(x)

    parts = (scene.inertia, scene.potential, scene.torque, scene.rotors)
    return any(is_sharp(x) for x in jax.tree.leaves(parts, is_leaf=is_sharp))
