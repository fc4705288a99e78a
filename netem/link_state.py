"""One direction of a link: its settings as numbers and its state, in memory that the core uses.

Random streams are named after the link, the direction and the impairment, with a number if there
are several of a kind. Hence adding a delay does not change which packets are lost.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.core_library import AnyArray, CData, core, dtype_of, ffi, pointer_to
from noack.core.random_streams import stream_key
from noack.guarantee.loss_guarantee import DeliveriesBetweenBursts, LossesInWindow
from noack.impairments.feature import Stage, StageTables
from noack.impairments.link_settings import Counters, LinkSettings
from noack.impairments.target_loss import with_target_loss

Integers = NDArray[np.int64]
_COUNTED = dtype_of("noack_counters").names or ()


class LinkState:
    """Settings and state of one direction of a link; see native/network/link.c.

    Args:
        settings: the settings; they must not name files.
        seed: seed of its random streams.
        name: names of the link and the direction.
        any_order: whether packets may be delivered out of order whatever the settings are.
        rows: number of flows that have room; more are added as needed.

    Raises:
        ValueError: the settings name a file that has not been read, or a loss rate cannot be kept.

    >>> link = LinkState(LinkSettings(mansd=4), 1, "update")
    >>> link.start_flow(0, 0)
    >>> link.decide(row=0, size_bytes=72, now_ns=1_000_000).release_ns
    1000000
    """

    def __init__(
        self,
        settings: LinkSettings,
        seed: int,
        *name: str,
        any_order: bool = False,
        rows: int = 1,
    ) -> None:
        self.settings = settings
        self._seed, self._name = seed, name
        self.flows: NDArray[np.void] = np.zeros(rows, dtype_of("noack_flow"))
        """(rows,) of ``noack_flow``."""
        self.decision: CData = ffi.new("noack_decision *")
        """The decision for the last packet, a ``noack_decision``; overwritten by the next."""
        self.core: CData = ffi.new("noack_link *")
        """The link, as the core's functions take it; its address does not change. It is valid as
        long as this object lives."""
        self._memory: dict[str, AnyArray] = {}
        self._stages: CData = None
        self.core[0] = self._new_link(settings, rows, tracks=any_order)[0]

    @property
    def rows(self) -> int:
        """Number of flows that have room."""
        return len(self.flows)

    @property
    def tracks(self) -> bool:
        """Whether packets can be delivered out of order."""
        return bool(self.core.tracks)

    @property
    def counters(self) -> Counters:
        """The counts so far."""
        return Counters(*(getattr(self.core.counters, name) for name in _COUNTED))

    def flow(self, row: int) -> CData:
        """Return the ``noack_flow`` in a row."""
        return self.core.flows[row]

    def start_flow(self, row: int, number: int) -> None:
        """Begin a new flow in a free row; make room if necessary."""
        while row >= self.rows:
            self._add_rows()
        first = self.settings.first_delivered
        core.noack_link_start_flow(self.core, row, number, first)

    def decide(self, row: int, size_bytes: int, now_ns: int) -> CData:
        """Decide for the next packet of the flow in a row; return :attr:`decision`."""
        core.noack_link_decide(self.core, row, size_bytes, now_ns, self.decision)
        return self.decision

    def decide_many(self, rows: Integers, sizes_bytes: Integers, arrivals_ns: Integers) -> NDArray[np.void]:
        """Return the decisions for k packets in order of arrival, (k,) of ``noack_decision``.

        Args:
            rows: (k,) rows of their flows, which have begun.
            sizes_bytes: (k,)
            arrivals_ns: (k,)
        """
        if len(rows) and not 0 <= rows.min() <= rows.max() < self.rows:
            raise ValueError("rows: a flow has not begun")
        decisions = np.zeros(len(rows), dtype_of("noack_decision"))
        core.noack_link_decide_many(
            self.core,
            len(rows),
            *(pointer_to(array, "int64_t *") for array in (rows, sizes_bytes, arrivals_ns)),
            pointer_to(decisions, "noack_decision *"),
        )
        return decisions

    def leave(self, row: int, packet: int, size_bytes: int, *, delayed: bool, counts: bool) -> bool:
        """Note that a packet, or a copy, actually leaves; return whether it is stale.

        ``delayed``: it was in flight. ``counts``: it is the packet's first intact copy.
        """
        return bool(core.noack_link_leave(self.core, row, packet, size_bytes, delayed, counts))

    def change(self, settings: LinkSettings, latest_ns: Integers) -> None:
        """Apply other settings; see native/network/link_change.c.

        Args:
            settings: the new settings.
            latest_ns: (rows,) last departure time of the packets in flight of each flow; −1: none.
        """
        earlier = self._memory, self._stages  # kept alive until the core has read it
        try:
            changed = self._new_link(settings, self.rows, tracks=self.tracks)
        except ValueError:  # the link goes on as it was
            self._memory, self._stages = earlier
            raise
        core.noack_link_change(self.core, changed, pointer_to(latest_ns, "int64_t *"))
        self.core[0] = changed[0]
        self.settings = settings

    def _new_link(self, settings: LinkSettings, rows: int, *, tracks: bool) -> CData:
        """Return a new ``noack_link`` of these settings, which shares the array of flows."""
        # What the core reads: stages, and the numbers to which they refer.
        settings = with_target_loss(settings)
        tables = StageTables(
            scored=any(getattr(impairment, "loss_correlation", 0) != 0 for impairment in settings.impairments)
        )
        keyed_stages = list(_stages(settings, tables, self._seed, self._name))
        stage_array, stages = _stage_array(keyed_stages), [stage for stage, *_ in keyed_stages]
        limits, windows = _loss_limits(settings)
        tracks = tracks or any(impairment.delays for impairment in settings.impairments)
        mansd = limits["mansd"]
        link = ffi.new(
            "noack_link *",
            {
                "stages": stage_array,
                "stage_count": len(keyed_stages),
                "limit": settings.limit,
                "tracks": tracks,
                "scheduler": next((index for index, stage in enumerate(stages) if stage.schedules), -1),
                "rows": rows,
                "recent_width": 1 << mansd.bit_length() if tracks and mansd >= 0 else 1,
                "departure_places": sum(stage.queue_places for stage in stages),
                **limits,
            },
        )
        # Python owns the memory to which the link points; the core checks what is in it.
        read_only = {
            "integers": np.array(tables.integers, np.int64),
            "reals": np.array(tables.reals, np.float64),
            "windows": np.array(windows, dtype_of("noack_window")),
        }
        for name, array in read_only.items():
            setattr(link, f"{name.removesuffix('s')}_count", len(array))
        self._stages, self._memory = stage_array, read_only | _link_memory(link) | {"flows": self.flows}
        self._point(link)
        _require(core.noack_link_check(link))
        return link

    def _point(self, link: CData) -> None:
        for name, array in self._memory.items():
            setattr(link, name, ffi.cast(ffi.typeof(getattr(link, name)), array.ctypes.data))

    def _add_rows(self) -> None:
        """Double the number of flows that have room."""
        for name in ("flows", "memory", "recent_ns", "losses"):
            old = self._memory[name]
            empty = core.NOACK_NEVER_NS if name == "recent_ns" else 0
            # The type is given: numpy would pack the rows of padded structures.
            self._memory[name] = np.concatenate((old, np.full_like(old, empty)), dtype=old.dtype)
        self.flows = self._memory["flows"].view(self.flows.dtype)
        self.core.rows = len(self.flows)
        self._point(self.core)


class _KeyedStage(NamedTuple):
    """A stage with the key and the name of its random stream."""

    stage: Stage
    key: tuple[int, int]
    stream: tuple[str, ...]


def stream_names(settings: LinkSettings, *name: str) -> list[tuple[str, ...]]:
    """Return the names of the random streams of a link's stages, in their order."""
    return [keyed_stage.stream for keyed_stage in _stages(settings, StageTables(), 0, name)]


def _link_memory(link: CData) -> dict[str, AnyArray]:
    """Return the arrays of a ``noack_link`` that the core writes, but for the flows."""
    rows, stages = link.rows, link.stage_count
    return {
        "memory": np.zeros((rows, stages), dtype_of("noack_stage_memory")),
        "recent_ns": np.full((rows, link.recent_width), core.NOACK_NEVER_NS, np.int64),
        "losses": np.zeros((rows, link.loss_width), np.int64),
        "queues": np.zeros(stages, dtype_of("noack_queue")),
        "departures_ns": np.zeros(link.departure_places, np.int64),
    }


def _loss_limits(settings: LinkSettings) -> tuple[dict[str, int], list[tuple[int, int]]]:
    """Return the fields of a ``noack_link`` that limit losses, and limit and length of each window."""
    rules = [constraint.rule for constraint in settings.constraints]
    windows = [(rule.limit, rule.window) for rule in rules if isinstance(rule, LossesInWindow)]
    between = (rule.deliveries for rule in rules if isinstance(rule, DeliveriesBetweenBursts))
    mansd = -1 if settings.longest_burst is None else settings.longest_burst
    recovery, longest = max(between, default=0), max((packets for _, packets in windows), default=0)
    width = 1 << max(longest + 1, mansd + recovery + 1).bit_length() if windows or recovery else 1
    return {"mansd": mansd, "recovery": recovery, "loss_width": width}, windows


def _stages(
    settings: LinkSettings, tables: StageTables, seed: int, name: Sequence[str]
) -> Iterator[_KeyedStage]:
    """Yield the stages; ``tables`` gets the numbers to which they refer."""
    numbers: Counter[str] = Counter()
    for impairment in settings.impairments:
        number = numbers[impairment.kind] + 1
        stream_name = impairment.kind if number == 1 else f"{impairment.kind} {number}"
        stream = ("netem", *name, stream_name)
        tables.key = stream_key(seed, *stream)
        stage = impairment.stage(tables)
        if stage is not None:
            numbers[impairment.kind] = number
            yield _KeyedStage(stage, tables.key, stream)


def _stage_array(stages: Sequence[_KeyedStage]) -> CData:
    """Return the stages as an array of ``noack_stage``; their queues lie one after the other."""
    array, queue_begin = ffi.new("noack_stage[]", max(len(stages), 1)), 0
    for row, (stage, key, _) in zip(array, stages, strict=False):
        row.kind = getattr(core, f"NOACK_{stage.kind.upper()}")
        row.key0, row.key1 = key
        row.queue_places, row.queue_begin = stage.queue_places, queue_begin
        queue_begin += stage.queue_places
        for field, number in stage.numbers.items():
            setattr(getattr(row, stage.structure or stage.kind), field, number)
    return array


def _require(wrong: CData) -> None:
    """Raise ValueError for what the core found wrong with a link."""
    if wrong != ffi.NULL:
        raise ValueError(f"link: {ffi.string(wrong).decode()}")
