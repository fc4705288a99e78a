"""The end of a run: what its lines and its table say."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

import noack
from cosim.analysis.summary.run_summary import Outcome
from cosim.analysis.summary.summary_model import Claim
from cosim.live.finalize import finalize
from cosim.output import run_verdict
from cosim.output.run_verdict import remarks, state_text, verdict
from cosim.simulation.virtual_time import simulate_run
from netem.output.result_tables import Tone
from noack.protocol.wire_format import Rejection
from noack.runtime.counting_sockets import DROPPED_IN_FLOOD
from tests.helpers.approved import compare_lines
from tests.helpers.shipped import shipped
from tests.helpers.summaries import claim, with_values

OLD_INPUT = {
    "certificate": "certificate", "document": "a loop", "until_s": 1.0,
    "failure": {"kind": "input", "place": "0 lost", "detail": "", "input_age_s": 0.25},
}  # fmt: skip


@pytest.fixture(scope="module")
def outcome(tmp_path_factory: pytest.TempPathFactory) -> Outcome:
    """The paper's example, completed without problems."""
    ending = simulate_run(shipped("lane_following"), tmp_path_factory.mktemp("runs"))
    return finalize(ending, report=False, view=False)


def test_a_line_states_whether_the_guarantee_was_kept(outcome: Outcome) -> None:
    """A line of the file has the summary's claims, each with what it has of its own, and other parts."""

    def stated(line: str) -> list[str]:
        content = json.loads(line)
        content["claims"] = [claim(**changes) for changes in content["claims"]]
        line = verdict(with_values(outcome.summary, **content))[-2]
        text, tone = line.text, line.tone
        return [f"{tone}: {text}"]

    compare_lines(Path(__file__).with_name("approved") / "verdicts.txt", stated)


@pytest.mark.parametrize(
    ("settings", "lacking"),
    [
        ((), "not guaranteed by the end of the run"),
        (("controller.update_timeout_s=1.0",), "not guaranteed"),
    ],
)
def test_a_run_that_ends_before_its_guarantee_begins_says_so(
    settings: tuple[str, ...], lacking: str, tmp_path: Path
) -> None:
    """The bound of the position is within the allowed error from 11.1 s on."""
    ending = simulate_run(shipped("double_integrator", "horizon_s=3.0", *settings), tmp_path)
    line = verdict(finalize(ending, report=False, view=False).summary)[0]
    assert f" ({lacking})" in line.text


@pytest.mark.parametrize(
    ("first", "largest", "final", "diverged_at_s", "text"),
    [
        (2.0, 2.0, 0.1999, None, "stable, ‖x‖ fell from 2 to 0.2"),
        (1.0, 2.0, 0.1999, None, "stable, ‖x‖ was 1 at the start, at most 2, at the end 0.2"),
        (1.0, 1.004, 0.02, None, "stable, ‖x‖ fell from 1 to 0.02"),
        (0.0, 0.0, 0.0, None, "stable, ‖x‖ stayed at 0"),
        (1.0, 2.0, 0.2001, None, "bounded, ‖x‖ was at most 2, at the end 0.2"),
        (1.0, 2.0, 9.0, 1.0, "diverged"),
        (None, None, None, None, ""),
    ],
)
def test_the_state_is_stable_bounded_or_diverged(
    first: float | None,
    largest: float | None,
    final: float | None,
    diverged_at_s: float | None,
    text: str,
) -> None:
    assert state_text(first, largest, final, diverged_at_s) == text


@pytest.mark.parametrize(("final", "tone"), [(0.1, Tone.GOOD), (9.0, Tone.GOOD), (31.0, Tone.DOUBTFUL)])
def test_a_run_whose_state_grew_is_not_good(outcome: Outcome, final: float, tone: Tone) -> None:
    grown = {"initial_state_norm": 3.0, "sup_state_norm": 31.0, "final_state_norm": final}
    loops = [outcome.summary.loops[0].model_copy(update=grown)]
    line = verdict(outcome.summary.model_copy(update={"loops": loops}))[1]
    assert line.text.startswith("completed 20 s")
    assert line.tone == tone


def test_at_a_set_point_the_state_is_the_distance_from_it() -> None:
    scenario = noack.load("double_integrator", {"controller.setpoint": [3.0, 0.0]})
    summary = noack.simulate(scenario).summary
    loop = summary.loops[0]
    assert loop.setpoint == [3.0, 0.0]
    assert loop.initial_state_norm == 2.0
    first, second, *_ = verdict(summary)
    assert re.fullmatch(r"position was within 0.05 of its set-point from [\d.]+ s on .*", first.text)
    assert "stable, ‖x − x_r‖ fell from 2 to " in second.text


def test_the_verdict_of_several_loops_counts_them() -> None:
    summary = noack.simulate(noack.load("different_loops", {"horizon_s": 2.0})).summary
    first, second, _ = verdict(summary)
    assert re.fullmatch(r"completed 2 s: \d of 4 loops (stable|bounded).*", first.text)
    assert re.fullmatch(r"guarantee kept in all 4 loops: \d+ claims held, none violated", second.text)
    loops = [*summary.loops]
    loops[2] = loops[2].model_copy(update={"claims": [Claim(**claim("violated"))]})
    broken = verdict(summary.model_copy(update={"loops": loops}))[1]
    name = loops[2].name
    assert (broken.text, broken.tone) == (
        f"guarantee broken in 1 of 4 loops, since 1.000 s: {name}: violated: a",
        Tone.BAD,
    )


def test_a_run_across_hosts_names_the_firewall_the_network_and_how_to_add_rows(
    outcome: Outcome,
) -> None:
    values: dict[str, Any] = {
        "kind": "live", "unintended_losses": 3, "unintended_losses_by_leg": {"actuation": 3},
        "conformance": [OLD_INPUT],
        "claims": [claim("ended", cause="conformance")],
    }  # fmt: skip

    def texts(clock_error_s: float | None, *, complete: bool) -> str:
        conditions = dict.fromkeys(("dropouts", "sampling_s", "delay_s", "hold_s", "start_s"))
        summary = with_values(
            outcome.summary,
            conditions=conditions | {"clock_error_s": clock_error_s},
            replay={"complete": complete, "bit_exact": None},
            **values,
        )
        return "\n".join(remark.text for remark in remarks(summary))

    across, alone = ([texts(error_s, complete=whole) for whole in (True, False)] for error_s in (1e-4, None))
    for named, whole in (
        ("firewalls must pass", True),
        ("the network between hosts was later than any certificate of this loop allows", True),
        ("--add FILE", False),
    ):
        assert named in across[not whole]
        assert named not in "".join(alone)
    # What is missing from the record may be later: no certificate was computed for it.
    assert "was later than" in alone[0]
    assert "was later than" not in across[1] + alone[1]
    alone = alone[0]
    assert "lost elsewhere (kernel, or a process that did not respond): 3 on actuation" in alone


def test_a_run_that_ends_before_its_first_input_is_due_keeps_its_guarantee() -> None:
    """Of 10 ms, it was said that no input came where the first has to come within 34 ms."""
    delay = {"network.impairments": [{"kind": "delay", "delay_s": 0.02}]}
    for horizon_s in (0.01, 0.2):
        summary = noack.simulate(noack.load("lane_weighted", {"horizon_s": horizon_s, **delay})).summary
        text = verdict(summary)[-2].text
        assert text.startswith("guarantee kept: ")
        assert text.endswith("claims held, none violated")


@pytest.mark.parametrize(("delay_s", "start"), [(0.4, "guarantee kept: "), (0.6, "conforms until 0.008 s: ")])
def test_a_late_run_says_how_it_was_late(delay_s: float, start: str) -> None:
    """The plant has a certificate for the first delay, every plant of the box none."""
    delay = {"kind": "delay", "delay_s": delay_s}
    changes = {"horizon_s": 5.0, "network.impairments": [delay], "certificate.network_delay_s": 0.001}
    line = noack.simulate(noack.load("lane_following", changes)).verdict[-2].text
    assert line.startswith(start)
    assert "the first input had not taken effect by 10 ms, at most 8 ms is allowed" in line


def test_every_reason_for_a_rejection_has_words() -> None:
    assert {*Rejection, DROPPED_IN_FLOOD} == {*run_verdict._REJECTIONS}
