"""A recording in a viewer: live, in a window or a browser, at the time of the largest error."""

import contextlib
import http.client
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urljoin, urlsplit

import psutil
import pytest
import rerun.chunk
import rerun.experimental

from cosim.output.viewer.pictures.picture import TIMELINE
from cosim.output.viewer.recording_viewer import RECORDING, LiveView
from cosim.output.viewer.rerun_program import move_window_to
from netem.core.errors import ExitStatus
from tests.cosim.output.viewer.recordings import add_samples, another_process, new_view
from tests.helpers.live_runs import noack_command
from tests.helpers.waiting import is_left, wait_for

pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif(not hasattr(os, "killpg"), reason="tells by process groups what is left behind"),
]


def get(url: str, host: str | None = None) -> tuple[int, bytes]:
    parts = urlsplit(url)
    connection = http.client.HTTPConnection(str(parts.hostname), parts.port)
    with contextlib.closing(connection):
        target = f"{parts.path}?{parts.query}" if parts.query else parts.path
        connection.request("GET", target, headers={"Host": host or parts.netloc})
        answer = connection.getresponse()
        if (location := answer.getheader("Location")) is not None:
            return get(urljoin(url, location))
        return answer.status, answer.read()


@pytest.fixture
def live() -> Iterator[LiveView]:
    view = LiveView(native=False)
    yield view
    view.close()


def test_a_live_viewer_receives_the_growing_file_to_its_end(tmp_path: Path, live: LiveView) -> None:
    path = tmp_path / "recording.rrd"
    view = new_view(path, live=live)
    assert live.url is not None
    assert live.url in live.status
    status, page = get(live.url)
    assert status == 200
    assert b"Rerun" in page
    parts = urlsplit(live.url + RECORDING)
    connection = http.client.HTTPConnection(str(parts.hostname), parts.port)
    with contextlib.closing(connection):
        connection.request("GET", parts.path)
        answer = connection.getresponse()
        received = answer.read(4)
        assert received == b"RRF2"
        size = path.stat().st_size
        add_samples(view, 5)
        while len(received) <= size:  # what was written after the download began
            received += answer.read(1)
        view.close()
        received += answer.read()
    assert received == path.read_bytes()
    live.close(keep=True)  # serves until it is ended
    assert get(live.url + RECORDING) == (200, path.read_bytes())
    assert live.pid is not None
    group = live.pid
    os.kill(group, signal.SIGTERM)
    live.close()
    assert not is_left(group)


def test_a_live_view_ends_when_the_recorder_is_killed(tmp_path: Path) -> None:
    path = tmp_path / "recording.rrd"
    path.write_bytes(b"RRF2")
    code = (
        "import time; from cosim.output.viewer.recording_viewer import LiveView;"
        "live = LiveView(native=False); live.show(path);"
        "print(live.pid, flush=True); time.sleep(1000)"
    )
    with another_process(code, path) as child:
        assert child.stdout is not None
        group = int(child.stdout.readline())
        assert is_left(group)
    wait_for(lambda: not is_left(group))


WINDOW = """#!{python}
import os, sys, time
if "--serve-web" in sys.argv:
    os.execv({viewer!r}, [{viewer!r}, *sys.argv[1:]])
print("Connect by running `rerun --connect rerun+http://127.0.0.1:1/proxy`", flush=True)
if {opens}:
    received = sys.stdin.buffer.read()
    with open({seen!r}, "wb") as seen:
        seen.write(received)
    time.sleep(2)
sys.exit({status})
"""


def pretend_window(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, opens: bool) -> Path:
    """Replace rerun's program by one that opens no window; its web server is rerun's."""
    folder = Path(str(__import__("rerun_cli").__file__)).parent
    program, seen = tmp_path / "viewer", tmp_path / "seen.rrd"
    values = {"python": sys.executable, "viewer": str(folder / "rerun"), "seen": str(seen)}
    program.write_text(WINDOW.format(**values, opens=opens, status=int(not opens)))
    program.chmod(0o755)
    monkeypatch.setenv("RERUN_CLI_PATH", str(program))
    return seen


@pytest.mark.parametrize("opens", [True, False])
def test_a_window_or_a_browser_is_served_the_whole_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, opens: bool
) -> None:
    seen = pretend_window(tmp_path, monkeypatch, opens=opens)
    path = tmp_path / "recording.rrd"
    live = LiveView(native=True)
    with new_view(path, live=live) as view:
        add_samples(view, 5)
        assert (live.url is None) == opens
        assert (live.status == "live view: in a window") == opens
    assert live.url is None or get(live.url)[0] == 200
    live.close()
    wait_for(lambda: not opens or (seen.exists() and seen.read_bytes() == path.read_bytes()))


def listening(viewer: "subprocess.Popen[str]") -> list[str]:
    """Where a viewer listens: one port is for the page and the recording, one for rerun's files."""
    process = psutil.Process(viewer.pid)
    return [
        address.laddr.ip
        for member in (process, *process.children())
        for address in member.net_connections("inet")
        if address.status == psutil.CONN_LISTEN
    ]


@pytest.mark.parametrize(
    ("sent", "status", "words"),
    [
        (signal.SIGINT, 0, ()),
        (signal.SIGHUP, ExitStatus.TERMINATED, ("--web",)),
        pytest.param(
            signal.SIGKILL, -signal.SIGKILL, (),
            marks=pytest.mark.skipif(sys.platform != "linux", reason="tells no child elsewhere"),
        ),
    ],
)  # fmt: skip
def test_the_command_serves_a_page_on_the_loopback_until_it_is_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sent: int, status: int, words: tuple[str, ...]
) -> None:
    """Without a display, or if no window is wanted."""
    pretend_window(tmp_path, monkeypatch, opens=True)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    if words:
        monkeypatch.setenv("DISPLAY", ":0")
    path = tmp_path / "recording.rrd"
    new_view(path).close()
    with subprocess.Popen(
        noack_command("view", str(path), *words),
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    ) as child:  # fmt: skip
        assert child.stdout is not None
        page = next(word for word in child.stdout.readline().split() if word.startswith("http"))
        assert get(page)[0] == 200
        assert get(page + RECORDING) == (200, path.read_bytes())
        assert listening(child) == ["127.0.0.1"] * 2
        child.send_signal(sent)
        assert child.wait() == status
        wait_for(lambda: not is_left(child.pid))


T_NS = 4_244_000_000


def test_the_time_is_sent_until_the_window_has_the_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    requests: list[tuple[str, Any]] = []

    class Client:
        @classmethod
        def connect(cls, url: str) -> "Client":
            requests.append(("connect", url))
            if len(requests) == 1:
                raise ConnectionError("transport error")
            return cls()

        def set_time(self, timeline: str, **more: Any) -> None:
            requests.append((timeline, more))
            if len(requests) == 3:
                raise ConnectionError("no active recording to set the time for")

    monkeypatch.setattr(rerun.experimental, "ViewerClient", Client)
    log, address = tmp_path / "log", "rerun+http://127.0.0.1:1234/proxy"
    log.write_text(f"Listening. Connect by running `rerun --connect {address}`")
    with subprocess.Popen(["sleep", "600"]) as window:
        move_window_to(TIMELINE, T_NS, window, log.open("rb"))
        window.kill()
    wanted = ("t", {"duration": 4.244, "play_state": "paused"})
    connected = ("connect", address)
    assert requests == [connected, connected, wanted, connected, wanted]
    move_window_to(TIMELINE, T_NS, window, log.open("rb"))  # closed: no further request
    assert len(requests) == 5
