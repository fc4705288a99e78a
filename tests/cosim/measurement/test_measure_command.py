"""``noack measure``: sources, tables, page, written networks, the time without a certificate."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from click.testing import Result
from hypothesis import given, settings
from hypothesis import strategies as st

import noack
from cosim.measurement.certificate_time import DELAY, certificate_time
from cosim.measurement.chain_fits import ChainRates
from cosim.measurement.loss_bursts import histogram
from cosim.measurement.measurement_outputs import measurement_figures, measurement_tables
from cosim.measurement.network_measurement import (
    MeasurementOptions,
    NetworkMeasurement,
    autocorrelation,
    normal_scores,
)
from cosim.measurement.network_section import trace_csv
from cosim.measurement.trace_sources import SourceOptions, read_source, updates_trace
from cosim.record.run_events import packet_outcomes
from cosim.simulation.virtual_time import simulate
from netem.fates import description
from noack.core.errors import CallerError
from noack.impairments.loss_prediction import read_files
from noack.scenario import toml_file
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate
from noack.scenario.sections import NetworkSection
from noack.traces.packet_trace import LOST_NS, PacketTrace, packet_trace, read_trace
from tests.cosim.measurement.chains import PERIOD_NS, chain_losses, trace_of
from tests.fuzz.parsers.fates import SPECS, TABLE
from tests.helpers.command_line import invoke
from tests.oracles.link import Link

RURAL = Path(__file__).parents[3] / "noack/traces/shipped/cicv5g" / "rural_n8_10kmh.csv"


def measure(*words: object) -> Result:
    return invoke("measure", *words)


def section(path: Path) -> NetworkSection:
    return toml_file.validated(NetworkSection, toml_file.read(path)["network"], "network")


@pytest.fixture(scope="module")
def chain_csv(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("trace") / "chain.csv"
    path.write_text(trace_csv(trace_of(chain_losses(4000, ChainRates(0.05, 0.5, 0, 1), 1))))
    return path


def test_json_tables_and_page_have_the_same_numbers(tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    words = (RURAL, "--deadline", "100ms", "--for-scenario", "lane_following", "--window", 20)
    document = json.loads(measure(*words, "--json", "--out", page).stdout)
    assert (document["packets"], document["late"], document["M"]) == (2178, 616, 49)
    assert document["windows"] == {"20": {"most_losses": 20, "without_outages": 20}}
    assert sum(int(n) * count for n, count in document["histogram"].items()) == 616
    assert document["certificate"]["share"] == pytest.approx(0.57, abs=0.01)
    assert document["written"] == [str(page)]
    html = page.read_text()
    assert html.count("<svg") + html.count("<img") == 4
    printed = measure(RURAL, "--deadline", "100ms")
    assert printed.exit_code == 0
    for text in ("616 (28.3 %)", "175 packets, 10.9 s, from 81.312 s"):
        assert text in html
        assert text in " ".join(printed.output.split())


def test_the_written_model_is_a_network_with_the_fitted_parameters(chain_csv: Path, tmp_path: Path) -> None:
    path = tmp_path / "network.toml"
    assert measure(chain_csv, "--write", path, "--as", "model").exit_code == 0
    network = section(path)
    assert network.link.impairments[0].loss.transitions == pytest.approx((0.05, 0.5), rel=0.2)  # type: ignore[union-attr]
    assert network.link.longest_delay_s == 0.001
    assert not network.enforce_mansd
    assert measure(RURAL, "--deadline", "100ms", "--write", path, "--as", "model").exit_code == 0
    network = section(path)
    assert [impairment.kind for impairment in network.impairments] == ["loss", "delay"]
    assert "outages" in path.read_text()
    scenario = noack.load("lane_following", {"network": network.model_dump(exclude_none=True)})
    assert noack.simulate(noack.with_settings(scenario, {"horizon_s": 1.0})).summary


@pytest.mark.usefixtures("no_drawing")
def test_a_network_without_losses_is_measured(tmp_path: Path) -> None:
    path = tmp_path / "all.csv"
    path.write_text("sent_ms,received_ms\n0,1\n")
    for words in ((), ("--out", tmp_path / "a.html"), ("--write", tmp_path / "a.toml")):
        document = measure(path, "--for-scenario", "lane_following", "--json", *words)
        assert json.loads(document.stdout)["M"] == 1
    path.write_text("sent_ms,received_ms\n0,\n5,\n")
    for words in ((), ("--out", tmp_path / "a.html")):
        document = json.loads(measure(path, "--json", *words).stdout)
        assert (document["lost"], document["M"], document["delay_s"]) == (2, 3, {})


def test_correlation_is_that_of_an_autoregressive_delay() -> None:
    rng, z = np.random.default_rng(1), np.zeros(20_000)
    for k in range(1, len(z)):
        z[k] = 0.8 * z[k - 1] + 0.6 * rng.normal()
    delay_ns = np.exp(15 + z).astype(np.int64)
    known = rng.random(len(z)) > 0.2
    lags, correlations = autocorrelation(delay_ns, known)
    for lag, correlation in list(zip(lags, correlations, strict=True))[:5]:
        assert correlation == pytest.approx(0.8**lag, abs=0.04)
    scores = normal_scores(np.array([5, 1, 1, 9]))
    assert scores[1] == scores[2] < scores[0] < scores[3]
    sent = 10**8 * np.arange(len(z))
    trace = packet_trace(sent, sent + delay_ns, ~known)
    delays = NetworkMeasurement(trace).delays
    assert delays.quantiles_s[0.5] == pytest.approx(np.median(delay_ns[known]) * 1e-9)
    assert delays.received == known.sum()


@settings(max_examples=6, deadline=None)
@given(
    st.lists(
        st.tuples(st.integers(0, 10**9), st.none() | st.integers(0, 10**12)),
        min_size=1,
        max_size=40,
    ),
    st.none() | st.floats(1e-9, 1e3),
)
def test_any_trace_is_measured(records: list[tuple[int, int | None]], deadline_s: float) -> None:
    sent = np.cumsum([gap for gap, _ in records])
    lost = np.array([delay is None for _, delay in records])
    received = sent + np.array([delay or 0 for _, delay in records])
    trace = packet_trace(sent, received, lost)
    measurement = NetworkMeasurement(trace, MeasurementOptions(deadline_s=deadline_s))
    with np.errstate(all="raise", under="ignore"):
        document = measurement.to_json()
    assert document["effective_losses"] >= int(lost.sum())
    void = measurement.certificate_time(noack.load("lane_following"))
    assert 0 <= void.share <= 1
    assert all(cause.share <= void.share for cause in void.causes)
    assert [*measurement_tables(measurement, void)]
    assert len([*measurement_figures(measurement)]) == 4


def through(path: Path, sent_ns: np.ndarray) -> PacketTrace:
    """Send packets at some times through a written network."""
    section = toml_file.validated(NetworkSection, toml_file.read(path)["network"], str(path))
    link = Link(read_files(section.link, path.parent), 1, "test")
    releases = np.array([link.decide(0, 100, at_ns).release_ns for at_ns in sent_ns.tolist()])
    return packet_trace(sent_ns, np.maximum(releases, sent_ns), releases < 0)


def measured_again(source: Path | str, path: Path, form: str) -> tuple[noack.Measurement, ...]:
    first = noack.measure(source)
    first.write_network(path, form)  # type: ignore[arg-type]
    sent_ns = first.trace.sent_ns
    if form == "model":
        sent_ns = PERIOD_NS * np.arange(12_000)
    second_trace = through(path, sent_ns)
    csv = path.with_suffix(".again.csv")
    csv.write_text(trace_csv(second_trace))
    return first, noack.measure(csv)


@pytest.mark.parametrize("first_lost", [False, True])
def test_a_written_trace_repeats_each_packet(tmp_path: Path, first_lost: bool) -> None:
    rng = np.random.default_rng(1)
    lost = chain_losses(800, ChainRates(0.1, 0.4, 0.02, 0.9), 3)
    lost[0] = first_lost
    trace = trace_of(lost)
    late_ns = np.where(lost, 0, rng.integers(0, 3 * PERIOD_NS, len(lost)))  # overtakes
    csv = tmp_path / "trace.csv"
    csv.write_text(trace_csv(packet_trace(trace.sent_ns, trace.sent_ns + late_ns, lost)))
    first, second = measured_again(csv, tmp_path / "network.toml", "trace")
    assert (first.trace.received_ns == second.trace.received_ns).all()
    assert histogram(first.bursts) == histogram(second.bursts)
    assert bool(first.trace.received_ns[0] == LOST_NS) is first_lost


def test_a_written_model_has_the_parameters_and_delays(tmp_path: Path) -> None:
    """A Gilbert chain with correlated delays below the period, so that nothing is overtaken."""
    rng, z = np.random.default_rng(2), np.zeros(6000)
    for k in range(1, len(z)):
        z[k] = 0.7 * z[k - 1] + np.sqrt(1 - 0.49) * rng.normal()
    lost = chain_losses(len(z), ChainRates(0.05, 0.4, 0, 1), 3)
    sent_ns = PERIOD_NS * np.arange(len(z))
    delay_ns = (PERIOD_NS * (0.3 + 0.2 * np.tanh(z))).astype(np.int64)
    csv = tmp_path / "trace.csv"
    csv.write_text(trace_csv(packet_trace(sent_ns, sent_ns + delay_ns, lost)))
    first, second = measured_again(csv, tmp_path / "network.toml", "model")
    fits = [measurement.models["gilbert"].fit.rates for measurement in (first, second)]
    assert fits[0] == pytest.approx(fits[1], rel=0.1)
    for share, delay_s in first.delays.quantiles_s.items():
        assert second.delays.quantiles_s[share] == pytest.approx(delay_s, abs=2e-4)
    correlations = [measurement.delays.correlation.at_lags[0] for measurement in (first, second)]
    assert correlations[0] == pytest.approx(correlations[1], abs=0.03)


def test_a_fate_file_gives_the_first_intact_delivery(tmp_path: Path) -> None:
    path = tmp_path / "fates.parquet"
    pq.write_table(TABLE.replace_schema_metadata(description(SPECS, 0)), path)
    trace = read_source([path])
    assert trace.notes[0] == "flow 1: up forward, flow 0, 4 packets; --flow chooses another of the 3 flows"
    assert trace.sent_ns.tolist() == [0, 10, 20, 30]
    # Delivered; dropped; corrupted, but its copy is intact and arrives 9 ns later; forced.
    assert trace.delay_ns.tolist() == [5, -1, 9, 5]
    assert len(read_source([path], SourceOptions(flow=3))) == 1
    with pytest.raises(CallerError, match="has no flow 4; its flows are 1 to 3"):
        read_source([path], SourceOptions(flow=4))
    incomplete = TABLE.replace_schema_metadata(description(SPECS, 7))
    pq.write_table(incomplete, path)
    with pytest.raises(CallerError, match="7 events are missing"):
        read_source([path])
    pq.write_table(pa.table({"a": [1]}), path)
    with pytest.raises(CallerError, match="not a fate trace"):
        read_source([path])


def test_a_run_gives_its_effective_losses(content: dict[str, Any]) -> None:
    content |= {"horizon_s": 5.0, "trigger": {"policy": "periodic", "period_s": 0.05}}
    loss = {"model": "bernoulli", "probability": 0.3}
    delay = {"kind": "delay", "delay_s": 0.1, "jitter_s": 0.1}
    content["network"] = {"mansd": 4, "loss": loss, "impairments": [delay]}
    record = simulate(resolve(validate(content, "test")))
    outcomes = packet_outcomes(record)
    trace = updates_trace(record)
    newest = np.minimum.accumulate(np.where(trace.lost, 2**62, trace.received_ns)[::-1])[::-1]
    effective = ~trace.lost & (trace.received_ns <= newest)
    assert (~effective).tolist() == outcomes.lost[: len(trace)].tolist()
    assert outcomes.lost.any()


def test_opportunities_delay_a_probe_until_the_next_one(tmp_path: Path) -> None:
    path = tmp_path / "link.up"
    times_ms = [0, 30, 31, 100, 200]
    path.write_text("".join(f"{t}\n" for t in times_ms))
    trace = read_source([path], SourceOptions(period_ns=20_000_000))
    # An opportunity at the very time of an arrival is lost, as in mahimahi.
    expected = [min(t for t in times_ms if t > sent_ms) - sent_ms for sent_ms in range(0, 200, 20)]
    assert trace.delay_ns.tolist() == [delay_ms * 10**6 for delay_ms in expected]
    assert "5 in 0.2 s, 0.3008 Mbit/s; longest time without one: 100 ms, before 0.2 s" in trace.notes[0]


def test_files_that_cannot_be_measured_are_refused_in_one_line(tmp_path: Path) -> None:
    csv = tmp_path / "a.csv"
    csv.write_text("sent_ms,received_ms\n0,1\n")
    for paths, options, message in (
        ([tmp_path], SourceOptions(), str(tmp_path)),
        ([tmp_path / "none"], SourceOptions(), "No such file"),
        ([csv, csv], SourceOptions(), "expected one file, or two captures"),
        ([csv], SourceOptions(sequence_at="0:4"), "--sequence-at: has no effect on a packet trace"),
    ):
        with pytest.raises(CallerError, match=message) as refused:
            read_source(paths, options)
        assert "\n" not in str(refused.value)


MS = 1_000_000
TRACES = Path(__file__).parents[3] / "noack/traces/shipped/cicv5g"


def lane(**network: object) -> Scenario:
    return noack.load("lane_following", {f"network.{key}": value for key, value in network.items()})


LANE = lane(mansd=2)  # allows 4 ms in the network


def share(certificate_time: object, cause: str) -> float:
    return next((violation.share for violation in certificate_time.causes if violation.cause == cause), 0.0)  # type: ignore[attr-defined]


@settings(max_examples=25, deadline=None)
@given(st.lists(st.one_of(st.none(), st.integers(0, 40)), min_size=2, max_size=14))
def test_shares_are_those_of_a_step_through_the_time(delays: list[int | None]) -> None:
    """In every millisecond: are more than two packets missing, is one, or the first, overdue?"""
    sent = 10 * np.arange(len(delays))
    received = [None if d is None else 10 * k + d for k, d in enumerate(delays)]
    lost = np.array([d is None for d in delays])
    trace = packet_trace(sent * MS, (sent + np.array([d or 0 for d in delays])) * MS, lost)
    end = max(sent[-1], *(t_ms for t_ms in received if t_ms is not None), 0)

    def replaced(k: int) -> float:
        return min((t_ms for t_ms in received[k + 1 :] if t_ms is not None), default=np.inf)

    stale = [t_ms is not None and replaced(k) < t_ms for k, t_ms in enumerate(received)]
    is_lost = [t_ms is None or (stale[k] and replaced(k) - 10 * k > 4) for k, t_ms in enumerate(received)]
    late = void = 0
    for ms in range(end):
        overdue = any(
            t_ms is not None and not stale[k] and 10 * k + 4 <= ms < t_ms for k, t_ms in enumerate(received)
        )
        missing = False
        for k in range(2, len(delays)):
            if all(is_lost[k - 2 : k + 1]) and 10 * k <= ms < replaced(k):
                missing = True
        has_none = received[0] is None or stale[0]  # the first is not the first to arrive
        none_yet = has_none and 4 <= ms < min((t_ms for t_ms in received if t_ms is not None), default=end)
        late += overdue
        void += overdue or missing or none_yet
    times = certificate_time(trace, LANE)
    assert times.allowed_delay_s == 0.004
    assert times.allowed_losses == 2
    if end:
        assert times.share == pytest.approx(void / end)
        assert share(times, DELAY) == pytest.approx(late / end)


def test_every_rule_of_the_guarantee_counts() -> None:
    """Two losses in any five packets, at 10 ms a packet: one too many from 60 to 71 ms."""
    scenario = lane(mansd=2, constraints=[{"kind": "at_most", "losses": 2, "window": 5}])
    sent, lost = 10 * np.arange(15), np.zeros(15, bool)
    lost[[2, 4, 6]] = True
    void = certificate_time(packet_trace(sent * MS, (sent + 1) * MS, lost), scenario)
    (cause,) = void.causes
    assert (cause.cause, cause.worst, cause.first_s) == ("atmost 2 in 5", 3, pytest.approx(0.06))
    assert void.kept["dropouts"] == "kept: 1 consecutive updates lost, 2 allowed"
    assert cause.share == pytest.approx(11 / 141)


def test_the_first_update_must_be_received_unless_the_state_is_known() -> None:
    sent, lost = 10 * np.arange(15), np.zeros(15, bool)
    lost[:2] = True
    trace = packet_trace(sent * MS, (sent + 1) * MS, lost)
    (cause,) = certificate_time(trace, LANE).causes
    assert (cause.cause, cause.first_s, cause.worst) == ("start", pytest.approx(0.004), pytest.approx(0.021))
    assert cause.share == pytest.approx(17 / 141)
    assert certificate_time(trace, lane(mansd=2, initial_sync="known_state")).first_s is None


def test_the_certificates_of_the_scenario_are_named() -> None:
    trace = read_trace(TRACES / "rural_n8_10kmh.csv")
    void = certificate_time(trace, lane())
    assert None in void.certificates.values()
    assert [cause.cause for cause in void.causes] == [DELAY]
    assert void.causes[0].worst == pytest.approx(9.744)
    slow = lane(impairments=[{"kind": "delay", "delay_s": 9.8}])
    slow_void = certificate_time(trace, slow)
    assert slow_void.share == 0.0
    assert slow_void.kept["dropouts"] == "kept"  # nothing was lost
    assert slow_void.kept[DELAY].startswith("kept: an update was in the network for 9.744 s, 9.8")
    acknowledged = certificate_time(trace, noack.load("lane_acknowledged"))
    assert all(reason is not None for reason in acknowledged.certificates.values())


def test_conditions_that_change_during_the_run_are_not_compared_with_a_trace() -> None:
    """With M − 1 = 8 at the start and 2 from 1 s on, 4 losses at 3 s were 'kept: 8 allowed'."""
    sent_ns = np.arange(100) * 100_000_000
    received_ns = sent_ns + 1_000_000
    received_ns[30:34] = LOST_NS
    trace = PacketTrace(np.arange(100), sent_ns, received_ns)
    changes = [{"at_s": 1.0, "set": {"network.mansd": 2}}]
    scenario = noack.load("lane_following", {"network.mansd": 8, "changes": changes})
    with pytest.raises(CallerError, match="changes: needs settings that stay the same"):
        certificate_time(trace, scenario)
