"""The page's server without a browser: what it computes, whom it answers, its live runs."""

import asyncio
import faulthandler
import gc
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Awaitable, Callable, MutableMapping
from pathlib import Path
from typing import Any, cast
from urllib.parse import urlsplit

import pytest

pytest.importorskip("nicegui", reason="the extra `lab` is not installed")

from cosim.interactive.exploration_figure import CERTIFICATE
from cosim.interactive.scenario_draft import open_draft
from cosim.interactive.scenario_guarantee import Margin
from cosim.lab import lab_server, lab_services, live_run
from cosim.lab.lab_server import AddressGuard, LabOptions
from cosim.lab.lab_services import LabServices, PageCalls, Session
from cosim.lab.live_run import LiveRun
from cosim.lab.recorded_views import live_view
from cosim.record.run_directory import SCENARIO_FILE
from cosim.simulation.virtual_time import simulate
from noack.protocol.record_tables import CONTROLLER_STEP, PLANT_STEP, SENSOR_MEASUREMENT
from noack.runtime.spool import SPOOL, SpoolWriter
from noack.scenario.scenario_file import dumps
from tests.helpers import live_runs as live
from tests.helpers.live_runs import WITHOUT_VIEWER
from tests.helpers.rows_of_loops import mixed_rows
from tests.helpers.shipped import resolved
from tests.helpers.summaries import run_of_one_loop

UNANSWERED = {
    "computes": "while True: pass",
    "stopped": "os.kill(os.getpid(), signal.SIGSTOP)",
    # The pool's thread has begun to read an answer of a million bytes, of which this is all.
    "half an answer": """
    answers = sys._getframe(1).f_locals["result_queue"]._writer
    os.write(answers.fileno(), struct.pack("!i", 1_000_000) + b"x")
    time.sleep(3600)
""",
}


def test_the_services_end_whatever_the_worker_does(tmp_path: Path) -> None:
    """In a program of its own: the interpreter's exit must not wait either."""
    functions = "".join(
        f"""
def unanswered_{number}(begun):
    Path(begun).touch()
    {what}
"""
        for number, what in enumerate(UNANSWERED.values())
    )
    program = tmp_path / "program.py"
    program.write_text(f"""
import asyncio, os, signal, struct, sys, time
from pathlib import Path
from cosim.lab.lab_services import LabServices
{functions}
async def main(services, unanswered):
    begun = Path(unanswered.__name__)
    call = asyncio.create_task(services.compute(unanswered, str(begun)))
    while not begun.exists():
        await asyncio.sleep(0.01)
    await asyncio.sleep(0.1)  # so that the pool's thread reads what there is
    call.cancel()

if __name__ == "__main__":
    for unanswered in (unanswered_0, unanswered_1, unanswered_2):
        with LabServices("lane_following", Path(), Path()) as services:
            asyncio.run(main(services, unanswered))
            services._replace_worker()
""")
    subprocess.run([sys.executable, program], cwd=tmp_path, timeout=live.PATIENCE_S, check=True)


class Inline:
    """Computes in this process."""

    async def compute(self, function: Callable[..., Any], *arguments: Any) -> Any:
        return function(*arguments)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Session]:
    monkeypatch.setattr(lab_services, "explore_ensemble", lambda scenario: None)
    monkeypatch.setattr(lab_services, "margin_of", lambda scenario: Margin("stable", (), True))
    monkeypatch.setattr(lab_services, "_QUIET_S", 0.0)
    monkeypatch.setattr(lab_services, "_MARGIN_S", 0.0)
    return []


def session_of(name: str, drawn: list[Session], calls: object = None, **settings: Any) -> Session:
    draft = open_draft(name)
    for key, value in settings.items():
        draft = draft.with_value(key.replace("__", "."), value)

    async def on_rest() -> None:
        drawn.append(lab_session)
        # What is there is not waited for any more.
        assert not known(lab_session, CERTIFICATE) or "certificate" not in lab_session.pending
        await asyncio.sleep(0)  # as the browser's answer is awaited

    lab_session = Session(cast("PageCalls", calls or Inline()), draft, on_rest, on_rest)
    return lab_session


def known(session: Session, name: str) -> bool:
    return session.results is not None and name in session.results.known


async def settled(lab_session: Session) -> None:
    await lab_session.change(lab_session.draft)
    assert lab_session._rest_task is not None
    await lab_session._rest_task


class Watched(Inline):
    """Notes what the page shows when a computation begins."""

    def __init__(self) -> None:
        self.session: Session | None = None
        self.begun: list[tuple[str, bool]] = []

    async def compute(self, function: Callable[..., Any], *arguments: Any) -> Any:
        assert self.session is not None
        while not self.session.pending.endswith("waiting for the processor"):
            await asyncio.sleep(0)
        self.begun.append((self.session.pending, known(self.session, CERTIFICATE)))
        return await super().compute(function, *arguments)


def test_the_certificate_is_shown_before_the_bands_and_waiting_is_said(
    drawn: list[Session], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lab_services, "_SLOW_S", 0.0)
    calls = Watched()
    lab_session = calls.session = session_of("lane_following", drawn, calls, horizon_s=2.0)
    asyncio.run(settled(lab_session))
    assert calls.begun == [
        ("certificate: waiting for the processor", False),
        ("bands: waiting for the processor", True),
        ("margin: waiting for the processor", True),
    ]
    assert lab_session.pending == ""


def test_of_many_changes_the_newest_is_drawn(drawn: list[Session]) -> None:
    lab_session = session_of("lane_following", drawn, horizon_s=2.0)

    async def drag() -> None:
        values = [0.1 * step for step in range(1, 9)]
        drafts = [lab_session.draft.with_value("trigger.beta", value) for value in values]
        await asyncio.gather(*map(lab_session.change, drafts))

    asyncio.run(drag())
    assert lab_session.results is not None
    assert lab_session.results.run.scenario.trigger.beta == pytest.approx(0.8)
    assert len(drawn) <= 4


def with_services(use: Callable[[LabServices], Awaitable[Any]], folder: Path) -> Any:
    unhandled = list[dict[str, Any]]()

    async def run() -> Any:
        asyncio.get_running_loop().set_exception_handler(lambda _, what: unhandled.append(what))
        with LabServices("lane_following", folder, folder / "runs") as services:
            return await asyncio.wait_for(use(services), live.PATIENCE_S)

    result = asyncio.run(run())
    gc.collect()  # the loop hears of exceptions that nobody asked for when they are removed
    assert unhandled == []
    return result


def test_a_closed_page_gives_up_its_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lab_services, "_GIVE_UP_S", 0.0)
    begun = tmp_path / "begun"

    async def use(services: LabServices) -> int:
        closed, other = PageCalls(services), PageCalls(services)
        given_up = [
            asyncio.create_task(closed.compute(time.sleep, 1e6)),
            asyncio.create_task(closed.compute(begun.touch)),
        ]
        wanted = asyncio.create_task(other.compute(int, "7"))
        while not services._turn.locked():  # the first of them is begun
            await asyncio.sleep(0)
        closed.give_up()
        results = await asyncio.gather(*given_up, return_exceptions=True)
        assert [type(result) for result in results] == [asyncio.CancelledError] * 2
        return await wanted

    assert with_services(use, tmp_path) == 7
    assert not begun.exists()


def test_the_newest_run_that_has_ended_is_known(tmp_path: Path) -> None:
    for name in ("1", "2"):
        (folder := tmp_path / "runs" / name).mkdir(parents=True)
        (folder / "scenario.toml").touch()
    (tmp_path / "runs" / "1" / "summary.json").touch()
    with LabServices("lane_following", tmp_path, tmp_path / "runs") as services:
        assert services.recorded() == ["2", "1"]
        assert [services.has_ended(name) for name in services.recorded()] == [False, True]


def test_a_run_without_a_recorded_measurement_is_not_drawn_yet(tmp_path: Path) -> None:
    """On a busy machine the controller's rows may come first."""
    record = simulate(resolved("double_integrator", "horizon_s=0.1"))
    rows = mixed_rows(run_of_one_loop(record))
    (tmp_path / SCENARIO_FILE).write_text(dumps(record.scenario))
    writer = SpoolWriter(tmp_path / SPOOL, "recorder")
    for table in (CONTROLLER_STEP, PLANT_STEP, SENSOR_MEASUREMENT):
        assert live_view(tmp_path) is None
        writer.append(table, 0, rows[table].tobytes())
    assert live_view(tmp_path) is not None
    writer.close()


def test_mistakes_leave_no_run(drawn: list[Session]) -> None:
    lab_session = session_of("lane_following", drawn)
    asyncio.run(lab_session.change(lab_session.draft.with_text(lab_session.draft.text + "\nbeta = 1\n")))
    assert lab_session.results is None
    assert lab_session.mistakes


SECRET, OPENING = "s" * 43, "o" * 43


def answer(kind: str, path: str, **headers: str) -> list[MutableMapping[str, Any]]:
    """What a request is answered with."""
    sent: list[MutableMapping[str, Any]] = []

    async def inner(scope: Any, receive: Any, send: Any) -> None:
        assert scope["root_path"] == f"/{SECRET}"
        await send({"type": "http.response.start", "status": 200, "headers": []})

    async def receive() -> MutableMapping[str, Any]:
        return {"type": "websocket.connect"}

    async def send(message: MutableMapping[str, Any]) -> None:
        sent.append(message)

    given = [(name.encode(), value.encode()) for name, value in headers.items()]
    scope = {
        "type": kind, "path": path, "headers": given, "query_string": b"a=1",
        "client": ("127.0.0.1", 4711), "server": ("127.0.0.1", 8765),
    }  # fmt: skip
    asyncio.run(AddressGuard(inner, SECRET, OPENING)(scope, receive, send))
    return sent


OWN = f"/{SECRET}/"
HOST = {"host": "127.0.0.1:8765"}


@pytest.mark.parametrize(
    ("kind", "path", "headers", "status"),
    [
        ("http", OWN, HOST, 200),
        ("http", "/", HOST, 404),
        ("http", f"/{SECRET[:-1]}/", HOST, 404),
        ("http", f"/{SECRET}x/", HOST, 404),
        ("http", OWN, {}, 403),
        ("http", OWN, {"host": "evil.example:8765"}, 403),
        ("http", OWN, {"host": "127.0.0.1.evil.example"}, 403),
        ("http", OWN, HOST | {"origin": "http://evil.example"}, 403),
        ("http", OWN, HOST | {"origin": "http://127.0.0.1:9999"}, 403),
        ("http", OWN, HOST | {"origin": "null"}, 403),
        ("websocket", OWN, HOST, None),
        ("websocket", OWN, HOST | {"origin": "http://evil.example"}, None),
    ],
)
def test_only_the_page_itself_is_answered(
    kind: str, path: str, headers: dict[str, str], status: int | None
) -> None:
    first, *_ = answer(kind, path, **headers)
    assert first.get("status") == status
    assert (first["type"] == "websocket.close") == (status is None)
    if status == 200:
        names = {name for name, _ in first["headers"]}
        assert {b"content-security-policy", b"x-frame-options", b"referrer-policy"} <= names


@pytest.mark.parametrize("user", [os.getuid(), os.getuid() + 1, None])
def test_the_address_on_a_command_line_is_for_processes_of_this_user(
    user: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every user can read command lines."""
    asked = []
    monkeypatch.setattr(lab_server, "socket_user", lambda *of: asked.append(of) or user)
    first, _ = answer("http", f"/{OPENING}/", host="127.0.0.1:8765")
    assert asked == [(("127.0.0.1", 4711), ("127.0.0.1", 8765))]
    if user == os.getuid():
        assert first["status"] == 303
        assert dict(first["headers"])[b"location"] == f"/{SECRET}/?a=1".encode()
    else:
        assert first["status"] == 404
        assert SECRET not in str(first)


def test_the_browser_is_started_with_the_address_for_command_lines(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened, announced = list[str](), list[str]()

    def open_page(address: str) -> None:
        opened.append(address)
        raise KeyboardInterrupt

    monkeypatch.setattr(lab_server.webbrowser, "open", open_page)
    options = LabOptions("lane_following", "", tmp_path, tmp_path / "runs", 0, open_browser=True)
    lab_server.serve(options, announced.append)
    faulthandler.cancel_dump_traceback_later()
    (page,), (line) = announced, opened[0]
    assert urlsplit(page).netloc == urlsplit(line).netloc
    assert urlsplit(page).path != urlsplit(line).path


def report_event(run: LiveRun, event: str, **fields: object) -> None:
    run._handle_line(json.dumps({"event": event, **fields}))


REPORT = {
    "t_s": 1.5, "events": 3, "deliveries": 2, "longest_loss_burst": 1, "x_norm": 0.5,
    "live": None, "warnings": [], "changes": [],
}  # fmt: skip


def test_what_a_live_run_reports_sets_its_state_and_its_lines() -> None:
    run = LiveRun(20.0)
    assert run.state == "starting"
    report_event(run, "started", run_dir="/runs/one")
    assert (run.state, run.run_dir) == ("running", Path("/runs/one"))
    live = "live view: http://127.0.0.1:1234/secret/"
    for changes in ([], ["M 3"]):  # each warning is shown once
        report_event(run, "progress", **REPORT | {"warnings": ["void"], "changes": changes, "live": live})
    assert run.lines == ["all processes run", "void", "changed: M 3"]
    assert run.viewer == "http://127.0.0.1:1234/secret/"
    report_event(run, "finalising", reason="horizon")
    assert run.state == "finalising"
    assert not run.is_over
    lines = [["completed 20 s", "good"], ["3 transmissions, 2 delivered", ""]]
    report_event(run, "ended", run_dir="/runs/one", reason="horizon", ok=True, verdict=lines)
    assert run.is_over
    assert run.ok
    assert run.progress is not None
    assert run.progress.events == 3
    assert run.verdict == [("completed 20 s", "good"), ("3 transmissions, 2 delivered", "")]
    failed = LiveRun(20.0)
    report_event(failed, "error", text="the port is taken")
    assert failed.is_over
    assert failed.ok is False
    assert failed.lines == ["the port is taken"]


@pytest.mark.parametrize("line", ["", "compiling ...", "{", "[1]", '{"x": 1}', "7"])
def test_other_output_is_a_line_of_the_log(line: str) -> None:
    run = LiveRun(20.0)
    run._handle_line(line)
    assert run.lines == [line] * bool(line)
    assert run.state == "starting"


def test_a_run_writes_nothing_beside_the_scenario_and_reads_the_files_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another user may replace what is written there, or place links before."""
    folder, private = tmp_path / "shared", tmp_path / "private"
    folder.mkdir()
    private.write_text("precious")
    draft = open_draft("saturated_lqr").with_value("horizon_s", 0.5)
    shutil.copy(draft.folder / "saturated_lqr.py", folder)
    (folder / f".lab-{os.getpid()}.toml").symlink_to(private)
    monkeypatch.setenv("PYTHONPATH", WITHOUT_VIEWER["PYTHONPATH"])
    before = folder.stat().st_mtime_ns  # changes if a file is made, renamed or removed

    async def run() -> LiveRun:
        live = LiveRun(0.5)
        await live.start(draft.text, folder, tmp_path / "runs")
        await live.follow()
        return live

    live = asyncio.run(run())
    assert live.state == "ended", live.lines
    assert folder.stat().st_mtime_ns == before
    assert private.read_text() == "precious"


STUBBORN = """
import signal, sys
signal.signal(signal.SIGINT, signal.SIG_IGN)
print("ready", flush=True)
sys.stdin.read()
"""


@pytest.mark.parametrize(("state", "status"), [("running", -signal.SIGKILL), ("finalising", 0)])
def test_a_loop_that_does_not_end_is_killed_but_not_its_check(
    state: str, status: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_run, "_STOP_S", 0.0)

    async def end() -> int | None:
        run = LiveRun(20.0)
        run._process = process = await asyncio.create_subprocess_exec(
            sys.executable, "-c", STUBBORN, stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
        )  # fmt: skip
        assert process.stdin is not None
        assert process.stdout is not None
        await process.stdout.readline()
        run.state = state
        if state == "finalising":
            asyncio.get_running_loop().call_later(0.2, process.stdin.close)
        await run.end()
        return process.returncode

    assert asyncio.run(end()) == status
