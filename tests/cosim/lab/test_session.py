"""What one page computes: the newest settings are drawn, and what takes longer follows."""

import asyncio
import gc
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any, cast

import pytest

from cosim.interactive.draft import open_draft
from cosim.interactive.exploration_figure import CERTIFICATE
from cosim.interactive.scenario_guarantee import Margin
from cosim.lab import lab_services
from cosim.lab.lab_services import LabServices, PageCalls, Session
from tests.integration import conftest as live


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

    async def on_drawn() -> None:
        drawn.append(found)
        # What is there is not waited for any more.
        assert not known(found, CERTIFICATE) or "certificate" not in found.pending
        await asyncio.sleep(0)  # as the browser's answer is awaited

    found = Session(cast("PageCalls", calls or Inline()), draft, on_drawn)
    return found


def known(session: Session, name: str) -> bool:
    return session.results is not None and name in session.results.known


async def settled(found: Session) -> None:
    await found.change(found.draft)
    assert found._later is not None
    await found._later


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
    found = calls.session = session_of("lane_following", drawn, calls, horizon_s=2.0)
    asyncio.run(settled(found))
    assert calls.begun == [
        ("certificate: waiting for the processor", False),
        ("bands: waiting for the processor", True),
        ("margin: waiting for the processor", True),
    ]
    assert found.pending == ""


def test_of_many_changes_the_newest_is_drawn(drawn: list[Session]) -> None:
    found = session_of("lane_following", drawn, horizon_s=2.0)

    async def drag() -> None:
        values = [0.1 * step for step in range(1, 9)]
        drafts = [found.draft.with_value("trigger.beta", value) for value in values]
        await asyncio.gather(*map(found.change, drafts))

    asyncio.run(drag())
    assert found.results is not None
    assert found.results.run.scenario.trigger.beta == pytest.approx(0.8)
    assert len(drawn) <= 4


def with_services(use: Callable[[LabServices], Awaitable[Any]], folder: Path) -> Any:
    unhandled = list[dict[str, Any]]()

    async def run() -> Any:
        asyncio.get_running_loop().set_exception_handler(lambda _, what: unhandled.append(what))
        with LabServices("lane_following", folder, folder / "runs") as services:
            return await asyncio.wait_for(use(services), live.PATIENCE_S)

    found = asyncio.run(run())
    gc.collect()  # the loop hears of exceptions that nobody asked for when they are removed
    assert unhandled == []
    return found


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
        found = await asyncio.gather(*given_up, return_exceptions=True)
        assert [type(one) for one in found] == [asyncio.CancelledError] * 2
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


def test_mistakes_leave_no_run(drawn: list[Session]) -> None:
    found = session_of("lane_following", drawn)
    asyncio.run(found.change(found.draft.with_text(found.draft.text + "\nbeta = 1\n")))
    assert found.results is None
    assert found.mistakes
