"""Losses and a loop that several tests of random losses use."""

import numpy as np

import noack
from netem.guarantee.loss_guarantee import LossGuarantee
from netem.impairments.loss_prediction import LossProcess, OutcomeChain
from netem.impairments.markov_chain import Array
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.theory.random_losses import mean_square_growth as mean_square_module
from noack.theory.time_triggered.exact_matrices import exactly

BURSTY = LossProcess(np.array([0.8, 0.2]), np.array([[0.9, 0.1], [0.4, 0.6]]), np.array([0.05, 0.8]))

NOISE = {
    "plant.disturbances": [
        {"kind": "gaussian", "std": [0.5]},
        {"kind": "uniform", "bound": [0.2, 0.4], "at": "state"},
    ],
    "plant.measurement.noise_std": [0.05, 0.1],
}
BURSTS = {"model": "gilbert_elliott", "good_to_bad": 0.3, "bad_to_good": 0.4, "loss_in_good": 0.1,
          "loss_in_bad": 0.9}  # fmt: skip


def scenario(**settings: object) -> Scenario:
    timing = {"plant.rate_hz": 40.0, "controller.rate_hz": 40.0, "horizon_s": 1.5}
    trigger = {"policy": "periodic", "period_s": 0.25}
    settings = {**timing, "trigger": trigger, "certificate.late_periods": 0, "outputs": None, **settings}
    return resolve(noack.load("double_integrator", settings=settings))


def independent(p: float) -> LossProcess:
    return LossProcess(np.ones(1), np.ones((1, 1)), np.array([p]))


def unlimited(process: LossProcess) -> OutcomeChain:
    return process.outcomes(LossGuarantee())


def mean_square_growth(maps: list[tuple[Array, Array]], chain: OutcomeChain) -> float:
    exact = [(exactly(delivered), exactly(lost)) for delivered, lost in maps]
    return mean_square_module.mean_square_growth(exact, chain)
