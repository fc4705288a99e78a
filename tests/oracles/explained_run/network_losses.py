"""The network: each event has one update, and losses obey the guarantee."""

import numpy as np

from cosim.record.run_events import PacketOutcome, packet_outcomes
from netem.impairments.constraints.at_most import AtMost
from netem.impairments.constraints.recovery import Recovery
from noack.protocol.record_tables import CONTROLLER_DELIVERY, CONTROLLER_STEP, NO_SEQUENCE, SENSOR_MEASUREMENT
from noack.scenario.scenario import Scenario
from tests.oracles.explained_run.findings import ExplainedLoop

NETWORK = "network"


def check_updates(run: ExplainedLoop) -> None:
    """Check the updates from event to controller, and the losses among them."""
    measured = run.rows(SENSOR_MEASUREMENT)
    events = measured[measured["event"] != NO_SEQUENCE]
    outcomes = packet_outcomes(run.record)
    before = outcomes.event_ns < run.until_ns
    outcomes = PacketOutcome(**{name: column[before] for name, column in outcomes._asdict().items()})
    event_ns = dict(zip(events["event"].tolist(), events["t_ns"].tolist(), strict=True))
    for number, t_ns in zip(outcomes.sequence.tolist(), outcomes.event_ns.tolist(), strict=True):
        if event_ns.get(number) != t_ns:
            run.add(t_ns, NETWORK, f"update {number} is of no event")
    present = set(outcomes.sequence.tolist())
    newest = max(present, default=-1)
    for number in sorted(event_ns.keys() - present):
        if number < newest:
            run.add(event_ns[number], NETWORK, f"update {number} did not reach the network")
    if run.scenario.network.enforce_mansd and len(present) > newest:
        _check_guarantee(run, outcomes)
    _check_deliveries(run, outcomes)


def _check_guarantee(run: ExplainedLoop, outcomes: PacketOutcome) -> None:
    """Check every rule; a packet that is in flight at the end counts as delivered."""
    lost, times_ns = outcomes.lost & ~outcomes.in_flight, outcomes.event_ns
    if len(lost) and lost[0] and run.scenario.network.initial_sync == "first_packet":
        run.add(times_ns[0], NETWORK, "the first update is lost")
    for name, beyond in violations(run.scenario, lost):
        run.add(times_ns[beyond], NETWORK, f"update {outcomes.sequence[beyond]} is lost against {name}")


def violations(scenario: Scenario, lost: np.ndarray) -> list[tuple[str, int]]:
    """Return the first packet whose loss violates each rule of a scenario's guarantee."""
    network, found = scenario.network, []
    windows = [(network.mansd, network.mansd + 1, f"at most {network.mansd} lost in a row")]
    limits = [constraint for constraint in network.constraints if isinstance(constraint, AtMost)]
    windows += [(limit.losses, limit.window, limit.text()) for limit in limits]
    total = np.append(0, np.cumsum(lost))
    for most, window, name in windows:
        ends = np.arange(1, len(lost) + 1)
        beyond = total[ends] - total[np.maximum(ends - window, 0)] > most
        if beyond.any():
            found.append((name, int(np.argmax(beyond))))
    places = np.flatnonzero(lost)
    for constraint in network.constraints:
        if isinstance(constraint, Recovery):
            apart = np.diff(places) - 1  # deliveries between two losses
            few = np.flatnonzero((apart > 0) & (apart < constraint.deliveries))
            if len(few):
                found.append((constraint.text(), int(places[few[0] + 1])))
    return found


def _check_deliveries(run: ExplainedLoop, outcomes: PacketOutcome) -> None:
    """Check that the controller received what the network forwarded, in order."""
    received, ticks = run.record[CONTROLLER_DELIVERY], run.rows(CONTROLLER_STEP, time="now_ns")
    forwarded = set(outcomes.sequence[outcomes.forwarded].tolist())
    known = set(outcomes.sequence.tolist())
    before = -1
    for row in received[received["t_ns"] < run.until_ns]:
        number = int(row["sequence"])
        if number in known and number not in forwarded:
            run.add(row["t_ns"], NETWORK, f"update {number} was received, but the network did not forward it")
        if number <= before:
            run.add(row["t_ns"], NETWORK, f"update {number} was received after {before}")
        before = number
    last_ns = int(ticks["now_ns"].max(initial=0))
    due = outcomes.forwarded & (outcomes.due_ns < last_ns)
    missing = due & ~np.isin(outcomes.sequence, received["sequence"])
    if run.record.kind == "simulated" and missing.any():
        first = int(np.argmax(missing))
        what = f"update {outcomes.sequence[first]} was forwarded, but not received"
        run.add(outcomes.event_ns[first], NETWORK, what)
