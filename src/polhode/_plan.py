"""The planner: the cheapest way that is exact enough, from the scene's structure alone."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polhode._checks import is_concrete
from polhode._closed_form import ClosedForm
from polhode._extrapolated import Extrapolated, lane_rates
from polhode._lanes import PARTS, common_batch, flatten
from polhode._methods import AbstractDiffraxMethod, AbstractMethod, LiePoisson, Record
from polhode._scene import Scene
from polhode._state import State
from polhode._top_methods import AbstractTopMethod, exact_top
from polhode.inertia import Symmetry
from polhode.solvers import Extrapolation, steps_for
from polhode.torques import GravityGradient, PotentialSum, UniformGravity

_FREE_LAWS = {
    Symmetry.NONE: "nothing acts on the body: exact motion in Jacobi elliptic functions",
    Symmetry.AXISYMMETRIC: "free and known to be axisymmetric: exact steady precession",
    Symmetry.SPHERICAL: "free and known to be spherical: exact turn about a fixed axis",
}


@dataclass(frozen=True)
class Plan:
    """What will run, what is skipped and why; ``print`` it.

    **Fields:** ``method``; ``law``: why this one; ``skipped``: what is absent from the compiled
    program, with the reason; ``bodies``, ``samples``, ``dtype``: the size of the work;
    ``seconds``: predicted run time on one core once compiled (None: unknown); ``error``:
    predicted attitude error in words.
    """

    method: AbstractMethod
    law: str
    skipped: tuple[str, ...]
    bodies: int
    samples: int
    dtype: str
    seconds: float | None
    error: str

    def __str__(self) -> str:
        cost = "unknown" if self.seconds is None else f"about {_duration(self.seconds)} on one core"
        lines = [
            f"{self.bodies:,} {'body' if self.bodies == 1 else 'bodies'} x {self.samples:,}"
            f" {'sample' if self.samples == 1 else 'samples'}, {self.dtype}",
            f"runs    {type(self.method).__name__}: {self.law}",
            *(
                f"{'skips   ' if i == 0 else '        '}{reason}"
                for i, reason in enumerate(self.skipped)
            ),
            f"cost    {cost}, once compiled",
            f"error   {self.error}",
        ]
        return "\n".join(lines)


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
    if scene.is_free:
        if scene.inertia.symmetry is Symmetry.NONE and _is_long(state, rtol, ts):
            return ClosedForm(compensated=True), _FREE_LAWS[Symmetry.NONE] + _LONG
        return ClosedForm(), _FREE_LAWS[scene.inertia.symmetry]
    exact = exact_top(scene, state, record)
    if exact is not None:
        return exact, exact.law
    compensated = _wanders(state, rtol, ts)
    if _is_steady(scene):
        falls = _falls(scene.potential)
        method = Extrapolated(
            _order(rtol),
            upright=falls or _pulled(scene.potential),
            on_axis=falls and _balanced(scene.potential),
            compensated=compensated,
        )
        return method, (
            f"a potential acts on the body: extrapolated midpoint rule of order {method.order}"
            f" in equal steps by each body's natural rate{_COMPENSATED * compensated}"
        )
    order = 10 if state.wxyz.dtype == jnp.float32 else min(14, _order(rtol))
    solver = Extrapolation(order, compact=True, compensated=compensated)
    method = LiePoisson(solver, at_end=True, adjoint=None)
    return method, (
        f"something acts on the body: extrapolated midpoint rule of order {order}, stepped with an"
        f" error estimate, held to rtol at the last time{_COMPENSATED * compensated}"
    )


_COMPENSATED = ", its rounding carried along: it would miss rtol"


def _wanders(state: State, rtol, ts) -> bool:
    """Whether the rounding of plain steps, which wanders and turns the body on, may miss rtol."""
    eps = float(jnp.finfo(state.wxyz.dtype).eps)
    if not is_concrete(rtol):
        return state.wxyz.dtype == jnp.float32
    if rtol < 2000 * eps:
        return True
    return _is_known(state, ts) and eps * _turned(state, ts) ** 1.5 > 5 * float(rtol)


def _is_steady(scene: Scene) -> bool:
    """Whether the natural rate alone says how finely to step: known, constant fields only."""
    if scene.potential is None or scene.torque is not None or scene.rotors is not None:
        return False
    whole = scene.potential
    return all(
        isinstance(x, UniformGravity)
        or (isinstance(x, GravityGradient) and not callable(x.position_space))
        for x in (whole.terms if isinstance(whole, PotentialSum) else (whole,))
    )


_LONG = ", its frequencies in sums of two floats: a rounded phase would miss rtol"


def _is_known(state: State, ts) -> bool:
    if ts is None or not is_concrete(state.omega_body, ts):
        return False
    return getattr(state.omega_body, "is_fully_addressable", True)


def _is_long(state: State, rtol, ts) -> bool:
    if not is_concrete(rtol) or not _is_known(state, ts):
        return False
    eps = float(jnp.finfo(state.omega_body.dtype).eps)
    return eps * _turned(state, ts) > 10 * float(rtol)


def _turned(state: State, ts) -> float:
    """Angle [rad] that the fastest body turns through."""
    ts = np.asarray(ts)
    if not state.omega_body.size:
        return 0.0
    if state.omega_body.size < 10_000:
        fastest = np.max(np.linalg.norm(np.asarray(state.omega_body), axis=-1))
    else:
        with jax.ensure_compile_time_eval():  # many: where they lie, also under a user's jit
            fastest = jnp.max(jnp.linalg.norm(state.omega_body, axis=-1))
    return float(fastest) * float(np.max(np.abs(ts[..., -1] - ts[..., 0])))


def _order(rtol) -> int:
    """Order of least work for a tolerance (benchmarks/integrators.py); 12 while it is traced."""
    if not is_concrete(rtol):
        return 12
    return next((o for o, bound in ((10, 1e-4), (12, 1e-8), (14, 1e-10)) if rtol >= bound), 16)


def _falls(potential) -> bool:
    """Whether the potential is uniform gravity that is known not to vanish."""
    if not isinstance(potential, UniformGravity):
        return False
    force = (potential.mass, potential.gravity_space)
    return is_concrete(force) and bool(
        np.all(np.asarray(force[0]) > 0) and np.all(np.any(np.asarray(force[1]) != 0, axis=-1))
    )


def _pulled(potential) -> bool:
    """Whether the potential is a gravity gradient whose centre rests."""
    return isinstance(potential, GravityGradient) and not callable(potential.position_space)


def _balanced(gravity: UniformGravity) -> bool:
    """Whether the centre of mass is known to lie on body z."""
    return is_concrete(gravity.centre_body) and not np.any(np.asarray(gravity.centre_body)[..., :2])


def plan(
    scene: Scene,
    state: State,
    ts: Array,
    method: AbstractMethod | None,
    rtol: Array,
    record: Record,
) -> Plan:
    """The plan of checked input (see ``ph.explain``)."""
    law = "as asked for"
    if method is None:
        method, law = choose(scene, state, record, rtol, ts)
    parts = (getattr(scene, name) for name in PARTS)
    bodies = int(np.prod(common_batch(*parts, state, extra=(ts.shape[:-1],)), dtype=int))
    samples = 1 if record.final_only else ts.shape[-1]
    eps = float(jnp.finfo(state.wxyz.dtype).eps)
    if isinstance(method, ClosedForm):
        seconds, error = _exact_cost(
            scene, state, ts, bodies, samples, record, eps, method.compensated
        )
    elif isinstance(method, AbstractTopMethod):
        seconds, error = None, "rounding only: a few units in the last place of the angle turned"
    else:
        seconds, error = _stepped_cost(method, scene, state, ts, bodies, rtol)
    return Plan(
        method, law, _skipped(scene, method, record), bodies, samples,
        str(state.wxyz.dtype), seconds, error,
    )  # fmt: skip


def _skipped(scene: Scene, method: AbstractMethod, record: Record) -> tuple[str, ...]:
    reasons = []
    absent = [name for name in PARTS if getattr(scene, name) is None]
    if absent:
        reasons.append(f"{', '.join(absent)}: not in the scene")
    if isinstance(method, ClosedForm | AbstractTopMethod):
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
    if isinstance(method, AbstractDiffraxMethod | Extrapolated):
        reasons.append("checkpoints: kept only under jax.grad")
    return tuple(reasons)


# Nanoseconds on one core of a server of 2020s make, float64: (set-up per body, per sample), with
# and without attitude; benchmarks/scene_cost.py measures them again.
_EXACT_NS = {(Symmetry.NONE, True): (130, 54), (Symmetry.NONE, False): (60, 30)}
_SYMMETRIC_NS = (60, 60)
_COMPENSATED_NS = 290


def _exact_cost(scene, state, ts, bodies, samples, record, eps, compensated) -> tuple[float, str]:
    start, each = _EXACT_NS.get((scene.inertia.symmetry, record.attitude), _SYMMETRIC_NS)
    compensated = compensated and scene.inertia.symmetry is Symmetry.NONE
    seconds = 1e-9 * bodies * (start + (_COMPENSATED_NS if compensated else 0) + each * samples)
    if compensated:
        return seconds, f"rounding only: about {4 * eps:.0e} rad at any time (compensated phases)"
    if not is_concrete(state.omega_body, ts):
        return seconds, f"rounding only: about {eps:.0e} per radian turned"
    turned = _turned(state, ts)
    return seconds, (
        f"rounding only: about {max(1.0, turned) * eps:.0e} rad at the last time"
        f" (one unit in the last place of {turned:.2g} rad turned)"
    )


# Seconds on the same core: an evaluation of the field for one body and for each of many, a step.
_EVALUATION, _EVALUATION_OF_MANY, _STEP = 4.5e-8, 2e-9, 5e-6


def _stepped_cost(method, scene, state, ts, bodies, rtol) -> tuple[float | None, str]:
    lasting = isinstance(method, Extrapolated) or getattr(method, "at_end", False)
    if not lasting or not is_concrete(scene, state, ts, rtol):
        where = "rad at the last time" if lasting else "per step, of the worst body of each chunk"
        return None, f"about {rtol:.0e} {where}" if is_concrete(rtol) else f"rtol {where}"
    scene = scene.settled(state, ts[..., 0])
    batch = common_batch(*(getattr(scene, name) for name in PARTS), state, extra=(ts.shape[:-1],))
    parts = {name: flatten(getattr(scene, name), batch) for name in PARTS}
    rate = np.asarray(lane_rates(Scene(**parts), flatten(state, batch, shared=False), ts))
    turned = float(np.max(rate) * np.max(np.abs(np.asarray(ts[..., -1] - ts[..., 0]))))
    reached = max(float(rtol), 4 * float(np.finfo(rate.dtype).eps) * turned)
    error = f"about {reached:.0e} rad at the last time"
    solver = Extrapolation(method.order) if isinstance(method, Extrapolated) else method.solver
    if not isinstance(solver, Extrapolation):
        return None, error
    steps = float(steps_for(solver.formal_order, rtol, 1.0, turned))
    each = solver.evaluations * max(_EVALUATION, _EVALUATION_OF_MANY * bodies)
    own = 0 if isinstance(method, Extrapolated) else _STEP
    return steps * (each + own), error


def _duration(seconds: float) -> str:
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6)):
        if seconds >= size:
            return f"{seconds / size:.2g} {unit}"
    return f"{seconds * 1e9:.2g} ns"
