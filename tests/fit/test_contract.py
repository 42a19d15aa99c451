"""The public interface of ``polhode.fit``: names, annotations, options and results."""

import inspect

import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode import fit

NAMES = [
    "fit_inertia",
    "fit_recordings",
    "fit_scene",
    "FitOptions",
    "Fit",
    "Finding",
    "FitError",
    "Observability",
    "Recording",
    "read_recording",
    "windows",
    "stack",
    "Huber",
    "Gyroscope",
    "FullTensor",
    "MomentsOnly",
    "Parameters",
    "Model",
    "Drag",
    "FreeMotion",
    "SteppedMotion",
    "SceneMotion",
    "averaged",
    "log_density",
    "predict",
    "residuals",
    "sensor_axes",
]


def public(holder):
    return {name: thing for name, thing in vars(holder).items() if not name.startswith("_")}


def test_the_namespace_exports_these_names_and_is_not_called():
    exported = {name for name, thing in public(fit).items() if not inspect.ismodule(thing)}
    assert exported == set(NAMES)
    assert not callable(fit)
    assert type(fit) is type(inspect)


def functions_of(name):
    """A public function, or the public methods, properties and ``__init__`` of a class."""
    thing = getattr(fit, name)
    if not inspect.isclass(thing):
        return {name: thing}
    found = {}
    for key, member in vars(thing).items():
        if key.startswith("_") and key not in ("__init__", "__call__"):
            continue
        member = member.fget if isinstance(member, property) else member
        member = getattr(member, "__func__", member)
        if inspect.isfunction(member):
            found[f"{name}.{key}"] = member
    return found


@pytest.mark.parametrize("name", NAMES)
def test_every_public_name_is_annotated(name):
    for where, function in functions_of(name).items():
        signature = inspect.signature(inspect.unwrap(function))
        bare = [
            key
            for key, parameter in signature.parameters.items()
            if parameter.annotation is parameter.empty and key not in ("self", "cls", "_cls")
        ]
        assert not bare, (where, bare)
        if not where.endswith("__init__"):
            assert signature.return_annotation is not signature.empty, where


@pytest.mark.parametrize("name", ["fit_inertia", "fit_recordings", "fit_scene"])
def test_every_entry_point_returns_a_fit(name):
    assert inspect.signature(getattr(fit, name)).return_annotation is fit.Fit


TIMES = np.linspace(0, 1, 20)
RATES = np.sin(np.outer(TIMES, [3.0, 4, 5]))
WXYZ = np.tile([1.0, 0, 0, 0], (20, 1))
BODY = ph.Inertia.from_moments([1.0, 2.0, 2.5])


@pytest.mark.parametrize(
    ("given", "error", "message"),
    [
        ({"motion": 1.0}, TypeError, "motion of FitOptions must be a motion"),
        ({"initial_inertia": [1.0, 2, 3]}, TypeError, "initial_inertia .* must be a ph.Inertia"),
        ({"robust": 3.0}, TypeError, r"robust of FitOptions must be Huber\(threshold\)"),
        ({"solver": "lm"}, TypeError, "solver of FitOptions must be a Gauss-Newton solver"),
        ({"bias": [0.0, 0, 0]}, TypeError, "bias of FitOptions must be True or False"),
        ({"trust_noise": 0.01}, TypeError, "trust_noise of FitOptions must be True, False"),
        ({"max_starts": 0}, ValueError, "max_starts of FitOptions must be an integer, at least 1"),
        ({"max_steps": 0}, ValueError, "max_steps of FitOptions must be an integer, at least 1"),
        ({"known": BODY}, TypeError, "known"),
    ],
)
def test_options_are_checked_where_they_are_made(given, error, message):
    with pytest.raises(error, match=message):
        fit.FitOptions(**given)


@pytest.mark.parametrize(
    ("options", "data", "message"),
    [
        ({"trust_noise": True}, {}, "trust_noise=True needs the noise"),
        ({"robust": fit.Huber()}, {}, "robust counts residuals in standard deviations"),
        ({"bias": True}, {"omega_body": None, "wxyz": WXYZ}, "bias=True needs rates"),
        ({"mounting": True}, {"omega_body": None, "wxyz": WXYZ}, "mounting=True needs rates"),
        ({"motion": fit.SteppedMotion(1e-6)}, {}, "needs the wheel's speed"),
        (
            {"initial_inertia": ph.Inertia.from_moments([[1.0, 2.0, 2.5]] * 2)},
            {},
            r"that of one body, got the batch axes \(2,\)",
        ),
        ({}, {"wheel_speed": TIMES}, "wheel_speed needs the wheel's spin inertia"),
        ({}, {"attitude_noise": 0.1}, "attitude_noise is the noise of wxyz, which was not given"),
        ({}, {"wxyz": WXYZ, "omega_noise": 0.1}, "omega_noise without attitude_noise"),
    ],
)
def test_what_fit_inertia_cannot_use_is_refused(options, data, message):
    data = {"omega_body": RATES, **data}
    with pytest.raises(ValueError, match=message):
        fit.fit_inertia(TIMES, **data, options=fit.FitOptions(**options))


SCENE = ph.Scene(BODY, torque=ph.LinearDamping(0.1))


@pytest.mark.parametrize(
    ("options", "data", "more", "message"),
    [
        ({"motion": fit.FreeMotion()}, {}, {}, "does not use the option motion"),
        ({"unknown": fit.MomentsOnly()}, {}, {}, "does not use the option unknown"),
        ({"initial_inertia": BODY}, {}, {}, "does not use the option initial_inertia"),
        ({"mounting": True}, {}, {}, "does not fit a mounting"),
        ({}, {"wheel_speed": TIMES}, {}, "does not read wheel_speed"),
        ({}, {"force_body": RATES}, {}, "does not model accelerometer readings"),
        ({}, {"wxyz": WXYZ}, {"attitude": [1.0, 0, 0, 0]}, "for recordings without attitudes"),
    ],
)
def test_what_fit_scene_cannot_use_is_refused(options, data, more, message):
    recording = fit.Recording.of(TIMES, RATES, **data)
    options = fit.FitOptions(**options)
    with pytest.raises(ValueError, match=message):
        ph.fit_scene(SCENE, recording, lambda s: s.torque.c, options=options, **more)


@pytest.mark.parametrize("options", [{"bias": True}, fit.Huber()])
def test_options_are_one_object(options):
    recording = fit.Recording.of(TIMES, RATES)
    for call in (
        lambda: ph.fit_inertia(TIMES, RATES, options=options),
        lambda: ph.fit_recordings([recording], options=options),
        lambda: ph.fit_scene(SCENE, recording, lambda s: s.torque.c, options=options),
    ):
        with pytest.raises(TypeError, match=r"options must be a polhode\.fit\.FitOptions"):
            call()


def test_recordings_of_one_body_have_no_batch():
    batch = fit.Recording.of(TIMES, np.stack([RATES, RATES]))
    with pytest.raises(ValueError, match=r"no batch axes, got \(2,\)"):
        ph.fit_recordings([batch])


def test_vectors_may_be_lists_of_integers():
    assert hash(fit.SteppedMotion(1e-6, axis=[0, 0, 1]).axis) == hash((0.0, 0.0, 1.0))
    sensor = fit.Gyroscope(np.eye(3, dtype=int), [0, 0, 1])
    assert sensor.gain.dtype == sensor.bias.dtype == jnp.float64
