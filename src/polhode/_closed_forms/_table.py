"""The exact laws, one row each: the planner takes the first that is known to hold."""

from typing import NamedTuple

from polhode._closed_forms._closed_form import AbstractExact
from polhode._closed_forms._elementary import FixedAxis, SymmetricTop
from polhode._closed_forms._free import ClosedForm
from polhode._closed_forms._lagrange import LagrangeTop
from polhode._method._base import Record
from polhode._scene import Scene, State
from polhode.inertia import Symmetry


class Law(NamedTuple):
    """One law: its name, what ``explain`` says where it runs, the method that computes it.

    ``symmetry``: the one that the inertia must be known to have; None: left to the method.
    ``of_state``: whether it holds for some states of a scene only.
    """

    name: str
    says: str
    method: AbstractExact
    symmetry: Symmetry | None = None
    of_state: bool = False

    def why_not(self, scene: Scene, state: State, record: Record) -> str | None:
        """Why it is not known to hold, in words; None where it is."""
        reason = self.method.why_not(scene, state, record)
        if reason is None and self.symmetry not in (None, scene.inertia.symmetry):
            return f"the inertia is not declared {self.symmetry.name.lower()}"
        return reason


LAWS = (
    Law(
        "free body",
        "free and known to be spherical: exact turn about a fixed axis",
        ClosedForm(),
        Symmetry.SPHERICAL,
    ),
    Law(
        "free body",
        "free and known to be axisymmetric: exact steady precession",
        ClosedForm(),
        Symmetry.AXISYMMETRIC,
    ),
    Law(
        "free body",
        "nothing acts on the body: exact motion in Jacobi elliptic functions",
        ClosedForm(),
    ),
    Law(
        "Lagrange's top",
        "symmetric body, centre of mass on its axis, uniform gravity (Lagrange's top): exact motion"
        " in theta functions",
        LagrangeTop(),
    ),
    Law(
        "symmetric top",
        "symmetric body with torque, damping or wheels about its axis: exact motion in elementary"
        " functions",
        SymmetricTop(),
    ),
    Law(
        "fixed axis",
        "spin about one fixed principal axis: exact motion in elementary functions",
        FixedAxis(),
        of_state=True,
    ),
)


def lawful(scene: Scene, state: State, record: Record) -> tuple[Law | None, tuple[str, ...]]:
    """The first law known to hold, or None; and of those before it why they do not."""
    refused = []
    for law in LAWS:
        reason = law.why_not(scene, state, record)
        if reason is None:
            return law, tuple(refused)
        refused.append(f"{law.name}: {reason}")
    return None, tuple(dict.fromkeys(refused))
