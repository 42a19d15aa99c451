"""Elliptic integrals and functions with analytic derivatives; nothing about bodies."""

from polhode._closed_forms.elliptic._carlson import (
    carlson_rc as carlson_rc,
    carlson_rd as carlson_rd,
    carlson_rf as carlson_rf,
    carlson_rj as carlson_rj,
)
from polhode._closed_forms.elliptic._complete import (
    associate_b as associate_b,
    associate_d as associate_d,
    ellipe as ellipe,
    ellipk as ellipk,
)
from polhode._closed_forms.elliptic._incomplete import (
    ellipe_inc as ellipe_inc,
    ellipe_inc_sincos as ellipe_inc_sincos,
    ellipf as ellipf,
    ellipf_sincos as ellipf_sincos,
)
from polhode._closed_forms.elliptic._jacobi import (
    ellipj as ellipj,
    jacobi_epsilon as jacobi_epsilon,
)
from polhode._closed_forms.elliptic._third import (
    associate_j as associate_j,
    ellippi as ellippi,
    ellippi_inc as ellippi_inc,
    ellippi_inc_sincos as ellippi_inc_sincos,
)
