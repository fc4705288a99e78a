"""An emulator within a program: between a UDP client and a server, for tests and experiments.

:class:`LossyUdp` runs a relay with one link in a thread of this process. It is used as a context,
with ``with`` or with ``async with``; the fixture ``lossy_udp`` of :mod:`netem.pytest_plugin` makes
as many as a test needs.
"""

import asyncio
from collections.abc import Sequence
from concurrent.futures import Future
from os import PathLike
from pathlib import Path
from threading import Event, Thread
from typing import Self

from netem.control.command_queue import CommandQueue, Snapshot
from netem.control.emulator_statistics import DirectionStatistics, LinkStatistics, statistics
from netem.core.address import Address, address_text, parse_address, parse_destination
from netem.core.clock import NS_PER_S
from netem.core.errors import CallerError, why
from netem.core.number_checks import real_number, whole_number
from netem.core.settings_section import LARGEST_SEED
from netem.impairments.link_settings import LinkSettings
from netem.impairments.target_loss import read_files
from netem.relay.relay import Relay
from netem.relay.relay_links import LinkSpec
from netem.relay.relay_reports import DIRECTIONS, Direction
from netem.relay.timetable import Timetable
from netem.tc_words import preset_names, reverse_words, settings_of
from netem.timetable_file import SHORTEST_NS, read_timetable


class LossyUdp:
    """A UDP relay to a server, which delays and loses datagrams, within the limits that its words set.

    Clients send to ``address`` instead of to the server. A datagram's fate depends on ``seed``,
    the direction, the number of the client (in the order in which clients appear) and the number of
    the datagram within its flow; so a program that sends the same datagrams meets the same losses
    again, here, from ``noack-netem`` and from a file of links. How many datagrams a program sends
    may depend on its timers.

    >>> import netem
    >>> with netem.LossyUdp("127.0.0.1:9", "loss 30% mansd 4", seed=1) as link:
    ...     host, port = link.address
    ...     link.change("loss 50% mansd 4")
    >>> link.forward["received"]
    0

    Args:
        to: the server: host and port, or ``"host:port"``.
        words: what happens to datagrams of clients, in the words of ``noack netem``.
        reverse: what happens to the server's answers; by default nothing, or what the presets say
            that ``words`` name (``like dsl``).
        seed: seed of the random streams.
        listen: where clients send to; port 0 selects a free port.
        name: name of the link in reports.
        timetable: a CSV file with changes of the settings, in seconds since the start; ``noack-netem
            --timetable`` takes the same file.
        repeat_s: the timetable repeats after this time in seconds; by default it does not.

    Raises:
        CallerError: an address, a word or the timetable is wrong; the listening address is in use
            (on entering).
    """

    def __init__(
        self,
        to: str | Sequence[str | int],
        words: str = "",
        *,
        reverse: str | None = None,
        seed: int = 0,
        listen: str | Sequence[str | int] = "127.0.0.1:0",
        name: str = "relay",
        timetable: str | PathLike[str] | None = None,
        repeat_s: float | None = None,
    ) -> None:
        seed = whole_number("seed", seed, 0, LARGEST_SEED)
        listen_at = parse_address(_text(listen, "listen"), "listen")
        server = parse_destination(_text(to, "to"), "to", listen_at)
        forward_settings = _settings(words, "words")
        answers = reverse_words(preset_names(words)) if reverse is None else reverse
        reverse_settings = _settings(answers, "reverse", "reverse")
        self._spec = LinkSpec(name, listen_at, server, forward_settings, reverse_settings, seed)
        self._timetable = self._read_timetable(timetable, repeat_s)
        self._opening: Future[tuple[CommandQueue, Address]] = Future()
        self._last_snapshot: Snapshot | None = None
        self._stop = Event()
        self._thread = Thread(target=self._run, name=f"noack {name}", daemon=True)

    def __enter__(self) -> Self:
        """Start; a link of the fixture ``lossy_udp`` runs already."""
        if self._stop.is_set():
            raise CallerError(f"{self._spec.name}: it has ended; make a new one")
        if self._thread.ident is None:
            self._thread.start()
        self._opening.result()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    async def __aenter__(self) -> Self:
        return await asyncio.to_thread(self.__enter__)

    async def __aexit__(self, *_: object) -> None:
        await asyncio.to_thread(self.__exit__)

    @property
    def address(self) -> Address:
        """Host and port to which clients send."""
        return self._running()[1]

    @property
    def seed(self) -> int:
        """The seed of the random streams."""
        return self._spec.seed

    @property
    def forward(self) -> DirectionStatistics:
        """What ``noack netem show --json`` prints of the datagrams to the server.

        Among it are ``received``, ``fates``, by name, and ``longest_loss_burst``.
        """
        return self._statistics()["forward"]

    @property
    def reverse(self) -> DirectionStatistics:
        """The same of the server's answers."""
        return self._statistics()["reverse"]

    def change(self, words: str, *, directions: Sequence[Direction] = ("forward",)) -> None:
        """Change what happens to datagrams from now on.

        Flows keep their numbers, and the guarantee remembers the losses before.

        Args:
            words: as above.
            directions: ``"forward"``, ``"reverse"``, or both.

        Raises:
            CallerError: a word is wrong.
            PeerError: the relay has ended.
        """
        if unknown := [direction for direction in directions if direction not in DIRECTIONS]:
            raise CallerError(f"directions: {unknown[0]!r}; the directions are forward and reverse")
        commands, _ = self._running()
        commands.change(
            self._spec.name, {direction: _settings(words, "words", direction) for direction in directions}
        )

    def __str__(self) -> str:
        """Where the link leads, its settings, and what was lost."""
        lines = [f"{self._spec.name} to {address_text(self._spec.to)}, seed {self.seed}"]
        for direction, counts in (("forward", self.forward), ("reverse", self.reverse)):
            lost = counts["received"] - counts["fates"].get("delivered", 0)
            lost -= counts["fates"].get("forced", 0)
            lines.append(
                f"  {direction}: {counts['words'] or 'no impairment'}; {counts['received']} "
                f"received, {lost} lost, longest burst {counts['longest_loss_burst']}"
            )
        return "\n".join(lines)

    def _statistics(self) -> LinkStatistics:
        commands, _ = self._running()
        snapshot = commands.snapshot() if self._last_snapshot is None else self._last_snapshot
        return statistics(snapshot)["links"][0]

    def _running(self) -> tuple[CommandQueue, Address]:
        if self._thread.ident is None:
            raise CallerError(f"{self._spec.name}: not entered; with noack.LossyUdp(...) as link:")
        return self._opening.result()

    def _read_timetable(self, path: str | PathLike[str] | None, repeat_s: float | None) -> Timetable | None:
        if path is None:
            if repeat_s is not None:
                raise CallerError(f"repeat_s: {repeat_s!r}; there is no timetable")
            return None
        if not isinstance(path, str | PathLike):
            raise CallerError(f"timetable: {path!r}; give the name of a CSV file")
        repeat_ns = None
        if repeat_s is not None:
            repeat_ns = round(real_number("repeat_s", repeat_s, above=0, most=1e6) * NS_PER_S)
            if repeat_ns < SHORTEST_NS:
                raise CallerError(f"repeat_s {repeat_s:g}: must be 0.001 s or more")
        return read_timetable(Path(path), [self._spec], repeat_ns).timetable

    def _run(self) -> None:
        """Relay until the context ends; all of the relay is used in this thread."""
        try:
            relay = Relay([self._spec], timetable=self._timetable)
        except OSError as error:  # e.g. too many open files
            self._opening.set_exception(CallerError(f"{self._spec.name}: {why(error)}"))
            return
        except BaseException as error:  # raised where the context is entered
            self._opening.set_exception(error)
            return
        commands = CommandQueue(relay)
        try:
            self._opening.set_result((commands, relay.addresses()[self._spec.name]))
            relay.run(self._stop.is_set, commands.run_pending)
            self._last_snapshot = commands.snapshot_here()
        finally:
            commands.close()
            relay.close()


def _text(address: str | Sequence[str | int], argument: str) -> str:
    if isinstance(address, str):
        return address
    match address:
        case [str(host), int(port), *_]:
            return address_text((host, port))
    raise CallerError(f"{argument}: {address!r}; give host and port, or 'host:port'")


def _settings(words: str, argument: str, direction: Direction = "forward") -> LinkSettings:
    if not isinstance(words, str):
        raise CallerError(f"{argument}: {words!r}; give words such as 'loss 30% mansd 4'")
    return read_files(settings_of(words, direction=direction), Path())
