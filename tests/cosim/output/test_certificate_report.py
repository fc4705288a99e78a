"""``noack certify``: its text and JSON output."""

import json
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flint import arb
from rich.console import Console

from cosim.analysis.certificates import Certificates, certificates_of
from cosim.analysis.claims.claim_evaluation import RunClaims
from cosim.analysis.scenario_certificates import certificate_of, quick_certificate
from cosim.analysis.witnesses import WitnessedStatement, find_statement
from cosim.output.certificate_report import certificate_document, certificate_table
from cosim.simulation.virtual_time import simulate
from netem.core.errors import ExitStatus
from netem.output.document import Sentence
from netem.output.terminal_writer import print_document
from noack.core.linear_systems import Vector
from noack.proof.search.results import smallest_bounds
from noack.theory.certificates.conditions import allowed_conditions, outside_box
from noack.theory.certificates.proven_bounds import ProvenBound, ProvenBounds
from noack.theory.witnesses.loss_margin import Stability
from tests.helpers.approved import compare_text
from tests.helpers.command_line import invoke
from tests.helpers.shipped import resolved, shipped

pytestmark = pytest.mark.usefixtures("nothing_was_found_before")

LATE = 'network.impairments=[{kind="delay", delay_s=1.0}]'
QUEUE = 'network.impairments=[{kind="rate",rate_bps=400000,queue=100}]'


def test_advice_names_only_what_helps() -> None:
    """While no largest delay is stated, neither faster rates nor fewer losses give a certificate."""
    settings = ['trigger={policy="absolute", delta=0.1}', QUEUE]
    words = [word for setting in settings for word in ("--set", setting)]
    result = invoke("certify", "double_integrator", "--no-search", *words)
    _, _, last = " ".join(result.stdout.split()).rpartition("no certificate for the schedule, ")
    assert "there is one with certificate.network_delay_s = " in last
    assert "rate_hz =" not in last
    assert "mansd" not in last


@pytest.mark.parametrize(
    "words",
    [
        ("double_integrator", 'trigger={policy="relative",sigma=0.9}'),
        ("unstable_pendulum", QUEUE),
    ],
)
def test_advised_settings_have_a_certificate(words: tuple[str, ...]) -> None:
    name, *settings = words
    results = certificates_of(shipped(name, *settings))
    assert not results.answer.is_certified
    assert results.helpful_settings
    for tried in results.helpful_settings:
        changed = [f"{key}={json.dumps(value)}" for key, value in tried.values.items()]
        assert certificates_of(shipped(name, *settings, *changed)).answer.is_certified, tried.text


def test_the_largest_settings_have_a_certificate() -> None:
    results = certificates_of(shipped("unstable_pendulum"))
    keys = set()
    for tried in results.largest_settings:
        [(key, value)] = tried.values.items()
        keys.add(key)
        assert certificates_of(shipped("unstable_pendulum", f"{key}={value}")).answer.is_certified
    assert keys == {"certificate.network_delay_s", "plant.measure_every"}
    delay_s = results.largest_settings[0].values["certificate.network_delay_s"]
    assert isinstance(delay_s, float)
    later = f"certificate.network_delay_s={2 * delay_s}"
    assert not certificates_of(shipped("unstable_pendulum", later)).answer.is_certified


def test_an_advised_box_has_a_certificate() -> None:
    results = certificates_of(shipped("double_integrator", "plant.uncertainty_B=[[0.0],[0.9]]"))
    tried = results.helpful_box
    assert tried is not None
    changed = [f"{key}={json.dumps(value)}" for key, value in tried.values.items()]
    box = certificates_of(shipped("double_integrator", *changed)).schedule_box
    assert box is not None
    assert box.exists


def test_linear_equations_are_certified_from_any_start_without_a_search(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(
        "class Own:\n    def derivative(self, t_s, z, u):\n"
        "        return [z[1], 9.81 * z[0] - 0.1 * z[1] + u[0]]\n"
    )
    start = "plant.initial_state=[30.0,0.0]"
    as_matrices = certificates_of(shipped("unstable_pendulum", start, 'plant.draw="nominal"'))
    system = f'{{kind="python", file="{tmp_path}/own.py", name="Own"}}'
    own = certificates_of(
        shipped("unstable_pendulum", start, 'plant.draw="nominal"', f"plant.system={system}",
                "model.A=[[0,1],[9.81,-0.1]]", "model.B=[[0],[1]]")
    )  # fmt: skip
    assert own.answer.is_certified, own.answer.text
    assert own.schedule.has("x")
    assert as_matrices.schedule.has("x")


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
def test_no_bound_is_infinite(settings: list[str]) -> None:
    for _, certificate in certificates_of(shipped("unstable_pendulum", *settings)):
        if certificate.proven is None:
            assert certificate.void
        else:
            assert all(np.isfinite(bound).all() for bound in certificate.proven.bounds.values())


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
    assert {(c.verdict, c.since_s) for c in claims} == {("ended", 0.0)}


def test_a_set_point_is_certified_in_its_own_coordinates() -> None:
    """A mass rests at any position."""
    moved = certificates_of(shipped("double_integrator", "controller.setpoint=[3.0, 0.0]"))
    zero = certificates_of(shipped("double_integrator", "plant.initial_state=[-2.0, 0.0]"))
    assert moved.schedule.proven == zero.schedule.proven
    assert moved.schedule.exists
    assert moved.to_json()["setpoint"] == (3.0, 0.0)
    for results, named in ((moved, "‖x − x_r‖ ≤ "), (zero, "‖x‖ ≤ ")):
        document = certificate_document(results)
        texts = [block.text for block in document.blocks if isinstance(block, Sentence)]
        assert any(named in text for text in texts)
        assert not any("‖x‖ ≤ " in text for text in texts) or named == "‖x‖ ≤ "
        assert named.strip() in repr(results)


def test_a_claim_at_a_set_point_is_about_the_distance_from_it() -> None:
    claims = RunClaims(simulate(resolved("double_integrator", "controller.setpoint=[3.0, 0.0]"))).evaluate()
    bounds = [claim.bound for claim in claims if claim.source.endswith("certificate") and "‖x" in claim.bound]
    assert bounds
    assert all(bound.startswith("‖x − x_r‖ ≤ ") for bound in bounds)


P = 0.05
MANSD = 2
WITHOUT_CAP = (
    "network.enforce_mansd=false", f"network.mansd={MANSD}",
    f'network.loss={{model="bernoulli", probability={P}}}', 'plant.draw="nominal"',
)  # fmt: skip


@pytest.fixture(scope="module")
def without_a_cap() -> Certificates:
    return Certificates(resolved("lane_weighted", *WITHOUT_CAP))


def test_a_run_of_the_largest_number_of_events_keeps_the_assumption_as_often_as_stated(
    without_a_cap: Certificates,
) -> None:
    """By 4000 sequences of losses that are drawn here."""
    scheduled = without_a_cap.schedule
    assert scheduled.proven is not None
    packets = scheduled.proven.most_events(
        resolved("lane_weighted").timing.horizon_ns / 1e9,
        scheduled.conditions.start_s,
        scheduled.conditions.spacing_s,
    )
    assert packets is not None
    lost = np.random.default_rng(1).uniform(size=(4000, packets)) < P
    lost[:, 0] = False
    bursts = np.lib.stride_tricks.sliding_window_view(lost, MANSD + 1, axis=1)
    allowed_count = int((~bursts.all(axis=2).any(axis=1)).sum())
    (why,) = (assumption.why for assumption in scheduled.assumptions if "not enforced" in assumption.why)
    stated = float(why.split("probability ")[1].split()[0])
    assert abs(allowed_count / 4000 - stated) < 5 * (stated * (1 - stated) / 4000) ** 0.5


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (
            ["unstable_pendulum", "--set=model.gain=[[15.0, 5.0]]", "--set=model.allow_unstable=true"],
            "the loop's u is +Kx, and −K would stabilise it",
        ),
    ],
)
def test_a_loop_without_any_certificate_has_the_reasons(words: list[str], reason: str) -> None:
    result = invoke("certify", *words, "--no-search", "--verbose")
    assert result.exit_code == 1
    assert reason in " ".join(result.stdout.split())


PROVEN = ProvenBounds(
    rate_per_s=0.2,
    bounds={"x": ProvenBound(7.0, 0.5), "e_c": ProvenBound(1.0, 0.0), "e_s": ProvenBound(0.25, 0.0)},
    limits={"y[1]": 0.125},
    inter_event_s=0.004,
    first_event_s=None,
    is_quiet=True,
)
REASON = "none was found"


def with_proofs(results: Certificates, *statements: tuple[str, str, ProvenBounds | None]) -> Certificates:
    """Give certificates what a search would have proven: plants, conditions, bounds."""
    results._found = []
    for plants, under, proven in statements:
        statement = WitnessedStatement(plants, under, None, None, "" if proven else REASON, proven)
        certificate = certificate_of(results.scenario, statement, allowed_conditions(results.scenario))
        results._found.append(({"ideal": "paper"}.get(under, under), certificate))
    return results


def printed(certificates: Certificates, *, verbose: bool = True) -> str:
    document = certificate_document(certificates, verbose=verbose)
    print_document(Console(file=(output := StringIO()), width=100), document)
    return output.getvalue()


def test_the_first_screen_is_a_sentence_and_a_few_lines() -> None:
    """``APPROVE=1 pytest`` writes them anew: read the difference."""
    outputs = 'outputs=[{name="angle", unit="rad", allowed=0.02}, {name="rate", unit="rad/s", allowed=0.005}]'
    of_outputs = PROVEN._replace(
        bounds={**PROVEN.bounds, "y[0]": ProvenBound(3.0, 0.015), "y[1]": PROVEN.bounds["x"]}
    )
    own, box, none = ("own", "schedule", PROVEN), ("box", "schedule", of_outputs), ("own", "schedule", None)
    cases = {
        "stated outputs": with_proofs(Certificates(resolved("unstable_pendulum", outputs)), own, box),
        "the states": with_proofs(Certificates(resolved("unstable_pendulum")), own),
        "no certificate, by a search": with_proofs(Certificates(resolved("unstable_pendulum", LATE)), none),
        "no certificate, without a search": with_proofs(Certificates(resolved("cart_pole")), none),
    }
    cases["no certificate, by a search"].is_searched = True
    cases["stated outputs"].threshold_advice["rate"] = "trigger.floor = 0.0001 is small enough (proved)"
    text = ""
    for name, certificates in cases.items():
        assert len(certificate_document(certificates).blocks) <= 11
        text += f"# {name}\n{printed(certificates, verbose=False)}"
    compare_text(Path(__file__).with_name("first_screens.txt"), text)


NONE = ("own", "schedule", None)


@pytest.mark.parametrize(
    ("statements", "status"),
    [
        ([NONE], ExitStatus.FAILED),
        ([NONE, ("box", "schedule", PROVEN)], ExitStatus.OK),
        ([NONE, ("own", "ideal", PROVEN)], ExitStatus.OK),
    ],
)
def test_each_proof_is_enough_for_the_exit_status(
    statements: list[Any], status: ExitStatus, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also one for all plants of the box alone, or for the idealised loop."""
    monkeypatch.setattr(Certificates, "prove", lambda self, *_, **__: with_proofs(self, *statements))
    for advice in ("helpful_settings", "largest_settings"):
        monkeypatch.setattr(f"cosim.analysis.certificates.{advice}", lambda *_: ())
    assert invoke("certify", "lane_following", "--no-search").exit_code == status


def test_a_guarantee_about_a_reference_ends_with_the_run() -> None:
    results = with_proofs(Certificates(resolved("servo_reference")), ("own", "schedule", PROVEN))
    assert ", up to 16 s, although" in printed(results, verbose=False)


def test_what_is_proven_leaves_nothing_undecided() -> None:
    results = Certificates(resolved("lane_periodic"))
    results.__dict__["stability"] = Stability(0.9, 1.1, (True,), (0.05,))
    assert "Not decided whether" in printed(with_proofs(results, ("own", "schedule", None)))
    assert "Not decided whether" not in printed(with_proofs(results, ("own", "schedule", PROVEN)))


def test_only_a_proven_growth_below_1_is_called_stable() -> None:
    """A certificate that bounds no ‖x‖ says nothing about stability."""
    results = Certificates(resolved("lane_periodic"))
    errors = PROVEN._replace(bounds={"e_s": PROVEN.bounds["x"]})
    for upper, proven, is_stable in ((0.95, None, True), (1.1, None, False), (1.1, errors, False)):
        results.__dict__["stability"] = Stability(0.9, upper, (True,), (0.05,))
        text = printed(with_proofs(results, ("own", "schedule", proven)), verbose=False)
        assert ("stable if nothing is late" in text) is is_stable
        assert ("though the loop is stable" in " ".join(text.split())) is is_stable


def test_the_table_has_the_bounds_of_what_is_proven() -> None:
    outputs = 'outputs=[{name="angle", unit="rad"}, {name="rate", unit="rad/s"}]'
    results = with_proofs(
        Certificates(resolved("unstable_pendulum", outputs)),
        ("own", "ideal", None),
        ("own", "schedule", PROVEN),
    )
    table = certificate_table(results)
    assert table is not None
    assert [heading.replace("\n", " ") for heading in table.headings] == ["", "schedule, plant"]
    rows = dict(map(tuple, table.rows))  # type: ignore[arg-type]
    assert rows["‖x‖ ≤"] == "7 e^(−0.2t) + 0.5"
    assert rows["‖e_s‖ ≤"] == "0.25 e^(−0.2t)"
    assert rows["|rate| in rad/s ≤"] == "7 e^(−0.2t) + 0.5"
    assert rows["inter-event time in s ≥"] == "0.004"
    t_s = np.array([0.0, 10.0])
    np.testing.assert_allclose(results.schedule.state(t_s), 7.0 * np.exp(-0.2 * t_s) + 0.5)
    text = " ".join(printed(results).split())
    assert "‖x‖ ≤ 7 e^(−0.2t) + 0.5 (proved). The inter-event time is at least 4 ms, except between" in text


@pytest.mark.usefixtures("short_searches")
def test_bounds_of_the_command_are_those_of_the_checker() -> None:
    result = json.loads(invoke("certify", "double_integrator", "--json").stdout)
    scenario: Any = resolved("double_integrator")
    under = {"paper": "ideal", "schedule": "schedule"}
    assert len(result["certificates"]) == 4
    for certificate in result["certificates"]:
        plants = "box" if "box" in certificate["scope"] else "own"
        proof = find_statement(scenario, plants, under[certificate["under"]], most_work=0.02).proof
        value = certificate["proven"]["bounds"]["x"]["decaying"]
        assert proof is not None
        (bound,) = (b for b in smallest_bounds(proof) if b.output == "x" and b.from_start)
        assert arb(value) >= bound.decaying
        assert value == pytest.approx(float(bound.decaying.mid()), rel=1e-9)


@pytest.mark.parametrize(
    ("is_quiet", "first_s", "events_s"),
    [
        (True, 0.25, np.arange(0, 9, 0.25)),
        (True, 0.125, np.concatenate([[0.0], np.arange(0.125, 9, 0.25)])),
        (True, None, np.concatenate([[0.0], np.arange(1e-9, 9, 0.25)])),
        (False, None, np.concatenate([np.arange(0, 0.5, 0.0625), np.arange(0.5, 9, 0.25)])),
    ],
    ids=["all far apart", "an early second one", "a second one at once", "tests before the first input"],
)
@pytest.mark.parametrize("until_s", [0.5, 3.0, 8.1])
def test_no_more_events_are_counted_on_than_may_happen(
    is_quiet: bool, first_s: float | None, events_s: Vector, until_s: float
) -> None:
    bounds = PROVEN._replace(is_quiet=is_quiet, inter_event_s=0.25, first_event_s=first_s)
    most = bounds.most_events(until_s, 0.5, 0.0625)
    assert most is not None
    assert int((events_s <= until_s).sum()) <= most <= int((events_s <= until_s).sum()) + 3
    assert PROVEN._replace(is_quiet=is_quiet, inter_event_s=None).most_events(until_s, 0.5, 0.0625) is None


def test_what_keeps_a_guarantee_is_not_known_beyond_a_jump_of_the_reference() -> None:
    """After it nothing keeps events apart."""
    step = 'controller.reference=[{kind="step", output="angle", value=1.0, from_s=8.0}]'
    free = ("network.enforce_mansd=false", 'network.loss={model="bernoulli", probability=0.01}')
    for jumps in (True, False):
        scenario = resolved("servo_reference", *free, step, f"horizon_s={12.0 if jumps else 6.0}")
        certificate = quick_certificate(scenario)
        assert certificate.inter_event_s
        (kept,) = [each.why for each in certificate.assumptions if each.why.startswith("not enforced")]
        assert kept.endswith("or more (computed)") != jumps


def test_a_box_without_a_proof_is_said() -> None:
    words = ["certify", "f16_lateral", "--no-search", "--set"]
    without = invoke(*words, "plant.measure_every=5").stdout
    assert "nothing is proven for the stated uncertainty" in " ".join(without.split())
    assert "nothing is proven" not in invoke(*words, "plant.measure_every=1").stdout


def test_a_region_that_is_not_found_leaves_the_bounds_by_gains() -> None:
    statement = find_statement(resolved("sine_pendulum"), "region", "schedule", most_work=1e-9)
    assert statement.document is not None
    assert "gains" in statement.document
    assert "bounds" not in statement.document
