"""Inertia and other numbers of a scene from recordings, with their uncertainty."""

from polhode.fit._conclude import sensor_axes as sensor_axes
from polhode.fit._csv import read_recording as read_recording
from polhode.fit._findings import (
    Finding as Finding,
    FitError as FitError,
    Observability as Observability,
)
from polhode.fit._fit import (
    fit_inertia as fit_inertia,
    fit_recordings as fit_recordings,
    fit_scene as fit_scene,
    windows as windows,
)
from polhode.fit._model import (
    Drag as Drag,
    FreeMotion as FreeMotion,
    FullTensor as FullTensor,
    MomentsOnly as MomentsOnly,
    Parameters as Parameters,
    SceneMotion as SceneMotion,
    SteppedMotion as SteppedMotion,
)
from polhode.fit._options import FitOptions as FitOptions, Gyroscope as Gyroscope, Huber as Huber
from polhode.fit._recording import (
    Recording as Recording,
    averaged as averaged,
    stack as stack,
)
from polhode.fit._residuals import (
    Model as Model,
    log_density as log_density,
    predict as predict,
    residuals as residuals,
)
from polhode.fit._result import Fit as Fit
