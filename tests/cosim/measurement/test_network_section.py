"""A written network, measured again: a trace packet by packet, a model by its parameters."""

from pathlib import Path

import numpy as np
import pytest

import noack
from cosim.measurement.network_section import trace_csv
from netem.core import toml_file
from netem.impairments.target_loss import read_files
from netem.measurement.chain_fits import ChainRates
from netem.measurement.loss_bursts import histogram
from netem.traces.packet_trace import LOST_NS, PacketTrace, packet_trace
from noack.scenario.sections import NetworkSection
from tests.helpers.command_line import invoke
from tests.netem.measurement.chains import PERIOD_NS, chain_losses, trace_of
from tests.netem.stepped_link import Link


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


@pytest.mark.usefixtures("no_searches")
def test_a_scenario_takes_the_network_of_a_file(tmp_path: Path) -> None:
    """The trace is beside that file, whatever the folder of the scenario is."""
    (folder := tmp_path / "measured").mkdir()
    lost = np.random.default_rng(1).random(400) < 0.2
    sent_ns = PERIOD_NS * np.arange(400)
    (folder / "trace.csv").write_text(trace_csv(packet_trace(sent_ns, sent_ns + 1_000_000, lost)))
    path = folder / "network.toml"
    noack.measure(folder / "trace.csv").write_network(path)
    loaded = noack.load("lane_periodic", network=path)
    assert noack.load(noack.load("lane_periodic"), network=path).network == loaded.network
    checked = invoke("check", "lane_periodic", "--network", str(path), "--set", "network.mansd=1")
    assert checked.stdout.count("\nmansd = 1\n") == 1
    new = tmp_path / "new.toml"
    assert invoke("new", "cart_pole", "--out", str(new), "--network", str(path)).exit_code == 0
    assert 'file = "measured/network.csv"' in new.read_text()
    assert noack.load(new).network == loaded.network
