"""The interface of methods: options, samples, status, and checks of the input of a simulation."""

import abc
import enum
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from polhode._checks import as_float_array, describe, is_concrete, require, require_digits
from polhode._parts import as_static, check_fields, takes
from polhode._scene import Scene, State, check_scene

# Outcomes of a simulation.


class Status(enum.IntEnum):
    """Outcome per body, as stored in ``Trajectory.status``."""

    SUCCESSFUL = 0
    MAX_STEPS = 1
    NOT_FINITE = 2
    CHART_SINGULAR = 3
    STEP_FAILED = 4
    INACCURATE = 5
    NOT_PHYSICAL = 6
    BAD_TIMES = 7
    SLIDING = 8
    TOO_MANY_EVENTS = 9

    @property
    def explanation(self) -> str:
        """The cause and the remedy."""
        return _EXPLANATIONS[self]


_EXPLANATIONS = {
    Status.SUCCESSFUL: "finished",
    Status.MAX_STEPS: (
        "the solver used up max_steps before the last time: raise max_steps on the method,"
        " loosen rtol, or shorten ts; damping far faster than the motion needs an implicit solver,"
        " such as ph.LiePoisson(diffrax.Kvaerno5(), chunk=1)"
    ),
    Status.NOT_FINITE: (
        "a NaN or infinity appeared: look at this body's inertia, state, potential and torque, and"
        " at limits that must be positive, pulses that must end after they start and times of"
        " tables that must ascend; or"
        " the closed-form solution passed as method is not valid for its numbers (symmetry, centre"
        " of mass, initial state): leave method=None"
    ),
    Status.CHART_SINGULAR: (
        "theta reached 0 or pi, where Euler angles break down: use ph.LiePoisson (or leave"
        " method=None) for this body"
    ),
    Status.STEP_FAILED: (
        "the steps became too short to continue, or an implicit solve gave up: a torque that jumps"
        " again and again, or damping far faster than the motion, which needs an implicit solver"
        " such as ph.LiePoisson(diffrax.Kvaerno5(), chunk=1)"
    ),
    Status.INACCURATE: (
        "the estimated error exceeds ten times the requested tolerance: the body is chaotic, or its"
        " rounding alone is more; loosen rtol, shorten ts, or use float64"
    ),
    Status.NOT_PHYSICAL: (
        "no body has this inertia: moments must be positive and each at most the sum of the two"
        " others, a tensor symmetric, and a wheel's moment less than the body's about its axis;"
        " to use published values that violate the inequality, call"
        " ph.Inertia.from_moments(..., physical=False)"
    ),
    Status.SLIDING: (
        "the motion slides along a switch: a comparison in a torque (where, sign, a threshold)"
        " drives the body back from both sides; make the torque continuous there, for instance"
        " x / width clipped to -1 and 1 in place of sign(x)"
    ),
    Status.TOO_MANY_EVENTS: (
        "the body met more events than are stored (trajectory.events.count tells how many): give"
        " ph.Event(..., capacity=n)"
    ),
    Status.BAD_TIMES: "ts is not strictly increasing or strictly decreasing: sort it",
}


class StepCounts(NamedTuple):
    """Numbers of steps of each body by what limited them; see ``Trajectory.step_counts``.

    **Fields**, each (...) of integers: ``accepted``; ``refused``: attempts whose error was too
    large, repeated with a shorter step; ``at_switches``: steps that ended at a switch of a torque
    or at an event; ``at_times``: steps shortened to end at a saved time; ``at_stability``: explicit
    Runge-Kutta steps limited by stability, because of a fast decay (``ph.explain`` names an
    implicit method). All others were limited by the error of the step. Methods that use a solver
    of diffrax count the first two only.
    """

    accepted: Array
    refused: Array
    at_switches: Array
    at_times: Array
    at_stability: Array

    @classmethod
    def of(
        cls,
        accepted: Array,
        refused: Array | None = None,
        at_switches: Array | None = None,
        at_times: Array | None = None,
        at_stability: Array | None = None,
    ) -> "StepCounts":
        """These counts; those that are None are zero."""
        accepted = jnp.asarray(accepted)
        others = (refused, at_switches, at_times, at_stability)
        return cls(accepted, *(jnp.zeros_like(accepted) if x is None else x for x in others))


class SimulationError(RuntimeError):
    """Some bodies did not finish; ``status`` (of the shape of the batch) states which and why."""

    def __init__(self, message: str, status: Array):
        super().__init__(message)
        self.status = status


# The interface of all methods.


class Record(eqx.Module):
    """What a simulation saves: attitude, rates, all times or the last one, or a function of them.

    ``attitude``, ``rates``, ``final_only`` (static): attitude (..., T, 4) and body rates
    (..., T, 3) at all times, or at the last one.

    ``work``: also integrate the work [J] of the external torques. ``error``: also estimate the
    error of each body at the last time, by a second, coarser run of about the same cost. Bodies
    with an estimate of more than ten times the tolerance get ``Status.INACCURATE``: chaotic
    bodies, and those whose rounding error exceeds the tolerance.

    ``save``: a function of the motion that is stored instead of attitude and rates, as
    ``Trajectory.saved``. It is called with the ``Trajectory`` of one body, without batch axes, and
    returns an array (T, ...) or a pytree of such arrays: one row for each sample. It is mapped over
    batches, one chunk of bodies at a time, so that the states of all bodies are not in memory at
    the same time (under ``vmap`` and in reverse mode they are). After the failure of a body its
    rows are NaN. Of the states only the last is stored: see ``Trajectory.last``. If the function is
    an ``eqx.Module``, results are differentiable with respect to its arrays. Define the function
    once: each new function object is compiled again.

    Raises ValueError if nothing is recorded, TypeError for a ``save`` that does not take one
    argument; ``ph.simulate`` raises TypeError or ValueError for values that are not such arrays.

        record = ph.Record(save=lambda trajectory: trajectory.momentum_space)
    """

    attitude: bool = eqx.field(static=True, default=True)
    rates: bool = eqx.field(static=True, default=True)
    final_only: bool = eqx.field(static=True, default=False)
    work: bool = eqx.field(static=True, default=False)
    error: bool = eqx.field(static=True, default=False)
    save: Callable | None = None

    def __init__(
        self,
        attitude: bool = True,
        rates: bool = True,
        final_only: bool = False,
        work: bool = False,
        error: bool = False,
        save: Callable | None = None,
    ):
        self.attitude, self.rates, self.final_only = attitude, rates, final_only
        self.work, self.error = work, error
        if save is not None:
            takes("Record(save=)", save, ("trajectory",))
            save = as_static(save)
        self.save = save
        if not (self.attitude or self.rates):
            raise ValueError("this Record would save nothing: set attitude, rates or both to True.")

    @property
    def of_states(self) -> "Record":
        """The same without ``save``."""
        return Record(self.attitude, self.rates, self.final_only, self.work, self.error)


class Samples(NamedTuple):
    """Results of a method for N lanes: ``wxyz`` (N, T, 4), ``omega_body`` (N, T, 3), ``status``
    (N,), ``steps`` (N,), ``work`` (N, T), ``error`` (N,).

    ``error``: sum of the estimated errors of the steps, if the method estimates it.
    ``motor_work`` (N, T, m): of every wheel; ``spins``: momenta of the coupled wheels; or None.
    ``saved``, ``final``: for ``Record(save=)``, its values, and attitude, rates and momenta of
    coupled wheels at the last time; they are not set by methods.
    """

    wxyz: Array | None
    omega_body: Array | None
    status: Array
    steps: StepCounts
    work: Array | None = None
    error: Array | None = None
    motor_work: Array | None = None
    spins: Array | None = None
    saved: Any = None
    final: tuple[Array | None, Array | None, Array | None] | None = None


class AbstractMethod(eqx.Module):
    """Base of all methods. ``run`` computes the motion of N lanes; ``ph.simulate`` checks the input
    and handles batches.

    ``exact``: whether the method is a closed form, which does not compute the work.
    """

    exact: ClassVar[bool] = False

    @property
    def is_compensated(self) -> bool:
        """Whether rounding errors are compensated, so that they do not grow with the angle."""
        return False

    @property
    def keeps_rtol(self) -> bool:
        """Whether ``rtol`` controls the accuracy of the motion."""
        return False

    @property
    def name(self) -> str:
        """The name that ``ph.explain`` prints."""
        return type(self).__name__

    @abc.abstractmethod
    def run(self, scene: Scene, state: State, ts: Array, rtol: Array, record: Record) -> Samples:
        """Samples at ``ts`` (T,) or (N, T) of lanes whose ``state`` is that at the first time."""

    def steps_of(self, scene: Scene, state: State, ts: Array, record: Record) -> str:
        """Description of the steps for N lanes, for ``ph.explain``; empty for a closed form."""
        return ""

    def search(
        self, scene: Scene, state: State, ts: Array, rtol: Array, search: Any, final_only: bool
    ) -> Any:
        """Samples and events, if the method searches for events during the motion; else None."""
        return None


# Checks of the options of integrations.


def check_options(
    solver: Any,
    controller: Any = None,
    adjoint: Any = None,
    *,
    dt0: Any = None,
    max_steps: Any = None,
    chunk: Any = None,
) -> None:
    """Check the options of an integration: instances of diffrax's classes, and positive integers.

    Raises TypeError for another type, ValueError for an option that is not possible here.
    """
    import diffrax  # here, so that closed forms do not load it

    for name, value, kind, example in (
        ("solver", solver, diffrax.AbstractSolver, "diffrax.Dopri8()"),
        (
            "controller",
            controller,
            diffrax.AbstractStepSizeController,
            "diffrax.PIDController(rtol=1e-9, atol=1e-9)",
        ),
        ("adjoint", adjoint, diffrax.AbstractAdjoint, "diffrax.RecursiveCheckpointAdjoint()"),
    ):
        if isinstance(value, kind) or (value is None and name != "solver"):
            continue
        if isinstance(value, type) and issubclass(value, kind):
            raise TypeError(
                f"{name} must be an object, got the class {value.__name__}: make one of it,"
                f" {constructor_call(value)}."
            )
        raise TypeError(
            f"{name} must be a diffrax object such as {example}, got {type(value).__name__}:"
            f" {value!r:.60}."
        )
    if isinstance(adjoint, diffrax.BacksolveAdjoint):
        raise ValueError(
            "adjoint=diffrax.BacksolveAdjoint() integrates the motion backward, which misses rtol,"
            " and gives no derivatives with respect to the scene: use ph.FlowAdjoint() (the"
            " default), diffrax.RecursiveCheckpointAdjoint(), or diffrax.ForwardMode() for jax.jvp."
        )
    if isinstance(getattr(solver, "term_structure", None), tuple):
        raise ValueError(
            f"{type(solver).__name__} splits positions from momenta, whose rates here depend on"
            " both: use another solver, such as diffrax.Dopri8()."
        )
    if dt0 is not None:
        step = as_float_array("dt0", dt0)
        if step.ndim or (is_concrete(step) and float(step) == 0):
            raise ValueError(f"dt0 must be one step in seconds, not zero, got {dt0!r:.60}.")
    for name, value in (("max_steps", max_steps), ("chunk", chunk)):
        if value is None:
            continue
        if isinstance(value, bool) or not isinstance(value, int | np.integer):
            raise TypeError(
                f"{name} must be an integer, got {type(value).__name__}: {value!r:.40}."
            )
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}.")


def constructor_call(x: Any) -> str:
    """The constructor call of this class, or of the class of this object, for messages."""
    kind = x if isinstance(x, type) else type(x)
    room = kind.__module__.split(".")[0]
    return f"{'ph' if room == 'polhode' else room}.{kind.__name__}()"


# Checks of what users pass to ``simulate``: types, dtypes, times and tolerances.


def check_method(method: Any) -> None:
    """TypeError unless ``method`` is None or an instance of a method class."""
    if method is None or isinstance(method, AbstractMethod):
        return
    import diffrax  # here, so that closed forms do not load it

    kind = method if isinstance(method, type) else type(method)
    if isinstance(method, type) and issubclass(method, AbstractMethod):
        description, remedy = (
            f"the class {method.__name__}",
            f": make an object of it, {constructor_call(method)}",
        )
    elif issubclass(kind, diffrax.AbstractSolver):
        description, remedy = (
            f"the solver {kind.__name__}",
            f": pass it to a coordinate system, ph.LiePoisson({constructor_call(method)})",
        )
    else:
        description, remedy = type(method).__name__, ""
        if callable(method) and getattr(method, "__module__", "").startswith("polhode."):
            description, remedy = (
                f"the function {method.__name__}",
                f": call it, ph.{method.__name__}()",
            )
    raise TypeError(
        f"method must be None or an object such as ph.LiePoisson(), got {description}{remedy}."
    )


def check_kinds(scene: Any, state: Any) -> None:
    """TypeError unless ``scene`` is a ``Scene`` and ``state`` a ``State``."""
    for name, value, kind in (("scene", scene, Scene), ("state", state, State)):
        if not isinstance(value, kind):
            raise TypeError(f"{name} must be a ph.{kind.__name__}, got {type(value).__name__}.")


def of_one_dtype(name: str, tree: Any) -> tuple[Any, Any]:
    """The tree with weakly typed numbers in the dtype of its arrays, and that dtype. Raises
    TypeError for several dtypes, or one of too low precision."""
    dtypes = _dtypes(jax.tree.leaves(tree))
    if len(dtypes) > 1:
        tree = _in_one_dtype(tree)
        dtypes = _dtypes(jax.tree.leaves(tree))
    if len(dtypes) != 1:
        raise TypeError(
            f"{name} mix the dtypes {sorted(map(str, dtypes))}: make all arrays of one"
            " dtype, for example with jnp.asarray(x, jnp.float64)."
        )
    dtype = dtypes.pop()
    if dtype not in (jnp.float32, jnp.float64):
        raise TypeError(
            f"{name} are of {dtype}, whose precision is too low: make all"
            " arrays float32 or float64, for example with jnp.asarray(x, jnp.float32)."
        )
    return tree, dtype


def check_inputs(
    scene: Any, state: Any, ts: Any, record: Any
) -> tuple[Scene, State, Array, Record]:
    """The checked input of ``ph.simulate``: types, dtypes and times."""
    check_kinds(scene, state)
    record = _DEFAULT if record is None else record
    if not isinstance(record, Record):
        raise TypeError(f"record must be a ph.Record or None, got {type(record).__name__}.")
    check_scene(scene)
    check_fields(state, "state")
    (scene, state), dtype = of_one_dtype("scene and state", (scene, state))
    ts = _times(ts, dtype)
    check_times(ts)
    return scene, state, ts, record


def _dtypes(leaves: list[Any]) -> set[Any]:
    """The dtypes of the arrays of inexact numbers."""
    dtypes = {x.dtype for x in leaves if isinstance(x, _ARRAYS)}
    return {x for x in dtypes if jnp.issubdtype(x, jnp.inexact)}


def _in_one_dtype(tree: Any) -> Any:
    """The tree with weakly typed arrays (Python numbers, defaults) in the dtype of the others."""
    leaves = jax.tree.leaves(tree)
    strong = _dtypes([x for x in leaves if not (isinstance(x, jax.Array) and x.weak_type)])
    if len(strong) != 1:
        return tree
    (dtype,) = strong

    def cast(x):
        weak = isinstance(x, jax.Array) and x.weak_type
        return x.astype(dtype) if weak and jnp.issubdtype(x.dtype, jnp.inexact) else x

    return jax.tree.map(cast, tree)


_DEFAULT = Record()
_ARRAYS = (jax.Array, np.ndarray)


def _times(ts: Any, dtype: Any) -> Any:
    """Times (..., T) of the dtype; concrete ones as NumPy arrays, which need no dispatch."""
    kinds = (float, int, np.float64, np.int64)
    if isinstance(ts, list | tuple) and all(type(x) in kinds for x in ts):
        ts = np.asarray(ts, float)
    if isinstance(ts, np.ndarray) and ts.dtype.kind == "f" and ts.ndim and np.isfinite(ts).all():
        times = np.asarray(ts, dtype)
        if ts.itemsize > times.itemsize:
            require_digits("ts", ts, times)
        return times
    ts = as_float_array("ts", ts, (None,))
    return ts if ts.dtype == dtype else ts.astype(dtype)


def check_times(ts: Array | np.ndarray) -> None:
    """ValueError for fewer than two times, or concrete ones that are not strictly monotonic."""
    if ts.shape[-1] < 2:  # no ``require``: to format the message takes longer than a simulation
        given = describe(ts) if is_concrete(ts) else f"an array of shape {ts.shape}"
        raise ValueError(f"ts must hold at least two times, got {given}: the state holds at ts[0].")
    if not is_concrete(ts):
        return
    ts = np.asarray(ts)
    steps = np.diff(ts, axis=-1)
    good = np.all(steps > 0, axis=-1) | np.all(steps < 0, axis=-1)
    if not np.all(good):
        row = np.argmin(good.reshape(-1))
        ts, steps = (x.reshape(-1, x.shape[-1])[row] for x in (ts, steps))
        turn = int(np.argmax((steps <= 0) if steps[0] > 0 else (steps >= 0)))
        raise ValueError(
            "ts must be strictly increasing or strictly decreasing (in the dtype of the state,"
            f" {ts.dtype}); entries {turn} and {turn + 1} are {ts[turn]} and"
            f" {ts[turn + 1]}: sort them and drop repeated ones."
        )


def default_rtol(dtype: Any) -> float:
    """The default of ``rtol``: 1e-9 in float64, 1e-5 in float32."""
    return 1e-9 if float(jnp.finfo(dtype).eps) < 1e-9 else 1e-5


def check_rtol(rtol: float | None, dtype) -> Array | np.ndarray:
    """The tolerance in the dtype of the state; a concrete number remains concrete under ``jit``."""
    if rtol is None:
        return np.asarray(default_rtol(dtype), dtype)
    if isinstance(rtol, Tracer) and rtol.ndim == 0:
        return jnp.asarray(rtol, dtype)
    eps = float(jnp.finfo(dtype).eps)
    number = _number("rtol", rtol)
    require(np.isfinite(number) and number > 0, f"rtol must be positive, got {rtol}.")
    require(
        number >= 8 * eps,
        f"rtol={number:g} is below what {jnp.dtype(dtype).name} can reach (about {8 * eps:.0e}):"
        " raise rtol, or use float64 (jax.config.update('jax_enable_x64', True)).",
    )
    require(
        number < 1,
        f"rtol must be below 1, got {number:g}: it is the error of the attitude in radians, and"
        " that of the momentum relative to its size.",
    )
    return np.asarray(number, dtype)


def _number(name: str, value: Any) -> float:
    """A concrete real number; TypeError for strings, truth values, arrays and anything else."""
    try:
        if isinstance(value, str | bytes | bool) or np.ndim(value) != 0:
            raise TypeError("no number")
        return float(value)
    except (TypeError, ValueError) as error:
        raise TypeError(
            f"{name} must be one number, such as 1e-9, got {type(value).__name__}: {value!r:.60}."
        ) from error


def raise_on_failure(
    status: Array,
    remedy: str = "Pass throw=False to get the trajectory with its status per body.",
) -> None:
    """SimulationError if bodies failed: for each status the number of bodies and the first one."""
    ended = np.asarray(status)
    if not ended.any():  # all Status.SUCCESSFUL
        return
    lines = []
    for code in np.unique(ended[ended != Status.SUCCESSFUL]):
        indices = np.argwhere(ended == code)
        first = tuple(int(i) for i in indices[0])
        which = (
            f"{len(indices)} of {ended.size} bodies (first: index {first})" if first else "the body"
        )
        lines.append(f"{which}: {Status(int(code)).explanation}")
    raise SimulationError(f"{'; '.join(lines)}. {remedy}", ended)


def status_with_input_errors(
    status: Array, scene: Scene, ts: Array, rtol: Array | float | None
) -> Array:
    """The status (N,) of lanes, replaced by that of invalid input where the input is invalid.

    These are the checks of ``check_inputs``, here in the compiled program, for traced numbers: a
    few operations for each body. ``scene``: that of the lanes; ``ts`` (T,) or (N, T).
    """
    if rtol is not None:
        min_rtol = 8 * float(jnp.finfo(ts.dtype).eps)
        is_too_small = (status == Status.SUCCESSFUL) & ~(rtol >= min_rtol * 0.99)
        status = jnp.where(is_too_small, Status.INACCURATE, status)
    status = jnp.where(scene.is_possible, status, Status.NOT_PHYSICAL)
    steps = jax.lax.stop_gradient(ts[..., 1:] - ts[..., :-1])
    ordered = jnp.all(steps > 0, axis=-1) | jnp.all(steps < 0, axis=-1)
    return jnp.where(ordered, status, Status.BAD_TIMES)
