"""``fit_inertia``: the inertia of bodies from recordings of their motion."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import ArrayLike

from polhode._batch import map_chunks
from polhode._checks import require
from polhode.fit._compiled import compiled
from polhode.fit._fit_wheel import fit_wheel, fit_wheels
from polhode.fit._instrument import Instrument
from polhode.fit._motion import AbstractMotion
from polhode.fit._parameters import AbstractInertiaUnknown
from polhode.fit._recording import Recording, stack
from polhode.fit._residuals import Huber
from polhode.fit._result import CURES, UNUSABLE, FitError, InertiaFit, conclude, is_unusable
from polhode.fit._solve import FitOptions, solve
from polhode.inertia import Inertia

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
    instrument: Instrument | None = None,
    block: int = 1,
    motion: AbstractMotion | None = None,
    unknown: AbstractInertiaUnknown | None = None,
    known: Inertia | None = None,
    bias: bool = False,
    mounting: bool = False,
    robust: Huber | None = None,
    starts: int = 6,
    solver: Any = None,
    max_steps: int = 100,
    throw: bool = True,
) -> InertiaFit:
    """Inertia of a body, or a batch of bodies, from one recording each.

    **Arguments:** ``times`` (..., T), s, increasing; ``omega_body`` (..., T, 3), rad/s, the
    gyroscope in right-handed sensor axes; ``wxyz`` (..., T, 4) attitudes body -> space;
    ``force_body`` (..., T, 3), m/s^2, accelerometer; rows with NaN are gaps. ``..._noise``:
    standard deviations (None: one for all channels, taken from the residuals). ``wheel_speed``
    (..., T), rad/s, of a wheel aboard, whose ``Instrument(spin_inertia)`` is to be given: then the
    likelihood of the readings is fitted as by ``fit_balance``, drag and noise with it, ``block``
    samples to a residual. ``motion``: what the body does instead: ``FreeMotion()`` (exact,
    torque-free) or ``SteppedMotion`` (drag, a wheel that turns exactly as it says). ``unknown``:
    ``FullTensor()`` or ``MomentsOnly()``. ``known``: an inertia to start from. ``bias``,
    ``mounting``: whether to fit them. ``robust``: ``Huber(threshold)``, in standard deviations,
    needs a known noise. ``starts``: how many attempts are made at most (1:
    from a regression only; the next ones follow where its result misses the data: from another
    regression, to growing parts of the recording, from other bodies). ``solver``: any
    Gauss-Newton solver of optimistix.

    A wheel's motion that is taken at its word (``SteppedMotion``) misleads where the air pushes and
    the speed is noisy: of simulated throws of 0.5 s it misses the moments by 2 to 7 % and states
    0.6 to 1.1 %, the likelihood of the readings by 0.04 to 1.7 % and states 0.03 to 1.4 %. Forces
    take part in fits of a ``motion`` only: 3 cm from the centre of mass an accelerometer narrows
    the tensor of such a throw by 0.3 % at most.

    Torque-free rates show only the ratios of the moments: see ``InertiaFit.scale_known``. Every
    iterate is a physical body. Left-handed axes are not fitted away: with attitudes they are
    noticed; without, ``InertiaFit.mirrored`` tells what the rates would mean then.

    Raises ValueError for bad input, and unless ``throw=False`` FitError when a fit is not finite,
    stopped early, or rates and attitudes disagree about the axes; ``finding`` has the flags.
    """
    noise = {
        "omega_noise": omega_noise,
        "attitude_noise": attitude_noise,
        "force_noise": force_noise,
    }
    if instrument is not None or (wheel_speed is not None and motion is None):
        _only_a_wheel(
            instrument,
            wheel_speed,
            {
                "omega_noise": omega_noise, "wxyz": wxyz, "force_body": force_body,
                "motion": motion, "unknown": unknown, "known": known, "bias": bias,
                "mounting": mounting, "robust": robust, "solver": solver,
            },
        )  # fmt: skip
        recording = Recording.of(times, omega_body, wheel_speed=wheel_speed)
        return _finished(fit_wheel(recording, instrument, block), throw)
    recording = Recording.of(
        times,
        omega_body,
        wxyz=wxyz,
        force_body=force_body,
        wheel_speed=wheel_speed,
        **{name: 1.0 if value is None else value for name, value in noise.items()},
    )
    noise_known = any(value is not None for value in noise.values())
    options = FitOptions(
        motion, unknown, known, robust, bias, mounting, noise_known, starts, solver, max_steps
    )
    return _finished(each(recording, options), throw)


def _only_a_wheel(instrument: Instrument | None, wheel_speed, others) -> None:
    """Refuse what the likelihood of the readings would not use."""
    require(
        instrument is not None,
        "wheel_speed needs instrument=Instrument(spin_inertia) to mean a momentum; or give the "
        "motion: SteppedMotion(spin_inertia), or FreeMotion() to leave the wheel out.",
    )
    require(wheel_speed is not None, "an instrument needs the wheel's speed: give wheel_speed.")
    require(
        instrument is not None and instrument.spin_inertia is not None,
        "the instrument needs the wheel's spin_inertia; throws without a wheel: fit_balance.",
    )
    unused = [name for name, value in others.items() if value is not None and value is not False]
    require(
        not unused,
        f"with an instrument the readings of gyroscope and wheel alone are fitted, got also "
        f"{', '.join(unused)}: leave it out, or give motion=SteppedMotion(spin_inertia) in place "
        "of the instrument.",
    )


def fit_recordings(
    recordings: Sequence[Recording],
    *,
    instrument: Instrument | None = None,
    block: int = 1,
    motion: AbstractMotion | None = None,
    unknown: AbstractInertiaUnknown | None = None,
    known: Inertia | None = None,
    bias: bool = False,
    mounting: bool = False,
    robust: Huber | None = None,
    noise_known: bool = False,
    starts: int = 6,
    solver: Any = None,
    max_steps: int = 100,
    throw: bool = True,
) -> InertiaFit:
    """One inertia from several recordings of the same body (``Recording.of``); see ``fit_inertia``.

    Recordings with a wheel need its ``instrument``, as there (the noise is found, too, and what
    belongs to a motion is refused), or the ``motion``. Windows of one long recording are recordings
    too: their initial rates are then fitted separately (multiple shooting), which keeps a long or
    chaotic motion tractable.
    """
    wheel = [one.wheel is not None for one in recordings]
    if instrument is not None or (any(wheel) and motion is None):
        _only_a_wheel(
            instrument,
            any(wheel) or None,
            {
                "motion": motion, "unknown": unknown, "known": known, "bias": bias,
                "mounting": mounting, "robust": robust, "noise_known": noise_known,
                "solver": solver, "attitudes": any(one.wxyz is not None for one in recordings),
                "forces": any(one.force is not None for one in recordings),
            },
        )  # fmt: skip
        return _finished(fit_wheels(recordings, instrument, block), throw)
    options = FitOptions(
        motion, unknown, known, robust, bias, mounting, noise_known, starts, solver, max_steps
    )
    return _finished(together(stack(recordings), options), throw)


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
    return conclude(solve(recording, options), recording, options)


@compiled
def each(recording: Recording, options: FitOptions, conclude: Callable = conclude) -> Any:
    """Fits of all bodies (leading axes), one recording each, in one compiled call."""
    batch = recording.batch_shape
    if not batch:
        return together(jax.tree.map(lambda leaf: leaf[None], recording), options, conclude)
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, 1, *leaf.shape[len(batch) :]), recording)
    found = _batch(flat, options, conclude)
    return jax.tree.map(lambda leaf: leaf.reshape(*batch, *leaf.shape[1:]), found)


def _batch(recording: Recording, options: FitOptions, conclude: Callable) -> Any:
    """Fits of bodies on one leading axis."""

    def fit(one):
        return conclude(solve(one, options), one, options)

    # A processor core fills its vector units with the samples of a few bodies; more at a time would
    # only wait for the slowest of them.
    count = recording.times.shape[0]
    at_once = max(1, _LANES // max(recording.times.shape[1] * recording.times.shape[2], 1))
    rounds = -(-count // at_once) if jax.default_backend() == "cpu" else 1
    if at_once == 1 < rounds:
        return jax.lax.map(fit, recording)
    return map_chunks(jax.vmap(fit), recording, count, -(-count // rounds))


def _finished(result: InertiaFit, throw: bool) -> InertiaFit:
    if throw and is_unusable(result):
        codes = np.asarray(result.finding).reshape(-1)
        said = [
            f"{int(((codes & int(flag)) != 0).sum())} of {codes.size}: {text}"
            for flag, text in CURES.items()
            if flag & UNUSABLE and (codes & int(flag)).any()
        ]
        raise FitError("; ".join(said) + ". Pass throw=False to get the result with its flags.")
    return result
