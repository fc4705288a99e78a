# %% [markdown]
# # Model or hold: how often, under which losses
#
# Between two updates the controller knows nothing new. It can go on with a model of the plant
# (`mode = "model"`), or hold what it was told last (`mode = "zoh"`). How many transmissions does a
# model save, and what becomes of that when the network loses packets? Here for the paper's
# lane-following example, over loss rates from none to eight in ten, at most four in a row, for two
# seeds of the losses, at half the example's rate. Over thousands of draws, for thresholds of any
# size and with confidence intervals, the two are compared by `noack campaign mb_vs_zoh`
# (docs/campaigns.md).

# %%
import matplotlib.pyplot as plt
import numpy as np

import noack

LOSS_RATES = [0.0, 0.4, 0.8]
SEEDS = [1, 2]
scenario = noack.load("lane_following", {"plant.rate_hz": 250.0, "controller.rate_hz": 250.0})
print(scenario)

# %% [markdown]
# ## The runs
#
# One row per run. The car is beside its lane at first; it has settled when ‖x‖ stays below a
# twentieth of ‖x(0)‖.

# %%
rows = []
for mode in ("model", "zoh"):
    for loss_rate in LOSS_RATES:
        for seed in SEEDS:
            run = noack.simulate(
                noack.with_settings(
                    scenario,
                    {"mode": mode, "network.loss.probability": loss_rate, "seeds.loss": seed},
                )
            )
            steps = run.table("plant_step")
            x = np.column_stack([steps[f"x_{i}"] for i in (1, 2, 3, 4)])
            norm = np.linalg.norm(x, axis=1)
            settled_s = steps["t_s"].to_numpy()[norm > 0.05 * norm[0]].max()
            rows.append((mode, loss_rate, run.events().num_rows, settled_s))

# %% [markdown]
# ## How often
#
# Medians over the seeds.

# %%
print("mode   loss rate  transmissions  settled, s")
medians = {}
for mode in ("model", "zoh"):
    for loss_rate in LOSS_RATES:
        found = [row[2:] for row in rows if row[:2] == (mode, loss_rate)]
        events, settled_s = medians[mode, loss_rate] = np.median(found, axis=0)
        print(f"{mode:<6} {loss_rate:9.1f}  {events:13.0f}  {settled_s:10.1f}")

# %%
figure, (above, below) = plt.subplots(2, 1, sharex=True, layout="constrained")
for mode, marker in (("model", "o"), ("zoh", "s")):
    points = np.array([row[1:] for row in rows if row[0] == mode], dtype=float)
    middle = np.array([medians[mode, loss_rate] for loss_rate in LOSS_RATES])
    for axes, column in ((above, 0), (below, 1)):
        (line,) = axes.plot(LOSS_RATES, middle[:, column], marker=marker, label=mode)
        axes.plot(points[:, 0], points[:, 1 + column], ".", color=line.get_color(), alpha=0.4)
above.set_ylabel("transmissions in 20 s")
above.set_yscale("log")
above.legend(title="between updates")
below.set_ylabel("settled [s]")
below.set_xlabel("probability of loss, before the cap")
figure.savefig("model_or_hold.svg")
