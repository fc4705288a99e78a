"""``noack measure``: the same numbers in JSON, tables and page, a written model, no losses."""

import json
import struct
from pathlib import Path

import pytest
from click.testing import Result

import noack
from cosim.measurement.network_section import trace_csv
from netem.core import toml_file
from netem.measurement.chain_fits import ChainRates
from netem.presets.preset import load_preset
from netem.tc_words import settings_of
from noack.scenario.sections import NetworkSection
from tests.helpers.command_line import invoke
from tests.netem.measurement.chains import chain_losses, trace_of
from tests.oracles.capture_files import Sent, pcap_of

RURAL = Path(__file__).parents[3] / "netem/traces/shipped/cicv5g" / "rural_n8_10kmh.csv"
TRACES = Path(__file__).parents[2] / "netem/traces"
IRTT = Path(__file__).parents[2] / "netem/traces" / "irtt.json"


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
    words = (RURAL, "--deadline", "100ms", "--for", "lane_following", "--window", 20)
    document = json.loads(measure(*words, "--json", "--out", page).stdout)
    assert (document["packets"], document["late"], document["mansd"]) == (2178, 616, 48)
    assert document["windows"] == {"20": {"most_losses": 20, "without_outages": 20}}
    assert sum(int(n) * count for n, count in document["histogram"].items()) == 616
    assert document["certificate"]["share"] == pytest.approx(0.57, abs=0.01)
    assert document["written"] == [str(page)]
    html = page.read_text()
    assert html.count("<svg") + html.count("<img") == 8  # for wide and narrow screens
    result = measure(RURAL, "--deadline", "100ms")
    assert result.exit_code == 0
    for text in ("616 (28.3 %)", "175 packets, 10.9 s, from 81.312 s"):
        assert text in html
        assert text in " ".join(result.output.split())


def test_a_document_of_irtt_is_measured_as_irtt_counts_it() -> None:
    """The file is the output of `irtt client -i 20ms -d 800ms -l 100 -o FILE`, irtt 0.9.0."""
    own = json.loads(IRTT.read_text())["stats"]
    document = json.loads(measure(IRTT, "--json").stdout)
    assert document["packets"] == own["packets_sent"]
    assert document["lost"] == own["packets_sent"] - own["packets_received"]
    up, down = (own["packets_sent"] - own["server_packets_received"],
                own["server_packets_received"] - own["packets_received"])  # fmt: skip
    text = measure(IRTT).output
    assert f"lost forward: {up}" in text
    assert f"lost in reverse: {down}" in text
    # irtt subtracts the time that its server takes for a packet, some 10 µs.
    assert document["delay_s"]["0.5"] == pytest.approx(own["rtt"]["median"] * 1e-9, abs=100e-6)


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
        document = measure(path, "--for", "lane_following", "--json", *words)
        assert json.loads(document.stdout)["mansd"] == 0
    path.write_text("sent_ms,received_ms\n0,\n5,\n")
    for words in ((), ("--out", tmp_path / "a.html")):
        document = json.loads(measure(path, "--json", *words).stdout)
        assert (document["lost"], document["mansd"], document["delay_s"]) == (2, 2, {})


def test_the_chance_of_a_long_burst_is_that_of_the_fitted_chain(chain_csv: Path) -> None:
    document = json.loads(measure(chain_csv, "--within", "500", "--json").stdout)
    lengths = {int(length): count for length, count in document["histogram"].items()}
    losses = sum(length * count for length, count in lengths.items())
    assert document["mean_burst"] == pytest.approx(losses / sum(lengths.values()))
    predicted = document["bursts_by_preferred_model"]
    assert predicted["packets"] == 500
    assert predicted["mean_burst"] == pytest.approx(document["mean_burst"], rel=0.01)
    # By counting, from the fitted chain: losses are the bad state, which the trace begins in by its share.
    assert document["chosen_model"] == "gilbert"
    p, r = (
        document["models"]["gilbert"]["estimates"][name]["value"] for name in ("good_to_bad", "bad_to_good")
    )
    for cap in (2, 5):
        run = [r / (p + r), p / (p + r)] + [0.0] * (cap - 1)
        for _ in range(499):
            run = [run[0] * (1 - p) + sum(run[1:]) * r, run[0] * p, *(mass * (1 - r) for mass in run[1:-1])]
        assert predicted["chance_of_longer"][str(cap)] == pytest.approx(1 - sum(run), abs=1e-6)
    # A time is one of packets at the trace's mean rate.
    period_s = document["observed_s"] / (document["packets"] - 1)
    of_time = json.loads(measure(chain_csv, "--within", f"{500 * period_s:.6f}s", "--json").stdout)
    assert of_time["bursts_by_preferred_model"] == predicted


def test_availability_is_printed_for_a_transfer_interval_and_a_survival_time() -> None:
    words = ("urban_n78_40kmh", "--deadline", "100ms", "--survival", "120ms")
    document = json.loads(measure(*words, "--json").stdout)["availability"]
    assert (document["losses_survived"], document["messages"], document["failures"]) == (2, 3174, 2)
    assert document["availability"]["low"] < document["availability"]["value"] < 1
    assert 0.998 < document["by_preferred_model"]["availability"] < 1
    text = " ".join(measure(*words).output.split())
    assert "99.906 %" in text
    assert "mean time between failures" in text
    thinned = (
        "urban_n78_40kmh",
        "--deadline",
        "100ms",
        "--interval",
        "180ms",
        "--survival",
        "180ms",
        "--json",
    )
    document = json.loads(measure(*thinned).stdout)["availability"]
    assert (document["transfer_interval_s"], document["losses_survived"]) == (0.18, 1)
    assert document["messages"] == pytest.approx(189.3 / 0.18, abs=3)
    assert json.loads(measure("urban_n78_40kmh", "--json").stdout)["availability"] is None
    refused = measure("urban_n78_40kmh", "--interval", "10ms", "--survival", "30ms")
    assert refused.exit_code == 2
    assert "shorter than the time between two packets of the trace" in refused.output


def test_a_measured_preset_is_a_network_of_the_emulator(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, chain_csv: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    document = json.loads(measure(chain_csv, "--preset", "office", "--json").stdout)
    assert document["written"] == ["office.toml"]
    preset = load_preset(Path("office.toml"))
    assert preset.source is not None
    assert preset.source.title == str(chain_csv)
    chain, delay = settings_of("like ./office.toml").impairments
    assert chain.loss.transitions == pytest.approx((0.05, 0.5), rel=0.2)  # type: ignore[union-attr]
    assert delay.delay_s == 0.001  # type: ignore[union-attr]
    explained = invoke("netem", "--explain", "like", "./office.toml", "mansd", "4")
    assert explained.exit_code == 0
    assert "like office: Measured:" in " ".join(explained.output.split())
    # A shipped preset is what the command writes, but for its name and its texts.
    (tmp_path / "presets").mkdir()
    assert measure(RURAL, "--deadline", "100ms", "--preset", "presets/mine.toml").exit_code == 0
    shipped = settings_of("like 5g-rural")
    assert settings_of("like presets/mine.toml") == shipped
    refused = measure(RURAL, "--preset", "my office")
    assert (refused.exit_code, "--preset my office: a preset's name has letters" in refused.output) == (
        2,
        True,
    )
    Path("none.csv").write_text("sent_ms,received_ms\n0,0\n5,5\n")
    nothing = measure("none.csv", "--preset", "none")
    assert "neither losses nor delays" in nothing.output


def test_a_report_of_iperf3_says_what_its_intervals_say() -> None:
    text = " ".join(measure(TRACES / "iperf3_receiver.json").output.split())
    assert "3.0 % lost, at least 1 in a row" in text
    assert "iperf3 counts losses per interval, not per packet" in text
    document = json.loads(measure(TRACES / "iperf3_sender.json", "--json").stdout)
    assert [stream["stream"] for stream in document["streams"]] == [2, 1]  # the worst first
    refused = measure(TRACES / "iperf3_receiver.json", "--survival", "1s")
    assert refused.exit_code == 2
    assert "--survival: needs packets; iperf3 counts per interval" in refused.output


def test_a_log_of_ping_is_measured_and_flows_are_compared(tmp_path: Path) -> None:
    document = json.loads(measure(TRACES / "ping.txt", "--json").stdout)
    assert (document["packets"], document["lost"], document["longest"]["losses"]) == (40, 11, 4)
    log = tmp_path / "fping.txt"
    log.write_text(
        "a.example : [0], 64 bytes, 1.00 ms (1.00 avg, 0% loss)\n"
        "b.example : [0], timed out (NaN avg, 100% loss)\n"
        "a.example : [1], 64 bytes, 1.10 ms (1.05 avg, 0% loss)\n"
        "b.example : [1], 64 bytes, 9.00 ms (9.00 avg, 50% loss)\n"
    )
    document = json.loads(measure(log, "--flows", "--json").stdout)
    assert [(flow["flow"], flow["name"], flow["loss_rate"]) for flow in document["flows"]] == [
        (2, "b.example", 0.5),
        (1, "a.example", 0.0),
    ]
    text = " ".join(measure(log, "--flows").output.split())
    assert "flow 2 is the worst of 2: 50.0 % lost" in text
    for words in (("--flow", "2"), ("--write", tmp_path / "n.toml"), ("--preset", "x")):
        assert measure(log, "--flows", *words).exit_code == 2
    assert "other sources have one flow" in measure("urban_n78_40kmh", "--flows").output


def test_all_flows_of_a_capture_are_rows_and_the_worst_is_the_first(tmp_path: Path) -> None:
    """Three senders with numbers at one receiver; the second loses every third, the third every tenth."""
    capture, packets = tmp_path / "receiver.pcap", []
    for port, lost_of in ((5001, 0), (5002, 3), (5003, 10)):
        for k in range(300):
            if not lost_of or k % lost_of != 1:
                at_ns = 1_700_000_000 * 10**9 + k * 20_000_000 + port
                packets.append(Sent(at_ns, struct.pack(">HQ", k, port))._replace(source_port=port))
    capture.write_bytes(pcap_of(*sorted(packets)))
    document = json.loads(measure(capture, "--sequence-at", "0:2", "--flows", "--json").stdout)
    assert [flow["effective_losses"] for flow in document["flows"]] == [100, 30, 0]
    assert [flow["flow"] for flow in document["flows"]] == [3, 2, 1]  # numbered by their packets
    # The same numbers as those of the flow alone.
    alone = json.loads(measure(capture, "--sequence-at", "0:2", "--flow", "3", "--json").stdout)
    assert (alone["effective_losses"], alone["mansd"]) == (100, document["flows"][0]["mansd"])
    refused = measure(capture, "--flows")
    assert refused.exit_code == 2
    assert "no flow can be measured; flow 1: has one end only" in refused.output
