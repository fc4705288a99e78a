"""Runs of a campaign by the machines of a live run, in virtual time.

They have the schedule's sampling, delays and acknowledgements.

The input is constant over a step of the plant, so the cost is exact. Over a step of length h, with
z = (x, u) and ż = G z, it is zᵀMz with M = ∫₀ʰ e^{Gᵀs} diag(Q, R) e^{Gs} ds (Van Loan 1978).
Disturbances are constant over a step, too, and part of z with weight 0. The cost of a nonlinear
plant is computed by the trapezoidal rule over the plant's steps. All other metrics are computed
from samples: x at the plant's steps, e_c at the measurements.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from cosim.record.align import align_tables, in_common
from cosim.record.packet_outcomes import packet_outcomes
from cosim.record.run_record import RunRecord
from cosim.simulation.batch.batch_interface import ROW
from cosim.simulation.batch.batch_status import DIVERGED, OK, TOO_MANY_EVENTS
from cosim.simulation.virtual_time import simulate
from cosim.studies.campaign.random_draws import drawn_scenario
from noack.config.scenario import Scenario
from noack.config.sections.run_sections import PortsSection, RealtimeSection, SeedsSection
from noack.core.clock import NS_PER_S
from noack.core.linear_systems import Matrix
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    NO_SEQUENCE,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
)

_UNKNOWN = (
    "inter_event_min_s", "inter_event_mean_s", "settling_s", "cost", "sup_e_c_scaled",
    "final_norm", "diverged_at_s",
)  # fmt: skip
"""Columns without a value in some runs."""


@dataclass(frozen=True)
class SampledWork:
    """Computes draws of a grid point in virtual time.

    Args:
        scenario: its plant and initial state are not yet drawn; see :func:`in_virtual_time`.
        seed: of the draws.
        Q: weight of the state in the cost, (n, n); None: the identity.
        R: weight of the input, (m, m); None: the identity.
        settle: a run has settled when ‖x‖ stays at or below this share of ‖x(0)‖.
        most_events: a run with more events is stopped.
    """

    scenario: Scenario
    seed: int
    Q: Matrix | None
    R: Matrix | None
    settle: float
    most_events: int

    def run(self, draws: range) -> NDArray[np.void]:
        """Compute consecutive draws; one row of ``batch_interface.ROW`` each."""
        rows = np.zeros(len(draws), ROW)
        for row, draw in zip(rows, draws, strict=True):
            record = simulate(drawn_scenario(self.scenario, self.seed, draw))
            with np.errstate(all="ignore"):  # the status reports a run that diverges
                self._measure(record, row)
        return rows

    def _measure(self, record: RunRecord, row: np.void) -> None:
        measurements, steps = record[SENSOR_MEASUREMENT], record[PLANT_STEP]
        events_s = measurements["t_ns"][measurements["event"] != NO_SEQUENCE] / NS_PER_S
        gaps_s = np.diff(events_s)
        row["transmissions"] = len(events_s)
        row["deliveries"] = len(record[CONTROLLER_DELIVERY])
        row["longest_loss_burst"] = packet_outcomes(record).longest_loss_burst()
        for name in _UNKNOWN:
            row[name] = np.nan
        if len(gaps_s):
            row["inter_event_min_s"], row["inter_event_mean_s"] = gaps_s.min(), gaps_s.mean()
        norms, t_s = np.linalg.norm(steps["x"], axis=1), steps["t_ns"] / NS_PER_S
        lost = np.flatnonzero(~np.isfinite(norms))
        if len(lost):
            row["status"], row["diverged_at_s"] = DIVERGED, t_s[lost[0]]
            return
        if len(events_s) > self.most_events:
            row["status"] = TOO_MANY_EVENTS
            return
        row["status"] = OK
        if norms[-1] <= self.settle * norms[0]:
            row["settling_s"] = t_s[norms > self.settle * norms[0]].max(initial=0.0)
        row["final_norm"] = norms[-1]
        row["cost"] = self._cost(record)
        joined = align_tables(record)
        decay_per_s = record.scenario.trigger.threshold_decay_per_s
        scaled = joined.e_c_norm * np.exp(decay_per_s * joined.t_ns / NS_PER_S)
        row["sup_e_c_scaled"] = scaled[in_common(record.scenario, joined)].max(initial=0.0)

    def _cost(self, record: RunRecord) -> float:
        loop, steps = record.loop, record[PLANT_STEP]
        n, m = loop.n, loop.m
        if not record.scenario.coverage.is_linear:
            return self._trapezoid(record)
        inputs = {"u": loop.B, "d": loop.B, "w": np.eye(n)}
        inputs = {name: B for name, B in inputs.items() if name in (steps.dtype.names or ())}
        through = np.hstack(list(inputs.values()))
        size = n + through.shape[1]
        weight = np.zeros((size, size))
        weight[:n, :n], weight[n : n + m, n : n + m] = self._weights(n, m)
        drift = np.zeros((size, size))
        drift[:n, :n], drift[:n, n:] = loop.A, through
        block = np.block([[-drift.T, weight], [np.zeros((size, size)), drift]])
        block = expm(block * (record.scenario.timing.plant_period_ns / NS_PER_S))
        over_a_step = block[size:, size:].T @ block[:size, size:]
        z = np.hstack([steps[name] for name in ("x", *inputs)])[:-1]
        return float(np.einsum("kj,kj->", z @ over_a_step, z))

    def _trapezoid(self, record: RunRecord) -> float:
        x, u = record[PLANT_STEP]["x"], record[PLANT_STEP]["u"][:-1]
        Q, R = self._weights(record.loop.n, record.loop.m)
        step_s = record.scenario.timing.plant_period_ns / NS_PER_S
        of_x = np.trapezoid(np.einsum("ki,ij,kj->k", x, Q, x))
        return float(step_s * (of_x + np.einsum("ki,ij,kj->", u, R, u)))

    def _weights(self, n: int, m: int) -> tuple[Matrix, Matrix]:
        Q, R = self.Q, self.R
        return np.eye(n) if Q is None else Q, np.eye(m) if R is None else R


def in_virtual_time(scenario: Scenario) -> Scenario:
    """Return the scenario without the settings that do not affect its simulation."""
    sections = {"seeds": SeedsSection(), "ports": PortsSection(), "realtime": RealtimeSection()}
    return scenario.model_copy(
        update={"name": "campaign", "description": "", "speed": 1.0, **sections}
    )
