from polhode.solvers._extrapolation import Extrapolation as Extrapolation
