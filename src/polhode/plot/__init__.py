"""Figures in one call, of a Trajectory or of arrays (the extra ``plot``: matplotlib).

``view``, the page of a moving body, needs no extra.
"""

from polhode.plot._animate import animate as animate
from polhode.plot._fit import fit as fit
from polhode.plot._herpolhode import herpolhode as herpolhode
from polhode.plot._history import history as history
from polhode.plot._overview import overview as overview
from polhode.plot._polhode import polhode as polhode
from polhode.plot._samples import Samples as Samples, samples as samples
from polhode.plot._view import View as View, view as view, view_file as view_file
from polhode.plot._work_precision import work_precision as work_precision
