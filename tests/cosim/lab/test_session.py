"""What one page computes: the newest settings are drawn, and what takes longer follows."""

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import pytest

from cosim.interactive.draft import open_draft
from cosim.interactive.exploration_figure import CERTIFICATE
from cosim.interactive.scenario_guarantee import VOID, Margin
from cosim.lab import lab_services as under_test
from cosim.lab.lab_services import PageCalls, Session


class Inline:
    """Computes in this process."""

    async def compute(self, function: Callable[..., Any], *arguments: Any) -> Any:
        return function(*arguments)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Session]:
    monkeypatch.setattr(under_test, "explore_ensemble", lambda scenario: None)
    monkeypatch.setattr(under_test, "margin_of", lambda scenario: Margin("stable", (), True))
    monkeypatch.setattr(under_test, "_QUIET_S", 0.0)
    monkeypatch.setattr(under_test, "_MARGIN_S", 0.0)
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
    monkeypatch.setattr(under_test, "_SLOW_S", 0.0)
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


def test_mistakes_leave_no_run(drawn: list[Session]) -> None:
    found = session_of("lane_following", drawn)
    found.draft = found.draft.with_text(found.draft.text + "\nbeta = 1\n")
    asyncio.run(found.change(found.draft))
    assert found.results is None
    assert found.mistakes


def test_a_loop_that_grows_is_explained(drawn: list[Session], tmp_path: Path) -> None:
    found = session_of(
        "unstable_pendulum", drawn, mode="zoh", network__mansd=10,
        network__loss={"model": "worst_case"}, trigger={"policy": "periodic", "period_s": 0.1},
    )  # fmt: skip
    asyncio.run(settled(found))
    assert found.results is not None
    assert found.results.certificate.verdict == VOID
    assert "it diverged at" in found.results.warning
    assert found.results.certificate.reason in found.results.warning
