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
# # Training a controller on 4,096 bodies
#
# [![Open in Colab](https://colab.research.google.com/assets/colab-badge.svg)](https://colab.research.google.com/github/polhode/polhode/blob/main/notebooks/training.ipynb)
#
# Satellites leave the launcher with random attitudes and rates. A controller must stop their
# rotation and bring them to a fixed attitude within ten seconds. This notebook trains two
# controllers by gradient descent through the simulation: a linear law and a small network. It then
# optimises a slew by two pulses, and designs a body that nutates with a prescribed period.

# %%
# Needs polhode with its figures and optax, installed from a checkout or from an archive of a
# release (on Colab: upload the archive first). Remove the # in front of one line:
# # %pip install '..[all]' optax
# # %pip install './polhode-<version>.tar.gz[all]' optax

# %%
import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax

import polhode as ph

jax.config.update("jax_enable_x64", True)
plt.rcParams.update(
    {
        "figure.dpi": 80,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "legend.frameon": False,
        "figure.constrained_layout.use": True,
    }
)
body = ph.Inertia.from_moments([1.0, 1.5, 2.0])
count, batch = 4096, 128
attitudes = jax.random.normal(jax.random.key(1), (count, 4))
rates = 0.3 * jax.random.normal(jax.random.key(2), (count, 3))

# %% [markdown]
# ## Two controllers
#
# Both controllers are Equinox modules, whose arrays are the parameters. The torque about each axis
# is limited, by `clip` in the linear law and by `tanh` in the network.


# %%
class Linear(eqx.Module):
    gains: jax.Array

    def __call__(self, t, wxyz, omega_body):
        error = jnp.sign(wxyz[0]) * wxyz[1:]
        return jnp.clip(-self.gains @ jnp.concatenate([error, omega_body]), -0.5, 0.5)


class Network(eqx.Module):
    layers: eqx.nn.MLP

    def __call__(self, t, wxyz, omega_body):
        error = jnp.sign(wxyz[0]) * wxyz[1:]
        return 0.5 * jnp.tanh(self.layers(jnp.concatenate([error, omega_body])))


linear = Linear(jnp.concatenate([0.1 * jnp.eye(3), 0.1 * jnp.eye(3)], axis=1))
layers = eqx.nn.MLP(6, 3, 16, 2, activation=jax.nn.relu, key=jax.random.key(0))
network = Network(layers)

# %% [markdown]
# ## The loop
#
# The gradient of a minibatch is noisy in any case, so the steps need not end at the kinks of `relu`
# and `clip` (`ph.CoarseSteps`). A body that does not finish within 400 steps is excluded from the
# mean.

# %%
ts = np.array([0.0, 10.0])
coarse = ph.CoarseSteps(max_steps=400)


def cost(trajectory):
    last = trajectory.last
    return 1 - last.wxyz[..., 0] ** 2 + jnp.sum(last.omega_body**2, axis=-1)


def loss(controller, states):
    scene = ph.Scene(body, torque=ph.FeedbackTorque(controller))
    trajectory = ph.simulate(scene, states, ts, coarse, rtol=1e-3)
    return ph.successful_mean(trajectory, cost), jnp.sum(~trajectory.successful)


def train(controller, rate, epochs, trained=eqx.is_inexact_array):
    """The controller after so many epochs, and the loss of every minibatch."""
    optimiser = optax.adam(rate)
    free, fixed = eqx.partition(controller, trained)

    @eqx.filter_jit
    def update(free, memory, states):
        def of(free):
            return loss(eqx.combine(free, fixed), states)

        (value, failed), gradient = eqx.filter_value_and_grad(of, has_aux=True)(free)
        change, memory = optimiser.update(gradient, memory)
        return eqx.apply_updates(free, change), memory, value, failed

    memory, history = optimiser.init(free), []
    for epoch in range(epochs):
        order = jax.random.permutation(jax.random.key(epoch), count).reshape(-1, batch)
        lost = 0
        for chosen in order:
            states = ph.State(attitudes[chosen], rates[chosen])
            free, memory, value, failed = update(free, memory, states)
            history.append(float(value))
            lost += int(failed)
        mean = np.mean(history[-len(order) :])
        print(f"epoch {epoch + 1}: mean cost {mean:.2f}, {lost} bodies not finished")
    return eqx.combine(free, fixed), history


# %%
linear, by_linear = train(linear, 2e-2, 3)

# %%
network, by_network = train(network, 1e-2, 3)

# %% [markdown]
# For a progress bar instead of the printed lines, wrap the loop in `tqdm.trange`. The next cells
# train only the last layer of the network further: a filter freezes all other leaves.

# %%
chosen = jax.tree.map(lambda _: False, network)
chosen = eqx.tree_at(lambda n: n.layers.layers[-1].weight, chosen, True)
network, finer = train(network, 2e-3, 1, chosen)

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3))
left.semilogy(by_linear, label="linear, clipped")
left.semilogy([*by_network, *finer], label="network")
left.set(xlabel="update", ylabel="cost of a minibatch")
left.legend()
times = np.linspace(0.0, 10.0, 101)
for controller, style in ((linear, "C0"), (network, "C1")):
    scene = ph.Scene(body, torque=ph.FeedbackTorque(controller))
    path = ph.simulate(scene, ph.State(attitudes[:6], rates[:6]), times, rtol=1e-6)
    right.plot(times, 2 * np.degrees(np.arccos(np.minimum(np.abs(path.wxyz[..., 0]), 1))).T, style)
right.set(xlabel="time (s)", ylabel="angle to the target (deg)")
plt.show()

# %% [markdown]
# ## A slew by two pulses
#
# The satellite rotates by 90 degrees, from rest to rest, about an axis that is not principal.
# Thrusters act along two directions for a limited time. The unknowns are the impulses and the start
# of the second pulse.

# %%
still = ph.State([1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0])
wanted = np.array([np.cos(np.pi / 4), 0.0, np.sin(np.pi / 4) * 0.6, np.sin(np.pi / 4) * 0.8])


def slew(unknowns):
    push, stop, begin = unknowns[:3], unknowns[3:6], unknowns[6]
    first = ph.Pulses(ph.BodyTorque(push), jnp.array([0.0]), jnp.array([1.0]))
    second = ph.Pulses(ph.BodyTorque(stop), begin[None], begin[None] + 1)
    scene = ph.Scene(body, torque=first + second)
    return ph.simulate(scene, still, [0.0, 8.0], rtol=1e-8).last


def miss(unknowns):
    last = slew(unknowns)
    return 1 - jnp.dot(last.wxyz, wanted) ** 2 + jnp.sum(last.omega_body**2)


unknowns = jnp.array([0.0, 0.3, 0.6, 0.0, -0.3, -0.6, 5.0])
optimiser = optax.adam(2e-2)
memory, slope = optimiser.init(unknowns), jax.jit(jax.value_and_grad(miss))
for step in range(301):
    value, gradient = slope(unknowns)
    if step % 100 == 0:
        print(f"step {step}: miss {value:.1e}")
    change, memory = optimiser.update(gradient, memory)
    unknowns = unknowns + change

# %% [markdown]
# ## A shape with a given period
#
# A free cylinder of 10 kg and 0.1 m radius nutates (its angular velocity circulates about the axis,
# as seen in the body) with a period that depends on its length. Newton's method, applied to the
# frequency, determines the length for which the rate about x crosses zero upward after 20 s.


# %%
def period(length):
    axial, side = 0.5 * 10 * 0.1**2, 10 * (3 * 0.1**2 + length**2) / 12
    cylinder = ph.Scene(ph.Inertia.from_moments([side, side, axial]))
    state = ph.State([1.0, 0.0, 0.0, 0.0], [0.0, 0.1, 1.0])
    start = ph.Event(lambda wxyz, omega, t: omega[0], direction=1)
    return ph.simulate(cylinder, state, [0.0, 60.0], until=start).event_time


length = 0.3
for _ in range(4):
    value, by_length = jax.value_and_grad(period)(length)
    print(f"length {length:.4f} m: {value:.3f} s")
    slope_of_frequency = -by_length / value**2
    length = length - (1 / value - 1 / 20) / slope_of_frequency
