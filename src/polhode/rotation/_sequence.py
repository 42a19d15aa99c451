"""The twenty-four sequences of Euler angles: twelve axis orders, about body or space axes."""

import enum


class Sequence(enum.Enum):
    """Order of the three rotations of Euler angles.

    ``Sequence.ZYZ`` is the convention here, ``R = Rz(phi) Ry(theta) Rz(psi)``. A plain member
    is *intrinsic*: the second and third turn are about the axes that the body has by then, and
    ``R = R_i(first) R_j(second) R_k(third)``. A member ending in ``_SPACE`` is *extrinsic*: all
    turns are about fixed space axes, and ``R = R_k(third) R_j(second) R_i(first)``.

    The second angle lies in [0, pi] when the first and last axis are the same (proper Euler angles)
    and in [-pi/2, pi/2] when all three differ (Tait-Bryan angles).
    """

    XYX = ((0, 1, 0), False)
    XZX = ((0, 2, 0), False)
    YXY = ((1, 0, 1), False)
    YZY = ((1, 2, 1), False)
    ZXZ = ((2, 0, 2), False)
    ZYZ = ((2, 1, 2), False)
    XYZ = ((0, 1, 2), False)
    XZY = ((0, 2, 1), False)
    YXZ = ((1, 0, 2), False)
    YZX = ((1, 2, 0), False)
    ZXY = ((2, 0, 1), False)
    ZYX = ((2, 1, 0), False)
    XYX_SPACE = ((0, 1, 0), True)
    XZX_SPACE = ((0, 2, 0), True)
    YXY_SPACE = ((1, 0, 1), True)
    YZY_SPACE = ((1, 2, 1), True)
    ZXZ_SPACE = ((2, 0, 2), True)
    ZYZ_SPACE = ((2, 1, 2), True)
    XYZ_SPACE = ((0, 1, 2), True)
    XZY_SPACE = ((0, 2, 1), True)
    YXZ_SPACE = ((1, 0, 2), True)
    YZX_SPACE = ((1, 2, 0), True)
    ZXY_SPACE = ((2, 0, 1), True)
    ZYX_SPACE = ((2, 1, 0), True)

    @classmethod
    def of(cls, axes: str) -> "Sequence":
        """The sequence that SciPy writes so: ``"ZYX"`` intrinsic, ``"zyx"`` extrinsic.

        Raises ValueError for anything but three letters of one case, neighbours different.
        """
        name = axes.upper() + ("_SPACE" if axes.islower() else "")
        if name not in cls.__members__ or not (axes.islower() or axes.isupper()):
            raise ValueError(
                f"no sequence is called {axes!r}: give three of XYZ about body axes or three of xyz"
                ' about space axes, neighbours different, such as "ZYX" (yaw, pitch, roll).'
            )
        return cls[name]

    @property
    def axes(self) -> tuple[int, int, int]:
        """Axes in the order in which the angles are given; 0, 1, 2 are x, y, z."""
        return self.value[0]

    @property
    def is_extrinsic(self) -> bool:
        """Whether all three rotations are about fixed space axes."""
        return self.value[1]

    @property
    def is_proper(self) -> bool:
        """Whether the first and the last axis are the same."""
        return self.axes[0] == self.axes[2]
