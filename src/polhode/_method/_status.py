"""How the simulation of each body ended."""

import enum

from jaxtyping import Array


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
        """What happened and how to correct it."""
        return _EXPLANATIONS[self]


_EXPLANATIONS = {
    Status.SUCCESSFUL: "finished",
    Status.MAX_STEPS: (
        "the solver used up max_steps before the last time: raise max_steps on the method,"
        " loosen rtol, or shorten ts; damping far faster than the motion wants an implicit solver,"
        " such as ph.LiePoisson(diffrax.Kvaerno5(), chunk=1)"
    ),
    Status.NOT_FINITE: (
        "a NaN or infinity appeared: look at this body's inertia, state, potential and torque; or"
        " the closed-form solution passed as method is not valid for its numbers (symmetry, centre"
        " of mass, initial state): leave method=None"
    ),
    Status.CHART_SINGULAR: (
        "theta reached 0 or pi, where Euler angles break down: use ph.LiePoisson (or leave"
        " method=None) for this body"
    ),
    Status.STEP_FAILED: (
        "the steps became too short to lead on, or an implicit solve gave up: a torque that jumps"
        " again and again, or damping far faster than the motion, which wants an implicit solver"
        " such as ph.LiePoisson(diffrax.Kvaerno5(), chunk=1)"
    ),
    Status.INACCURATE: (
        "the estimated error exceeds the tolerance asked for tenfold: the body is chaotic, or its"
        " rounding alone is more; loosen rtol, shorten ts, or use float64"
    ),
    Status.NOT_PHYSICAL: (
        "no body has this inertia: moments must be positive and each at most the sum of the two"
        " others, a tensor symmetric, and a wheel's moment less than the body's about its axis;"
        " published numbers that break the inequality pass with"
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


class SimulationError(RuntimeError):
    """Some bodies did not finish; ``status`` (of the shape of the batch) states which and why."""

    def __init__(self, message: str, status: Array):
        super().__init__(message)
        self.status = status
