"""The [method] of a scene file as a method object."""

import inspect
import math

import diffrax

import polhode
from polhode import _integrate as solvers
from polhode.files._build import blamed
from polhode.files._error import SceneFileError, did_you_mean
from polhode.files._models import SceneFile


def build_method(file: SceneFile) -> "polhode.AbstractMethod | None":
    """The method object, or None when the planner is to choose.

    Raises SceneFileError for a solver that neither polhode nor diffrax has.
    """
    method = file.method
    if method.kind == "auto":
        return None
    if method.kind == "closed-form":
        return polhode.ClosedForm()
    chart = {"lie-poisson": polhode.LiePoisson, "euler-angles": polhode.EulerAngles}[method.kind]
    options = {}
    with blamed(file, "[method]"):
        if method.solver is not None:
            options["solver"] = _solver(file, method.solver)
        if method.step is not None:
            first, last = file.times.seconds[[0, -1]]
            options["dt0"] = math.copysign(method.step, last - first)
            options["controller"] = diffrax.ConstantStepSize()
        return chart(**options)


def _solver(file: SceneFile, name: str) -> diffrax.AbstractSolver:
    known = {
        key: value
        for module in (diffrax, solvers)
        for key, value in vars(module).items()
        if inspect.isclass(value)
        and issubclass(value, diffrax.AbstractSolver)
        and not key.startswith("Abstract")
    }
    if name not in known:
        raise SceneFileError(
            file.path, "[method] solver", "unknown solver", name,
            "the name of a solver of diffrax or polhode, such as Dopri8",
            did_you_mean(name, known),
        )  # fmt: skip
    try:
        return known[name]()
    except TypeError:
        raise SceneFileError(
            file.path, "[method] solver", "a solver that needs arguments", name,
            "one that is made without, such as Dopri8", "use it from Python instead",
        ) from None  # fmt: skip
