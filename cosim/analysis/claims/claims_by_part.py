"""The claims about a run with changes of settings.

The claims at the start end at the first change. The part after a change is checked as a separate
run, in deviations from the set-point. Its time 0 is the first event after the change whose update
the controller received: there x_s = x, and x_c is reset to x. There are no claims in between.

Such a part starts with an input of the part before: until the plant applies the first input of the
new part, u was computed from older updates. ‖u − Kx‖ is recorded, and the certificate holds if it
covers input errors of this size; see ``CertificateScope`` in
:mod:`noack.theory.certificates.scenario_certificates`.

The processes of a stopped run end some milliseconds apart. Claims and conditions are checked up to
the last time that all of them reached, because the loop is incomplete after it.
"""

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from cosim.analysis.claims.claim_definition import Envelope
from cosim.analysis.claims.claim_evaluation import ClaimEvaluation, void_claim
from cosim.analysis.claims.observed_conditions import AssumptionViolation
from cosim.analysis.claims.run_evidence import RunPart
from cosim.analysis.summary_model import Claim
from cosim.record.recorded_changes import NEVER_NS, RecordedChange, changes_of
from cosim.record.run_record import Rows, RunRecord
from noack.config.resolution import loop_of, setpoint_of
from noack.config.runtime_parameters import text_of
from noack.config.scenario import Scenario
from noack.core.clock import NS_PER_S
from noack.core.linear_systems import Vector, row_norms
from noack.protocol.record_tables import (
    CLOCK_TABLES,
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    NETEM_PACKET,
    OWNER,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
    SETTINGS,
)
from noack.protocol.topology import LOOP_ROLES
from noack.runtime.life_cycle import HORIZON
from noack.theory.bounds.disturbances import bound_forcing
from noack.theory.certificates.conditions import about_setpoint, void_at_setpoint

_TIMES = ("t_ns", "now_ns", "model_t_ns", "release_ns", "copy_ns")
_STATES = ("x", "x_s", "x_c", "x_c_before", "x_s_before")
_PACES = {
    "plant": (PLANT_STEP, "t_ns"),
    "sensor": (SENSOR_MEASUREMENT, "t_ns"),
    "netem": (NETEM_PACKET, "now_ns"),
    "controller": (CONTROLLER_STEP, "t_ns"),
}
"""By process: the table and column with the times of its steps."""


@lru_cache(maxsize=1)
def claims_of(record: RunRecord) -> "RunClaims":
    """Return the claims about a run; the summary and the report use the same ones."""
    return RunClaims(record)


@dataclass(frozen=True)
class RunClaims:
    """The claims about a run, part by part; each property is computed once."""

    record: RunRecord

    @cached_property
    def _judged(self) -> RunRecord:
        return up_to_common_end(self.record)

    @property
    def judged_until_s(self) -> float | None:
        """End of the claims about a stopped run; None if they are checked to the end of the run."""
        end_ns = common_end_ns(self.record)
        return None if end_ns is None else end_ns / NS_PER_S

    @cached_property
    def _setpoint(self) -> tuple[Vector, Vector] | None:
        return setpoint_of(self._judged.scenario)

    @cached_property
    def parts(self) -> list[ClaimEvaluation | Claim]:
        """The claims of each part; for a part without claims, the reason as a void claim."""
        record = self._judged
        changes = [made for made in changes_of(record) if made.touches_claims]
        first_ns = changes[0].first_ns if changes else NEVER_NS
        part = RunPart(record, 0.0, _seconds(first_ns), None, void_at_setpoint(record.scenario))
        own = record if self._setpoint is None else _part_of(record, record.scenario, 0, None)
        found: list[ClaimEvaluation | Claim] = [ClaimEvaluation(own, part)]
        for made, after in zip(changes, [*changes[1:], None], strict=False):
            until_ns = NEVER_NS if after is None else after.first_ns
            found.append(self._after(made, until_ns))
        return found

    @property
    def conditions(self) -> dict[str, float | None]:
        """Largest observed value of each condition, over the whole run."""
        first = self.parts[0]
        if isinstance(first, ClaimEvaluation) and first.record is self._judged:
            return first.conditions
        return ClaimEvaluation(self._judged).conditions

    def violations(self) -> list[AssumptionViolation]:
        """The assumptions that the run violated: in each part, the first violation of each."""
        found = []
        for one in self.parts:
            if not isinstance(one, Claim):
                from_s = one.part.from_s
                found += [each._replace(t_s=each.t_s + from_s) for each in one.violations()]
        return sorted(found, key=lambda one: one.t_s)

    def judge(self) -> list[Claim]:
        """Every claim with its verdict, in the run's time."""
        found: list[Claim] = []
        for one in self.parts:
            if isinstance(one, Claim):
                found.append(one)
                continue
            from_s, until_s = one.part.from_s, one.part.until_s
            found += [
                claim.model_copy(
                    update={
                        "since_s": None if claim.since_s is None else claim.since_s + from_s,
                        "from_s": from_s,
                        "until_s": from_s + until_s if math.isfinite(until_s) else None,
                    }
                )
                for claim in one.judge()
            ]
        return found

    def envelopes(self) -> list[Envelope]:
        """The curves of all bounds, each over its own part of the run."""
        found: list[Envelope] = []
        for one in self.parts:
            # Other bounds hold for deviations from another set-point, or start later.
            if not isinstance(one, Claim) and one.part.from_s == 0 and self._setpoint is None:
                found += [_until(envelope, one.part.until_s) for envelope in one.envelopes()]
        return found

    def _after(self, made: RecordedChange, until_ns: int) -> ClaimEvaluation | Claim:
        """The claims about the part of the run that follows a change."""
        record = self._judged
        known = record.events()["event"]
        after = record.columns(
            CONTROLLER_DELIVERY, "t_ns", "sequence",
            where=lambda rows: rows["t_ns"] >= made.everywhere_ns,
        )  # fmt: skip
        after = after[np.isin(after["sequence"], known)]
        if made.everywhere_ns == NEVER_NS:
            return _nothing_after(made, until_ns, "not every process received the change")
        if not len(after) or after["t_ns"][0] >= until_ns:
            up_to = "" if until_ns == NEVER_NS else f", up to {until_ns / NS_PER_S:.3f} s"
            return _nothing_after(made, until_ns, f"no update was delivered after it{up_to}")
        origin_ns, sequence = int(after["t_ns"][0]), int(after["sequence"][0])
        own = _part_of(record, made.scenario, origin_ns, sequence)
        part = RunPart(
            record,
            origin_ns / NS_PER_S,
            _seconds(until_ns) - origin_ns / NS_PER_S,
            _start_error(own, ClaimEvaluation(own).started_s),
            void_at_setpoint(made.scenario),
        )
        return ClaimEvaluation(own, part)


def _nothing_after(made: RecordedChange, until_ns: int, why: str) -> Claim:
    """Return a void claim for the part after a change, with the reason for having no claims."""
    at_s, text = made.first_ns / NS_PER_S, text_of(made.change.settings)
    until_s = None if until_ns == NEVER_NS else until_ns / NS_PER_S
    why = f"changed at {at_s:.3f} s: {text}; {why}"
    return void_claim("claims after a change", "claims", at_s, why, until_s)


def _seconds(t_ns: int) -> float:
    return math.inf if t_ns == NEVER_NS else t_ns / NS_PER_S


def _until(envelope: Envelope, until_s: float) -> Envelope:
    if envelope.quantity == "inter_event":  # two ends of a line
        return envelope._replace(t_s=np.minimum(envelope.t_s, until_s))
    return envelope._replace(values=np.where(envelope.t_s < until_s, envelope.values, np.nan))


def _part_of(
    record: RunRecord, scenario: Scenario, origin_ns: int, sequence: int | None
) -> RunRecord:
    """Return the part of a run after the event ``sequence``, in the form of a separate record.

    The time of the event becomes time 0. Without an event it is the whole run.
    """
    setpoint = setpoint_of(scenario)
    loop = loop_of(scenario)
    x_r, u_r = (np.zeros(loop.n), np.zeros(loop.m)) if setpoint is None else setpoint

    def derive(table: str, part: Rows) -> Rows:
        if table in SETTINGS:
            part = part[:0]
        elif table in (SENSOR_MEASUREMENT, PLANT_STEP, CONTROLLER_STEP):
            part = part.compress(part["t_ns"] >= origin_ns)
        elif table == NETEM_PACKET or table in CLOCK_TABLES:
            part = part.compress(part["now_ns"] >= origin_ns)
        elif table == CONTROLLER_DELIVERY and sequence is not None:
            part = part[part["sequence"] >= sequence]
        rows = _shifted(part, origin_ns, x_r, u_r)
        if sequence is not None:  # the state before the reset belongs to the last part
            _begin(table, rows, sequence)
        return rows

    batches = record.source.batches(SENSOR_MEASUREMENT)
    first = next(filter(len, (derive(SENSOR_MEASUREMENT, rows) for rows in batches)), None)
    x_0 = np.array(scenario.plant.initial_state) - x_r if first is None else first["x"][0]
    scenario = about_setpoint(scenario)
    update = {
        "plant": scenario.plant.model_copy(update={"initial_state": tuple(x_0.tolist())}),
        "horizon_s": max(scenario.horizon_s - origin_ns / NS_PER_S, 1e-9),
        "changes": (),
    }
    if sequence is not None:
        update["network"] = scenario.network.model_copy(update={"initial_sync": "first_packet"})
    update["trigger"] = scenario.trigger.at_origin(origin_ns / NS_PER_S)
    return record.derived(scenario.model_copy(update=update), derive)


def _begin(table: str, rows: Rows, sequence: int) -> None:
    """Change the row of the event at which a part of a run begins: it has no error before it."""
    if table == SENSOR_MEASUREMENT:
        first = np.flatnonzero(rows["t_ns"] == 0)[:1]
        rows["x_s"][first] = rows["x"][first]
        rows["e_s_norm"][first] = rows["compared"][first] = 0.0
    elif table == CONTROLLER_DELIVERY:
        rows["dropouts"][rows["sequence"] == sequence] = 0


def _shifted(rows: Rows, origin_ns: int, x_r: Vector, u_r: Vector) -> Rows:
    shifted = rows.copy()
    for name in rows.dtype.names or ():
        if name in _TIMES:
            shifted[name] -= origin_ns
        elif name in _STATES:
            shifted[name] -= x_r
        elif name == "u":
            shifted[name] -= u_r
    return shifted


def _start_error(own: RunRecord, started_s: float) -> float:
    """sup‖u − Kx‖ e^{αt} over the steps until the plant applied the first input of the part.

    u is constant within a step. So ‖u − Kx‖ is at most the larger of its values at both ends, plus
    a term for the curvature of x: Δt²/8 sup‖K A ẋ‖, with ẋ = e^{As}(Ax + Bu + Dw), w constant.
    """
    alpha = own.scenario.trigger.threshold_decay_per_s
    largest, last = 0.0, np.zeros(0, own.tables[PLANT_STEP])
    for batch in own.source.batches(PLANT_STEP):
        steps = np.concatenate([last, batch])
        ended = int(np.searchsorted(steps["t_ns"] * 1e-9, started_s)) + 1
        if len(steps[:ended]) > 1:
            largest = max(largest, _input_error(own, steps[:ended], alpha))
        if ended < len(steps):
            break
        last = steps[-1:]
    return largest


def _input_error(own: RunRecord, steps: Rows, alpha_per_s: float) -> float:
    """Return the bound of ‖u − Kx‖ e^{αt} over at least two steps."""
    loop = own.loop
    x, u, dt_s = steps["x"], steps["u"][:-1], own.scenario.timing.plant_period_ns * 1e-9
    ends = np.maximum(row_norms(u - x[:-1] @ loop.K.T), row_norms(u - x[1:] @ loop.K.T))
    speed = x[:-1] @ loop.A.T + u @ loop.B.T
    grown = math.exp(min(float(np.linalg.norm(loop.A, 2)) * dt_s, 700.0))
    pushes, forcing = 0.0, bound_forcing(own.scenario, loop.B)
    if forcing is not None:
        pushes = float(np.linalg.norm(loop.K @ loop.A @ forcing.limited, axis=0).sum())
    bend = dt_s**2 / 8 * grown * (row_norms(speed @ (loop.K @ loop.A).T) + pushes)
    return float(((ends + bend) * np.exp(alpha_per_s * steps["t_ns"][1:] * 1e-9)).max())


def common_end_ns(record: RunRecord) -> int | None:
    """Return the latest time that every process of a stopped run reached.

    None if the run was not stopped, or if a process did not report its time.
    """
    reports = [record.reports.get(role, {}) for role in LOOP_ROLES]
    if all(report.get("ended") == HORIZON for report in reports):
        return None
    reached_ns = [report.get("reached_ns") for report in reports]
    known_ns = [int(one) for one in reached_ns if one is not None]
    measured_ns = record.last_ns(SENSOR_MEASUREMENT)
    if len(known_ns) < len(reports) or measured_ns is None:
        return None
    # A sensor has no deadlines, so its time is that of its last measurement.
    return int(min(*known_ns, measured_ns))


def up_to_common_end(record: RunRecord) -> RunRecord:
    """Return the record of a run up to its common end; the record itself if it has none.

    The rows of each process are cut at its first row beyond that time, in all tables.
    """
    end_ns = common_end_ns(record)
    if end_ns is None:
        return record
    before: dict[str, int] = {}
    for role, (pace, column) in _PACES.items():
        found = (rows["input"][rows[column] > end_ns] for rows in record.source.batches(pace))
        first = next(filter(len, found), None)
        before[role] = int(np.iinfo(np.int64).max if first is None else first[0])

    def derive(table: str, rows: Rows) -> Rows:
        if table in CLOCK_TABLES:  # their rows have numbers of their own
            return rows.compress(rows["t_ns"] <= end_ns)
        return rows.compress(rows["input"] < before[OWNER[table]])

    return record.derived(record.scenario, derive)
