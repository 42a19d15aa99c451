"""A gyroscope and a reaction wheel: calibration parameters, and preparation of recordings."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks.throws.numerics import attitudes, central_differences
from polhode.fit import Recording


def _as_floats(value: Any) -> Any:
    return None if value is None else jnp.asarray(value, float)


class Instrument(eqx.Module):
    """Calibration of gyroscope and reaction wheel: ``omega = (1 + skew) (reading - bias)``.

    **Fields:** ``spin_inertia``, kg m^2, of the wheel (None: no wheel); ``axis`` (3,): unit vector
    of its axis in sensor axes; ``delay``, s: a reading of the gyroscope corresponds to the speed of
    the wheel ``delay`` earlier; ``skew`` (3, 3): symmetric, traceless deviation of the gyroscope's
    sensitivity from one (a common factor is equivalent to one of ``spin_inertia``, an antisymmetric
    part to a rotation of the axes); ``bias`` (3,), rad/s.
    """

    spin_inertia: Array | float | None
    axis: Float[Array, " 3"] = eqx.field(converter=_as_floats, default=(0.0, 0.0, 1.0))
    delay: Array | float = 0.0
    skew: Float[Array, "3 3"] | None = eqx.field(converter=_as_floats, default=None)
    bias: Float[Array, " 3"] | None = eqx.field(converter=_as_floats, default=None)

    def __check_init__(self) -> None:
        spin = self.spin_inertia
        if isinstance(spin, float | int | np.ndarray) and not np.all(spin > 0):
            raise ValueError(
                f"spin_inertia must be positive, got {spin}; None stands for no wheel."
            )

    def rates(self, reading: Float[Array, "*t 3"]) -> Float[Array, "*t 3"]:
        """True rates, rad/s, sensor axes."""
        if self.bias is not None:
            reading = reading - jnp.broadcast_to(self.bias, reading.shape)
        if self.skew is None:
            return reading
        return reading + jnp.einsum("ij,...j->...i", self.skew, reading)

    def carried(self, times: Float[Array, " t"], wheel: Float[Array, " t"]) -> Float[Array, "t 3"]:
        """Momentum of the wheel relative to the body, sensor axes; linear between samples."""
        if self.spin_inertia is None:
            return jnp.zeros((*times.shape, 3), times.dtype)
        speed = jnp.interp(times - self.delay, times, wheel)
        return self.spin_inertia * speed[:, None] * self.axis[None]


class Tolerance(NamedTuple):
    """Prior standard deviations of the fields of an ``Instrument``; a field with zero is not
    fitted.

    **Fields:** ``axis`` [rad]; ``delay`` [s]; ``skew``, relative; ``bias`` [rad/s].
    """

    axis: float = 0.02
    delay: float = 1e-3
    skew: float = 0.01
    bias: float = 0.02


@jax.jit
def lever_arm(recording: Recording) -> Float[Array, "*b 3"]:
    """Position (..., 3), m, of the accelerometer relative to the centre of mass, in free flight.

    Linear least squares of ``force = alpha x r + omega x (omega x r) + R^T (a + b t)``, with the
    angular acceleration by central differences, and a drag that changes slowly in space while the
    body rotates. A recording that is ``averaged`` to samples of a few milliseconds has less noise
    in ``alpha``. The recording must have ``force`` and ``omega``.
    """

    def normal_equations(times, present, omega, force):
        slope = central_differences(omega, times)
        unit = jnp.eye(3, dtype=omega.dtype)

        def felt(arm):
            return jnp.cross(slope, arm) + jnp.cross(omega, jnp.cross(omega, arm))

        turn = jnp.swapaxes(attitudes(omega, slope, times), -1, -2)
        late = (times - times[0])[:, None, None]
        design = jnp.concatenate([jax.vmap(felt, out_axes=-1)(unit), turn, late * turn], axis=-1)
        # a central difference uses both neighbours
        whole = present * jnp.roll(present, 1) * jnp.roll(present, -1)
        whole = whole.at[0].set(0).at[-1].set(0)
        design = design * whole[:, None, None]
        square = jnp.einsum("tij,tik->jk", design, design)
        return square, jnp.einsum("tij,ti->j", design, force)

    batch = recording.batch_shape
    if recording.omega is None or recording.force is None:
        raise ValueError("lever_arm needs omega_body and force_body in the recording.")
    parts = (recording.times, recording.present, recording.omega, recording.force)
    flat = [part.reshape(-1, *part.shape[len(batch) :]) for part in parts]
    systems = jax.vmap(normal_equations)(*flat)
    # sequentially: batched calls of LAPACK can deadlock (jax below 0.12)
    solutions = jax.lax.map(lambda system: jnp.linalg.solve(*system), systems)
    return solutions[:, :3].reshape(*batch, 3)
