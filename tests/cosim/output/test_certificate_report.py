"""``noack certify``: its text and JSON output, and the figures quoted in the documentation."""

import json
import math
import re
from collections.abc import Sequence
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flint import arb
from rich.console import Console
from scipy.linalg import expm

from cosim.analysis.certificates import _STATED, Certificates, certificates_of, with_weight
from cosim.analysis.claims.claim_evaluation import RunClaims
from cosim.analysis.witnesses import Unproven, find_statement, resolved_content
from cosim.output.certificate_report import certificate_document, certificate_tables
from cosim.output.document import Document
from cosim.output.terminal_writer import print_document
from cosim.simulation.virtual_time import simulate
from noack.core.errors import CallerError
from noack.scenario.resolution import loop_of
from noack.theory.bounds.certificate_terms import Constants
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.conditions import OWN_PLANT, most_events
from noack.theory.certificates.proven_bounds import ProvenBound, ProvenBounds
from noack.theory.certificates.scenario_certificates import outside_box
from noack_check.sentences import smallest_bounds
from tests.helpers.approved import compare_text
from tests.helpers.command_line import invoke
from tests.helpers.shipped import resolved, shipped

ROOT = Path(__file__).parents[3]


def constants(certificate: ScenarioCertificate | None) -> Constants:
    assert certificate is not None
    assert certificate.constants is not None
    return certificate.constants


@pytest.fixture(scope="module")
def lane() -> Certificates:
    return Certificates(resolved("lane_following"), 2)


@pytest.fixture(scope="module")
def weighted() -> Certificates:
    return Certificates(resolved("lane_weighted"), 2)


def test_the_documentation_quotes_computed_figures(lane: Certificates, weighted: Certificates) -> None:
    assert lane.theorem_2 is not None
    text = (ROOT / "docs/theory.md").read_text().partition("## The adversary")[0]
    rows = {
        key: [cell.strip() for cell in cells.strip(" |").split("|")]
        for key, cells in re.findall(r"^\| (Δ|X|δ) \|(.*)$", text, re.MULTILINE)
    }
    scenario_norm, other_norm = (constants(s.paper) for s in (lane, weighted))
    theorem = lane.theorem_2
    assert rows["Δ"] == ["(same)", f"{scenario_norm.delta:.3g}", f"{other_norm.delta:.3g}"]
    assert scenario_norm.inter_event_s >= 100 * theorem.inter_event_s
    assert 3.06 < other_norm.delta < 1.7 * 3.06  # 3.06: the worst run of 30 s
    assert constants(weighted.paper_box).delta == pytest.approx(5.0, abs=1e-9)  # Δ ≤ M
    paper_bound = theorem.state_start + theorem.state_forced
    assert rows["X"] == [f"{paper_bound:.3g}", f"{scenario_norm.state:.3g}", f"{other_norm.state:.3g}"]
    assert rows["δ"] == [
        f"{1e6 * theorem.inter_event_s:.3g} µs",
        f"{1e3 * scenario_norm.inter_event_s:.3g} ms",
        f"{1e3 * other_norm.inter_event_s:.3g} ms",
    ]
    live = constants(lane.schedule)
    least_ms = 1e3 * live.inter_event_s
    message = f"Δ = {live.delta:.3g}, X = {live.state:.3g} and δ = {least_ms:.0f} ms"
    assert message in " ".join(text.split())
    limits, plain = (certificates.limits_by_scope[OWN_PLANT] for certificates in (weighted, lane))
    assert limits.sampling_s is not None
    assert plain.sampling_s is not None
    delay_s = weighted.largest_settings[0].values["certificate.network_delay_s"]
    assert isinstance(delay_s, float)
    for quoted in (
        f"a certificate exists for sampling periods up to {1e3 * plain.sampling_s:.3g} ms",
        f"it exists for sampling periods up to {1e3 * limits.sampling_s:.3g} ms",
        f"for updates up to {1e3 * limits.delay_s:.3g} ms late",
        f"with a network that delays them by {1e3 * delay_s:.3g} ms",
    ):
        assert quoted in " ".join(text.split())


RATE_HZ = 1 / 0.0458
SLOW = (
    'model={name="double_integrator"}',
    f"plant={{initial_state=[1.0,0.0],rate_hz={RATE_HZ}}}",
    f"controller.rate_hz={RATE_HZ}",
    'outputs=[{name="position"}, {name="velocity"}]',
)
"""With a step of 45.8 ms, this loop has no certificate for its schedule in the Euclidean norm."""


@pytest.fixture(scope="module")
def chosen() -> Certificates:
    """The slow loop in a norm that noack chooses, after seconds of search."""
    shares: list[float] = []
    certificates = certificates_of(shipped("lane_following", *SLOW), "chosen", progress=shares.append)
    assert shares[-1] == 1.0
    return certificates


def test_the_chosen_weight_makes_the_model_contract_and_keeps_the_volume(chosen: Certificates) -> None:
    W = chosen.weight
    assert W is not None
    assert abs(np.linalg.det(W)) == pytest.approx(1.0)
    np.testing.assert_array_equal(np.array(chosen.scenario.trigger.weight), W)
    turned = W @ (loop_of(chosen.scenario).H + 0.25 * np.eye(2)) @ np.linalg.inv(W)
    assert np.linalg.eigvalsh(turned + turned.T).max() <= 1e-9
    unweighted = certificates_of(shipped("lane_following", *SLOW))
    better, plain = constants(chosen.paper), constants(unweighted.paper)
    assert better.delta <= 5.0
    # In the Euclidean norm: an event's error, at most β in the chosen one, followed by e^{Hτ}.
    scheduled, G = constants(chosen.schedule), loop_of(chosen.scenario).H + 0.25 * np.eye(2)
    assert scheduled.inter_event_s is not None
    gains = [np.linalg.norm(expm(G * t) @ np.linalg.inv(W), 2) for t in np.arange(0.0, 20.0, 0.01)]
    ages = [int(100 * scheduled.inter_event_s * j) for j in range(scheduled.missing_events)]
    followed = scheduled.overshoot * (gains[0] + sum(max(gains[age:]) for age in ages))
    expected = min(followed, gains[0] * scheduled.delta)
    assert chosen.error_in_given_norm == pytest.approx(expected, rel=2e-2)
    assert unweighted.error_in_given_norm is None
    assert better.inter_event_s >= plain.inter_event_s


def test_advice_names_only_what_helps() -> None:
    """With this delay neither faster rates nor fewer losses give a certificate."""
    settings = ['trigger={policy="absolute", delta=0.1}']
    settings += ['network.impairments=[{kind="delay", delay_s=1.0}]']
    result = invoke(
        "certify", "double_integrator", "--no-proofs", *(word for s in settings for word in ("--set", s))
    )
    _, _, last = " ".join(result.stdout.split()).rpartition("no certificate for the schedule, ")
    assert "there is one with certificate.network_delay_s = 0.5 " in last
    assert "rate_hz =" not in last
    assert "mansd" not in last


STICK = (
    "model={A=[[0,1],[19.6,0]], B=[[0],[1]], gain=[[-40,-9]]}",
    'plant={draw="given", A=[[0,1],[20.4,0]], B=[[0],[1]], initial_state=[0.1,0]}',
    "trigger={beta=0.05, alpha_per_s=0.5}",
    "network.mansd=3",
)
"""The loop of the tutorial."""


@pytest.mark.parametrize(
    "settings",
    [STICK, ("trigger={beta=0.02, alpha_per_s=0.3}",), ('trigger={policy="absolute", delta=0.1}',)],
)
def test_the_largest_settings_are_certified_and_the_next_ones_are_not(settings: Sequence[str]) -> None:
    """Waits for clocks, and whole numbers of steps, come between a time of the schedule and a setting."""
    certificates = certificates_of(shipped("unstable_pendulum", *settings))
    keys = set()
    for tried in certificates.largest_settings:
        [(key, value)] = tried.values.items()
        assert isinstance(value, float | int)
        keys.add(key)
        step = 1 if isinstance(value, int) else 10.0 ** (math.floor(math.log10(value)) - 2)
        certified = [
            certificates_of(shipped("unstable_pendulum", *settings, f"{key}={other:.12g}")).schedule.exists
            for other in (value, value + 2 * step)
        ]
        assert certified == [True, False], (key, value)
    assert keys == {"certificate.network_delay_s", "plant.measure_every"}


@pytest.mark.parametrize(
    "words",
    [
        ("unstable_pendulum", 'network.impairments=[{kind="delay",delay_s=0.3}]'),
        ("lane_following", "plant.measure_every=100"),
        ("double_integrator", 'trigger={policy="relative",sigma=0.9}'),
        ("lane_periodic",),
        ("sine_pendulum", "network.mansd=12"),
        ("unstable_pendulum", 'network.impairments=[{kind="rate",rate_bps=400000,queue=100}]'),
    ],
)
def test_advised_settings_have_a_certificate(words: Sequence[str]) -> None:
    name, *settings = words
    results = certificates_of(shipped(name, *settings), of_model=True)
    assert not results.answer.is_certified
    assert results.helpful_settings
    for tried in results.helpful_settings:
        changed = [f"{key}={json.dumps(value)}" for key, value in tried.values.items()]
        again = certificates_of(shipped(name, *settings, *changed), of_model=True)
        assert again.answer.is_certified, tried.text


def test_an_advised_box_has_a_certificate() -> None:
    results = certificates_of(shipped("double_integrator", "plant.uncertainty_B=[[0.0],[0.9]]"))
    tried = results.helpful_box
    assert tried is not None
    assert tried.text == "plant.uncertainty_B times 0.2, entry by entry"
    changed = [f"{key}={json.dumps(value)}" for key, value in tried.values.items()]
    box = certificates_of(shipped("double_integrator", *changed)).schedule_box
    assert box is not None
    assert box.exists


def test_linear_equations_are_certified_as_the_plant(tmp_path: Path) -> None:
    """From any x(0), with the same bounds and the same advice as A and B in the scenario."""
    (tmp_path / "own.py").write_text(
        "class Own:\n    def derivative(self, t_s, z, u):\n        return [z[1], 20.4 * z[0] + u[0]]\n"
    )
    start = "plant.initial_state=[30.0,0.0]"
    as_matrices = certificates_of(shipped("unstable_pendulum", *STICK, start))
    system = f'{{kind="python", file="{tmp_path}/own.py", name="Own"}}'
    own = f'plant={{draw="nominal", system={system}, initial_state=[30.0,0.0]}}'
    certificates = certificates_of(shipped("unstable_pendulum", STICK[0], own, *STICK[2:]), of_model=True)
    assert certificates.nonlinear is None
    assert certificates.answer.is_certified
    assert certificates.schedule.constants == as_matrices.schedule.constants
    assert certificates.largest_settings == as_matrices.largest_settings
    certificates.prove()
    assert certificates.schedule.is_proven("state")
    assert certificates.paper.is_proven("state")


def test_no_weight_improves_a_hold_and_identity_removes_the_weight() -> None:
    with pytest.raises(CallerError, match=r"weight chosen: α = 0\.25 /s is not below"):
        with_weight(resolved("lane_following", 'mode="zoh"'), "chosen")
    with pytest.raises(CallerError, match="'best' is not one of 'given', 'identity', 'chosen'"):
        with_weight(resolved("lane_following"), "best")
    plain, W = with_weight(resolved("lane_weighted"), "identity")
    assert W is None
    assert plain.trigger.weight is None


@pytest.mark.parametrize(
    "settings",
    [
        ["plant.uncertainty_A=[[0.0, 0.0], [1e3, 1e3]]"],
        ["plant.initial_state=[1e300, 1e300]"],
        ["trigger.beta=1e308", "trigger.floor=0.0"],
        ["model.gain=[[0.0, -1e7]]", "model.allow_unstable=true"],
    ],
)
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_numbers_that_overflow_give_no_certificate(settings: list[str]) -> None:
    """No certificate has a constant that is not finite."""
    scenario = shipped("unstable_pendulum", *settings)
    for _, certificate in certificates_of(scenario):
        if certificate.constants is None:
            assert certificate.void
        else:
            values = certificate.constants._asdict()
            values.pop("inter_event_s")
            assert all(np.isfinite(value) for value in values.values())


BOXED = (
    'model={name="double_integrator"}',
    "plant={initial_state=[1.0,0.0],uncertainty_A=[[0.0,0.0],[0.3,0.1]]}",
)


def test_a_plant_outside_its_box_is_named() -> None:
    inside = resolved("lane_following", *BOXED)
    assert outside_box(inside) is None
    assert outside_box(resolved("lane_following")) is None
    outside = resolved(
        "lane_following", *BOXED, 'plant.draw="given"', "plant.A=[[0.0,1.0],[2.0,0.0]]",
        "plant.B=[[0.0],[1.0]]",
    )  # fmt: skip
    message = outside_box(outside)
    assert message == ("the plant lies outside: A[2, 1] is 2 from the model's, the half-width is 0.3")
    claims = [c for c in RunClaims(simulate(outside)).evaluate() if c.source == "box certificate"]
    assert claims
    assert {(c.verdict, c.since_s) for c in claims} == {("void", 0.0)}


def test_a_set_point_is_certified_in_its_own_coordinates() -> None:
    """A mass rests at any position; a drawn plant does not rest where its model does."""
    moved = Certificates(resolved("double_integrator", "controller.setpoint=[3.0, 0.0]"), 2)
    zero = resolved("double_integrator", "plant.initial_state=[-2.0, 0.0]")
    assert constants(moved.schedule) == constants(Certificates(zero, 2).schedule)
    assert moved.to_json()["setpoint"] == (3.0, 0.0)
    assert moved.to_json()["schedule"]["delay_s"] == moved.scheduled.delay_s > 0
    settings = (
        "controller.setpoint=[0.1, 0.0]",
        "plant.A=[[0.0, 1.0], [0.2, 0.1]]",
        "plant.B=[[0.0], [1.0]]",
        'plant.draw="given"',
    )
    tilted = Certificates(resolved("double_integrator", *settings), 2)
    loop = loop_of(tilted.scenario)
    x_r, H_of_plant = np.array([0.1, 0.0]), loop.A + loop.B @ loop.K
    rest = -np.linalg.solve(H_of_plant, loop.A @ x_r)
    persistent = tilted.paper.state(np.array([1e3]))[0]
    assert 0 < np.linalg.norm(rest) < persistent < 30 * np.linalg.norm(rest)
    with pytest.raises(CallerError, match=r"first one arrives, .* a \[\[controller.reference\]\] that steps"):
        Certificates(resolved("unstable_pendulum", "controller.setpoint=[0.1, 0.0]"), 2)


P = 0.05
MANSD = 2
WITHOUT_CAP = (
    "network.enforce_mansd=false", f"network.mansd={MANSD}",
    f'network.loss={{model="bernoulli", probability={P}}}', 'plant.draw="nominal"',
)  # fmt: skip


@pytest.fixture(scope="module")
def without_a_cap() -> Certificates:
    return Certificates(resolved("lane_weighted", *WITHOUT_CAP), 2)


def test_a_run_of_the_largest_number_of_events_keeps_the_assumption_as_often_as_stated(
    without_a_cap: Certificates,
) -> None:
    """By 4000 sequences of losses that are drawn here."""
    scheduled = without_a_cap.schedule
    assert scheduled.inter_event_s is not None
    packets = most_events(resolved("lane_weighted"), scheduled.inter_event_s)
    lost = np.random.default_rng(1).uniform(size=(4000, packets)) < P
    lost[:, 0] = False
    bursts = np.lib.stride_tricks.sliding_window_view(lost, MANSD + 1, axis=1)
    allowed_count = int((~bursts.all(axis=2).any(axis=1)).sum())
    (why,) = (assumption.why for assumption in scheduled.assumptions if "not enforced" in assumption.why)
    stated = float(why.split("probability ")[1].split()[0])
    assert abs(allowed_count / 4000 - stated) < 5 * (stated * (1 - stated) / 4000) ** 0.5


WRONG_SIGN = "model.gain=[[15.0, 5.0]]"


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["lane_periodic"], "loop gain of the errors"),
        (
            ["unstable_pendulum", f"--set={WRONG_SIGN}", "--set=model.allow_unstable=true"],
            "the loop's u is +Kx, and −K would stabilise it",
        ),
    ],
)
def test_a_loop_without_any_certificate_has_the_reasons(words: list[str], reason: str) -> None:
    result = invoke("certify", *words, "--no-proofs", "--verbose")
    assert result.exit_code == 1
    assert reason in " ".join(result.stdout.split())
    assert "largest certified value" not in result.stdout


def test_a_norm_with_certificates_is_found_and_can_be_pasted(
    chosen: Certificates, monkeypatch: pytest.MonkeyPatch
) -> None:
    printed = list[Any]()
    monkeypatch.setattr("cosim.analysis.certificates.choose_weight", lambda *_: chosen.weight)

    def document(*given: Any, verbose: bool) -> Document:
        printed.append(given)
        return Document(title="", blocks=[])

    monkeypatch.setattr("cosim.output.certificate_report.certificate_document", document)
    invoke("certify", "lane_following", "--no-proofs", *(f"--set={setting}" for setting in SLOW))
    ((result, in_chosen_norm),) = printed
    shown = certificate_document(result, in_chosen_norm)
    print_document(Console(file=(output := StringIO()), width=100), shown)
    text = output.getvalue()
    pasted_lines = text[text.index("\nweight = [") :].splitlines()[1:]
    rows = "".join(line.strip() for line in pasted_lines)
    weighted = certificates_of(shipped("lane_following", *SLOW, f"trigger.{rows}"))
    assert weighted.schedule.constants is not None
    assert result.schedule.constants is None
    constants = in_chosen_norm.schedule.constants
    assert constants.state == pytest.approx(weighted.schedule.constants.state, rel=1e-3)


PROVEN = ProvenBounds(
    rate_per_s=0.2,
    bounds={"x": ProvenBound(7.0, 0.5), "e_c": ProvenBound(1.0, 0.0), "e_s": ProvenBound(0.25, 0.0)},
    limits={"y[1]": 0.125},
    inter_event_s=0.004,
    first_event_s=None,
    is_quiet=True,
)


def proven_lane(proven: ProvenBounds = PROVEN) -> Certificates:
    lane = Certificates(resolved("lane_following"), 2)
    lane.__setstate__(({("own", "schedule"): proven}, [Unproven("own", "ideal", "none was found")]))
    return lane


def printed(certificates: Certificates) -> str:
    document = certificate_document(certificates, verbose=True)
    print_document(Console(file=(output := StringIO()), width=150), document)
    return output.getvalue()


def test_the_first_screen_is_a_sentence_and_a_few_lines() -> None:
    """``APPROVE=1 pytest`` writes them anew: read the difference."""
    outputs = 'outputs=[{name="angle", unit="rad", allowed=0.02}, {name="rate", unit="rad/s", allowed=0.005}]'
    cases = {
        "stated outputs": Certificates(resolved("unstable_pendulum", outputs), 2),
        "the states": Certificates(
            resolved("unstable_pendulum", 'outputs=[{name="angle"}, {name="rate"}]'), 2
        ),
        "no certificate": Certificates(resolved("lane_following", *SLOW), 2),
    }
    proven = PROVEN._replace(
        bounds={**PROVEN.bounds, "y[0]": ProvenBound(3.0, 0.015), "y[1]": PROVEN.bounds["x"]}
    )
    cases["stated outputs"].__setstate__(({("box", "schedule"): proven}, ()))
    cases["stated outputs"].threshold_advice["rate"] = "trigger.floor = 0.0001 is small enough (proved)"
    text = ""
    for name, certificates in cases.items():
        document = certificate_document(certificates)
        assert len(document.blocks) <= 11
        print_document(Console(file=(output := StringIO()), width=100), document)
        text += f"# {name}\n{output.getvalue()}"
    compare_text(Path(__file__).with_name("first_screens.txt"), text)


def test_what_is_proven_takes_the_place_of_what_is_computed() -> None:
    lane = proven_lane()
    (table, *_) = certificate_tables(lane)
    rows = {row[0]: row[3] for row in table.rows}
    assert rows["decay rate, 1/s"] == "0.2✓"
    assert rows["X, bound of ‖x‖"] == "7✓"
    assert rows["+ without decay: ‖x‖"] == "0.5✓"
    assert rows["Δ, bound of ‖e_c‖/β"] == "2✓"
    assert rows["bound of ‖e_s‖/β"] == "0.5✓"
    assert rows["bound of |heading| in the limit"] == "0.125✓"
    assert rows["inter-event time, s"] == "0.004✓"  # also where the computed one is larger
    assert rows["bound of ‖u − Kx‖"] == "3.998"
    t_s = np.array([0.0, 10.0])
    np.testing.assert_allclose(lane.schedule.state(t_s), 7.0 * np.exp(-0.2 * t_s) + 0.5)
    text = " ".join(printed(lane).split())
    assert "‖x‖ ≤ 7 e^(−0.2t) + 0.5 (proved). The inter-event time is at least 4 ms, from the second" in text
    assert "‖x‖ ≤ 970.5 e^(−0.25t) (computed)" in text
    assert "nothing is proven (paper, plant): none was found" in text
    assert "✓" not in printed(Certificates(resolved("lane_following"), 2))


def test_a_proof_is_a_certificate_where_none_can_be_computed() -> None:
    periodic = Certificates(resolved("lane_periodic"), 2)
    assert not periodic.answer.is_certified
    periodic.__setstate__(({("own", "schedule"): PROVEN}, ()))
    assert periodic.answer.is_certified
    text = " ".join(printed(periodic).split())
    assert "the bounds are proven without it" in text
    assert "violated" not in text.partition("assumptions of the paper's theorems")[0]
    assert periodic.largest_settings == periodic.helpful_settings == []


def test_proofs_of_the_command_are_those_of_the_checker() -> None:
    result = json.loads(invoke("certify", "double_integrator", "--json").stdout)
    found = [certificate["proven"]["bounds"]["x"]["decaying"] for certificate in result["certificates"]]
    content = resolved_content(resolved("double_integrator"), 2)
    of_linear = {key: which for key, which in _STATED.items() if which[0] != "region"}
    statements = [find_statement(content, *which) for which in of_linear.values()]
    proofs = {(s.plants, s.conditions): s.proof for s in statements}
    for which, value in zip(of_linear.values(), found, strict=True):
        proof = proofs[which]
        assert proof is not None
        (bound,) = (b for b in smallest_bounds(proof) if b.output == "x" and b.from_start)
        assert arb(value) >= bound.decaying
        assert value == pytest.approx(float(bound.decaying.mid()), rel=1e-9)
