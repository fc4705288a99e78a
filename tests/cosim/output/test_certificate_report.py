"""``noack certify``: its text and JSON output, and the figures quoted in the documentation."""

import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from cosim.analysis.certificates import (
    Certificates,
    certificates_of,
    with_weight,
)
from cosim.analysis.claims.claim_evaluation import ClaimEvaluation
from cosim.cli import app
from cosim.simulation.virtual_time import simulate
from noack.core.errors import CallerError
from noack.scenario.resolution import loop_of, resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load
from noack.theory.bounds.terms import Constants
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.scenario_certificates import outside_box

ROOT = Path(__file__).parents[3]


def scenario(name: str, *settings: str) -> Scenario:
    return resolve(load(ROOT / "scenarios" / f"{name}.toml", settings))


def constants(certificate: ScenarioCertificate | None) -> Constants:
    assert certificate is not None
    assert certificate.constants is not None
    return certificate.constants


@pytest.fixture(scope="module")
def lane() -> Certificates:
    return Certificates(scenario("lane_following"), 2)


@pytest.fixture(scope="module")
def weighted() -> Certificates:
    return Certificates(scenario("lane_weighted"), 2)


def test_the_lane_example_has_its_documented_figures(
    lane: Certificates, weighted: Certificates
) -> None:
    """A hundred times the paper's inter-event time; Δ ≤ M = 5 in a chosen weight."""
    assert lane.theorem_2 is not None
    printed_s = lane.theorem_2.inter_event_s
    assert constants(lane.paper).inter_event_s >= 100 * printed_s
    assert constants(weighted.paper).inter_event_s >= 500 * printed_s
    assert 3.06 < constants(weighted.paper).delta < 1.5 * 3.06  # 3.06: the worst run of 30 s
    assert constants(weighted.paper_box).delta == pytest.approx(5.0, abs=1e-9)


def test_the_documentation_quotes_computed_figures(
    lane: Certificates, weighted: Certificates
) -> None:
    assert lane.theorem_2 is not None
    text = (ROOT / "docs/theory.md").read_text().partition("## The adversary")[0]
    rows = {
        key: [cell.strip() for cell in cells.strip(" |").split("|")]
        for key, cells in re.findall(r"^\| (Δ|X|δ) \|(.*)$", text, re.MULTILINE)
    }
    own, chosen = (constants(s.paper) for s in (lane, weighted))
    theorem = lane.theorem_2
    assert rows["Δ"] == ["(same)", f"{own.delta:.3g}", f"{chosen.delta:.3g}"]
    printed = theorem.state_start + theorem.state_forced
    assert rows["X"] == [f"{printed:.3g}", f"{own.state:.3g}", f"{chosen.state:.3g}"]
    assert rows["δ"] == [
        f"{1e6 * theorem.inter_event_s:.3g} µs",
        f"{1e3 * own.inter_event_s:.3g} ms",
        f"{1e3 * chosen.inter_event_s:.3g} ms",
    ]
    live = constants(lane.schedule)
    least_ms = 1e3 * live.inter_event_s
    message = f"Δ = {live.delta:.3g}, X = {live.state:.3g} and δ = {least_ms:.0f} ms"
    assert message in " ".join(text.split())
    limits = weighted.limits
    assert f"sampling periods up to {1e3 * limits.sampling_s:.0f} ms" in text


def test_beyond_the_largest_certified_schedule_there_is_no_certificate(lane: Certificates) -> None:
    """The limits are tight: slightly less is certified, slightly more is not."""
    from noack.theory.certificates.conditions import nominal_conditions
    from noack.theory.certificates.scenario_certificates import own_plant

    resolved = scenario("lane_following")
    scheduled, scope = nominal_conditions(resolved, 2), own_plant(resolved)
    limits = lane.limits
    for share, stands in ((0.99, True), (1.01, False)):
        for changed in (
            scheduled._replace(
                sampling_s=share * limits.sampling_s, spacing_s=share * limits.sampling_s
            ),
            scheduled._replace(hold_s=share * limits.hold_s),
        ):
            assert (scope.certificate(changed).constants is not None) == stands


def test_the_chosen_weight_makes_the_model_contract_and_keeps_the_volume() -> None:
    settings = ('model={name="double_integrator"}', "plant={initial_state=[1.0,0.0]}")
    loaded = load(ROOT / "scenarios" / "lane_following.toml", settings)
    shares: list[float] = []
    weighted = certificates_of(loaded, "chosen", 0, shares.append)
    W = weighted.weight
    assert W is not None
    assert abs(np.linalg.det(W)) == pytest.approx(1.0)
    assert shares[-1] == 1.0
    np.testing.assert_array_equal(np.array(weighted.scenario.trigger.weight), W)
    turned = W @ (loop_of(weighted.scenario).H + 0.25 * np.eye(2)) @ np.linalg.inv(W)
    assert np.linalg.eigvalsh(turned + turned.T).max() <= 1e-9
    better, plain = (
        constants(one.paper) for one in (weighted, certificates_of(loaded, late_periods=0))
    )
    assert better.delta <= 5.0
    assert better.inter_event_s >= plain.inter_event_s


def test_no_weight_improves_a_hold() -> None:
    with pytest.raises(CallerError, match=r"weight chosen: α = 0\.25 /s is not below"):
        with_weight(scenario("lane_following", 'mode="zoh"'), "chosen")
    with pytest.raises(CallerError, match='given, identity or chosen, not "best"'):
        with_weight(scenario("lane_following"), "best")


def test_identity_removes_the_weight() -> None:
    plain, W = with_weight(scenario("lane_weighted"), "identity")
    assert W is None
    assert plain.trigger.weight is None


def test_a_gain_of_the_opposite_sign_is_recognised() -> None:
    settings = ["--set", "model.gain=[[15.0, 5.0]]", "--set", "model.allow_unstable=true"]
    arguments = ["certify", "unstable_pendulum", *settings]
    message = " ".join(CliRunner().invoke(app, arguments).stdout.split())
    assert "the loop's u is +Kx, and −K would stabilise it" in message


@pytest.mark.parametrize(
    "settings",
    [
        ["plant.uncertainty_A=[[0.0, 0.0], [1e3, 1e3]]"],
        ["plant.uncertainty_A=[[0.0, 0.0], [1e300, 0.0]]", 'plant.draw="nominal"'],
        ["plant.initial_state=[1e300, 1e300]"],
        ["trigger.beta=1e308", "trigger.floor=0.0"],
        ["model.gain=[[0.0, -1e7]]", "model.allow_unstable=true"],
    ],
)
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_numbers_that_overflow_give_no_certificate(settings: list[str]) -> None:
    """No certificate has a constant that is not finite."""
    loaded = load(ROOT / "scenarios" / "unstable_pendulum.toml", settings)
    for _, certificate in certificates_of(loaded):
        if certificate.constants is None:
            assert certificate.void
        else:
            found = certificate.constants._asdict()
            found.pop("inter_event_s")
            assert all(np.isfinite(value) for value in found.values())


BOXED = (
    'model={name="double_integrator"}',
    "plant={initial_state=[1.0,0.0],uncertainty_A=[[0.0,0.0],[0.3,0.1]]}",
)


def test_a_plant_outside_its_box_is_named() -> None:
    inside = scenario("lane_following", *BOXED)
    assert outside_box(inside) is None
    assert outside_box(scenario("lane_following")) is None
    outside = scenario(
        "lane_following", *BOXED, 'plant.draw="given"', "plant.A=[[0.0,1.0],[2.0,0.0]]",
        "plant.B=[[0.0],[1.0]]",
    )  # fmt: skip
    message = outside_box(outside)
    assert message == (
        "the plant lies outside: A[2, 1] is 2 from the model's, the half-width is 0.3"
    )
    claims = [
        c for c in ClaimEvaluation(simulate(outside)).judge() if c.source == "box certificate"
    ]
    assert claims
    assert {(c.verdict, c.since_s) for c in claims} == {("void", 0.0)}


def test_a_set_point_is_certified_in_its_own_coordinates() -> None:
    """The lane rests at any lateral position; the pendulum does not rest where its model does."""
    moved = Certificates(scenario("lane_following", "controller.setpoint=[0.0, 0.0, 0.0, 3.0]"), 2)
    zero = scenario("lane_following", "plant.initial_state=[0.5, 0.0, 0.1, 0.0]")
    assert constants(moved.schedule) == constants(Certificates(zero, 2).schedule)
    assert moved.to_json()["setpoint"] == (0.0, 0.0, 0.0, 3.0)
    tilted = Certificates(scenario("unstable_pendulum", "controller.setpoint=[0.1, 0.0]"), 2)
    loop = loop_of(tilted.scenario)
    x_r, H_of_plant = np.array([0.1, 0.0]), loop.A + loop.B @ loop.K
    given = loop_of(scenario("unstable_pendulum", "controller.setpoint=[0.1, 0.0]"))
    assert given.setpoint_input is not None
    rest = -np.linalg.solve(H_of_plant, loop.A @ x_r + loop.B @ given.setpoint_input)
    persistent = tilted.paper.state(np.array([1e3]))[0]
    assert 0 < np.linalg.norm(rest) < persistent < 30 * np.linalg.norm(rest)


def test_a_time_triggered_loop_shows_whether_all_patterns_are_stable() -> None:
    found = certificates_of(load(ROOT / "scenarios/lane_periodic.toml", []))
    assert found.paper.constants is None
    assert found.stability is not None
    assert found.stability.verdict == "stable"


@pytest.mark.parametrize(
    ("trigger", "why"),
    [
        ('{policy="lyapunov", rate_per_s=0.3}', "deadline"),
        ('{policy="relative", sigma=1e-4}', "accumulate"),
    ],
)
def test_a_policy_without_a_certificate_says_why(trigger: str, why: str) -> None:
    found = certificates_of(load(ROOT / "scenarios/lane_following.toml", [f"trigger={trigger}"]))
    assert why in (found.paper.void or "")


def test_a_loop_without_any_certificate_has_the_reasons_and_no_empty_tables() -> None:
    result = CliRunner().invoke(app, ["certify", "reactor_petc"])
    assert result.exit_code == 1
    assert "loop gain of the errors" in result.stdout
    table, _, rest = result.stdout.partition("└")
    assert table.count("void") == 2  # paper, schedule
    assert "largest certified value" not in rest
