"""Explicit Runge-Kutta rules that the loop of explicit steps can take."""

from dataclasses import dataclass, field

import numpy as np

from polhode._integrate import _dop853


@dataclass(frozen=True, eq=False)
class Tableau:
    """Coefficients of an explicit rule the last stage of which stands at the end of the step.

    ``order`` of the error estimate in the width; ``nodes`` (S,): where all S stages stand in the
    step; ``weights`` (S, S): of the stages before; ``stages``: how many the step needs, the others
    belong to dense output; ``errors``: weights of one error estimate, or of two of different
    order; ``dense`` (K, S): of the coefficients of dense output beyond the cubic of Hermite;
    ``margin_stages``: in order of time, those at which switches are inspected."""

    order: int
    nodes: np.ndarray
    weights: np.ndarray
    stages: int
    errors: tuple[np.ndarray, ...]
    dense: np.ndarray
    margin_stages: tuple[int, ...]
    margin_nodes: tuple[float, ...] = field(init=False)

    def __post_init__(self):
        places = tuple(float(self.nodes[k]) for k in self.margin_stages)
        object.__setattr__(self, "margin_nodes", places)

    @property
    def dense_stages(self) -> int:
        """Number of all stages."""
        return len(self.nodes)


DOP853 = Tableau(
    7,
    _dop853.NODES,
    _dop853.WEIGHTS,
    _dop853.STAGES,
    (_dop853.ERROR_5, _dop853.ERROR_3),
    _dop853.DENSE,
    (0, 3, 6, 5, 9, 10, 12),
)
"""Order 8, dense output of order 7."""

_TSIT5_DENSE = np.array(
    [
        [
            -1.0530884977290216,
            0.1017,
            2.490627285651252793,
            -16.54810288924490272,
            47.37952196281928122,
            -34.87065786149660974,
            2.5,
        ]
    ]
)
"""Coefficients of x^4 of the stages in the interpolant of Tsit5."""

_TSIT5_ROWS = (
    (0.161,),
    (-0.008480655492356989, 0.335480655492357),
    (2.8971530571054935, -6.359448489975075, 4.3622954328695815),
    (5.325864828439257, -11.748883564062828, 7.4955393428898365, -0.09249506636175525),
    (
        5.86145544294642,
        -12.92096931784711,
        8.159367898576159,
        -0.071584973281401,
        -0.028269050394068383,
    ),
    (
        0.09646076681806523,
        0.01,
        0.4798896504144996,
        1.379008574103742,
        -3.290069515436081,
        2.324710524099774,
    ),
)
_TSIT5_ERROR = (
    0.0017800110522257773,
    0.0008164344596567463,
    -0.007880878010261994,
    0.1447110071732629,
    -0.5823571654525552,
    0.45808210592918686,
    -0.015151515151515152,
)

TSIT5 = Tableau(
    5,
    np.array([0.0, 0.161, 0.327, 0.9, 0.9800255409045097, 1.0, 1.0]),
    np.array([[0.0] * 7] + [[*row, *[0.0] * (7 - len(row))] for row in _TSIT5_ROWS]),
    7,
    (np.array(_TSIT5_ERROR),),
    _TSIT5_DENSE,
    # the sixth stage stands at the end too, less accurately than the seventh
    (0, 1, 2, 3, 4, 6),
)
"""Order 5, dense output of order 4. C. Tsitouras, Computers & Mathematics with Applications 62
(2011) 770-775."""
