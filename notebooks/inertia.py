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
# # Inertia: from parts to principal axes
#
# [![Open in Colab](https://colab.research.google.com/assets/colab-badge.svg)](https://colab.research.google.com/github/polhode/polhode/blob/main/notebooks/inertia.ipynb)
#
# A spacecraft, drawn in its designer's axes, is to rotate about z. Whether this is a permanent
# rotation depends on its principal axes. This notebook computes the inertia tensor from the parts,
# its principal axes, and the motion, and then balances the spacecraft.

# %%
# Needs polhode with its figures, installed from a checkout or from an archive of a release (on
# Colab: upload the archive first). Remove the # in front of one line:
# # %pip install '..[all]'
# # %pip install './polhode-<version>.tar.gz[all]'

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

import polhode as ph
from polhode import rotation
from polhode.inertia import compose, is_physical
from polhode.plot import polhode

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
np.set_printoptions(precision=3, suppress=True)

# %% [markdown]
# ## From parts to a tensor
#
# The spacecraft consists of a bus, two inclined solar panels, and a boom with a ball at its tip.
# Each part is a simple shape, `moved` to its position; `compose` adds the masses, computes the
# common centre of mass and shifts every tensor to it.

# %%
bus_sides, panel_sides = np.array([1.2, 1.0, 0.6]), np.array([1.0, 2.0, 0.04])
foot, tip = np.array([0.5, 0.1, 0.3]), np.array([1.5, 0.4, 1.3])  # ends of the boom, m

sunward = rotation.axis_angle_to_wxyz(jnp.array([0.0, 1.0, 0.0]), jnp.deg2rad(35.0))
boom_length = np.linalg.norm(tip - foot)
tilt_axis = np.cross([0.0, 0.0, 1.0], tip - foot)
tilt = jnp.arccos((tip - foot)[2] / boom_length)
along_boom = rotation.axis_angle_to_wxyz(tilt_axis / np.linalg.norm(tilt_axis), tilt)  # from z

MP = ph.MassProperties
parts = {
    "bus": MP.from_box(120.0, bus_sides),
    "left panel": MP.from_box(9.0, panel_sides).moved([0.0, -1.6, 0.1], sunward),
    "right panel": MP.from_box(9.0, panel_sides).moved([0.0, 1.6, 0.1], sunward),
    "boom": MP.from_rod(2.0, boom_length, 0.02).moved((foot + tip) / 2, along_boom),
    "ball": MP.from_sphere(3.0, 0.12).moved(tip),
}
craft = compose(parts.values())
print("mass          ", float(craft.mass), "kg")
print("centre of mass", np.asarray(craft.centre), "m")
print("inertia about it, kg m^2, in the designer's axes:")
print(np.asarray(craft.inertia.tensor))

# %% [markdown]
# ## From the tensor to principal axes
#
# The products of inertia show that the designer's axes are not principal axes. `to_principal`
# returns the body in principal axes, and the rotation from them to the designer's axes.

# %%
principal, turn = craft.inertia.to_principal()
axes = np.asarray(rotation.wxyz_to_matrix(turn))  # columns: the principal axes in designer's axes
tilt = np.rad2deg(np.arccos(np.abs(axes[2]).max()))
print("principal moments", np.asarray(principal.moments), "kg m^2")
print(f"the principal axis nearest to the designer's z is {tilt:.1f}° away from it")

# %%
SIGNS = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
FACES = [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]]


def draw_box(ax, sides, offset=(0.0, 0.0, 0.0), wxyz=(1.0, 0.0, 0.0, 0.0), color=GREY):
    place = np.asarray(rotation.wxyz_to_matrix(jnp.asarray(wxyz)))
    corners = (SIGNS * sides / 2) @ place.T + np.asarray(offset)
    solid = Poly3DCollection(corners[FACES], facecolor=color, edgecolor=INK, linewidth=0.7)
    solid.set_alpha(0.35)
    ax.add_collection3d(solid)


fig = plt.figure(figsize=(8.0, 5.4))
ax = fig.add_subplot(projection="3d")
draw_box(ax, bus_sides, color="#C9B458")
for side in (-1.6, 1.6):
    draw_box(ax, panel_sides, (0.0, side, 0.1), sunward, color="#4477AA")
ax.plot(*np.stack([foot, tip]).T, color=INK, linewidth=2.5)
ax.scatter(*tip, s=260, color="#B0B0B0", edgecolor=INK)
centre = np.asarray(craft.centre)
for column, color, moment in zip(axes.T, (RED, GREEN, BLUE), principal.moments, strict=True):
    direction = column * np.sign(column[np.argmax(np.abs(column))])
    end = centre + 1.9 * direction
    ax.plot(*np.stack([centre, end]).T, color=color, linewidth=2.4, zorder=10)
    label = centre + 1.9 * direction + np.array([0.0, 0.0, 0.12])
    ax.text(*label, f"{moment:.0f} kg m²", color=color, ha="center", va="bottom", zorder=11)
ax.plot([0, 0], [0, 0], [0, 2.0], color=GREY, linewidth=1.2, linestyle="--")
ax.text(0, 0, 2.1, "designer's z ", color=GREY, ha="right")
ax.set_proj_type("ortho")
ax.view_init(22, 38)
ax.set(xlim=(-2.2, 2.2), ylim=(-2.2, 2.2), zlim=(-1.8, 2.6))
ax.set_box_aspect((1, 1, 1), zoom=1.5)
ax.set_axis_off()
plt.show()

# %% [markdown]
# ## Unconstrained parameters
#
# Not every symmetric matrix is an inertia tensor: the moments are positive and none exceeds the sum
# of the other two. The log-Cholesky parameters (Rucker and Wensing 2022) are unconstrained: *any*
# ten real numbers are the mass properties of a possible body. They suit optimisation and the
# propagation of uncertainty.

# %%
ten = craft.to_log_cholesky()
back = MP.from_log_cholesky(ten)
print("log-Cholesky", np.asarray(ten))
print(
    "there and back, worst change:",
    float(jnp.abs(back.central.tensor - craft.central.tensor).max()),
)

rng = np.random.default_rng(3)
spread = 0.35
count = 1500
six = craft.inertia.to_log_cholesky() + spread * rng.normal(size=(count, 6))
bodies = ph.Inertia.from_log_cholesky(six)
noise = rng.normal(size=(count, 3, 3)) * spread * float(principal.moments.mean())
tensors = craft.inertia.tensor + jnp.asarray(noise + noise.transpose(0, 2, 1)) / 2
good = np.asarray(is_physical(tensors))
print(
    f"physical: {np.asarray(is_physical(bodies.tensor)).mean():.0%} by log-Cholesky,"
    f" {good.mean():.0%} by entry"
)


# %%
def shape_of(moments):
    """Smallest and middle moment over the largest."""
    moments = np.sort(np.asarray(moments), axis=-1)
    return moments[..., 0] / moments[..., 2], moments[..., 1] / moments[..., 2]


fig, panels = plt.subplots(1, 2, figsize=(9.6, 4.4), sharex=True, sharey=True)
by_entry = np.linalg.eigvalsh(tensors)
for ax, title in zip(
    panels, ("Uncertain log-Cholesky parameters", "Uncertain entries"), strict=True
):
    ax.fill([0, 0.5, 1, 0], [1, 0.5, 1, 1], color="#EEF3F7", zorder=0)
    ax.plot([0, 0.5, 1, 0], [1, 0.5, 1, 1], color=GREY, linewidth=1)
    ax.set(xlim=(-0.25, 1.02), ylim=(0.2, 1.03), aspect="equal")
    ax.set(title=title, xlabel="smallest / largest moment")
panels[0].set_ylabel("middle / largest moment")
panels[0].scatter(*shape_of(bodies.moments), s=7, color=BLUE, alpha=0.5, linewidth=0)
panels[1].scatter(*shape_of(by_entry[good]), s=7, color=BLUE, alpha=0.5, linewidth=0)
panels[1].scatter(*shape_of(by_entry[~good]), s=7, color=RED, alpha=0.5, linewidth=0)
for ax in panels:
    ax.plot(*shape_of(principal.moments), "o", color=INK, markeredgecolor="white", markersize=9)
panels[1].text(0.5, 0.3, "no body has these", color=RED)
panels[0].text(0.22, 0.72, "flat", color=GREY, rotation=-45, ha="center", va="center")
panels[0].text(0.93, 0.96, "sphere", color=GREY, ha="right", va="center")
plt.show()

# %% [markdown]
# ## The motion
#
# If it starts with a rotation about the designer's z at 6 rpm, the spacecraft tumbles: its angular
# velocity follows a polhode on the inertia ellipsoid instead of remaining on a principal axis.
# `periods` returns the two periods of the motion.

# %%
spin = 6 * 2 * np.pi / 60
state = ph.State(wxyz=[1.0, 0.0, 0.0, 0.0], omega_body=[0.0, 0.0, spin])
ts = jnp.linspace(0.0, 240.0, 2401)
tumble = ph.simulate(ph.Scene(craft.inertia), state, ts)
found = ph.periods(craft.inertia, state)
print(ph.Mode(int(found.mode)).name, "mode:", end=" ")
print(f"P_psi = {float(found.P_psi):.2f} s, P_phi = {float(found.P_phi):.2f} s")
print("energy kept to", f"{float(jnp.ptp(tumble.energy) / tumble.energy[0]):.0e}")

momentum = tumble.momentum_space[0] / jnp.linalg.norm(tumble.momentum_space[0])
z_in_space = rotation.rotate(tumble.wxyz, jnp.broadcast_to(jnp.array([0.0, 0.0, 1.0]), (2401, 3)))
off = np.rad2deg(np.arccos(np.asarray(z_in_space @ momentum)))

# %%
fig = plt.figure(figsize=(9.6, 4.6))
left = fig.add_subplot(1, 2, 1, projection="3d")
polhode(tumble, ax=left, view=(38.0, 20.0))
left.set_title("Polhode on the inertia ellipsoid")
right = fig.add_subplot(1, 2, 2)
right.plot(ts, off, color=BLUE)
for k in range(1, int(240 / float(found.P_psi)) + 1):
    right.axvline(k * float(found.P_psi), color=GREY, linewidth=0.8, linestyle="--")
right.set(xlabel="time (s)", ylabel="degrees", ylim=(0, None))
right.set_title("Angle of the designer's z to the angular momentum\n(dashed: every P_psi)")
plt.show()

# %% [markdown]
# ## Balancing
#
# Everything above is differentiable, so the spacecraft can be balanced by shifting two battery
# packs of 30 kg on the deck and on the floor of the bus. Newton's method determines the positions
# that make z a principal axis through the centre of the bus.


# %%
def with_batteries(places):
    """The craft with 30 kg at (x, y) = places[0] on the deck and places[1] on the floor [m]."""
    heights = jnp.array([[0.25], [-0.25]])
    packs = MP.from_points(jnp.array([30.0, 30.0]), jnp.concatenate([places, heights], axis=1))
    return craft + packs


def imbalance(places):
    """Products of inertia with z, and the offset of the mass centre: all to be zero."""
    made = with_batteries(places)
    return jnp.stack([made.central.tensor[:2, 2], made.centre[:2]])


places = jnp.zeros((2, 2))
for _ in range(4):
    slope = jax.jacfwd(imbalance)(places).reshape(4, 4)
    step = jnp.linalg.solve(slope, imbalance(places).reshape(4))
    places = places - step.reshape(2, 2)
print("deck ", np.asarray(places[0]), "m,  floor", np.asarray(places[1]), "m")
print("products with z and offset left:", f"{float(jnp.abs(imbalance(places)).max()):.0e}")

steady = ph.simulate(ph.Scene(with_batteries(places).inertia), state, ts)
apart = float(jnp.abs(steady.omega_body - state.omega_body[None]).max()) / spin
print(f"spun about z as before, the rates stay within {apart:.0e} of what they were")
