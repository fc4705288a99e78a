"""Claims against runs: held, violated or void, as constructed; random runs violate none."""

import math
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

import noack
from cosim.analysis.claims import catalogue
from cosim.analysis.claims.claim_definition import CertifiedClaim, ClaimDefinition
from cosim.analysis.claims.claim_evaluation import ClaimEvaluation, definitions
from cosim.analysis.summary_model import Claim, ClaimVerdict
from cosim.record.align import UNKNOWN, align_tables
from cosim.record.run_record import RunRecord
from cosim.simulation.virtual_time import simulate
from noack.core.linear_systems import spectral_abscissa
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
)
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate
from tests.cosim.analysis.claims.conftest import (
    Make,
    event_s,
    network_of,
    without,
)
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


def test_a_claim_without_data_is_held_without_an_observed_value(make: Make) -> None:
    """One event, at t = 0, gives no inter-event time."""
    record = simulate(make(trigger={"beta": 100.0}))
    claim = certified(record)["minimum inter-event time"]
    assert (claim.verdict, claim.ratio, claim.observed) == (HELD, None, None)


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


def test_a_small_jump_of_the_state_violates_only_the_claim_from_the_newest_event(
    run: RunRecord,
) -> None:
    rows = run[SENSOR_MEASUREMENT].copy()
    moved = np.flatnonzero(rows["event"] < 0)[100]
    rows["x"][moved] += 0.1
    claims = certified(changed(run, {SENSOR_MEASUREMENT: rows}))
    verdicts = [claims[CERTIFIED[i]].verdict for i in (2, 4)]
    assert verdicts == [HELD, VIOLATED]
    assert claims[CERTIFIED[4]].since_s == pytest.approx(rows["t_ns"][moved] * 1e-9)


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


def test_nothing_is_known_of_the_input_until_the_first_one_if_it_is_late(run: RunRecord) -> None:
    """The delay does not limit when it comes: until then other bounds cover the input."""
    whole = ClaimEvaluation(run)
    certificate, *_ = whole.certificates
    bounds = whole.known_state_bounds(certificate)
    assert bounds is not None
    instant, (samples,) = replace(bounds, delay_s=0.0), whole.samples()
    known = samples.since_event.missing
    after = whole.missing_events(samples, instant)
    begun_s = samples.t_s - samples.since_event.age_s
    early = begun_s < whole.started_s
    assert early.any()
    assert (after[early] == UNKNOWN).all()
    np.testing.assert_array_equal(after[~early], known[~early])
    np.testing.assert_array_equal(whole.missing_events(samples, bounds), known)


def test_a_violation_is_reported_with_its_first_time(run: RunRecord) -> None:
    rows = run[SENSOR_MEASUREMENT].copy()
    rows["e_s_norm"][150:152] = 5.0
    claim = certified(changed(run, {SENSOR_MEASUREMENT: rows}))[CERTIFIED[0]]
    assert claim.verdict is VIOLATED
    assert claim.since_s == pytest.approx(1.5)


def test_a_controller_that_is_not_the_model_violates_the_identity(run: RunRecord) -> None:
    ticks = run[CONTROLLER_STEP].copy()
    ticks["x_c"][200] += 1e-3
    claims = {c.what: c for c in from_I1(changed(run, {CONTROLLER_STEP: ticks}))}
    difference = claims["x_c − x_s is the sum of the missed jumps"]
    assert difference.verdict is VIOLATED
    assert difference.since_s == pytest.approx(2.01, abs=0.011)


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


def test_too_many_losses_void_every_certified_claim(make: Make) -> None:
    record = simulate(make(), network_of(lambda n: None if 10 <= n < 14 else 0))
    for claim in certified(record).values():
        assert claim.verdict is VOID
        assert claim.since_s == pytest.approx(event_s(record, 12))
        assert claim.why == "4 consecutive updates lost, 2 allowed"
    assert [claim.verdict for claim in from_I1(record)] == [HELD, HELD]


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


def test_a_claim_without_a_certificate_is_void_with_the_reason(make: Make) -> None:
    record = simulate(make(model={"gain": [[0.0, 0.0]], "allow_unstable": True}, horizon_s=1.0))
    (claim,) = certified(record).values()
    assert claim.verdict is VOID
    assert "grows" in claim.why


def test_claims_of_a_diverging_run_without_a_certificate_are_void(make: Make) -> None:
    record = simulate(
        make(
            horizon_s=1.0,
            model={"A": [[2000.0]], "B": [[1.0]], "gain": [[-1.0]], "allow_unstable": True},
            plant={"initial_state": [1.0], "A": [[2000.0]], "B": [[1.0]]},
        )
    )  # fmt: skip
    with np.errstate(all="ignore"):
        claims = ClaimEvaluation(record)
        judged, envelopes = claims.judge(), claims.envelopes()
    assert all(claim.verdict is not HELD for claim in judged), judged
    assert {claim.verdict for claim in judged if claim.source == "certificate"} == {VOID}
    assert [envelope.label for envelope in envelopes] == ["bound from (I1)"]


# --- incomplete records ---------------------------------------------------------------------------


def test_a_run_without_measurements_has_no_claims(run: RunRecord) -> None:
    assert ClaimEvaluation(without(run, "sensor")).judge() == []


@pytest.mark.parametrize("process", ["plant", "controller"])
def test_certified_claims_need_the_rows_of_every_process(run: RunRecord, process: str) -> None:
    """Claims on recorded signals are judged; too little is known about the conditions."""
    for claim in certified(without(run, process)).values():
        assert (claim.verdict, claim.since_s) == (VOID, 0.0)


def test_a_dead_controller_makes_claims_void_not_violated(make: Make) -> None:
    """The plant diverges under its last input, for which no bound is certified."""
    whole = simulate(make(network={"mansd": 0}), network_of(lambda n: 0))
    died_ns = 1_500_000_000
    steps, sensor = whole[PLANT_STEP].copy(), whole[SENSOR_MEASUREMENT].copy()
    late = steps["t_ns"] > died_ns
    steps["actuation"][late] = steps["actuation"][~late][-1]
    steps["x"][late] *= np.exp(steps["t_ns"][late, None] * 1e-9 * 5)
    sensor["x"][sensor["t_ns"] > died_ns] = steps["x"][late]
    kept = {
        table: whole[table][whole[table]["now_ns"] < died_ns - 40_000_000]
        for table in (CONTROLLER_STEP, CONTROLLER_DELIVERY)
    }
    record = changed(whole, {PLANT_STEP: steps, SENSOR_MEASUREMENT: sensor} | kept)
    state = certified(record)["the state is bounded"]
    assert state.verdict is VOID
    assert state.since_s is not None
    assert state.since_s <= died_ns * 1e-9 + 0.03


# --- further output -------------------------------------------------------------------------------


def test_envelopes_are_evaluated_at_the_measurements(run: RunRecord) -> None:
    claims = ClaimEvaluation(run)
    k = len(run[SENSOR_MEASUREMENT])
    found = {(e.label, e.quantity): e for e in claims.envelopes()}
    for envelope in found.values():
        points = 2 if envelope.quantity == "inter_event" else k
        assert envelope.t_s.shape == envelope.values.shape == (points,)
    own = "certified for the scenario's plant"
    assert {("bound from (I1)", "e_c"), (own, "e_c"), (own, "x")} <= set(found)
    error = align_tables(run).e_c_norm
    known = np.isfinite(found["bound from (I1)", "e_c"].values)
    assert known.sum() > k - 3
    for label in ("bound from (I1)", own):
        bound = found[label, "e_c"].values
        assert (error[known] <= bound[known] * (1 + 1e-9) + 1e-12).all()


def test_inter_event_times_are_exact_in_a_long_run(run: RunRecord) -> None:
    """At 1e7 s, a float resolves 2 ns only, so differences are taken in integer nanoseconds."""
    rows = run[SENSOR_MEASUREMENT].copy()
    rows["t_ns"] += 10**16
    shifted = changed(run, {SENSOR_MEASUREMENT: rows})
    here, there = (
        np.concatenate([part.inter_event_s[1] for part in ClaimEvaluation(record).samples()])
        for record in (run, shifted)
    )
    np.testing.assert_array_equal(here, there)


def test_values_that_are_not_finite_are_null_in_json() -> None:
    claim = Claim(
        what="w", source="s", bound="b", certified=math.inf, observed=math.nan,
        ratio=np.float64(0.5), verdict=HELD, since_s=None, why="", from_s=0.0, until_s=None,
    )  # fmt: skip
    assert claim.model_dump(mode="json") == {
        "what": "w", "source": "s", "bound": "b", "certified": None, "observed": None,
        "ratio": 0.5, "verdict": "held", "since_s": None, "why": "", "from_s": 0.0, "until_s": None,
    }  # fmt: skip


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


def test_no_simulated_run_violates_its_certificate() -> None:
    """The run also meets its conditions and the bounds of (I1)."""
    judged: dict[ClaimVerdict, int] = {}

    @settings(
        deadline=None, max_examples=10, phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(scenarios(), st.integers(0, 2**32))
    def check(resolved: Scenario, seed: int) -> None:
        claims = ClaimEvaluation(simulate(resolved, hostile(resolved, seed)))
        for claim in claims.judge():
            if claim.source in ("certificate", "(I1)"):
                assert claim.verdict is not VIOLATED, claim
                assert claim.verdict is HELD or claim.bound == "none", claim
                judged[claim.verdict] = judged.get(claim.verdict, 0) + 1

    check()
    assert judged[HELD] > 10 * judged.get(VOID, 0)


def test_no_simulated_run_violates_the_certificate_of_its_lateness() -> None:
    """Updates are later than the scenario allows; the certificate is chosen after the run."""
    judged: Counter[str] = Counter()

    @settings(
        deadline=None, max_examples=20, phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(scenarios(), st.integers(0, 2**32), st.integers(4, 40))
    def check(resolved: Scenario, seed: int, late_periods: int) -> None:
        claims = ClaimEvaluation(simulate(resolved, hostile(resolved, seed, late_periods)))
        verdicts = {one.verdict for one in claims.judge() if one.source == "certificate"}
        assert VIOLATED not in verdicts
        if claims.certified_for is not None:
            judged.update(verdicts)

    check()
    assert judged[HELD] > 3


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


def test_a_run_at_rest_holds_every_bound(make: Make) -> None:
    """x(0) = 0: all errors, and the bounds that follow from them, are 0 throughout."""
    record = simulate(make(plant={"initial_state": [0.0, 0.0]}))
    for claim in ClaimEvaluation(record).judge():
        assert claim.verdict is HELD, claim
        assert claim.ratio is None or claim.ratio <= 1


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


def test_an_estimate_that_overflows_refutes_nothing() -> None:
    """The observer's error grows without limit, until x̂ and then x_s are not finite."""
    scenario = noack.load("double_integrator", {
        "horizon_s": 20.0, "plant.rate_hz": 50, "controller.rate_hz": 50, "network.mansd": 0,
        "plant.measurement": {"C": [[1.0, 0.0]], "noise_bound": [1e-3]},
        "observer": {"kind": "luenberger", "gain": [[1e4], [1e4]]},
        "trigger": {"policy": "periodic", "period_s": 0.5},
    })  # fmt: skip
    claims = ClaimEvaluation(simulate(resolve(scenario))).judge()
    assert {claim.verdict for claim in claims} == {VOID}
