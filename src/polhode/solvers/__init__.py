from polhode.solvers._extrapolation import Extrapolation as Extrapolation
from polhode.solvers._splitting import Splitting as Splitting
