"""The state of a rotating body: attitude and body rates."""

from typing import Protocol

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode import rotation
from polhode._checks import ArrayLike, as_float_array, is_concrete, require
from polhode._hamiltonian import (
    canonical_from_momentum,
    components,
    momentum_from_canonical,
    rates_from_angle_rates,
)
from polhode._parts import AbstractPart, shaped
from polhode.inertia import Inertia


class SciPyRotation(Protocol):
    """What ``State`` needs of a ``scipy.spatial.transform.Rotation``."""

    def as_quat(self) -> np.ndarray: ...


class State(AbstractPart):
    """Attitude and body rates at one time, and the speeds of wheels where they are given.

    **Arguments:** ``wxyz`` (..., 4): unit quaternion, scalar first, body -> space; one that is not
    of unit length is normalised; or a SciPy ``Rotation``. ``omega_body`` (..., 3): angular velocity
    in body axes [rad/s]. ``wheel_speed`` (..., m): speeds of the m wheels of the scene relative to
    the body [rad/s], in the order of its rotors; they replace the speeds and momenta that the
    ``ph.Rotor`` objects were given. None: those of the rotors. Entries of wheels with a prescribed
    speed are not used (they may be NaN), nor is any entry in a scene without rotors. Leading axes
    are a batch and broadcast together.

    Raises ValueError for a zero quaternion, NaN, wrong shapes or axes that do not broadcast.
    """

    wxyz: Float[Array, "*#b 4"] = shaped(4)
    omega_body: Float[Array, "*#b 3"] = shaped(3)
    wheel_speed: Float[Array, "*#b m"] | None = shaped(None)

    def __init__(
        self,
        wxyz: ArrayLike | SciPyRotation,
        omega_body: ArrayLike,
        wheel_speed: ArrayLike | None = None,
    ):
        if hasattr(wxyz, "as_quat"):
            wxyz = rotation.scipy_to_wxyz(wxyz, getattr(omega_body, "dtype", None))
        quaternion = as_float_array("wxyz", wxyz, (4,))
        rates = as_float_array("omega_body", omega_body, (3,))
        arrays = {"wxyz": quaternion, "omega_body": rates}
        if wheel_speed is not None:
            wheel_speed = as_float_array("wheel_speed", wheel_speed, (None,), finite=False)
            arrays["wheel_speed"] = wheel_speed
        try:
            np.broadcast_shapes(*(x.shape[:-1] for x in arrays.values()))
        except ValueError as error:
            shapes = " and ".join(f"{name} {x.shape}" for name, x in arrays.items())
            raise ValueError(f"{shapes} must have leading axes that broadcast together.") from error
        self.wxyz = rotation.normalise(quaternion)
        self.omega_body = rates
        self.wheel_speed = wheel_speed

    @classmethod
    def from_euler(
        cls,
        phi: ArrayLike,
        theta: ArrayLike,
        psi: ArrayLike,
        rates: ArrayLike | None = None,
        momenta: ArrayLike | None = None,
        inertia: Inertia | None = None,
    ) -> "State":
        """State from ZYZ Euler angles [rad] and their rates or canonical momenta.

        ``phi, theta, psi`` (...); exactly one of ``rates`` (..., 3) = d(phi, theta, psi)/dt
        [rad/s] and ``momenta`` (..., 3) = (p_phi, p_theta, p_psi) [kg m^2/s], the latter with
        ``inertia``. Momenta at theta = 0 or pi do not fix the rates: ValueError.
        """
        angles = tuple(
            as_float_array(name, value)
            for name, value in (("phi", phi), ("theta", theta), ("psi", psi))
        )
        angles = tuple(jnp.broadcast_arrays(*angles))
        wxyz = rotation.euler_to_wxyz(*angles)
        if (rates is None) == (momenta is None):
            raise ValueError(
                "State.from_euler takes exactly one of rates (angle rates, rad/s) and momenta"
                " (canonical momenta, kg m^2/s, with inertia)."
            )
        if rates is not None:
            rates = as_float_array("rates", rates, (3,))
            omega = rates_from_angle_rates(angles, components(rates))
            return cls(wxyz, jnp.stack(jnp.broadcast_arrays(*omega), axis=-1))
        if not isinstance(inertia, Inertia):
            raise TypeError(
                "State.from_euler(momenta=...) needs inertia=, the body's ph.Inertia, got"
                f" {type(inertia).__name__}."
            )
        momenta = as_float_array("momenta", momenta, (3,))
        if is_concrete(angles[1]):
            require(
                np.sin(np.asarray(angles[1])) != 0,
                "theta at 0 or pi: canonical momenta do not determine the body rates there;"
                " give rates, or build the State from a quaternion.",
            )
        momentum = momentum_from_canonical(angles, components(momenta))
        momentum = jnp.stack(jnp.broadcast_arrays(*momentum), axis=-1)
        return cls(wxyz, inertia.rates(momentum))

    @property
    def without_wheels(self) -> "State":
        """Attitude and body rates alone, once the scene holds the momenta of its wheels."""
        if self.wheel_speed is None:
            return self
        return eqx.tree_at(lambda s: s.wheel_speed, self, None)

    def as_unit(self) -> "State":
        """The state with quaternions of unit length, where an edit or a step left another."""
        square = jnp.sum(self.wxyz * self.wxyz, axis=-1, keepdims=True)
        unit = jnp.abs(square - 1) <= 8 * jnp.finfo(self.wxyz.dtype).eps
        wxyz = jnp.where(unit, self.wxyz, rotation.normalise(self.wxyz))
        return eqx.tree_at(lambda s: s.wxyz, self, wxyz)

    def canonical(self, inertia: Inertia) -> tuple[Array, Array]:
        """Angles q = (phi, theta, psi) [rad] and momenta p [kg m^2/s], arrays (..., 3)."""
        q = rotation.wxyz_to_euler(self.wxyz)
        p = canonical_from_momentum(q, components(inertia.momentum(self.omega_body)))
        return jnp.stack(q, axis=-1), jnp.stack(jnp.broadcast_arrays(*p), axis=-1)
