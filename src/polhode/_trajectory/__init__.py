"""The result of a simulation: samples, quantities derived from them, and states at other times."""

from polhode._trajectory._propagator import (
    Propagator as Propagator,
    moved_through as moved_through,
    moved_to as moved_to,
    shortly_after as shortly_after,
    with_initial_spins as with_initial_spins,
)
from polhode._trajectory._saved import (
    final_of as final_of,
    successful_mean as successful_mean,
    values_of as values_of,
    with_saved as with_saved,
)
from polhode._trajectory._trajectory import (
    Ending as Ending,
    Events as Events,
    Trajectory as Trajectory,
)
