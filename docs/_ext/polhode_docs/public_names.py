"""The public names of polhode, read from its source, and the pages of the reference.

Nothing of polhode is imported here: the tests compare this list with the package.
"""

import ast
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[3] / "src" / "polhode"

GROUPS = {
    "simulation": (
        "Simulation",
        "A scene, an initial state and times give a trajectory; events; states for filters.",
        """
        simulate explain Scene State Trajectory Record Status SimulationError Plan
        crossings Event Crossings propagate Propagation
        """,
    ),
    "methods": (
        "Methods",
        "The solution method is chosen by the library unless one of these is passed to `simulate`.",
        """
        AbstractMethod ClosedForm LagrangeTop SymmetricTop FixedAxis LiePoisson EulerAngles
        Extrapolation Splitting FlowAdjoint
        """,
    ),
    "bodies": (
        "Bodies",
        "Inertia, mass properties, and the periods of the free motion.",
        "Inertia MassProperties periods Periods Mode",
    ),
    "torques": (
        "Potentials, torques and wheels",
        "What a scene holds beside the body. Parts of one kind are added with `+`.",
        """
        AbstractPotential UniformGravity GravityGradient Potential
        AbstractOrbit KeplerOrbit StateOrbit LVLH
        AbstractTorque BodyTorque SpaceTorque FeedbackTorque RelativeTorque LinearDamping
        QuadraticDamping EnergySink Pulses Pointing RateDamping MagneticDipole BDot DipoleField
        AbstractRotor Rotor Motor AbstractCoupling ViscousCoupling CoulombFriction
        """,
    ),
    "hamiltonian": (
        "The Hamiltonian",
        "The Hamiltonian in ZYZ Euler angles, its equations of motion, and their matrices.",
        "hamiltonian hamiltons_equations HamiltonianMatrices hamiltonian_matrices",
    ),
    "sensors": (
        "Sensors and fits",
        "Sensor models, rotating frames and fits; more in `polhode.frames` and `polhode.fit`.",
        """
        RotatingFrame accelerometer gyroscope
        fit_inertia fit_recordings fit_scene
        """,
    ),
}
"""Pages of the names of `polhode` itself: title, introduction, names."""


def _statements(path: Path):
    """The explicit re-exports (`from a import b as b`) of a module or stub, in their order."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            for alias in node.names:
                if alias.asname == alias.name and not alias.name.startswith("_"):
                    yield node, alias.name


def namespaces() -> list[str]:
    """The public subpackages that the stub names (`from . import rotation as rotation`)."""
    return [
        name
        for node, name in _statements(PACKAGE / "__init__.pyi")
        if node.level == 1 and node.module is None
    ]


def names_in(namespace: str = "") -> list[str]:
    """The public functions, classes and types of `polhode` or of one of its namespaces."""
    folder = PACKAGE / namespace
    stub = folder / "__init__.pyi"
    path = stub if stub.exists() else folder / "__init__.py"
    left_out = namespaces() if not namespace else []
    return [name for _, name in _statements(path) if name not in left_out]


def public_names() -> list[str]:
    """Every public name with its package, such as `polhode.rotation.multiply`."""
    found = [f"polhode.{name}" for name in names_in()]
    for namespace in namespaces():
        found.append(f"polhode.{namespace}")
        found += [f"polhode.{namespace}.{name}" for name in names_in(namespace)]
    return found


def grouped() -> dict[str, tuple[str, str, list[str]]]:
    """The pages of `polhode`: title, introduction, names; those of no group come last."""
    listed = names_in()
    pages = {
        page: (title, text, [name for name in row.split() if name in listed])
        for page, (title, text, row) in GROUPS.items()
    }
    placed = {name for _, _, row in pages.values() for name in row}
    others = [name for name in listed if name not in placed]
    if others:
        pages["others"] = ("Others", "", others)
    return pages
