"""Where a run listens for other hosts, and floods of connections."""

import json
from collections import Counter
from pathlib import Path

from cosim.live.coordination import remote_access
from noack.core.errors import CallerError
from noack.scenario.run_sections import ClocksSection
from noack.scenario.scenario_file import load
from tests.helpers.approved import compare_lines


def test_a_run_listens_at_addresses_that_others_can_reach() -> None:
    """A port may be missing."""

    def addresses(text: str) -> list[str]:
        try:
            return ["{} port {}".format(*remote_access.listen_address(json.loads(text)))]
        except CallerError as error:
            return [str(error).partition(" (")[0]]

    compare_lines(Path(__file__).with_name("addresses.txt"), addresses)


def test_one_loop_records_the_bounds_of_its_clocks() -> None:
    given = load(Path("scenarios/lane_following.toml"))
    assert remote_access.with_clocks(given).clocks == ClocksSection()
    strict = given.model_copy(update={"clocks": ClocksSection(largest_error_us=5.0)})
    assert remote_access.with_clocks(strict) is strict


def test_a_flood_of_connections_is_reported_at_its_begin_and_end() -> None:
    watch = remote_access.ConnectionFloodWatch()

    def lines(*counts: int) -> list[str]:
        for count in counts:
            watch.next_interval(Counter({"192.0.2.7": count, "192.0.2.8": count // 2}))
        return [watch.lines.get_nowait() for _ in range(watch.lines.qsize())]

    assert lines(3, 0, 40) == []
    (begin,) = lines(4000, 4000)
    assert begin == (
        "flood: 6000 connections without an invitation in a second, from 2 addresses, most from "
        "192.0.2.7; processes with an invitation can still join"
    )
    assert lines(0, 0, 4000, 0, 0) == []
    assert lines(0) == ["the flood is over: 18000 connections without an invitation ended"]
    assert len(lines(4000, 0, 0, 0)) == 1  # the next end is reported later
    assert len(lines(0, 0, 0)) == 1
