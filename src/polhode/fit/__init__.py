"""Inertia and other numbers from recordings: fits that say how uncertain they are."""

import sys
import types

from polhode.fit._csv import load_recording as load_recording, read_recording as read_recording
from polhode.fit._design import throw_information as throw_information
from polhode.fit._filter import Noise as Noise
from polhode.fit._fit import (
    fit_inertia as fit_inertia,
    fit_recordings as fit_recordings,
    windows as windows,
)
from polhode.fit._fit_balance import BalanceFit as BalanceFit, fit_balance as fit_balance
from polhode.fit._instrument import (
    Instrument as Instrument,
    Tolerance as Tolerance,
    averaged as averaged,
    lever_arm as lever_arm,
)
from polhode.fit._motion import (
    AbstractMotion as AbstractMotion,
    Drag as Drag,
    FreeMotion as FreeMotion,
    Predicted as Predicted,
    SteppedMotion as SteppedMotion,
)
from polhode.fit._parameters import (
    AbstractInertiaUnknown as AbstractInertiaUnknown,
    FullTensor as FullTensor,
    MomentsOnly as MomentsOnly,
    Parameters as Parameters,
)
from polhode.fit._recording import Recording as Recording, stack as stack
from polhode.fit._residuals import (
    Huber as Huber,
    Model as Model,
    log_density as log_density,
    predict as predict,
    residuals as residuals,
)
from polhode.fit._result import (
    Finding as Finding,
    FitError as FitError,
    InertiaFit as InertiaFit,
    is_unusable as is_unusable,
    remarks as remarks,
    sensor_axes as sensor_axes,
)
from polhode.fit._scene_fit import (
    LeafMotion as LeafMotion,
    SceneFit as SceneFit,
    fit_scene as fit_scene,
)
from polhode.fit._scene_motion import SceneMotion as SceneMotion


class _Callable(types.ModuleType):
    """This package can be called: ``ph.fit(scene, data, free)`` is ``ph.fit_scene``."""

    def __call__(self, *args, **options):
        return fit_scene(*args, **options)


sys.modules[__name__].__class__ = _Callable
