"""A heap of deadlines with their loops, as a flat array of pairs; ties go by the loop's number."""

from typing import Any


def lower_first(heap: Any, count: int) -> None:
    """Restore the order after the first of ``count`` entries was replaced by a later one."""
    due_ns, loop = heap[0], heap[1]
    place = 0
    while True:
        below = 2 * place + 1
        if below >= count:
            break
        if below + 1 < count and is_before(
            heap[2 * below + 2], heap[2 * below + 3], heap[2 * below], heap[2 * below + 1]
        ):
            below += 1
        if not is_before(heap[2 * below], heap[2 * below + 1], due_ns, loop):
            break
        heap[2 * place], heap[2 * place + 1] = heap[2 * below], heap[2 * below + 1]
        place = below
    heap[2 * place], heap[2 * place + 1] = due_ns, loop


def is_before(due_ns: int, loop: int, other_ns: int, other: int) -> bool:
    """Whether a deadline is served before another."""
    return due_ns < other_ns or (due_ns == other_ns and loop < other)
