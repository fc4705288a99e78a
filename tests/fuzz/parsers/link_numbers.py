"""Numbers of a link: the core refuses them, or acts on them without undefined behaviour.

The long run uses the core that is built with sanitizers (:mod:`tests.native.sanitized_core`).
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from netem.link_state import LinkState
from noack.core.core_library import core, dtype_of, ffi, pointer_to
from noack.impairments.link_settings import LinkSettings
from tests.fuzz.edits import Choices
from tests.noack.impairments.feature_examples import CONSTRAINED, IMPAIRED, keeps_loss, names_file

_COMPUTABLE = [
    impairment for impairment in IMPAIRED if not names_file(impairment) and not keeps_loss(impairment)
]
_FIELDS = [(name, of.type.cname) for name, of in ffi.typeof("noack_link").fields]
_SCALARS = [name for name, kind in _FIELDS if kind == "int64_t"]
_COUNTED = ("stages", "integers", "reals", "windows")
"""The tables, of which ``noack_link`` has the length."""
_MOST = 4096
LATEST_NS, LARGEST_BYTES = 2**61, 65_535
"""What the core assumes of packets."""

Words = NDArray[np.int64]


def link_numbers_input(choices: Choices) -> None:
    """Make two links, decide for packets of the first, and go on with the second."""
    links = [link for link in (_link(choices), _link(choices)) if link is not None]
    for number, (link, kept) in enumerate(links):
        if number == 0:
            for row in range(link.rows):
                core.noack_link_start_flow(link, row, row, choices.below(2))
        else:
            before, owner = links[0]
            if link.rows != before.rows:
                return
            link.flows = before.flows
            latest_ns = np.full(link.rows, core.NOACK_NEVER_NS, np.int64)
            core.noack_link_change(before, link, pointer_to(latest_ns, "int64_t *"))
            kept |= {"flows": owner["flows"]}
        if link.rows:
            _decide(link, choices)


def _decide(link: Any, choices: Choices) -> None:
    """Decide for some packets; let those leave that are not lost."""
    decision = ffi.new("noack_decision *")
    now_ns = choices.integer() % LATEST_NS
    for _ in range(12):
        row, size = choices.below(256) % link.rows, choices.integer() % (LARGEST_BYTES + 1)
        core.noack_link_decide(link, row, size, now_ns, decision)
        assert core.NOACK_DELIVERED <= decision.fate <= core.NOACK_BLACKED_OUT
        if decision.release_ns != core.NOACK_NEVER_NS and choices.flag():
            delayed = decision.release_ns > now_ns
            core.noack_link_leave(link, row, decision.packet, size, delayed, decision.bit < 0)
        step_ns = choices.integer() if choices.below(8) == 1 else choices.below(1 << 16) << 10
        now_ns = min(now_ns + abs(step_ns), LATEST_NS)


def _link(choices: Choices) -> tuple[Any, dict[str, Any]] | None:
    """Return a link of numbers that the core accepts, and the arrays that it has; or None."""
    chain = [choices.choose(_COMPUTABLE) for _ in range(choices.below(4))]
    # A link has one scheduler at most.
    chosen = [impairment for impairment in chain if getattr(impairment, "scheduler", None)][1:]
    settings = LinkSettings.model_construct(
        impairments=tuple(impairment for impairment in chain if impairment not in chosen),
        constraints=tuple(choices.choose(CONSTRAINED) for _ in range(choices.below(3))),
        mansd=choices.choose((None, 0, 1, 5)),
    )
    state = LinkState(settings, 1, "fuzz", any_order=choices.below(4) == 1, rows=1 + choices.below(3))
    valid = state.core
    link = ffi.new("noack_link *", valid[0])
    tables = {
        name: np.frombuffer(
            ffi.buffer(getattr(valid, name), _length(valid, name) * ffi.sizeof(_kind(name))),
            np.int64,
        ).copy()
        for name in _COUNTED
    }
    keys = tables["stages"].reshape(-1, ffi.sizeof("noack_stage") // 8)[:, 1:3]
    keys[:] = choices.below(2)  # a change of settings transfers states between equal keys
    for _ in range(choices.below(6)):
        number = _integer(choices)
        index = choices.below(len(tables) + 2)
        if index < len(tables):
            words = [*tables.values()][index]
            if len(words):
                words[choices.below(1 << 16) % len(words)] = number
        else:
            setattr(link, choices.choose(_SCALARS), number)
    kept = _allocate(link, tables)
    wrong = core.noack_link_check(link)
    if wrong != ffi.NULL:
        assert ffi.string(wrong).decode().isprintable()
        return None
    return link, kept


def _integer(choices: Choices) -> int:
    """Return 64 bits: of an integer, or of a real number."""
    if choices.below(4) == 1:
        return int(np.float64(choices.real()).view(np.int64))
    return (choices.integer() + 2**63) % 2**64 - 2**63


def _kind(name: str) -> Any:
    return ffi.typeof(getattr(ffi.new("noack_link *"), name)).item


def _length(link: Any, name: str) -> int:
    return int(getattr(link, f"{name.removesuffix('s')}_count"))


def _allocate(link: Any, tables: dict[str, Words]) -> dict[str, Any]:
    """Give a link memory of exactly the lengths that it names; shorten those that are too long.

    No check can know how much memory there is.
    """
    lengths = [name for name in _SCALARS if name.endswith(("_count", "_flows", "_places", "rows"))]
    for name in (*lengths, "recent_width", "loss_width"):
        if getattr(link, name) > _MOST:
            setattr(link, name, getattr(link, name) % 64)
    sizes = {name: max(_length(link, name), 0) for name in tables}
    kept: dict[str, Any] = {
        name: _resized(words, sizes[name] * ffi.sizeof(_kind(name)) // 8) for name, words in tables.items()
    }
    rows, stages = max(link.rows, 0), sizes["stages"]
    kept |= {
        "flows": np.zeros(rows, dtype_of("noack_flow")),
        "memory": np.zeros(rows * stages, dtype_of("noack_stage_memory")),
        "recent_ns": np.full(rows * max(link.recent_width, 0), core.NOACK_NEVER_NS, np.int64),
        "losses": np.zeros(rows * max(link.loss_width, 0), np.int64),
        "queues": np.zeros(stages, dtype_of("noack_queue")),
        "departures_ns": np.zeros(max(link.departure_places, 0), np.int64),
    }
    for name, array in kept.items():
        setattr(link, name, ffi.cast(ffi.typeof(getattr(link, name)), array.ctypes.data))
    return kept


def _resized(words: Words, length: int) -> Words:
    return np.resize(words, length) if len(words) else np.zeros(length, np.int64)


PARSERS = {
    "link_numbers": link_numbers_input,
}
