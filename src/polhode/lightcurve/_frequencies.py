"""Fourier series of a light curve, and the interpretations of its lines as a body's frequencies."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode.lightcurve._data import BLOCK

# Two-dimensional Fourier series: the pairs of frequencies that fit a light curve.
#
# The brightness of a torque-free body, seen from constant directions, is a series in ``cos`` and
# ``sin`` of ``2 pi (i f_phi + j f_psi) t``. If f_phi and f_psi are nodes of a uniform grid, so is
# every such sum. The transforms of data and sampling window are therefore tabulated once, in
# O(points x nodes), and the normal equations of any pair are looked up in the tables: their cost
# does not depend on the number of points, only on the square of the number of terms.

_CHUNK = 4096
# Maximum number of frequency nodes, for the two-dimensional grid of pairs and for that of lines.
_MAX_PAIR_NODES, _MAX_LINE_NODES = 600, 15_000
_FASTEST = 24.0  # per day: the second harmonic of a rotation in two hours
_EDGE = 0.95  # lines above this part of the highest frequency are at the edge of the grid
# Sums (i, j) of two lines g and h: g/2, g, 3g/2 and 2g, so that h is not chosen for what g alone
# explains; then h, g + h and g - h.
LINES = np.array([(1, 0), (2, 0), (3, 0), (4, 0), (0, 2), (2, 2), (2, -2)]) / 2


class Pairs(NamedTuple):
    """Candidate pairs of frequencies, the best first."""

    f_phi: np.ndarray  # (k,) per unit of time
    f_psi: np.ndarray  # (k,)
    explained: np.ndarray  # (k,) part of the variance that the series explains
    resolution: float  # 1 / span
    max_frequency: float = np.inf  # end of the grid
    # strongest line of the whole spectrum that the sampling resolves; may be beyond the grid
    strongest: float = np.nan
    is_cut: bool = False  # the grid was limited and the spectrum has strong lines beyond it

    def warnings(self) -> tuple[str, ...]:
        """Sentences on lines that may lie beyond the range of the search."""
        at_edge = max(self.f_phi[:1].max(initial=0), self.f_psi[:1].max(initial=0))
        out = []
        if self.is_cut or self.strongest > self.max_frequency:
            out.append(
                f"The search ends at {self.max_frequency:.4g} cycles per day, below lines of the"
                f" spectrum (the strongest is at {self.strongest:.4g}): faster rotations were not"
                " tried. Set a higher max_frequency (--max-frequency)."
            )
        elif at_edge > _EDGE * self.max_frequency:
            out.append(
                f"The best pair has a line at {at_edge:.4g} cycles per day, at the edge of the"
                f" search ({self.max_frequency:.4g}): faster lines may explain more. Set a higher"
                " max_frequency (--max-frequency)."
            )
        return tuple(out)


def terms(order: int, even: bool = True) -> np.ndarray:
    """Multiples (i, j) of f_phi and f_psi, one of each pair of opposite signs.

    ``even``: only even j. The light of a body in long-axis mode that is symmetric under half a turn
    about its long axis, such as an ellipsoid, has no others.
    """
    j = np.arange(-order, order + 1) * (2 if even else 1)
    grid = np.array([(a, b) for a in range(order + 1) for b in j])
    return grid[(grid[:, 0] > 0) | (grid[:, 1] > 0)]


@partial(jax.jit, static_argnums=3)  # outside jit too, one program for all operations
def _transforms(t, values, step: float, count: int):
    """Sums of ``values`` (c, n) times exp(-2 pi i k step t), k = 0 ... count - 1: (c, count)."""

    def block(k):
        phase = 2 * jnp.pi * ((k[:, None] * step * t[None]) % 1.0).T
        return jax.lax.complex(values @ jnp.cos(phase), -(values @ jnp.sin(phase)))

    starts = jnp.arange(0, count, 256)
    out = jax.lax.map(lambda s: block(s + jnp.arange(256.0)), starts.astype(t.dtype))
    return jnp.moveaxis(out, 0, 1).reshape(values.shape[0], -1)[:, :count]


def _gram(tables, a, b):
    """Entries of the normal equations of columns cos, sin at nodes a, b (..., k): real blocks.

    ``tables``: transforms of the window and of the orthonormal columns projected out.
    """
    window, columns = tables

    def at(table, k):
        value = jnp.take(table, jnp.abs(k), axis=-1)
        return jnp.where(k < 0, jnp.conj(value), value)

    # A product of two waves is a wave with the difference plus one with the sum of their
    # frequencies, both nodes of the grid: two look-ups replace a sum over the points. Blocks cos
    # cos, cos sin, sin cos, sin sin. The transforms use exp(-i x): Re is cos and -Im is sin.
    less, more = at(window, a - b), at(window, a + b)
    cc, ss = (less.real + more.real) / 2, (less.real - more.real) / 2
    sc, cs = -(more.imag + less.imag) / 2, -(more.imag - less.imag) / 2
    left, right = at(columns, a), at(columns, b)
    lc, ls, rc, rs = left.real, -left.imag, right.real, -right.imag
    return (
        cc - (lc * rc).sum(0),
        cs - (lc * rs).sum(0),
        sc - (ls * rc).sum(0),
        ss - (ls * rs).sum(0),
    )


def _equations(tables, data, nodes):
    """Matrix and right side of the normal equations at integer nodes (k,) of one pair."""
    a, b = nodes[:, None], nodes[None]
    cc, cs, sc, ss = _gram(tables, a, b)
    gram = jnp.block([[cc, cs], [sc, ss]])
    value = jnp.take(data, jnp.abs(nodes))
    value = jnp.where(nodes < 0, jnp.conj(value), value)
    return gram, jnp.concatenate([value.real, -value.imag])


@jax.jit
def _scan(tables, data, nodes):
    return jax.vmap(lambda each: _equations(tables, data, each))(nodes)


class Scan(NamedTuple):
    """Tables from which the normal equations of any pair of nodes are looked up."""

    tables: tuple  # transforms of the window and of the columns projected out
    data: Float[Array, " m"]
    step: float
    count: int  # nodes up to the highest frequency
    size: int  # points
    resolution: float
    strongest: float  # frequency of the strongest line
    is_cut: bool  # as in ``Pairs``

    @classmethod
    def of(
        cls, t, values, columns, highest, oversampling: int, most: int, max_nodes: int | None = None
    ) -> "Scan":
        """Tables for data ``values`` at times ``t``, with ``columns`` projected out.

        ``most``: the highest sum is that many times the highest frequency. ``highest``: the end of
        the grid; None: the end of the strong lines, but at most ``max_nodes`` nodes.
        """
        t, values = np.asarray(t, float), np.asarray(values, float)
        t = t - t[0]
        columns = np.ones((1, t.size)) if columns is None else np.asarray(columns, float)
        basis = _orthonormal(columns)
        size = values @ values
        values = values - basis.T @ (basis @ values)
        if values @ values <= 1e-24 * size:
            raise ValueError(
                "the brightness does not vary but for an offset of each group: there is nothing to"
                " find."
            )
        values = values / np.sqrt(values @ values)
        step = 1 / (oversampling * np.ptp(t))
        strongest, is_cut = np.nan, False
        if max_nodes is not None:
            strongest, end = _strong_lines(t, values, step)
            if highest is None:
                highest = min(end, max_nodes * step)
                is_cut = end > highest
        count = int(np.ceil(highest / step)) + 1
        # Points, columns and frequencies are padded, so that one program serves many light curves.
        missing, spare = -t.size % BLOCK, -len(basis) % 8
        rows = np.vstack([np.ones_like(t), values, basis, np.zeros((spare, t.size))])
        transforms = np.asarray(
            _transforms(
                jnp.asarray(np.pad(t, (0, missing))),
                jnp.asarray(np.pad(rows, ((0, 0), (0, missing)))),
                step,
                _padded_size(2 * (most * count + 1)),
            )
        )
        window, data, columns = map(jnp.asarray, (transforms[0], transforms[1], transforms[2:]))
        return cls(
            (window, columns),
            data,
            step,
            count,
            t.size,
            step * oversampling,
            strongest,
            is_cut,
        )

    def pairs(self, f_phi, f_psi, explained) -> Pairs:
        """``Pairs`` with the resolution and range of this grid."""
        end = (self.count - 1) * self.step
        return Pairs(f_phi, f_psi, explained, self.resolution, end, self.strongest, self.is_cut)

    def fit_nodes(self, nodes: np.ndarray, soft=1e-3) -> tuple[np.ndarray, np.ndarray]:
        """Part of the variance (k,) explained by waves at nodes (k, m), and ln det of the matrix.

        ``soft`` (..., m), times the number of points, is added to the diagonal of the normal
        equations.
        """
        chunk = min(_CHUNK, _padded_size(len(nodes)))
        whole = np.concatenate([nodes, np.repeat(nodes[-1:], -len(nodes) % chunk, 0)])
        power, size = np.empty((2, len(whole)))
        # Two sums of a pair may share a node, or be zero: the ridge makes the matrix regular. With
        # ``soft`` from prior variances the determinant gives the evidence at no extra cost.
        ridge = self.size * np.diag(np.tile(np.broadcast_to(soft, nodes.shape[1:]), 2))
        for start in range(0, len(whole), chunk):
            part = slice(start, start + chunk)
            gram, right = _scan(self.tables, self.data, jnp.asarray(whole[part]))
            gram, right = np.asarray(gram) + ridge, np.asarray(right)
            power[part] = np.sum(right * np.linalg.solve(gram, right[..., None])[..., 0], axis=-1)
            size[part] = np.linalg.slogdet(gram)[1]
        return np.nan_to_num(power[: len(nodes)]), size[: len(nodes)]

    def explained(self, pairs: np.ndarray, multiples: np.ndarray) -> np.ndarray:
        """Part of the variance (k,) that the sums (m, 2) of pairs of nodes (k, 2) explain."""
        return self.fit_nodes(np.rint(pairs @ multiples.T).astype(int))[0]


def check_max_frequency(t: np.ndarray, max_frequency: float | None) -> None:
    """ValueError for a highest frequency below one cycle within the light curve."""
    least = 1 / float(np.ptp(t))
    if max_frequency is not None and not max_frequency > least:
        raise ValueError(
            f"max_frequency must exceed one turn within the light curve, {least:.4g} per day, got"
            f" {max_frequency:g}."
        )


def reaches_beyond_pairs(t: np.ndarray, max_frequency: float | None, oversampling: int = 4) -> bool:
    """Whether this frequency is beyond the grid of ``fourier_pairs``, which memory limits."""
    nodes = 0.0 if max_frequency is None else max_frequency * np.ptp(t) * oversampling
    return nodes > _MAX_PAIR_NODES


def fourier_pairs(
    t: Float[Array | np.ndarray, " n"],
    values: Float[Array | np.ndarray, " n"],
    *,
    columns: Float[Array | np.ndarray, "c n"] | None = None,
    max_frequency: float | None = None,
    order: int = 2,
    even: bool = True,
    oversampling: int = 4,
    keep: int = 40,
) -> Pairs:
    """Pairs (f_phi, f_psi) whose Fourier series explain ``values`` best, over a full grid.

    ``columns``: functions fitted in addition, such as a constant for each night (default: one
    constant). ``max_frequency`` of either, per unit of ``t``; default: the larger of 1.3 times the
    highest frequency with a tenth of the maximum power and 2.2 times that of the maximum, but at
    most 600 steps of the grid, ``600 / oversampling`` cycles within the light curve:
    ``Pairs.is_cut`` and ``Pairs.warnings`` state if that is not enough, and `fourier_lattices`
    reaches higher. Returns the ``keep`` best local maxima on the grid. Without ``even`` the two may
    be swapped, and ``f_phi`` is the higher one.
    """
    multiples = terms(order, even)
    most = int(np.abs(multiples).sum(1).max())
    scan = Scan.of(t, values, columns, max_frequency, oversampling, most, _MAX_PAIR_NODES)
    # at least half a cycle within the light curve
    nodes = np.arange(max(oversampling // 2, 1), scan.count)
    pairs = np.stack(np.meshgrid(nodes, nodes, indexing="ij"), -1).reshape(-1, 2)
    if not even:
        pairs = pairs[pairs[:, 0] > pairs[:, 1]]
    power = scan.explained(pairs, multiples)
    grid = np.zeros((nodes.size, nodes.size))
    grid[tuple((pairs - nodes[0]).T)] = power
    power = grid
    peak = np.pad(power, 1, constant_values=-1.0)
    around = [
        peak[1 + i : peak.shape[0] - 1 + i, 1 + j : peak.shape[1] - 1 + j]
        for i in (-1, 0, 1)
        for j in (-1, 0, 1)
        if (i, j) != (0, 0)
    ]
    high = np.argwhere((power >= np.max(around, axis=0)) & (power > 0))
    best = high[np.argsort(-power[tuple(high.T)])][:keep]
    frequencies = nodes[best] * scan.step
    return scan.pairs(frequencies[:, 0], frequencies[:, 1], power[tuple(best.T)])


def fourier_lattices(
    t: Float[Array | np.ndarray, " n"],
    values: Float[Array | np.ndarray, " n"],
    *,
    columns: Float[Array | np.ndarray, "c n"] | None = None,
    max_frequency: float | None = None,
    lines: int = 16,
    oversampling: int = 5,
    keep: int = 60,
) -> Pairs:
    """Pairs of lines (g, h) that explain ``values`` best, given as ``f_phi`` and ``f_psi``.

    For long light curves, whose grid has millions of pairs: g is only one of the ``lines`` highest
    peaks of the spectrum of one frequency (some of which are aliases), and h is searched over the
    whole grid, in a fit with multiples of g/2. The light of a body has lines at a few sums of
    multiples of its frequencies; which of these sums g and h are is not decided here.
    ``max_frequency`` of either, per unit of ``t``; default: as for `fourier_pairs`, but at most
    15,000 steps of the grid, ``15_000 / oversampling`` cycles within the light curve.
    """
    scan = Scan.of(t, values, columns, max_frequency, oversampling, 2, _MAX_LINE_NODES)
    nodes = np.arange(max(oversampling // 2, 1), scan.count)
    peaks = _maxima(scan.fit_nodes(nodes[:, None])[0])[:lines]
    pairs, power = [], []
    for node in nodes[peaks]:
        line = np.stack([np.full_like(nodes, node), nodes], -1)
        part = scan.explained(line, LINES)
        best = _maxima(part)[:keep]
        pairs.append(line[best])
        power.append(part[best])
    pairs, power = np.concatenate(pairs), np.concatenate(power)
    index: list[int] = []
    for k in np.argsort(-power):
        near = np.abs(pairs[index] - pairs[k]).max(1) if index else np.array([np.inf])
        if near.min() > oversampling // 4:
            index.append(int(k))
        if len(index) == keep:
            break
    g, h = scan.step * pairs[index].T
    return scan.pairs(g, h, power[index])


def _padded_size(count: int) -> int:
    """The next power of two, at least 256: a padded size that many light curves share."""
    return max(1 << (count - 1).bit_length(), 256)


def _maxima(values: np.ndarray) -> np.ndarray:
    """Indices of the local maxima, the highest first."""
    around = np.pad(values, 1, constant_values=-np.inf)
    high = np.flatnonzero((values >= around[:-2]) & (values >= around[2:]))
    return high[np.argsort(-values[high])]


def _orthonormal(columns: np.ndarray) -> np.ndarray:
    """An orthonormal basis of the rows."""
    _, size, basis = np.linalg.svd(columns, full_matrices=False)
    return basis[size > 1e-10 * size[0]]


def _strong_lines(t, values, step) -> tuple[float, float]:
    """Frequency of the strongest line of the spectrum, and the end of a grid for all strong ones.

    The end: 1.3 times the highest frequency with a tenth of the maximum power, or 2.2 times that of
    the maximum, whose second harmonic may be the next line. The spectrum extends to the highest
    frequency that the sampling resolves; for sparse and uneven points to a rotation in two hours.
    """
    gaps = np.diff(np.sort(np.asarray(t, float)))
    gaps = gaps[gaps > 0]
    limit = max(0.5 / np.median(gaps), min(0.5 / np.quantile(gaps, 0.05), _FASTEST))
    count = max(int(min(limit / step, 4 * _MAX_LINE_NODES)), 8)
    missing = -len(t) % BLOCK
    t, values = np.pad(np.asarray(t, float), (0, missing)), np.pad(values, (0, missing))
    (table,) = _transforms(jnp.asarray(t), jnp.asarray(values)[None], step, _padded_size(count))
    power = np.abs(np.asarray(table))[:count] ** 2
    strong = step * np.flatnonzero(power > 0.1 * power.max())[-1]
    strongest = step * int(np.argmax(power))
    return strongest, min(max(1.3 * strong, 2.2 * strongest), max(count * step, 8 * step))


# Interpretations of pairs of lines of a light curve: periods and mode of a body.
#
# Two lines of the spectrum determine the two frequencies if it is known which sums they are. It is
# not: every invertible assignment of main sums is solved (a 2 x 2 system each) and ranked by the
# evidence of the whole series. No trial body is then drawn for a pair of frequencies that the
# spectrum rejects.

# Sums i f_phi + j f_psi in the light of ellipsoids, and the part of its variance that each has:
# rounded means over random spins and directions. By its symmetry an ellipsoid's light repeats after
# half a turn about the long axis in long-axis mode (j is even), and after half a period of the
# nutation with half a turn about the momentum in short-axis mode (i + j is even).
LAM = {
    (1, 0): 0.4,
    (2, 0): 0.2,
    (2, 2): 0.2,
    (1, 2): 0.06,
    (0, 2): 0.05,
    (1, -2): 0.005,
    (3, 0): 0.005,
    (4, 0): 0.005,
    (4, 2): 0.003,
    (3, 2): 0.003,
    (4, 4): 0.003,
}
SAM = {
    (1, 1): 0.5,
    (2, 0): 0.35,
    (2, 2): 0.1,
    (1, -1): 0.015,
    (0, 2): 0.012,
    (1, 3): 0.01,
    (3, 1): 0.003,
    (4, 0): 0.003,
}
_MAIN = 0.0101  # part of the variance above which a sum may be one of the lines
_OVER = 5  # oversampling: nodes per 1/span
_LINES = 6  # lines whose second frequency is searched over the whole grid


class Hypotheses(NamedTuple):
    """Frequencies and modes of bodies that may explain a light curve; arrays (h,)."""

    f_phi: np.ndarray
    f_psi: np.ndarray
    long_axis: np.ndarray  # bool: LAM


def hypotheses(pairs: Pairs, t, values, *, columns=None, max_count: int = 800) -> Hypotheses:
    """Frequencies of bodies that explain pairs of lines (g, h), at most ``max_count``, the most
    likely first.

    Each of g and h may be any of the main sums of either mode. For the best pairs g alone may be a
    main sum, and the other frequency is free. A hypothesis is rated by the evidence of waves at all
    sums of its mode with Gaussian amplitudes, whose prior variances are those of ``LAM`` or
    ``SAM``. In SAM ``f_psi <= f_phi``, because no moment exceeds the sum of the other two.
    """
    lines = np.stack([pairs.f_phi, pairs.f_psi], -1)
    highest = 1.01 * lines.max()
    scan = Scan.of(t, values, columns, highest, _OVER, 8)
    # for noise, waves not listed, and changing directions: twice the misfit of the best pair
    noise = 2 * max(1 - float(np.max(pairs.explained)), 1e-3)
    alone = lines[_separated(lines[:, :1], pairs.explained, 0.2 * pairs.resolution, _LINES), 0]
    candidates, score = [], []
    for long_axis, sums in ((True, LAM), (False, SAM)):
        main = {s: part for s, part in sums.items() if part > _MAIN}
        meant = [np.einsum("kij,lj->lki", _inverse_sums(main), lines).reshape(-1, 2)]
        for i, j in main:
            free = _with_line(i, j, alone, scan)
            free = free[_physically_possible(free, long_axis, pairs.resolution, highest)]
            if len(free):
                best = np.argsort(-_evidence(scan, free, main, noise))
                meant.append(free[best[:max_count]])
        meant = np.concatenate(meant)
        meant = meant[_physically_possible(meant, long_axis, pairs.resolution, highest)]
        if len(meant):
            evidence = _evidence(scan, meant, sums, noise)
            index = _separated(meant, evidence, 0.4 * pairs.resolution, max_count)
            candidates += [(*meant[k], long_axis) for k in index]
            score += evidence[index].tolist()
    best = np.argsort(-np.array(score))[:max_count]
    f_phi, f_psi, mode = np.array(candidates, float).reshape(-1, 3)[best].T
    return Hypotheses(f_phi, f_psi, mode > 0.5)


def _physically_possible(
    meant: np.ndarray, long_axis: bool, resolution: float, highest: float
) -> np.ndarray:
    # at least half a cycle within the light curve
    good = (meant.min(1) >= 0.5 * resolution) & (meant.max(1) <= highest)
    return good if long_axis else good & (meant[:, 1] <= meant[:, 0])


def _with_line(i: int, j: int, lines: np.ndarray, scan: Scan) -> np.ndarray:
    """All (f_phi, f_psi) on the grid for which i f_phi + j f_psi is one of ``lines``."""
    nodes = scan.step * np.arange(1, scan.count)
    g, other = (x.reshape(-1) for x in np.meshgrid(lines, nodes, indexing="ij"))
    if j == 0:
        return np.stack([g / i, other / 2], -1)
    return np.stack([other, (g - i * other) / j], -1)


def _evidence(scan: Scan, meant: np.ndarray, sums, misfit: float) -> np.ndarray:
    """Twice the logarithm of the evidence (k,) of waves at ``sums``, up to a constant."""
    nodes = np.rint(meant @ np.array(list(sums)).T / scan.step).astype(int)
    variance = np.array(list(sums.values()))
    power, size = scan.fit_nodes(nodes, misfit / variance / scan.size)
    return power * scan.size / misfit - size + 2 * np.log(misfit / variance).sum()


def _inverse_sums(sums) -> np.ndarray:
    """Matrices (k, 2, 2) from (g, h) to (f_phi, f_psi), for all pairs of ``sums`` as g and h."""
    main = np.array(list(sums), float)
    pairs = [np.stack([a, b]) for a in main for b in main if abs(np.linalg.det([a, b])) > 0.5]
    return np.unique(np.round(np.linalg.inv(pairs), 9), axis=0)


def _separated(points: np.ndarray, score: np.ndarray, size: float, max_count: int) -> list[int]:
    """Indices of the ``max_count`` best ``points`` (k, d), no two within ``size`` of each other."""
    index: list[int] = []
    for k in np.argsort(-score):
        if not index or np.abs(points[index] - points[k]).max(1).min() > size:
            index.append(int(k))
        if len(index) == max_count:
            break
    return index


def meaning(f_phi: float, f_psi: float) -> str:
    """Description of a pair of frequencies: possible modes, and the strongest sums of each."""

    def listed(sums):
        return ", ".join(
            f"{sum_name(i, j)} = {i * f_phi + j * f_psi:.5g}" for i, j in list(sums)[:3]
        )

    # A body that precesses about L more slowly than it rotates about its long axis is in long-axis
    # mode: (I_s/I_i - 1)(I_s/I_l - 1) <= 1 for physical moments.
    if f_psi < f_phi:
        return f"LAM or SAM; LAM: {listed(LAM)}; SAM: {listed(SAM)}"
    return f"LAM only: {listed(LAM)}"


def sum_name(i: int, j: int) -> str:
    """The sum i f_phi + j f_psi as text."""
    return f"{_name(i, 'f_phi')}{_name(j, 'f_psi', first=i == 0)}"


def _name(count: int, symbol: str, first: bool = True) -> str:
    if count == 0:
        return ""
    sign = "-" if count < 0 else "" if first else "+"
    size = "" if abs(count) == 1 else f"{abs(count)} "
    return f"{sign}{size}{symbol}" if first else f" {sign} {size}{symbol}"
