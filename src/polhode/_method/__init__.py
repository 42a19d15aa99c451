"""The interface of methods: what they are told, what they return, and checks of input."""

from polhode._method._base import (
    AbstractMethod as AbstractMethod,
    Record as Record,
    Samples as Samples,
)
from polhode._method._inputs import (
    check_inputs as check_inputs,
    check_kinds as check_kinds,
    check_method as check_method,
    check_rtol as check_rtol,
    check_times as check_times,
    default_rtol as default_rtol,
    judged as judged,
    raise_on_failure as raise_on_failure,
)
from polhode._method._options import check_options as check_options, made as made
from polhode._method._status import SimulationError as SimulationError, Status as Status
