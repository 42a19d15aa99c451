"""Inertia and other numbers of a scene from recordings, with their uncertainty."""

from polhode.fit._csv import read_recording as read_recording
from polhode.fit._fit import (
    fit_inertia as fit_inertia,
    fit_recordings as fit_recordings,
    windows as windows,
)
from polhode.fit._gyroscope import Gyroscope as Gyroscope
from polhode.fit._motion import (
    Drag as Drag,
    FreeMotion as FreeMotion,
    SteppedMotion as SteppedMotion,
)
from polhode.fit._options import FitOptions as FitOptions
from polhode.fit._parameters import (
    FullTensor as FullTensor,
    MomentsOnly as MomentsOnly,
    Parameters as Parameters,
)
from polhode.fit._recording import Recording as Recording, averaged as averaged, stack as stack
from polhode.fit._residuals import (
    Huber as Huber,
    Model as Model,
    log_density as log_density,
    predict as predict,
    residuals as residuals,
)
from polhode.fit._result import (
    Finding as Finding,
    Fit as Fit,
    FitError as FitError,
    Observability as Observability,
    sensor_axes as sensor_axes,
)
from polhode.fit._scene_fit import fit_scene as fit_scene
from polhode.fit._scene_motion import SceneMotion as SceneMotion
