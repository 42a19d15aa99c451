"""Two-dimensional Fourier series: which pairs of frequencies a light curve allows.

A free body's brightness, in constant directions, is a series in ``cos`` and ``sin`` of
``2 pi (i f_phi + j f_psi) t``. Every such frequency is a node of one uniform grid when both are, so
that the transforms of data and window are tabulated once and the normal equations of a pair are
looked up, not summed.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_CHUNK = 4096
_MOST = 600  # nodes of the grid that are sought unless more are asked for


class Pairs(NamedTuple):
    """Candidate pairs of frequencies, the best first."""

    f_phi: np.ndarray  # (k,) per unit of time
    f_psi: np.ndarray  # (k,)
    explained: np.ndarray  # (k,) part of the variance that the series explains
    resolution: float  # 1 / span


def terms(order: int, even: bool = True) -> np.ndarray:
    """Multiples (i, j) of f_phi and f_psi, one of each pair of opposites.

    ``even``: only even j. A body that half a turn about its long axis does not change, such as an
    ellipsoid, has no others.
    """
    j = np.arange(-order, order + 1) * (2 if even else 1)
    grid = np.array([(a, b) for a in range(order + 1) for b in j])
    return grid[(grid[:, 0] > 0) | (grid[:, 1] > 0)]


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
def _scan(tables, data, pairs, multiples):
    return jax.vmap(lambda pair: _equations(tables, data, multiples @ pair))(pairs)


class _Scan(NamedTuple):
    """Tables from which the normal equations of any pair of nodes are looked up."""

    tables: tuple  # transforms of the window and of the columns projected out
    data: Float[Array, " m"]
    step: float
    count: int  # nodes up to the highest frequency
    size: int  # points
    resolution: float

    @classmethod
    def of(cls, t, values, columns, highest, oversampling: int, multiples) -> "_Scan":
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
        if highest is None:
            highest = min(_highest(t, values, step), _MOST * step)
        count = int(np.ceil(highest / step)) + 1
        most = 2 * (int(np.abs(multiples).sum(1).max()) * count + 1)
        window, data, *rest = _transforms(
            jnp.asarray(t), jnp.asarray(np.vstack([np.ones_like(t), values, basis])), step, most
        )
        return cls((window, jnp.stack(rest)), data, step, count, t.size, step * oversampling)

    def explained(self, pairs: np.ndarray, multiples: np.ndarray) -> np.ndarray:
        """Part of the variance (k,) that the series of pairs of nodes (k, 2) explain."""
        chunk = min(_CHUNK, 256 * -(-len(pairs) // 256))
        whole = np.concatenate([pairs, np.repeat(pairs[-1:], -len(pairs) % chunk, 0)])
        power = np.empty(len(whole))
        for start in range(0, len(whole), chunk):
            part = slice(start, start + chunk)
            gram, right = _scan(
                self.tables, self.data, jnp.asarray(whole[part]), jnp.asarray(multiples)
            )
            # columns that coincide, or vanish, leave a singular matrix
            gram = np.asarray(gram) + 1e-3 * self.size * np.eye(right.shape[-1])
            right = np.asarray(right)
            power[part] = np.sum(right * np.linalg.solve(gram, right[..., None])[..., 0], axis=-1)
        return np.nan_to_num(power[: len(pairs)])


def fourier_pairs(
    t: Float[Array | np.ndarray, " n"],
    values: Float[Array | np.ndarray, " n"],
    *,
    columns: Float[Array | np.ndarray, "c n"] | None = None,
    highest: float | None = None,
    order: int = 2,
    even: bool = True,
    oversampling: int = 4,
    keep: int = 40,
) -> Pairs:
    """Pairs (f_phi, f_psi) whose Fourier series explain ``values`` best, over a whole grid.

    ``columns``: what is fitted besides, such as a constant for each night (default: one
    constant). ``highest`` frequency of either, per unit of ``t``; default: 1.3 times that of the
    highest peak of the power spectrum with a tenth of the greatest power, but at most 600 steps of
    the grid, ``600 / oversampling`` turns within the light curve. Local maxima of the grid, the
    best ``keep``. Without ``even`` the two may be swapped, and ``f_phi`` is the higher one.
    """
    multiples = terms(order, even)
    scan = _Scan.of(t, values, columns, highest, oversampling, multiples)
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
    return Pairs(found[:, 0], found[:, 1], power[tuple(best.T)], scan.resolution)


def fourier_lattices(
    t: Float[Array | np.ndarray, " n"],
    values: Float[Array | np.ndarray, " n"],
    *,
    columns: Float[Array | np.ndarray, "c n"] | None = None,
    highest: float | None = None,
    order: int = 2,
    lines: int = 16,
    oversampling: int = 5,
    keep: int = 60,
) -> Pairs:
    """Pairs (g, h) whose sums of multiples up to ``order`` explain ``values`` best.

    As `fourier_pairs` without ``even``, but g is only one of the ``lines`` highest peaks of the
    spectrum of one frequency, of which aliases are some, and h is sought over the whole grid: the
    strongest line of a body is always one of its sums, so that a long light curve, with thousands
    of nodes, is searched by lines of the grid instead of all of it: with order 1, and the best of
    every line again with ``order``. Which sums of multiples of the body's own frequencies g and h
    are is left open.
    """
    multiples = terms(order, even=False)
    scan = _Scan.of(t, values, columns, highest, oversampling, multiples)
    nodes = np.arange(max(oversampling // 2, 1), scan.count)
    alone = np.stack([nodes, np.zeros_like(nodes)], -1)
    peaks = _maxima(scan.explained(alone, np.array([[1, 0]])))[:lines]
    found = []
    for node in nodes[peaks]:
        line = np.stack([np.full_like(nodes, node), nodes], -1)
        found.append(line[_maxima(scan.explained(line, terms(1, even=False)))[:keep]])
    found = np.concatenate(found)
    power = scan.explained(found, multiples)
    first = np.argsort(-power)
    kept: list[tuple[float, int, int]] = []
    for part, (one, other) in zip(power[first], found[first]):
        g, h = int(max(one, other)), int(min(one, other))
        same = [max(abs(g - a), abs(h - b)) <= oversampling // 2 for _, a, b in kept]
        if not any(same) and g - h > oversampling // 2:
            kept.append((float(part), g, h))
        if len(kept) == keep:
            break
    power, high, low = np.array(kept).T
    return Pairs(high * scan.step, low * scan.step, power, scan.resolution)


def _maxima(values: np.ndarray) -> np.ndarray:
    """Numbers of the local maxima, the highest first."""
    around = np.pad(values, 1, constant_values=-np.inf)
    high = np.flatnonzero((values >= around[:-2]) & (values >= around[2:]))
    return high[np.argsort(-values[high])]


def _orthonormal(columns: np.ndarray) -> np.ndarray:
    """An orthonormal basis of the rows."""
    _, size, basis = np.linalg.svd(columns, full_matrices=False)
    return basis[size > 1e-10 * size[0]]


def _highest(t, values, step) -> float:
    """1.3 times the highest frequency of the spectrum with a tenth of the greatest power."""
    gap = np.median(np.diff(np.sort(np.asarray(t, float))))
    count = int(min(0.5 / gap / step, 20000))
    (table,) = _transforms(jnp.asarray(t), jnp.asarray(values)[None], step, count)
    power = np.abs(np.asarray(table)) ** 2
    return 1.3 * step * np.flatnonzero(power > 0.1 * power.max())[-1]


def meaning(f_phi: float, f_psi: float, order: int = 2) -> str:
    """What a pair would mean, in words: modes that it allows, and its strongest sums."""
    sums = sorted(
        (abs(i) + abs(j), abs(i * f_phi + j * f_psi), i, j) for i, j in terms(order, even=True)
    )
    listed = ", ".join(
        f"{_name(i, 'f_phi')}{_name(j, 'f_psi', first=i == 0)} = {f:.5g}" for _, f, i, j in sums[:4]
    )
    # A body slower about L than about its long axis can only turn fully about the latter:
    # (I_s/I_i - 1)(I_s/I_l - 1) <= 1 for moments that mass can have.
    modes = "LAM or SAM" if f_psi < f_phi else "LAM only"
    return f"{modes}; {listed}"


def _name(count: int, symbol: str, first: bool = True) -> str:
    if count == 0:
        return ""
    sign = "-" if count < 0 else "" if first else "+"
    size = "" if abs(count) == 1 else f"{abs(count)} "
    return f"{sign}{size}{symbol}" if first else f" {sign} {size}{symbol}"
