"""``noack measure``: tables, JSON, page, ``[network]`` section, mistakes."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner, Result

import noack
from cosim.cli import app
from cosim.measurement.chain_fits import ChainRates
from cosim.measurement.measurement_outputs import measurement_figures, measurement_tables, trace_csv
from cosim.measurement.network_measurement import (
    Measurement,
    MeasurementOptions,
    autocorrelation,
    normal_scores,
)
from noack.scenario import toml_file
from noack.scenario.sections import NetworkSection
from noack.traces.packet_trace import packet_trace
from tests.cosim.measurement.chains import chain_losses, trace_of

RURAL = Path(__file__).parents[3] / "noack/traces/shipped/cicv5g" / "rural_n8_10kmh.csv"


def measure(*words: object) -> Result:
    return CliRunner().invoke(app, ["measure", *map(str, words)], prog_name="noack")


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
    found = json.loads(measure(*words, "--json", "--out", page).stdout)
    assert (found["packets"], found["late"], found["M"]) == (2178, 616, 49)
    assert found["windows"] == {"20": {"most_losses": 20, "without_outages": 20}}
    assert sum(int(n) * count for n, count in found["histogram"].items()) == 616
    assert found["certificate"]["share"] == pytest.approx(0.57, abs=0.01)
    assert found["written"] == [str(page)]
    html = page.read_text()
    assert html.count("<svg") + html.count("<img") == 4
    shown = measure(*words)
    assert shown.exit_code == 0
    for text in ("616 (28.3 %)", "175 packets, 10.9 s, from 81.312 s"):
        assert text in html
        assert text in " ".join(shown.output.split())


def test_the_written_model_is_a_network_with_the_fitted_parameters(
    chain_csv: Path, tmp_path: Path
) -> None:
    path = tmp_path / "network.toml"
    assert measure(chain_csv, "--write", path, "--as", "model").exit_code == 0
    network = section(path)
    assert network.link.impairments[0].loss.transitions == pytest.approx((0.05, 0.5), rel=0.2)  # type: ignore[union-attr]
    assert network.link.longest_delay_s == 0.001
    assert not network.enforce_mansd
    assert measure(RURAL, "--deadline", "100ms", "--write", path, "--as", "model").exit_code == 0
    network = section(path)
    assert [one.kind for one in network.impairments] == ["loss", "delay"]
    assert "outages" in path.read_text()
    scenario = noack.load("lane_following", {"network": network.model_dump(exclude_none=True)})
    assert noack.simulate(noack.with_settings(scenario, {"horizon_s": 1.0}), runs=tmp_path).summary


def test_a_network_without_losses_is_measured(tmp_path: Path) -> None:
    path = tmp_path / "all.csv"
    path.write_text("sent_ms,received_ms\n0,1\n")
    for words in ((), ("--out", tmp_path / "a.html"), ("--write", tmp_path / "a.toml")):
        found = measure(path, "--for-scenario", "lane_following", "--json", *words)
        assert json.loads(found.stdout)["M"] == 1
    path.write_text("sent_ms,received_ms\n0,\n5,\n")
    for words in ((), ("--out", tmp_path / "a.html")):
        found = json.loads(measure(path, "--json", *words).stdout)
        assert (found["lost"], found["M"], found["delay_s"]) == (2, 3, {})


def test_correlation_is_that_of_an_autoregressive_delay() -> None:
    rng, z = np.random.default_rng(1), np.zeros(20_000)
    for k in range(1, len(z)):
        z[k] = 0.8 * z[k - 1] + 0.6 * rng.normal()
    delay_ns = np.exp(15 + z).astype(np.int64)
    known = rng.random(len(z)) > 0.2
    lags, found = autocorrelation(delay_ns, known)
    for lag, one in list(zip(lags, found, strict=True))[:5]:
        assert one == pytest.approx(0.8**lag, abs=0.04)
    scores = normal_scores(np.array([5, 1, 1, 9]))
    assert scores[1] == scores[2] < scores[0] < scores[3]
    sent = 10**8 * np.arange(len(z))
    trace = packet_trace(sent, sent + delay_ns, ~known)
    delays = Measurement(trace).delays
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
    found = Measurement(trace, MeasurementOptions(deadline_s=deadline_s))
    with np.errstate(all="raise", under="ignore"):
        document = found.to_json()
    assert document["effective_losses"] >= int(lost.sum())
    void = found.certificate_time(noack.load("lane_following"))
    assert 0 <= void.share <= 1
    assert all(one.share <= void.share for one in void.causes)
    assert [*measurement_tables(found, void)]
    assert len([*measurement_figures(found)]) == 4


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["missing.csv"], "missing.csv: cannot be read: No such file or directory"),
        ([RURAL, "--deadline", "100"], "--deadline 100: expected a time in s, ms, us or ns"),
        ([RURAL, "--deadline", "0s"], "--deadline 0s: expected a time"),
        ([RURAL, "--outage", "-1s"], "--outage -1s: expected a time"),
        ([RURAL, "--share", "99"], "--share 99: expected a share, e.g. 0.99 or 99%"),
        ([RURAL, "--share", "x%"], "--share x%: expected a share, e.g. 0.99 or 99%"),
        ([RURAL, "--flow", 2], "--flow: has no effect on a packet trace"),
        ([RURAL, "--rate", "20hz"], "--rate: has no effect on a packet trace"),
        ([RURAL, "--silence", "3s"], f"--silence: has no effect on {RURAL}"),
        (["--listen", ":1", "--for", "5s"], "--for: has no effect on a listener"),
        ([":1", "--silence", "5s"], "--silence: has no effect on a sender"),
        ([":1", "--out", "a.html"], "the sender of a one-way probe does not know what arrives"),
        ([":1", "--share", "99%"], "the sender of a one-way probe does not know what arrives"),
        ([RURAL, "--as", "model"], "--as model: is the form of --write; give its FILE.toml"),
        ([RURAL, "--set", "trigger.beta=0.3"], "--set: replaces a value of the scenario of"),
        ([RURAL, "--out", "page.pdf"], "--out page.pdf: the file's name must end in .html"),
        ([RURAL, "--write", "n.json"], "--write n.json: the file's name must end in .toml"),
        ([RURAL, "--for-scenario", "nothing"], "nothing"),
        ([RURAL, "--write", f"{RURAL}/n.toml", "--as", "model"], "n.toml"),
    ],
)
def test_mistakes_are_one_line(words: list[object], message: str) -> None:
    result = measure(*words)
    assert result.exit_code in (1, 2)
    (line,) = result.stderr.strip().splitlines()
    assert message in line
