"""The planner: the cheapest way that is exact enough, from the scene's structure alone."""

import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polhode._batch import PARTS, common_batch, flatten, lane_times
from polhode._checks import is_concrete
from polhode._closed_forms import CLOSED_FORMS, ClosedForm, choose_closed_form
from polhode._method._base import AbstractMethod, Record
from polhode._scene import GravityGradient, Scene, State, UniformGravity
from polhode.inertia import Symmetry


@dataclass(frozen=True)
class Plan:
    """The chosen method, what is skipped, and the reasons; ``print`` shows them.

    **Fields:** ``method``; ``reason``: why this one; ``skipped``: what is absent from the compiled
    program, with the reason; ``bodies``, ``samples``, ``dtype``: the size of the work;
    ``error``: the attitude error to be expected, in words; ``refused``: the closed forms that do
    not apply, with the reason, if the motion is integrated.
    """

    method: AbstractMethod
    reason: str
    skipped: tuple[str, ...]
    bodies: int
    samples: int
    dtype: str
    error: str
    refused: tuple[str, ...] = ()

    @property
    def closed_form(self) -> str | None:
        """The name of the closed-form solution; None where the motion is integrated."""
        return self.method.name if self.method.exact else None

    def __str__(self) -> str:
        lines = [
            f"{self.bodies:,} {'body' if self.bodies == 1 else 'bodies'} x {self.samples:,}"
            f" {'sample' if self.samples == 1 else 'samples'}, {self.dtype}",
            f"runs    {self.method.name}: {self.reason}",
            *_listed("skips", self.skipped),
            *_listed("not", self.refused),
            f"error   {self.error}",
        ]
        return "\n".join(lines)


def _listed(word: str, reasons: tuple[str, ...]) -> list[str]:
    return [f"{'' if i else word:8}{reason}" for i, reason in enumerate(reasons)]


def choose(
    scene: Scene,
    state: State,
    record: Record,
    rtol: Array | float = 1e-9,
    ts: Array | None = None,
) -> tuple[AbstractMethod, str]:
    """The method that ``simulate(..., method=None)`` uses, and why.

    The scene's structure decides; values only where they are known (not traced), for the laws
    that hold for special bodies and states, and, with the times ``ts``, for horizons so long that
    the rounding of a phase would miss ``rtol`` tenfold.
    """
    ways = ways_of(scene, state, record)
    number = int(_misses(ways, state, rtol, ts))
    return ways.methods[number], ways.says[number]


class Ways(NamedTuple):
    """How a scene is moved: plainly, or with sums that are carried along in two floats where the
    rounding of plain ones would miss ``rtol``.

    ``methods``, ``says``: of the two. Rounding takes about ``eps * angle**power`` of the attitude,
    and may take ``factor * rtol``; ``least``: the tolerance over eps from which plain sums do at
    all. ``of_state``: whether other states of the same scene may be moved otherwise.
    """

    methods: tuple[AbstractMethod, AbstractMethod]
    says: tuple[str, str]
    power: float = 0.0
    factor: float = math.inf
    least: float = 0.0
    of_state: bool = False

    def reach(self, rtol: float, eps: float) -> float:
        """Angle [rad] up to which plain sums are good enough."""
        if self.factor == math.inf:
            return math.inf
        return (self.factor * rtol / eps) ** (1 / self.power) if rtol >= self.least * eps else 0.0


def ways_of(scene: Scene, state: State, record: Record) -> Ways:
    """The ways that the planner chooses from."""
    law, _ = choose_closed_form(scene, state, record)
    if law is None:
        upright = scene.torque is None and _is_upright(scene.potential)
        says = (
            "something acts on the body: integrated in steps with an error estimate, held to"
            " rtol at every saved time"
        )
        both = tuple(_stepped(upright, compensated) for compensated in (False, True))
        also = says + ", its rounding carried along: it would miss rtol"
        of_state = any(law.of_state and law.method.objection(scene) is None for law in CLOSED_FORMS)
        return Ways(both, (says, also), 1.5, 1.5, 2000, of_state)
    if not scene.is_free or scene.inertia.symmetry is not Symmetry.NONE:
        return Ways(
            (law.method, law.method), (law.explanation, law.explanation), of_state=law.of_state
        )
    also = (
        law.explanation + ", its frequencies in sums of two floats: a rounded phase would miss rtol"
    )
    return Ways((law.method, _COMPENSATED), (law.explanation, also), 1.0, 10.0)


_COMPENSATED = ClosedForm(compensated=True)


@functools.cache
def _stepped(upright: bool, compensated: bool) -> AbstractMethod:
    # here, so that diffrax loads with the first scene that is integrated
    from polhode._integrate import Automatic, LiePoisson, LiePoissonChart

    return LiePoisson(Automatic(None, compensated), chart=LiePoissonChart(upright))


def _misses(ways: Ways, state: State, rtol, ts) -> bool:
    """Whether plain sums are known, or where nothing is known feared, to miss rtol."""
    eps = float(jnp.finfo(state.wxyz.dtype).eps)
    if not is_concrete(rtol):
        return ways.least > 0 and state.wxyz.dtype == jnp.float32
    reach = ways.reach(float(rtol), eps)
    if reach in (0, math.inf):
        return reach == 0
    return _is_known(state, ts) and _turned(state, ts) > reach


def _is_known(state: State, ts) -> bool:
    if ts is None or not is_concrete(state.omega_body, ts):
        return False
    return getattr(state.omega_body, "is_fully_addressable", True)


def _turned(state: State, ts) -> float:
    """Angle [rad] of the body that turns farthest."""
    ts = np.asarray(ts)
    span = np.abs(ts[..., -1] - ts[..., 0])
    if not state.omega_body.size or not span.size:
        return 0.0
    if state.omega_body.size < 10_000:
        return float(np.max(np.linalg.norm(np.asarray(state.omega_body), axis=-1) * span))
    with jax.ensure_compile_time_eval():  # many: where they lie, also under a user's jit
        size = jnp.linalg.norm(state.omega_body, axis=-1)
        return float(jnp.max(size * jnp.asarray(span, size.dtype)))


def _is_upright(potential) -> bool:
    """Whether the potential has one direction in space: uniform gravity known not to vanish, or a
    gravity gradient whose centre rests."""
    if isinstance(potential, GravityGradient):
        return not callable(potential.position_space)
    if not isinstance(potential, UniformGravity):
        return False
    force = (potential.mass, potential.gravity_space)
    return is_concrete(force) and bool(
        np.all(np.asarray(force[0]) > 0) and np.all(np.any(np.asarray(force[1]) != 0, axis=-1))
    )


def plan(
    scene: Scene,
    state: State,
    ts: Array,
    method: AbstractMethod | None,
    rtol: Array,
    record: Record,
) -> Plan:
    """The plan of checked input (see ``ph.explain``)."""
    reason, refused = "as asked for", ()
    if method is None:
        method, reason = choose(scene, state, record, rtol, ts)
        if not method.exact:
            _, refused = choose_closed_form(scene, state, record)
            reason = f"{reason}; {_steps(method, scene, state, ts, record)}"
    parts = (getattr(scene, name) for name in PARTS)
    bodies = int(np.prod(common_batch(*parts, state, extra=(ts.shape[:-1],)), dtype=int))
    samples = 1 if record.final_only else ts.shape[-1]
    return Plan(
        method, reason, _skipped(scene, method, record), bodies, samples,
        str(state.wxyz.dtype), _error(method, scene, state, ts, rtol), refused,
    )  # fmt: skip


def _steps(method, scene: Scene, state: State, ts: Array, record: Record) -> str:
    """The rule of the steps, found as ``simulate`` finds it."""
    words: list[str] = []

    def look(scene, state, ts):
        scene, state = scene.settled(state, ts[..., 0]), state.without_wheels
        parts = {name: getattr(scene, name) for name in PARTS}
        batch = common_batch(*parts.values(), state, extra=(ts.shape[:-1],))
        lanes = Scene(**{name: flatten(part, batch) for name, part in parts.items()})
        times = lane_times(ts, batch)
        words.append(method.steps_of(lanes, flatten(state, batch, shared=False), times, record))

    eqx.filter_eval_shape(look, scene, state, ts)
    return words[0]


def _skipped(scene: Scene, method: AbstractMethod, record: Record) -> tuple[str, ...]:
    reasons = []
    absent = [name for name in PARTS if getattr(scene, name) is None]
    if absent:
        reasons.append(f"{', '.join(absent)}: not in the scene")
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
    if record.final_only:
        reasons.append("the trajectory buffer: only the last time is recorded")
    if not method.exact:
        reasons.append("checkpoints: kept only under jax.grad")
    return tuple(reasons)


_MEANING = "as the steps estimate it (docs/methods.md: What rtol means)"


def _error(method: AbstractMethod, scene: Scene, state: State, ts: Array, rtol: Array) -> str:
    """The error of the attitude that is to be expected, in words."""
    eps = float(jnp.finfo(state.wxyz.dtype).eps)
    if not method.exact:
        if not method.keeps_rtol:
            return "as the steps asked for make it"
        if not is_concrete(rtol):
            return f"about rtol rad at every saved time, {_MEANING}"
        if is_concrete(state.omega_body, ts) and 4 * eps * _turned(state, ts) > float(rtol):
            turned = _turned(state, ts)
            return (
                f"about {4 * eps * turned:.0e} rad at the last time: rounding of {turned:.2g} rad"
                f" turned takes more than the {rtol:.0e} asked for"
            )
        return f"about {rtol:.0e} rad at every saved time, {_MEANING}"
    if getattr(method, "compensated", False) and scene.inertia.symmetry is Symmetry.NONE:
        return f"rounding only: about {4 * eps:.0e} rad at any time (compensated phases)"
    if not is_concrete(state.omega_body, ts):
        return f"rounding only: about {eps:.0e} per radian turned"
    turned = _turned(state, ts)
    return (
        f"rounding only: about {max(1.0, turned) * eps:.0e} rad at the last time"
        f" (one unit in the last place of {turned:.2g} rad turned)"
    )
