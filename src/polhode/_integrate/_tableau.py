"""Coefficients of the explicit Runge-Kutta methods of the integration loop: DOP853 and Tsit5."""

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True, eq=False)
class Tableau:
    """Coefficients of an explicit Runge-Kutta method whose last stage is at the end of the step.

    - ``order``: of the error estimate in the width;
    - ``nodes`` (S,): of all S stages; ``weights`` (S, S): of the previous stages;
    - ``stages``: number of stages of a step; the others are those of dense output;
    - ``errors``: weights of one error estimate, or of two of different orders;
    - ``difference``: weights of a divided difference of the rates, or None;
    - ``dense`` (K, S): weights of the coefficients of dense output beyond Hermite's cubic;
    - ``dense_error``: error of dense output over that at the end of the step, in the mean of
      rotating bodies;
    - ``margin_stages``: in order of time, the stages at which margins of switches are examined;
    - ``stability``: width times rate of decay beyond which a step amplifies errors."""

    order: int
    nodes: np.ndarray
    weights: np.ndarray
    stages: int
    errors: tuple[np.ndarray, ...]
    difference: np.ndarray | None
    dense: np.ndarray
    dense_error: float
    margin_stages: tuple[int, ...]
    stability: float
    margin_nodes: tuple[float, ...] = field(init=False)

    def __post_init__(self):
        places = tuple(float(self.nodes[k]) for k in self.margin_stages)
        object.__setattr__(self, "margin_nodes", places)

    @property
    def dense_stages(self) -> int:
        """Number of all stages."""
        return len(self.nodes)


_DOP853_STAGES = 13
"""Stages of a step, of which the last is at its end and is the first of the next step."""

_DOP853_DENSE_STAGES = 16
"""Stages including those of dense output."""

_DOP853_NODES = (
    0.0,
    0.05260015195876773,
    0.0789002279381516,
    0.1183503419072274,
    0.2816496580927726,
    0.3333333333333333,
    0.25,
    0.3076923076923077,
    0.6512820512820513,
    0.6,
    0.8571428571428571,
    1.0,
    1.0,
    0.1,
    0.2,
    0.7777777777777778,
)

_DOP853_ROWS = {
    1: {0: 0.05260015195876773},
    2: {0: 0.0197250569845379, 1: 0.0591751709536137},
    3: {0: 0.02958758547680685, 2: 0.08876275643042054},
    4: {0: 0.2413651341592667, 2: -0.8845494793282861, 3: 0.924834003261792},
    5: {0: 0.037037037037037035, 3: 0.17082860872947386, 4: 0.12546768756682242},
    6: {0: 0.037109375, 3: 0.17025221101954405, 4: 0.06021653898045596, 5: -0.017578125},
    7: {
        0: 0.03709200011850479,
        3: 0.17038392571223998,
        4: 0.10726203044637328,
        5: -0.015319437748624402,
        6: 0.008273789163814023,
    },
    8: {
        0: 0.6241109587160757,
        3: -3.3608926294469414,
        4: -0.868219346841726,
        5: 27.59209969944671,
        6: 20.154067550477894,
        7: -43.48988418106996,
    },
    9: {
        0: 0.47766253643826434,
        3: -2.4881146199716677,
        4: -0.590290826836843,
        5: 21.230051448181193,
        6: 15.279233632882423,
        7: -33.28821096898486,
        8: -0.020331201708508627,
    },
    10: {
        0: -0.9371424300859873,
        3: 5.186372428844064,
        4: 1.0914373489967295,
        5: -8.149787010746927,
        6: -18.52006565999696,
        7: 22.739487099350505,
        8: 2.4936055526796523,
        9: -3.0467644718982196,
    },
    11: {
        0: 2.273310147516538,
        3: -10.53449546673725,
        4: -2.0008720582248625,
        5: -17.9589318631188,
        6: 27.94888452941996,
        7: -2.8589982771350235,
        8: -8.87285693353063,
        9: 12.360567175794303,
        10: 0.6433927460157636,
    },
    12: {
        0: 0.054293734116568765,
        5: 4.450312892752409,
        6: 1.8915178993145003,
        7: -5.801203960010585,
        8: 0.3111643669578199,
        9: -0.1521609496625161,
        10: 0.20136540080403034,
        11: 0.04471061572777259,
    },
    13: {
        0: 0.056167502283047954,
        6: 0.25350021021662483,
        7: -0.2462390374708025,
        8: -0.12419142326381637,
        9: 0.15329179827876568,
        10: 0.00820105229563469,
        11: 0.007567897660545699,
        12: -0.008298,
    },
    14: {
        0: 0.03183464816350214,
        5: 0.028300909672366776,
        6: 0.053541988307438566,
        7: -0.05492374857139099,
        10: -0.00010834732869724932,
        11: 0.0003825710908356584,
        12: -0.00034046500868740456,
        13: 0.1413124436746325,
    },
    15: {
        0: -0.42889630158379194,
        5: -4.697621415361164,
        6: 7.683421196062599,
        7: 4.06898981839711,
        8: 0.3567271874552811,
        12: -0.0013990241651590145,
        13: 2.9475147891527724,
        14: -9.15095847217987,
    },
}
"""Weights of the previous stages, for each stage."""

_DOP853_DENSE = {
    0: {
        0: -8.428938276109013,
        5: 0.5667149535193777,
        6: -3.0689499459498917,
        7: 2.38466765651207,
        8: 2.117034582445028,
        9: -0.871391583777973,
        10: 2.2404374302607883,
        11: 0.6315787787694688,
        12: -0.08899033645133331,
        13: 18.148505520854727,
        14: -9.194632392478356,
        15: -4.436036387594894,
    },
    1: {
        0: 10.427508642579134,
        5: 242.28349177525817,
        6: 165.20045171727028,
        7: -374.5467547226902,
        8: -22.113666853125306,
        9: 7.733432668472264,
        10: -30.674084731089398,
        11: -9.332130526430229,
        12: 15.697238121770845,
        13: -31.139403219565178,
        14: -9.35292435884448,
        15: 35.81684148639408,
    },
    2: {
        0: 19.985053242002433,
        5: -387.0373087493518,
        6: -189.17813819516758,
        7: 527.8081592054236,
        8: -11.57390253995963,
        9: 6.8812326946963,
        10: -1.0006050966910838,
        11: 0.7777137798053443,
        12: -2.778205752353508,
        13: -60.19669523126412,
        14: 84.32040550667716,
        15: 11.99229113618279,
    },
    3: {
        0: -25.69393346270375,
        5: -154.18974869023643,
        6: -231.5293791760455,
        7: 357.6391179106141,
        8: 93.40532418362432,
        9: -37.45832313645163,
        10: 104.0996495089623,
        11: 29.8402934266605,
        12: -43.53345659001114,
        13: 96.32455395918828,
        14: -39.17726167561544,
        15: -149.72683625798564,
    },
}
"""Weights of the stages in the last four coefficients of dense output."""

_DOP853_ERROR_5 = {
    0: {
        0: 0.01312004499419488,
        5: -1.2251564463762044,
        6: -0.4957589496572502,
        7: 1.6643771824549864,
        8: -0.35032884874997366,
        9: 0.3341791187130175,
        10: 0.08192320648511571,
        11: -0.022355307863886294,
    },
}
"""Weights of the stages in the error of order 5."""

_DOP853_ERROR_3 = {
    0: {
        0: -0.18980075407240762,
        5: 4.450312892752409,
        6: 1.8915178993145003,
        7: -5.801203960010585,
        8: -0.4226823213237919,
        9: -0.1521609496625161,
        10: 0.20136540080403034,
        11: 0.02265179219836082,
    },
}
"""Weights of the stages in the error of order 3."""


def _filled(rows: dict[int, dict[int, float]], shape: tuple[int, int]) -> np.ndarray:
    table = np.zeros(shape)
    for i, row in rows.items():
        for j, value in row.items():
            table[i, j] = value
    return table


def _divided_difference(stages: tuple[int, ...]) -> np.ndarray:
    """Weights of the divided difference of the rates at some stages of DOP853."""
    places = np.array([_DOP853_NODES[k] for k in stages])
    gaps = places[:, None] - places + np.eye(len(stages))
    weights = np.zeros(_DOP853_STAGES)
    weights[list(stages)] = 1 / np.prod(gaps, axis=1)
    return weights


DOP853 = Tableau(
    7,
    np.array(_DOP853_NODES),
    # row 12 is the result of the step
    _filled(_DOP853_ROWS, (_DOP853_DENSE_STAGES, _DOP853_DENSE_STAGES)),
    _DOP853_STAGES,
    (
        _filled(_DOP853_ERROR_5, (1, _DOP853_STAGES))[0],
        _filled(_DOP853_ERROR_3, (1, _DOP853_STAGES))[0],
    ),
    # The only combination of the stages that is of the seventh order in the width for every field:
    # it alone satisfies all 37 order conditions up to the sixth.
    _divided_difference((0, 5, 6, 7, 8, 9, 10)),
    _filled(_DOP853_DENSE, (4, _DOP853_DENSE_STAGES)),
    10,
    (0, 3, 6, 5, 9, 10, 12),
    6.4,
)
"""Order 8, dense output of order 7; the table leaves out zeros. J. R. Dormand, P. J. Prince;
E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I (1993), sections
II.5, II.6 and II.10, code ``dop853``."""


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
    None,
    _TSIT5_DENSE,
    3,
    # without the sixth stage, which is at the end of the step and less accurate than the seventh
    (0, 1, 2, 3, 4, 6),
    3.5,
)
"""Order 5, dense output of order 4. C. Tsitouras, Computers & Mathematics with Applications 62
(2011) 770-775."""
