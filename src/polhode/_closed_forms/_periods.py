"""Rotation periods of a tumbling free body."""

import jax
import jax.numpy as jnp
import numpy as np

from polhode import rotation
from polhode._batch import common_batch
from polhode._checks import describe, is_concrete, require
from polhode._closed_forms import free
from polhode._closed_forms.free import Periods
from polhode._scene import State
from polhode.inertia import Inertia, principal


def periods(inertia: Inertia, state: State) -> Periods:
    """P_psi, P_phi [s], mode and nutation limits [rad] of free bodies; fields (...).

    ``P_psi``: rotation about (LAM) or oscillation about (SAM) the long axis; ``P_phi``: mean
    precession of the long axis about the angular momentum; ``mode``: ``ph.Mode``; ``k2``: the
    elliptic parameter; ``theta_min``, ``theta_max``: angle between long axis and momentum.
    Infinite where there is no such motion. Differentiable. Formulas: Landau & Lifshitz, Mechanics,
    section 37; Samarasinha & A'Hearn, Icarus 93 (1991).

    Raises TypeError when handed anything but a ``ph.Inertia`` and a ``ph.State``.
    """
    if not isinstance(inertia, Inertia) or not isinstance(state, State):
        raise TypeError(
            "periods takes a ph.Inertia and a ph.State, got"
            f" {type(inertia).__name__} and {type(state).__name__}."
        )
    if is_concrete(inertia):
        require(
            np.asarray(inertia.is_possible),
            f"periods needs moments that a body can have, got {describe(inertia.moments)}.",
        )
    batch = common_batch(inertia, state)
    moments, products, omega = inertia.moments, None, _spread(state.omega_body, batch)
    if not inertia.is_principal:
        moments, axes, products = principal(inertia.full)
        products = _spread(products[..., ::-1], batch)  # (yz, zx, xy) -> (xy, xz, yz)
        omega = rotation.rotate(rotation.conjugate(_spread(axes, batch)), omega)
    return _compiled(_spread(moments, batch), omega, products)


def _spread(x, batch):
    x = x.reshape((1,) * (len(batch) + 1 - x.ndim) + x.shape)
    return jnp.broadcast_to(x, (*batch, x.shape[-1]))


_compiled = jax.jit(free.periods)
