"""``Fit``: the result of a fit, its uncertainty, and what the data do not show."""

import csv
import json
from collections.abc import Callable
from os import PathLike
from statistics import NormalDist
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from polhode._atomic import atomic_write
from polhode._checks import ArrayLike, require
from polhode._scene import Scene, State
from polhode.fit._determination import NullSpace
from polhode.fit._findings import (
    MODEL_FLAWS,
    SCALE_UNKNOWN,
    SCENE_WARNINGS,
    UNUSABLE,
    WARNINGS,
    Finding,
    FitError,
    Observability,
    shown_beside_prior,
    shown_of_gain,
)
from polhode.fit._model import LeafMotion, Parameters, entries_of, whole_of
from polhode.fit._residuals import Model
from polhode.inertia import Inertia


class InertiaEstimate(eqx.Module):
    """The inertia that a fit estimated; the properties of ``Fit`` document these fields."""

    inertia: Inertia
    moments: Float[Array, "*b 3"]
    axes: Float[Array, "*b 4"]
    ratios: Float[Array, "*b 3"]
    moments_std: Float[Array, "*b 3"]
    ratios_std: Float[Array, "*b 3"]
    axes_std: Float[Array, "*b 3"]
    scale_known: bool = eqx.field(static=True)
    handedness_known: bool = eqx.field(static=True)


class Fit(eqx.Module):
    """Result of every fit. Leading axes (...) are those of the bodies, none for a single body.

    **Fields** of every fit, r recordings of a body and p unknowns:

    - ``values``: list of the fitted arrays, and ``std`` their standard deviations (infinite for
      what the data do not show). For ``fit_scene`` these are the arrays that ``free`` listed; for
      an inertia the tensor (..., 3, 3) [kg m^2] in sensor axes and the unknowns of the motion
      (leaves of ``parameters.motion``: drag, delay).
    - ``sensor``, ``sensor_std``: the fitted ones of ``"gain"`` (..., 3, 3), ``"bias"`` (..., 3)
      [rad/s], ``"delay"`` (...) [s] and ``"mounting"`` (..., 3) [rad] of the gyroscope and
      ``"lever"`` (..., 3) [m] of the accelerometer.
    - ``initial``: ``ph.State`` (..., r) at the first time of each recording. Without recorded
      attitudes its attitude is the identity, or the ``attitude`` of ``fit_scene``.
    - ``covariance`` (..., p, p) of all unknowns: the tensor's entries xx, yy, zz, yz, zx, xy (three
      for ``MomentsOnly``, none of a scene), bias, mounting, lever, the motion's unknowns or the
      scene's values (of a tensor its six entries), gain (row by row) and delay, then of each
      recording rates and attitude (rotation vector) at its start and the walk of the bias. It is
      the pseudo-inverse of ``information`` (..., p, p), which includes the calibration, times
      ``noise**2`` where the level of the noise was estimated.
    - ``null_count`` (...): number of directions of the unknowns that the data do not show.
    - ``noise`` (...): standard deviation of the residuals over the assumed one (reduced chi); with
      a robust loss, of those within its threshold.
    - ``whiteness`` (...): probability of autocorrelations as large as observed, for independent
      residuals (Ljung-Box).
    - ``rms`` (...): root mean square of the residual rates [rad/s]; NaN without rates.
    - ``diagnostics`` (...): ``Finding`` flags as integers; ``findings``, ``warnings``, ``report``
      and ``is_usable`` explain them.
    - ``steps``, ``attempts`` (...): numbers of optimiser steps and of starting points tried.
    - ``residuals``: of ``"omega"``, ``"attitude"``, ``"force"`` (..., r, T, 3) over their noise.
    - ``parameters``, ``model``: arguments of ``predict``, ``residuals`` and ``log_density``.

    **Of an inertia** (``fit_inertia``, ``fit_recordings``): ``inertia``,
    ``moments``, ``axes``, ``ratios``, their standard deviations, ``scale_known``,
    ``principal_values``, ``interval``, ``mirror_inertia``. **Of a scene** (``fit_scene``):
    ``scene``. They raise AttributeError for fits of another kind.
    """

    values: list[Array]
    std: list[Array]
    sensor: dict[str, Array]
    sensor_std: dict[str, Array]
    initial: State
    information: Float[Array, "*b p p"]
    covariance: Float[Array, "*b p p"]
    null_count: Int[Array, "*b"]
    noise: Float[Array, "*b"]
    whiteness: Float[Array, "*b"]
    rms: Float[Array, "*b"]
    diagnostics: Int[Array, "*b"]
    steps: Int[Array, "*b"]
    attempts: Int[Array, "*b"]
    residuals: dict[str, Array]
    parameters: Parameters
    model: Model
    _null: NullSpace
    _inertia: InertiaEstimate | None = None

    def _of_inertia(self, name: str) -> InertiaEstimate:
        if self._inertia is None:
            raise AttributeError(
                f"a fit of a scene has no {name}: see values, std and scene, or scene.inertia; an"
                " inertia with its principal axes is fitted by fit_inertia or fit_recordings."
            )
        return self._inertia

    @property
    def inertia(self) -> Inertia:
        """Full tensor (...) in sensor axes about the centre of mass, reaction wheels locked.

        Where ``scale_known`` is False the data show only its shape: the largest moment is 1 (with a
        ``SceneMotion`` that has unknowns it is arbitrary, and their values refer to it).
        """
        return self._of_inertia("inertia").inertia

    @property
    def moments(self) -> Float[Array, "*b 3"]:
        """Principal moments of inertia (..., 3) [kg m^2], ascending."""
        return self._of_inertia("moments").moments

    @property
    def axes(self) -> Float[Array, "*b 4"]:
        """Principal axes: quaternions ``wxyz`` (..., 4), principal -> sensor axes."""
        return self._of_inertia("axes").axes

    @property
    def ratios(self) -> Float[Array, "*b 3"]:
        """Ratios (..., 3) of the moments to the largest."""
        return self._of_inertia("ratios").ratios

    @property
    def moments_std(self) -> Float[Array, "*b 3"]:
        """Standard deviations of ``moments``; infinite where the scale is not known."""
        return self._of_inertia("moments_std").moments_std

    @property
    def ratios_std(self) -> Float[Array, "*b 3"]:
        """Standard deviations of ``ratios``; infinite for what the data do not show."""
        return self._of_inertia("ratios_std").ratios_std

    @property
    def axes_std(self) -> Float[Array, "*b 3"]:
        """Standard deviations (..., 3) [rad] of rotations about each principal axis."""
        return self._of_inertia("axes_std").axes_std

    @property
    def scale_known(self) -> bool:
        """Whether the data show the absolute size of the inertia, not only ratios (static)."""
        return self._of_inertia("scale_known").scale_known

    @property
    def principal_values(self) -> tuple[Float[Array, "*b 3"], Float[Array, "*b 3"]]:
        """``moments`` if the scale is known, else ``ratios``, and their standard deviations."""
        body = self._of_inertia("principal_values")
        if body.scale_known:
            return body.moments, body.moments_std
        return body.ratios, body.ratios_std

    @property
    def mirror_inertia(self) -> Inertia:
        """The body with the same rates if the sensor axes are left-handed; largest moment 1.

        Reversing one rate (or exchanging two) changes the sign of ``omega x I omega`` and nothing
        else, which is the free motion of the body ``I Sigma`` with ``Sigma = tr(I)/2 - I``: the
        ratios ``I_k (I_i + I_j - I_k)``. It is as physical as the first, so free rates alone do not
        determine the handedness; attitudes, a wheel or knowledge of the body do.
        """
        body = self._of_inertia("mirror_inertia")
        return Inertia(diagonal=mirror_moments(body.moments)).turned(body.axes)

    @property
    def scene(self) -> Scene:
        """The scene with the fitted numbers and the leading axes (...) of the fit."""
        motion = self.model.motion
        if self._inertia is not None or not isinstance(motion, LeafMotion):
            raise AttributeError(
                "a fit of an inertia has no scene: make one of it, ph.Scene(fit.inertia, ...), or"
                " fit the numbers of a scene by fit_scene."
            )
        return motion.with_values(self.values)

    @property
    def is_usable(self) -> bool:
        """Whether every fit converged and is finite, and rates do not contradict attitudes.

        ``findings`` says what else is doubtful, such as residuals far above the noise (POOR).
        """
        return not bool((np.asarray(self.diagnostics) & int(UNUSABLE)).any())

    def derived(
        self, function: Callable[[list[Array]], ArrayLike], body: int = 0
    ) -> tuple[np.ndarray, np.ndarray]:
        """A function of the ``values`` of one body and its standard deviation.

        **Arguments:** ``function`` of the list ``values``, differentiable by JAX, with an array of
        any shape; ``body``: number in the flattened batch.

        By linear propagation of ``covariance``. The data may determine a function but not its
        arguments: where they do not show the common size of inertia and drag, the ratio of these
        has a finite deviation, ``fit.derived(lambda v: v[1] / v[0])``. The deviation is infinite
        for functions that the data do not determine.
        """
        lead = np.ndim(self.diagnostics)
        values = [jnp.reshape(x, (-1, *jnp.shape(x)[lead:]))[body] for x in self.values]
        counts = self._entry_counts
        # the unknowns are entries of a symmetric tensor, not its nine components
        unknowns = [x if n is None else entries_of(x, n) for x, n in zip(values, counts)]

        def of_unknowns(parts):
            return jnp.asarray(
                function([x if n is None else whole_of(x, n) for x, n in zip(parts, counts)])
            )

        value, slopes = of_unknowns(unknowns), jax.jacfwd(of_unknowns)(unknowns)
        slopes = [np.reshape(np.asarray(x), (value.size, -1)) for x in slopes]
        skipped = self._count("bias", "mounting", "lever")
        covariance, null = jax.tree.map(
            lambda x: np.reshape(x, (-1, *np.shape(x)[lead:]))[body], (self.covariance, self._null)
        )
        # in the order of the covariance: entries, sensors, then the motion's values
        full_derivative = np.zeros((value.size, covariance.shape[0]))
        position = 0
        for k, slope in enumerate(slopes):
            position += skipped if k == int(self._inertia is not None) else 0
            full_derivative[:, position : position + slope.shape[1]] = slope
            position += slope.shape[1]
        std = np.sqrt(
            np.maximum(np.einsum("ij,jk,ik->i", full_derivative, covariance, full_derivative), 0)
        )
        std = np.where(null.undetermines(full_derivative), np.inf, std)
        return np.asarray(value), std.reshape(value.shape)

    @property
    def _entry_counts(self) -> list[int | None]:
        """Number of unknown entries of each symmetric tensor of ``values``, None for the others."""
        if self._inertia is not None:
            return [self.model.entries, *[None] * (len(self.values) - 1)]
        return self.model.motion.entry_counts

    @property
    def value_names(self) -> list[str]:
        """Names of ``values``: paths in the scene, or ``"inertia"`` and the motion's unknowns."""
        motion = self.model.motion
        if self._inertia is None and isinstance(motion, LeafMotion):
            paths = [path for path, _ in jax.tree_util.tree_flatten_with_path(motion.scene)[0]]
            paths = [paths[k] for k in motion.places]
        else:
            paths = [
                path for path, _ in jax.tree_util.tree_flatten_with_path(self.parameters.motion)[0]
            ]
        texts = (jax.tree_util.keystr(path, simple=True, separator=".") for path in paths)
        names = [text or "unknown" for text in texts]  # empty if the unknown is a single array
        if self._inertia is None:
            return names
        return ["inertia", *("motion.inertia" if x == "inertia" else x for x in names)]

    def common_scale(self, body: int = 0) -> list[tuple[str, np.ndarray, np.ndarray]]:
        """Ratios of ``values`` where the data determine some of them only up to a common factor.

        Of these values: names, ratios to the largest and standard deviations of the ratios. Empty
        where the data determine the values themselves, or not even their ratios.
        """
        lead = np.ndim(self.diagnostics)
        values = [np.asarray(x).reshape(-1, *np.shape(x)[lead:])[body] for x in self.values]
        spread = [np.asarray(x).reshape(-1, *np.shape(x)[lead:])[body] for x in self.std]
        unknown = [k for k, std in enumerate(spread) if std.size and not np.any(np.isfinite(std))]
        if self._inertia is not None or not unknown:
            return []
        k = max(unknown, key=lambda k: np.abs(values[k]).max())
        place = np.unravel_index(np.argmax(np.abs(values[k])), values[k].shape)
        rows = []
        for j in unknown:
            ratio, std = self.derived(lambda v, j=j: v[j] / v[k][place], body)
            if j == k:
                std[place] = 0  # the ratio of the largest value to itself is exactly 1
            if not np.all(np.isfinite(std)):
                return []
            rows.append((self.value_names[j], ratio, std))
        return rows if sum(ratio.size for _, ratio, _ in rows) > 1 else []

    def limit(self, body: int = 0) -> str:
        """What limits the result of one body, in one sentence."""
        flaws = [flag for flag in self._flags(body) if flag & MODEL_FLAWS]
        if flaws:
            words = ", ".join(str(flag.name).lower().replace("_", " ") for flag in flaws)
            return f"the model, which does not explain the readings ({words})"
        if self._inertia is not None:
            std = np.asarray(self.ratios_std).reshape(-1, 3)[body, :2]
        else:
            lead = np.ndim(self.diagnostics)
            std = np.concatenate(
                [np.asarray(x).reshape(-1, *np.shape(x)[lead:])[body].reshape(-1) for x in self.std]
            )
        if not np.all(np.isfinite(std)):
            return "the motion, which does not show all unknowns: record another spin"
        if any("prior" in row.source and row.shown < row.count for row in self.observability(body)):
            return "the prior, which alone states some of the values: record another motion"
        part = self._calibration_part(body)
        if part > 0.5:
            return (
                f"the calibration of the gyroscope ({part:.0%} of the variance): a better one"
                " helps, more samples of this kind do not"
            )
        return "the noise of the readings: more samples, or faster rotation, help"

    def _count(self, *names: str) -> int:
        """Number of unknowns of one body in these fields of ``parameters``."""
        leaves = [x for name in names for x in jax.tree.leaves(getattr(self.parameters, name))]
        return sum(int(np.prod(np.shape(x)[np.ndim(self.diagnostics) :])) for x in leaves)

    def _calibration_part(self, body: int) -> float:
        """The largest part of the variance of a value that an exact calibration would remove."""
        entry_count = self.model.entries
        if self.parameters.gain is None:
            return 0.0
        start = entry_count + self._count("bias", "mounting", "lever")
        motion_end = start + self._count("motion")
        matrix = np.asarray(self.covariance)
        matrix = matrix.reshape(-1, *matrix.shape[-2:])[body]
        value_places = (
            np.arange(entry_count) if self._inertia is not None else np.arange(start, motion_end)
        )
        gain = np.arange(motion_end, motion_end + 9)
        gain = gain[np.diagonal(matrix)[gain] > 0]
        if not gain.size or not value_places.size:
            return 0.0
        side = matrix[np.ix_(value_places, gain)]
        removed = side @ np.linalg.pinv(matrix[np.ix_(gain, gain)], hermitian=True) @ side.T
        total = np.diagonal(matrix)[value_places]
        return float(np.max(np.diagonal(removed) / np.where(total > 0, total, np.inf)))

    def to_dict(self, body: int = 0) -> dict[str, Any]:
        """The result of one body as numbers, lists and strings, ready for JSON.

        ``values`` and ``std`` by their names (``value_names``), the sensor, the initial states, the
        covariance, and what ``report`` shows; of an inertia its principal moments and axes as well.
        Units are SI. None stands for a number that is not finite, such as the standard deviation of
        an undetermined value.
        """
        lead = np.ndim(self.diagnostics)

        def as_list(value):
            value = np.asarray(value)
            value = value.reshape(-1, *value.shape[lead:])[body]
            return np.asarray(np.where(np.isfinite(value), value, None)).tolist()

        names = self.value_names
        out = {
            "kind": "scene" if self._inertia is None else "inertia",
            "values": {k: as_list(x) for k, x in zip(names, self.values, strict=True)},
            "std": {k: as_list(x) for k, x in zip(names, self.std, strict=True)},
            "sensor": {k: as_list(x) for k, x in self.sensor.items()},
            "sensor_std": {k: as_list(x) for k, x in self.sensor_std.items()},
            "initial_wxyz": as_list(self.initial.wxyz),
            "initial_omega_body": as_list(self.initial.omega_body),
            "covariance": as_list(self.covariance),
            "null_count": as_list(self.null_count),
            "noise": as_list(self.noise),
            "whiteness": as_list(self.whiteness),
            "rms": as_list(self.rms),
            "steps": as_list(self.steps),
            "findings": self.findings(body),
            "warnings": self.warnings(body),
            "limit": self.limit(body),
            "observability": [row._asdict() for row in self.observability(body)],
            "common_scale": {
                name: [ratio.tolist(), std.tolist()] for name, ratio, std in self.common_scale(body)
            },
        }
        if self._inertia is not None:
            low, high = self.interval()
            out |= {
                "scale_known": self.scale_known,
                "moments": as_list(self.moments),
                "moments_std": as_list(self.moments_std),
                "ratios": as_list(self.ratios),
                "ratios_std": as_list(self.ratios_std),
                "interval_95": [as_list(low), as_list(high)],
                "axes_wxyz": as_list(self.axes),
                "axes_std": as_list(self.axes_std),
            }
        return out

    def to_json(self, path: str | PathLike[str]) -> None:
        """Write ``to_dict`` of every body: one object, or a list of them for a batch."""
        bodies = [self.to_dict(k) for k in range(np.size(self.diagnostics))]
        content = bodies if np.ndim(self.diagnostics) else bodies[0]
        text = json.dumps(content, indent=1, allow_nan=False) + "\n"
        with atomic_write(path) as temporary:
            temporary.write_text(text, encoding="utf-8")

    def to_csv(self, path: str | PathLike[str]) -> None:
        """Write a row for every fitted number: body, name, component, value, standard deviation.

        A standard deviation that is not finite is an empty cell.
        """
        lead = np.ndim(self.diagnostics)
        pairs = [
            *zip(self.value_names, self.values, self.std, strict=True),
            *((name, x, self.sensor_std[name]) for name, x in self.sensor.items()),
        ]
        if self._inertia is not None:
            pairs += [
                ("moments", self.moments, self.moments_std),
                ("ratios", self.ratios, self.ratios_std),
            ]
        with (
            atomic_write(path) as temporary,
            temporary.open("w", newline="", encoding="utf-8") as file,
        ):
            writer = csv.writer(file)
            writer.writerow(["body", "name", "component", "value", "std"])
            for body in range(np.size(self.diagnostics)):
                for name, value, std in pairs:
                    value, std = (
                        np.asarray(x).reshape(-1, *np.shape(x)[lead:])[body] for x in (value, std)
                    )
                    for place in np.ndindex(value.shape):
                        spread = repr(float(std[place])) if np.isfinite(std[place]) else ""
                        component = " ".join(map(str, place))
                        writer.writerow([body, name, component, repr(float(value[place])), spread])

    def interval(self, level: float = 0.95) -> tuple[Float[Array, "*b 3"], Float[Array, "*b 3"]]:
        """Ends (..., 3) of confidence intervals of ``principal_values``; 0 < ``level`` < 1."""
        value, spread = self.principal_values
        require(0 < level < 1, f"level must lie between 0 and 1, got {level!r}: 0.95 for 95 %.")
        reach = NormalDist().inv_cdf(0.5 + float(level) / 2) * spread
        return value - reach, value + reach

    def findings(self, body: int = 0) -> list[str]:
        """Names of the diagnostics of one body, in plain words."""
        return [str(flag.name).lower().replace("_", " ") for flag in self._flags(body)]

    def warnings(self, body: int = 0) -> list[str]:
        """What to know before using the fit of one body: sentences with cause and remedy."""
        about = []
        if self._inertia is not None and not self._inertia.scale_known:
            about.append(SCALE_UNKNOWN)
            if not self._inertia.handedness_known:
                twin = np.sort(mirror_moments(np.asarray(self.moments).reshape(-1, 3)[body]))
                about.append(
                    "free rates do not show the handedness of the axes: with one axis inverted the "
                    f"same data give the ratios {twin[0]:.4f} : {twin[1]:.4f} : 1; compare with "
                    "what you know of the body"
                )
        texts = self._texts()
        return about + [texts[flag] for flag in self._flags(body)]

    def observability(self, body: int = 0) -> list[Observability]:
        """What the recordings of one body can show, and what would show the rest."""
        rows = []
        gained = self._calibration_shown(body)
        data_source = "data" if gained is None else "data and calibration"
        if self._inertia is not None:
            spread = np.asarray(self.ratios_std).reshape(-1, 3)[body, :2]
            shown_count = int(np.isfinite(spread).sum())
            source = data_source if shown_count else "nothing"
            remedy = "" if shown_count == 2 else "another spin, away from the principal axes"
            rows.append(Observability("ratios of the moments (2)", 2, shown_count, source, remedy))
            size = int(self.scale_known)
            remedy = "" if size else "a wheel of known spin inertia, a known torque or moment"
            source = data_source if size else "nothing"
            rows.append(Observability("size of the inertia", 1, size, source, remedy))
            if not (self.scale_known or self._inertia.handedness_known):
                remedy = "attitudes (wxyz), a wheel, or knowledge of the body"
                rows.append(Observability("handedness of the axes", 1, 0, "nothing", remedy))
        else:
            for k, (spread, entries) in enumerate(zip(self.std, self._entry_counts)):
                flat = np.asarray(spread).reshape(max(np.size(self.diagnostics), 1), -1)[body]
                flat = flat if entries is None else np.asarray(entries_of(flat.reshape(3, 3)))
                has_prior = self._prior_std[k] is not None
                shown_count = int(np.isfinite(flat).sum())
                if has_prior:
                    shown_count = self._count_shown_beside_prior(k, body)
                remedy = "" if shown_count == flat.size else "another motion, or fewer free numbers"
                sources = [data_source] * (shown_count > 0) + ["prior"] * has_prior
                source = " and ".join(sources) or "nothing"
                name = f"{self.value_names[k]} ({flat.size})"
                rows.append(Observability(name, flat.size, shown_count, source, remedy))
        for name, count, shown_count in gained or []:
            source = ("calibration", "data and calibration", "data")[
                int(shown_count > 0) + int(shown_count == count)
            ]
            remedy = "" if shown_count == count else "attitudes (wxyz), or rates of a rate table"
            rows.append(Observability(f"{name} ({count})", count, shown_count, source, remedy))
        return rows

    @property
    def _prior_std(self) -> list[Array | None]:
        """Standard deviations of the priors of a scene's ``values``; None without a prior."""
        return self.model.motion.prior_std()

    def _count_shown_beside_prior(self, k: int, body: int) -> int:
        """``shown_beside_prior`` of a value of one body."""
        lead = np.ndim(self.diagnostics)
        sizes = [int(np.prod(np.shape(x)[lead:])) for x in self.parameters.motion]
        first = self._count("bias", "mounting", "lever") + sum(sizes[:k])
        place = slice(first, first + sizes[k])
        covariance = np.asarray(self.covariance)
        block = covariance.reshape(-1, *covariance.shape[-2:])[body][place, place]
        widths = np.asarray(self._prior_std[k]).reshape(-1, sizes[k])
        width = widths[min(body, len(widths) - 1)]
        return shown_beside_prior(block, width)

    def _calibration_shown(self, body: int) -> list[tuple[str, int, int]] | None:
        """``shown_of_gain`` of the gyroscope; None where its gain is not fitted."""
        if self.parameters.gain is None:
            return None
        count = self.model.entries + self._count("bias", "mounting", "lever", "motion")
        covariance = np.asarray(self.covariance)
        covariance = covariance.reshape(-1, *covariance.shape[-2:])[body]
        block = covariance[count : count + 9, count : count + 9]
        return shown_of_gain(block, self.model.gyroscope.gain_std)

    def report(self, body: int | None = None) -> str:
        """A short text on one body, or on all (None): values, uncertainty and warnings."""
        count = np.asarray(self.diagnostics).size
        bodies = range(count) if body is None else [body]
        lines = []
        if self._inertia is not None and not self._inertia.scale_known:
            lines.append(SCALE_UNKNOWN)
        for k in bodies:
            lines += self._value_lines(k) if self._inertia is None else [self._inertia_line(k)]
            lines += [f"  - {text}" for text in self.warnings(k) if text != SCALE_UNKNOWN]
            if body is not None or count == 1:
                lines.append("  what this recording can show:")
                for row in self.observability(k):
                    remedy = f"; would be shown by {row.remedy}" if row.remedy else ""
                    lines.append(f"    {row.quantity}: {row.source}{remedy}")
        return "\n".join(lines)

    def _inertia_line(self, body: int) -> str:
        ratios, spread, moments = (
            np.asarray(x).reshape(-1, 3)[body] for x in (self.ratios, self.ratios_std, self.moments)
        )
        rms, noise = (np.asarray(x).reshape(-1)[body] for x in (self.rms, self.noise))
        ratio_text = " : ".join(f"{r:.4f}({s:.1g})" for r, s in zip(ratios, spread))
        size = f"; moments {moments} kg m^2" if self.scale_known else ""
        return f"body {body}: {ratio_text}{size}; rms {rms:.3g} rad/s, chi {noise:.3g}"

    def _value_lines(self, body: int) -> list[str]:
        lead = np.ndim(self.noise)
        lines = [f"body {body}:"] if lead else []
        for name, value, spread in zip(self.value_names, self.values, self.std, strict=True):
            value, spread = (
                np.asarray(x).reshape(-1, *np.shape(x)[lead:])[body].reshape(-1)
                for x in (value, spread)
            )
            numbers = ", ".join(f"{v:.6g} +- {s:.2g}" for v, s in zip(value, spread))
            lines.append(f"{name}: {numbers}")
        scale = self.common_scale(body)
        if scale:
            lines.append("only a common factor of these is not shown; ratios to the largest:")
        for name, ratio, std in scale:
            numbers = ", ".join(f"{v:.6g} +- {s:.2g}" for v, s in zip(ratio.flat, std.flat))
            lines.append(f"  {name}: {numbers}")
        return lines

    def _flags(self, body: int) -> list[Finding]:
        code = int(np.asarray(self.diagnostics).reshape(-1)[body])
        return [flag for flag in WARNINGS if code & flag]

    def _texts(self) -> dict[Finding, str]:
        return SCENE_WARNINGS if self._inertia is None else WARNINGS


def checked_fit(fit: Fit, throw: bool) -> Fit:
    """The fit; FitError where it must not be used, unless ``throw`` is False."""
    if throw and not fit.is_usable:
        codes = np.asarray(fit.diagnostics).reshape(-1)
        texts = [
            f"{int(((codes & int(flag)) != 0).sum())} of {codes.size}: {text}"
            for flag, text in fit._texts().items()
            if flag & UNUSABLE and (codes & int(flag)).any()
        ]
        raise FitError("; ".join(texts) + ". Pass throw=False to get the result with its flags.")
    return fit


def mirror_moments(moments: Any) -> Any:
    """Moments (..., 3) of ``Fit.mirror_inertia``, in the order of ``moments``."""
    other = moments * (moments.sum(axis=-1, keepdims=True) - 2 * moments)
    return other / other.max(axis=-1, keepdims=True)
