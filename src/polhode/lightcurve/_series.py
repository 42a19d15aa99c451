"""Bodies turned to the phases that a light curve's series prefers.

While Sun and observer keep their directions, a body's light is a function on the torus of its two
angles, and a shift of both is a shift of the phases of its Fourier coefficients. All places on the
polhode and all turns about the momentum are so compared with the points at the cost of a few.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode import rotation
from polhode._closed_forms import free_motion
from polhode.lightcurve._model import Bodies, Points, _to_body, moments_of
from polhode.lightcurve._scattering import seeliger_ellipsoid

# Sums i f_phi + j f_psi compared, of SAM and of LAM: nearly all of an ellipsoid's light.
_SUMS = np.array([
    [(1, 1), (2, 0), (2, 2), (1, -1), (0, 2), (1, 3), (3, 1), (4, 0), (2, -2), (3, 3), (4, 2)],
    [(1, 0), (2, 0), (2, 2), (1, 2), (0, 2), (1, -2), (3, 0), (4, 0), (4, 2), (3, 2), (4, 4)],
])  # fmt: skip
_TURN, _HALF = 12, 6  # nodes of a turn about the momentum, and of half a period of the nutation
GAIN = (0.6, 1.7)  # of the variations, in a trial's score
_NODES = np.stack(np.meshgrid(np.arange(_TURN), np.arange(_HALF), indexing="ij"), -1).reshape(-1, 2)
_ANGLES = 2 * np.pi * np.einsum("nc,mkc->mnk", _NODES / (_TURN, 2 * _HALF), _SUMS)


def series(points: Points, f_phi, f_psi, long_axis) -> tuple[np.ndarray, np.ndarray]:
    """Right sides (h, 2 k) and matrices (h, 2 k, 2 k) of the least squares of the sums' waves.

    Of frequencies (h,) and modes (h,), the points weighted by their errors. What offsets and the
    phase angle explain is projected out.
    """
    known = _known(points)
    t, alpha, data, weight = (
        np.asarray(x[0])[known] for x in (points.t, points.alpha, points.magnitude, points.weight)
    )
    root = np.sqrt(weight)
    columns = np.vstack([np.asarray(points.columns)[:, known], alpha, alpha**2]) * root
    _, size, basis = np.linalg.svd(columns, full_matrices=False)
    basis = basis[size > 1e-10 * size[0]]
    data = data * root
    data = data - (data @ basis.T) @ basis
    right, matrix = [], []
    for f, g, sums in zip(f_phi, f_psi, _SUMS[long_axis.astype(int)], strict=True):
        angle = 2 * np.pi * (sums @ [f, g])[:, None] * t
        waves = np.concatenate([np.cos(angle), np.sin(angle)]) * root
        waves = waves - (waves @ basis.T) @ basis
        right.append(waves @ data)
        matrix.append(waves @ waves.T)
    return np.array(right), np.array(matrix)


def directions(points: Points) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors (3,) to Sun and observer in the mean."""
    known = _known(points)
    means = (
        np.array([np.asarray(x[0])[known].mean() for x in v]) for v in (points.sun, points.observer)
    )
    sun, observer = (v / np.linalg.norm(v) for v in means)
    return sun, observer


def _known(points: Points) -> np.ndarray:
    return np.asarray(points.weight[0]) > 0  # others pad


@jax.jit
def turned(
    bodies: Bodies, f_phi, f_psi, long_axis, right, matrix, sun, observer
) -> tuple[Bodies, Float[Array, " b"]]:
    """The bodies (b,), of frequencies (b,), where their light comes nearest to the series.

    ``right`` (b, 2 k), ``matrix`` (b, 2 k, 2 k): of `series`; ``sun``, ``observer`` (3,): of
    `directions`. Only attitude and rates change; the momentum keeps its direction. And by how much
    each lowers chi-square.
    """
    u, wxyz = bodies
    moments, omega = moments_of(u), tuple(u[:, k] for k in (4, 5, 6))
    # half a period of the nutation: what is left is the same, turned by half a turn in SAM
    times = jnp.arange(_HALF)[None] / (2 * _HALF) / f_psi[:, None]
    rates, q = free_motion(moments, tuple(wxyz[:, k] for k in range(4)), omega, times)
    assert rates is not None  # neither was declined
    assert q is not None
    pole = rotation.rotate(
        wxyz, jnp.stack([a * b for a, b in zip(moments, omega, strict=True)], -1)
    )
    pole = pole / jnp.linalg.norm(pole, axis=-1, keepdims=True)
    turn = 2 * jnp.pi * (_NODES[None, :, 0] / _TURN - f_phi[:, None] * times[:, _NODES[:, 1]])
    # single precision is enough to choose by, in half the time
    c, s, axis = (x.astype(jnp.float32) for x in (jnp.cos(turn), jnp.sin(turn), pole))

    def back(vector):
        """A direction in space, turned about the pole by minus ``turn``: components (b, n)."""
        along = (axis @ vector)[:, None] * axis
        across, plain = jnp.cross(axis, vector[None]), vector[None] - along
        return tuple(
            along[:, k, None] + c * plain[:, k, None] - s * across[:, k, None] for k in range(3)
        )

    sun, observer, right, matrix, shape = (
        x.astype(jnp.float32) for x in (sun, observer, right, matrix, jnp.exp(u[:, 2:4]))
    )
    axes = (jnp.ones_like(shape[:, :1]), shape[:, :1], shape[:, 1:])
    facing = tuple(x.astype(jnp.float32)[:, _NODES[:, 1]] for x in q)
    light = seeliger_ellipsoid(axes, *(_to_body(facing, back(v)) for v in (sun, observer)))
    light = -2.5 * jnp.log10(jnp.maximum(light, 1e-12))

    mode = long_axis.astype(int)
    c, s = (jnp.asarray(wave(_ANGLES), jnp.float32)[mode] for wave in (np.cos, np.sin))
    even, odd = (2 * jnp.einsum("bn,bnk->bk", light, x)[:, None] / len(_NODES) for x in (c, s))
    # a shift forward by the angles of a node: the light of the later time at t = 0
    model = jnp.concatenate([even * c + odd * s, odd * c - even * s], -1)
    both = jnp.einsum("bnk,bk->bn", model, right)
    own = jnp.sum(jnp.einsum("bnk,bkl->bnl", model, matrix) * model, -1)
    gain = jnp.clip(both / jnp.maximum(own, 1e-12), *GAIN)
    fall = gain * (2 * both - gain * own)
    best = jnp.argmax(fall, axis=-1)
    fall = jnp.take_along_axis(fall, best[:, None], 1)[:, 0]
    node = jnp.asarray(_NODES)[best]

    def at(parts):
        return jnp.stack([jnp.take_along_axis(x, node[:, 1:], 1)[:, 0] for x in parts], -1)

    parts = node / np.array([[_TURN, 2 * _HALF]])  # of a turn, of a period
    half = jnp.pi * (parts[:, :1] - (f_phi / f_psi)[:, None] * parts[:, 1:])
    turn = jnp.concatenate([jnp.cos(half), jnp.sin(half) * pole], -1)
    return Bodies(u.at[:, 4:7].set(at(rates)), rotation.multiply(turn, at(q))), fall
