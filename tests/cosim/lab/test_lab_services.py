"""The worker process that computes for all pages."""

import asyncio
import gc
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

from cosim.lab import lab_services
from cosim.lab.lab_services import LabServices, PageCalls
from tests.integration import conftest as live


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
    for name, ended in (("1", True), ("2", False)):
        folder = tmp_path / "runs" / name
        folder.mkdir(parents=True)
        (folder / "scenario.toml").touch()
        if ended:
            (folder / "summary.json").touch()
    with LabServices("lane_following", tmp_path, tmp_path / "runs") as services:
        assert services.recorded() == ["2", "1"]
        assert [services.has_ended(name) for name in services.recorded()] == [False, True]
