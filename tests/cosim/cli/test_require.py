"""The exit status of ``--require``: 0 only where certificates, or the verdict of a run, say so."""

import json
from pathlib import Path

import pytest

import noack
from cosim.output.requirement import Requirement
from cosim.output.requirements import unmet_by_run
from tests.helpers.command_line import invoke
from tests.helpers.summaries import claim, with_values

pytestmark = pytest.mark.usefixtures("nothing_was_found_before")

ALL = ("--require", "certificate", "--require", "guarantee", "--require", "stable")
UNENFORCED = ("--set", "network.enforce_mansd=false")


@pytest.mark.parametrize(
    ("words", "unmet"),
    [
        (("lane_following", *ALL), []),
        (("lane_following", *UNENFORCED, *ALL), ["guarantee: network.enforce_mansd = false: nothing"]),
        # Proven stable by its margin, without a bound of ‖x‖ by a certificate.
        (("lane_periodic", "--require", "stable"), []),
        (("lane_periodic", "--require", "certificate"), ["certificate: no certificate: gains: "]),
        # Certified under the paper's conditions only: without --require the status is 0.
        (("unstable_pendulum", "--late", "1000", *ALL[:2]), ["certificate: no certificate: "]),
        (("cart_pole", *ALL), [f"{word}: no certificate: for all x and u: its equations"
                               for word in Requirement]),
        (("model_predictive", *ALL), [f'{word}: no certificate: controller.kind = "python": the input is not'
                                      for word in Requirement]),
        (("lane_acknowledged", *ALL), [f'{word}: no certificate: network.protocol = "ack"'
                                       for word in Requirement]),
    ],
)  # fmt: skip
def test_certify_exits_with_1_unless_what_is_required_is_certified(
    words: tuple[str, ...], unmet: list[str]
) -> None:
    result = invoke("certify", *words, "--no-search")
    assert result.exit_code == (1 if unmet else 0), result.stderr
    lines = [line for line in result.stderr.splitlines() if line.startswith("noack: --require ")]
    assert len(lines) == len(unmet)  # beside progress on a slow machine
    for line, start in zip(lines, unmet, strict=True):
        assert line.startswith(f"noack: --require {start}")


@pytest.mark.parametrize(
    ("words", "unmet"),
    [
        (("lane_following",), []),
        (("lane_periodic",), ["certificate: no certificate: ", "guarantee: not checkable: no certificate: "]),
        (("lane_following", "--set", "horizon_s=1"), ["stable: the loop is bounded"]),
        (
            ("model_predictive", "--set", "horizon_s=1"),
            ["certificate: ", "guarantee: not checkable: ", "stable: "],
        ),
        (
            ("shared_channel", "--set", "horizon_s=2", "--set", "loops.0.count=2"),
            ["stable: in 2 of 2 loops: lane-1: the loop is bounded"],
        ),
    ],
)
def test_a_run_exits_with_1_unless_its_verdict_has_what_is_required(
    words: tuple[str, ...], unmet: list[str], tmp_path: Path
) -> None:
    command = ("simulate", *words, "--no-report", "--runs", tmp_path, "--json")
    result = invoke(*command, *ALL)
    assert result.exit_code == (1 if unmet else 0)
    assert json.loads(result.stdout)["exit"]["status"] == 0  # of the run, which completed
    lines = [line for line in result.stderr.splitlines() if line.startswith("noack: --require ")]
    assert len(lines) == len(unmet)
    for line, start in zip(lines, unmet, strict=True):
        assert line.startswith(f"noack: --require {start}")


@pytest.mark.parametrize(
    ("claims", "unmet"),
    [
        ([claim("held"), claim("ended", source="box certificate", cause="conformance")], []),
        ([claim("held", source="box certificate"), claim("ended", cause="conformance")], []),
        ([claim("held"), claim("ended", cause="conformance")], ["certificate"]),
        ([claim("held", kind="identity", source="(I1)")], ["certificate", "guarantee"]),
        ([claim("held", until_s=1.0)], ["certificate"]),  # the settings changed
        ([claim("violated")], ["certificate", "guarantee"]),
        ([], ["certificate", "guarantee"]),
    ],
)
def test_one_certificate_of_the_run_covers_all_of_it(
    claims: list[dict[str, object]], unmet: list[str]
) -> None:
    run = noack.simulate(noack.load("lane_following", {"horizon_s": 0.1})).summary
    lines = unmet_by_run(with_values(run, claims=claims), [Requirement.CERTIFICATE, Requirement.GUARANTEE])
    assert [line.split()[1].rstrip(":") for line in lines] == unmet
