"""Attitudes as a file may give them: quaternions and Euler angles of any sequence."""

from collections.abc import Sequence

import numpy as np

SEQUENCES = tuple(
    a + b + c for a in "xyz" for b in "xyz" for c in "xyz" if a != b and b != c
)  # fmt: skip


def quaternion_of_sequence(sequence: str, angles: Sequence[float]) -> np.ndarray:
    """`wxyz`, body -> space, of R = R_a R_b R_c for the three letters of `sequence`; angles in rad.

    The angles turn the body about its own axes, first letter first (intrinsic), which is the same
    as turning it about the fixed axes, last letter first. `zyz` is that of theory section 1.
    """
    result = np.array([1.0, 0.0, 0.0, 0.0])
    for axis, angle in zip(sequence, angles, strict=True):
        w, x, y, z = result
        c, s = np.cos(angle / 2), np.sin(angle / 2)
        turned = {
            "x": [w * c - x * s, x * c + w * s, y * c + z * s, z * c - y * s],
            "y": [w * c - y * s, x * c - z * s, y * c + w * s, z * c + x * s],
            "z": [w * c - z * s, x * c + y * s, y * c - x * s, z * c + w * s],
        }
        result = np.array(turned[axis])
    return result
