"""``fit_inertia``, ``fit_recordings`` and ``fit_scene``: fits of bodies and scenes."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polhode import _policy
from polhode._batch import PARTS, batch_shapes
from polhode._checks import ArrayLike, as_float_array, require, require_positive
from polhode._kernels import map_chunks
from polhode._method import AbstractMethod
from polhode._scene import Scene
from polhode._scene._scene import places_of
from polhode.fit._conclude import conclude, conclude_scene
from polhode.fit._model import FreeMotion, LeafMotion, NoInertia, SteppedMotion, entries_of
from polhode.fit._numerics import compiled
from polhode.fit._options import FitOptions, Gyroscope, calibrate, check_usable, checked_options
from polhode.fit._recording import Recording, stack
from polhode.fit._result import Fit, checked_fit
from polhode.fit._solve import solve_fit

# ``fit_inertia``: the inertia of bodies from recordings of their motion.


def fit_inertia(
    times: ArrayLike,
    omega_body: ArrayLike | None = None,
    *,
    wxyz: ArrayLike | None = None,
    force_body: ArrayLike | None = None,
    wheel_speed: ArrayLike | None = None,
    omega_noise: ArrayLike | None = None,
    attitude_noise: ArrayLike | None = None,
    force_noise: ArrayLike | None = None,
    options: FitOptions | None = None,
    throw: bool = True,
) -> Fit:
    """Inertia of a body, or of each body of a batch, from one recording.

    **Arguments:**

    - ``times`` (..., T) [s], increasing; ``omega_body`` (..., T, 3) [rad/s], the gyroscope in
      right-handed sensor axes; ``wxyz`` (..., T, 4), attitudes body -> space; ``force_body``
      (..., T, 3) [m/s^2], the accelerometer; rows with NaN are gaps.
    - ``omega_noise`` [rad/s], ``attitude_noise`` [rad], ``force_noise`` [m/s^2]: standard
      deviations, broadcast against the data. Give them for every recorded channel or for none.
      None: the noise is estimated from the residuals, as one number for all channels in SI units.
    - ``wheel_speed`` (..., T) [rad/s]: speed of a reaction wheel relative to the body, for
      ``FitOptions(motion=SteppedMotion(spin_inertia))``, which treats it as noise-free; NaN where
      it was not measured.
    - ``options``: ``FitOptions``: motion, unknowns, loss, start and solver.
    - ``throw``: whether an unusable fit (``Fit.is_usable``) raises FitError.

    Returns a ``Fit`` with the leading axes of the data. Torque-free rates determine only the ratios
    of the moments (``Fit.scale_known``). Every iterate is a physical body. Left-handed axes are
    detected where attitudes are given; otherwise see ``Fit.mirror_inertia``.

    Needs float64 (``jax_enable_x64``). Raises RuntimeError in float32; ValueError for bad input and
    for options that do not apply; FitError for a fit that is not finite or stopped early, or where
    rates and attitudes contradict each other.
    """
    options = checked_options(options)
    _check_wheel(wheel_speed is not None, options)
    channels = {
        "omega_noise": (omega_noise, "omega_body", omega_body),
        "attitude_noise": (attitude_noise, "wxyz", wxyz),
        "force_noise": (force_noise, "force_body", force_body),
    }
    options = _with_noise(options, channels)
    noise = {name: 1.0 if value is None else value for name, (value, _, _) in channels.items()}
    recording = Recording.of(
        times, omega_body, wxyz=wxyz, force_body=force_body, wheel_speed=wheel_speed, **noise
    )
    check_usable(options, recording)
    return checked_fit(fit_each(recording, options), throw)


def _with_noise(options: FitOptions, channels: dict[str, tuple]) -> FitOptions:
    """The options with ``trust_noise=None`` replaced: True if ``fit_inertia`` was given a noise."""
    stated = [name for name, (noise, _, _) in channels.items() if noise is not None]
    if options.gyroscope is not None and options.gyroscope.noise_density > 0:
        require(
            "omega_noise" not in stated,
            "omega_noise and noise_density of the gyroscope state the same noise: give one.",
        )
        stated.append("omega_noise")
        channels = channels | {"omega_noise": (1.0, *channels["omega_noise"][1:])}
    for name, (noise, data_name, data) in channels.items():
        require(
            noise is None or data is not None,
            f"{name} is the noise of {data_name}, which was not given.",
        )
    for name, (noise, _, data) in channels.items():
        require(
            noise is not None or data is None or not stated,
            f"{', '.join(stated)} without {name}: the noise must be given of everything that was"
            " recorded, or of nothing.",
        )
    require(
        stated or not options.trust_noise,
        "trust_noise=True needs the noise: give omega_noise (rad/s).",
    )
    require(
        stated or options.robust is None,
        "robust counts residuals in standard deviations of the noise: give omega_noise (rad/s).",
    )
    if options.trust_noise is None:
        return dataclasses.replace(options, trust_noise=bool(stated))
    return options


def _check_wheel(wheel: bool, options: FitOptions) -> None:
    """ValueError for wheel speeds without a ``motion``: only that states the wheel's inertia."""
    require(
        not wheel or options.motion is not None,
        "wheel_speed needs the wheel's spin inertia to mean a momentum: give"
        " FitOptions(motion=SteppedMotion(spin_inertia)), or FreeMotion() to leave the wheel out.",
    )


def fit_recordings(
    recordings: Sequence[Recording],
    *,
    options: FitOptions | None = None,
    throw: bool = True,
) -> Fit:
    """One inertia from several recordings of the same body.

    **Arguments:** ``recordings``: made by ``Recording.of`` or ``read_recording``, with the same
    kinds of data, of any lengths. ``options``, ``throw``: as in ``fit_inertia``;
    ``FitOptions(trust_noise=True)`` where the noise of the recordings is absolute. Recordings with
    a wheel need a ``motion``.

    Windows of one long recording (``windows``) are recordings too: their initial rates are fitted
    separately (multiple shooting), which keeps a long or chaotic motion tractable.

    Returns a ``Fit`` of one body. Raises ValueError and FitError as ``fit_inertia``.
    """
    options = checked_options(options)
    stacked = stack(recordings)
    _check_wheel(stacked.wheel is not None, options)
    check_usable(options, stacked)
    return checked_fit(fit_together(stacked, options), throw)


def windows(recording: Recording, length: int) -> list[Recording]:
    """A recording (without batch) cut into windows of ``length`` samples sharing their ends.

    The last window has the remaining samples. If these are fewer than four, they are added to the
    window before.
    """
    if not isinstance(recording, Recording):
        raise TypeError(f"recording must be a Recording, got {type(recording).__name__}.")
    count = recording.times.shape[-1]
    require(4 <= length <= count, f"a window needs 4 to {count} samples, got {length}.")
    # starts that leave at least four samples
    cuts = [slice(start, start + length) for start in range(0, count - 3, length - 1)]
    cuts[-1] = slice(cuts[-1].start, count)
    return [jax.tree.map(lambda leaf, cut=cut: leaf[cut], recording) for cut in cuts]


def _is_brief(recording: Recording, options: FitOptions, *_: Any) -> bool:
    """Whether a fit takes little time: few samples, of a motion whose cost is set by their number.

    The cost of a simulated scene is not.
    """
    is_bounded = isinstance(options.motion, FreeMotion | SteppedMotion | None)
    return is_bounded and recording.times.size <= _policy.BRIEF_FIT


@compiled(_is_brief)
def fit_together(recording: Recording, options: FitOptions, conclude: Callable = conclude) -> Any:
    """One body from its recordings (leading axis); ``conclude`` makes the result."""
    return _fit_one(recording, options, conclude)


@compiled(_is_brief)
def fit_each(recording: Recording, options: FitOptions, conclude: Callable = conclude) -> Any:
    """Fits of all bodies (leading axes), one recording each, in one compiled call."""
    batch = recording.batch_shape
    if not batch:
        return fit_together(jax.tree.map(lambda leaf: leaf[None], recording), options, conclude)
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, 1, *leaf.shape[len(batch) :]), recording)
    fits = _fit_batch(flat, options, conclude)
    return jax.tree.map(lambda leaf: leaf.reshape(*batch, *leaf.shape[1:]), fits)


def _fit_one(recording: Recording, options: FitOptions, conclude: Callable) -> Any:
    """The fit of one body, whose readings the sensor model first converts to rates."""
    recording = calibrate(recording, options.gyroscope or Gyroscope())
    return conclude(solve_fit(recording, options), recording, options)


def _fit_batch(recording: Recording, options: FitOptions, conclude: Callable) -> Any:
    """Fits of bodies on one leading axis."""

    def fit(body_recording):
        return _fit_one(body_recording, options, conclude)

    # On a CPU the samples of a few bodies fill the SIMD lanes of a core. More bodies at a time
    # would only iterate until the slowest of them has converged.
    count = recording.times.shape[0]
    at_once = max(
        1, _policy.FIT_SAMPLES // max(recording.times.shape[1] * recording.times.shape[2], 1)
    )
    rounds = -(-count // at_once) if _policy.is_cpu() else 1
    if at_once == 1 < rounds:
        return jax.lax.map(fit, recording)
    return map_chunks(jax.vmap(fit), recording, count, -(-count // rounds))


# ``fit_scene``: any arrays of a scene from recordings of its motion.


def fit_scene(
    scene: Scene,
    data: Recording | Sequence[Recording],
    free: Callable[[Any], Any],
    *,
    bounds: Sequence[tuple[ArrayLike | None, ArrayLike | None] | None] | None = None,
    prior_std: Sequence[ArrayLike | None] | None = None,
    attitude: ArrayLike | None = None,
    method: AbstractMethod | None = None,
    rtol: float | None = None,
    options: FitOptions | None = None,
    throw: bool = True,
) -> Fit:
    """Numbers of a scene, with standard deviations, from recordings of its motion.

    **Arguments:**

    - ``scene``: with starting values, one body.
    - ``data``: a ``ph.fit.Recording``, whose leading axes are bodies that are fitted one by one; or
      a list of recordings of the same body.
    - ``free``: function of the scene that returns the array or the list of arrays to fit (a part
      stands for all its arrays). The initial rates of each recording, and its initial attitude if
      attitudes were recorded, are always fitted too.
    - ``bounds``: for each array of ``free`` a pair of its lower and upper bound, numbers or arrays
      of its shape, None where there is none; None in place of a pair: no bounds. The starting
      values must lie between them. ``[(0.0, None)]`` keeps a coefficient positive.
    - ``prior_std``: for each array of ``free`` the standard deviation of a normal prior about its
      starting value, a number or an array of its shape, or None.
    - ``attitude`` (4,): initial attitude ``wxyz``, for recordings without attitudes; None: the
      identity.
    - ``method``, ``rtol``: as in ``ph.simulate``.
    - ``options``: ``FitOptions``, of which these apply: ``robust``, ``bias``, ``trust_noise``,
      ``gyroscope`` (by default with scale factors and axes uncertain by 1 %, which widens ``std``;
      for exact ones give ``Gyroscope.ideal()``), ``max_starts`` (at most 2 are used: all data,
      then growing parts of them), ``solver`` and ``max_steps``.
    - ``throw``: whether a fit that is not finite or stopped early raises FitError.

    Returns a ``Fit``: ``values`` and ``std`` in the order of ``free``, ``scene`` with the values.
    Numbers without bounds are not constrained: a coefficient may become negative. For an unknown
    inertia use ``fit_inertia``, which needs no starting point and keeps it physical.

        ts = jnp.linspace(0.0, 20.0, 200)
        scene = ph.Scene(ph.Inertia.from_moments([1.0, 2.0, 2.5]), torque=ph.LinearDamping(0.1))
        data = ph.fit.Recording.of(ts, rates, omega_noise=0.01)
        options = ph.fit.FitOptions(trust_noise=True)
        fit = ph.fit_scene(scene, data, free=lambda s: [s.torque.c], options=options)
        print(fit.report())                              # fit.values[0], fit.std[0]: (3,)

    Needs float64 (``jax_enable_x64``). Raises RuntimeError in float32; TypeError or ValueError for
    bad input and for options that do not apply; and FitError.
    """
    _check_single(scene)
    options = checked_options(options)
    for name in ("motion", "unknown", "initial_inertia"):
        require(
            getattr(options, name) is None,
            f"fit_scene does not use the option {name}: the scene is the model, and free selects"
            " what is unknown.",
        )
    require(
        not options.mounting,
        "fit_scene does not fit a mounting: rotate the rates into the axes of the scene, or use"
        " fit_inertia with motion=SceneMotion(...).",
    )
    recordings = [data] if isinstance(data, Recording) else data
    if not (
        isinstance(recordings, list | tuple)
        and recordings
        and all(isinstance(recording, Recording) for recording in recordings)
    ):
        raise TypeError(
            "data must be a ph.fit.Recording (ph.fit.Recording.of(times, omega_body, ...)) or a"
            f" list of them, got {type(data).__name__}."
        )
    for recording in recordings:
        require(
            recording.wheel is None,
            "fit_scene does not read wheel_speed: describe the wheel by rotors of the scene"
            " (ph.Rotor), and leave wheel_speed out of the recording.",
        )
        require(
            recording.force is None,
            "fit_scene does not model accelerometer readings: leave force_body out.",
        )
        require(
            attitude is None or recording.wxyz is None,
            "attitude is for recordings without attitudes; these have wxyz, whose first one is"
            " fitted.",
        )
    check_usable(options, recordings[0])
    places = places_of(scene, free)
    starts = [jax.tree.leaves(scene)[i] for i in places]
    motion = LeafMotion(scene, places, _start(attitude, scene), method, rtol)
    counts = motion.entry_counts
    motion = dataclasses.replace(
        motion,
        bounds=None if bounds is None else _entries(_bounds(bounds, starts), counts),
        widths=None if prior_std is None else _entries(_widths(prior_std, starts), counts),
    )
    options = dataclasses.replace(options, motion=motion, unknown=NoInertia())
    if isinstance(data, Recording):
        return checked_fit(fit_each(data, options, conclude_scene), throw)
    return checked_fit(fit_together(stack(recordings), options, conclude_scene), throw)


def _bounds(bounds: Sequence, starts: Sequence[Array]) -> tuple[tuple[Array, Array] | None, ...]:
    _check_count("bounds", bounds, starts)
    pairs = []
    for k, (pair, start) in enumerate(zip(bounds, starts, strict=True)):
        if pair is None:
            pairs.append(None)
            continue
        if not (isinstance(pair, tuple | list) and len(pair) == 2):
            raise TypeError(f"bounds[{k}] must be a pair (lower, upper) or None, got {pair!r}.")
        ends = [
            jnp.full(start.shape, sign * jnp.inf, start.dtype)
            if end is None
            else _like_start(f"bounds[{k}]", end, start)
            for end, sign in zip(pair, (-1, 1), strict=True)
        ]
        inside = (ends[0] < start) & (start < ends[1])
        require(
            np.asarray(inside),
            f"the starting values of array {k} must lie between their bounds, got"
            f" {np.asarray(start)} for {pair}.",
        )
        pairs.append((ends[0], ends[1]))
    return tuple(pairs)


def _widths(prior_std: Sequence, starts: Sequence[Array]) -> tuple[Array | None, ...]:
    _check_count("prior_std", prior_std, starts)
    arrays = []
    for k, (std, start) in enumerate(zip(prior_std, starts, strict=True)):
        if std is None:
            arrays.append(None)
            continue
        require_positive(f"prior_std[{k}]", std, hint="None stands for no prior")
        arrays.append(_like_start(f"prior_std[{k}]", std, start))
    return tuple(arrays)


def _entries(arrays: tuple, counts: Sequence[int | None]) -> tuple:
    """``arrays`` with the entries of symmetric tensors in place of their nine components."""

    def entries(tensor, count):
        is_symmetric = np.asarray(tensor == tensor.T)
        require(is_symmetric, f"bounds and priors of a tensor must be symmetric, got {tensor}.")
        return entries_of(tensor, count)

    return tuple(
        x if n is None else jax.tree.map(lambda tensor, n=n: entries(tensor, n), x)
        for x, n in zip(arrays, counts, strict=True)
    )


def _like_start(name: str, value: ArrayLike, start: Array) -> Array:
    array = jnp.asarray(value, start.dtype)
    try:
        return jnp.broadcast_to(array, start.shape)
    except ValueError:
        raise ValueError(
            f"{name} must be a number or have the shape {start.shape} of its array, got"
            f" {array.shape}."
        ) from None


def _check_count(name: str, values: Sequence, starts: Sequence[Array]) -> None:
    require(
        isinstance(values, list | tuple) and len(values) == len(starts),
        f"{name} must be a list with one entry for each of the {len(starts)} arrays of free.",
    )


def _start(attitude: ArrayLike | None, scene: Scene) -> Array | None:
    if attitude is None:
        return None
    return as_float_array("attitude", attitude, (4,)).astype(scene.inertia.dtype)


def _check_single(scene: Any) -> None:
    """TypeError or ValueError unless ``scene`` is a ``Scene`` of one body."""
    if not isinstance(scene, Scene):
        raise TypeError(f"scene must be a ph.Scene, got {type(scene).__name__}.")
    shapes = [shape for name in PARTS for shape in batch_shapes(getattr(scene, name))]
    if any(shapes):
        raise ValueError(
            f"the scene of a fit is that of one body, got parts with the batch axes {max(shapes)}:"
            " give one body's numbers as the start; a batch is in the recording."
        )
