"""Rotations: quaternions, Euler angles, axis-angle, matrices (docs/equations.md, 002).

Conversions are named ``source_to_target``.
"""

from polhode.rotation._conversions import (
    Sequence as Sequence,
    axis_angle_to_euler as axis_angle_to_euler,
    axis_angle_to_wxyz as axis_angle_to_wxyz,
    euler_to_axis_angle as euler_to_axis_angle,
    euler_to_matrix as euler_to_matrix,
    euler_to_modified_rodrigues as euler_to_modified_rodrigues,
    euler_to_rotation_vector as euler_to_rotation_vector,
    euler_to_wxyz as euler_to_wxyz,
    matrix_to_euler as matrix_to_euler,
    matrix_to_wxyz as matrix_to_wxyz,
    modified_rodrigues_to_euler as modified_rodrigues_to_euler,
    modified_rodrigues_to_wxyz as modified_rodrigues_to_wxyz,
    rotation_vector_to_euler as rotation_vector_to_euler,
    rotation_vector_to_wxyz as rotation_vector_to_wxyz,
    wxyz_to_axis_angle as wxyz_to_axis_angle,
    wxyz_to_euler as wxyz_to_euler,
    wxyz_to_matrix as wxyz_to_matrix,
    wxyz_to_modified_rodrigues as wxyz_to_modified_rodrigues,
    wxyz_to_rotation_vector as wxyz_to_rotation_vector,
    wxyz_to_shadow as wxyz_to_shadow,
)
from polhode.rotation._quaternion import (
    angle_between as angle_between,
    between as between,
    canonical as canonical,
    conjugate as conjugate,
    identity as identity,
    multiply as multiply,
    normalise as normalise,
    rotate as rotate,
    scipy_to_wxyz as scipy_to_wxyz,
    wxyz_to_scipy as wxyz_to_scipy,
    wxyz_to_xyzw as wxyz_to_xyzw,
    xyzw_to_wxyz as xyzw_to_wxyz,
)
