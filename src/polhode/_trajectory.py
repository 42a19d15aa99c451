"""The result of a simulation: sampled attitude and rates, everything else on demand."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from polhode import __version__, rotation
from polhode._batch import PARTS, along_time
from polhode._scene import Scene
from polhode.hamiltonian import components, from_quaternion
from polhode.methods import Status


class Trajectory(eqx.Module):
    """Samples of the motion; leading axes (...) are the batch, then T times.

    **Fields:** ``ts`` (T,) or (..., T) [s]; ``wxyz`` (..., T, 4) body -> space, or None when not
    recorded; ``omega_body`` (..., T, 3) [rad/s], or None; ``status`` (...): ``ph.Status`` per
    body; ``steps`` (...): solver steps (0 for an exact solution); ``scene``, the motion of its
    rotors fixed by the initial state; ``work`` (..., T) [J]: done from outside since the first
    time, by external torques, potentials that change with time (also orbits) and the motors of
    wheels, so that ``energy - work`` is constant, or None (``Record(work=True)``); ``error`` (...)
    [rad]: estimated error of the attitude at the last time, or None (``Record(error=True)``;
    without attitude that of the rates, relative); ``motor_work`` (..., T, m) [J]: the part of
    ``work`` that motor and friction of each wheel have done, or None without ``work`` or such;
    ``spins`` (..., T, k) [kg m^2/s]: momenta of the wheels with a coupling, or None.
    """

    ts: Float[Array, "*t"]
    wxyz: Float[Array, "*b t 4"] | None
    omega_body: Float[Array, "*b t 3"] | None
    status: Int[Array, "*b"]
    steps: Int[Array, "*b"]
    scene: Scene
    work: Float[Array, "*b t"] | None = None
    error: Float[Array, "*b"] | None = None
    motor_work: Float[Array, "*b t m"] | None = None
    spins: Float[Array, "*b t k"] | None = None

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading axes."""
        return self.status.shape

    @property
    def successful(self) -> Array:
        """Which bodies finished, (...) of bool."""
        return self.status == Status.SUCCESSFUL

    def _need(self, name: str) -> Array:
        value = getattr(self, name)
        if value is None:
            raise ValueError(
                f"this trajectory holds no {name}: ask for it with"
                " record=ph.Record(attitude=True, rates=True) in ph.simulate."
            )
        return value

    @property
    def _scene(self) -> Scene:
        """The scene with arrays shaped to broadcast against (..., T) samples."""
        rank = len(self.batch_shape)
        parts = {name: along_time(getattr(self.scene, name), rank) for name in PARTS}
        spins = () if self.spins is None else tuple(jnp.moveaxis(self.spins, -1, 0))
        return Scene(**parts).with_spins(spins)

    @property
    def _t(self) -> Array:
        return self.ts.reshape((1,) * (len(self.batch_shape) + 1 - self.ts.ndim) + self.ts.shape)

    @property
    def momentum_body(self) -> Float[Array, "*b t 3"]:
        """Angular momentum in body axes, that of rotors included [kg m^2/s]."""
        return self._scene.momentum(self._need("omega_body"), self._t)

    @property
    def momentum_space(self) -> Float[Array, "*b t 3"]:
        """Angular momentum in space axes [kg m^2/s]."""
        return rotation.rotate(self._need("wxyz"), self.momentum_body)

    @property
    def wheel_speed(self) -> Float[Array, "*b t m"] | None:
        """Speed of each wheel relative to the body [rad/s]; None without wheels.

        NaN for a wheel that is held at a momentum, its inertia not given.
        """
        wheels = self._scene.rotors
        if wheels is None:
            return None
        omega = components(self._need("omega_body"))
        speeds = [wheels.speed(i, self._t, omega) for i in range(len(wheels.held))]
        shape = omega[0].shape
        return jnp.stack([jnp.broadcast_to(x, shape) for x in speeds], axis=-1)

    @property
    def energy(self) -> Float[Array, "*b t"]:
        """Kinetic plus potential energy [J]: the one Hamiltonian at every sample.

        Of wheels that spin freely or by a motor the spin energy is included; with wheels held at
        their speed it is the energy of the body turning with them locked, which is what then stays
        constant. It changes by ``work`` and by nothing else (but a potential that jumps in time).
        """
        scene = self._scene
        attitude = None
        if scene.potential is not None:
            wxyz = self._need("wxyz")
            attitude = from_quaternion(tuple(wxyz[..., i] for i in range(4)))
        return scene.hamiltonian.total(components(self.momentum_body), attitude, self._t)

    def euler(self) -> tuple[Array, Array, Array]:
        """ZYZ Euler angles (phi, theta, psi) [rad], each (..., T)."""
        return rotation.wxyz_to_euler(self._need("wxyz"))

    def to_xarray(self) -> Any:
        """An ``xarray.Dataset`` with named dimensions, units and attributes (needs xarray)."""
        try:
            import xarray
        except ImportError as error:
            raise ImportError("to_xarray needs xarray: pip install 'polhode[cli]'") from error

        rank = len(self.batch_shape)
        batch = ("body",) if rank == 1 else tuple(f"batch_{i}" for i in range(rank))
        time = ("time",) if self.ts.ndim == 1 else (*batch, "time")
        data: dict[str, Any] = {}

        def put(name, array, dims, units, long_name):
            data[name] = (dims, np.asarray(array), {"units": units, "long_name": long_name})

        if self.wxyz is not None:
            put(
                "wxyz",
                self.wxyz,
                (*batch, "time", "quaternion"),
                "1",
                "attitude quaternion, scalar first, body to space",
            )
        if self.omega_body is not None:
            put(
                "omega_body",
                self.omega_body,
                (*batch, "time", "axis"),
                "rad s-1",
                "angular velocity in body axes",
            )
            if self.scene.potential is None or self.wxyz is not None:
                put("energy", self.energy, (*batch, "time"), "J", "kinetic plus potential energy")
            if self.wxyz is not None:
                put(
                    "momentum_space",
                    self.momentum_space,
                    (*batch, "time", "axis"),
                    "kg m2 s-1",
                    "angular momentum in space axes",
                )
        if self.work is not None:
            put("work", self.work, (*batch, "time"), "J", "work done by the external torques")
        if self.error is not None:
            put("error", self.error, batch, "rad", "estimated error at the last time")
        data["status"] = (
            batch,
            np.asarray(self.status, np.int8),
            {
                "long_name": "outcome of each body",
                "flag_values": np.array([int(s) for s in Status], np.int8),
                "flag_meanings": " ".join(s.name.lower() for s in Status),
            },
        )
        coords: dict[str, Any] = {
            "quaternion": ("quaternion", list("wxyz"), {"long_name": "part, the scalar first"}),
            "axis": ("axis", list("xyz"), {"long_name": "axis of the frame that the name states"}),
        }
        times = (time, np.asarray(self.ts), {"units": "s", "long_name": "time"})
        (coords if self.ts.ndim == 1 else data)["time" if self.ts.ndim == 1 else "ts"] = times
        attributes = {
            "Conventions": "CF-1.11",
            "title": "Rotating rigid bodies",
            "source": f"polhode {__version__}",
            "convention": "wxyz scalar first, body -> space; R = Rz(phi) Ry(theta) Rz(psi)",
        }
        return xarray.Dataset(data, coords=coords, attrs=attributes)
