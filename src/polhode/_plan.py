"""The choice of a method: the first closed form that the types allow, otherwise integration."""

import functools
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from polhode import _policy
from polhode._batch import PARTS, common_batch, flatten, lane_times
from polhode._checks import is_concrete
from polhode._closed_forms import ClosedForm, FixedAxis, LagrangeTop, SymmetricTop
from polhode._closed_forms._closed_form import VARIABLE, AbstractClosedForm
from polhode._kernels import jit_distinct
from polhode._method import AbstractMethod, Record, default_rtol
from polhode._scene import GravityGradient, Scene, State, UniformGravity, constructors, specialise
from polhode.inertia import Symmetry, VariableInertia


@dataclass(frozen=True)
class Plan:
    """The chosen method, what is skipped, and the reasons; ``print`` shows them.

    **Fields:** ``method``; ``reason``: why this one; ``skipped``: what is absent from the compiled
    program, with the reason; ``bodies``, ``samples``, ``dtype``: the size of the problem;
    ``error``: the expected error of the attitude, in words; ``refused``: the closed forms that do
    not apply, with the reason, if the motion is integrated; ``narrower``: the constructors that
    allow a closed form for these numbers (``ph.specialise`` uses them); ``plain``: why the
    optimisations for CPUs are off, or None; ``stiff``: a description of a decay that limits
    explicit steps, or None.
    """

    method: AbstractMethod
    reason: str
    skipped: tuple[str, ...]
    bodies: int
    samples: int
    dtype: str
    error: str
    refused: tuple[str, ...] = ()
    narrower: tuple[str, ...] = ()
    plain: str | None = None
    stiff: str | None = None

    @property
    def closed_form(self) -> str | None:
        """The name of the closed-form solution; None if the motion is integrated."""
        return self.method.name if self.method.exact else None

    def __str__(self) -> str:
        lines = [
            f"{self.bodies:,} {'body' if self.bodies == 1 else 'bodies'} x {self.samples:,}"
            f" {'sample' if self.samples == 1 else 'samples'}, {self.dtype}",
            f"runs    {self.method.name}: {self.reason}",
            *_listed("skips", self.skipped),
            *_listed("not", self.refused),
            *_listed("allow", self.narrower),
            f"error   {self.error}",
        ]
        if self.plain is not None:
            lines.append(f"plain   without optimisations for CPUs: {self.plain}")
        if self.stiff is not None:
            lines.append(f"stiff   {self.stiff}")
        return "\n".join(lines)


def _listed(word: str, reasons: tuple[str, ...]) -> list[str]:
    return [f"{'' if i else word:8}{reason}" for i, reason in enumerate(reasons)]


class Solution(NamedTuple):
    """A closed-form solution: its name, the explanation that ``ph.explain`` prints, and the method
    that evaluates it.

    ``symmetry``: required symmetry of the type of the inertia; None: the method decides.
    """

    name: str
    explanation: str
    method: AbstractClosedForm
    symmetry: Symmetry | None = None

    def why_not(self, scene: Scene) -> str | None:
        """Why it is not valid for the types of the parts; None if it is valid."""
        if isinstance(scene.inertia, VariableInertia):
            return VARIABLE
        reason = self.method.why_not(scene)
        if reason is None and self.symmetry not in (None, scene.inertia.symmetry):
            return f"the inertia is not one of ph.Inertia.{self.symmetry.name.lower()}"
        return reason


CLOSED_FORMS = (
    Solution(
        "free body",
        "free and spherical: exact rotation about a fixed axis",
        ClosedForm(),
        Symmetry.SPHERICAL,
    ),
    Solution(
        "free body",
        "free and axisymmetric: exact regular precession",
        ClosedForm(),
        Symmetry.AXISYMMETRIC,
    ),
    Solution(
        "free body",
        "nothing acts on the body: exact motion in Jacobi elliptic functions",
        ClosedForm(),
    ),
    Solution(
        "Lagrange's top",
        "symmetric body, centre of mass on its axis, uniform gravity (Lagrange's top): exact motion"
        " in theta functions",
        LagrangeTop(),
    ),
    Solution(
        "symmetric top",
        "symmetric body with torque, damping or wheels about its axis: exact motion in elementary"
        " functions",
        SymmetricTop(),
    ),
    Solution(
        "fixed axis",
        "spin about one fixed principal axis: exact motion in elementary functions",
        FixedAxis(),
    ),
)


def choose_closed_form(scene: Scene) -> tuple[Solution | None, tuple[str, ...]]:
    """The first closed form that is valid for the types of the parts, or None; and why those before
    it are not."""
    refusals = []
    for solution in CLOSED_FORMS:
        reason = solution.why_not(scene)
        if reason is None:
            return solution, tuple(refusals)
        refusals.append(f"{solution.name}: {reason}")
    return None, tuple(dict.fromkeys(refusals))


def choose(scene: Scene, rtol: Array | float = 1e-9) -> tuple[AbstractMethod, str]:
    """The method that ``simulate(..., method=None)`` uses, and why.

    The choice depends on the types of the parts, and on ``rtol`` if it is concrete, but on no
    number of the scene, the state or the times. Therefore it is the same under ``jit``, ``vmap``
    and ``grad``.
    """
    solution = _closed_form_of(jax.tree.structure(scene))
    eps = float(jnp.finfo(scene.inertia.dtype).eps)
    if solution is None:
        reason = (
            "no closed form applies: integrated, with an estimated error below rtol at every saved"
            " time"
        )
        compensated = _is_below(rtol, _policy.COMPENSATED_STEPS * eps, scene)
        return _integration_method(_has_axis(scene), compensated, _low_order(scene, rtol)), reason
    general = scene.is_free and scene.inertia.symmetry is Symmetry.NONE
    if general and _is_below(rtol, _policy.COMPENSATED_PHASES * eps, scene):
        also = ", its frequencies in sums of two floats: a rounded phase would miss rtol"
        return _COMPENSATED, solution.explanation + also
    return solution.method, solution.explanation


@functools.lru_cache(maxsize=256)
def _closed_form_of(tree: Any) -> Solution | None:
    """The closed form of scenes of this tree structure, which does not contain their numbers."""
    return choose_closed_form(jax.tree.unflatten(tree, [0.0] * tree.num_leaves))[0]


_COMPENSATED = ClosedForm(compensated=True)


@functools.cache
def _integration_method(upright: bool, compensated: bool, low_order: bool) -> AbstractMethod:
    # imported here, so that diffrax is loaded with the first scene that is integrated
    from polhode._integrate import Automatic, LiePoisson, LiePoissonChart

    return LiePoisson(
        Automatic(None, compensated, low_order=low_order), chart=LiePoissonChart(upright)
    )


def _low_order(scene: Scene, rtol: Array | float) -> bool:
    """Whether the tolerance allows steps of lower order; False for scenes that cannot have many
    switches, so that their programs serve all tolerances."""
    from polhode._integrate import may_jump

    return may_jump(scene) and not _is_below(rtol, _policy.LOW_ORDER_RTOL, scene)


def _is_below(rtol: Array | float, limit: float, scene: Scene) -> bool:
    """Whether the tolerance is below the limit; a traced one counts as the default."""
    if is_concrete(rtol):
        return float(rtol) < limit
    return default_rtol(scene.inertia.dtype) < limit


def _has_axis(scene: Scene) -> bool:
    """Whether the potential depends on a single direction in space, and there is no torque."""
    potential = scene.potential
    if scene.torque is not None:
        return False
    if isinstance(potential, GravityGradient):
        return not callable(potential.position_space)
    return isinstance(potential, UniformGravity)


def _max_angle(state: State, ts) -> float:
    """The largest angle of rotation [rad] of a body, from its initial rate."""
    ts = np.asarray(ts)
    span = np.abs(ts[..., -1] - ts[..., 0])
    if not state.omega_body.size or not span.size:
        return 0.0
    if state.omega_body.size < 10_000:
        return float(np.max(np.linalg.norm(np.asarray(state.omega_body), axis=-1) * span))
    with jax.ensure_compile_time_eval():  # many bodies: on their devices, also under ``jit``
        size = jnp.linalg.norm(state.omega_body, axis=-1)
        return float(jnp.max(size * jnp.asarray(span, size.dtype)))


def plan(
    scene: Scene,
    state: State,
    ts: Array,
    method: AbstractMethod | None,
    rtol: Array,
    record: Record,
    reason: str = "as requested",
) -> Plan:
    """The plan for checked input (see ``ph.explain``); ``reason``: why ``method`` is used, if it is
    not None."""
    refusals, narrower, stiff = (), (), None
    if method is None:
        method, reason = choose(scene, rtol)
        if not method.exact:
            _, refusals = choose_closed_form(scene)
            stiff = _stiff(scene, state, ts)
        narrower = _narrower(scene)
    steps = "" if method.exact else _steps(method, scene, state, ts, record)
    reason = f"{reason}; {steps}" if steps else reason
    parts = (getattr(scene, name) for name in PARTS)
    bodies = int(np.prod(common_batch(*parts, state, extra=(ts.shape[:-1],)), dtype=int))
    samples = 1 if record.final_only else ts.shape[-1]
    return Plan(
        method,
        reason,
        _skipped(scene, method, record),
        bodies,
        samples,
        str(state.wxyz.dtype),
        _error(method, scene, state, ts, rtol),
        refusals,
        narrower,
        _policy.plain_reason(),
        stiff,
    )


_STIFF = 1e4
"""[relaxation times] In the time simulated, from which on ``explain`` warns. Explicit steps of
order 8 are stable up to about six relaxation times each."""


def _stiff(scene: Scene, state: State, ts: Array) -> str | None:
    """A warning if stability limits explicit steps; None otherwise."""
    if (scene.torque is None and scene.rotors is None) or not is_concrete(scene, state, ts):
        return None
    try:
        rate = float(np.max(_decay(scene, state, ts), initial=0))
    except ValueError:  # a part has no derivative, such as a callback to Python
        return None
    number = rate * float(np.max(np.abs(ts[..., -1] - ts[..., 0])))
    if not number >= _STIFF:
        return None
    return (
        f"the fastest decay, {rate:.1e}/s, is {number:.0e} times shorter than the motion: explicit"
        " steps are not much longer than it; ph.LiePoisson(diffrax.Kvaerno5(), chunk=1) is implicit"
    )


def _decay(scene: Scene, state: State, ts: Array) -> np.ndarray:
    """Rate [1/s] (...) of the fastest decay of body rates and wheel speeds. The equations are
    linearised at the start and where the wheels are at rest in the body, since friction changes
    most there."""
    rates = []
    for jacobian in _jacobians(scene, state, ts):
        if isinstance(jacobian, Tracer):  # a function in the scene closes over a traced value
            return np.zeros(jacobian.shape[:-2])
        jacobian = np.asarray(jacobian, float)
        finite_jacobian = np.where(np.isfinite(jacobian), jacobian, 0)
        rates.append(np.max(-np.linalg.eigvals(finite_jacobian).real, axis=-1))
    return np.max(np.stack(rates), axis=0)


@jit_distinct  # one program: its operations one by one take ten times as long
def _jacobians(scene: Scene, state: State, ts: Array) -> list[Array]:
    """Jacobians (..., n, n) [1/s] of the rates of change of body rates and wheel momenta, at the
    points of ``_decay``."""
    state = state.as_unit()
    scene, t = scene.settled(state, ts[..., 0]), ts[..., 0]
    parts = (getattr(scene, name) for name in PARTS)
    batch = common_batch(*parts, state.without_wheels, extra=(ts.shape[:-1],))
    omega = jnp.broadcast_to(state.omega_body, (*batch, 3))
    wxyz = jnp.broadcast_to(state.wxyz, (*batch, 4))
    components = tuple(jnp.moveaxis(omega, -1, 0))
    wheels = scene.dynamics.wheels if scene.dynamics.coupled else None
    points = [()] if wheels is None else [wheels.initial_spins(components[0])]
    if wheels is not None:

        def speeds(spins):
            return [wheels.at(spins).speed(i, t, components) for i in wheels.coupled]

        at_zero, at_one = (
            speeds([jnp.full(batch, value, omega.dtype) for _ in points[0]]) for value in (0, 1)
        )
        points.append(tuple(-a / (b - a) for a, b in zip(at_zero, at_one)))

    def jacobian(spins):
        def rates(y):
            wheel_spins = tuple(x + y[..., 3 + k] for k, x in enumerate(spins))
            acceleration, wheel_torques = scene.with_spins(wheel_spins).changes(
                wxyz, omega + y[..., :3], t
            )
            columns = [jnp.broadcast_to(x, batch)[..., None] for x in wheel_torques]
            return jnp.concatenate([acceleration, *columns], axis=-1)

        def along(direction):
            origin = jnp.zeros((*batch, direction.size), omega.dtype)
            return jax.jvp(rates, (origin,), (jnp.broadcast_to(direction, origin.shape),))[1]

        directions = jnp.eye(3 + len(spins), dtype=omega.dtype)
        return jax.vmap(along, out_axes=-1)(directions)

    return [jacobian(spins) for spins in points]


def _narrower(scene: Scene) -> tuple[str, ...]:
    """The constructors that would permit a simpler closed form for these numbers."""
    if not is_concrete(scene):
        return ()
    special = specialise(scene)
    solution, _ = choose_closed_form(special)
    if solution is None or solution == choose_closed_form(scene)[0]:
        return ()
    names = ", ".join(constructors(scene, special))
    return (f"{names} would say what these numbers are: {solution.name} in closed form",)


def _steps(method, scene: Scene, state: State, ts: Array, record: Record) -> str:
    """The description of the steps, for the lanes that ``simulate`` would integrate."""
    words: list[str] = []

    def describe_lanes(scene, state, ts):
        scene, state = scene.settled(state, ts[..., 0]), state.without_wheels
        parts = {name: getattr(scene, name) for name in PARTS}
        batch = common_batch(*parts.values(), state, extra=(ts.shape[:-1],))
        lanes = Scene(**{name: flatten(part, batch) for name, part in parts.items()})
        times = lane_times(ts, batch)
        words.append(method.steps_of(lanes, flatten(state, batch, shared=False), times, record))

    eqx.filter_eval_shape(describe_lanes, scene, state, ts)
    return words[0]


def _skipped(scene: Scene, method: AbstractMethod, record: Record) -> tuple[str, ...]:
    reasons = []
    absent_parts = [name for name in PARTS if getattr(scene, name) is None]
    if absent_parts:
        reasons.append(f"{', '.join(absent_parts)}: not in the scene")
    if method.exact:
        reasons.append("steps, error control, checkpoints: the solution is exact")
    if isinstance(method, ClosedForm):
        if scene.inertia.symmetry is not Symmetry.NONE:
            reasons.append("elliptic functions: circular ones do for this symmetry")
        reasons.append("energy and momentum per sample: constants of the motion")
    if scene.inertia.is_principal:
        reasons.append("principal axes: the body axes are principal")
    if not record.attitude:
        reasons.append("attitude and the integral of the third kind: only rates are recorded")
    if not record.rates:
        reasons.append("rates at the samples: only the attitude is recorded")
    if record.save is not None:
        reasons.append("attitude and rates in memory: a function of the motion is saved instead")
    if record.final_only:
        reasons.append("the trajectory buffer: only the last time is recorded")
    if not method.exact:
        reasons.append("checkpoints: stored only under jax.grad")
    return tuple(reasons)


_MEANING = "as the steps estimate it (docs/methods.md: What rtol means)"


def _error(method: AbstractMethod, scene: Scene, state: State, ts: Array, rtol: Array) -> str:
    """The expected error of the attitude, in words."""
    eps = float(jnp.finfo(state.wxyz.dtype).eps)
    if not method.exact:
        if not method.keeps_rtol:
            return "unknown: the requested steps do not follow from rtol"
        if not is_concrete(rtol):
            return f"about rtol rad at every saved time, {_MEANING}"
        if is_concrete(state.omega_body, ts) and 4 * eps * _max_angle(state, ts) > float(rtol):
            angle = _max_angle(state, ts)
            return (
                f"about {4 * eps * angle:.0e} rad at the last time: over a rotation of {angle:.2g}"
                f" rad, rounding exceeds the requested {rtol:.0e}"
            )
        return f"about {rtol:.0e} rad at every saved time, {_MEANING}"
    if method.is_compensated and scene.inertia.symmetry is Symmetry.NONE:
        return f"rounding only: about {4 * eps:.0e} rad at any time (compensated phases)"
    if not is_concrete(state.omega_body, ts):
        return f"rounding only: about {eps:.0e} per radian turned"
    angle = _max_angle(state, ts)
    return (
        f"rounding only: about {max(1.0, angle) * eps:.0e} rad at the last time"
        f" (one unit in the last place of {angle:.2g} rad turned)"
    )
