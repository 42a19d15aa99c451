"""The inverse of an inertia tensor in the Hamiltonian."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from polhode._hamiltonian import inverse_components

TENSOR = np.array([[2.0, 0.3, -0.2], [0.3, 1.5, 0.1], [-0.2, 0.1, 1.8]])
CHANGE = np.array([[1.0, 0.2, 0.0], [0.2, 0.0, -0.1], [0.0, -0.1, 0.3]])


@pytest.mark.parametrize("size", [1e-9, 1.0, 1e9])
def test_derivatives_in_single_precision_neither_underflow_nor_overflow(size):
    """The determinant of the largest tensor is about 1e27, its square 1e54."""

    def second(dtype):
        def inverse(x):
            tensor = (
                jnp.asarray(size * TENSOR, dtype) * x + jnp.asarray(size * CHANGE, dtype) * x**2
            )
            return jnp.stack(inverse_components(tensor)) * dtype(size)

        slope = jax.jacfwd(inverse)
        return slope(dtype(1)), jax.jacfwd(slope)(dtype(1))

    for single, double in zip(second(np.float32), second(np.float64)):
        np.testing.assert_allclose(single, double, rtol=1e-5, atol=1e-5)
