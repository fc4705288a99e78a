"""How a process finds the run that it joins, and what it says meanwhile."""

import signal
from pathlib import Path

import pytest

from noack.core.errors import PeerError
from noack.runtime import join_run
from noack.runtime.command_line import END_SIGNALS, Signals
from noack.runtime.join_run import _find_descriptor, _wait_for_credentials


@pytest.fixture
def signals(monkeypatch: pytest.MonkeyPatch) -> Signals:
    """A signal has come already: the wait ends at once."""
    monkeypatch.setattr(join_run, "find_descriptor", lambda session: None)
    signals = Signals()
    signals.received = signal.SIGINT
    return signals


def test_a_process_says_what_it_waits_for_and_how_to_join_another_host(
    signals: Signals, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(PeerError, match="no run to join in session 'two'"):
        _find_descriptor("plant", "two", signals)
    assert capsys.readouterr().err == (
        "noack plant: waiting for `noack record SCENARIO` on this host (session 'two'); to join a run on "
        "another host, use --credentials; Ctrl-C ends the wait\n"
    )


def test_a_missing_folder_of_credentials_is_named(
    signals: Signals, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    folder = tmp_path / "sensor"
    with pytest.raises(PeerError, match=f"{folder}: there is no such folder"):
        _wait_for_credentials("sensor", folder, tmp_path, signals)
    assert capsys.readouterr().err == f"noack sensor: waiting for {folder}; Ctrl-C ends the wait\n"


def test_every_signal_that_ends_a_program_ends_the_recorder_at_once() -> None:
    """After SIGHUP it waited 8 s for the other processes."""
    assert {*END_SIGNALS} >= {"SIGINT", "SIGTERM", "SIGHUP"}
