"""Transformations to rotating frames and back, over six decades of rate."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import polhode as ph

vectors = st.tuples(*[st.integers(-3, 3)] * 3)
decades = st.floats(-3, 3)


@eqx.filter_jit
def motions(omega, wxyz, t, inner):
    """Motion of a particle in the frame, in space, and transformed back to the frame."""
    frame = ph.RotatingFrame.from_rate(omega, wxyz=wxyz)
    position = frame.position_to_space(t, inner[0])
    velocity = frame.velocity_to_space(t, *inner[:2])
    acceleration = frame.acceleration_to_space(t, *inner)
    back = (
        frame.position_to_frame(t, position),
        frame.velocity_to_frame(t, position, velocity),
        frame.acceleration_to_frame(t, position, velocity, acceleration),
    )
    return (position, velocity, acceleration), back


@pytest.mark.parametrize("dtype", [np.float64, np.float32], ids=["float64", "float32"])
@settings(max_examples=60, deadline=None)
@given(vectors.filter(any), decades, vectors, vectors, vectors, st.integers(-4, 4))
def test_motions_to_space_and_back(dtype, axis, decade, position, velocity, acceleration, t):
    """Lengths are those of the composed rotation; v = omega r and a = omega^2 r set the scale."""
    rate = 10.0**decade
    omega = np.array(axis) / np.linalg.norm(axis) * rate
    inner = [np.array(x, float) for x in (position, velocity, acceleration)]
    inner = [x * rate**order for order, x in enumerate(inner)]  # rates per angle of rotation
    given_ = [jnp.asarray(x, dtype) for x in (omega, [0.5, -0.5, 0.1, 0.7], t / rate)]
    space, back = motions(*given_, [jnp.asarray(x, dtype) for x in inner])
    size = 1 + max(np.linalg.norm(x) / rate**order for order, x in enumerate(inner))
    for order, (found, true) in enumerate(zip(back, inner)):
        off = np.abs(np.asarray(found, float) - true).max()
        assert off < 64 * np.finfo(dtype).eps * size * rate**order
    np.testing.assert_allclose(
        np.linalg.norm(space[0]), np.linalg.norm(inner[0]), rtol=8 * np.finfo(dtype).eps
    )
    # velocity in space: that in the frame plus omega x r, both rotated
    carried = inner[1] + np.cross(omega, inner[0])
    np.testing.assert_allclose(
        np.linalg.norm(space[1]),
        np.linalg.norm(carried),
        rtol=8 * np.finfo(dtype).eps,
        atol=32 * np.finfo(dtype).eps * size * rate,
    )


@eqx.filter_jit
def local_vertical(frame, wxyz, omega, t):
    inside = frame.to_frame(wxyz, omega, t)
    return inside, frame.from_frame(*inside, t)


@settings(max_examples=40, deadline=None)
@given(decades, st.tuples(*[st.integers(-3, 3)] * 4).filter(any), vectors, st.floats(0, 6))
def test_attitudes_to_the_orbit_frame_and_back(decade, wxyz, omega, anomaly):
    """Orbits of sizes from 1e-3 to 1e3, with rates scaled accordingly."""
    axis = 10.0**decade
    rate = axis**-1.5
    frame = ph.LVLH(ph.KeplerOrbit(1.0, axis, 0.1, 0.5))
    wxyz = ph.rotation.normalise(jnp.array(wxyz, float))
    omega = jnp.array(omega, float) * rate
    inside, (attitude, back) = local_vertical(frame, wxyz, omega, jnp.asarray(anomaly / rate))
    assert float(ph.rotation.angle_between(attitude, wxyz)) < 1e-14
    np.testing.assert_allclose(back, omega, rtol=0, atol=2e-14 * rate)
    relative = ph.rotation.rotate(inside[0], inside[1]) / rate
    still = ph.rotation.rotate(inside[0], omega) / rate
    turning = np.asarray(still - relative)  # angular velocity of the frame along its axes
    assert turning[1] < -0.5
    np.testing.assert_allclose(turning[[0, 2]], 0, atol=1e-13)
