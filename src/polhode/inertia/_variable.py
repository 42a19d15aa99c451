"""Inertia that changes with time: fuel, deployment, moving masses."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polhode._checks import as_float_array, require
from polhode._parts import AbstractPart, Signature, kept, shaped, takes
from polhode.inertia._inertia import Inertia
from polhode.inertia._shapes import Symmetry


class VariableInertia(AbstractPart):
    """Inertia as a prescribed function of time, in body axes, for ``ph.Scene(inertia=...)``.

    **Arguments:** ``fn``: a function of time [s] that returns principal moments (3,) or a tensor
    (3, 3) [kg m^2]; or a ``ph.Table`` of moments (..., n, 3) or of tensors as nine numbers
    (..., n, 9), row by row. Its values must be physical at all times; they are not checked.

    The angular momentum L obeys dL/dt = L x omega + N with omega = I(t)^-1 L, so that the term
    (dI/dt) omega of Euler's equations,

        I domega/dt = -omega x I omega - (dI/dt) omega + N,

    is included and no derivative of I is needed. Without torques L is constant in space, as in a
    deployment. The parts must move so that they carry no angular momentum relative to the body axes
    (in pairs, or along lines through the centre of mass). Mass that leaves the body takes momentum
    with it: add that as a torque, ``ph.FeedbackTorque(lambda t, wxyz, omega: dI_dt(t) @ omega)``
    for mass that leaves with the velocity of its place on the body.

        booms = ph.VariableInertia(lambda t: jnp.array([1.0, 1.2, 0.6]) * (1 + 0.1 * t))
        ph.simulate(ph.Scene(booms), state, ts)

    P. C. Hughes, Spacecraft Attitude Dynamics, 1986, section 3.5. Raises TypeError or ValueError
    for a function that takes or returns something else.
    """

    is_principal: bool = eqx.field(static=True)
    fn: Callable = shaped(None)

    def __init__(self, fn: Callable):
        if isinstance(fn, AbstractPart) and callable(fn):
            width = (np.shape(jax.eval_shape(fn, 0.0)) or (1,))[-1]
            require(
                width in (3, 9),
                "VariableInertia takes a table of moments (..., n, 3) or of tensors (..., n, 9),"
                f" got vectors of {width} numbers.",
            )
            self.fn, self.is_principal = fn, width == 3
            return
        takes("VariableInertia", fn, ("t",))
        given: Any = fn
        with jax.numpy_dtype_promotion("standard"):
            shape = np.shape(jax.eval_shape(lambda t: as_float_array(_NAME, given(t)), 0.0))
        require(
            shape in ((3,), (3, 3)),
            "the function given to VariableInertia must return moments (3,) or a tensor (3, 3), got"
            f" shape {shape}.",
        )
        self.fn, self.is_principal = kept(fn), shape == (3,)

    def at(self, t: Array | float) -> Inertia:
        """The inertia at the times ``t`` (...)."""
        core_rank = 2
        if isinstance(self.fn, AbstractPart) and callable(self.fn):
            value, core_rank = self.fn(t), 1
        else:
            core = (3,) if self.is_principal else (3, 3)
            value = Signature(_NAME, {"t": ()}, core).mapped(self.fn, t)
        if self.is_principal:
            return Inertia(diagonal=value, physical=False)
        return Inertia(
            full=value.reshape(*value.shape[: value.ndim - core_rank], 3, 3), physical=False
        )

    @property
    def symmetry(self) -> Symmetry:
        """None by construction (static)."""
        return Symmetry.NONE

    @property
    def dtype(self) -> Any:
        """Floating dtype of the numbers of a table; else that of JAX."""
        leaves = [x for x in jax.tree.leaves(self) if eqx.is_inexact_array(x)]
        return jnp.result_type(*leaves) if leaves else jnp.result_type(float)


_NAME = "VariableInertia"


def inertia_at(inertia: Inertia | VariableInertia, t: Array | float) -> Inertia:
    """The inertia at the time ``t``; what does not change is returned as it is."""
    return inertia.at(t) if isinstance(inertia, VariableInertia) else inertia
