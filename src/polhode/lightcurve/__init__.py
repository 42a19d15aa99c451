"""Tumbling bodies from their light curves."""

from polhode.lightcurve._brightness import (
    HG as HG,
    HG1G2 as HG1G2,
    Convex as Convex,
    LinearPhase as LinearPhase,
    SeeligerPhase as SeeligerPhase,
    facets as facets,
    harmonics as harmonics,
    seeliger_ellipsoid as seeliger_ellipsoid,
    seeliger_sphere as seeliger_sphere,
)
from polhode.lightcurve._command import (
    figure as figure,
    read_solutions as read_solutions,
    run as run,
    table as table,
)
from polhode.lightcurve._data import LightCurve as LightCurve
from polhode.lightcurve._files import read_light_curve as read_light_curve
from polhode.lightcurve._fit import fit_light_curve as fit_light_curve
from polhode.lightcurve._frequencies import (
    Pairs as Pairs,
    fourier_lattices as fourier_lattices,
    fourier_pairs as fourier_pairs,
    meaning as meaning,
)
from polhode.lightcurve._nulls import Model as Model
from polhode.lightcurve._solutions import LightCurveFit as LightCurveFit, Solution as Solution
from polhode.lightcurve._verdict import Verdict as Verdict
