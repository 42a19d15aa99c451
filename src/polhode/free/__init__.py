"""The exact motion of the free body."""

from polhode.free._evaluate import (
    evaluate as evaluate,
    free_motion as free_motion,
    prepare as prepare,
)
from polhode.free._motion import FreeMotion as FreeMotion
