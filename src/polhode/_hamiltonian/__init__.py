"""The one Hamiltonian, its two charts, and closed forms to compare with (docs/equations.md)."""

from polhode._hamiltonian import document_000 as document_000, document_002 as document_002
from polhode._hamiltonian._attitude import (
    Attitude as Attitude,
    Vector as Vector,
    components as components,
    cross as cross,
    dot as dot,
    from_euler_angles as from_euler_angles,
    from_quaternion as from_quaternion,
    triple as triple,
)
from polhode._hamiltonian._costate import LiePoissonCostate as LiePoissonCostate
from polhode._hamiltonian._energy import (
    Hamiltonian as Hamiltonian,
    inverse_components as inverse_components,
    inverse_inertia as inverse_inertia,
)
from polhode._hamiltonian._euler_chart import (
    CanonicalHamiltonian as CanonicalHamiltonian,
    canonical_from_momentum as canonical_from_momentum,
    euler_angle_field as euler_angle_field,
    hamiltonian as hamiltonian,
    hamiltons_equations as hamiltons_equations,
    momentum_from_canonical as momentum_from_canonical,
    rates_from_angle_rates as rates_from_angle_rates,
)
from polhode._hamiltonian._lie_poisson import (
    Dynamics as Dynamics,
    external_power as external_power,
    lie_poisson_field as lie_poisson_field,
    momentum_rate as momentum_rate,
    motor_powers as motor_powers,
    quaternion_rate as quaternion_rate,
)
from polhode._hamiltonian._units import (
    FixedUnits as FixedUnits,
    LiePoissonUnits as LiePoissonUnits,
    relative as relative,
)
from polhode._hamiltonian.document_000 import (
    HamiltonianMatrices as HamiltonianMatrices,
    hamiltonian_matrices as hamiltonian_matrices,
)
