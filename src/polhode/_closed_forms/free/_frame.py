"""Passage between the body's axes and the axes in their roles, and small vector algebra."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode._closed_forms.free._motion import Swing
from polhode._closed_forms.free._roles import Triple, pick, restore
from polhode._closed_forms.free._tangent import Change
from polhode._hamiltonian import triple

Scalars = Float[Array, "*b"]
Quadruple = tuple[Scalars, Scalars, Scalars, Scalars]


class Frame:
    """Passage between x, y, z and the right-handed axes 1, 2, 3 on which L3 is positive."""

    def __init__(self, swing: Swing):
        self.swing = swing
        facing = jnp.copysign(1, swing.momentum[2])
        self.signs = (jnp.ones_like(facing), swing.parity * facing, facing)
        self.index = (3 - swing.middle - swing.circled, swing.middle, swing.circled)

    def to_roles(self, values: Triple) -> Triple:
        return triple(pick(values, k) for k in self.index)

    def to_pairs(self, values: Triple) -> Triple:
        """Entries xy, xz, yz as entries 12, 13, 23."""
        i, j, k = self.index
        return triple(pick(values, n - 1) for n in (i + j, i + k, j + k))

    def to_body(self, values: Triple) -> Triple:
        return restore(values, self.swing.middle, self.swing.circled)

    def turned(self, values: Triple) -> Triple:
        return triple(e * x for e, x in zip(self.signs, values, strict=True))


def cross(a: Triple, b: Triple) -> Triple:
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


def dot(a, b) -> Scalars:
    """Scalar product of vectors or quaternions."""
    first, *rest = (x * y for x, y in zip(a, b, strict=True))
    return sum(rest, start=first)


def hamilton(a: Quadruple, b: Quadruple) -> Quadruple:
    v = cross(a[1:], b[1:])
    vector = triple(a[0] * b[k + 1] + a[k + 1] * b[0] + v[k] for k in range(3))
    return a[0] * b[0] - dot(a[1:], b[1:]), *vector


def matrix(change: Change, vector: Triple) -> Triple:
    """The variation of the inverse tensor, applied."""
    a, b, c = vector
    plain = triple(e * x for e, x in zip(change.inverse, vector, strict=True))
    if change.crossed is None:
        return plain
    h12, h13, h23 = change.crossed
    return (
        plain[0] + h12 * b + h13 * c,
        plain[1] + h12 * a + h23 * c,
        plain[2] + h13 * a + h23 * b,
    )
