"""Runs of a campaign by the machines of a live run, in virtual time.

They have the schedule's sampling, delays and acknowledgements.

The input is constant over a step of the plant, so the cost is exact. Over a step of length h, with
z = (x, u) and ż = G z, it is zᵀMz with M = ∫₀ʰ e^{Gᵀs} diag(Q, R) e^{Gs} ds (Van Loan 1978).
Disturbances are constant over a step, too, and part of z with weight 0. The cost of a nonlinear
plant is computed by the trapezoidal rule over the plant's steps. All other metrics are computed
from samples: x at the plant's steps, e_c at the measurements.

Runs of several loops on one network follow at the end.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from cosim.record.align import align_tables, shares_update
from cosim.record.run_events import packet_outcomes, reference_in_run
from cosim.record.run_record import Rows, RunRecord
from cosim.simulation.exact_simulation import DIVERGED, OK, ROW, TOO_MANY_EVENTS
from cosim.simulation.virtual_time import simulate, simulate_loops
from cosim.studies.campaign.random_draws import drawn_scenario, seeds_of
from netem.core.clock import NS_PER_S
from netem.core.packet_rows import NETEM_PACKET, effective
from noack.core.linear_systems import Matrix
from noack.protocol.record_tables import CONTROLLER_DELIVERY, NO_SEQUENCE, PLANT_STEP, SENSOR_MEASUREMENT
from noack.scenario.resolution import ResolvedRun, policy_of
from noack.scenario.run_sections import PortsSection, RealtimeSection, SeedsSection
from noack.scenario.scenario import Scenario

_UNKNOWN = (
    "inter_event_min_s",
    "inter_event_mean_s",
    "settling_s",
    "cost",
    "sup_e_c_scaled",
    "final_norm",
    "diverged_at_s",
)
"""Columns without a value in some runs."""


@dataclass(frozen=True)
class SampledWork:
    """Computes draws of a grid point in virtual time.

    Args:
        scenario: its plant and initial state are not yet drawn; see :func:`in_virtual_time`.
        seed: of the draws.
        Q: weight of the state in the cost, (n, n); None: the identity.
        R: weight of the input, (m, m); None: the identity.
        settle: a run has settled when ‖x − x_r‖ stays at or below this share of its first value.
        most_events: a run with more events is stopped.
        output: the output or state whose largest distance from the reference is measured, or None.
        from_s: from when on.
    """

    scenario: Scenario
    seed: int
    Q: Matrix | None
    R: Matrix | None
    settle: float
    most_events: int
    output: str | None = None
    from_s: float = 0.0

    @property
    def row_type(self) -> np.dtype[np.void]:
        """The type of the rows of runs."""
        return ROW if self.output is None else _with_output(ROW)

    def run(self, draws: range) -> NDArray[np.void]:
        """Compute consecutive draws; one row of ``row_type`` each."""
        rows = np.zeros(len(draws), self.row_type)
        for row, draw in zip(rows, draws, strict=True):
            record = simulate(drawn_scenario(self.scenario, self.seed, draw))
            with np.errstate(all="ignore"):  # the status reports a run that diverges
                self._measure(record, row)
        return rows

    def _measure(self, record: RunRecord, row: np.void) -> None:
        """Fill the row of a run; what is unknown of one that did not end well stays NaN."""
        # Counts and intervals, which every run has.
        measurements, steps = record[SENSOR_MEASUREMENT], record[PLANT_STEP]
        events_s = measurements["t_ns"][measurements["event"] != NO_SEQUENCE] / NS_PER_S
        gaps_s = np.diff(events_s)
        row["transmissions"] = len(events_s)
        row["deliveries"] = len(record[CONTROLLER_DELIVERY])
        row["longest_loss_burst"] = packet_outcomes(record).longest_loss_burst()
        for name in (*_UNKNOWN, *(() if self.output is None else (OUTPUT_LARGEST,))):
            row[name] = np.nan
        if len(gaps_s):
            row["inter_event_min_s"], row["inter_event_mean_s"] = gaps_s.min(), gaps_s.mean()
        # How the run ended.
        norms, t_s = np.linalg.norm(steps["x"], axis=1), steps["t_ns"] / NS_PER_S
        lost = np.flatnonzero(~np.isfinite(norms))
        if len(lost):
            row["status"], row["diverged_at_s"] = DIVERGED, t_s[lost[0]]
            return
        if len(events_s) > self.most_events:
            row["status"] = TOO_MANY_EVENTS
            return
        row["status"] = OK
        # Settling, about the reference.
        x, reference = steps["x"], reference_in_run(record)
        if reference is not None:
            x = x - reference.states(steps["t_ns"])
        deviations = np.linalg.norm(x, axis=1)
        settled_norm = self.settle * deviations[0]
        if deviations[-1] <= settled_norm:
            row["settling_s"] = t_s[deviations > settled_norm].max(initial=0.0)
        row["final_norm"] = norms[-1]
        if self.output is not None:
            y = x[t_s >= self.from_s] @ measured_rows(record.scenario)[self.output]
            row[OUTPUT_LARGEST] = np.abs(y).max(initial=0.0)
        row["cost"] = self._cost(record)
        # The controller's error, where it shares an update with the sensor.
        aligned = align_tables(record)
        decay_per_s = policy_of(record.scenario).fading_per_s
        scaled_errors = aligned.e_c_norm * np.exp(decay_per_s * aligned.t_ns / NS_PER_S)
        row["sup_e_c_scaled"] = scaled_errors[shares_update(record.scenario, aligned)].max(initial=0.0)

    def _cost(self, record: RunRecord) -> float:
        """Return ∫ xᵀQx + uᵀRu dt, exactly, as inputs are held (Van Loan 1978)."""
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
        block = expm(block * (record.scenario.timing.plant_period.seconds))
        over_a_step = block[size:, size:].T @ block[:size, size:]
        z = np.hstack([steps[name] for name in ("x", *inputs)])[:-1]
        return float(np.einsum("kj,kj->", z @ over_a_step, z))

    def _trapezoid(self, record: RunRecord) -> float:
        x, u = record[PLANT_STEP]["x"], record[PLANT_STEP]["u"][:-1]
        Q, R = self._weights(record.loop.n, record.loop.m)
        step_s = record.scenario.timing.plant_period.seconds
        of_x = np.trapezoid(np.einsum("ki,ij,kj->k", x, Q, x))
        return float(step_s * (of_x + np.einsum("ki,ij,kj->", u, R, u)))

    def _weights(self, n: int, m: int) -> tuple[Matrix, Matrix]:
        Q, R = self.Q, self.R
        return np.eye(n) if Q is None else Q, np.eye(m) if R is None else R


def measured_rows(scenario: Scenario) -> Mapping[str, NDArray[np.float64]]:
    """Return the rows of a loop's outputs and states, (n,), by their names."""
    outputs = {output.name: np.array(output.row) for output in scenario.loop_outputs()}
    names = scenario.named_model.state_names or ()
    return {**dict(zip(names, np.eye(len(names)), strict=True)), **outputs}


def in_virtual_time(scenario: Scenario) -> Scenario:
    """Return the scenario without the settings that do not affect its simulation."""
    sections = {"seeds": SeedsSection(), "ports": PortsSection(), "realtime": RealtimeSection()}
    return scenario.model_copy(update={"name": "campaign", "description": "", "speed": 1.0, **sections})


OUTPUT_LARGEST = "output_largest"


def _with_output(row: np.dtype[np.void]) -> np.dtype[np.void]:
    return np.dtype([*row.descr, (OUTPUT_LARGEST, "<f8")])


LOOPS_ROW = np.dtype(
    [
        *ROW.descr,
        *((name, "<f8") for name in ("cost_worst", "loops_failed", "updates_late", "delay_max_s")),
    ]
)
"""The row of a run of loops that share a network.

cost_worst: the largest cost of a loop. loops_failed: share of the loops that diverged or exceeded
the largest number of events. updates_late: share of the delivered updates that were late.
delay_max_s: largest time of a delivered update in the network.
"""
_OF_ALL: Mapping[str, Callable[[NDArray[np.float64]], float]] = {
    "transmissions": np.sum,
    "deliveries": np.sum,
    "longest_loss_burst": np.max,
    "inter_event_min_s": np.min,
    "inter_event_mean_s": np.mean,
    "settling_s": np.max,
    "cost": np.mean,
    "sup_e_c_scaled": np.max,
    "final_norm": np.max,
    OUTPUT_LARGEST: np.max,
}


@dataclass(frozen=True)
class SharedNetworkWork(SampledWork):
    """Computes draws of a grid point of a scenario with [[loops]].

    Loop k of draw i has the same plant, initial state and phase for any number of loops.
    """

    @property
    def row_type(self) -> np.dtype[np.void]:
        """The type of the rows of runs."""
        return LOOPS_ROW if self.output is None else _with_output(LOOPS_ROW)

    def run(self, draws: range) -> NDArray[np.void]:
        """Compute consecutive draws; one row of ``row_type`` each."""
        rows = np.zeros(len(draws), self.row_type)
        for row, draw in zip(rows, draws, strict=True):
            seeds = seeds_of(self.seed, draw)
            run = ResolvedRun(self.scenario.model_copy(update={"seeds": seeds}))
            records = [*simulate_loops(run).loops]
            loops = np.zeros(len(records), super().row_type)
            with np.errstate(all="ignore"):  # loops may diverge
                for loop_row, record in zip(loops, records, strict=True):
                    self._measure(record, loop_row)
            for name in loops.dtype.names or ():
                if name in _OF_ALL:
                    row[name] = _OF_ALL[name](loops[name])
            row["diverged_at_s"] = np.nanmin(np.append(loops["diverged_at_s"], np.inf))
            row["status"] = OK
            row["cost_worst"] = np.max(loops["cost"])
            row["loops_failed"] = np.mean(loops["status"] != OK)
            _measure_delays(records, row)
        return rows


def _measure_delays(records: Sequence[RunRecord], row: np.void) -> None:
    """Fill what a row says of the updates' time in the network."""
    updates = [_updates(record) for record in records]
    delays_ns = np.concatenate(
        [(packets["release_ns"] - packets["now_ns"])[effective(packets["fate"])] for packets in updates]
    )
    scenario = records[0].scenario
    due_s = scenario.certificate.network_delay_s
    due_ns = scenario.timing.measurement_period_ns if due_s is None else due_s * NS_PER_S
    row["updates_late"] = np.mean(delays_ns > due_ns) if len(delays_ns) else 0.0
    row["delay_max_s"] = delays_ns.max(initial=0) / NS_PER_S


def _updates(record: RunRecord) -> Rows:
    packets = record.with_departures(record[NETEM_PACKET])
    updates: Rows = packets[packets["flow"] == 0]
    return updates
