from polhode.solvers._choice import (
    Choice as Choice,
    choose as choose,
    natural_rate as natural_rate,
    steps_for as steps_for,
)
from polhode.solvers._extrapolation import Extrapolation as Extrapolation
from polhode.solvers._flow import flow as flow
from polhode.solvers._path import path as path
from polhode.solvers._splitting import Splitting as Splitting
