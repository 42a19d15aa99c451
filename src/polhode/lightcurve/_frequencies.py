"""Two-dimensional Fourier series: which pairs of frequencies a light curve allows.

A free body's brightness, in constant directions, is a series in ``cos`` and ``sin`` of
``2 pi (i f_phi + j f_psi) t``. Every such frequency is a node of one uniform grid when both are, so
that the transforms of data and window are tabulated once and the normal equations of a pair are
looked up, not summed.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_CHUNK = 4096
# Nodes of the grid of frequencies, for pairs over the whole square of it and for lines.
_MAX_PAIR_NODES, _MAX_LINE_NODES = 600, 15_000
_FASTEST = 24.0  # per day: the second harmonic of a rotation in two hours
_EDGE = 0.95  # of the highest frequency: lines above are at the edge of the grid
# Sums of a line g and another h, in halves: g and what it may be a harmonic of, or have as one, so
# that h is not chosen for what g alone explains; h, and its sidebands.
LINES = np.array([(1, 0), (2, 0), (3, 0), (4, 0), (0, 2), (2, 2), (2, -2)]) / 2


class Pairs(NamedTuple):
    """Candidate pairs of frequencies, the best first."""

    f_phi: np.ndarray  # (k,) per unit of time
    f_psi: np.ndarray  # (k,)
    explained: np.ndarray  # (k,) part of the variance that the series explains
    resolution: float  # 1 / span
    max_frequency: float = np.inf  # end of the grid
    # strongest line of the whole spectrum, that of the sampling, which may exceed the grid
    strongest: float = np.nan
    is_cut: bool = False  # the spectrum has strong lines beyond the grid, which was cut

    def warnings(self) -> tuple[str, ...]:
        """Sentences on what the range of the search may have missed."""
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
    """Multiples (i, j) of f_phi and f_psi, one of each pair of opposites.

    ``even``: only even j. A body in long-axis mode that half a turn about its long axis does not
    change, such as an ellipsoid, has no others.
    """
    j = np.arange(-order, order + 1) * (2 if even else 1)
    grid = np.array([(a, b) for a in range(order + 1) for b in j])
    return grid[(grid[:, 0] > 0) | (grid[:, 1] > 0)]


@partial(jax.jit, static_argnums=3)  # one program, not one for each operation
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

    less, more = at(window, a - b), at(window, a + b)
    # cos cos, cos sin, sin cos, sin sin, with exp(-i x) transforms: Re = cos, -Im = sin
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
    is_cut: bool

    @classmethod
    def of(
        cls, t, values, columns, highest, oversampling: int, most: int, max_nodes: int | None = None
    ) -> "Scan":
        """``most``: the highest sum looked at is that many times the highest frequency.

        ``highest``: the end of the grid; None: that of the strong lines, at ``max_nodes`` at most.
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
        window, data, *rest = _transforms(
            jnp.asarray(t), jnp.asarray(np.vstack([np.ones_like(t), values, basis])), step,
            2 * (most * count + 1),
        )  # fmt: skip
        return cls(
            (window, jnp.stack(rest)),
            data,
            step,
            count,
            t.size,
            step * oversampling,
            strongest,
            is_cut,
        )

    def pairs(self, f_phi, f_psi, explained) -> Pairs:
        """Candidates of this grid."""
        end = (self.count - 1) * self.step
        return Pairs(f_phi, f_psi, explained, self.resolution, end, self.strongest, self.is_cut)

    def fitted(self, nodes: np.ndarray, soft=1e-3) -> tuple[np.ndarray, np.ndarray]:
        """Part of the variance (k,) explained by waves at nodes (k, m), and ln det of the matrix.

        ``soft`` (..., m): added to the diagonal of the normal equations, over the number of points.
        """
        chunk = min(_CHUNK, 256 * -(-len(nodes) // 256))
        whole = np.concatenate([nodes, np.repeat(nodes[-1:], -len(nodes) % chunk, 0)])
        power, size = np.empty((2, len(whole)))
        # columns that coincide, or vanish, would leave a singular matrix
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
        return self.fitted(np.rint(pairs @ multiples.T).astype(int))[0]


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
    """Pairs (f_phi, f_psi) whose Fourier series explain ``values`` best, over a whole grid.

    ``columns``: what is fitted besides, such as a constant for each night (default: one
    constant). ``max_frequency`` of either, per unit of ``t``; default: 1.3 times that of the
    highest peak of the power spectrum with a tenth of the greatest power, and 2.2 times that of the
    greatest, but at most 600 steps of the grid, ``600 / oversampling`` turns within the light
    curve: ``Pairs.is_cut`` and ``Pairs.warnings`` say where that is not enough, and
    `fourier_lattices` reaches further. Local maxima of the grid, the best ``keep``. Without
    ``even`` the two may be swapped, and ``f_phi`` is the higher one.
    """
    multiples = terms(order, even)
    most = int(np.abs(multiples).sum(1).max())
    scan = Scan.of(t, values, columns, max_frequency, oversampling, most, _MAX_PAIR_NODES)
    # a tenth of a cycle at least; neither frequency may be that of the other
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
        for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)
    ]  # fmt: skip
    high = np.argwhere((power >= np.max(around, axis=0)) & (power > 0))
    best = high[np.argsort(-power[tuple(high.T)])][:keep]
    found = nodes[best] * scan.step
    return scan.pairs(found[:, 0], found[:, 1], power[tuple(best.T)])


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
    peaks of the spectrum of one frequency, of which aliases are some, and h is sought over the
    whole grid, beside the multiples of g and half of it. What explains a body's light are a few
    sums of multiples of its frequencies; which of them g and h are is left open. ``max_frequency``
    of either, per unit of ``t``; default: as for `fourier_pairs`, but at most 15,000 steps of the
    grid, ``15_000 / oversampling`` cycles within the light curve.
    """
    scan = Scan.of(t, values, columns, max_frequency, oversampling, 2, _MAX_LINE_NODES)
    nodes = np.arange(max(oversampling // 2, 1), scan.count)
    peaks = _maxima(scan.fitted(nodes[:, None])[0])[:lines]
    found, power = [], []
    for node in nodes[peaks]:
        line = np.stack([np.full_like(nodes, node), nodes], -1)
        part = scan.explained(line, LINES)
        best = _maxima(part)[:keep]
        found.append(line[best])
        power.append(part[best])
    found, power = np.concatenate(found), np.concatenate(power)
    kept: list[int] = []
    for k in np.argsort(-power):
        near = np.abs(found[kept] - found[k]).max(1) if kept else np.array([np.inf])
        if near.min() > oversampling // 4:
            kept.append(int(k))
        if len(kept) == keep:
            break
    g, h = scan.step * found[kept].T
    return scan.pairs(g, h, power[kept])


def _maxima(values: np.ndarray) -> np.ndarray:
    """Numbers of the local maxima, the highest first."""
    around = np.pad(values, 1, constant_values=-np.inf)
    high = np.flatnonzero((values >= around[:-2]) & (values >= around[2:]))
    return high[np.argsort(-values[high])]


def _orthonormal(columns: np.ndarray) -> np.ndarray:
    """An orthonormal basis of the rows."""
    _, size, basis = np.linalg.svd(columns, full_matrices=False)
    return basis[size > 1e-10 * size[0]]


def _strong_lines(t, values, step) -> tuple[float, float]:
    """Frequency of the strongest line of the spectrum, and the end of a grid for all strong ones.

    The end: 1.3 times the highest frequency with a tenth of the greatest power, or 2.2 times that
    of the greatest, whose second harmonic may be the next line. The spectrum reaches to what the
    sampling resolves; where points are sparse but uneven, to a rotation in two hours.
    """
    gaps = np.diff(np.sort(np.asarray(t, float)))
    gaps = gaps[gaps > 0]
    limit = max(0.5 / np.median(gaps), min(0.5 / np.quantile(gaps, 0.05), _FASTEST))
    count = max(int(min(limit / step, 4 * _MAX_LINE_NODES)), 8)
    (table,) = _transforms(jnp.asarray(t), jnp.asarray(values)[None], step, count)
    power = np.abs(np.asarray(table)) ** 2
    strong = step * np.flatnonzero(power > 0.1 * power.max())[-1]
    strongest = step * int(np.argmax(power))
    return strongest, min(max(1.3 * strong, 2.2 * strongest), max(count * step, 8 * step))
