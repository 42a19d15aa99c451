"""``fit_inertia``: the inertia of bodies from recordings of their motion."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax

from polhode._batch import map_chunks
from polhode._checks import ArrayLike, require
from polhode.fit._compiled import compiled
from polhode.fit._gyroscope import Gyroscope, calibrated
from polhode.fit._options import FitOptions, check_usable, checked_options
from polhode.fit._recording import Recording, stack
from polhode.fit._result import Fit, checked_fit, conclude
from polhode.fit._solve import solve

# Samples that a processor core works on together.
_LANES = 1024


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
      deviations, broadcast against the data, of everything that was recorded or of nothing. None:
      the noise is estimated from the residuals, all channels having the same in these units.
    - ``wheel_speed`` (..., T) [rad/s]: speed of a reaction wheel relative to the body, for
      ``FitOptions(motion=SteppedMotion(spin_inertia))``, which takes it as exact; NaN where it is
      not known.
    - ``options``: ``FitOptions``: motion, unknowns, loss, start and solver.
    - ``throw``: whether a fit that must not be used raises FitError.

    Returns a ``Fit`` with the leading axes of the data. Torque-free rates show only the ratios of
    the moments (``Fit.scale_known``). Every iterate is a physical body. Left-handed axes are
    detected where attitudes are given; otherwise see ``Fit.mirror_inertia``.

    Raises ValueError for bad input and for options that do not apply; FitError for a fit that is
    not finite or stopped early, or where rates and attitudes contradict each other.
    """
    options = checked_options(options)
    _check_wheel(wheel_speed is not None, options)
    channels = {
        "omega_noise": (omega_noise, "omega_body", omega_body),
        "attitude_noise": (attitude_noise, "wxyz", wxyz),
        "force_noise": (force_noise, "force_body", force_body),
    }
    options = _with_noise(options, channels)
    noise = {name: 1.0 if given is None else given for name, (given, _, _) in channels.items()}
    recording = Recording.of(
        times, omega_body, wxyz=wxyz, force_body=force_body, wheel_speed=wheel_speed, **noise
    )
    check_usable(options, recording)
    return checked_fit(each(recording, options), throw)


def _with_noise(options: FitOptions, channels: dict[str, tuple]) -> FitOptions:
    """The options with ``trust_noise`` as the noise of ``fit_inertia`` implies it."""
    given = [name for name, (noise, _, _) in channels.items() if noise is not None]
    if options.gyroscope is not None and options.gyroscope.noise_density > 0:
        require(
            "omega_noise" not in given,
            "omega_noise and noise_density of the gyroscope state the same noise: give one.",
        )
        given.append("omega_noise")
        channels = channels | {"omega_noise": (1.0, *channels["omega_noise"][1:])}
    for name, (noise, data_name, data) in channels.items():
        require(
            noise is None or data is not None,
            f"{name} is the noise of {data_name}, which was not given.",
        )
    for name, (noise, _, data) in channels.items():
        require(
            noise is not None or data is None or not given,
            f"{', '.join(given)} without {name}: the noise must be given of everything that was"
            " recorded, or of nothing.",
        )
    require(
        given or not options.trust_noise,
        "trust_noise=True needs the noise: give omega_noise (rad/s).",
    )
    require(
        given or options.robust is None,
        "robust counts residuals in standard deviations of the noise: give omega_noise (rad/s).",
    )
    if options.trust_noise is None:
        return dataclasses.replace(options, trust_noise=bool(given))
    return options


def _check_wheel(wheel: bool, options: FitOptions) -> None:
    """ValueError for a wheel's speed without a motion, which gives it a meaning."""
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
    return checked_fit(together(stacked, options), throw)


def windows(recording: Recording, length: int) -> list[Recording]:
    """A recording (without batch) cut into windows of ``length`` samples sharing their ends."""
    count = recording.times.shape[-1]
    require(4 <= length <= count, f"a window needs 4 to {count} samples, got {length}.")
    # starts that leave at least four samples
    cuts = [slice(first, first + length) for first in range(0, count - 3, length - 1)]
    return [jax.tree.map(lambda leaf, cut=cut: leaf[cut], recording) for cut in cuts]


@compiled
def together(recording: Recording, options: FitOptions, conclude: Callable = conclude) -> Any:
    """One body from its recordings (leading axis); ``conclude`` makes the result."""
    return _fitted(recording, options, conclude)


@compiled
def each(recording: Recording, options: FitOptions, conclude: Callable = conclude) -> Any:
    """Fits of all bodies (leading axes), one recording each, in one compiled call."""
    batch = recording.batch_shape
    if not batch:
        return together(jax.tree.map(lambda leaf: leaf[None], recording), options, conclude)
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, 1, *leaf.shape[len(batch) :]), recording)
    found = _batch(flat, options, conclude)
    return jax.tree.map(lambda leaf: leaf.reshape(*batch, *leaf.shape[1:]), found)


def _fitted(recording: Recording, options: FitOptions, conclude: Callable) -> Any:
    """One body, its readings turned into rates by the sensor model."""
    recording = calibrated(recording, options.gyroscope or Gyroscope())
    return conclude(solve(recording, options), recording, options)


def _batch(recording: Recording, options: FitOptions, conclude: Callable) -> Any:
    """Fits of bodies on one leading axis."""

    def fit(one):
        return _fitted(one, options, conclude)

    # A processor core fills its vector units with the samples of a few bodies; more at a time would
    # only wait for the slowest of them.
    count = recording.times.shape[0]
    at_once = max(1, _LANES // max(recording.times.shape[1] * recording.times.shape[2], 1))
    rounds = -(-count // at_once) if jax.default_backend() == "cpu" else 1
    if at_once == 1 < rounds:
        return jax.lax.map(fit, recording)
    return map_chunks(jax.vmap(fit), recording, count, -(-count // rounds))
