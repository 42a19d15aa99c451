"""The inertia of a rigid body in body axes, constant or variable, and Euler's equation.

Equations: docs/equations.md, 003: 29.
"""

from collections.abc import Callable
from typing import Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from polhode._checks import (
    ArrayLike,
    as_float_array,
    as_floats,
    as_vectors,
    is_concrete,
    on_host,
    require,
    require_positive,
)
from polhode._parts import AbstractPart, Signature, as_static, shaped, takes
from polhode.inertia._physical import (
    check_moments,
    check_points,
    check_tensor,
    inertia_from_log_cholesky,
    inertia_to_log_cholesky,
    is_symmetric,
    of_points,
    possible_moments,
    possible_tensor,
    principal,
    principal_moments,
    rotate_tensor,
    tolerance,
)
from polhode.inertia._shapes import AbstractShaped, Symmetry
from polhode.rotation import wxyz_to_matrix

_ONE_FORM = (
    "Inertia holds either principal moments or a full tensor, not both and not neither; use"
    " Inertia.from_moments or Inertia.from_tensor."
)


class Inertia(AbstractShaped, AbstractPart):
    """Inertia tensor I of a rigid body in body axes, kg m^2 (docs/equations.md, 003).

    ``ph.Inertia(moments)``, of shape (..., 3), is ``Inertia.from_moments(moments)``. Three rows of
    three are rejected, since they may be a tensor: use a ``from_...`` constructor.

    The numbers have one of four forms, with leading axes for a batch of bodies: ``diagonal`` (...,
    3), moments about body x, y, z, which are principal axes; ``full`` (..., 3, 3), any axes;
    ``transverse`` (...) and ``axial`` (...) of a body symmetric about body z; ``moment`` (...) of
    one with three equal moments. A symmetry therefore cannot be lost, for example in a step of an
    optimiser. Numbers passed by these names are not checked until the simulation
    (``ph.Status.NOT_PHYSICAL``).

    ``physical`` (static): whether the triangle inequality is required; positive moments and a
    symmetric tensor always are. Default: True for ``moments``, False for numbers passed by name
    (``diagonal``, ``full``, ...).
    """

    diagonal: Float[Array, "*b 3"] | None = shaped(3)
    full: Float[Array, "*b 3 3"] | None = shaped(3, 3)
    transverse: Float[Array, "*b"] | None = shaped()
    axial: Float[Array, "*b"] | None = shaped()
    moment: Float[Array, "*b"] | None = shaped()
    physical: bool = eqx.field(static=True, kw_only=True)

    def __init__(
        self,
        moments: ArrayLike | None = None,
        full: ArrayLike | None = None,
        *,
        diagonal: ArrayLike | None = None,
        transverse: ArrayLike | None = None,
        axial: ArrayLike | None = None,
        moment: ArrayLike | None = None,
        physical: bool | None = None,
    ):
        if moments is not None:
            require(diagonal is None, _ONE_FORM)
            diagonal, physical = _moments_meant(moments), physical is not False
            if is_concrete(diagonal):
                _checked("moments", diagonal, triangle=physical)
        forms = {
            "diagonal": (diagonal, (3,)),
            "full": (full, (3, 3)),
            "transverse": (transverse, ()),
            "axial": (axial, ()),
            "moment": (moment, ()),
        }
        for name, (value, core) in forms.items():
            array = None if value is None else as_float_array(name, value, core, finite=False)
            setattr(self, name, array)
        self.physical = bool(physical)
        check_form(self)

    @classmethod
    def from_moments(cls, moments: ArrayLike, *, physical: bool = True) -> Self:
        """Principal moments (..., 3), kg m^2, about body x, y, z, which are principal axes.

        ``physical=False`` accepts published moments that violate the triangle inequality, such as
        (2, 1, 2/3); the equations of motion are the same.

        Raises ValueError for a wrong shape, values that are not positive and finite, or unphysical
        moments (flat bodies, where one equals the sum of the two others, are accepted).
        """
        array = as_float_array("moments", moments, (3,))
        return cls(diagonal=_checked("moments", array, physical), physical=physical)

    @classmethod
    def axisymmetric(
        cls, transverse: ArrayLike, axial: ArrayLike, *, physical: bool = True
    ) -> Self:
        """A symmetric top: moments (transverse, transverse, axial), symmetry axis body z.

        Both of shape (...), kg m^2, broadcast together; they are its two leaves. ``physical`` and
        errors are those of ``from_moments``.
        """
        first, last = as_floats(transverse=(transverse, ()), axial=(axial, ()))
        name = "(transverse, transverse, axial)"
        if is_concrete(first, last):
            _checked(name, np.stack(np.broadcast_arrays(first, first, last), axis=-1), physical)
        return cls(transverse=first, axial=last, physical=physical)

    @classmethod
    def spherical(cls, moment: ArrayLike) -> Self:
        """All moments equal (sphere, cube, ...): ``moment`` of shape (...), kg m^2, positive."""
        single = as_float_array("moment", moment, ())
        require_positive("moment", single)
        return cls(moment=single, physical=True)

    @classmethod
    def from_tensor(cls, tensor: ArrayLike, *, physical: bool = True) -> Self:
        """Inertia tensor (..., 3, 3) in any body axes, kg m^2: symmetric, products negative-signed.

        The off-diagonal entries are ``-integral x y dm``. ``physical`` as for
        ``from_moments``. Raises ValueError for a wrong shape, NaN or infinity, a tensor that is not
        symmetric, or one whose principal moments are not positive or violate the triangle
        inequality. A traced tensor that is not symmetric becomes NaN.
        """
        array = as_float_array("tensor", tensor, (3, 3))
        check_tensor("tensor", array, triangle=physical)
        values = on_host(array)
        symmetric = (values + values.mT) / 2
        if isinstance(values, np.ndarray):  # computed by NumPy, without compiling a program
            symmetric = as_float_array("tensor", symmetric)
        elif not is_concrete(array):
            symmetric = jnp.where(is_symmetric(array)[..., None, None], symmetric, jnp.nan)
        return cls(full=symmetric, physical=physical)

    @classmethod
    def from_points(cls, masses: ArrayLike, positions: ArrayLike) -> Self:
        """Point masses (..., n), kg, at ``positions`` (..., n, 3), m, about the origin.

        ``I = sum m (x.x 1 - x x^T)`` (docs/equations.md, 003: 24). The origin is the point about
        which the body rotates; for a free body use ``MassProperties.from_points``, whose
        ``inertia`` is about the centre of mass. Raises ValueError for an empty set, a negative
        mass, points that all lie on one line through the origin, NaN or infinity.
        """
        masses, positions = as_floats(masses=(masses, (None,)), positions=(positions, (None, 3)))
        check_points(masses, positions)
        tensor = of_points(masses, positions)
        check_tensor("the inertia of the points", tensor)
        return cls(full=tensor, physical=True)

    @classmethod
    def _of_shape(cls, mass: Array, moments: Array, symmetry: Symmetry) -> Self:
        return cls.of_symmetry(_checked("the principal moments", moments), symmetry)

    @classmethod
    def of_symmetry(cls, moments: Array, symmetry: Symmetry, physical: bool = True) -> Self:
        """Moments (..., 3) in the form for a symmetry that the caller guarantees; unchecked."""
        if symmetry is Symmetry.NONE:
            return cls(diagonal=moments, physical=physical)
        values = on_host(moments)
        first, last = (as_float_array("a moment", values[..., i], finite=False) for i in (0, 2))
        if symmetry is Symmetry.AXISYMMETRIC:
            return cls(transverse=first, axial=last, physical=physical)
        return cls(moment=first, physical=physical)

    @classmethod
    def from_log_cholesky(cls, parameters: ArrayLike) -> Self:
        """A physical inertia from any real 6-vector (..., 6); see ``to_log_cholesky``."""
        array = as_float_array("parameters", parameters, (6,))
        return cls(full=inertia_from_log_cholesky(array), physical=True)

    def to_log_cholesky(self) -> Float[Array, "*b 6"]:
        """Unconstrained parameters (..., 6) of the tensor: log-Cholesky of its second moments.

        A flat body lies on the boundary, where a logarithm is infinite.
        """
        return inertia_to_log_cholesky(self.tensor)

    @property
    def symmetry(self) -> Symmetry:
        """Which moments are equal by construction (static)."""
        if self.moment is not None:
            return Symmetry.SPHERICAL
        return Symmetry.NONE if self.transverse is None else Symmetry.AXISYMMETRIC

    @property
    def is_principal(self) -> bool:
        """Whether the body axes are principal axes by construction (static)."""
        return self.full is None

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading axes."""
        return self.moments.shape[:-1] if self.full is None else self.full.shape[:-2]

    @property
    def dtype(self) -> Any:
        """Floating dtype of the numbers."""
        return jax.tree.leaves(self)[0].dtype

    @property
    def moments(self) -> Float[Array, "*b 3"]:
        """Principal moments (..., 3) [kg m^2]: as given, or ascending for a full tensor.

        Differentiable twice; second derivatives of equal moments with respect to the full tensor
        are NaN.
        """
        if self.diagonal is not None:
            return self.diagonal
        if self.full is not None:
            return principal_moments(self.full)
        if self.moment is not None:
            return _stacked(self.moment, self.moment, self.moment)
        return _stacked(self.transverse, self.transverse, self.axial)

    @property
    def is_possible(self) -> Bool[Array, "*b"]:
        """Whether (...) the inertia is physical, up to rounding; works under JAX transformations.

        It requires positive moments that satisfy the triangle inequality (unless ``physical`` is
        False), a symmetric tensor, neither NaN nor infinity.
        """
        if self.full is None:
            return possible_moments(self.moments, self.physical)
        return possible_tensor(self.full, self.physical)

    @property
    def axes(self) -> Float[Array, "*b 4"] | None:
        """Rotation ``wxyz`` (..., 4) from principal to body axes, or None when they are the same.

        Carries no derivative (see ``principal`` for correct derivatives).
        """
        return None if self.full is None else principal(self.full)[1]

    @property
    def tensor(self) -> Float[Array, "*b 3 3"]:
        """The tensor (..., 3, 3) in body axes [kg m^2]."""
        if self.full is not None:
            return self.full
        return _diagonal(self.moments)

    def turned(self, wxyz: Float[Array, "*#b 4"]) -> Self:
        """The body rotated by the unit quaternion (..., 4) in its axes: ``R I R^T``, a full tensor.

        It inverts the decomposition: ``Inertia(inertia.moments).turned(inertia.axes)``.
        """
        return type(self)(
            full=rotate_tensor(self.tensor, wxyz_to_matrix(wxyz)), physical=self.physical
        )

    def to_principal(self) -> tuple[Self, Float[Array, "*b 4"]]:
        """The body in principal axes, and the rotation ``wxyz`` from those to the present axes.

        ``wxyz`` has no derivatives, and the tangents of the products of inertia are dropped: for
        derivatives of a motion with respect to a full tensor use ``principal``.
        """
        if self.full is None:
            unit = jnp.asarray([1, 0, 0, 0], self.dtype)
            return self, jnp.broadcast_to(unit, (*self.batch_shape, 4))
        moments, wxyz = principal_moments(self.full), principal(self.full)[1]
        return type(self)(diagonal=moments, physical=self.physical), wxyz

    def momentum(self, omega: Float[Array | np.ndarray, "*#b 3"]) -> Float[Array, "*b 3"]:
        """Body momentum ``I omega``, kg m^2/s, of body rates (..., 3), rad/s."""
        omega = as_vectors("omega", omega)
        if self.full is None:
            return jnp.multiply(*jnp.broadcast_arrays(self.moments, omega))
        return _product(self.full, omega)

    def rates(self, momentum: Float[Array | np.ndarray, "*#b 3"]) -> Float[Array, "*b 3"]:
        """Body rates ``I^-1 L``, rad/s, of body momenta (..., 3), kg m^2/s."""
        momentum = as_vectors("momentum", momentum)
        if self.full is None:
            moments, momentum = jnp.broadcast_arrays(self.moments, momentum)
            return momentum / moments
        batch = jnp.broadcast_shapes(self.batch_shape, momentum.shape[:-1])
        tensor = jnp.broadcast_to(self.full, (*batch, 3, 3))
        return _solve(tensor, jnp.broadcast_to(momentum, (*batch, 3)))


def check_form(inertia: Inertia) -> None:
    """ValueError unless exactly one form has numbers, and all of its numbers are present."""
    forms = (inertia.diagonal, inertia.full, inertia.transverse, inertia.moment)
    is_complete = (inertia.transverse is None) == (inertia.axial is None)
    if sum(x is not None for x in forms) != 1 or not is_complete:
        raise ValueError(_ONE_FORM)


def _stacked(*moments: Array) -> Array:
    values = [on_host(x) for x in moments]
    if all(isinstance(x, np.ndarray) for x in values):  # without compiling a program
        stacked = np.stack(np.broadcast_arrays(*values), axis=-1)
        return as_float_array("moments", stacked, finite=False)
    return jnp.stack(jnp.broadcast_arrays(*moments), axis=-1)


def _diagonal(moments: Array) -> Array:
    values = on_host(moments)
    if isinstance(values, np.ndarray):
        tensor = values[..., None] * np.eye(3, dtype=values.dtype)
        return as_float_array("tensor", tensor, finite=False)
    return _diagonal_of(moments)


@jax.jit  # outside jit too, one program for all operations; likewise below
def _diagonal_of(moments):
    unit = jnp.eye(3, dtype=moments.dtype)
    return moments[..., None] * jnp.broadcast_to(unit, (*moments.shape, 3))


@jax.jit
def _product(tensor, vector):
    rows = (jnp.broadcast_arrays(tensor[..., i, :], vector) for i in range(3))
    return jnp.stack([jnp.sum(a * b, axis=-1) for a, b in rows], axis=-1)


@jax.jit
def _solve(tensor, vector):
    """Solution of a symmetric positive definite 3x3 system by its L D L^T factors, elementwise."""
    a, p, q, r = (tensor[..., 0, 0], tensor[..., 1, 0], tensor[..., 2, 0], tensor[..., 2, 1])
    x, y, z = jnp.unstack(vector, axis=-1)
    l10, l20 = p / a, q / a
    d1 = tensor[..., 1, 1] - l10 * p
    e21 = r - l20 * p
    l21 = e21 / d1
    d2 = tensor[..., 2, 2] - l20 * q - l21 * e21
    y = y - l10 * x
    z = (z - l20 * x - l21 * y) / d2
    y = y / d1 - l21 * z
    return jnp.stack([x / a - l10 * y - l20 * z, y, z], axis=-1)


def _checked(name, moments, triangle=True):
    if is_concrete(moments):
        slack = tolerance(moments) if triangle else np.inf
        check_moments(name, np.asarray(moments, np.float64), slack)
    return moments


def _moments_meant(value) -> Array:
    """The moments of ``ph.Inertia(value)``, or an error that names the right constructor."""
    if isinstance(value, eqx.Module):
        raise TypeError(
            f"Inertia takes numbers, got {type(value).__name__}: of ph.MassProperties take .inertia"
            " or .about(point)."
        )
    array = as_float_array("Inertia(moments): moments", value)
    if array.shape[-2:] == (3, 3):
        raise ValueError(
            f"Inertia(...) of shape {array.shape} may mean tensors or the moments of three bodies:"
            " use Inertia.from_tensor or Inertia.from_moments."
        )
    if array.ndim == 0:
        raise ValueError(
            "Inertia(...) takes three moments, got one number: use Inertia.spherical(moment) for a"
            " body with three equal ones."
        )
    return as_float_array("Inertia(moments): moments", value, (3,))


def angular_acceleration(
    inertia: Inertia,
    omega_body: Float[ArrayLike, "*#b 3"],
    torque_body: Float[ArrayLike, "*#b 3"] | None = None,
) -> Float[Array, "*b 3"]:
    """``domega/dt`` (..., 3), rad/s^2, of ``I domega/dt + omega x (I omega) = N``.

    ``omega_body`` rad/s and ``torque_body`` N m (None: free) in body axes; constant inertia, any
    axes. The form without ``omega x (I omega)``, which is often printed, is correct only if omega
    is along a principal axis.
    """
    omega_body = as_vectors("omega_body", omega_body)
    drive = _cross(inertia.momentum(omega_body), omega_body)
    if torque_body is not None:
        torque_body = as_vectors("torque_body", torque_body)
        drive = jnp.add(*jnp.broadcast_arrays(drive, torque_body))
    return inertia.rates(drive)


def required_torque(
    inertia: Inertia,
    omega_body: Float[ArrayLike, "*#b 3"],
    omega_dot_body: Float[ArrayLike, "*#b 3"],
) -> Float[Array, "*b 3"]:
    """The torque ``I domega/dt + omega x (I omega)`` (..., 3), N m, that a given motion needs."""
    omega_body = as_vectors("omega_body", omega_body)
    omega_dot_body = as_vectors("omega_dot_body", omega_dot_body)
    gyroscopic = _cross(omega_body, inertia.momentum(omega_body))
    return jnp.add(*jnp.broadcast_arrays(inertia.momentum(omega_dot_body), gyroscopic))


def _cross(left: Array | np.ndarray, right: Array | np.ndarray) -> Array:
    return jnp.cross(*jnp.broadcast_arrays(left, right))


class VariableInertia(AbstractPart):
    """Inertia as a prescribed function of time, in body axes, for ``ph.Scene(inertia=...)``.

    **Arguments:** ``fn``: a function of time [s] that returns principal moments (3,) or a tensor
    (3, 3) [kg m^2]; or a ``ph.Table`` of moments (..., n, 3) or of tensors as nine numbers
    (..., n, 9), row by row. Its values must be physical at all times; they are not checked.

    The angular momentum L obeys dL/dt = L x omega + N with omega = I(t)^-1 L, so that the term
    (dI/dt) omega of Euler's equations,

        I domega/dt = -omega x I omega - (dI/dt) omega + N,

    is included and no derivative of I is needed. Without torques L is constant in space, as in a
    deployment. The parts must move so that they carry no angular momentum relative to the body axes
    (in pairs, or along lines through the centre of mass). Mass that leaves the body takes momentum
    with it: add that as a torque, ``ph.FeedbackTorque(lambda t, wxyz, omega: dI_dt(t) @ omega)``
    for mass that leaves with the velocity of its place on the body.

        booms = ph.VariableInertia(lambda t: jnp.array([1.0, 1.2, 0.6]) * (1 + 0.1 * t))
        ph.simulate(ph.Scene(booms), state, ts)

    P. C. Hughes, Spacecraft Attitude Dynamics, 1986, section 3.5. Raises TypeError or ValueError
    for a function that takes or returns something else.
    """

    is_principal: bool = eqx.field(static=True)
    fn: Callable = shaped(None)

    def __init__(self, fn: Callable):
        if isinstance(fn, AbstractPart) and callable(fn):
            width = (np.shape(jax.eval_shape(fn, 0.0)) or (1,))[-1]
            require(
                width in (3, 9),
                "VariableInertia takes a table of moments (..., n, 3) or of tensors (..., n, 9),"
                f" got vectors of {width} numbers.",
            )
            self.fn, self.is_principal = fn, width == 3
            return
        takes("VariableInertia", fn, ("t",))
        function: Any = fn
        with jax.numpy_dtype_promotion("standard"):
            shape = np.shape(jax.eval_shape(lambda t: as_float_array(_NAME, function(t)), 0.0))
        require(
            shape in ((3,), (3, 3)),
            "the function given to VariableInertia must return moments (3,) or a tensor (3, 3), got"
            f" shape {shape}.",
        )
        self.fn, self.is_principal = as_static(fn), shape == (3,)

    def at(self, t: Array | float) -> Inertia:
        """The inertia at the times ``t`` (...)."""
        core_rank = 2
        if isinstance(self.fn, AbstractPart) and callable(self.fn):
            value, core_rank = self.fn(t), 1
        else:
            core = (3,) if self.is_principal else (3, 3)
            value = Signature(_NAME, {"t": ()}, core).mapped(self.fn, t)
        if self.is_principal:
            return Inertia(diagonal=value, physical=False)
        return Inertia(
            full=value.reshape(*value.shape[: value.ndim - core_rank], 3, 3), physical=False
        )

    @property
    def symmetry(self) -> Symmetry:
        """None by construction (static)."""
        return Symmetry.NONE

    @property
    def dtype(self) -> Any:
        """Floating dtype of the numbers of a table; else that of JAX."""
        leaves = [x for x in jax.tree.leaves(self) if eqx.is_inexact_array(x)]
        return jnp.result_type(*leaves) if leaves else jnp.result_type(float)


_NAME = "VariableInertia"


def inertia_at(inertia: Inertia | VariableInertia, t: Array | float) -> Inertia:
    """The inertia at the time ``t``; a constant one is returned unchanged."""
    return inertia.at(t) if isinstance(inertia, VariableInertia) else inertia
