"""Checks of the options of stepped methods."""

from typing import Any

import numpy as np

from polhode._checks import as_float_array, is_concrete


def check_options(
    solver: Any,
    controller: Any = None,
    adjoint: Any = None,
    *,
    dt0: Any = None,
    max_steps: Any = None,
    chunk: Any = None,
) -> None:
    """Options of a stepped method: diffrax's objects, not their classes, and numbers that count.

    Raises TypeError for another kind, ValueError for an option that cannot work here.
    """
    import diffrax  # here, so that closed forms do not wait for it

    for name, value, kind, example in (
        ("solver", solver, diffrax.AbstractSolver, "diffrax.Dopri8()"),
        (
            "controller", controller, diffrax.AbstractStepSizeController,
            "diffrax.PIDController(rtol=1e-9, atol=1e-9)",
        ),
        ("adjoint", adjoint, diffrax.AbstractAdjoint, "diffrax.RecursiveCheckpointAdjoint()"),
    ):  # fmt: skip
        if isinstance(value, kind) or (value is None and name != "solver"):
            continue
        if isinstance(value, type) and issubclass(value, kind):
            raise TypeError(
                f"{name} must be an object, got the class {value.__name__}: make one of it,"
                f" {made(value)}."
            )
        raise TypeError(
            f"{name} must be a diffrax object such as {example}, got {type(value).__name__}:"
            f" {value!r:.60}."
        )
    if isinstance(adjoint, diffrax.BacksolveAdjoint):
        raise ValueError(
            "adjoint=diffrax.BacksolveAdjoint() finds the way back by integrating it, which misses"
            " rtol, and cannot reach the scene's numbers: use ph.FlowAdjoint() (the"
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


def made(x: Any) -> str:
    """How an object of this class, or of the class of this object, is written."""
    kind = x if isinstance(x, type) else type(x)
    room = kind.__module__.split(".")[0]
    return f"{'ph' if room == 'polhode' else room}.{kind.__name__}()"
