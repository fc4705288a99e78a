from typing import Any, cast

from netem.control.emulator_statistics import Statistics
from netem.control.statistics_view import History


def statistics(elapsed_s: float, rate: float | None, seconds: float = 1.0) -> Statistics:
    recent: dict[str, Any] | None = None
    if rate is not None:
        recent = {"seconds": seconds, "received_per_s": rate, "loss": None}
    side = {"recent": recent}
    document = {"elapsed_s": elapsed_s, "links": [{"name": "up", "forward": side, "reverse": side}]}
    return cast(Statistics, document)


def series(history: History, points: int, key: str = "received_per_s") -> list[float | None]:
    return [*history.series("up", "forward", key, points)]


def test_a_point_without_a_value_is_none() -> None:
    history = History()
    assert series(history, 3) == [None] * 3
    history.add(statistics(1, None))
    history.add(statistics(2, 5))
    assert series(history, 2) == [None, 5]
    assert series(history, 2, "loss") == [None] * 2


def test_the_last_minute_is_kept() -> None:
    history = History()
    for second in range(1, 101):
        history.add(statistics(second, second))
    assert series(history, 60) == list(range(41, 101))
    assert series(history, 30) == [41.5 + 2 * k for k in range(30)]


def test_a_sample_applies_to_the_time_since_the_previous_one() -> None:
    history = History()
    history.add(statistics(50, 7, seconds=10))
    history.add(statistics(60, 9, seconds=10))
    assert series(history, 6) == [None, None, None, None, 7, 9]
    assert series(history, 12) == [None] * 8 + [7, 7, 9, 9]
