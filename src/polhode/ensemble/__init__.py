"""Ensembles of any size: drawn by index, written in chunks, resumed after an interruption."""

from polhode.ensemble._ensemble import (
    AnyAttitude as AnyAttitude,
    Deviate as Deviate,
    Ensemble as Ensemble,
    SpreadAttitude as SpreadAttitude,
    SpreadEuler as SpreadEuler,
    SpreadMoments as SpreadMoments,
    SpreadMomentum as SpreadMomentum,
    SpreadRates as SpreadRates,
    SpreadTorque as SpreadTorque,
    build_ensemble as build_ensemble,
)
from polhode.ensemble._statistics import Statistic as Statistic, quantile as quantile
from polhode.ensemble._store import StoreError as StoreError, open_store as open_store
from polhode.ensemble._stream import Progress as Progress, stream as stream
