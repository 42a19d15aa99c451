"""``fit_scene``: whatever numbers of a scene the user points at, from recordings of its motion."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from polhode._batch import PARTS, batch_shapes
from polhode._checks import as_float_array
from polhode._method import AbstractMethod
from polhode._scene import Scene, State
from polhode._scene._scene import places_of
from polhode.fit._fit import each, together
from polhode.fit._motion import AbstractMotion
from polhode.fit._parameters import NoInertia
from polhode.fit._recording import Recording, stack
from polhode.fit._residuals import Huber
from polhode.fit._result import (
    CURES,
    UNUSABLE,
    Finding,
    FitError,
    by_kind,
    flagged,
    found_of,
    plainly,
    shown_by,
    whiteness_of,
)
from polhode.fit._scene_motion import simulated
from polhode.fit._solve import FitOptions, Solution, misfit_of
from polhode.rotation import multiply, rotation_vector_to_wxyz

_LEANS = 1e-3
"""Part of an unknown in directions that the data do not show, above which it is not known."""


class LeafMotion(AbstractMotion):
    """Motion of a scene some of whose arrays are unknown, by ``ph.simulate``.

    **Fields:** ``scene``, with the starting values; ``places`` (static): which of its leaves are
    unknown; ``attitude`` (4,): initial one for recordings without attitudes; ``method`` and
    ``rtol`` as in ``ph.simulate``.
    """

    scene: Scene
    places: tuple[int, ...] = eqx.field(static=True)
    attitude: Float[Array, " 4"] | None = None
    method: AbstractMethod | None = None
    rtol: float | None = eqx.field(static=True, default=None)

    def start(self):
        leaves = jax.tree.leaves(self.scene)
        return [leaves[i] for i in self.places]

    def fixes_scale(self):
        return True

    def with_values(self, values: Sequence[Array]) -> Scene:
        """The scene with these numbers in place of the unknown ones."""
        leaves, tree = jax.tree.flatten(self.scene)
        for i, value in zip(self.places, values, strict=True):
            leaves[i] = value.astype(leaves[i].dtype)
        return jax.tree.unflatten(tree, leaves)

    def __call__(self, tensor, omega, wxyz, times, wheel, unknown):
        scene = self.with_values(unknown)
        return simulated(scene, omega, wxyz, times, self.method, self.rtol, self.attitude)


class SceneFit(eqx.Module):
    """Result of ``fit_scene``; leading axes (...) are those of a batch of recordings.

    **Fields:** ``values``: the fitted arrays, as ``free`` listed them, and ``std`` their standard
    deviations (infinite for what the data do not show); ``initial``: ``ph.State`` (..., r) at the
    first time of each recording (attitudes only where they were recorded); ``bias`` (..., 3)
    [rad/s] or None; ``covariance`` (..., p, p) of bias and values one after another, by
    the pseudo-inverse of what the data show; ``null_count``: directions of all unknowns, initial
    states included, that they do not; ``noise``: standard deviation of the residuals over that
    assumed (reduced chi); ``whiteness``: probability of correlations as large as those seen, were
    the residuals independent; ``residuals`` over their noise; ``finding``: ``Finding`` flags;
    ``steps`` of the optimiser; ``motion``: what was fitted.
    """

    values: list[Array]
    std: list[Array]
    initial: State | None
    omega: Float[Array, "*b r 3"]
    bias: Float[Array, "*b 3"] | None
    covariance: Float[Array, "*b p p"]
    null_count: Array
    noise: Float[Array, "*b"]
    whiteness: Float[Array, "*b"]
    finding: Array
    steps: Array
    residuals: dict[str, Array]
    motion: LeafMotion

    @property
    def scene(self) -> Scene:
        """The scene with the fitted numbers (of a fit without a batch)."""
        return self.motion.with_values(self.values)

    def findings(self, body: int = 0) -> list[str]:
        """Names of the remarks on one body, in plain words."""
        return [plainly(flag) for flag in found_of(self, body, _CURES)]

    def report(self, body: int = 0) -> str:
        """A short text on one body: values, uncertainty, remarks with cause and cure."""
        lead = np.ndim(self.noise)
        lines = []
        for value, spread in zip(self.values, self.std):
            value, spread = (
                np.asarray(x).reshape(-1, *np.shape(x)[lead:])[body].reshape(-1)
                for x in (value, spread)
            )
            lines.append(", ".join(f"{v:.6g} +- {s:.2g}" for v, s in zip(value, spread)))
        return "\n".join(lines + [f"- {_CURES[flag]}" for flag in found_of(self, body, _CURES)])


_CURES = {
    flag: CURES[flag] for flag in (Finding.STEP_LIMIT, Finding.NOT_FINITE, Finding.NOT_WHITE)
} | {
    Finding.UNDETERMINED: "some of the numbers do not show in this motion, alone or against each"
    " other: their standard deviations are infinite; free fewer of them, or add a recording that"
    " shows them",
    Finding.POOR: "the residuals are more than twice as large as the noise: a wrong model, wrong"
    " units, outliers (robust=Huber()), or a start too far away",
}


def fit_scene(
    scene: Scene,
    data: Recording | Sequence[Recording],
    free: Callable[[Scene], Any],
    *,
    attitude: ArrayLike | None = None,
    bias: bool = False,
    robust: Huber | None = None,
    noise_known: bool = False,
    method: AbstractMethod | None = None,
    rtol: float | None = None,
    starts: int = 2,
    solver: Any = None,
    max_steps: int = 60,
    throw: bool = True,
) -> SceneFit:
    """Numbers of a scene, and how uncertain they are, from recordings of its motion.

    **Arguments:** ``scene``: with starting values, one body; ``data``: a ``ph.fit.Recording`` (its
    leading axes are bodies, fitted one by one), or a list of recordings of the same body; ``free``:
    function of the scene that returns the array or the list of arrays to fit (of a part: all its
    arrays). The initial rates of
    each recording, and its initial attitude where attitudes were recorded, are always fitted too;
    ``attitude`` (4,): the initial one where none were (None: the space axes). ``bias``: also that
    of the gyroscope. ``noise_known``: whether the recording's noise is to be believed (else it is
    taken from the residuals). ``robust``: ``Huber(threshold)``. ``method``, ``rtol``: as in
    ``ph.simulate``. ``starts``: 2 also fits growing parts of the data where the whole misleads.

    The numbers move freely: what must stay positive is only kept so by data that show it. For an
    inertia of which nothing is known, ``fit_inertia`` finds the start and stays physical.

        ts = jnp.linspace(0.0, 20.0, 200)
        scene = ph.Scene(ph.Inertia.from_moments([1.0, 2.0, 2.5]), torque=ph.LinearDamping(0.1))
        data = ph.fit.Recording.of(ts, rates, omega_noise=0.01)
        found = ph.fit_scene(scene, data, free=lambda s: [s.torque.c], noise_known=True)
        print(found.report())                            # found.values[0], found.std[0]: (3,)

    ``ph.fit(scene, data, free)`` is the same. Raises TypeError or ValueError for bad input, and
    unless ``throw=False`` FitError when the fit is not finite or stopped early.
    """
    _check_single(scene)
    motion = LeafMotion(scene, places_of(scene, free), _start(attitude, scene), method, rtol)
    options = FitOptions(
        motion, NoInertia(), None, robust, bias, False, noise_known, starts, solver, max_steps
    )
    if isinstance(data, Recording):
        found = each(data, options, conclude_scene)
    elif isinstance(data, list | tuple) and data and all(isinstance(x, Recording) for x in data):
        found = together(stack(data), options, conclude_scene)
    else:
        raise TypeError(
            "data must be a ph.fit.Recording (ph.fit.Recording.of(times, omega_body, ...)) or a"
            f" list of them, got {type(data).__name__}."
        )
    codes = np.atleast_1d(np.asarray(found.finding))
    fatal = [flag for flag in _CURES if flag & UNUSABLE and (codes & int(flag)).any()]
    if throw and fatal:
        said = "; ".join(CURES[flag] for flag in fatal)
        raise FitError(f"{said}. Pass throw=False to get the result with its flags.")
    return found


def _start(attitude: ArrayLike | None, scene: Scene) -> Array | None:
    if attitude is None:
        return None
    return as_float_array("attitude", attitude, (4,)).astype(scene.inertia.dtype)


def _check_single(scene: Any) -> None:
    """TypeError or ValueError for what is not the scene of one body."""
    if not isinstance(scene, Scene):
        raise TypeError(f"scene must be a ph.Scene, got {type(scene).__name__}.")
    shapes = [shape for name in PARTS for shape in batch_shapes(getattr(scene, name))]
    if any(shapes):
        raise ValueError(
            f"the scene of a fit is that of one body, got parts with the batch axes {max(shapes)}:"
            " give one body's numbers as the start; a batch is in the recording."
        )


def conclude_scene(solution: Solution, recording: Recording, options: FitOptions) -> SceneFit:
    """Values, uncertainty and diagnostics of one body (under jit and vmap)."""
    linear, parameters = solution.linear, solution.parameters
    shown = shown_by(linear, recording, options.noise_known)
    count = linear.shared.shape[-1]
    spread = jnp.sqrt(jnp.maximum(jnp.diagonal(shown.covariance), 0))
    leaning = jnp.sqrt(jnp.sum((shown.null * shown.safe[:, None]) ** 2, axis=1))
    spread = jnp.where(leaning > _LEANS, jnp.inf, spread)[:count]
    values = list(parameters.motion)
    std, first = [], count - sum(x.size for x in values)
    for value in values:
        std.append(spread[first : first + value.size].reshape(value.shape))
        first += value.size
    initial = None
    if recording.wxyz is not None:
        turned = multiply(recording.wxyz[:, 0], rotation_vector_to_wxyz(parameters.attitude))
        initial = State(turned, parameters.omega)
    whiteness = whiteness_of(linear.rest, recording.present)
    finite = jnp.isfinite(solution.cost) & jnp.all(jnp.isfinite(linear.at))
    finding = flagged({
        Finding.STEP_LIMIT: ~solution.stopped,
        Finding.NOT_FINITE: ~finite,
        Finding.UNDETERMINED: jnp.any(~jnp.isfinite(spread)),
        Finding.NOT_WHITE: whiteness < 1e-4,
        Finding.POOR: misfit_of(linear, options.robust) > 4 * solution.expected,
    })  # fmt: skip
    return SceneFit(
        values, std, initial, parameters.omega, parameters.bias,
        shown.covariance[:count, :count], shown.null_count, shown.noise, whiteness, finding,
        solution.steps, by_kind(linear, recording), options.motion,
    )  # fmt: skip
