"""Figures of a Trajectory or of arrays, each in one call (needs the extra ``plot``: matplotlib).

``view``, an HTML page with the moving bodies, needs no extra.
"""

from polhode.plot._fits import fit as fit, work_precision as work_precision
from polhode.plot._samples import Samples as Samples, samples as samples
from polhode.plot._trajectory import (
    animate as animate,
    herpolhode as herpolhode,
    history as history,
    overview as overview,
    polhode as polhode,
)
from polhode.plot._view import View as View, view as view, view_file as view_file
