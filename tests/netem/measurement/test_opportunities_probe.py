"""The simulated probe through delivery opportunities loses nothing, however long the file is."""

from pathlib import Path

from netem.measurement.trace_sources import read_opportunities


def test_a_long_probe_loses_nothing(tmp_path: Path) -> None:
    path = tmp_path / "link.trace"
    path.write_text("".join(f"{time_ms}\n" for time_ms in range(1, 20_001)))
    trace = read_opportunities(path, 1_000_000)
    assert len(trace) == 20_000
    assert not trace.lost.any()
