"""The result of a simulation: samples of attitude and rates, with derived quantities on demand."""

import abc
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from polhode import rotation
from polhode._batch import (
    PARTS,
    along_time,
    check_key,
    ends_at_last,
    is_integer,
    map_arrays,
    split_key,
)
from polhode._checks import ArrayLike, is_concrete
from polhode._hamiltonian import components, from_quaternion
from polhode._method import Status, StepCounts
from polhode._scene import Scene, State, Wheels
from polhode._trajectory._exports import dataset, scipy_rotation, write_aem

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation


@partial(jax.jit, static_argnums=2)  # outside jit too, one program for all operations
def _sample(wxyz: Array, omega: Array, place: int) -> tuple[Array, Array]:
    """Attitude and rates (...) of one sample."""
    return wxyz[..., place, :], omega[..., place, :]


@eqx.filter_jit  # likewise
def _speeds(trajectory: "Trajectory", place: int) -> Array | None:
    """Wheel speeds (..., m) of one sample."""
    speeds = trajectory[..., place].wheel_speed
    return None if speeds is None else speeds[..., 0, :]


@eqx.filter_jit  # likewise
def _derived(of: Callable[["Trajectory"], Any], trajectory: "Trajectory") -> Any:
    return of(trajectory)


class AbstractPropagator(eqx.Module):
    """Computes a trajectory at other times."""

    @abc.abstractmethod
    def at(self, trajectory: "Trajectory", t: ArrayLike) -> "Trajectory":
        """The trajectory at times ``t`` (K,) or (..., K)."""


class Events(eqx.Module):
    """Events of each body in the order of the motion; see ``simulate(events=)``.

    **Fields:** ``times`` (..., M) [s], padded with inf; ``which`` (..., M): index of the event
    function in ``events``, padded with -1; ``wxyz`` (..., M, 4) and ``omega_body`` (..., M, 3)
    [rad/s]: the states at the events, padded with NaN; ``count`` (...): number of events, which
    exceeds M if the status is ``TOO_MANY_EVENTS``.
    """

    times: Float[Array, "*b m"]
    which: Int[Array, "*b m"]
    wxyz: Float[Array, "*b m 4"]
    omega_body: Float[Array, "*b m 3"]
    count: Int[Array, "*b"]


class Ending(NamedTuple):
    """The event that ended the motion of each body (...): its time [s], inf without one, and the
    sign of the time steps, 1 or -1, which is not known from samples at the event alone."""

    time: Array
    sign: Array


class NotRecordedError(ValueError, AttributeError):
    """Raised for a quantity that was not recorded; an AttributeError, so that ``hasattr`` works."""


def _recorded(trajectory: Any, name: str, request: str) -> Any:
    # A function, and not a method: Equinox builds an object for every method that is looked up.
    value = getattr(trajectory, f"_{name}")
    if value is None and trajectory._saved is not None and name in ("wxyz", "omega_body", "spins"):
        raise NotRecordedError(
            f"this trajectory has no {name}: it was not recorded, because"
            " ph.Record(save=fn) stores the values of a function in its place, traj.saved."
            f" Return trajectory.{name} from the function as well."
        )
    if value is None:
        raise NotRecordedError(
            f"this trajectory has no {name}, which ph.simulate records {request}."
        )
    return value


class Trajectory(eqx.Module):
    """Samples of the motion; leading axes (...) are the batch, then T times.

    **Attributes:** ``ts`` (T,) or (..., T) [s]; ``wxyz`` (..., T, 4) body -> space; ``omega_body``
    (..., T, 3) [rad/s]; ``status`` (...): ``ph.Status`` of each body; ``steps`` (...): steps of the
    solver (0 for a closed form), and ``step_counts``: what limited their size; ``scene``, with the
    wheel momenta of the initial state; ``propagator``: method and tolerance, for ``at``. On
    request: ``work``, ``motor_work``, ``error``, ``saved`` (see ``ph.Record``) and ``event_time``
    (``until=``). For wheels with a coupling: ``spins`` (..., T, k), their momenta. Access to a
    quantity that was not recorded raises an error, both AttributeError and ValueError, with the
    option that records it; ``hasattr(traj, "work")`` is then False.

    Use ``traj.at(t)`` for times between the samples. For indexing, a trajectory is an array of
    samples of shape (..., T): ``traj[i]`` is a body of a batch, ``traj[..., ::10]`` every tenth
    sample. A loop over a batch yields its bodies; their number is in ``traj.batch_shape``.
    """

    ts: Float[Array, "*t"]
    _wxyz: Float[Array, "*b t 4"] | None
    _omega_body: Float[Array, "*b t 3"] | None
    status: Int[Array, "*b"]
    _steps: StepCounts
    scene: Scene
    _work: Float[Array, "*b t"] | None
    _error: Float[Array, "*b"] | None
    _motor_work: Float[Array, "*b t m"] | None
    _spins: Float[Array, "*b t k"] | None
    propagator: AbstractPropagator | None
    _ending: Ending | None
    _events: Events | None
    _saved: PyTree[Array]
    _final: tuple[Array | None, ...] | None

    def __init__(
        self,
        ts: Array,
        wxyz: Array | None,
        omega_body: Array | None,
        status: Array,
        steps: Array | StepCounts,
        scene: Scene,
        work: Array | None = None,
        error: Array | None = None,
        motor_work: Array | None = None,
        spins: Array | None = None,
        propagator: AbstractPropagator | None = None,
        ending: Ending | None = None,
        events: Events | None = None,
        saved: PyTree[Array] = None,
        final: tuple[Array | None, ...] | None = None,
    ):
        self.ts, self.status, self.scene = ts, status, scene
        self._steps = steps if isinstance(steps, StepCounts) else StepCounts.of(steps)
        self._wxyz, self._omega_body = wxyz, omega_body
        self._work, self._error, self._motor_work = work, error, motor_work
        self._spins, self.propagator, self._ending = spins, propagator, ending
        self._events, self._saved, self._final = events, saved, final

    def __str__(self) -> str:
        """Size, status and steps, for ``print``; under ``jit`` the shapes of all arrays."""
        if not is_concrete(self.ts, self.status, self.steps):
            return repr(self)
        shape, times = self.batch_shape, np.asarray(self.ts)
        bodies = "1 body" if shape == () else f"{' x '.join(f'{n:,}' for n in shape)} bodies"
        count = times.shape[-1]
        lines = [f"{bodies} x {count:,} {'sample' if count == 1 else 'samples'}, {times.dtype}"]
        if times.size:
            lines.append(f"times   {times[..., 0].min():g} to {times[..., -1].max():g} s")
        values, numbers = np.unique(np.asarray(self.status), return_counts=True)
        outcomes = (f"{n:,} {Status(int(v)).name}" for v, n in zip(values, numbers))
        lines.append(f"status  {', '.join(outcomes)}")
        steps = np.asarray(self.steps)
        if steps.size and steps.max() > 0:
            lines.append(f"steps   {_spread(steps)}")
            names = ("refused", "ended at a switch or event", "ended at a saved time")
            names += ("limited by stability",)
            for name, counts in zip(names, map(np.asarray, self._steps[1:])):
                if counts.max() > 0:
                    lines.append(f"        {name}: {_spread(counts)}")
        elif steps.size:
            lines.append("steps   none: a closed form")
        return "\n".join(lines)

    def _with_samples(
        self,
        ts: Array,
        samples: Sequence[Array],
        status: Array,
        steps: StepCounts,
        ending: Ending | None,
        events: Events | None = None,
    ) -> "Trajectory":
        """The same motion with other samples: attitude, rates, momenta of coupled wheels."""
        wxyz, omega, *spins = samples
        return Trajectory(
            ts,
            wxyz,
            omega,
            status,
            steps,
            self.scene,
            spins=spins[0] if spins else None,
            propagator=self.propagator,
            ending=ending,
            events=events,
        )

    @property
    def wxyz(self) -> Float[Array, "*b t 4"]:
        """Attitudes (..., T, 4), body -> space, scalar first."""
        return _recorded(self, "wxyz", "with record=ph.Record(attitude=True), the default")

    @property
    def omega_body(self) -> Float[Array, "*b t 3"]:
        """Body rates (..., T, 3) [rad/s]."""
        return _recorded(self, "omega_body", "with record=ph.Record(rates=True), the default")

    @property
    def steps(self) -> Int[Array, "*b"]:
        """Steps (...) of the solver; 0 for a closed form."""
        return self._steps.accepted

    @property
    def step_counts(self) -> StepCounts:
        """Numbers of steps (...) of each body, in total and by what limited their size.

        Many rejected steps: the motion changes abruptly. At switches: a torque switches often;
        smooth it, or widen its limit. At saved times: save fewer. Limited by stability: a mode
        decays fast; weaken it, or use an implicit solver. Closed forms: 0.
        """
        return self._steps

    @property
    def work(self) -> Float[Array, "*b t"]:
        """Work (..., T) [J] done on the body and its wheels since the first time.

        It includes external torques, time-dependent potentials (also by orbits) and the motors of
        wheels, so that ``energy - work`` is constant.
        """
        return _recorded(self, "work", "with record=ph.Record(work=True)")

    @property
    def error(self) -> Float[Array, "*b"]:
        """Estimated error (...) [rad] of the attitude at the last time.

        Without attitudes it is the relative error of the rates.
        """
        return _recorded(self, "error", "with record=ph.Record(error=True)")

    @property
    def motor_work(self) -> Float[Array, "*b t m"]:
        """The part (..., T, m) [J] of ``work`` due to motor and friction of each wheel."""
        return _recorded(
            self, "motor_work", "with record=ph.Record(work=True) and wheels that turn"
        )

    @property
    def spins(self) -> Float[Array, "*b t k"]:
        """Momenta (..., T, k) [kg m^2/s] of the k wheels with a coupling, in their order.

        Each is along the axis of its wheel and includes the rotation of the body.
        """
        return _recorded(self, "spins", "only where a wheel has a coupling")

    @property
    def event_time(self) -> Float[Array, "*b"]:
        """Time (...) [s] of the event that ended the motion; inf for a body without one."""
        return _recorded(self, "event_time", "with until=ph.Event(...)")

    @property
    def _event_time(self) -> Array | None:
        return None if self._ending is None else self._ending.time

    @property
    def events(self) -> Events:
        """The events of each body; see ``Events``."""
        return _recorded(self, "events", "with events=[ph.Event(...)]")

    @property
    def saved(self) -> PyTree[Array]:
        """Values of the function of ``ph.Record(save=fn)``; leaves (..., T, *k)."""
        return _recorded(self, "saved", "with record=ph.Record(save=fn)")

    def at(self, t: Float[ArrayLike, "*#b k"]) -> "Trajectory":
        """The trajectory of the same bodies at other times ``t`` [s].

        ``t``: (K,) shared by all bodies, or (..., K) with one row for each; a number counts as
        (1,). The times may be in any order, also outside the simulated span; beyond the
        ``event_time`` of a body its times and samples are those of the event. Differentiable with
        respect to ``t``, the initial state and the numbers of the scene; works under ``jit`` and
        ``vmap``. Closed forms are evaluated at ``t``; an integrated motion is continued from the
        nearest sample with ``rtol``, which takes a few steps for each time. A time that is not
        finite gives NaN. ``work``, ``motor_work`` and ``error`` are not available.

        Raises ValueError where attitude or rates were not recorded, SimulationError as
        ``ph.simulate`` does.

            traj = ph.simulate(scene, state, [0.0, 10.0])
            traj.at(jnp.linspace(0, 10, 501)).energy
        """
        _ = self.wxyz, self.omega_body  # both must have been recorded
        if self.ts.shape[-1] == 0:
            raise ValueError("this trajectory has no samples from which a motion can continue.")
        if self.propagator is None:
            raise ValueError(
                "this trajectory was made by hand, without a method to move it by: use one that"
                " ph.simulate returns."
            )
        return self.propagator.at(self, t)

    def state_at(self, t: Float[ArrayLike, "*#b"]) -> State:
        """The state (...) at one time ``t`` [s], () or one for each body; see ``at``."""
        return self.at(jnp.asarray(t)[..., None]).last

    @property
    def first(self) -> State:
        """The state (...) at the first sample."""
        return self._state(0)

    @property
    def last(self) -> State:
        """The state (...) at the last sample, from which another simulation can continue.

        It contains attitude and rates and, if the scene has wheels without a prescribed speed, the
        speeds of all wheels.
        """
        return self._state(-1)

    def _state(self, place: int) -> State:
        if self._final is not None and place == -1:
            return self._last_sample._state(-1)
        wxyz, omega = _sample(self.wxyz, self.omega_body, place)
        wheels = self.scene.rotors
        if not isinstance(wheels, Wheels) or wheels.is_constant:
            return State.of_samples(wxyz, omega)
        return State.of_samples(wxyz, omega, _speeds(self._without_records, place))

    @property
    def _last_sample(self) -> "Trajectory":
        """The last sample of a trajectory that does not store states."""
        assert self._final is not None
        wxyz, omega, spins = (None if x is None else x[..., None, :] for x in self._final)
        return Trajectory(
            self.ts[..., -1:], wxyz, omega, self.status, self._steps, self.scene, spins=spins
        )

    def __getitem__(self, key: Any) -> "Trajectory":
        """Bodies and samples, indexed as an array of shape (..., T), body axes first.

        Integers, slices, ``...``, arrays of integers or booleans. ``traj[3]`` is the fourth body
        (without a batch the fourth sample); ``traj[3, ::10]``, ``traj[..., -1]``: bodies first,
        then times. The time axis is preserved: an integer there selects a single sample.
        """
        bodies, times = split_key(key, len(self.batch_shape))
        shape = self.batch_shape
        check_key(bodies, shape, "bodies")
        check_key(times, self.ts.shape[-1:], "samples")
        times = (jnp.asarray(times)[None],) if is_integer(times) else (times,)

        def of_bodies(x, rank):
            if x is None or (lead := x.shape[: x.ndim - rank]) == ():
                return x
            expanded = jnp.broadcast_to(
                x.reshape((1,) * (len(shape) - len(lead)) + x.shape),
                (*shape, *x.shape[x.ndim - rank :]),
            )
            return expanded[bodies] if bodies else expanded

        def of_both(x, rank):
            entries = of_bodies(x, rank)
            if entries is None:
                return None
            return entries[(..., *times, *(slice(None),) * (rank - 1))]

        parts = {name: map_arrays(getattr(self.scene, name), of_bodies) for name in PARTS}
        final = None
        if self._final is not None and ends_at_last(times):
            final = tuple(of_bodies(x, 1) for x in self._final)
        return Trajectory(
            of_both(self.ts, 1),
            of_both(self._wxyz, 2),
            of_both(self._omega_body, 2),
            of_bodies(self.status, 0),
            jax.tree.map(lambda x: of_bodies(x, 0), self._steps),
            Scene(**parts),
            of_both(self._work, 1),
            of_bodies(self._error, 0),
            of_both(self._motor_work, 2),
            of_both(self._spins, 2),
            self.propagator,
            jax.tree.map(lambda x: of_bodies(x, 0), self._ending),
            None
            if self._events is None
            else Events(
                *(of_bodies(x, r) for x, r in zip(jax.tree.leaves(self._events), (1, 1, 2, 2, 0)))
            ),
            jax.tree.map(lambda x: of_both(x, x.ndim - len(shape)), self._saved),
            final,
        )

    def between(self, start: float, end: float) -> "Trajectory":
        """The samples from ``start`` to ``end`` [s], both included, if all bodies share the times.

        Not for use under ``jit``, where the number of samples must be static: use ``at``, or a
        slice. Raises ValueError for an empty interval, and if bodies have different times.
        """
        if not is_concrete(self.ts) or self.ts.ndim != 1:
            raise ValueError(
                "between needs one row of known times: use traj.at(times), or a slice such as"
                " traj[..., 10:20]."
            )
        ts = np.asarray(self.ts)
        (places,) = np.nonzero((ts >= min(start, end)) & (ts <= max(start, end)))
        if not places.size:
            raise ValueError(
                f"no sample lies between {start} and {end}; they run from {ts[0]} to {ts[-1]}:"
                " for times between samples use traj.at(times)."
            )
        first, last = int(places[0]), int(places[-1])
        is_contiguous = last - first + 1 == places.size  # False for some unsorted times
        return self[..., slice(first, last + 1) if is_contiguous else places]

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading axes."""
        return self.status.shape

    @property
    def successful(self) -> Array:
        """Whether each body finished: booleans (...)."""
        return self.status == Status.SUCCESSFUL

    def _compiled(self, of: Callable[["Trajectory"], Any]) -> Any:
        """``of(self)`` in one compiled program, independent of further records such as ``work``."""
        return _derived(of, self._without_records)

    @property
    def _without_records(self) -> "Trajectory":
        """The samples and the scene, without other records."""
        return Trajectory(
            self.ts,
            self._wxyz,
            self._omega_body,
            self.status,
            self._steps,
            self.scene,
            spins=self._spins,
        )

    @property
    def _samples(self) -> list[Array]:
        """Attitude, rates and momenta of coupled wheels (..., T, n), those that were recorded."""
        return [x for x in (self._wxyz, self._omega_body, self._spins) if x is not None]

    @property
    def _scene(self) -> Scene:
        """The scene with arrays shaped to broadcast against samples (..., T)."""
        rank = len(self.batch_shape)
        parts = {name: along_time(getattr(self.scene, name), rank) for name in PARTS}
        spins = () if self._spins is None else tuple(jnp.moveaxis(self._spins, -1, 0))
        return Scene(**parts).with_spins(spins)

    @property
    def _t(self) -> Array:
        return self.ts.reshape((1,) * (len(self.batch_shape) + 1 - self.ts.ndim) + self.ts.shape)

    @property
    def momentum_body(self) -> Float[Array, "*b t 3"]:
        """Angular momentum (..., T, 3) in body axes, rotors included [kg m^2/s]."""
        _ = self.omega_body  # must have been recorded
        return self._compiled(_momentum_body)

    @property
    def momentum_space(self) -> Float[Array, "*b t 3"]:
        """Angular momentum (..., T, 3) in space axes [kg m^2/s]."""
        return rotation.rotate(self.wxyz, self.momentum_body)

    @property
    def omega_space(self) -> Float[Array, "*b t 3"]:
        """Angular velocity (..., T, 3) in space axes [rad/s]."""
        return rotation.rotate(self.wxyz, self.omega_body)

    @property
    def wheel_speed(self) -> Float[Array, "*b t m"]:
        """Speed of each wheel relative to the body (..., T, m) [rad/s].

        NaN for a wheel of prescribed momentum without an inertia. Raises ValueError for a scene
        without wheels.
        """
        wheels = self._scene.rotors
        if not isinstance(wheels, Wheels):
            raise NotRecordedError("this trajectory has no wheel_speed: its scene has no wheels.")
        omega = components(self.omega_body)
        speeds = [wheels.speed(i, self._t, omega) for i in range(len(wheels.is_held))]
        shape = omega[0].shape
        return jnp.stack([jnp.broadcast_to(x, shape) for x in speeds], axis=-1)

    @property
    def energy(self) -> Float[Array, "*b t"]:
        """Kinetic plus potential energy (..., T) [J]: the Hamiltonian at every sample.

        It includes the spin energy of wheels that spin freely or are driven by a motor. For wheels
        of prescribed speed it is the energy of the body with the wheels locked, which is constant
        then. It changes only by ``work`` (and by potentials that are discontinuous in time).
        """
        _ = self.omega_body  # must have been recorded
        if self.scene.potential is not None:
            _ = self.wxyz
        return self._compiled(_energy)

    def euler(
        self, sequence: rotation.Sequence | str = rotation.Sequence.ZYZ
    ) -> tuple[Array, Array, Array]:
        """Euler angles [rad], each (..., T): by default ZYZ (phi, theta, psi).

        ``sequence``: a ``rotation.Sequence``, or its axes in SciPy's notation: ``"ZYX"`` for
        successive rotations about body axes (yaw, pitch, roll), ``"zyx"`` about space axes. Angles
        are in the order of the axes. Raises ValueError for other letters.
        """
        return rotation.wxyz_to_euler(self.wxyz, sequence)

    def to_scipy(self) -> "Rotation":
        """The attitudes, body -> space, as one SciPy ``Rotation`` of all samples.

        In the order of ``wxyz`` with its leading axes flattened. Conversely, ``ph.State`` accepts a
        ``Rotation`` in place of a quaternion. Not under ``jit``. Raises ValueError if attitudes are
        NaN, as those of bodies that did not finish.
        """
        return scipy_rotation(self.wxyz)

    def to_xarray(self, labels: Sequence[str] | None = None) -> Any:
        """An ``xarray.Dataset`` with named dimensions, units and attributes (needs xarray).

        It contains all records: states and derived quantities, ``saved`` (arrays of a dictionary as
        ``saved_<key>``), ``event_time`` and, as ``events_<field>``, ``events``. ``labels``: names
        of the bodies of a batch with one axis, for the coordinate ``body``.
        """
        return dataset(self, labels)

    def to_aem(self, path: str | Path, epoch: str, **fields: Any) -> None:
        """Write the attitudes as a CCSDS attitude ephemeris message (504.0-B-2), a text file.

        **Arguments:** ``path``; ``epoch``: calendar time at which ``ts`` is zero, such as
        ``"2029-04-13T21:46:00"``; fields of the message: ``object_name`` and ``object_id``
        (required; for a batch one for each body), ``frame`` ("EME2000": the space frame),
        ``body_frame`` ("SC_BODY_1"), ``time_system`` ("TAI"), ``originator`` ("POLHODE"),
        ``center_name`` (None), ``rates`` (True: body rates too), ``creation_date`` (now).

        One segment per body, by increasing time. Times are ``epoch`` plus seconds without leap
        seconds: do not use ``time_system="UTC"`` across one. Raises ValueError or TypeError for
        fields that the standard does not allow, FileNotFoundError for a missing folder.
        """
        write_aem(path, self, epoch, **fields)


def _spread(counts: np.ndarray) -> str:
    """The median of the bodies' counts, and their range, as text."""
    minimum, median, maximum = counts.min(), np.median(counts), counts.max()
    return f"{median:,.0f}" + (
        "" if minimum == maximum else f", at least {minimum:,}, at most {maximum:,}"
    )


def _momentum_body(trajectory: Trajectory) -> Array:
    return trajectory._scene.momentum(trajectory.omega_body, trajectory._t)


def _energy(trajectory: Trajectory) -> Array:
    scene, attitude = trajectory._scene, None
    if scene.potential is not None:
        attitude = from_quaternion(jnp.unstack(trajectory.wxyz, axis=-1))
    return scene.hamiltonian.total(components(_momentum_body(trajectory)), attitude, trajectory._t)
