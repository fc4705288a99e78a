"""The summary of a run, computed from its record: counts, claims of completeness, timing."""

import json
import math
from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.record.align import AlignedRun, identity_residual, join_all
from cosim.record.divergence import Divergence, divergence
from cosim.record.estimation_error import disturbance_summary, estimation_summary, true_states
from cosim.record.packet_outcomes import PacketOutcome, crossing
from cosim.record.recorded_changes import NEVER_NS, changes_of
from cosim.record.run_record import Life, Rows, RunRecord
from netem.loss_prediction import predicted_loss
from noack.config.runtime_parameters import text_of
from noack.core.clock import NS_PER_S
from noack.core.errors import ExitStatus
from noack.core.linear_systems import row_norms
from noack.protocol.machine_interface import FAILED, GENERATION, RESTART
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    NO_SEQUENCE,
    PLANT_ACTUATION,
    PLANT_STEP,
    SENSOR_ACKNOWLEDGEMENT,
    SENSOR_MEASUREMENT,
    Fate,
    effective,
)
from noack.protocol.topology import LOOP_ROLES, RECORDER
from noack.protocol.wire_format import Flow
from noack.runtime.life_cycle import HORIZON
from noack.theory.assumptions import assumptions
from plant_server.watchdog import too_old

Summary = dict[str, Any]


def summarise(
    record: RunRecord, exit_status: int, reason: str, startup_s: float | None = None
) -> Summary:
    """Return the content of ``summary.json``; ``docs/record.md`` documents the keys.

    Args:
        record: the run's record.
        exit_status: the run's exit status.
        reason: why the run ended.
        startup_s: wall time from the launch to simulated time 0, if anybody saw it.
    """
    with np.errstate(all="ignore"):  # a run that diverged has a summary, too
        return _summarise(record, exit_status, reason, startup_s)


def _summarise(
    record: RunRecord, exit_status: int, reason: str, startup_s: float | None
) -> Summary:
    scenario = record.scenario
    sensor, crossed = record[SENSOR_MEASUREMENT], crossing(record)
    events = sensor[sensor["event"] != NO_SEQUENCE]
    intervals_s = np.diff(events["t_ns"]) * 1e-9
    joined = join_all(record)
    residual = identity_residual(record, joined)
    residual = residual[~np.isnan(residual)]
    states = record[PLANT_STEP]["x"]
    missing, lost = _missing(record), _lost(record)
    diverged = _divergence(record)
    if exit_status == ExitStatus.OK and (why := _why_failed(record, missing, diverged)):
        exit_status, reason = ExitStatus.FAILED, why
    reception_s = np.diff(record[CONTROLLER_DELIVERY]["t_ns"]) * 1e-9
    common = joined.since_delivery(scenario)
    common_s, e_c_norm = joined.t_ns[common] * 1e-9, joined.e_c_norm[common]
    live = record.kind == "live"
    summary = {
        "kind": record.kind,
        "startup_s": startup_s,
        "scenario": scenario.name,
        "mode": scenario.mode,
        "mansd": scenario.network.mansd,
        "horizon_s": scenario.horizon_s,
        "speed": scenario.speed,
        "reached_s": _last_s(record[PLANT_STEP]),
        "events": len(events),
        "deliveries": len(record[CONTROLLER_DELIVERY]),
        "drops": int(crossed.lost.sum()),
        "loss_expected": None if scenario.changes else predicted_loss(scenario.network.link),
        "drops_by_cause": _causes(crossed),
        "forced_deliveries": int((crossed.rows["fate"] == Fate.FORCED).sum()),
        "longest_loss_burst": max(
            crossed.longest_loss_burst(),
            int(record[CONTROLLER_DELIVERY]["dropouts"].max(initial=0)),
        ),
        "assumption_violations": _violations(record),
        "assumptions": [assumption._asdict() for assumption in assumptions(scenario)],
        "restarts": _restarts(record),
        "changes": _changes(record),
        "missing_samples": sum(missing.values()),
        "missing_by_table": {table: n for table, n in missing.items() if n},
        "lost_outside_netem": sum(lost.values()),
        "lost_by_leg": {leg: n for leg, n in lost.items() if n},
        "rejected_datagrams": {
            role: rejected
            for role, report in record.reports.items()
            if (rejected := _rejected(report["channel"]))
        },
        "inter_event_min_s": _or_none(np.min, intervals_s),
        "inter_event_median_s": _or_none(np.median, intervals_s),
        "inter_delivery_median_s": _or_none(np.median, reception_s),
        "initial_state_norm": float(row_norms(states[:1])[0]) if len(states) else None,
        "final_state_norm": float(row_norms(states[-1:])[0]) if len(states) else None,
        "sup_e_s_norm": _or_none(np.max, joined.e_s_norm),
        "sup_e_c_norm": _or_none(np.max, e_c_norm),
        "sup_e_c_at_s": _or_none(lambda e_c: common_s[np.argmax(e_c)], e_c_norm),
        "identity_residual_max": _or_none(np.max, residual),
        "identity_residual_relative": _or_none(
            lambda values: np.max(values) / max(np.abs(joined.x_s).max(), np.finfo(float).tiny),
            residual,
        ),
        "lateness_us": {role: _lateness(record, role) for role in LOOP_ROLES if live},
        "latency_us": _latency(record) if live else None,
        "realtime": {
            role: report.get("realtime") or {} for role, report in record.reports.items() if live
        },
        "watchdog": _watchdog(record),
        "estimation": estimation_summary(record, _or_none(np.max, _true_e_c(record, joined))),
        "disturbances": disturbance_summary(record),
        "diverged_at_s": None if diverged is None else diverged.at_s,
        "exit": {"status": int(exit_status), "reason": reason},
    }
    if SENSOR_ACKNOWLEDGEMENT in record.tables:
        summary["acknowledgements"] = _acknowledgements(record)
    finite: Summary = _finite(summary)
    return finite


def _true_e_c(record: RunRecord, joined: AlignedRun) -> NDArray[np.float64]:
    """‖x_c − x‖_W against the plant's own state, from the controller's first update on."""
    e_c = joined.x_c - true_states(record[PLANT_STEP], joined.t_ns)
    if record.loop.weight is not None:
        e_c = e_c @ record.loop.weight.T
    norms = row_norms(e_c)
    return norms[np.isfinite(norms) & joined.since_delivery(record.scenario)]


def _watchdog(record: RunRecord) -> dict[str, Any]:
    """When the newest actuation was too old for the plant's watchdog, by its recorded steps."""
    scenario, steps, taken = record.scenario, record[PLANT_STEP], record[PLANT_ACTUATION]
    found = np.searchsorted(taken["sequence"], steps["actuation"])
    there = np.append(taken["sequence"], NO_SEQUENCE)[found] == steps["actuation"]
    newest_ns = np.where(steps["actuation"] != NO_SEQUENCE, np.append(taken["t_ns"], 0)[found], 0)
    # Of an actuation that is not on record nobody knows how old it is.
    old = there & too_old(steps["t_ns"], newest_ns, scenario.timing.actuation_timeout_ns)
    trips = np.flatnonzero(old & ~np.append(False, old[:-1]))
    return {
        "policy": scenario.plant.watchdog.policy,
        "timeout_s": scenario.timing.actuation_timeout_ns * 1e-9,
        "trips": len(trips),
        "first_s": float(steps["t_ns"][trips[0]]) * 1e-9 if len(trips) else None,
        "total_s": int(old.sum()) * scenario.timing.plant_period_ns * 1e-9,
    }


def _acknowledgements(record: RunRecord) -> dict[str, int]:
    """What became of the acknowledgements; the controller sends one for each update it takes."""
    crossed = crossing(record, Flow.ACKNOWLEDGEMENT)
    return {
        "sent": len(record[CONTROLLER_DELIVERY]),
        "lost": int(crossed.lost.sum()),
        "longest_loss_burst": crossed.longest_loss_burst(),
        "received": len(record[SENSOR_ACKNOWLEDGEMENT]),
    }


def _finite(value: Any) -> Any:
    """JSON knows no infinity: what is not finite becomes null."""
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _rejected(channel: Mapping[str, Any]) -> dict[str, int]:
    """What a process rejected, by reason, of all that it hears."""
    parse_message = Counter(channel.get("rejected") or {})
    return dict(
        parse_message + Counter((channel.get("acknowledgements") or {}).get("rejected") or {})
    )


def _why_failed(
    record: RunRecord, missing: Mapping[str, int], diverged: Divergence | None
) -> str | None:
    """Why a run failed that ended at its horizon; None if it did not fail."""
    if diverged is not None:
        return diverged.text
    for notice in record.notices:
        if notice["level"] == FAILED:
            at_s = notice["t_ns"] * 1e-9
            return f"the {notice['process']} failed at {at_s:g} s: {notice['text']}"
    # What a process that was killed had not handed over is not among these; others took its place.
    lacking = [f"{missing[table]:,} of {table}" for table in record.tables if missing[table] > 0]
    return f"rows are missing from the record: {', '.join(lacking)}" if lacking else None


def _divergence(record: RunRecord) -> Divergence | None:
    scenarios = [record.scenario, *(made.scenario for made in changes_of(record))]
    steps = record[PLANT_STEP]
    found = divergence(steps["t_ns"] * 1e-9, steps["x"], scenarios)
    for notice in record.notices:
        if found is not None and notice["level"] == FAILED:
            text = f"the plant failed at {found.at_s:g} s: {notice['text']}"
            return found._replace(text=text)
    return found


def _violations(record: RunRecord) -> list[dict[str, Any]]:
    """What the controller saw, and the run of drops at the end that it could not see any more."""
    seen = [
        {"t_s": notice["t_ns"] * 1e-9, "process": notice["process"], "what": notice["text"]}
        for notice in record.notices
        if notice["level"] == "violation"
    ]
    crossed = crossing(record)
    survived = np.flatnonzero(~crossed.lost)
    last = int(survived[-1]) + 1 if len(survived) else 0
    mansd = _largest_cap(record, int(crossed.event_ns[last - 1]) if last else 0)
    dropped = len(crossed.lost) - last
    if dropped > mansd:
        what = f"MANSD violated: the last {dropped} updates were lost, at most {mansd} assumed"
        at_s = float(crossed.event_ns[last + mansd]) * 1e-9
        seen.append({"t_s": at_s, "process": "netem", "what": what})
    return seen


def _largest_cap(record: RunRecord, since_ns: int) -> int:
    """The largest M − 1 that was in force at any time since then."""
    caps = [(0, record.scenario.network.mansd)]
    caps += [(one.everywhere_ns, one.scenario.network.mansd) for one in changes_of(record)]
    ends_ns = [*(from_ns for from_ns, _ in caps[1:]), NEVER_NS]
    return max(cap for (_, cap), end_ns in zip(caps, ends_ns, strict=True) if end_ns > since_ns)


def _changes(record: RunRecord) -> list[dict[str, Any]]:
    """What was changed while the run went on."""
    return [
        {
            "number": made.change.number,
            "t_s": made.change.t_ns / NS_PER_S,
            "settings": dict(made.change.settings),
            "what": text_of(made.change.settings),
            "since_s": {role: ns / NS_PER_S for role, ns in made.since_ns.items()},
        }
        for made in changes_of(record)
    ]


def _causes(crossed: PacketOutcome) -> dict[str, int]:
    """How many updates were lost by what."""
    fates = crossed.rows["fate"]
    causes = {
        fate.name.lower(): int((fates == fate).sum()) for fate in Fate if not fate.effective
    } | {"delivered_out_of_order": int((effective(fates) & crossed.lost).sum())}
    return {cause: n for cause, n in causes.items() if n}


def _last_s(rows: Rows) -> float:
    return float(rows["t_ns"][-1]) * 1e-9 if len(rows) else 0.0


def _or_none(statistic: Any, values: NDArray[np.float64]) -> float | None:
    return float(statistic(values)) if len(values) else None


def _missing(record: RunRecord) -> Counter[str]:
    """Rows that a process made and the record lacks, by table.

    Of a process that died without a report, by process, as far as is known.
    """
    missing: Counter[str] = Counter()
    for role in LOOP_ROLES:
        for life in record.lives(role):
            if life.report is not None:
                for table, rows in life.rows.items():
                    missing[table] += life.report["rows"][table] - len(rows)
                continue
            # The process died without a report: its inputs are numbered, so gaps still show.
            inputs = np.concatenate([rows["input"] for rows in life.rows.values()])
            for of in np.unique(inputs // GENERATION):
                numbers = inputs[inputs // GENERATION == of] % GENERATION
                missing[role] += int(numbers.max()) + 1 - len(numbers)
    return missing


def _restarts(record: RunRecord) -> list[dict[str, Any]]:
    """Processes that took the place of one that had died."""
    found: list[dict[str, Any]] = []
    for role in (*LOOP_ROLES, RECORDER):
        notices = [n for n in record.notices if (n["process"], n["level"]) == (role, RESTART)]
        if role == RECORDER:  # it leaves no rows of its own
            found += [
                _restart(role, number, None, notice["t_ns"] * 1e-9, notice["text"])
                for number, notice in enumerate(notices, 1)
            ]
            continue
        acted_s = {life.generation: _acted_s(life) for life in record.lives(role)}
        # Each says it once; if one's word is lost, it is that of one that did not live long.
        said = dict(enumerate(notices, max(max(acted_s) - len(notices), 0) + 1))
        last_s = acted_s.pop(0)[-1]
        for number in sorted(acted_s.keys() | said.keys()):
            first_s, until_s = acted_s.get(number, (None, last_s))
            what = said[number]["text"] if number in said else None
            found.append(_restart(role, number, last_s, first_s, what))
            last_s = until_s
    return sorted(found, key=lambda one: one["first_s"] or one["last_s"] or math.inf)


def _restart(
    process: str, generation: int, last_s: float | None, first_s: float | None, what: str | None
) -> dict[str, Any]:
    return {
        "process": process,
        "generation": generation,
        "last_s": last_s,
        "first_s": first_s,
        "what": what,
    }


def _acted_s(life: Life) -> tuple[float | None, float | None]:
    """When a process first left a row, and when last; None of one that never did."""
    now_ns = np.concatenate([rows["now_ns"] for rows in life.rows.values()])
    if not len(now_ns):
        return None, None
    return float(now_ns.min()) * 1e-9, float(now_ns.max()) * 1e-9


def _lost(record: RunRecord) -> dict[str, int]:
    """Datagrams that were sent and did not arrive, other than by the emulator's decision."""
    sensor, crossed = record[SENSOR_MEASUREMENT], crossing(record)
    every = record.scenario.plant.measure_every
    sent = record[PLANT_STEP]["sequence"]
    legs = {
        "measurement": (sent[sent % every == 0] // every, sensor["sequence"]),
        "update to netem": (sensor["event"][sensor["event"] != NO_SEQUENCE], crossed.sequence),
        "update to controller": (
            crossed.sequence[crossed.left],
            record[CONTROLLER_DELIVERY]["sequence"],
        ),
        "actuation": (record[CONTROLLER_STEP]["sequence"], record[PLANT_ACTUATION]["sequence"]),
    }
    if SENSOR_ACKNOWLEDGEMENT in record.tables:
        answers = crossing(record, Flow.ACKNOWLEDGEMENT)
        taken = record[CONTROLLER_DELIVERY]["sequence"]
        legs["acknowledgement to netem"] = (taken, answers.sequence)
        arrived = record[SENSOR_ACKNOWLEDGEMENT]["sequence"]
        legs["acknowledgement to sensor"] = (answers.sequence[answers.left], arrived)
    whole = all(record.reports.get(role, {}).get("ended") == HORIZON for role in LOOP_ROLES)
    lost: dict[str, int] = {}
    for leg, (out, arrived) in legs.items():
        if not whole:  # what was under way when a process ended is nobody's loss
            out = out[out <= arrived.max(initial=-1)]
        lost[leg] = int(np.setdiff1d(out, arrived).size)
    return lost


def _quantiles(late_us: NDArray[np.float64]) -> dict[str, float | None]:
    if not len(late_us):
        return {"p50": None, "p99": None, "p999": None, "max": None}
    p50, p99, p999 = np.quantile(late_us, [0.5, 0.99, 0.999])
    return {"p50": float(p50), "p99": float(p99), "p999": float(p999), "max": float(late_us.max())}


def lateness_us(record: RunRecord, role: str) -> NDArray[np.float64]:
    """Wall time by which a process acted after what it acts on was due, (k,).

    The plant and the controller have deadlines of their own; the sensor's is the measurement's grid
    time, the network's is the event's.
    """
    if role == "netem":
        crossed = crossing(record)
        rows, due_ns = crossed.rows, crossed.event_ns
    else:
        steps = {"plant": PLANT_STEP, "sensor": SENSOR_MEASUREMENT, "controller": CONTROLLER_STEP}
        rows = record[steps[role]]
        due_ns = rows["t_ns"]
    late_us: NDArray[np.float64] = (rows["now_ns"] - due_ns) / (1e3 * record.scenario.speed)
    return late_us


def _lateness(record: RunRecord, role: str) -> dict[str, float | int | None]:
    scenario = record.scenario
    period_ns = {
        "plant": scenario.timing.plant_period_ns,
        "sensor": scenario.timing.measurement_period_ns,
        "controller": scenario.timing.controller_period_ns,
        "netem": scenario.timing.plant_period_ns,
    }[role]
    late_us = lateness_us(record, role)
    late_steps = int((late_us * 1e3 * scenario.speed > period_ns).sum())
    return {**_quantiles(late_us), "steps": len(late_us), "late_steps": late_steps}


def latency_us(record: RunRecord) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Wall time from the sensor's event to the controller's update, one way.

    Returns:
        Event times in ns (d,) and latencies in µs (d,), of the updates that arrived.
    """
    sensor, deliveries = record[SENSOR_MEASUREMENT], record[CONTROLLER_DELIVERY]
    events = sensor[sensor["event"] != NO_SEQUENCE]
    _, at_sensor, at_controller = np.intersect1d(
        events["event"], deliveries["sequence"], return_indices=True
    )
    taken_ns = deliveries["now_ns"][at_controller] - events["now_ns"][at_sensor]
    return events["t_ns"][at_sensor], taken_ns / (1e3 * record.scenario.speed)


def _latency(record: RunRecord) -> dict[str, float | int | None]:
    _, taken_us = latency_us(record)
    return {**_quantiles(taken_us), "updates": len(taken_us)}


def dumps(summary: Summary) -> str:
    """The summary as JSON."""
    return json.dumps(summary, indent=2, allow_nan=False)
