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
    (3, 0): 0.005, (4, 0): 0.005, (4, 2): 0.003, (3, 2): 0.003, (4, 4): 0.003,
}  # fmt: skip
SAM = {
    (1, 1): 0.5, (2, 0): 0.35, (2, 2): 0.1, (1, -1): 0.015, (0, 2): 0.012, (1, 3): 0.01,
    (3, 1): 0.003, (4, 0): 0.003,
}  # fmt: skip
_MAIN = 0.0101  # sums with more than this are taken for the lines seen
_OVER = 5  # nodes by resolution
_LINES = 6  # lines whose other frequency is sought over all of the grid


class Hypotheses(NamedTuple):
    """Periods that a light curve may stand for; arrays (h,)."""

    f_phi: np.ndarray
    f_psi: np.ndarray
    long_axis: np.ndarray  # bool: LAM


def hypotheses(pairs: Pairs, t, values, *, columns=None, most: int = 800) -> Hypotheses:
    """Bodies' frequencies that explain pairs of lines (g, h), the ``most`` most likely first.

    Each of g and h may be any of the main sums of either mode; or g of the best pairs is one, and
    the other frequency anything, where g is all that is seen. How likely a meaning is: by the
    evidence of Gaussian waves of all sums of the mode, with their usual variances. SAM has
    ``f_psi <= f_phi``, because no moment exceeds the sum of the other two.
    """
    lines = np.stack([pairs.f_phi, pairs.f_psi], -1)
    highest = 1.01 * lines.max()
    scan = Scan.of(t, values, columns, highest, _OVER, 8)
    # noise, waves that are not listed, and directions that turn: twice what the best pair leaves
    left = 2 * max(1 - float(np.max(pairs.explained)), 1e-3)
    alone = lines[_apart(lines[:, :1], pairs.explained, 0.2 * pairs.resolution, _LINES), 0]
    found, score = [], []
    for long_axis, sums in ((True, LAM), (False, SAM)):
        main = {s: part for s, part in sums.items() if part > _MAIN}
        meant = [np.einsum("kij,lj->lki", _solved(main), lines).reshape(-1, 2)]
        for i, j in main:
            free = _with_line(i, j, alone, scan)
            free = free[_possible(free, long_axis, pairs.resolution, highest)]
            if len(free):
                best = np.argsort(-_evidence(scan, free, main, left))
                meant.append(free[best[:most]])
        meant = np.concatenate(meant)
        meant = meant[_possible(meant, long_axis, pairs.resolution, highest)]
        if len(meant):
            evidence = _evidence(scan, meant, sums, left)
            kept = _apart(meant, evidence, 0.4 * pairs.resolution, most)
            found += [(*meant[k], long_axis) for k in kept]
            score += evidence[kept].tolist()
    best = np.argsort(-np.array(score))[:most]
    f_phi, f_psi, mode = np.array(found, float).reshape(-1, 3)[best].T
    return Hypotheses(f_phi, f_psi, mode > 0.5)


def _possible(meant: np.ndarray, long_axis: bool, resolution: float, highest: float) -> np.ndarray:
    # half a turn within the light curve at least
    good = (meant.min(1) >= 0.5 * resolution) & (meant.max(1) <= highest)
    return good if long_axis else good & (meant[:, 1] <= meant[:, 0])


def _with_line(i: int, j: int, lines: np.ndarray, scan: Scan) -> np.ndarray:
    """All (f_phi, f_psi) of the grid for which i f_phi + j f_psi is one of ``lines``."""
    nodes = scan.step * np.arange(1, scan.count)
    g, other = (x.reshape(-1) for x in np.meshgrid(lines, nodes, indexing="ij"))
    if j == 0:
        return np.stack([g / i, other / 2], -1)
    return np.stack([other, (g - i * other) / j], -1)


def _evidence(scan: Scan, meant: np.ndarray, sums, left: float) -> np.ndarray:
    """Twice the logarithm of the evidence (k,) of waves of ``sums``, but for a constant."""
    nodes = np.rint(meant @ np.array(list(sums)).T / scan.step).astype(int)
    variance = np.array(list(sums.values()))
    power, size = scan.fitted(nodes, left / variance / scan.size)
    return power * scan.size / left - size + 2 * np.log(left / variance).sum()


def _solved(sums) -> np.ndarray:
    """Matrices (k, 2, 2) from (g, h) to (f_phi, f_psi): two of the sums solved for these."""
    main = np.array(list(sums), float)
    pairs = [np.stack([a, b]) for a in main for b in main if abs(np.linalg.det([a, b])) > 0.5]
    return np.unique(np.round(np.linalg.inv(pairs), 9), axis=0)


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
            f"{sum_name(i, j)} = {i * f_phi + j * f_psi:.5g}" for i, j in list(sums)[:3]
        )

    # A body slower about L than about its long axis can only turn fully about the latter:
    # (I_s/I_i - 1)(I_s/I_l - 1) <= 1 for moments that mass can have.
    if f_psi < f_phi:
        return f"LAM or SAM; LAM: {listed(LAM)}; SAM: {listed(SAM)}"
    return f"LAM only: {listed(LAM)}"


def sum_name(i: int, j: int) -> str:
    """The sum i f_phi + j f_psi in words."""
    return f"{_name(i, 'f_phi')}{_name(j, 'f_psi', first=i == 0)}"


def _name(count: int, symbol: str, first: bool = True) -> str:
    if count == 0:
        return ""
    sign = "-" if count < 0 else "" if first else "+"
    size = "" if abs(count) == 1 else f"{abs(count)} "
    return f"{sign}{size}{symbol}" if first else f" {sign} {size}{symbol}"
