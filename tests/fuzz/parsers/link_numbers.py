"""Numbers of a link: the core refuses them, or acts on them without undefined behaviour.

The long run uses the core that is built with sanitizers (:mod:`tests.native.sanitized_core`).
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from netem.core.core_library import core, ffi, pointer_to
from netem.impairments.link_settings import LinkSettings
from netem.link_state import _link_numbers
from tests.fuzz.edits import Choices
from tests.netem.impairments.feature_examples import CONSTRAINED, IMPAIRED, keeps_loss, names_file

_COMPUTABLE = [
    impairment for impairment in IMPAIRED if not names_file(impairment) and not keeps_loss(impairment)
]
_FIELDS = [(name, of.type.cname) for name, of in ffi.typeof("noack_link_settings").fields]
_SCALARS = [name for name, kind in _FIELDS if kind == "int64_t"]
_MOST = 4096
LATEST_NS, LARGEST_BYTES = 2**61, 65_535
"""What the core assumes of packets."""

Words = NDArray[np.int64]


def link_numbers_input(choices: Choices) -> None:
    """Make a link of some numbers, decide for packets, and go on with other numbers."""
    wrong = ffi.new("const char **")
    numbers, _arrays = _settings(choices)
    link = core.noack_link_new(numbers, wrong)
    if link == ffi.NULL:
        assert ffi.string(wrong[0]).decode().isprintable()
        return
    link = ffi.gc(link, core.noack_link_free)
    for row in range(core.noack_link_rows(link)):
        assert core.noack_link_start_flow(link, row, row, choices.below(2))
    _decide(link, choices)
    other, _arrays = _settings(choices)
    latest_ns = np.full(core.noack_link_rows(link), core.NOACK_NEVER_NS, np.int64)
    core.noack_link_change(link, other, pointer_to(latest_ns, "int64_t *"), wrong)
    _decide(link, choices)


def _decide(link: Any, choices: Choices) -> None:
    """Decide for some packets; let those leave that are not lost."""
    decision = ffi.new("noack_decision *")
    now_ns = choices.integer() % LATEST_NS
    for _ in range(12):
        row, size = choices.below(256) % core.noack_link_rows(link), choices.integer() % (LARGEST_BYTES + 1)
        core.noack_link_decide(link, row, size, now_ns, decision)
        assert core.NOACK_DELIVERED <= decision.fate <= core.NOACK_BLACKED_OUT
        if decision.release_ns != core.NOACK_NEVER_NS and choices.flag():
            delayed = decision.release_ns > now_ns
            core.noack_link_leave(link, row, decision.packet, size, delayed, decision.bit < 0)
        step_ns = choices.integer() if choices.below(8) == 1 else choices.below(1 << 16) << 10
        now_ns = min(now_ns + abs(step_ns), LATEST_NS)


def _settings(choices: Choices) -> tuple[Any, dict[str, Any]]:
    """Return settings of any numbers, and the arrays that they have."""
    chain = [choices.choose(_COMPUTABLE) for _ in range(choices.below(4))]
    # A link has one scheduler at most.
    chosen = [impairment for impairment in chain if getattr(impairment, "scheduler", None)][1:]
    settings = LinkSettings.model_construct(
        impairments=tuple(impairment for impairment in chain if impairment not in chosen),
        constraints=tuple(choices.choose(CONSTRAINED) for _ in range(choices.below(3))),
        mansd=choices.choose((None, 0, 1, 5)),
    )
    link, arrays = _link_numbers(settings, 1, ("fuzz",))
    link.can_reorder |= choices.below(4) == 1
    link.rows = 1 + choices.below(3)
    tables = {name: np.frombuffer(ffi.buffer(array), np.int64).copy() for name, array in arrays.items()}
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
    return link, _allocate(link, tables, arrays)


def _integer(choices: Choices) -> int:
    """Return 64 bits: of an integer, or of a real number."""
    if choices.below(4) == 1:
        return int(np.float64(choices.real()).view(np.int64))
    return (choices.integer() + 2**63) % 2**64 - 2**63


def _allocate(link: Any, tables: dict[str, Words], arrays: Mapping[str, Any]) -> dict[str, Any]:
    """Give settings arrays of exactly the lengths that they name; shorten those that are too long.

    No check can know how much memory there is.
    """
    for name in _SCALARS:
        if name != "can_reorder" and getattr(link, name) > _MOST:
            setattr(link, name, getattr(link, name) % 64)
    kept: dict[str, Any] = {}
    for name, words in tables.items():
        length = max(getattr(link, f"{name.removesuffix('s')}_count"), 0)
        kept[name] = _resized(words, length * ffi.sizeof(ffi.typeof(arrays[name]).item) // 8)
        setattr(link, name, ffi.cast(ffi.typeof(getattr(link, name)), kept[name].ctypes.data))
    for stage in link.stages[0 : max(link.stage_count, 0)]:
        if stage.queue_places > _MOST:
            stage.queue_places %= 64
    return kept


def _resized(words: Words, length: int) -> Words:
    return np.resize(words, length) if len(words) else np.zeros(length, np.int64)


PARSERS = {
    "link_numbers": link_numbers_input,
}
