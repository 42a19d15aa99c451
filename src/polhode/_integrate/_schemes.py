"""Coefficients of composition methods, each a palindromic list fed to one stepper.

A list ``(c_1, ..., c_2s)`` means chi(c_1 h), chi*(c_2 h), chi(c_3 h), ... where chi runs the flows
of the parts one after the other and chi* is its adjoint, the same flows in opposite order.
"""

from typing import NamedTuple


class Scheme(NamedTuple):
    """A composition: its order, its coefficients and where they were published."""

    order: int
    coefficients: tuple[float, ...]
    reference: str


def _from_strang(order: int, half: tuple[float, ...], reference: str) -> Scheme:
    """Composition of Strang steps; ``half`` ends with the middle one."""
    gammas = (*half, *reversed(half[:-1]))
    middle = len(half) - 1
    gammas = (*half[:-1], 1 - 2 * sum(half[:-1]), *gammas[middle + 1 :])
    return Scheme(order, tuple(g / 2 for g in gammas for _ in range(2)), reference)


def _from_two_parts(order: int, a: tuple[float, ...], b: tuple[float, ...], ref: str) -> Scheme:
    """The composition whose two-part form is a_1 b_1 a_2 b_2 ...; ``a`` and ``b`` are the halves
    without the entries that consistency fixes: of the one with an entry in the middle that, of the
    other the last one of the half."""

    def whole(half, has_middle):
        if has_middle:
            return (*half, 1 - 2 * sum(half), *reversed(half))
        half = (*half, 0.5 - sum(half))
        return (*half, *reversed(half))

    # one a more than b in all; what is fixed counts once in the half or in the middle
    middle_is_a = len(a) > len(b)
    whole_a, whole_b = whole(a, middle_is_a), whole(b, not middle_is_a)
    coefficients = [whole_a[0]]
    for i, value in enumerate(whole_b):
        coefficients.append(value - coefficients[-1])
        if i + 1 < len(whole_b):
            coefficients.append(whole_a[i + 1] - coefficients[-1])
    return Scheme(order, tuple(coefficients), ref)


STRANG = _from_strang(2, (1.0,), "G. Strang, SIAM J. Numer. Anal. 5 (1968) 506")

BLANES_MOAN_4 = _from_two_parts(
    4,
    (0.0792036964311957, 0.353172906049774, -0.0420650803577195),
    (0.209515106613362, -0.143851773179818),
    "S. Blanes, P. C. Moan, J. Comput. Appl. Math. 142 (2002) 313, table 2, S6",
)

BLANES_MOAN_6 = _from_two_parts(
    6,
    (
        0.0502627644003922,
        0.413514300428344,
        0.0450798897943977,
        -0.188054853819569,
        0.541960678450780,
    ),
    (0.148816447901042, -0.132385865767784, 0.067307604692185, 0.432666402578175),
    "S. Blanes, P. C. Moan, J. Comput. Appl. Math. 142 (2002) 313, table 2, S10",
)

KAHAN_LI_8 = _from_strang(
    8,
    (
        0.13020248308889008088,
        0.56116298177510838456,
        -0.38947496264484728641,
        0.15884190655515560090,
        -0.39590389413323757734,
        0.18453964097831570709,
        0.25837438768632204729,
        0.29501172360931029887,
        -0.60550853383003451170,
    ),
    "W. Kahan, R.-C. Li, Math. Comp. 66 (1997) 1089, s17odr8a",
)

NYSTROM_4 = _from_two_parts(
    4,
    (0.0829844064174052, 0.396309801498368, -0.0390563049223486),
    (0.245298957184271, 0.604872665711080),
    "S. Blanes, P. C. Moan, J. Comput. Appl. Math. 142 (2002) 313, table 3, SRKN6b",
)

NYSTROM_6 = _from_two_parts(
    6,
    (
        0.0,
        0.09171915262446165,
        0.183983170005006,
        -0.05653436583288827,
        0.004914688774712854,
        0.143761127168358,
        0.328567693746804,
    ),
    (
        0.0378593198406116,
        0.102635633102435,
        -0.0258678882665587,
        0.314241403071447,
        -0.130144459517415,
        0.106417700369543,
        -0.00879424312851058,
    ),
    "S. Blanes, P. C. Moan, J. Comput. Appl. Math. 142 (2002) 313, table 3, SRKN14a",
)

SCHEMES = {s.order: s for s in (STRANG, BLANES_MOAN_4, BLANES_MOAN_6, KAHAN_LI_8)}
"""The scheme of each order for any parts."""

KICK_SCHEMES = {s.order: s for s in (STRANG, NYSTROM_4, NYSTROM_6, KAHAN_LI_8)}
"""The scheme of each order for two parts, a kick and a motion whose energy is quadratic in the
momenta: the two commute suitably (Runge-Kutta-Nyström), so fewer conditions hold up the order."""
