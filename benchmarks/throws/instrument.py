"""A gyroscope beside a reaction wheel: calibration parameters, and preparation of recordings."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode._checks import as_float_array, require_positive
from polhode.fit._numerics import solve
from polhode.fit._recording import Recording, central_slope, require_channel
from polhode.fit._solve import integrate
from polhode.rotation import wxyz_to_matrix


def _vector(name: str, *rows: int) -> Callable[[Any], Any]:
    """Converter of a field to floats of shape (*rows, 3); None stays."""

    def convert(value: Any) -> Any:
        return None if value is None else as_float_array(name, value, (*rows, 3))

    return convert


class Instrument(eqx.Module):
    """Calibration of gyroscope and reaction wheel: ``omega = (1 + skew) (reading - bias)``.

    **Fields:** ``spin_inertia``, kg m^2, of the wheel (None: there is none); ``axis`` (3,) unit
    vector of its axis in sensor axes; ``delay``, s: to a gyroscope's reading belongs the speed of
    ``delay`` before; ``skew`` (3, 3): symmetric, traceless departure of the gyroscope's sensitivity
    from one (a common factor is that of ``spin_inertia``, an antisymmetric part a turn of the
    axes); ``bias`` (3,), rad/s.
    """

    spin_inertia: Array | float | None
    axis: Float[Array, " 3"] = eqx.field(converter=_vector("axis"), default=(0.0, 0.0, 1.0))
    delay: Array | float = 0.0
    skew: Float[Array, "3 3"] | None = eqx.field(converter=_vector("skew", 3), default=None)
    bias: Float[Array, " 3"] | None = eqx.field(converter=_vector("bias"), default=None)

    def __check_init__(self) -> None:
        if self.spin_inertia is not None:
            require_positive("spin_inertia", self.spin_inertia, hint="None stands for no wheel")

    def rates(self, reading: Float[Array, "*t 3"]) -> Float[Array, "*t 3"]:
        """True rates, rad/s, sensor axes."""
        if self.bias is not None:
            reading = reading - jnp.broadcast_to(self.bias, reading.shape)
        if self.skew is None:
            return reading
        return reading + jnp.einsum("ij,...j->...i", self.skew, reading)

    def carried(self, times: Float[Array, " t"], wheel: Float[Array, " t"]) -> Float[Array, "t 3"]:
        """Momentum of the wheel relative to the body, sensor axes; linear between the samples."""
        if self.spin_inertia is None:
            return jnp.zeros((*times.shape, 3), times.dtype)
        speed = jnp.interp(times - self.delay, times, wheel)
        return self.spin_inertia * speed[:, None] * self.axis[None]


class Tolerance(NamedTuple):
    """Prior standard deviations of the fields of an ``Instrument``; zero: not fitted.

    **Fields:** ``axis`` [rad]; ``delay`` [s]; ``skew``, relative; ``bias`` [rad/s].
    """

    axis: float = 0.02
    delay: float = 1e-3
    skew: float = 0.01
    bias: float = 0.02


@jax.jit
def lever_arm(recording: Recording) -> Float[Array, "*b 3"]:
    """Position (..., 3), m, of the accelerometer relative to the centre of mass, in free flight.

    Linear least squares of ``force = alpha x r + omega x (omega x r) + R^T (a + b t)``: the angular
    acceleration by central differences, and a drag of the air that changes little in space while
    the body turns. ``averaged`` to samples of a few milliseconds the recording has less noise in
    ``alpha``. Needs ``force`` and ``omega``.
    """

    def one(times, present, omega, force):
        slope = central_slope(omega, times)
        unit = jnp.eye(3, dtype=omega.dtype)

        def felt(arm):
            return jnp.cross(slope, arm) + jnp.cross(omega, jnp.cross(omega, arm))

        turn = jnp.swapaxes(wxyz_to_matrix(integrate(omega, slope, times)), -1, -2)
        late = (times - times[0])[:, None, None]
        design = jnp.concatenate([jax.vmap(felt, out_axes=-1)(unit), turn, late * turn], axis=-1)
        # a difference reaches to both neighbours
        whole = present * jnp.roll(present, 1) * jnp.roll(present, -1)
        whole = whole.at[0].set(0).at[-1].set(0)
        design = design * whole[:, None, None]
        square = jnp.einsum("tij,tik->jk", design, design)
        return solve(square, jnp.einsum("tij,ti->j", design, force))[:3]

    batch = recording.batch_shape
    omega, force = (
        require_channel("omega", recording.omega),
        require_channel("force", recording.force),
    )
    parts = (recording.times, recording.present, omega, force)
    flat = [part.reshape(-1, *part.shape[len(batch) :]) for part in parts]
    return jax.vmap(one)(*flat).reshape(*batch, 3)
