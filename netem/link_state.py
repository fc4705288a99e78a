"""One direction of a link: its settings as numbers for the core, which has its state.

Random streams are named after the link, the direction and the impairment, with a number if there
are several of a kind. Hence adding a delay does not change which packets are lost.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from netem.core.core_library import CData, core, dtype_of, ffi, new_handle, pointer_to, require, rows_at
from netem.core.random_streams import stream_key
from netem.guarantee.loss_guarantee import DeliveriesBetweenBursts, LossesInWindow
from netem.impairments.feature import Stage, StageTables
from netem.impairments.link_settings import Counters, LinkSettings
from netem.impairments.target_loss import with_target_loss

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
        ValueError: the settings name a file that has not been read, a loss rate cannot be kept, or the
            core refuses a number.

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
        self.decision: CData = ffi.new("noack_decision *")
        """The decision for the last packet, a ``noack_decision``; overwritten by the next."""
        numbers, _arrays = _link_numbers(settings, seed, name)
        numbers.can_reorder |= any_order
        numbers.rows = rows
        self.core: CData = new_handle("link", numbers)
        """The link, as the core's functions take it; valid as long as this object lives."""

    @property
    def rows(self) -> int:
        """Number of flows that have room."""
        return int(core.noack_link_rows(self.core))

    @property
    def flows(self) -> NDArray[np.void]:
        """(rows,) of ``noack_flow``; valid until a flow begins."""
        return rows_at(core.noack_link_flows(self.core), self.rows)

    @property
    def in_flight(self) -> int:
        """Number of delayed packets and copies."""
        return int(core.noack_link_in_flight(self.core))

    @property
    def can_reorder(self) -> bool:
        """Whether packets can be delivered out of order."""
        return bool(core.noack_link_can_reorder(self.core))

    @property
    def counters(self) -> Counters:
        """The counts so far."""
        counters = core.noack_link_counters(self.core)
        return Counters(*(getattr(counters, name) for name in _COUNTED))

    def flow(self, row: int) -> CData:
        """Return the ``noack_flow`` in a row."""
        return core.noack_link_flows(self.core)[row]

    def start_flow(self, row: int, number: int) -> None:
        """Begin a new flow in a free row; make room if necessary."""
        if not core.noack_link_start_flow(self.core, row, number, self.settings.first_delivered):
            raise MemoryError

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

    def change(self, settings: LinkSettings, latest_ns: Integers) -> None:
        """Apply other settings; see native/network/link_change.c.

        Args:
            settings: the new settings.
            latest_ns: (rows,) last departure time of the packets in flight of each flow; −1: none.
        """
        wrong = ffi.new("const char **")
        numbers, _arrays = _link_numbers(settings, self._seed, self._name)
        pointer = pointer_to(latest_ns, "int64_t *")
        require(core.noack_link_change(self.core, numbers, pointer, wrong), wrong, "link")
        self.settings = settings


class _KeyedStage(NamedTuple):
    """A stage with the key and the name of its random stream."""

    stage: Stage
    key: tuple[int, int]
    stream: tuple[str, ...]


def stream_names(settings: LinkSettings, *name: str) -> list[tuple[str, ...]]:
    """Return the names of the random streams of a link's stages, in their order."""
    return [keyed_stage.stream for keyed_stage in _stages(settings, StageTables(), 0, name)]


def _link_numbers(
    settings: LinkSettings, seed: int, name: Sequence[str]
) -> tuple[CData, Mapping[str, CData]]:
    """Return the settings as a ``noack_link_settings``, and the arrays to which it points."""
    settings = with_target_loss(settings)
    tables = StageTables(
        scored=any(getattr(impairment, "loss_correlation", 0) != 0 for impairment in settings.impairments)
    )
    keyed_stages = list(_stages(settings, tables, seed, name))
    rules = [constraint.rule for constraint in settings.constraints]
    between = (rule.deliveries for rule in rules if isinstance(rule, DeliveriesBetweenBursts))
    numbers = ffi.new("noack_link_settings *", {
        "recovery": max(between, default=0),
        "mansd": -1 if settings.longest_burst is None else settings.longest_burst,
        "limit": settings.limit,
        "can_reorder": any(impairment.delays for impairment in settings.impairments),
    })  # fmt: skip
    arrays = {
        "stages": _stage_array(keyed_stages),
        "integers": ffi.new("int64_t[]", tables.integers),
        "reals": ffi.new("double[]", tables.reals),
        "windows": ffi.new(
            "noack_window[]",
            [(rule.limit, rule.window) for rule in rules if isinstance(rule, LossesInWindow)],
        ),
    }
    for array_name, array in arrays.items():
        setattr(numbers, array_name, array)
        setattr(numbers, f"{array_name.removesuffix('s')}_count", len(array))
    return numbers, arrays


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
    """Return the stages as an array of ``noack_stage``."""
    array = ffi.new("noack_stage[]", len(stages))
    for row, (stage, key, _) in zip(array, stages, strict=True):
        row.kind = getattr(core, f"NOACK_{stage.kind.upper()}")
        row.key0, row.key1 = key
        row.queue_places = stage.queue_places
        for field, number in stage.numbers.items():
            setattr(getattr(row, stage.structure or stage.kind), field, number)
    return array
