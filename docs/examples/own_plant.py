# %% [markdown]
# # Your own plant: from matrices to a certificate and a picture
#
# What you need is a linear model ẋ = Âx + B̂u of your plant and a gain K with which u = Kx
# stabilises it. Here: an inverted pendulum of one metre, whose state is the angle from upright, in
# rad, and its rate. The gain is that of the linear-quadratic regulator; SciPy and python-control
# give the K of u = −Kx, so the sign is turned.

# %%
import numpy as np
from scipy.linalg import solve_continuous_are

import noack

A = np.array([[0.0, 1.0], [9.81, -0.1]])
B = np.array([[0.0], [1.0]])
P = solve_continuous_are(A, B, np.diag([10.0, 1.0]), np.eye(1))
K = -B.T @ P
print("eigenvalues of A + BK:", np.linalg.eigvals(A + B @ K).round(2))

# %% [markdown]
# ## A scenario around it
#
# Sensor and controller compute with this model. The true plant is another: its rod is three
# centimetres shorter, and it has more friction. `from_system` chooses whatever is not said: the
# trigger's threshold βe^(−αt) from the loop's decay and from x(0), the horizon from α, and a
# network that loses half of the updates, but never more than four in a row. The box is what is
# believed of the plant: half-widths around A.

# %%
truth = np.array([[0.0, 1.0], [9.81 / 0.97, -0.12]])
scenario = noack.from_system(
    (A, B),
    K,
    [0.2, 0.0],
    plant=(truth, B),
    settings={"plant.uncertainty_A": [[0.0, 0.0], [0.4, 0.05]]},
    name="pendulum",
    state_names=["angle", "rate"],
    input_names=["torque"],
)
print(scenario)

# %% [markdown]
# ## What is guaranteed
#
# Before anything has run: bounds of the errors, of the state and of the time between two events.
# Under the paper's conditions nothing is sampled, delayed or held; under the schedule the loop is
# as it will run, 500 times a second and two steps late. The columns of the box hold for every
# plant in it. A column that says void comes with its reason.

# %%
certificates = noack.certify(scenario)
print(certificates)
for name in ("paper", "schedule", "paper_box", "schedule_box"):
    certificate = getattr(certificates, name)
    print(f"{name}: {certificate.void or 'stands'}")

# %% [markdown]
# ## A run, and its picture
#
# In virtual time: the machines, messages and losses of a live run, without sockets. `noack.run` in
# the place of `noack.simulate` starts the processes. The run is held against the certificates, and
# against the paper's own bounds.

# %%
run = noack.simulate(scenario)
print(run)
for claim in run.claims:
    print(f"{claim.verdict:<9} {claim.what}, by {claim.source}")

# %%
run.plot("states").savefig("own_plant.svg")
run.plot("errors").savefig("own_plant_errors.svg")

# %% [markdown]
# ## Harsher
#
# The same with nine updates in ten lost, and up to nine in a row. Of the run, as a table: when x
# was within a hundredth of a radian for good.

# %%
harsh = noack.with_settings(scenario, {"network.loss.probability": 0.9, "network.mansd": 9})
for case in (scenario, harsh):
    run = noack.simulate(case)
    samples = run.samples()
    t_s, angle = samples["t_s"].to_numpy(), samples["x_1"].to_numpy()
    settled_s = t_s[np.abs(angle) > 0.01].max()
    print(
        f"at most {case.network.mansd} lost in a row: {run.summary.loops[0].events} events, "
        f"{run.summary.loops[0].deliveries} received, upright after {settled_s:.2f} s"
    )
