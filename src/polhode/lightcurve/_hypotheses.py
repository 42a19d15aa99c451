"""What pairs of lines of a light curve can mean: periods and mode of a body."""

from typing import NamedTuple

import numpy as np

from polhode.lightcurve._frequencies import Pairs, Scan

# Sums i f_phi + j f_psi in the light of ellipsoids, and the part of its variance that each has:
# means over spins and directions at random, in round numbers. Half a turn about its long axis, or
# half a period of the nutation about the short one, leave an ellipsoid's light as it was: in
# long-axis mode j is even, in short-axis mode i + j is.
LAM = {
    (1, 0): 0.4, (2, 0): 0.2, (2, 2): 0.2, (1, 2): 0.06, (0, 2): 0.05, (1, -2): 0.005,
    (3, 0): 0.005, (4, 0): 0.005, (4, 2): 0.003, (3, 2): 0.003,
}  # fmt: skip
SAM = {
    (1, 1): 0.5, (2, 0): 0.35, (2, 2): 0.1, (1, -1): 0.015, (0, 2): 0.012, (1, 3): 0.01,
    (3, 1): 0.003, (4, 0): 0.003,
}  # fmt: skip
_MAIN = 0.0101  # sums with more than this are taken for the lines seen
_OVER = 5  # nodes by resolution


class Hypotheses(NamedTuple):
    """Periods that a light curve may stand for; arrays (h,)."""

    f_phi: np.ndarray
    f_psi: np.ndarray
    long_axis: np.ndarray  # bool: LAM


def hypotheses(pairs: Pairs, t, values, *, columns=None, most: int = 400) -> Hypotheses:
    """Bodies' frequencies of which the lines (g, h) are two sums, the ``most`` most likely first.

    Each of g and h may be any of the main sums of either mode. How likely a meaning is: by the
    evidence of Gaussian waves of all sums of the mode, with their usual variances. SAM has
    ``f_psi <= f_phi``, because no moment exceeds the sum of the other two.
    """
    lines = np.stack([pairs.f_phi, pairs.f_psi], -1)
    highest = 1.01 * lines.max()
    scan = Scan.of(t, values, columns, highest, _OVER, 6)
    # noise, waves that are not listed, and directions that turn: twice what the best pair leaves
    left = 2 * max(1 - float(np.max(pairs.explained)), 1e-3)
    found, score = [], []
    for long_axis, sums in ((True, LAM), (False, SAM)):
        meant = np.einsum("kij,lj->lki", _solved(sums), lines).reshape(-1, 2)
        # half a turn within the light curve at least
        good = meant.min(1) >= 0.5 * pairs.resolution
        good &= meant.max(1) <= highest
        if not long_axis:
            good &= meant[:, 1] <= meant[:, 0]
        meant = meant[good]
        if not len(meant):
            continue
        nodes = np.rint(meant @ np.array(list(sums)).T / scan.step).astype(int)
        variance = np.array(list(sums.values()))
        power, size = scan.fitted(nodes, left / variance / scan.size)
        evidence = power * scan.size / left - size + 2 * np.log(left / variance).sum()
        kept = _apart(meant, evidence, 0.4 * pairs.resolution, most)
        found += [(*meant[k], long_axis) for k in kept]
        score += evidence[kept].tolist()
    best = np.argsort(-np.array(score))[:most]
    f_phi, f_psi, mode = np.array(found, float).reshape(-1, 3)[best].T
    return Hypotheses(f_phi, f_psi, mode > 0.5)


def _solved(sums) -> np.ndarray:
    """Matrices (k, 2, 2) from (g, h) to (f_phi, f_psi): two main sums solved for these."""
    main = [np.array(s, float) for s, part in sums.items() if part > _MAIN]
    out = []
    for a in main:
        for b in main:
            matrix = np.stack([a, b])
            if abs(np.linalg.det(matrix)) > 0.5:
                out.append(np.linalg.inv(matrix))
    return np.unique(np.round(out, 9), axis=0)


def _apart(points: np.ndarray, score: np.ndarray, size: float, most: int) -> list[int]:
    """Numbers of the ``most`` best of (k, 2), no two within ``size`` of each other."""
    kept: list[int] = []
    for k in np.argsort(-score):
        if not kept or np.abs(points[kept] - points[k]).max(1).min() > size:
            kept.append(int(k))
        if len(kept) == most:
            break
    return kept


def meaning(f_phi: float, f_psi: float) -> str:
    """What a pair would mean, in words: modes that it allows, and the strongest sums of each."""

    def listed(sums):
        return ", ".join(
            f"{_name(i, 'f_phi')}{_name(j, 'f_psi', first=i == 0)} = {i * f_phi + j * f_psi:.5g}"
            for i, j in list(sums)[:3]
        )

    # A body slower about L than about its long axis can only turn fully about the latter:
    # (I_s/I_i - 1)(I_s/I_l - 1) <= 1 for moments that mass can have.
    if f_psi < f_phi:
        return f"LAM or SAM; LAM: {listed(LAM)}; SAM: {listed(SAM)}"
    return f"LAM only: {listed(LAM)}"


def _name(count: int, symbol: str, first: bool = True) -> str:
    if count == 0:
        return ""
    sign = "-" if count < 0 else "" if first else "+"
    size = "" if abs(count) == 1 else f"{abs(count)} "
    return f"{sign}{size}{symbol}" if first else f" {sign} {size}{symbol}"
