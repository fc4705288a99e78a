"""A timetable: which changes are due, and what a relay does at their times."""

import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from netem.control.command_queue import CommandQueue
from netem.control.emulator_statistics import statistics
from netem.core.errors import CallerError
from netem.impairments.link_settings import LinkSettings
from netem.relay.relay import Relay
from netem.relay.relay_reports import Direction
from netem.relay.timetable import NEVER_NS, TimedChange, Timetable, TimetableProgress
from netem.tc_words import settings_of
from tests.netem.relay.relays import Running, drain, endpoints, link, name_of

NOTHING, ALL_LOST = LinkSettings(), settings_of("loss 100%")
FAR_NS = 3_600 * 10**9


def change(
    at_ns: int, settings: LinkSettings, name: str = "test", side: Direction = "forward"
) -> TimedChange:
    return TimedChange(at_ns, name, side, settings)


times_ns = st.lists(st.integers(0, 99), max_size=6).map(sorted)


@given(times_ns, st.none() | st.integers(100, 150), st.lists(st.integers(-5, 400), max_size=8).map(sorted))
def test_changes_are_due_in_their_order_once_or_in_each_round(
    at_ns: list[int], repeat_ns: int | None, asked_ns: list[int]
) -> None:
    """Compared with all changes of all rounds, written out; of rounds that have passed the last is taken."""
    changes = [change(t_ns, NOTHING, str(number)) for number, t_ns in enumerate(at_ns)]
    rounds = range(0, 1000, repeat_ns) if repeat_ns else (0,)
    every = [(begin + each.at_ns, each.link) for begin in rounds for each in changes]
    progress = TimetableProgress(Timetable(changes, repeat_ns))
    before_ns = -10
    for now_ns in asked_ns:
        taken = [each.link for each in progress.take(now_ns)]
        due = [name for t_ns, name in every if before_ns < t_ns <= now_ns]
        before_ns = max(before_ns, now_ns)
        assert taken == due[len(due) - len(taken) :]
        assert len(due) <= len(taken) or len(taken) >= len(changes)
        later = [t_ns for t_ns, _ in every if t_ns > before_ns]
        assert progress.next_ns == min(later, default=NEVER_NS)


def test_a_datagram_meets_the_settings_at_its_arrival_however_late_it_is_read() -> None:
    """Three datagrams wait in the socket while the times of two changes pass."""
    with endpoints(*["127.0.0.1"] * 2) as (server, client):
        relay = Relay([link(name_of(server))], timetable=Timetable())
        emulator = Running(relay)
        between_ns: list[int] = []
        for data in (b"before", b"between", b"behind"):
            client.sendto(data, emulator.address())
            time.sleep(0.01)
            between_ns.append(time.monotonic_ns())
            time.sleep(0.01)
        relay._epoch_ns = between_ns[0] - FAR_NS
        second_ns = FAR_NS + between_ns[1] - between_ns[0]
        changes = [change(FAR_NS, ALL_LOST), change(second_ns, NOTHING)]
        relay._timetable = TimetableProgress(Timetable(changes))
        assert [data for data, _ in emulator.receive(server, 2)] == [b"before", b"behind"]
        assert emulator.report().forward.counters.dropped == 1
        relay.close()


def test_changes_of_several_links_and_directions_repeat_and_are_counted() -> None:
    """Datagrams are sent all the time; they are lost and pass again, in the directions that change."""
    with endpoints(*["127.0.0.1"] * 3) as (server, *clients):
        specs = [link(name_of(server), name=name) for name in ("a", "b")]
        changed: list[tuple[str, Direction]] = [("a", "forward"), ("b", "reverse")]
        times = ((0, NOTHING), (10**8, ALL_LOST), (2 * 10**8, NOTHING))
        changes = [change(t_ns, settings, *which) for t_ns, settings in times for which in changed]
        relay = Relay(specs, timetable=Timetable(changes, 3 * 10**8))
        commands = CommandQueue(relay)
        seen = {which: [""] for which in changed}
        dropped = dict.fromkeys(changed, 0)

        def is_over() -> bool:
            for client, name in zip(clients, "ab", strict=True):
                client.sendto(b"question", relay.addresses()[name])
            for _, source in drain(server):
                server.sendto(b"answer", source)
            links = dict(zip("ab", statistics(commands.snapshot_here())["links"], strict=True))
            for name, side in changed:
                direction = links[name][side]
                assert direction["words"] in ("", "loss 100%")
                if direction["words"] != seen[name, side][-1]:
                    seen[name, side].append(direction["words"])
                    assert 0 < direction["received_before"] <= direction["received"]
                if direction["words"] == "":  # and nothing is lost under these settings
                    assert direction["loss"]["lost"] in (None, 0.0)
                dropped[name, side] = direction["fates"]["dropped"]
            assert links["a"]["reverse"]["fates"]["dropped"] == links["b"]["forward"]["fates"]["dropped"] == 0
            return min(map(len, seen.values())) > 4

        relay.run(is_over, commands.run_pending)
        relay.close()
        assert min(dropped.values()) > 0


def test_a_change_applies_without_datagrams() -> None:
    with endpoints("127.0.0.1") as (server,):
        relay = Relay(
            [link(name_of(server))], timetable=Timetable([change(0, ALL_LOST), change(10**7, NOTHING)])
        )
        words: list[str] = []

        def is_over() -> bool:
            words.append(str(relay.report()[0].forward.settings.impairments))
            return words[-1] == "()" and len(words) > 1

        relay.run(is_over, lambda: None)
        relay.close()
        assert "loss" in str(words)


def test_a_change_of_a_link_that_is_not_there_is_refused() -> None:
    with endpoints("127.0.0.1") as (server,):
        relay = Relay([link(name_of(server))], timetable=Timetable([change(0, ALL_LOST, "other")]))
        with pytest.raises(CallerError, match="no such link"):
            relay.run(lambda: False, lambda: None)
        relay.close()
