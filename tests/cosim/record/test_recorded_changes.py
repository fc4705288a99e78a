"""Runs with changes of runtime parameters: replay, the identity (I1), and the cap."""

from typing import Any

import numpy as np
import pytest

from cosim.analysis.claims.claim_evaluation import RunClaims
from cosim.analysis.replay import replay
from cosim.analysis.summary.loop_summary import summarise_loop
from cosim.analysis.summary.summary_model import ClaimCause, ClaimVerdict
from cosim.record.align import align_tables
from cosim.record.run_events import changes_of
from cosim.record.run_record import RunRecord
from cosim.simulation.virtual_time import simulate
from netem.core.errors import CallerError
from netem.core.packet_rows import NETEM_PACKET
from noack.protocol.record_tables import NETEM_SETTING
from noack.protocol.roles import Notice
from noack.protocol.wire_format import Flow, Message
from noack.scenario.parameter_changes import ParameterChange
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import validate
from tests.cosim.record.changed_records import CONTENT, changed, identity_residual
from tests.cosim.simulation.event_scheduler import EventScheduler
from tests.helpers.machine_parts import controller_of

MS = 1_000_000


def run_with(changes: list[tuple[int, dict[str, Any]]], **more: Any) -> RunRecord:
    changes_table = [{"at_s": t_ns / 1e9, "set": settings} for t_ns, settings in changes]
    return simulate(resolve(validate(CONTENT | {"changes": changes_table} | more, "here")))


def test_the_cap_in_force_holds_for_losses_that_change() -> None:
    """The number of consecutive losses never exceeds the largest cap in force meanwhile."""
    worst = {"network.loss": {"model": "worst_case"}}
    often = {"trigger.beta": 0.005, "network.loss": {"model": "bernoulli", "probability": 0.9}}
    changes = [(0, often), (500 * MS, {"network.mansd": 1}), (1_003 * MS, worst)]
    record = run_with([*changes, (1_500 * MS, {"network.mansd": 5}), (2_000 * MS, often)])
    assert len(changes_of(record)) == 5
    replayed = replay(record)
    assert (replayed.bit_exact, replayed.gaps) == (True, [])
    scale = float(np.abs(align_tables(record).x_s).max())
    assert np.nanmax(identity_residual(record)) <= 1e-12 * max(scale, 1.0)
    assert summarise_loop(record, 0, "horizon").to_json()["violations"] == []
    packets = record[NETEM_PACKET]
    longest = {cap: packets["consecutive_losses"][(packets["now_ns"] >= since_ns)
                                                  & (packets["now_ns"] < until_ns)].max()
               for cap, since_ns, until_ns in ((3, 0, 500 * MS), (1, 800 * MS, 1_500 * MS),
                                               (5, 1_500 * MS, 3_000 * MS))}  # fmt: skip
    assert longest == {3: 3, 1: 1, 5: 5}


def test_dropouts_are_compared_with_the_cap_of_their_time() -> None:
    content = CONTENT | {"network": {"mansd": 5, "loss": {"model": "lossless"}}}
    controller = controller_of(resolve(validate(content, "here")))

    def delivered(sequence: int, t_ns: int) -> list[str]:
        message = Message(Flow.UPDATE, sequence, t_ns, np.zeros(2))
        return [output.text for output in controller.handle(message, t_ns) if isinstance(output, Notice)]

    assert delivered(0, 0) == []
    controller.announce(ParameterChange(0, 50 * MS, {"network.mansd": 1}), 0)
    assert delivered(5, 60 * MS) == []  # four were lost while the cap was five
    (text,) = delivered(8, 90 * MS)
    assert "2 consecutive losses" in text
    assert "at most 1 assumed" in text


def test_a_change_received_too_late_is_reported_and_ends_its_claims() -> None:
    """The controller receives at 1 s a change that applies from 0.9 s on."""
    resolved = resolve(validate(CONTENT, "here"))
    change = ParameterChange(0, 900 * MS, {"controller.setpoint": [2.0, 0.0]})
    announced_ns = {"sensor": 500 * MS, "netem": 500 * MS, "controller": 1_000 * MS}
    scheduler = EventScheduler(resolved)
    for now_ns in scheduler.steps():
        for role in [role for role, at_ns in announced_ns.items() if at_ns <= now_ns]:
            machine: Any = scheduler.machines[role]
            scheduler.emit(role, machine.announce(change, now_ns))
            del announced_ns[role]
    record = scheduler.record()
    assert replay(record).bit_exact
    (recorded_change,) = changes_of(record)
    late_ns = {role: ns for role, ns in recorded_change.since_ns.items() if ns > recorded_change.change.t_ns}
    assert list(late_ns) == ["controller"]
    assert recorded_change.everywhere_ns == late_ns["controller"] > 990 * MS
    (violation,) = summarise_loop(record, 0, "horizon").to_json()["violations"]
    assert "change received too late" in violation["what"]
    assert violation["process"] == "controller"
    claims = [claim for claim in RunClaims(record).evaluate() if claim.source == "(I1)"]
    assert [(claim.verdict, claim.since_s) for claim in claims] == [(ClaimVerdict.ENDED, 0.9)] * 2
    assert claims[0].cause is ClaimCause.SETPOINTS
    # In between, only one of the two models had the change.
    samples = align_tables(record)
    between = (samples.t_ns > 910 * MS) & (samples.t_ns < recorded_change.everywhere_ns)
    assert np.nanmax(identity_residual(record)[between]) > 1e-3


def test_a_network_that_knows_of_no_change_or_of_another_is_reported() -> None:
    changes_table = [{"at_s": 1.0, "set": {"network.mansd": 1}}]
    resolved = resolve(validate(CONTENT | {"changes": changes_table}, "here"))
    with pytest.raises(CallerError, match="settings that stay the same"):
        simulate(resolved, lambda data, now_ns: 0)
    record = simulate(resolved)
    settings = record[NETEM_SETTING].copy()
    settings["t_ns"] += 1
    settings["since_ns"] += 1
    difference = replay(changed(record, {NETEM_SETTING: settings})).first_difference
    assert difference is not None
    assert difference.what == "another process received another change"
