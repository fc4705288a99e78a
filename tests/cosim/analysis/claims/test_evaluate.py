"""Claims against runs: held, violated or void, as constructed; random runs violate none."""

import re
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from cosim.analysis.claims import catalogue
from cosim.analysis.claims.claim_definition import CertifiedClaim, ClaimDefinition
from cosim.analysis.claims.claim_evaluation import ClaimEvaluation, definitions
from cosim.analysis.summary_model import Claim, ClaimVerdict
from cosim.record.run_record import RunRecord
from cosim.simulation.virtual_time import simulate
from noack.core.linear_systems import spectral_abscissa
from noack.protocol.record_tables import CONTROLLER_DELIVERY, CONTROLLER_STEP, SENSOR_MEASUREMENT
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate
from tests.cosim.analysis.claims.conftest import Make, event_s, without
from tests.cosim.record.changed_records import changed

HELD, VIOLATED, VOID = ClaimVerdict.HELD, ClaimVerdict.VIOLATED, ClaimVerdict.VOID

CERTIFIED = (
    "the sensor's error is bounded",
    "the controller's error is bounded",
    "the state is bounded",
    "minimum inter-event time",
    "the state is bounded from the newest event on",
    "the controller's error is bounded by the events it misses",
)


def certified(record: RunRecord) -> dict[str, Claim]:
    return {c.what: c for c in ClaimEvaluation(record).judge() if c.source == "certificate"}


def from_I1(record: RunRecord) -> list[Claim]:
    return [claim for claim in ClaimEvaluation(record).judge() if claim.source == "(I1)"]


DOCS = Path(__file__).parents[4] / "docs" / "record.md"


def test_the_docs_list_every_claim_of_the_catalogue() -> None:
    texts = [path.read_text() for path in Path(catalogue.__path__[0]).glob("*.py")]
    defined = sum(len(re.findall(r"^@(?:claim|certified)\(", text, re.MULTILINE)) for text in texts)
    rows = {(one.statement, one.source, one.assumes) for one in definitions(ClaimDefinition)}
    rows |= {(one.statement, "certificate", one.assumes) for one in definitions(CertifiedClaim)}
    assert len(rows) == defined
    text = DOCS.read_text(encoding="utf-8")
    section = text[text.index("\n## Claims") : text.index("\n## The summary")]
    listed = [line.strip("| ").split(" | ") for line in section.splitlines() if " | " in line]
    assert {tuple(cells) for cells in listed[1:]} == rows


# --- held -----------------------------------------------------------------------------------------


def test_certified_claims_hold_in_a_run_that_meets_its_schedule(run: RunRecord) -> None:
    assert {c.what: c.verdict for c in certified(run).values()} == dict.fromkeys(CERTIFIED, HELD)
    for claim in ClaimEvaluation(run).judge():
        assert claim.since_s is None
        assert claim.ratio is not None
        assert 0 <= claim.ratio <= 1
        if claim.certified is not None and claim.what != "minimum inter-event time":
            assert claim.observed == pytest.approx(claim.certified * claim.ratio)


def test_the_observed_value_is_the_smallest_bound_that_would_hold(run: RunRecord) -> None:
    """Computed from the recorded tables, not from the aligned ones."""
    claims, rows = certified(run), run[SENSOR_MEASUREMENT]
    trigger = run.scenario.trigger
    growth = np.exp(trigger.alpha_per_s * rows["t_ns"] * 1e-9)
    errors = np.linalg.norm(rows["x_s"] - rows["x"], axis=1) * growth / trigger.beta
    assert claims[CERTIFIED[0]].observed == pytest.approx(errors.max(), rel=1e-6)
    sizes = np.linalg.norm(rows["x"], axis=1) * growth
    assert claims[CERTIFIED[2]].observed == pytest.approx(sizes.max(), rel=1e-9)
    event_s = rows["t_ns"][rows["event"] >= 0] * 1e-9
    assert claims[CERTIFIED[3]].observed == pytest.approx(np.diff(event_s).min(), rel=1e-6)


# --- violated -------------------------------------------------------------------------------------


def test_a_run_of_another_plant_violates_the_certificate(make: Make) -> None:
    """The certificate is for a plant equal to the model that starts at a tenth of the distance."""
    run = simulate(make())
    plant = {"A": [[0.0, 1.0], [0.0, 0.0]], "B": [[0.0], [1.0]], "initial_state": [0.1, 0.0]}
    other = changed(run, scenario=make(plant=plant))
    claims = certified(other)
    state = claims["the state is bounded"]
    assert (state.verdict, state.since_s) == (VIOLATED, 0.0)
    assert state.ratio is not None
    assert state.ratio > 1
    assert claims["minimum inter-event time"].verdict is VIOLATED
    # it makes no assumption on the plant
    assert [claim.verdict for claim in from_I1(other)] == [HELD, HELD]


@pytest.mark.parametrize(
    ("table", "column", "by", "violated"),
    [
        (SENSOR_MEASUREMENT, "x", 0.1, CERTIFIED[4]),  # a bound of the whole run still holds
        (SENSOR_MEASUREMENT, "e_s_norm", 5.0, CERTIFIED[0]),
        (CONTROLLER_STEP, "x_c", 1e-3, "x_c − x_s is the sum of the missed jumps"),
    ],
)
def test_a_wrong_value_violates_its_claim_from_its_time_on(
    run: RunRecord, table: str, column: str, by: float, violated: str
) -> None:
    rows = run[table].copy()
    row = np.flatnonzero(rows["event"] < 0)[150] if table == SENSOR_MEASUREMENT else 200
    rows[column][row] += by
    claims = {claim.what: claim for claim in ClaimEvaluation(changed(run, {table: rows})).judge()}
    assert claims[violated].verdict is VIOLATED
    assert claims[violated].since_s == pytest.approx(rows["t_ns"][row] * 1e-9, abs=0.011)
    assert claims["the state is bounded"].verdict is HELD


def test_missing_events_and_predictions_follow_from_the_tables(run: RunRecord) -> None:
    (samples,) = ClaimEvaluation(run).samples()
    rows, deliveries, loop = run[SENSOR_MEASUREMENT], run[CONTROLLER_DELIVERY], run.loop
    for i in range(0, len(rows), 7):
        t_ns = rows["t_ns"][i]
        event = rows[(rows["event"] >= 0) & (rows["t_ns"] <= t_ns)][-1]
        received = deliveries["sequence"][deliveries["model_t_ns"] <= t_ns]
        if len(received):
            assert samples.since_event.missing[i] == event["event"] - received.max()
        age_s = (t_ns - event["t_ns"]) * 1e-9
        assert samples.since_event.age_s[i] == pytest.approx(age_s)
        predicted = expm((loop.A + loop.B @ loop.K) * age_s) @ event["x"]
        np.testing.assert_allclose(samples.since_event.predicted[i], predicted, rtol=1e-9)


def test_exceeding_a_printed_bound_outside_its_assumptions_is_not_a_violation(make: Make) -> None:
    """eq:LossEv3 assumes ‖e_s‖ ≤ βe^{−αt} at all times; five tests a second do not ensure it."""
    lossy = {"loss": {"model": "worst_case"}}
    seldom = make(plant={"measure_every": 20}, network=lossy, trigger={"beta": 1e-3})
    record = simulate(seldom)
    printed = {c.source: c for c in ClaimEvaluation(record).judge()}
    exceeded = printed["eq:LossEv3"]
    assert exceeded.verdict is ClaimVerdict.NOT_APPLICABLE
    assert exceeded.ratio is not None
    assert exceeded.ratio > 1
    assert exceeded.since_s is not None
    assert "continuous trigger" in exceeded.why


# --- void -----------------------------------------------------------------------------------------


def test_a_void_claim_is_judged_only_up_to_the_violation(run: RunRecord) -> None:
    rows = run[SENSOR_MEASUREMENT].copy()
    rows["e_s_norm"][[100, 400]] = 5.0
    late = np.delete(rows, slice(300, 310))
    earlier = np.delete(late, 100)  # that event is missing, too
    rows["e_s_norm"][100] = 0.0
    for damaged, verdict, since_s in (
        (late, VIOLATED, 1.0),
        (earlier, VOID, 0.99),
        (np.delete(rows, slice(300, 310)), VOID, 2.99),
    ):
        claim = certified(changed(run, {SENSOR_MEASUREMENT: damaged}))[CERTIFIED[0]]
        assert (claim.verdict, claim.since_s) == (verdict, pytest.approx(since_s))
        assert claim.ratio is not None
        assert (claim.ratio < 1) == (verdict is VOID)


# --- incomplete records ---------------------------------------------------------------------------


@pytest.mark.parametrize("process", ["plant", "controller"])
def test_certified_claims_need_the_rows_of_every_process(run: RunRecord, process: str) -> None:
    """Claims on recorded signals are judged; too little is known about the conditions."""
    assert ClaimEvaluation(without(run, "sensor")).judge() == []
    for claim in certified(without(run, process)).values():
        assert (claim.verdict, claim.since_s) == (VOID, 0.0)


# --- further output -------------------------------------------------------------------------------


# --- no certificate is violated, for any scenario -------------------------------------------------


@st.composite
def scenarios(draw: st.DrawFn) -> Scenario:
    """Loops of every kind with schedules of every kind, with delays up to the allowed maximum."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    n, m = int(rng.integers(1, 4)), int(rng.integers(1, 3))
    H = rng.uniform(-1, 1, (n, n)) * 2
    H -= (spectral_abscissa(H) + rng.uniform(0.5, 2)) * np.eye(n)
    B, K = rng.uniform(-1, 1, (n, m)), rng.uniform(-1, 1, (m, n))
    apart = draw(st.sampled_from([0.0, 0.1, 0.3]))
    far_A, far_B = apart * rng.uniform(-1, 1, (n, n)), apart * rng.uniform(-1, 1, (n, m))
    while spectral_abscissa(H + far_A + far_B @ K) > -0.3:
        far_A, far_B = far_A / 2, far_B / 2
    speed = float(np.abs(np.linalg.eigvals(H)).max())
    step_ns = round(draw(st.sampled_from([2, 5, 10])) / speed) * 1_000_000 + 1_000_000
    tick_ns = round(step_ns * draw(st.sampled_from([0.5, 1.0, 1.5, 2.0])))
    beta, decay = draw(st.sampled_from([0.01, 0.1, 0.5])), -spectral_abscissa(H)
    content: dict[str, Any] = {
        "name": "random", "horizon_s": 9 / speed, "mode": draw(st.sampled_from(["model", "zoh"])),
        "model": {"A": (H - B @ K).tolist(), "B": B.tolist(), "gain": K.tolist()},
        "plant": {
            "draw": "given", "A": (H - B @ K + far_A).tolist(), "B": (B + far_B).tolist(),
            "initial_state": rng.uniform(-1, 1, n).tolist(), "rate_hz": 1e9 / step_ns,
            "measure_every": draw(st.integers(1, 3)),
        },
        "controller": {
            "rate_hz": 1e9 / tick_ns, "phase": draw(st.sampled_from([0.0, 0.5, 0.9])),
        },
        "trigger": {
            "beta": beta, "alpha_per_s": draw(st.sampled_from([0.3, 0.8, 2.0])) * decay,
            "floor": beta * draw(st.sampled_from([0.0, 0.0, 0.1, 0.99, 2.0])),
        },
        "network": {
            "mansd": draw(st.integers(0, 4)), "loss": {"model": "worst_case"},
            "initial_sync": draw(st.sampled_from(["first_packet", "known_state"])),
        },
        "certificate": {"late_periods": draw(st.integers(0, 3))},
    }  # fmt: skip
    return resolve(validate(content, "test"))


def hostile(resolved: Scenario, seed: int, late_periods: int | None = None) -> Any:
    """Loses as many updates as allowed, or some; delays them as long as allowed, or less."""
    rng = np.random.default_rng(seed)
    if late_periods is None:
        late_periods = resolved.certificate.late_periods
    late_ns = late_periods * resolved.timing.plant_period_ns
    known = resolved.network.initial_sync == "known_state"
    share, events, run = float(rng.choice([0.5, 1.0])), 0, 0

    def network(data: bytes, now_ns: int) -> int | None:
        nonlocal events, run
        first, events = events == 0, events + 1
        if (known or not first) and run < resolved.network.mansd and rng.uniform() < share:
            run += 1
            return None
        run = 0
        # At the last tick that is not too late.
        return int(rng.integers(0, late_ns + 1)) if late_ns else 0

    return network


@pytest.mark.parametrize("late", [False, True])
def test_no_simulated_run_violates_its_certificate(late: bool) -> None:
    """Nor the bounds of (I1). Late updates get a certificate that is chosen after the run."""
    judged: Counter[ClaimVerdict] = Counter()

    @settings(max_examples=10, phases=[Phase.generate], suppress_health_check=list(HealthCheck))
    @given(scenarios(), st.integers(0, 2**32), st.integers(4, 40))
    def check(resolved: Scenario, seed: int, late_periods: int) -> None:
        network = hostile(resolved, seed, late_periods if late else None)
        claims = ClaimEvaluation(simulate(resolved, network))
        for claim in claims.judge():
            if claim.source in ("certificate", "(I1)"):
                assert claim.verdict is not VIOLATED, claim
                assert late or claim.verdict is HELD or claim.bound == "none", claim
                if not late or (claims.certified_for and claim.source == "certificate"):
                    judged[claim.verdict] += 1

    check()
    assert judged[HELD] > (3 if late else 10 * judged[VOID])


# --- claims that cannot be judged -----------------------------------------------------------------


def test_too_many_dropouts_void_the_papers_theorems(make: Make) -> None:
    """The theorems assume M − 1; consequences of (I1) alone do not and are judged to the end."""
    record = simulate(
        make(network={"loss": {"model": "worst_case"}, "enforce_mansd": False, "mansd": 2})
    )
    claims = ClaimEvaluation(record).judge()
    since = {claim.since_s for claim in claims if claim.verdict is VOID}
    theorems = [claim for claim in claims if claim.source.startswith("Theorem")]
    assert theorems
    assert {claim.verdict for claim in theorems} == {VOID}
    # t_0 arrives; of the following updates, the third loss is one too many.
    assert list(since) == pytest.approx([event_s(record, 3)])
    assert {claim.verdict for claim in claims if claim.source == "(I1)"} == {HELD}


def test_a_claim_is_not_held_where_the_record_has_no_rows(run: RunRecord) -> None:
    """Measurements continue after the controller's record ends: ‖e_c‖ is unknown from 2 s on."""
    ticks, taken = run[CONTROLLER_STEP], run[CONTROLLER_DELIVERY]
    early = {
        CONTROLLER_STEP: ticks[ticks["t_ns"] < 2_000_000_000],
        CONTROLLER_DELIVERY: taken[taken["now_ns"] < 2_000_000_000],
    }
    cut = changed(run, early)
    unknown = [c for c in ClaimEvaluation(cut).judge() if "e_c" in c.bound or c.source == "(I1)"]
    assert unknown
    for claim in unknown:
        assert claim.verdict is not HELD
        assert claim.since_s is not None
        assert claim.since_s <= 2.02
