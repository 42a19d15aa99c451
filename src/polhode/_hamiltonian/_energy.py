"""The Hamiltonian of the rigid body, and the attitude as the argument of a potential.

All integrated equations of motion are derivatives of H. Both sets of coordinates (ZYZ Euler angles;
quaternion and body momentum) and every energy that the library reports evaluate
``Hamiltonian.__call__``, the only place of the formula in the package.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from polhode.inertia import Inertia
from polhode.inertia._inertia import VariableInertia, inertia_at
from polhode.rotation._quaternion import matrix_row

Vector = tuple[Array, Array, Array]
"""Three component arrays of one common shape (structure of arrays)."""


def dot(a: Sequence[Array], b: Sequence[Array]) -> Array:
    """Scalar product of the components of two vectors or quaternions."""
    first, *rest = (x * y for x, y in zip(a, b, strict=True))
    return sum(rest, start=first)


def cross(a: Sequence[Array], b: Sequence[Array]) -> Vector:
    """Vector product of two component triples."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def triple(values: Iterable[Array]) -> Vector:
    """The items of an iterable of three component arrays as a tuple; ValueError for another
    number of items."""
    x, y, z = values
    return x, y, z


def components(array: Array) -> Vector:
    """The last axis of an array as a triple of component arrays."""
    return triple(jnp.unstack(array, axis=-1))


class Attitude:
    """Rotation body -> space by the rows of its matrix R (``x_space = R x_body``).

    Row ``i`` contains the body components of the space axis ``i``. Rows are computed when they are
    first used, and cached, so that rows on which a potential does not depend are not computed;
    ``used`` lists the rows used.
    """

    def __init__(
        self,
        compute: Callable[[int], Vector],
        quaternion: Callable[[], tuple[Array, ...]] | None = None,
    ):
        self.compute, self._quaternion = compute, quaternion
        self._rows: dict[int, Vector] = {}

    def row(self, i: int) -> Vector:
        """Body components of the unit vector along space axis ``i``."""
        if i not in self._rows:
            self._rows[i] = self.compute(i)
        return self._rows[i]

    @property
    def wxyz(self) -> tuple[Array, ...]:
        """Unit quaternion, scalar first, as four component arrays (for torques; not potentials)."""
        if self._quaternion is None:
            raise ValueError(
                "a potential sees the attitude by its rows: use row(i), to_body, to_space, matrix."
            )
        return self._quaternion()

    @property
    def used(self) -> tuple[int, ...]:
        """Rows used so far."""
        return tuple(sorted(self._rows))

    def to_body(self, vector_space: Sequence[Array]) -> Vector:
        """Body components ``R^T v`` of a vector given by space components."""
        x, y, z = (self.row(i) for i in range(3))
        a, b, c = vector_space
        return triple(a * x[k] + b * y[k] + c * z[k] for k in range(3))

    def to_space(self, vector_body: Sequence[Array]) -> Vector:
        """Space components ``R v`` of a vector given by body components."""
        return triple(dot(self.row(i), vector_body) for i in range(3))

    @property
    def matrix(self) -> Array:
        """R as one array of shape (..., 3, 3)."""
        rows = [jnp.stack(self.row(i), axis=-1) for i in range(3)]
        return jnp.stack(rows, axis=-2)


def from_quaternion(wxyz: Sequence[Array]) -> Attitude:
    """Attitude of a unit quaternion given by four component arrays."""
    return Attitude(lambda i: matrix_row(wxyz, i), lambda: tuple(wxyz))


def from_euler_angles(phi: Array, theta: Array, psi: Array) -> Attitude:
    """Attitude ``Rz(phi) Ry(theta) Rz(psi)`` of three component arrays."""
    cf, sf, ct = jnp.cos(phi), jnp.sin(phi), jnp.cos(theta)
    st, cp, sp = jnp.sin(theta), jnp.cos(psi), jnp.sin(psi)

    def row(i: int) -> Vector:
        if i == 0:
            return ct * cf * cp - sf * sp, -ct * cf * sp - sf * cp, st * cf
        if i == 1:
            return ct * sf * cp + cf * sp, -ct * sf * sp + cf * cp, st * sf
        return -st * cp, st * sp, ct

    def quaternion() -> tuple[Array, ...]:
        half, sum_, difference = theta / 2, (psi + phi) / 2, (psi - phi) / 2
        c, s = jnp.cos(half), jnp.sin(half)
        return (
            c * jnp.cos(sum_),
            s * jnp.sin(difference),
            s * jnp.cos(difference),
            c * jnp.sin(sum_),
        )

    return Attitude(row, quaternion)


def from_rows(rows: dict[int, Vector]) -> Attitude:
    """Attitude with rows that have been computed."""
    return Attitude(lambda i: rows[i])


@runtime_checkable
class EnergyOfAttitude(Protocol):
    """The interface of a potential that the Hamiltonian uses (``_scene.AbstractPotential``)."""

    def energy(self, attitude: Attitude, t: Array | float, inertia: Inertia) -> Array: ...


def inverse_components(tensor: Array) -> tuple[Array, ...]:
    """(xx, yy, zz, xy, xz, yz) of the inverse of a symmetric tensor of shape (..., 3, 3)."""
    # In units of the trace: the derivative of one over the determinant contains one over the sixth
    # power of the moments, which underflows in single precision for moments of 1e6 and more.
    unit = jax.lax.stop_gradient(tensor[..., 0, 0] + tensor[..., 1, 1] + tensor[..., 2, 2])
    a, b, c = (tensor[..., k, k] / unit for k in range(3))
    d, e, f = (tensor[..., i, j] / unit for i, j in ((0, 1), (0, 2), (1, 2)))
    xx, yy, zz = b * c - f * f, a * c - e * e, a * b - d * d
    xy, xz, yz = e * f - c * d, d * f - b * e, d * e - a * f
    scale = 1 / (a * xx + d * xy + e * xz) / unit
    return tuple(scale * entry for entry in (xx, yy, zz, xy, xz, yz))


def inverse_inertia(inertia: Inertia) -> tuple[Array, ...]:
    """Entries of I^-1 [1/(kg m^2)]: three in principal body axes, else six (xx yy zz xy xz yz)."""
    if inertia.is_principal:
        return tuple(1 / moment for moment in components(inertia.moments))
    return inverse_components(inertia.tensor)


class Hamiltonian(eqx.Module):
    """H = (L - h) . I^-1 (L - h) / 2 + V(R, t), in joules (docs/equations.md, 000: 1).

    **Fields:** ``inverse``: entries of I^-1 (three or six component arrays), or a function of time
    that returns them, if the inertia is variable; ``inertia``: an argument of the potential;
    ``potential`` or None; ``rotor_momentum`` or None: h(t) [kg m^2/s], body components of the
    momentum that the wheels carry relative to the body; ``wheel_energy`` or None: energy [J] of
    their rotation about their axes, a function of time alone, which does not affect the motion.
    """

    inverse: tuple[Array, ...] | Callable[[Array | float], tuple[Array, ...]]
    inertia: Inertia | VariableInertia
    potential: EnergyOfAttitude | None = None
    rotor_momentum: Callable[[Array | float], Vector] | None = None
    wheel_energy: Callable[[Array | float], Array] | None = None

    def __call__(
        self, momentum: Sequence[Array], attitude: Attitude | None, t: Array | float
    ) -> Array:
        """Energy [J] of body momentum components [kg m^2/s] at an attitude and time [s]."""
        if self.rotor_momentum is None:
            x, y, z = momentum
        else:
            x, y, z = (a - h for a, h in zip(momentum, self.rotor_momentum(t)))
        inverse = self.inverse(t) if callable(self.inverse) else self.inverse
        twice = inverse[0] * x * x + inverse[1] * y * y + inverse[2] * z * z
        if len(inverse) == 6:
            xy, xz, yz = inverse[3:]
            twice = twice + 2 * (xy * x * y + xz * x * z + yz * y * z)
        kinetic = twice / 2
        if self.potential is None:
            return kinetic
        return kinetic + self.potential.energy(attitude, t, inertia_at(self.inertia, t))

    def total(
        self, momentum: Sequence[Array], attitude: Attitude | None, t: Array | float
    ) -> Array:
        """H and the energy of the wheels [J]: only external work changes this sum."""
        energy = self(momentum, attitude, t)
        return energy if self.wheel_energy is None else energy + self.wheel_energy(t)

    def rows_used(self, attitude: Attitude, t: Array | float) -> tuple[int, ...]:
        """Rows of R on which the potential depends, from tracing it once; none without one."""
        potential = self.potential
        if potential is None:
            return ()
        row = jax.eval_shape(lambda: attitude.compute(2))  # not cached: it would leak a tracer
        rows: tuple[int, ...] = ()

        def traced_energy(rows_of_attitude):
            nonlocal rows
            attitude_seen = Attitude(lambda i: rows_of_attitude[i])
            energy = potential.energy(attitude_seen, t, inertia_at(self.inertia, t))
            rows = attitude_seen.used
            return energy

        jax.eval_shape(traced_energy, dict.fromkeys(range(3), row))
        return rows


def free_hamiltonian(inertia: Inertia, potential: EnergyOfAttitude | None = None) -> Hamiltonian:
    """The Hamiltonian of a body without rotors."""
    if not isinstance(inertia, Inertia):
        raise TypeError(
            "a Hamiltonian needs the body's ph.Inertia, such as ph.Inertia.from_moments([1., 2.,"
            f" 3.]), got {type(inertia).__name__}."
        )
    if potential is not None and not callable(getattr(potential, "energy", None)):
        raise TypeError(
            "the potential must be one of ph.UniformGravity, ph.Potential, ... or None, got"
            f" {type(potential).__name__}."
        )
    return Hamiltonian(inverse_inertia(inertia), inertia, potential)
