"""Principal axes, second moments, the triangle inequality, and checks of tensors and points.

A tensor is the inertia of some body exactly when its second moments ``Sigma = integral x x^T dm =
tr(I)/2 - I`` are positive semidefinite (which is the triangle inequality of its moments). Writing
``Sigma`` by a triangular factor with exponentials on its diagonal makes every real vector a
physical body. With mass and centre of mass the same holds for the 4x4 pseudo-inertia
``J = [[Sigma, m c], [m c^T, m]]`` (Rucker and Wensing, IEEE Robotics and Automation Letters 7(2),
2022, eqs. 8-13).

The eigen-decomposition carries no derivative. The tensor in the (constant) principal axes,
``Q^T I Q``, carries it: its diagonal entries are the moments, and its off-diagonal entries are zero
in value but not in tangent. Functions of both therefore have the derivative with respect to the
tensor, also for equal moments.

Shapes are always checked, values only where they are concrete.
"""

from collections.abc import Iterable
from functools import reduce
from operator import add
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from polhode._checks import (
    ArrayLike,
    as_float_array,
    as_vectors,
    is_concrete,
    numbers,
    on_host,
    require,
    require_positive,
)
from polhode._kernels import are_close, kernel, over_gap, underivable
from polhode.rotation._quaternion import matrix_row

# Sweeps of cyclic Jacobi rotations by item size of the dtype. They converge quadratically once the
# off-diagonal part is small compared with the differences of the moments, and linearly before.
# Further sweeps do not change the result (t = 0 exactly or below rounding). In tests, clustered
# moments included, 4 sweeps reached the rounding error of float32 and 6 that of float64; one more
# is a margin.
_SWEEPS = {2: 4, 4: 5, 8: 7}


def _turn(q, axis, cosine, sine):
    """Quaternion components of ``q`` followed, in body axes, by a rotation about one body axis."""
    w, v = q[0], q[1:]
    p, s = (axis + 1) % 3, (axis + 2) % 3
    vector_part = [None, None, None]
    vector_part[axis] = v[axis] * cosine + w * sine
    vector_part[p] = v[p] * cosine + v[s] * sine
    vector_part[s] = v[s] * cosine - v[p] * sine
    return (w * cosine - v[axis] * sine, *vector_part)


def _rotate_plane(diagonal, off, q):
    """One Jacobi rotation that annuls entry (0, 1); ``off[r]`` is the entry opposite to axis r."""
    p, s, r = 0, 1, 2
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
    """Moments in ascending order. Quarter turns exchange axes, which preserves handedness."""
    half = jnp.asarray(0.5, diagonal[0].dtype) ** 0.5
    for r in (2, 0, 2):
        p, s = (r + 1) % 3, (r + 2) % 3
        first, second = min(p, s), max(p, s)
        exchange = diagonal[first] > diagonal[second]
        rotated = _turn(q, r, half, half)
        q = tuple(jnp.where(exchange, new, old) for new, old in zip(rotated, q, strict=True))
        values = list(diagonal)
        values[first] = jnp.minimum(diagonal[first], diagonal[second])
        values[second] = jnp.maximum(diagonal[first], diagonal[second])
        diagonal = tuple(values)
    return diagonal, q


def _jacobi(diagonal, off):
    """Quaternion components (principal -> body axes) of a symmetric tensor, moments ascending."""
    one = jnp.ones_like(diagonal[0])
    q = (one, *(jnp.zeros_like(one) for _ in range(3)))

    def rotate(_, carry):
        # cyclic renaming of the axes: the program contains one rotation for all three planes
        diagonal, off, (w, *v) = _rotate_plane(*carry)
        diagonal, off, v = ((b, c, a) for a, b, c in (diagonal, off, v))
        return diagonal, off, (w, *v)

    count = 3 * _SWEEPS[jnp.dtype(one.dtype).itemsize]
    diagonal, off, q = jax.lax.fori_loop(0, count, rotate, (diagonal, off, q))
    _, q = _ordered(diagonal, q)
    # The sign is arbitrary. It must not be chosen by the scalar part, which may be zero up to
    # rounding: XLA may recompute that for each component with other rounding, and the components
    # would then have inconsistent signs.
    norm = jnp.sqrt(sum(c * c for c in q))
    return tuple(c / norm for c in q)


def _columns(q):
    """Columns of the rotation matrix of a unit quaternion: the principal axes in body axes."""
    return tuple(zip(*(matrix_row(q, i) for i in range(3))))


_DIAGONAL, _OFF_DIAGONAL = ((0, 0), (1, 1), (2, 2)), ((1, 2), (2, 0), (0, 1))


def _total(terms: Iterable[Array]) -> Array:
    """The sum in this order; ``jnp.sum`` would round differently."""
    return reduce(add, terms)


def principal(
    tensor: Float[ArrayLike, "*b 3 3"],
) -> tuple[Float[Array, "*b 3"], Float[Array, "*b 4"], Float[Array, "*b 3"]]:
    """Principal moments, axes and products of inertia of symmetric tensors.

    Returns ``moments`` (..., 3), ascending; ``wxyz`` (..., 4), the right-handed rotation from
    principal to body axes, ``I = R diag(moments) R^T``; and ``products`` (..., 3), the entries (y,
    z), (z, x), (x, y) of ``R^T I R``, which are zero in value.

    Derivatives: ``wxyz`` carries none. ``moments`` and ``products`` carry those of ``R^T I R`` at
    fixed R, which exist for equal moments too; for distinct moments those of ``moments`` are the
    usual derivatives of eigenvalues. A function of the tensor that is computed from moments,
    products and wxyz together has the correct derivative. This holds to first order: the second
    derivative of an eigenvalue depends on the rotation of the axes, which is omitted (see
    ``principal_moments``).
    """
    return _principal(_as_tensors(tensor))


def _as_tensors(value: Any, name: str = "tensor") -> Array:
    """Tensors (..., 3, 3) of floats, also from lists. NaN is accepted; JAX arrays are unchanged."""
    fits = isinstance(value, jax.Array) and value.shape[-2:] == (3, 3)
    if fits and jnp.issubdtype(value.dtype, jnp.floating):
        return value
    return as_float_array(name, value, (3, 3), finite=False)


@jax.jit  # outside jit too, one program for its hundred operations
@kernel  # compiles in half the time
def _principal(tensor: Array) -> tuple[Array, Array, Array]:
    # Rows and columns are the leading axes of arrays that are multiplied elementwise: written for
    # each entry separately, the program would compile for twice as long.
    tensor = jnp.moveaxis(tensor, (-2, -1), (0, 1))
    tensor = (tensor + jnp.swapaxes(tensor, 0, 1)) / 2
    fixed = jax.lax.stop_gradient(tensor)
    scale = jnp.max(jnp.abs(fixed), axis=(0, 1), keepdims=True)
    unit = fixed / jnp.where(scale > 0, scale, 1)
    diagonal, off = (tuple(unit[i, j] for i, j in pairs) for pairs in (_DIAGONAL, _OFF_DIAGONAL))
    q = _jacobi(diagonal, off)
    columns = jnp.stack([jnp.stack(column) for column in _columns(q)])
    image = _total(tensor[None, :, k] * columns[:, None, k] for k in range(3))
    turned = _total(columns[:, None, k] * image[None, :, k] for k in range(3))
    moments, products = (
        jnp.stack([turned[i, j] for i, j in pairs]) for pairs in (_DIAGONAL, _OFF_DIAGONAL)
    )
    # Rayleigh quotients: independent of the rounding error of the quaternion's norm
    moments = moments / _total(columns[:, k] * columns[:, k] for k in range(3))
    products = products - jax.lax.stop_gradient(products)
    return jnp.moveaxis(moments, 0, -1), jnp.stack(q, axis=-1), jnp.moveaxis(products, 0, -1)


@jax.jit
def principal_moments(tensor: Float[Array, "*b 3 3"]) -> Float[Array, "*b 3"]:
    """The moments of ``principal``, with correct second derivatives.

    These are NaN where two moments agree to half of their digits and the change of the tensor
    rotates the principal axes: eigenvalues have no second derivatives there.
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
    change, product_tangents = tangents
    a, b, c = jnp.unstack(moments, axis=-1)
    is_close = are_close(a, b) | are_close(b, c) | are_close(c, a)
    yz, zx, xy = (underivable(products[..., i], is_close) for i in range(3))
    by_yz, by_zx, by_xy = (
        2 * product_tangents[..., i] * x
        for i, x in enumerate((over_gap(yz, b, c), over_gap(zx, c, a), over_gap(xy, a, b)))
    )
    curved = jnp.stack([by_xy - by_zx, by_yz - by_xy, by_zx - by_yz], axis=-1)
    return _curved(moments, products), change + curved


def symmetric(diagonal, off):
    """Symmetric matrix (..., 3, 3) with a diagonal and the entries (y, z), (z, x), (x, y)."""
    (a, b, c), (p, q, r) = diagonal, off
    rows = [[a, r, q], [r, b, p], [q, p, c]]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def second_moments(tensor: Float[ArrayLike, "*b 3 3"]) -> Float[Array, "*b 3 3"]:
    """Second moments ``Sigma = tr(I)/2 - I`` (..., 3, 3), kg m^2, of inertia tensors."""
    tensor = _as_tensors(tensor)
    a, b, c = (tensor[..., i, i] for i in range(3))
    off = (-tensor[..., 1, 2], -tensor[..., 0, 2], -tensor[..., 0, 1])
    return symmetric(((b + c - a) / 2, (c + a - b) / 2, (a + b - c) / 2), off)


def inertia_of_second_moments(sigma: Float[ArrayLike, "*b 3 3"]) -> Float[Array, "*b 3 3"]:
    """Inertia tensors ``I = tr(Sigma) - Sigma`` (..., 3, 3), kg m^2, of second moments."""
    sigma = _as_tensors(sigma, "sigma")
    a, b, c = (sigma[..., i, i] for i in range(3))
    off = (-sigma[..., 1, 2], -sigma[..., 0, 2], -sigma[..., 0, 1])
    return symmetric((b + c, c + a, a + b), off)


def _upper_product(d1, d2, d3, s12, s13, s23):
    """``S S^T`` of the upper triangle ``S = [[d1, s12, s13], [0, d2, s23], [0, 0, d3]]``."""
    return symmetric(
        (d1 * d1 + s12 * s12 + s13 * s13, d2 * d2 + s23 * s23, d3 * d3),
        (s23 * d3, s13 * d3, s12 * d2 + s13 * s23),
    )


def _upper_factor(sigma):
    """The upper triangle S of ``sigma = S S^T``, with a diagonal that is positive, or zero for a
    flat body."""
    trace = sigma[..., 0, 0] + sigma[..., 1, 1] + sigma[..., 2, 2]
    limit = -tolerance(sigma) * trace  # rounding errors that the constructors accept as well

    def root(square):
        is_positive = square > 0
        zero = jnp.where(square >= limit, 0.0, jnp.nan).astype(square.dtype)  # NaN: unphysical
        return jnp.where(is_positive, jnp.sqrt(jnp.where(is_positive, square, 1)), zero)

    d3 = root(sigma[..., 2, 2])
    s23, s13 = _quotient(sigma[..., 1, 2], d3), _quotient(sigma[..., 0, 2], d3)
    d2 = root(sigma[..., 1, 1] - s23 * s23)
    s12 = _quotient(sigma[..., 0, 1] - s13 * s23, d2)
    d1 = root(sigma[..., 0, 0] - s13 * s13 - s12 * s12)
    return d1, d2, d3, s12, s13, s23


def _quotient(entry, diagonal):
    """An entry of a column over its diagonal entry; 0 if that is 0, as the column is zero then."""
    is_zero = diagonal == 0
    return jnp.where(is_zero, 0, entry / jnp.where(is_zero, 1, diagonal))


def inertia_from_log_cholesky(parameters: Float[ArrayLike, "*b 6"]) -> Float[Array, "*b 3 3"]:
    """Inertia tensor (..., 3, 3) of ``(d1, d2, d3, n12, n13, n23)``, any real numbers.

    ``Sigma = S S^T`` with ``S = N diag(exp d)`` and N unit upper triangular: adding a constant
    to the three d scales the body and changes nothing else. exp(d) in sqrt(kg) m, n dimensionless.
    """
    *logarithms, n12, n13, n23 = jnp.unstack(as_vectors("parameters", parameters, 6), axis=-1)
    d1, d2, d3 = map(jnp.exp, logarithms)
    sigma = _upper_product(d1, d2, d3, n12 * d2, n13 * d3, n23 * d3)
    return inertia_of_second_moments(sigma)


def inertia_to_log_cholesky(tensor: Float[ArrayLike, "*b 3 3"]) -> Float[Array, "*b 6"]:
    """Inverse of ``inertia_from_log_cholesky``.

    For a flat body, which is on the boundary, a logarithm is ``-inf``, and the entries of its
    column are 0; NaN for an unphysical tensor.
    """
    d1, d2, d3, s12, s13, s23 = _upper_factor(second_moments(tensor))
    logs = [jnp.log(d1), jnp.log(d2), jnp.log(d3)]
    off_diagonal = [_quotient(x, d) for x, d in ((s12, d2), (s13, d3), (s23, d3))]
    return jnp.stack([*logs, *off_diagonal], axis=-1)


def pseudo_from_log_cholesky(
    parameters: Float[Array, "*b 10"],
) -> tuple[Float[Array, "*b"], Float[Array, "*b 3"], Float[Array, "*b 3 3"]]:
    """Mass, centre of mass and inertia about it from the ten parameters of Rucker and Wensing.

    ``(alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3)``; ``J = U U^T`` with
    ``U = exp(alpha) [[exp d1, s12, s13, t1], [0, exp d2, s23, t2], [0, 0, exp d3, t3],
    [0, 0, 0, 1]]`` (their eqs. 11 and 12). Lengths in m, mass ``exp(2 alpha)`` in kg.
    """
    alpha, s12, s23, s13 = (parameters[..., i] for i in (0, 4, 5, 6))
    d1, d2, d3 = (jnp.exp(parameters[..., i]) for i in (1, 2, 3))
    mass = jnp.exp(2 * alpha)
    sigma = mass[..., None, None] * _upper_product(d1, d2, d3, s12, s13, s23)
    return mass, parameters[..., 7:], inertia_of_second_moments(sigma)


def pseudo_to_log_cholesky(
    mass: Float[Array, "*b"], centre: Float[Array, "*b 3"], tensor: Float[Array, "*b 3 3"]
) -> Float[Array, "*b 10"]:
    """Inverse of ``pseudo_from_log_cholesky``; ``tensor`` is about the centre of mass."""
    sigma = second_moments(tensor) / mass[..., None, None]
    d1, d2, d3, s12, s13, s23 = _upper_factor(sigma)
    head = [jnp.log(mass) / 2, jnp.log(d1), jnp.log(d2), jnp.log(d3), s12, s23, s13]
    return jnp.concatenate([jnp.stack(head, axis=-1), centre], axis=-1)


def physical_margin(tensor: Float[ArrayLike, "*b 3 3"]) -> Float[Array, "*b"]:
    """Signed distance (...), kg m^2, of a tensor from the boundary of the physical ones.

    A tensor belongs to a body exactly when its second moments ``Sigma = tr(I)/2 - I`` have no
    negative eigenvalue: positive moments and the triangle inequality in one. The distance is that
    of Sigma to the nearest singular one in the Frobenius norm: positive inside (the smallest
    eigenvalue), zero for a flat body, negative outside (the norm of the negative part).
    """
    eigenvalues = principal(second_moments(tensor))[0]
    negative = jnp.minimum(eigenvalues, 0)
    outside = eigenvalues[..., 0] < 0
    square = jnp.sum(negative * negative, axis=-1)
    # both branches of ``where`` must have finite derivatives
    distance = jnp.sqrt(jnp.where(outside, square, 1))
    return jnp.where(outside, -distance, eigenvalues[..., 0])


def is_physical(tensor: Float[ArrayLike, "*b 3 3"], slack: float = 0.0) -> Array:
    """Whether (...) a tensor is physical; ``slack``: tolerance relative to its trace."""
    tensor = _as_tensors(tensor)
    trace = tensor[..., 0, 0] + tensor[..., 1, 1] + tensor[..., 2, 2]
    return physical_margin(tensor) >= -slack * trace


def possible_moments(moments: Float[Array, "*b 3"], triangle: bool) -> Bool[Array, "*b"]:
    """Whether moments are positive and finite and, with ``triangle``, satisfy that inequality.

    With the tolerance of the constructors. It costs a few operations in a compiled program.
    """
    moments = on_host(moments, weak=True)
    xp = numbers(moments)
    if xp is jnp:
        moments = jax.lax.stop_gradient(moments)
    good = xp.all((moments > 0) & (moments < jnp.inf), axis=-1)
    if triangle:
        quarter = moments / 4  # so that no sum overflows
        largest = xp.max(quarter, axis=-1)
        good = good & (xp.sum(quarter, axis=-1) >= (2 - tolerance(moments)) * largest)
    if xp is jnp:
        return good
    with jax.ensure_compile_time_eval():
        return jax.device_put(np.asarray(good))


def possible_tensor(tensor: Float[Array, "*b 3 3"], triangle: bool) -> Bool[Array, "*b"]:
    """Whether a tensor is symmetric, positive definite and, with ``triangle``, physical.

    Definiteness is tested by the pivots of Gaussian elimination, without eigenvalues.
    """
    tensor = jax.lax.stop_gradient(tensor)
    unit = tensor / jnp.max(jnp.abs(tensor), axis=(-2, -1), keepdims=True)
    identity = jnp.broadcast_to(jnp.eye(3, dtype=tensor.dtype), unit.shape)
    rounding = 16 * float(jnp.finfo(tensor.dtype).eps)
    good = is_symmetric(tensor) & _is_positive(unit - rounding * identity)
    if triangle:
        spread = second_moments(unit)
        trace = unit[..., 0, 0] + unit[..., 1, 1] + unit[..., 2, 2]
        shift = jnp.broadcast_to((tolerance(tensor) / 2 * trace)[..., None, None], unit.shape)
        good = good & _is_positive(spread + shift * identity)
    return good


def is_symmetric(tensor: Float[Array, "*b 3 3"]) -> Bool[Array, "*b"]:
    """Whether tensors are symmetric, to the tolerance of the constructors; False for NaN."""
    tensor = jax.lax.stop_gradient(tensor)
    skew = jnp.max(jnp.abs(tensor - jnp.swapaxes(tensor, -1, -2)), axis=(-2, -1))
    return skew <= tolerance(tensor) * jnp.max(jnp.abs(tensor), axis=(-2, -1))


def _is_positive(matrix: Array) -> Array:
    """Whether symmetric matrices have positive pivots."""
    a, b, c = (matrix[..., i, i] for i in range(3))
    p, q, r = matrix[..., 1, 0], matrix[..., 2, 0], matrix[..., 2, 1]
    second = b - p / a * p
    last = c - q / a * q - (r - p / a * q) ** 2 / second
    return (a > 0) & (second > 0) & (last > 0)


def tolerance(array: Array) -> float:
    """Relative tolerance of consistency checks: the square root of the dtype's epsilon."""
    return float(np.sqrt(jnp.finfo(array.dtype).eps))


def require_below(small_name: str, small: Array, large_name: str, large: Array) -> None:
    """ValueError if a concrete ``small`` exceeds ``large`` anywhere."""
    if is_concrete(small, large):
        small_values, large_values = np.asarray(small), np.asarray(large)
        require(
            small_values <= large_values,
            f"{small_name} must not exceed {large_name}, got {small_values.max():g} against "
            f"{large_values.min():g}; exchange them?",
        )


def check_moments(name: str, moments: np.ndarray, slack: float, zero_fraction: float = 0.0) -> None:
    """ValueError unless moments (..., 3) are positive and satisfy the triangle inequality.

    ``slack`` is the relative tolerance of the inequality (flat bodies), ``zero_fraction`` the part
    of the largest moment that counts as zero.
    """
    if moments.size == 0:
        return
    # by columns: NumPy reduces a short last axis slowly
    columns = tuple(moments[..., i] for i in range(moments.shape[-1]))
    largest, smallest = reduce(np.maximum, columns), reduce(np.minimum, columns)
    require(
        smallest > zero_fraction * largest,
        lambda: (
            f"{name} must be positive (kg m^2), got {_worst(moments, smallest)}; a moment is zero"
            " only for a point or an infinitely thin line: give the body a width."
        ),
    )
    excess = 2 - sum(x / largest for x in columns)  # relative, so that nothing overflows
    require(
        excess <= slack,
        lambda: (
            f"{name} must satisfy the triangle inequality (each at most the sum of the two"
            f" others), got {_worst(moments, -excess)}; check the units, and that these are moments"
            " of inertia, not second moments or a gyration tensor. To use published values that"
            " violate this, call Inertia.from_moments(..., physical=False)."
        ),
    )


def check_tensor(name: str, array: Array, *, triangle: bool = True) -> None:
    """ValueError unless a concrete tensor is symmetric with positive principal moments.

    ``triangle``: whether these must satisfy the triangle inequality.
    """
    if not is_concrete(array) or array.size == 0:
        return
    entries = np.asarray(array, np.float64)
    mirrored = np.swapaxes(entries, -1, -2)
    skew = np.abs(entries - mirrored)
    require(
        skew <= tolerance(array) * np.abs(entries).max(axis=(-2, -1), keepdims=True),
        f"{name} must be symmetric, got entries that differ by up to {skew.max():g} from their "
        "transposed ones; pass (A + A.T) / 2 if that is what is meant.",
    )
    # moments below the rounding error of the largest one count as zero
    zero_fraction = 64 * float(jnp.finfo(array.dtype).eps)
    moments = np.linalg.eigvalsh((entries + mirrored) / 2)
    slack = tolerance(array) if triangle else np.inf
    check_moments(f"the principal moments of {name}", moments, slack, zero_fraction)


def _worst(values: np.ndarray, badness: np.ndarray | np.floating) -> str:
    return np.array2string(values.reshape(-1, values.shape[-1])[int(np.argmin(badness))])


def check_points(masses: Array, positions: Array) -> None:
    """ValueError for an empty set of points, differing lengths, or a mass below zero."""
    count = positions.shape[-2]
    require(count > 0, "positions must hold at least one point, got none; is the file empty?")
    require(
        masses.shape[-1] == count,
        f"masses (..., n) and positions (..., n, 3) must have one n, got {masses.shape} and "
        f"{positions.shape}.",
    )
    require_positive("masses", masses, zero=True)
    require_positive("the sum of the masses", jnp.sum(masses, axis=-1))


def of_points(
    masses: Float[Array, "*b n"], positions: Float[Array, "*b n 3"]
) -> Float[Array, "*b 3 3"]:
    """``sum m (x.x 1 - x x^T)`` about the origin (docs/equations.md, 003: 24)."""
    x, y, z = jnp.unstack(positions, axis=-1)

    def second(u, v):
        return jnp.sum(masses * u * v, axis=-1)

    xx, yy, zz = second(x, x), second(y, y), second(z, z)
    return symmetric((yy + zz, zz + xx, xx + yy), (-second(y, z), -second(z, x), -second(x, y)))


def offset(mass: Float[Array, "*b"], shift: Float[Array, "*b 3"]) -> Float[Array, "*b 3 3"]:
    """Contribution of a mass at ``shift`` (..., 3): ``m (d.d 1 - d d^T)`` (parallel axes)."""
    return of_points(mass[..., None], shift[..., None, :])


@jax.jit
def rotate_tensor(
    tensor: Float[Array, "*#b 3 3"], matrix: Float[Array, "*#b 3 3"]
) -> Float[Array, "*b 3 3"]:
    """``R I R^T``, exactly symmetric."""
    exact = jax.lax.Precision.HIGHEST  # accelerators may compute matrix products less precisely
    product = jnp.einsum("...ij,...jk,...lk->...il", matrix, tensor, matrix, precision=exact)
    return (product + jnp.swapaxes(product, -1, -2)) / 2
