"""Constants of the error control of both integration rules: unit in brackets, meaning and reason.

``python -m benchmarks.error_control`` compares estimated, requested and reached errors of random
bodies with long-double solutions (docs/design_notes.md). With ``--constants`` it measures the steps
and errors without each constant; other commands are named at the constant. eps: one unit in the
last place, relative. ``drift_divisor`` is a formula that both rules share.
"""

import jax.numpy as jnp
from jaxtyping import Array

# Both rules.

SAFETY = 0.9
"""[factor] By which the width of the next step is multiplied, beyond that by the error."""

MEMORY = 0.3
"""[exponent] Of the error of the previous step, in the width of the next one (a PI controller)."""

DRIFT_ANGLE = 100
"""[rad] Total angle beyond which the tolerance falls with the power 3/4 of the angle, because an
error of the rates continues to rotate the body. The power would have to be 1 if the errors of all
steps had the same sign, which is rare (1 body in 300)."""


def drift_divisor(total_angle: Array) -> Array:
    """Divisor of the tolerance: the power 3/4 of the angle over ``DRIFT_ANGLE``, at least 1."""
    ratio = jnp.maximum(total_angle / DRIFT_ANGLE, 1)
    return jnp.sqrt(ratio * jnp.sqrt(ratio))  # faster than a power


ROUNDED_STEP = 8
"""[eps] Lower bound of the tolerance of a step: smaller errors are rounding, which a shorter step
does not reduce."""

MIN_FACTOR, MAX_FACTOR = 0.1, 5
"""[factor] Smallest and largest change of the width from step to step."""

MIN_RATIO = 1e-6
"""[1] Lower bound of the ratio of error to tolerance, whose logarithm is taken."""

FIRST_WIDTH = 4
"""[rad] Angle of the first step, over rtol^(1 / (order + 1)): half of what smooth motions
permit."""

CUT = 0.999
"""[factor] A step shorter than this part of the proposed width was cut to end at a time: its error
does not shorten the next one."""

MIN_WIDTH = 0.1
"""[eps] Of the time span: if steps become shorter, the integration of the body has failed."""

ATTEMPTS = 4
"""[factor] Maximum number of attempts over the maximum number of steps."""


# Extrapolated midpoint rule.

CALIBRATION = 5
"""[factor] The estimated error of a step over e^2 / d (see ``_midpoint.py``): the true error is 2
to 20 times e^2 / d, 4.5 times in the median."""

MIDPOINT_SHARE = 0.6
"""[rtol] Bound of the sum of the errors of the steps. If the motion amplifies errors, the error at
the end is larger (docs/design_notes.md)."""

FIRST_SHARE = 0.05
"""[factor] Error allowed per radian at the start, over the mean of the motion; the remainder is
allowed in proportion to the square of the angle. Early errors have the longest time to grow, and at
a high order a step with a twentieth of the error is only a fifth shorter."""

COMPENSATED_STEP = 4
"""[eps] The same as ``ROUNDED_STEP`` with compensated summation. With 8, errors in single precision
are two to three times as large (``tests/solvers/test_error_control.py``)."""

# If a torque jumps within a step, the last two results of the extrapolation differ by less than
# their errors. This can be recognised when a rejected step is shortened: the error does not fall
# with the order. Of 480 motions of single bodies with six jumps at random times, hidden by a loop,
# 12 have errors of more than ten times ``rtol`` without the ``ROUGH_`` constants; with them 8, in
# which two jumps lie within ``JUMP_GAP``.

ROUGH_FALL = 2
"""[factor] A shortened step is rough if its error exceeds by this factor what the order and the
error of the rejected step predict."""

ROUGH_ROUNDING = 128
"""[eps] Smaller errors are not examined: they are rounding, which does not fall with the order."""

ROUGH_ERROR = 32
"""[factor] By which the estimated error of a rough step is multiplied."""

JUMP_GAP = 1 / 16
"""[step] The search for jumps samples the rates at one to four of these from either end of a
step."""

JUMP_RATIO = 0.75
"""[factor] Ratio of the fourth to the third difference of the samples above which they indicate a
jump: it is 1 to 3 where the rates jump, two thirds at an extremum of smooth rates, less
elsewhere."""

JUMP_NOISE = 64
"""[eps] Fourth differences below this, relative to the rates, are rounding."""

SHORT_STEP = 0.01
"""[rad] If jumps are searched for, the step after one that is shorter than this and whose error is
rounding grows by the largest factor: such an error does not indicate the possible width. In other
motions this would only lead to rejected steps."""


# Explicit Runge-Kutta steps.

EXPLICIT_SHARE = 2.0
"""[rtol] Bound of the sum of the estimated errors. The estimate, of lower order, is at least ten
times the error: with 0.6, satellites have errors of a hundredth of ``rtol`` and take 1.2 times the
steps; with 4, the worst of 64 has four times ``rtol`` (``python -m benchmarks.torqued``)."""

SIXTH_DIFFERENCE = 4e-5
"""[factor] Of the sixth divided difference of the rates over a step, which is added to the error of
DOP853. If the field has a narrow feature within a step, such as a friction that acts in a narrow
band of wheel speeds, the two estimates may vanish by chance: one such step in twelve has an error
of more than ten times the estimate; with the difference one in 140
(``tests/solvers/test_tableau.py``). In smooth motions the difference is a tenth of the estimates.
It costs 3 % of the steps at an ``rtol`` of 1e-4 and 17 % at 1e-10; fewer are rejected."""

NEAR_STABILITY = 0.8
"""[factor] Of the width at which a step becomes unstable: accepted steps wider than this are
counted as limited by stability. The controller oscillates about the stable width."""

GRAIN = 64
"""[units in the last place of the time] If a switch beyond which the field is undefined is this
close, the state is moved past it."""

COINCIDENT = 1e-6
"""[length of the motion] Switches with roots closer than this may be located at the same time: it
is ``LOCATED_JUMP`` times the coarsest ``rtol``. Knots of a table are much farther apart."""

MARGIN_VARIATION = 0.05
"""[factor] Of the largest margin of a switch within a step: smallest change between turning points
that counts. A margin that falls to zero and returns changes by all of it."""

DEEP_EXTREMUM = 0.5
"""[factor] The same for a single turning point, if it is too large for one step: for a sine, 120
degrees about an extremum. Without it, 2 of 63 short windows, each a seventh of the period long, in
which an event function changes its sign, are missed (``tests/test_events.py``)."""

MARGIN_STEPS = 4.0
"""[steps] Of the length of the motion divided by ``max_steps``: shorter steps are not rejected for
turning points of margins, because a margin that is rounding alone would shorten them forever."""

MAX_REVERSALS = 16
"""[switches] Number of consecutive switches that flip back at once, after which the motion is taken
to slide along a switch."""

SHORT_REVERSALS = 2
"""[switches] The same if the steps have become too short: each reversal divides the width by four,
and single precision does not have the digits for 16. A step between two of them resets the
count."""

UNDEFINED_SIDE = 0.98
"""[factor] Width of the step after one in which the field became undefined at a switch, relative to
the part of that step up to the switch."""
