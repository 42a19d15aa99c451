"""Export of trajectories: SciPy, xarray, and CCSDS attitude ephemeris messages."""

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from polhode import __version__, rotation
from polhode._atomic import atomic_write
from polhode._checks import require
from polhode._extras import imported
from polhode._method import Status
from polhode._scene import Wheels

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation


def scipy_rotation(wxyz: Any) -> "Rotation":
    """Attitudes as a SciPy ``Rotation``; ValueError for NaN, which SciPy rejects."""
    missing = int(np.sum(np.isnan(np.asarray(wxyz)[..., 0])))
    require(
        missing == 0,
        f"{missing} attitudes are NaN, those of bodies that did not finish (see status): take the"
        " others, rotation.wxyz_to_scipy(traj.wxyz[traj.status == 0]).",
    )
    return rotation.wxyz_to_scipy(wxyz)


def dataset(trajectory: Any, labels: Sequence[str] | None) -> Any:
    """See ``Trajectory.to_xarray``."""
    xarray = imported("to_xarray", "xarray")
    rank, wxyz, omega = len(trajectory.batch_shape), trajectory._wxyz, trajectory._omega_body
    batch = ("body",) if rank == 1 else tuple(f"batch_{i}" for i in range(rank))
    shared = trajectory.ts.ndim == 1
    time = ("time",) if shared else (*batch, "time")
    sample_dims, vectors = (*batch, "time"), (*batch, "time", "axis")
    data: dict[str, Any] = {}

    def put(name, array, dims, units, long_name):
        if array is not None:
            data[name] = (dims, np.asarray(array), {"units": units, "long_name": long_name})

    quaternion = "attitude quaternion, scalar first, body to space"
    put("wxyz", wxyz, (*sample_dims, "quaternion"), "1", quaternion)
    put("omega_body", omega, vectors, "rad s-1", "angular velocity in body axes")
    if omega is not None and (trajectory.scene.potential is None or wxyz is not None):
        put("energy", trajectory.energy, sample_dims, "J", "kinetic plus potential energy")
    if omega is not None and wxyz is not None:
        momentum = "angular momentum in space axes"
        put("momentum_space", trajectory.momentum_space, vectors, "kg m2 s-1", momentum)
    put(
        "work",
        trajectory._work,
        sample_dims,
        "J",
        "work done from outside and by the motors of wheels",
    )
    if isinstance(trajectory.scene.rotors, Wheels):
        wheels = (*sample_dims, "wheel")
        if omega is not None:
            speed = "speed of each wheel relative to the body"
            put("wheel_speed", trajectory.wheel_speed, wheels, "rad s-1", speed)
        done = "part of the work done by motor and friction of each wheel"
        put("motor_work", trajectory._motor_work, wheels, "J", done)
    unit, error = "rad", "estimated error of the attitude at the last time"
    # with ``Record(save=)`` only the last attitude tells whether attitudes were computed
    last = (wxyz,) if trajectory._saved is None else trajectory._final
    if last is not None and last[0] is None:
        unit, error = "1", "estimated relative error of the rates at the last time"
    put("error", trajectory._error, batch, unit, error)
    put("event_time", trajectory._event_time, batch, "s", "time of the event that ended the motion")
    for path, values in jax.tree_util.tree_leaves_with_path(trajectory._saved):
        key = jax.tree_util.keystr(path, simple=True, separator="_")
        name = f"saved_{key}" if key else "saved"
        while name in data:  # equal names, such as of {"a_b": x, "a": {"b": y}}
            name += "_"
        axes = (f"{name}_{k}" for k in range(values.ndim - len(sample_dims)))
        source = {"long_name": "value of the function of ph.Record(save=...)"}
        data[name] = ((*sample_dims, *axes), np.asarray(values), source)
    if trajectory._events is not None:
        events, each = trajectory._events, (*batch, "event")
        put("events_time", events.times, each, "s", "times of the events in order, inf for none")
        put("events_which", events.which, each, "1", "index of the event function, -1 for none")
        put("events_wxyz", events.wxyz, (*each, "quaternion"), "1", f"{quaternion}, at the events")
        rates_there = "angular velocity in body axes at the events"
        put("events_omega_body", events.omega_body, (*each, "axis"), "rad s-1", rates_there)
        put("events_count", events.count, batch, "1", "number of events, also beyond those stored")
    data["status"] = (
        batch,
        np.asarray(trajectory.status, np.int8),
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
    if labels is not None:
        names = [str(label) for label in labels]
        if rank != 1 or len(names) != trajectory.batch_shape[0]:
            raise ValueError(
                f"labels name the bodies of one batch axis, got {len(names)} for bodies of shape"
                f" {trajectory.batch_shape}."
            )
        coords["body"] = ("body", names, {"long_name": "body"})
    # times of each body may lack batch axes of the other arrays, or have a length of 1 there
    sample_times = np.broadcast_to(
        np.asarray(trajectory.ts),
        (*(() if shared else trajectory.batch_shape), trajectory.ts.shape[-1]),
    )
    times = (time, sample_times, {"units": "s", "long_name": "time"})
    (coords if shared else data)["time" if shared else "ts"] = times
    attributes = {
        "Conventions": "CF-1.11",
        "title": "Rotating rigid bodies",
        "source": f"polhode {__version__}",
        "convention": "wxyz scalar first, body -> space; R = Rz(phi) Ry(theta) Rz(psi)",
    }
    return xarray.Dataset(data, coords=coords, attrs=attributes)


_TIME_SYSTEMS = (
    "GMST",
    "GPS",
    "MET",
    "MRT",
    "SCLK",
    "TAI",
    "TCB",
    "TCG",
    "TDB",
    "TT",
    "UT1",
    "UTC",
)
"""CCSDS 504.0-B-2, annex B: values of TIME_SYSTEM."""


def write_aem(
    path: str | Path,
    trajectory: Any,
    epoch: str,
    *,
    object_name: str | Sequence[str],
    object_id: str | Sequence[str],
    frame: str = "EME2000",
    body_frame: str = "SC_BODY_1",
    time_system: str = "TAI",
    originator: str = "POLHODE",
    center_name: str | None = None,
    rates: bool = True,
    creation_date: str | None = None,
) -> None:
    """See ``Trajectory.to_aem``. CCSDS 504.0-B-2, sections 4.2 to 4.4 and annex B."""
    start = _instant("epoch", epoch)
    current_time = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S")
    created = current_time if creation_date is None else creation_date
    _instant("creation_date", created)
    created = created.removesuffix("Z")
    if time_system not in _TIME_SYSTEMS:
        raise ValueError(f"time_system must be one of {', '.join(_TIME_SYSTEMS)}: {time_system!r}.")
    wxyz = np.asarray(trajectory.wxyz, np.float64)
    count, samples = int(np.prod(wxyz.shape[:-2], dtype=int)), wxyz.shape[-2]
    require(
        count > 0 and samples > 0,
        f"a message needs one body and one sample or more, got attitudes of shape {wxyz.shape}.",
    )
    names = _one_per_body("object_name", object_name, count)
    identities = _one_per_body("object_id", object_id, count)
    text_fields = {"originator": originator, "frame": frame, "body_frame": body_frame}
    for name, value in (
        text_fields | ({} if center_name is None else {"center_name": center_name})
    ).items():
        _text(name, value)
    omega = np.asarray(trajectory.omega_body, np.float64) if rates else wxyz[..., :0]
    ts = np.broadcast_to(np.asarray(trajectory.ts, np.float64), wxyz.shape[:-1])
    lines = ["CCSDS_AEM_VERS = 2.0", f"CREATION_DATE = {created}", f"ORIGINATOR = {originator}"]
    for k in range(count):
        t = ts.reshape(count, samples)[k]
        places = np.unique(t, return_index=True)[1]  # by increasing time, without repeated times
        moments = [_later(start, x) for x in t[places]]
        if len(set(moments)) < len(moments):
            raise ValueError(
                "times closer than a nanosecond cannot be written: keep fewer samples."
            )
        lines += ["", "META_START", f"OBJECT_NAME = {names[k]}", f"OBJECT_ID = {identities[k]}"]
        lines += [] if center_name is None else [f"CENTER_NAME = {center_name}"]
        lines += [
            f"REF_FRAME_A = {frame}",
            f"REF_FRAME_B = {body_frame}",
            f"TIME_SYSTEM = {time_system}",
            f"START_TIME = {moments[0]}",
            f"STOP_TIME = {moments[-1]}",
            f"ATTITUDE_TYPE = {'QUATERNION/ANGVEL' if rates else 'QUATERNION'}",
            *(["ANGVEL_FRAME = REF_FRAME_B"] if rates else []),
            "META_STOP",
            "",
            "DATA_START",
        ]
        rows = (
            wxyz.reshape(count, samples, 4)[k][places],
            omega.reshape(count, samples, -1)[k][places],
        )
        lines += [f"{m} {row}" for m, row in zip(moments, _rows(*rows))]
        lines.append("DATA_STOP")
    with atomic_write(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="ascii")


def _rows(wxyz: np.ndarray, omega: np.ndarray) -> Iterator[str]:
    """Rows Q1 Q2 Q3 QC of the transformation A to B (space to body components), rates in deg/s."""
    if not (np.isfinite(wxyz).all() and np.isfinite(omega).all()):
        raise ValueError(
            "the samples contain NaN: write only the bodies that finished, traj[traj.successful]."
        )
    xyzw = wxyz[:, [1, 2, 3, 0]]
    for row in np.concatenate([xyzw, np.rad2deg(omega)], axis=-1):
        yield " ".join(f"{x:.16e}" for x in row)


def _instant(name: str, value: Any) -> tuple[np.datetime64, int]:
    """A calendar time as whole seconds and nanoseconds, because ``datetime64`` in nanoseconds
    overflows silently outside the years 1678 to 2262."""
    pattern = r"(\d{4}-\d{2}-\d{2}T\d{2}:\d{2}:\d{2})(?:\.(\d{1,9}))?Z?"
    parts = re.fullmatch(pattern, value) if isinstance(value, str) else None
    if parts is None:
        raise ValueError(
            f'{name} must be a calendar time such as "2029-04-13T21:46:00", got {value!r:.60}.'
        )
    try:
        return np.datetime64(parts[1], "s"), int((parts[2] or "0").ljust(9, "0"))
    except ValueError as error:
        raise ValueError(f"{name}: there is no time {value}: {error}.") from None


def _later(start: tuple[np.datetime64, int], seconds: float) -> str:
    """The calendar time ``seconds`` after ``start``."""
    fraction, integer = math.modf(seconds)  # exact, unlike the seconds times 1e9
    nanoseconds = int(integer) * 10**9 + round(fraction * 1e9)
    whole, rest = divmod(start[1] + nanoseconds, 10**9)
    years = abs(whole) / 31_556_952
    text = "" if years > 10_000 else str(start[0] + np.timedelta64(whole, "s"))
    if not re.match(r"\d{4}-", text):
        raise ValueError(
            f"{seconds:.6g} s after {start[0]} is outside of the years 0 to 9999, which an attitude"
            " ephemeris message can hold."
        )
    return f"{text}.{rest:09d}"


def _one_per_body(name: str, value: Any, count: int) -> list[str]:
    values = [value] if isinstance(value, str) or not isinstance(value, Iterable) else list(value)
    if len(values) != count:
        raise ValueError(f"{name} must name each of {count} bodies, got {len(values)}.")
    return [_text(name, x) for x in values]


def _text(name: str, value: Any) -> str:
    """The value; TypeError or ValueError unless it is one line of printable ASCII (standard)."""
    if not isinstance(value, str) or not re.fullmatch(r"[!-~]([ -~]*[!-~])?", value):
        raise ValueError(f"{name} must be one line of printable ASCII, got {value!r:.60}.")
    return value
