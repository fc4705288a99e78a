"""What the page computes: in a worker that may hang, the newest change first, in a fixed order."""

import asyncio
import gc
import subprocess
import sys
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any, cast

import pytest

pytest.importorskip("nicegui", reason="the extra `lab` is not installed")

from cosim.interactive.draft_results import CERTIFICATE
from cosim.interactive.scenario_draft import open_draft
from cosim.interactive.scenario_guarantee import Margin
from cosim.lab import lab_services
from cosim.lab.lab_services import LabServices, PageCalls, Session
from tests.helpers.waiting import PATIENCE_S

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
def unanswered_{number}(begin_file):
    Path(begin_file).touch()
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
    begin_file = Path(unanswered.__name__)
    call = asyncio.create_task(services.compute(unanswered, str(begin_file)))
    while not begin_file.exists():
        await asyncio.sleep(0.01)
    await asyncio.sleep(0.1)  # so that the pool's thread reads what there is
    call.cancel()

if __name__ == "__main__":
    for unanswered in (unanswered_0, unanswered_1, unanswered_2):
        with LabServices("lane_following", Path(), Path()) as services:
            asyncio.run(main(services, unanswered))
            services._replace_worker()
""")
    subprocess.run([sys.executable, program], cwd=tmp_path, timeout=PATIENCE_S, check=True)


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
        self.shown: list[tuple[str, bool]] = []

    async def compute(self, function: Callable[..., Any], *arguments: Any) -> Any:
        assert self.session is not None
        while not self.session.pending.endswith("waiting for the processor"):
            await asyncio.sleep(0)
        self.shown.append((self.session.pending, known(self.session, CERTIFICATE)))
        return await super().compute(function, *arguments)


def test_the_certificate_is_shown_before_the_bands_and_waiting_is_said(
    drawn: list[Session], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lab_services, "_SLOW_S", 0.0)
    calls = Watched()
    lab_session = calls.session = session_of("lane_following", drawn, calls, horizon_s=2.0)
    asyncio.run(settled(lab_session))
    assert calls.shown == [
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
            return await asyncio.wait_for(use(services), PATIENCE_S)

    result = asyncio.run(run())
    gc.collect()  # the loop hears of exceptions that nobody asked for when they are removed
    assert unhandled == []
    return result


def test_a_closed_page_gives_up_its_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lab_services, "_GIVE_UP_S", 0.0)
    marker = tmp_path / "marker"

    async def use(services: LabServices) -> int:
        closed, other = PageCalls(services), PageCalls(services)
        given_up = [
            asyncio.create_task(closed.compute(time.sleep, 1e6)),
            asyncio.create_task(closed.compute(marker.touch)),
        ]
        wanted = asyncio.create_task(other.compute(int, "7"))
        while not services._turn.locked():  # the first of them is begun
            await asyncio.sleep(0)
        closed.give_up()
        results = await asyncio.gather(*given_up, return_exceptions=True)
        assert [type(result) for result in results] == [asyncio.CancelledError] * 2
        return await wanted

    assert with_services(use, tmp_path) == 7
    assert not marker.exists()


def test_the_newest_run_that_has_ended_is_known(tmp_path: Path) -> None:
    for name in ("1", "2"):
        (folder := tmp_path / "runs" / name).mkdir(parents=True)
        (folder / "scenario.toml").touch()
    (tmp_path / "runs" / "1" / "summary.json").touch()
    with LabServices("lane_following", tmp_path, tmp_path / "runs") as services:
        assert services.recorded() == ["2", "1"]
        assert [services.has_ended(name) for name in services.recorded()] == [False, True]


def test_mistakes_leave_no_run(drawn: list[Session]) -> None:
    lab_session = session_of("lane_following", drawn)
    asyncio.run(lab_session.change(lab_session.draft.with_text(lab_session.draft.text + "\nbeta = 1\n")))
    assert lab_session.results is None
    assert lab_session.mistakes
