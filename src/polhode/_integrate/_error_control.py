"""Constants of the error control, of both rules of steps: unit in brackets, meaning, what fits it.

``python -m benchmarks.error_control`` compares estimates, requested and reached errors of random
bodies with long-double solutions (docs/design_notes.md), and with ``--constants`` the steps and
errors without each constant, where no other command is named. eps: one unit in the last place,
relative.
"""

# Both rules.

SAFETY = 0.9
"""[factor] Of the width that the error of the last step suggests."""

MEMORY = 0.3
"""[exponent] Of the error of the step before, in the width of the next one (a PI controller)."""

DRIFT_ANGLE = 100
"""[rad] Beyond it the tolerance falls with the power 3/4 of the angle, for an error of the rates
goes on turning the body. The error would grow in proportion to the angle if the errors of all steps
had one sign, which is rare (1 body in 300)."""

ROUNDED_STEP = 8
"""[eps] Below it the error of a step is rounding: no shorter step reduces it."""

MIN_FACTOR, MAX_FACTOR = 0.1, 5
"""[factor] Smallest and largest change of the width from step to step."""

MIN_RATIO = 1e-6
"""[1] Errors over tolerance below this count as this, for the logarithm."""

FIRST_WIDTH = 4
"""[rad] Angle of the first step at a tolerance of 1; falls with the root of the order: half of what
smooth motions allow."""

CUT = 0.999
"""[factor] A step shorter than this part of the proposed width was cut to end at a time: its error
does not shorten the next one."""

MIN_WIDTH = 0.1
"""[eps] Of the time span: steps that are shorter lead nowhere, and the body has failed."""

ATTEMPTS = 4
"""[attempts] Allowed for each step that is allowed."""


# Extrapolated midpoint rule.

CALIBRATION = 5
"""[factor] The estimated error of a step over e^2 / d (see ``_midpoint.py``): the true error was 2
to 20 times e^2 / d, 4.5 times in the median."""

MIDPOINT_SHARE = 0.6
"""[rtol] Bound of the sum of the errors of the steps. Where the motion itself amplifies errors the
error is larger (docs/design_notes.md)."""

FIRST_SHARE = 0.05
"""[factor] Error allowed for a radian at the start, over the mean of the motion; the remainder is
allowed in proportion to the square of the angle. An early error has the longest time to grow, and
at a high order a step with a twentieth of the error is only a fifth shorter."""

COMPENSATED_STEP = 4
"""[eps] The same as ``ROUNDED_STEP`` where steps carry their rounding errors along. With 8, errors
in single precision are two to three times as large (``tests/solvers/test_error_control.py``)."""

# Where a torque jumps within a step, the last two values of the table differ by less than their
# errors. This shows in errors that do not fall with the order when a refused step is shortened. Of
# 480 motions of single bodies with six jumps at random times, hidden by a loop, 12 exceed ten times
# ``rtol`` without this; with it 8, in which two jumps lie within ``JUMP_GAP``.

ROUGH_FALL = 2
"""[factor] By so much more than the order predicts the error exceeds that of the refused step."""

ROUGH_ROUNDING = 128
"""[eps] Smaller errors are not examined: rounding does not fall with the order either."""

ROUGH_ERROR = 32
"""[factor] Of the estimate in such a step."""

JUMP_GAP = 1 / 16
"""[step] The search for jumps samples one to four of these from either end of a step."""

JUMP_RATIO = 0.75
"""[factor] Fourth over third difference of the samples from which on they count as a jump: 1 to 3
where the rates jump, two thirds at an extremum of smooth rates, less elsewhere."""

JUMP_NOISE = 64
"""[eps] Fourth differences below this, of the rates, are rounding."""

SHORT_STEP = 0.01
"""[rad] Where jumps are searched for, a step as short as this whose error is rounding says nothing
about the width that is possible: the next one is longer by the largest factor. In other motions
this would only lead to refused steps."""


# Explicit Runge-Kutta steps.

EXPLICIT_SHARE = 2.0
"""[rtol] Bound of the sum of the estimated errors. The estimate, of lower order, exceeds the error
ten times and more: with 0.6 satellites keep a hundredth of ``rtol`` and take 1.2 times the steps;
with 4 the worst of 64 exceeds ``rtol`` four times (``python -m benchmarks.torqued``)."""

SIXTH_DIFFERENCE = 4e-5
"""[factor] Of the sixth divided difference of the rates over a step, which is added to the error of
DOP853. Where a step passes something narrow, such as a wheel the band of its friction, the two
estimates vanish by chance: one such step in twelve had an error more than ten times the estimate;
with the difference one in 140 (``tests/solvers/test_tableau.py``). In smooth motions it is a tenth
of them. It costs 3 % of the steps at an ``rtol`` of 1e-4 and 17 % at 1e-10; fewer are refused."""

NEAR_STABILITY = 0.8
"""[factor] Of the width at which a step becomes unstable: steps from there on are counted as
limited by stability. The controller moves to and fro about that width."""

GRAIN = 64
"""[units in the last place of the time] The motion starts anew beyond a switch that is this close
and beyond which the field is not defined."""

COINCIDENT = 1e-6
"""[length of the motion] Switches whose roots are as close as this may be found in one place: it is
``LOCATED_JUMP`` times the coarsest ``rtol``. Knots of a table are much farther apart."""

MARGIN_TURN = 0.05
"""[factor] Of the largest margin of a switch within a step: the least by which it turns back. One
that dips to zero turns by all of it."""

DEEP_TURN = 0.5
"""[factor] The same of a single turn that is too large for one step: of a sine, 120 degrees about
an extreme. Without it two of 63 passes of a body at rest by a window of a seventh of the period are
missed (``tests/test_events.py``)."""

MARGIN_STEPS = 4.0
"""[steps of ``max_steps``] Shorter steps are not refused for margins that turn back: those of a
margin that is rounding alone would not end."""

MAX_REVERSALS = 16
"""[switches] Consecutive ones that turn back at once, after which the motion slides along a
switch."""

SHORT_REVERSALS = 2
"""[switches] The same where the steps have become too short: each reversal divides the width by
four, and single precision has no room for 16. A chance step between two of them starts the count
anew."""

UNDEFINED_SIDE = 0.98
"""[factor] Of the part of a step up to a switch beyond which the field is not defined."""
