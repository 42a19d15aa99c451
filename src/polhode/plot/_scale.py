"""The units that times and rates are drawn in."""

from typing import NamedTuple, Self

import numpy as np

_DEGREE = np.pi / 180


class Scale(NamedTuple):
    """Names of the units of time and rate in a figure, and their size in s and rad/s."""

    time: str = "s"
    seconds: float = 1.0
    rate: str = "rad/s"
    radians_per_second: float = 1.0

    @classmethod
    def of(cls, seconds: float) -> Self:
        """Units that suit a motion of this duration."""
        if abs(seconds) > 3 * 86400:
            return cls("day", 86400.0, "deg/day", _DEGREE / 86400)
        if abs(seconds) > 3 * 3600:
            return cls("h", 3600.0, "deg/h", _DEGREE / 3600)
        return cls()
