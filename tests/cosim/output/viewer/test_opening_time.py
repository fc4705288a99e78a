"""The view of a finished run opens at the largest ‖e_c‖; without a summary, at rerun's default."""

import json
import re
import subprocess
import urllib.request
from pathlib import Path
from typing import Any

import pytest
import rerun.experimental

from cosim.output.viewer.live_viewer import (
    RecordingServer,
    move_window_to,
    opening_time_ns,
    script_to_open_at,
)
from cosim.shipped_files import find_shipped
from cosim.simulation.virtual_time import simulate
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load
from tests.cosim.summaries import summary_of

T_NS = 4_244_000_000


def summary_at(at_s: float | None) -> str:
    scenario = resolve(load(find_shipped("double_integrator", "scenarios"), ["horizon_s=0.1"]))
    return summary_of(simulate(scenario), sup_e_c_at_s=at_s).model_dump_json()


def test_the_page_sets_the_viewers_time_and_pauses_it() -> None:
    """The request is a ``SetTimeCursor`` (6): timeline (2), time (3), paused (5)."""
    found = re.search(rb"Uint8Array\((\[[^]]*\])\)", script_to_open_at(T_NS))
    assert found is not None
    timeline, time = b"\x0a\x01t", b"\x08" + bytes.fromhex("809ad9e70f")
    cursor = b"\x12\x03" + timeline + b"\x1a\x06" + time + b"\x28\x01"
    assert bytes(json.loads(found[1])) == b"\x32\x0f" + cursor


@pytest.mark.parametrize(
    ("summary", "expected"),
    [
        (4.244, T_NS), (None, None), ("{}", None),
        ("[]", None), ("{", None),
    ],
)  # fmt: skip
def test_the_opening_time_is_taken_from_the_summary(
    tmp_path: Path, summary: str | float | None, expected: int | None
) -> None:
    text = summary if isinstance(summary, str) else summary_at(summary)
    (tmp_path / "summary.json").write_text(text)
    assert opening_time_ns(tmp_path / "recording.rrd") == expected


def test_only_the_page_of_a_finished_run_moves_the_cursor(tmp_path: Path) -> None:
    path = tmp_path / "recording.rrd"
    path.write_bytes(b"RRF2")
    with RecordingServer(path, follow=False) as server:
        page = server.start_page()
        script = page + "re_viewer.js"
        assert b"openAt" not in read(page)
        (tmp_path / "summary.json").write_text(summary_at(4.244))
        assert read(page).endswith(script_to_open_at(T_NS))
        assert b"openAt" not in read(script)


def read(url: str) -> bytes:
    with urllib.request.urlopen(url, timeout=30) as answer:
        content: bytes = answer.read()
        return content


def test_the_time_is_sent_until_the_window_has_the_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str, Any]] = []

    class Client:
        @classmethod
        def connect(cls, url: str) -> "Client":
            asked.append(("connect", url))
            if len(asked) == 1:
                raise ConnectionError("transport error")
            return cls()

        def set_time(self, timeline: str, **more: Any) -> None:
            asked.append((timeline, more))
            if len(asked) == 3:
                raise ConnectionError("no active recording to set the time for")

    monkeypatch.setattr(rerun.experimental, "ViewerClient", Client)
    log = tmp_path / "log"
    log.write_bytes(
        b"Listening. Connect by running `rerun --connect rerun+http://127.0.0.1:1234/proxy`"
    )
    with subprocess.Popen(["sleep", "600"]) as window:
        move_window_to(T_NS, window, log.open("rb"))
        window.kill()
    wanted = ("t", {"duration": 4.244, "play_state": "paused"})
    connected = ("connect", "rerun+http://127.0.0.1:1234/proxy")
    assert asked == [connected, connected, wanted, connected, wanted]
    move_window_to(T_NS, window, log.open("rb"))  # closed: no further request
    assert len(asked) == 5
