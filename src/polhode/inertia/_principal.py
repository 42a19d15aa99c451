"""Principal axes of a batch of symmetric 3x3 tensors, with derivatives that never blow up.

The eigen-decomposition itself carries no derivative. What carries it is the tensor written in the
(constant) principal axes, ``Q^T I Q``: its diagonal holds the moments, its off-diagonal entries,
the products of inertia, are zero in value but not in tangent. Whatever is computed from moments,
products and the constant axes therefore has the tensor's derivative, equal moments included.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode._kernels import are_close, over_gap, underivable
from polhode.rotation._quaternion import matrix_row

# Cyclic Jacobi converges quadratically once the off-diagonal part is small against the gaps, and
# linearly fast before that. Sweeps beyond the last needed one do nothing (t = 0 exactly or below
# rounding). 4 sweeps reach float32 and 6 float64 rounding on every tensor tried, clustered
# moments included; one more is cheap insurance.
_SWEEPS = {2: 4, 4: 5, 8: 7}

# Planes (p, q) of the rotations and the remaining axis r, in cyclic order: p -> q is right-handed
# about r.
_PLANES = ((0, 1, 2), (1, 2, 0), (2, 0, 1))


def _turn(q, axis, cosine, sine):
    """Quaternion components of ``q`` followed, in body axes, by a turn about one body axis."""
    w, v = q[0], q[1:]
    p, s = (axis + 1) % 3, (axis + 2) % 3
    turned = [None, None, None]
    turned[axis] = v[axis] * cosine + w * sine
    turned[p] = v[p] * cosine + v[s] * sine
    turned[s] = v[s] * cosine - v[p] * sine
    return (w * cosine - v[axis] * sine, *turned)


def _rotate_plane(diagonal, off, q, plane):
    """One Jacobi rotation that annuls entry (p, q); ``off[r]`` is the entry opposite to axis r."""
    p, s, r = plane
    difference = diagonal[p] - diagonal[s]
    twice = 2 * off[r]
    size = jnp.abs(difference) + jnp.hypot(difference, twice)
    safe = jnp.where(size > 0, size, 1)
    # tangent of the smaller of the two angles that annul the entry: |angle| <= pi/4
    tangent = jnp.where(difference >= 0, twice, -twice) / safe
    cosine = jax.lax.rsqrt(1 + tangent * tangent)
    sine = tangent * cosine
    half_cosine = jnp.sqrt((1 + cosine) / 2)
    half_sine = sine / (2 * half_cosine)
    new_diagonal = list(diagonal)
    new_diagonal[p] = diagonal[p] + tangent * off[r]
    new_diagonal[s] = diagonal[s] - tangent * off[r]
    new_off = list(off)
    new_off[r] = jnp.zeros_like(off[r])
    # entries (p, r) = off[s] and (s, r) = off[p]
    new_off[s] = cosine * off[s] + sine * off[p]
    new_off[p] = cosine * off[p] - sine * off[s]
    return tuple(new_diagonal), tuple(new_off), _turn(q, r, half_cosine, half_sine)


def _ordered(diagonal, q):
    """Moments ascending; an exchange of two axes is a quarter turn, so handedness is kept."""
    half = jnp.asarray(0.5, diagonal[0].dtype) ** 0.5
    for r in (2, 0, 2):
        p, s = (r + 1) % 3, (r + 2) % 3
        first, second = min(p, s), max(p, s)
        exchange = diagonal[first] > diagonal[second]
        turned = _turn(q, r, half, half)
        q = tuple(jnp.where(exchange, new, old) for new, old in zip(turned, q, strict=True))
        values = list(diagonal)
        values[first] = jnp.minimum(diagonal[first], diagonal[second])
        values[second] = jnp.maximum(diagonal[first], diagonal[second])
        diagonal = tuple(values)
    return diagonal, q


def _jacobi(diagonal, off):
    """Quaternion components (principal -> body axes) of a symmetric tensor, moments ascending."""
    one = jnp.ones_like(diagonal[0])
    q = (one, *(jnp.zeros_like(one) for _ in range(3)))

    def sweep(_, carry):
        diagonal, off, q = carry
        for plane in _PLANES:
            diagonal, off, q = _rotate_plane(diagonal, off, q, plane)
        return diagonal, off, q

    count = _SWEEPS[jnp.dtype(one.dtype).itemsize]
    diagonal, off, q = jax.lax.fori_loop(0, count, sweep, (diagonal, off, q))
    _, q = _ordered(diagonal, q)
    norm = jnp.sqrt(sum(c * c for c in q))
    sign = jnp.where(q[0] < 0, -1, 1).astype(norm.dtype)
    return tuple(sign * c / norm for c in q)


def _columns(q):
    """Columns of the rotation matrix of a unit quaternion: the principal axes in body axes."""
    return tuple(zip(*(matrix_row(q, i) for i in range(3))))


@jax.jit  # a hundred operations: outside of a program each would be one of its own
def principal(
    tensor: Float[Array, "*b 3 3"],
) -> tuple[Float[Array, "*b 3"], Float[Array, "*b 4"], Float[Array, "*b 3"]]:
    """Principal moments, axes and products of inertia of symmetric tensors.

    Returns ``moments`` (..., 3), ascending; ``wxyz`` (..., 4), the right-handed rotation from
    principal to body axes, ``I = R diag(moments) R^T``; and ``products`` (..., 3), the entries (y,
    z), (z, x), (x, y) of ``R^T I R``, which are zero in value.

    Derivatives: ``wxyz`` carries none. ``moments`` and ``products`` carry those of ``R^T I R`` at
    fixed R, which exist for equal moments too; for separate moments those of ``moments`` are the
    usual ones. What depends on the tensor alone has its right derivative when it is computed from
    moments, products and wxyz together. This holds to first order: the second derivative of an
    eigenvalue depends on the rotation of the axes, which is omitted (see ``principal_moments``).
    """
    entries = [[(tensor[..., i, j] + tensor[..., j, i]) / 2 for j in range(3)] for i in range(3)]
    fixed = jax.lax.stop_gradient(tensor)
    scale = jnp.max(jnp.abs(fixed), axis=(-2, -1))
    scale = jnp.where(scale > 0, scale, 1)
    unit = [[jax.lax.stop_gradient(entry) / scale for entry in row] for row in entries]
    q = _jacobi((unit[0][0], unit[1][1], unit[2][2]), (unit[1][2], unit[2][0], unit[0][1]))
    columns = _columns(q)
    image = [[sum(row[k] * c[k] for k in range(3)) for row in entries] for c in columns]

    def entry(i, j):
        return sum(columns[i][k] * image[j][k] for k in range(3))

    # Rayleigh quotients: the rounding of the quaternion's norm drops out
    moments = jnp.stack([entry(i, i) / sum(x * x for x in columns[i]) for i in range(3)], axis=-1)
    products = jnp.stack([entry(1, 2), entry(2, 0), entry(0, 1)], axis=-1)
    return moments, jnp.stack(q, axis=-1), products - jax.lax.stop_gradient(products)


@jax.jit
def principal_moments(tensor: Float[Array, "*b 3 3"]) -> Float[Array, "*b 3"]:
    """The moments of ``principal``, with their second derivatives too.

    Those are NaN where two moments agree to half of their digits and the principal axes turn:
    there eigenvalues have no second derivatives.
    """
    moments, _, products = principal(tensor)
    return _curved(moments, products)


@jax.custom_jvp
def _curved(moments: Array, products: Array) -> Array:
    """Moments, with the second derivatives by the products (..., 3), which are zero in value."""
    return moments


@_curved.defjvp
def _curved_rule(primals, tangents):
    moments, products = primals
    change, turned = tangents
    a, b, c = (moments[..., i] for i in range(3))
    close = are_close(a, b) | are_close(b, c) | are_close(c, a)
    yz, zx, xy = (underivable(products[..., i], close) for i in range(3))
    by_yz, by_zx, by_xy = (
        2 * turned[..., i] * x
        for i, x in enumerate((over_gap(yz, b, c), over_gap(zx, c, a), over_gap(xy, a, b)))
    )
    curved = jnp.stack([by_xy - by_zx, by_yz - by_xy, by_zx - by_yz], axis=-1)
    return _curved(moments, products), change + curved
