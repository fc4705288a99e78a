from typing import Any, cast

import pytest

from netem.control.emulator_statistics import Statistics
from netem.control.statistics_history import History


def statistics(elapsed_s: float, rate: float | None, seconds: float = 1.0) -> Statistics:
    recent: dict[str, Any] | None = None
    if rate is not None:
        recent = {"seconds": seconds, "arrived_per_s": rate, "loss": None}
    way = {"recent": recent}
    document = {"elapsed_s": elapsed_s, "links": [{"name": "up", "forward": way, "reverse": way}]}
    return cast(Statistics, document)


def series(history: History, points: int) -> list[float | None]:
    return [*history.series("up", "forward", lambda recent: recent["arrived_per_s"], points)]


def test_before_anything_there_is_nothing() -> None:
    history = History()
    assert series(history, 3) == [None] * 3
    history.add(statistics(1, None))
    assert series(history, 3) == [None] * 3


def test_a_minute_is_kept() -> None:
    history = History()
    for second in range(1, 101):
        history.add(statistics(second, second))
    assert series(history, 60) == list(range(41, 101))
    assert series(history, 30) == [41.5 + 2 * k for k in range(30)]


def test_a_sample_lasts_from_the_one_before() -> None:
    history = History()
    history.add(statistics(50, 7, seconds=10))
    history.add(statistics(60, 9, seconds=10))
    assert series(history, 6) == [None, None, None, None, 7, 9]
    assert series(history, 12) == [None] * 8 + [7, 7, 9, 9]


def test_what_is_not_known_is_left_out() -> None:
    history = History()
    history.add(statistics(1, 5))
    assert list(history.series("up", "reverse", lambda recent: recent["loss"], 2)) == [None, None]
    assert series(history, 2)[1] == pytest.approx(5)
