"""The Hamiltonian, its two sets of coordinates, and closed forms as a reference for tests."""

from polhode._hamiltonian._energy import (
    Attitude as Attitude,
    Hamiltonian as Hamiltonian,
    Vector as Vector,
    components as components,
    cross as cross,
    dot as dot,
    from_euler_angles as from_euler_angles,
    from_quaternion as from_quaternion,
    inverse_components as inverse_components,
    inverse_inertia as inverse_inertia,
    triple as triple,
)
from polhode._hamiltonian._euler_angles import (
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
    FixedUnits as FixedUnits,
    LiePoissonCostate as LiePoissonCostate,
    LiePoissonUnits as LiePoissonUnits,
    external_power as external_power,
    lie_poisson_field as lie_poisson_field,
    momentum_rate as momentum_rate,
    motor_powers as motor_powers,
    quaternion_rate as quaternion_rate,
    relative as relative,
)
from polhode._hamiltonian._reference import (
    HamiltonianMatrices as HamiltonianMatrices,
    hamiltonian_matrices as hamiltonian_matrices,
)
