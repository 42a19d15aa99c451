# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Rotating frames: three problems
#
# [![Open in Colab](https://colab.research.google.com/assets/colab-badge.svg)](https://colab.research.google.com/github/polhode/polhode/blob/main/notebooks/rotating_frames.ipynb)
#
# In a rotating frame apparent forces act on a particle: the centrifugal and the Coriolis force and,
# if the angular velocity changes, the Euler force. `ph.RotatingFrame` computes them,
# `ph.frames.simulate_particles` simulates particles under them.
#
# 1. How fast does the plane of a Foucault pendulum rotate?
# 2. Where does a body dropped into a deep shaft land?
# 3. What does a bead do inside a tumbling box, and what does an accelerometer in that box read?

# %%
# Needs polhode with its figures, installed from a checkout or from an archive of a release (on
# Colab: upload the archive first). Remove the # in front of one line:
# # %pip install '..[all]'
# # %pip install './polhode-<version>.tar.gz[all]'

# %%
import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import polhode as ph
from polhode.frames import FrameForce

jax.config.update("jax_enable_x64", True)
RED, GREEN, BLUE, INK, GREY = "#D55E00", "#009E73", "#0072B2", "#222222", "#8A8A8A"
plt.rcParams.update(
    {
        "figure.dpi": 80,
        "figure.constrained_layout.use": True,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.titlelocation": "left",
        "axes.titlesize": 11,
        "legend.frameon": False,
    }
)

# %% [markdown]
# ## 1. A Foucault pendulum
#
# The local axes are x south, y east and z up, with the origin at the suspension. The Earth's
# angular velocity has a horizontal and a vertical component. Gravity along a plumb line already
# includes the centrifugal force at the origin, so the frame needs no accelerated origin.

# %%
GRAVITY = 9.81  # m/s^2
EARTH_RATE = 2 * np.pi / 86164.1  # rad/s, against the stars


def ground(latitude, rate):
    """The frame of the ground at a latitude [rad] of a planet turning at a rate [rad/s]."""
    up = jnp.stack([-jnp.cos(latitude), jnp.zeros_like(latitude), jnp.sin(latitude)])
    return ph.RotatingFrame.from_rate(rate * up)


def swing(latitude, rate, length, start, ts):
    """A bob of 1 kg on a wire, let go at rest `start` metres south of the lowest point."""
    frame = ground(latitude, rate)
    weight = jnp.array([0.0, 0.0, -GRAVITY])

    def weight_and_wire(t, position, velocity):
        """The tension is whatever keeps the length: r . r'' = -|v|^2."""
        along = position / length
        free = weight + frame.apparent_acceleration(t, position, velocity)
        tension = jnp.sum(along * free, -1) + jnp.sum(velocity**2, -1) / length
        return weight - tension[..., None] * along

    below = -jnp.sqrt(length**2 - start**2)
    return ph.frames.simulate_particles(
        frame, jnp.stack([start, 0.0 * start, below]), jnp.zeros(3), ts, FrameForce(weight_and_wire)
    )


# %% [markdown]
# The pendulum of the Panthéon has a wire of 67 m. It is released 3 m from the lowest point, at
# eight latitudes, and swings for one hour. The plane is determined from the first and the last
# swing. In the left figure the same pendulum hangs in Paris on a planet whose day lasts only 40
# swings.

# %%
length, start = jnp.array(67.0), jnp.array(3.0)
period = 2 * np.pi * np.sqrt(67.0 / GRAVITY) * (1 + (3.0 / 67.0) ** 2 / 16)  # of this amplitude
paris = jnp.deg2rad(48.85)

rosette = swing(
    paris, 2 * np.pi / (40 * period), length, start, jnp.linspace(0, 26.5 * period, 1600)
)


def plane(horizontal):
    """Direction of the swing plane [rad], from x + iy samples of one swing."""
    return jnp.angle(jnp.sum(horizontal**2, axis=-1)) / 2


one_swing = jnp.linspace(0.0, period, 33)[:-1]
ts = jnp.concatenate([one_swing, one_swing + 220 * period])
latitudes = jnp.deg2rad(jnp.linspace(-80.0, 80.0, 8))
hour = jax.vmap(lambda latitude: swing(latitude, EARTH_RATE, length, start, ts).position)(latitudes)
horizontal = hour[..., 0] + 1j * hour[..., 1]
turned = plane(horizontal[:, 32:]) - plane(horizontal[:, :32])
per_day = jnp.rad2deg(turned / (220 * period) * 86164.1)

# %%
fig, (left, right) = plt.subplots(1, 2, figsize=(9.6, 4.3), width_ratios=(1, 1.25))
south, east, _ = rosette.position.T
left.plot(east, -south, color=BLUE, linewidth=0.9)
left.plot(east[0], -south[0], "o", color=RED, markersize=7)
left.annotate(
    "let go here",
    (float(east[0]), -float(south[0])),
    (0.35, -3.1),
    color=RED,
    bbox={"facecolor": "white", "edgecolor": "none", "pad": 1},
)
left.set_aspect("equal")
left.set(xlabel="east (m)", ylabel="north (m)", title="From above, on a planet with a short day")
degrees = np.linspace(-90, 90, 181)
right.plot(degrees, -360 * np.sin(np.deg2rad(degrees)), color=GREY, label="-360° sin(latitude)")
right.plot(np.rad2deg(latitudes), per_day, "o", color=BLUE, label="measured over one hour")
right.set(xlabel="latitude (°)", ylabel="turn of the plane per sidereal day (°)")
right.set(title="On the Earth", xticks=range(-90, 91, 30), yticks=range(-360, 361, 120))
right.legend()
plt.show()

# %%
ratio = per_day / (-360 * jnp.sin(latitudes))
print("measured / sin(latitude) law:", np.array2string(np.asarray(ratio), precision=4))
print("1 - 3/8 (start / length)^2  :", round(1 - 3 / 8 * float(start / length) ** 2, 4))

# %% [markdown]
# The plane rotates clockwise in the north, slightly more slowly than the sine law predicts.
# A bob released at rest on the rotating Earth moves on a thin ellipse, and an
# ellipse of finite size precesses by itself, here against the rotation of Foucault's plane, at 3/8
# (amplitude / length)^2 of the frequency of its swing (Airy 1851).
# ## 2. A body dropped into a shaft
#
# In 1831 Reich dropped balls down a mine shaft at Freiberg, 158.5 m deep, and found them 28 mm to
# the east of the plumb line. The downward velocity causes a Coriolis force to the east; the
# eastward velocity causes a second, much smaller one to the south. Expanded in powers of the
# rate, the deflections are $\tfrac13 g\omega\cos\lambda\,t^3$ and $\tfrac18
# g\omega^2\sin\lambda\cos\lambda\,t^4$.

# %%
freiberg, depth = jnp.deg2rad(50.92), 158.5
weight = FrameForce(lambda t, position, velocity: jnp.array([0.0, 0.0, -GRAVITY]))
fall_time = np.sqrt(2 * depth / GRAVITY)
times = jnp.concatenate([jnp.zeros(1), jnp.geomspace(0.3, fall_time, 40)])
fall = ph.frames.simulate_particles(
    ground(freiberg, EARTH_RATE), jnp.zeros(3), jnp.zeros(3), times, weight, rtol=1e-13
)
south, east, up = np.asarray(fall.position[1:]).T
t, sine, cosine = np.asarray(times[1:]), np.sin(freiberg), np.cos(freiberg)
series_east = GRAVITY * EARTH_RATE * cosine * t**3 / 3
series_south = GRAVITY * EARTH_RATE**2 * sine * cosine * t**4 / 8

fig, (left, right) = plt.subplots(1, 2, figsize=(9.6, 4.3), width_ratios=(1, 1.6))
left.plot(1e3 * east, up, color=BLUE)
left.plot(1e3 * east[-1], up[-1], "o", color=BLUE)
left.axvline(0, color=GREY, linewidth=1)
left.annotate("plumb line", (0.6, -150), color=GREY)
left.set(xlabel="east (mm)", ylabel="height (m)", title="The path (not to scale)")
right.loglog(t, series_east, color=BLUE, label="first order, to the east")
right.loglog(t, series_south, color=RED, label="second order, to the south")
right.loglog(t[::3], east[::3], "o", color=BLUE, markersize=5)
right.loglog(t[::3], south[::3], "o", color=RED, markersize=5)
right.set(
    xlabel="time of fall (s)", ylabel="deflection (m)", title="Simulated (dots), series (lines)"
)
ticks = [0.3, 0.5, 1, 2, 3, 5]
right.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
right.minorticks_off()
right.legend()
plt.show()
print(f"lands {1e3 * east[-1]:.2f} mm east and {1e6 * south[-1]:.2f} µm south")
print(
    f"simulated / series: east {east[-1] / series_east[-1]:.9f},"
    f" south {south[-1] / series_south[-1]:.9f}"
)

# %% [markdown]
# Gravity is uniform in this model. On the real Earth its change along the shaft has an effect as
# large as the second-order term, so only the eastward deflection is a prediction.
#
# ## 3. A bead in a tumbling box
#
# A box tumbles freely, thrown almost about its intermediate axis. `RotatingFrame.from_trajectory`
# returns the frame of its body axes. A bead floats inside without touching anything: in space it
# moves along a straight line.

# %%
sides = np.array([0.46, 0.38, 0.30])  # m
box = ph.Inertia.from_box(12.0, sides)
thrown = ph.State(wxyz=[1.0, 0.0, 0.0, 0.0], omega_body=[0.05, 2.0, 0.02])
ts = jnp.linspace(0.0, 24.0, 961)
tumble = ph.simulate(ph.Scene(box), thrown, ts)
frame = ph.RotatingFrame.from_trajectory(tumble)

drift = np.array([-0.010, 0.0015, 0.002])  # m/s in space
at = jnp.array([0.125, 0.0, -0.03])  # m, in the box; the box is not turned yet
moving = eqx.filter_jit(frame.velocity_to_frame)(ts[0], at, jnp.asarray(drift))
bead = ph.frames.simulate_particles(frame, at, moving, ts, rtol=1e-12)
in_space = eqx.filter_jit(lambda paths: paths.position_space)(bead)

line = np.asarray(at) + np.asarray(ts)[:, None] * drift
print("farthest from the straight line:", float(np.abs(in_space - line).max()), "m")
assert np.all(np.abs(bead.position) < sides / 2)  # it never meets a wall

# %%
CORNERS = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]) * sides / 2
EDGES = [(a, b) for a in range(8) for b in range(a) if np.sum(CORNERS[a] != CORNERS[b]) == 1]


def draw_box(ax, turn, **style):
    corners = CORNERS @ np.asarray(turn).T
    for a, b in EDGES:
        ax.plot(*corners[[a, b]].T, **style)


def draw_path(ax, path):
    path = np.asarray(path)
    for k in range(0, len(path) - 1, 8):
        shade = plt.cm.viridis(0.95 * k / len(path))
        ax.plot(*path[k : k + 9].T, color=shade, linewidth=1.6, zorder=3)
    ax.scatter(*path[0], color=plt.cm.viridis(0.0), s=36, zorder=5)
    ax.scatter(*path[-1], color=plt.cm.viridis(0.95), s=36, zorder=5)


fig = plt.figure(figsize=(9.6, 4.4))
inside, outside = (fig.add_subplot(1, 2, k, projection="3d") for k in (1, 2))
draw_box(inside, np.eye(3), color=INK, linewidth=1.2)
draw_path(inside, bead.position)
inside.set_title("Seen in the box")
for k, faint in ((0, 0.9), (24, 0.22), (48, 0.22)):
    turn = ph.rotation.wxyz_to_matrix(tumble.wxyz[k])
    draw_box(outside, turn, color=INK, linewidth=1.0, alpha=faint)
draw_path(outside, in_space)
outside.set_title("Seen from space: a straight line")
for ax in (inside, outside):
    ax.set_proj_type("ortho")
    ax.view_init(24, -58)
    ax.set(xlim=(-0.26, 0.26), ylim=(-0.26, 0.26), zlim=(-0.26, 0.26))
    ax.set_box_aspect((1, 1, 1), zoom=1.2)
    ax.set_axis_off()
plt.show()

# %% [markdown]
# ### The same bead on a spring is an accelerometer
#
# Fix the bead at a corner of the box with a stiff, critically damped spring. The spring stretches
# until its force balances the centrifugal and Euler forces, so that stretch times stiffness over
# mass is minus the reading of an accelerometer at this point. `ph.accelerometer` computes that
# reading from the equations of motion.

# %%
corner = jnp.asarray(0.45 * sides)
stiffness = 400.0**2  # N/m on 1 kg: it settles within some 1/400 s


def spring(t, position, velocity):
    return -stiffness * (position - corner) - 2 * jnp.sqrt(stiffness) * velocity


shown = ts[:481]
held = ph.frames.simulate_particles(
    frame, corner, jnp.zeros(3), shown, FrameForce(spring), rtol=1e-8
)
stretch = -stiffness * (held.position - corner)
reading = ph.accelerometer(tumble, corner)[:481]

everywhere = jnp.broadcast_to(corner, (481, 3))
centrifugal = eqx.filter_jit(frame.centrifugal)(shown, everywhere)
euler = eqx.filter_jit(frame.euler)(shown, everywhere)

fig, (top, bottom) = plt.subplots(2, 1, figsize=(9.6, 5.4), sharex=True)
for k, color in enumerate((RED, GREEN, BLUE)):
    top.plot(shown, reading[:, k], color=color, label=f"accelerometer, {'xyz'[k]}")
    top.plot(shown[4::8], stretch[4::8, k], "o", color=color, markersize=3.5)
top.set(ylabel="m/s²", title="Reading at the corner (lines), bead on a spring (dots)")
for force, color, name in ((centrifugal, INK, "centrifugal"), (euler, RED, "Euler")):
    bottom.plot(shown, np.linalg.norm(force, axis=-1), color=color, label=name)
bottom.set(ylabel="m/s²", xlabel="time (s)", title="The forces on the bead, per unit mass")
for ax in (top, bottom):
    ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    ax.margins(x=0.01)
plt.show()

lag = float(np.abs(stretch[4:] - reading[4:]).max() / np.abs(reading).max())
print(f"bead against accelerometer: {lag:.1e} of the largest reading")
gap = float(np.abs(reading + centrifugal + euler).max())
print(f"reading + centrifugal + Euler: {gap:.1e} m/s^2")
