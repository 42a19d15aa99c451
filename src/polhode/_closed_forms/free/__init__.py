"""The exact motion of the free body, derived formula by formula in docs/free_motion.md."""

from polhode._closed_forms.free._evaluate import (
    evaluate as evaluate,
    even_rows as even_rows,
    free_motion as free_motion,
    is_abreast as is_abreast,
    prepare as prepare,
)
from polhode._closed_forms.free._motion import FreeConstants as FreeConstants
from polhode._closed_forms.free._periods import Mode as Mode, Periods as Periods, periods as periods
from polhode._closed_forms.free._symmetric import (
    spherical_motion as spherical_motion,
    symmetric_motion as symmetric_motion,
)
