"""Data minus model in units of the noise: the function that every optimiser needs."""

from collections.abc import Callable
from functools import reduce
from operator import add

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode.fit._motion import AbstractMotion, Predicted
from polhode.fit._parameters import Base, Parameters, tensor_of
from polhode.fit._recording import Recording, needed, turn_between
from polhode.rotation import conjugate, multiply, rotate, rotation_vector_to_wxyz


class Huber(eqx.Module):
    """Robust loss: residuals beyond ``threshold`` standard deviations count linearly."""

    threshold: float = 3.0

    def __check_init__(self) -> None:
        if not self.threshold > 0:
            raise ValueError(f"the threshold of Huber must be positive, got {self.threshold}.")

    def __call__(self, residual: Array) -> Array:
        size = jnp.abs(residual)
        inside = size <= self.threshold
        far = jnp.where(inside, self.threshold, size)
        outside = jnp.sqrt(2 * self.threshold * far - self.threshold**2)
        return jnp.where(inside, residual, jnp.sign(residual) * outside)


class Model(eqx.Module):
    """The model of a fit: how ``Parameters`` and a ``Recording`` give residuals.

    **Fields:** ``motion``; ``base``, ``columns`` (static): origin and directions of
    ``Parameters.shape``; ``attitude`` (r, 4): first recorded attitudes, to which
    ``Parameters.attitude`` is relative, or None; ``robust``: a ``Huber`` or None; ``scale_known``
    (static): whether ``shape`` includes the size of the inertia.
    """

    motion: AbstractMotion
    base: Base
    attitude: Float[Array, "r 4"] | None = None
    robust: Huber | None = None
    columns: tuple[tuple[float, ...], ...] = eqx.field(static=True, default=())
    scale_known: bool = eqx.field(static=True, default=False)

    @property
    def entries(self) -> int:
        """How many entries of the tensor are unknown (static): 6, 3 without products, or none."""
        if not any(self.columns):
            return 0
        return 6 if any(any(row) for row in self.columns[3:]) else 3

    def tensor(self, parameters: Parameters) -> Float[Array, "3 3"]:
        """Inertia tensor (3, 3) in sensor axes, kg m^2 (or to scale)."""
        return tensor_of(parameters.shape, self.base, np.array(self.columns))


def predict(
    parameters: Parameters, recording: Recording, model: Model, tensor: Array | None = None
) -> Predicted:
    """Motion of every recording (leading axis r) for these parameters, body axes.

    ``tensor`` (3, 3): inertia in place of that of ``parameters.shape``. Returns ``omega``,
    ``omega_dot`` (r, T, 3) and ``wxyz`` (r, T, 4), the last two None where they are not computed.
    """
    if tensor is None:
        tensor = model.tensor(parameters)
    attitude = model.attitude
    if attitude is not None and parameters.attitude is not None:
        attitude = multiply(attitude, rotation_vector_to_wxyz(parameters.attitude))

    def one(omega, wxyz, times, wheel):
        return model.motion(tensor, omega, wxyz, times, wheel, parameters.motion)

    return jax.vmap(one)(parameters.omega, attitude, recording.times, recording.wheel)


def residuals(
    parameters: Parameters, recording: Recording, model: Model, tensor: Array | None = None
) -> dict[str, Float[Array, "r t 3"]]:
    """Residuals of rates, attitudes (rotation vectors) and accelerometer, over their noise.

    ``recording`` carries one leading axis r: recordings of one body. Gaps count zero. Any
    optimiser can minimise the sum of squares; ``jax.grad`` and ``jax.jacfwd`` go through it.
    """
    motion = predict(parameters, recording, model, tensor)
    weight = recording.present[..., None]
    parts = {}
    if recording.omega is not None:
        seen, noise = motion.omega, needed("omega_noise", recording.omega_noise)
        if parameters.mounting is not None:
            turn = conjugate(rotation_vector_to_wxyz(parameters.mounting))
            seen = rotate(jnp.broadcast_to(turn, (*seen.shape[:-1], 4)), seen)
        if parameters.bias is not None:
            seen = seen + parameters.bias[None, None]
        parts["omega"] = weight * (recording.omega - seen) / noise
    if recording.wxyz is not None:
        noise = needed("attitude_noise", recording.attitude_noise)
        apart = turn_between(motion.wxyz, recording.wxyz)
        parts["attitude"] = weight * apart / noise[..., None]
    if recording.force is not None:
        if motion.omega_dot is None:
            raise ValueError(
                "force_body needs a motion that gives angular accelerations: FreeMotion or "
                f"SteppedMotion, got {type(model.motion).__name__}."
            )
        noise = needed("force_noise", recording.force_noise)
        lever = jnp.broadcast_to(parameters.lever, motion.omega.shape)
        felt = jnp.cross(motion.omega_dot, lever) + jnp.cross(
            motion.omega, jnp.cross(motion.omega, lever)
        )
        parts["force"] = weight * (recording.force - felt) / noise
    if model.robust is not None:
        parts = {name: model.robust(part) for name, part in parts.items()}
    return parts


def log_density(
    recording: Recording, model: Model, prior: Callable[[Parameters], Array] | None = None
) -> Callable[[Parameters], Float[Array, ""]]:
    """Logarithm of the posterior density of ``Parameters``, up to a constant, for any sampler.

    ``recording`` as in ``residuals`` (one leading axis: ``stack([recording])``), ``model`` that of
    a fit, whose ``parameters`` are the place to start from; ``prior`` adds the logarithm of its
    density (None: flat in the parameters, that is in the second moments away from flat bodies).
    The result is a density for BlackJAX; its negative is a ``potential_fn`` for NumPyro.
    """

    def density(parameters):
        parts = residuals(parameters, recording, model)
        misfit = -reduce(add, (jnp.sum(part**2) for part in parts.values())) / 2
        return misfit if prior is None else misfit + prior(parameters)

    return density
