"""Rotations: quaternions, Euler angles, axis-angle, matrices (document 002)."""

from polhode.rotation._quaternion import (
    conjugate as conjugate,
    multiply as multiply,
    normalise as normalise,
    rotate as rotate,
    to_matrix as to_matrix,
)
