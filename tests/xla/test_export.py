"""Programs contain no host callback: they can be cached on disk, and exported."""

import jax
import jax.numpy as jnp
import pytest
from jax import export

import polhode as ph

I = ph.Inertia.from_moments([1.0, 1.5, 2.0])
FALL = ph.UniformGravity(1.0, [0.1, 0.0, 0.3])
ORBIT = ph.KeplerOrbit(1.0, 2.0, 0.1)
SCENES = {
    "free": (I,),
    "heavy top": (I, FALL),
    "damped": (I, FALL, ph.LinearDamping(jnp.array([0.1, 0.2, 0.3]))),
    "satellite": (I, ph.GravityGradient(1.0, ORBIT)),
    "Lagrange": (ph.Inertia.axisymmetric(1.0, 0.5), ph.UniformGravity.axial(1.0, 0.3)),
}


@pytest.mark.parametrize(
    ("kind", "what"),  # the program of a gradient contains that of the value
    [("Lagrange", "value"), *((kind, "gradient") for kind in SCENES if kind != "Lagrange")],
)
def test_programs_are_exported_for_other_platforms(kind, what):
    """With and without CPU optimisations the lowered program has no custom call."""
    scene = ph.Scene(*SCENES[kind])

    def last(omega):
        state = ph.State([1.0, 0.0, 0.0, 0.0], omega)
        return jnp.sum(ph.simulate(scene, state, [0.0, 1.0]).wxyz[..., -1, 1:])

    function = last if what == "value" else jax.grad(last)
    shape = jax.ShapeDtypeStruct((8, 3), jnp.float64)
    made = export.export(jax.jit(function), platforms=["cuda", "tpu"])(shape)
    text = made.mlir_module()
    assert "callback" not in text
    assert made.platforms == ("cuda", "tpu")
