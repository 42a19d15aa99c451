"""Options of a fit, and which of them a function can use."""

import equinox as eqx
import optimistix as optx

from polhode._checks import require
from polhode.fit._gyroscope import Gyroscope
from polhode.fit._motion import AbstractMotion, SteppedMotion
from polhode.fit._parameters import AbstractInertiaUnknown
from polhode.fit._recording import Recording
from polhode.fit._residuals import Huber
from polhode.inertia import Inertia


class FitOptions(eqx.Module):
    """Options of ``fit_inertia``, ``fit_recordings`` and ``fit_scene``.

    **Arguments:**

    - ``motion``: model of the motion; None: ``FreeMotion()``, torque-free. ``SteppedMotion`` adds
      drag and a reaction wheel, ``SceneMotion`` the forces of any scene.
    - ``unknown``: ``FullTensor()`` (None) or ``MomentsOnly()``, where the sensor axes are principal
      axes.
    - ``initial_inertia``: ``ph.Inertia`` from which the search starts; None: from a linear
      regression on the data.
    - ``robust``: ``Huber(threshold)``, the loss of residuals beyond ``threshold`` standard
      deviations of the noise; None: least squares.
    - ``gyroscope``: ``Gyroscope``, the sensor model and how well it is calibrated; None:
      ``Gyroscope()``, scale factors and misalignment to 1 %. ``Gyroscope.ideal()`` takes them as
      exact, as simulated rates are; of a real sensor the intervals are then far too narrow.
    - ``bias``: whether a constant bias of the gyroscope is fitted, with no prior.
    - ``mounting``: whether a rotation between the axes of the gyroscope and those of the attitudes
      is fitted.
    - ``trust_noise``: whether the standard deviations of the recording are absolute (True) or only
      their ratios count and the level is estimated from the residuals (False). None: True where
      ``fit_inertia`` gets a noise, else False.
    - ``max_starts``: maximum number of starting points. 1: the regression only. Further ones are
      used where the residuals exceed the noise: a second regression, growing parts of the
      recording, other bodies.
    - ``solver``: a Gauss-Newton solver of optimistix; None: Levenberg-Marquardt that stops at a
      small fraction of the standard deviations.
    - ``max_steps``: maximum number of steps of the solver for each starting point.

    A function raises ValueError for an option that it cannot use: ``fit_scene`` for ``motion``,
    ``unknown``, ``initial_inertia`` and ``mounting``.
    """

    motion: AbstractMotion | None = None
    unknown: AbstractInertiaUnknown | None = None
    initial_inertia: Inertia | None = None
    robust: Huber | None = None
    gyroscope: Gyroscope | None = None
    bias: bool = eqx.field(static=True, default=False)
    mounting: bool = eqx.field(static=True, default=False)
    trust_noise: bool | None = eqx.field(static=True, default=None)
    max_starts: int = eqx.field(static=True, default=6)
    solver: optx.AbstractGaussNewton | None = None
    max_steps: int = eqx.field(static=True, default=100)

    def __check_init__(self) -> None:
        kinds = {
            "motion": (AbstractMotion, "a motion such as FreeMotion() or None"),
            "unknown": (AbstractInertiaUnknown, "FullTensor(), MomentsOnly() or None"),
            "initial_inertia": (Inertia, "a ph.Inertia or None"),
            "gyroscope": (Gyroscope, "a Gyroscope or None"),
            "robust": (Huber, "Huber(threshold) or None"),
            "solver": (optx.AbstractGaussNewton, "a Gauss-Newton solver of optimistix or None"),
            "trust_noise": (bool, "True, False or None"),
        }
        for name, (kind, expected) in kinds.items():
            value = getattr(self, name)
            # a traced or mapped option has other leaves, but the same class
            if value is not None and not isinstance(value, kind):
                raise TypeError(
                    f"{name} of FitOptions must be {expected}, got {type(value).__name__}."
                )
        for name in ("bias", "mounting"):
            value = getattr(self, name)
            if not isinstance(value, bool):
                raise TypeError(
                    f"{name} of FitOptions must be True or False, got {type(value).__name__}; the"
                    " fitted value is in Fit.sensor."
                )
        for name in ("max_starts", "max_steps"):
            value = getattr(self, name)
            require(value >= 1, f"{name} of FitOptions must be at least 1, got {value}.")


def noise_is_trusted(options: FitOptions) -> bool:
    """Whether the noise of the recordings is absolute."""
    if options.trust_noise is None:
        return options.gyroscope is not None and options.gyroscope.noise_density > 0
    return options.trust_noise


def checked_options(options: FitOptions | None) -> FitOptions:
    """The options, or the defaults for None; TypeError for anything else."""
    if options is None:
        return FitOptions()
    if not isinstance(options, FitOptions):
        raise TypeError(
            "options must be a polhode.fit.FitOptions, for example FitOptions(bias=True), got"
            f" {type(options).__name__}."
        )
    return options


def check_usable(options: FitOptions, recording: Recording) -> None:
    """ValueError for options that a recording cannot serve."""
    for name in ("bias", "mounting"):
        require(
            recording.omega is not None or not getattr(options, name),
            f"{name}=True needs rates of a gyroscope (omega_body), got attitudes alone.",
        )
    sensor = options.gyroscope
    if sensor is not None:
        require(
            recording.omega is not None,
            "the option gyroscope needs its rates (omega_body), got attitudes alone.",
        )
        require(
            not (sensor.delay or sensor.delay_std)
            or recording.wxyz is not None
            or recording.wheel is not None,
            "the delay of a gyroscope shows only beside attitudes (wxyz) or a wheel (wheel_speed):"
            " rates alone are those of a motion that begins later.",
        )
        require(
            not sensor.jitter or bool(options.trust_noise) or sensor.noise_density > 0,
            "jitter of the gyroscope adds to a known noise: give omega_noise (rad/s), or"
            " noise_density of the gyroscope.",
        )
    motion = options.motion
    require(
        recording.wheel is not None
        or not isinstance(motion, SteppedMotion)
        or motion.spin_inertia is None,
        "motion=SteppedMotion(spin_inertia) needs the wheel's speed: give wheel_speed.",
    )
    if options.initial_inertia is not None:
        shape = options.initial_inertia.tensor.shape[:-2]
        require(not shape, f"initial_inertia must be that of one body, got the batch axes {shape}.")
