"""Interchange with other conventions: scalar-last quaternions and SciPy's ``Rotation``."""

from typing import TYPE_CHECKING

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from polhode._checks import ArrayLike
from polhode.rotation._input import as_quaternions, as_vectors

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation


def wxyz_to_xyzw(wxyz: Float[ArrayLike, "*b 4"]) -> Float[Array, "*b 4"]:
    """Scalar-last order (SciPy, ROS, Eigen's storage) of a scalar-first quaternion."""
    wxyz = as_vectors("wxyz", wxyz, 4)
    return jnp.concatenate([wxyz[..., 1:], wxyz[..., :1]], axis=-1)


def xyzw_to_wxyz(xyzw: Float[ArrayLike, "*b 4"]) -> Float[Array, "*b 4"]:
    """Scalar-first order of a scalar-last quaternion."""
    xyzw = as_vectors("xyzw", xyzw, 4)
    return jnp.concatenate([xyzw[..., 3:], xyzw[..., :3]], axis=-1)


def wxyz_to_scipy(wxyz: Float[ArrayLike, "*b 4"]) -> "Rotation":
    """SciPy's ``Rotation`` of quaternions, body -> space (its ``apply`` is our `rotate`).

    Leading axes are flattened to the single one that every SciPy release knows; a lone quaternion
    of shape (4,) gives a single rotation. Not for use under a JAX transformation.
    """
    if isinstance(wxyz, jax.core.Tracer):
        raise TypeError(
            "wxyz_to_scipy was given a traced array: SciPy works on concrete values only; "
            "convert outside jit, vmap and grad"
        )
    from scipy.spatial.transform import Rotation

    xyzw = np.asarray(wxyz_to_xyzw(as_quaternions(wxyz)), np.float64)
    return Rotation.from_quat(xyzw if xyzw.ndim == 1 else xyzw.reshape(-1, 4))


def scipy_to_wxyz(rotation: "Rotation", dtype: DTypeLike | None = None) -> Float[Array, "*b 4"]:
    """Quaternions, scalar first, of SciPy's ``Rotation``; ``dtype`` defaults to JAX's float."""
    if not hasattr(rotation, "as_quat"):
        raise TypeError(
            "scipy_to_wxyz takes a scipy.spatial.transform.Rotation, got"
            f" {type(rotation).__name__}; for an array that is scalar last use xyzw_to_wxyz."
        )
    xyzw = jnp.asarray(rotation.as_quat(), dtype or jnp.result_type(float))
    return xyzw_to_wxyz(xyzw)
