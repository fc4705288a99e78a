"""The end of a run: what its lines and its table say."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

import noack
from cosim.analysis.summary.run_summary import Outcome
from cosim.analysis.summary.summary_model import Claim, ExitPart
from cosim.live.finalize import finalize
from cosim.output import run_verdict
from cosim.output.page_kit import TERMS
from cosim.output.result_tables import Tone
from cosim.output.run_tables import run_title, short_numbers
from cosim.output.run_verdict import SETTLED_SHARE, guarantee_of, remarks, state_text, verdict
from cosim.record.divergence import GROWTH
from cosim.simulation.virtual_time import simulate_run
from noack.protocol.wire_format import Rejection
from noack.runtime.udp_sockets import DROPPED_IN_FLOOD
from tests.helpers.approved import compare_lines
from tests.helpers.shipped import shipped
from tests.helpers.summaries import claim, with_values

LATE = {"t_s": 1.0, "process": "recorder", "cause": "hold", "what": "an input was old"}


@pytest.fixture(scope="module")
def outcome(tmp_path_factory: pytest.TempPathFactory) -> Outcome:
    """The paper's example, completed without problems."""
    ending = simulate_run(shipped("lane_following"), tmp_path_factory.mktemp("runs"))
    return finalize(ending, report=False, view=False)


def test_the_second_line_states_whether_the_guarantee_was_kept(outcome: Outcome) -> None:
    """A line of the file has the summary's claims, each with what it has of its own, and other parts."""

    def stated(line: str) -> list[str]:
        content = json.loads(line)
        content["claims"] = [claim(**changes) for changes in content["claims"]]
        line = verdict(with_values(outcome.summary, **content))[1]
        text, tone = line.text, line.tone
        return [f"{tone}: {text}"]

    compare_lines(Path(__file__).with_name("approved") / "verdicts.txt", stated)


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


def test_at_a_set_point_the_state_is_the_distance_from_it() -> None:
    scenario = noack.load("double_integrator", {"controller.setpoint": [3.0, 0.0]})
    summary = noack.simulate(scenario).summary
    loop = summary.loops[0]
    assert loop.setpoint == [3.0, 0.0]
    assert loop.initial_state_norm == 2.0
    assert "stable, ‖x − x_r‖ fell from 2 to " in verdict(summary)[0].text


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
        "assumption_violations": [LATE],
        "claims": [claim("void", why=LATE["what"])],
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


def test_the_longest_burst_is_shown_with_the_limit_of_all_rules(outcome: Outcome) -> None:
    assert "longest loss burst (cap M − 1 = 4)" in dict(short_numbers(outcome.summary))
    change = {"number": 1, "t_s": 1.0, "settings": {"network.mansd": 9}, "what": ""}
    raised = with_values(outcome.summary, changes=[change | {"in_force_from_s": {}}])
    assert "longest loss burst (cap M − 1 = 9)" in dict(short_numbers(raised))
    assert run_title(raised) == "lane_following, model-based, M − 1 = 4 → 9, simulated"
    limited = with_values(outcome.summary, constraints=["atmost 3 in 8"])
    assert "longest loss burst (at most 3 allowed)" in dict(short_numbers(limited))


@pytest.mark.parametrize("scenario", ["four_tank", "lane_acknowledged"])
def test_the_table_fits_eighty_columns(scenario: str) -> None:
    run = noack.simulate(noack.load(scenario, {"horizon_s": 1.0}))
    rows = short_numbers(run.summary)
    assert max(len(name) for name, _ in rows) + max(len(value) for _, value in rows) <= 73
    # There is no other value to compare with.
    assert "ideal loop" not in verdict(run.summary)[2].text


def test_the_glossary_has_the_limits_that_decide_the_words() -> None:
    """It said that a loop diverges if it grows beyond all bounds."""
    meaning = dict(TERMS)["stable, bounded, diverged"]
    assert f"{GROWTH:g} times its expected size" in meaning
    assert SETTLED_SHARE == 0.1
    assert "at most a tenth of its largest value" in meaning


def test_a_run_that_ends_before_its_first_input_is_due_keeps_its_guarantee() -> None:
    """Of 10 ms, it was said that no input came where the first has to come within 34 ms."""
    delay = {"network.impairments": [{"kind": "delay", "delay_s": 0.02}]}
    for horizon_s, held in ((0.01, 8), (0.2, 11)):  # nothing is compared for the other claims
        summary = noack.simulate(noack.load("lane_weighted", {"horizon_s": horizon_s, **delay})).summary
        assert verdict(summary)[1].text == f"guarantee kept: {held} claims held, none violated"


def test_one_missing_sample_and_one_lost_datagram_have_no_plural(outcome: Outcome) -> None:
    summary = with_values(
        outcome.summary, missing_samples=1, missing_by_table={"plant_step": 1},
        unintended_losses=1, unintended_losses_by_leg={"actuation": 1},
    )  # fmt: skip
    texts = "\n".join(remark.text for remark in remarks(summary))
    assert "1 sample is missing from the record: 1 of plant_step" in texts
    assert "1 datagram was lost elsewhere" in texts


def test_where_the_plant_is_certified_only_the_box_is_said_to_be_uncovered(outcome: Outcome) -> None:
    """It said that the machine was later than any certificate allows."""
    claims = [claim("held"), claim("void", source="box certificate", why=LATE["what"])]
    late = with_values(outcome.summary, kind="live", claims=claims, assumption_violations=[LATE])
    texts = "\n".join(remark.text for remark in remarks(late))
    assert "This machine was later than the box certificate of this loop allows, so some claims" in texts
    assert (
        "assumption violated from t = 1.000 s on (found in the record)" not in texts
    )  # it is in the verdict
    unseen = LATE | {"what": "no measurement for up to 1 s", "cause": "sampling"}
    other = with_values(outcome.summary, claims=claims, assumption_violations=[LATE, unseen])
    text = "\n".join(remark.text for remark in remarks(other))
    assert "assumption violated from t = 1.000 s on (found in the record): no measurement" in text


@pytest.mark.parametrize(
    ("delay_s", "end"),
    [
        (0.3, "held, none violated; 4 claims not checkable: {}; the box certificate does not cover that"),
        (0.4, "guarantee not checkable: {}; no certificate covers that"),
    ],
)
def test_a_late_run_says_which_certificate_does_not_cover_it(delay_s: float, end: str) -> None:
    """The plant has a certificate for 390 ms, every plant of the box one for 265 ms."""
    delay = {"kind": "delay", "delay_s": delay_s}
    changes = {"horizon_s": 5.0, "network.impairments": [delay], "certificate.network_delay_s": 0.001}
    line = noack.simulate(noack.load("lane_following", changes)).verdict[1].text
    why = f"the plant applied its first input at {delay_s + 0.002:.4g} s, 0.008 s allowed"
    assert line.endswith(end.format(why))


def test_the_numbers_and_reasons_of_datagrams_are_written_out(outcome: Outcome) -> None:
    summary = with_values(
        outcome.summary, missing_samples=2000, missing_by_table={"plant_step": 2000},
        unintended_losses=1500, unintended_losses_by_leg={"actuation": 1500},
        rejected_datagrams={"plant": {"length": 3, "shed": 4685}, "netem": {"source": 1}},
    )  # fmt: skip
    texts = "\n".join(remark.text for remark in remarks(summary))
    assert "2,000 samples are missing from the record: 2,000 of plant_step" in texts
    assert (
        "1,500 datagrams were lost elsewhere (kernel, or a process that did not respond): 1,500 on" in texts
    )
    assert "plant rejected datagrams: 3 (wrong length), 4,685 (dropped in a flood)" in texts
    assert "netem rejected datagrams: 1 (unknown source)" in texts


def test_every_reason_for_a_rejection_has_words() -> None:
    assert {*Rejection, DROPPED_IN_FLOOD} == {*run_verdict._REJECTIONS}


def test_without_any_certificate_the_reason_is_that_of_the_scenarios_own_plant(outcome: Outcome) -> None:
    """It was the one that comes first in the alphabet: certify gave another loop gain."""
    why = "the loop gain of the errors is {}, not below 1"
    box = claim("void", source="box certificate", why=why.format(1.37))
    summary = with_values(outcome.summary, claims=[box, claim("void", why=why.format(4.37))])
    assert guarantee_of(summary.loops[0]).why == f"{why.format(4.37)}"


def test_a_plant_that_fails_in_a_simulation_says_when_once() -> None:
    """The simulation goes on to its horizon, which is not when the plant failed."""
    end = ExitPart(status=1, reason="the plant failed at 0.02 s: x is not finite")
    assert run_verdict.ending_line(end, 4.0, 4.0).text == f"failed: {end.reason}"
    killed = ExitPart(status=1, reason="sensor exited with status 9")
    assert run_verdict.ending_line(killed, 2.0, 4.0).text.startswith("failed after 2 s of 4 s: ")
