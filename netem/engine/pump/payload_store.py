"""Stores delayed datagrams: payloads in chained blocks, and a heap ordered by release time."""

from netem.engine.pump.pump_layout import BLOCK_BYTES, CHUNK_BLOCKS, Array, Memory
from noack.runtime.native.libc_calls import array_at, memcpy


def blocks_for(size_bytes: int) -> int:
    """Return the number of blocks for a payload."""
    return max((size_bytes + BLOCK_BYTES - 1) // BLOCK_BYTES, 1)


def block_address(chunks: Array, block: int) -> int:
    """Return the address of a block."""
    return chunks[block // CHUNK_BLOCKS] + (block % CHUNK_BLOCKS) * BLOCK_BYTES


def keep(memory: Memory, address: int, size_bytes: int, bit: int) -> int:
    """Copy a payload into a slot, flip a bit of it (−1 none), and return the slot's number.

    There must be room.
    """
    pump = memory.pump[0]
    number = pump.free_slot
    slot = memory.slots[number]
    pump.free_slot = slot.next
    pump.free_slots -= 1
    slot.size_bytes = size_bytes
    slot.bit = bit
    slot.block = pump.free_block
    count = blocks_for(size_bytes)
    block = slot.block
    for k in range(count):
        begin = k * BLOCK_BYTES
        length = min(size_bytes - begin, BLOCK_BYTES)
        place = block_address(memory.chunks, block)
        memcpy(place, address + begin, length)
        byte = (bit >> 3) - begin
        if bit >= 0 and 0 <= byte < length:
            _flip(memory, place + byte, bit & 7)
        if k == count - 1:
            pump.free_block = memory.block_next[block]
            memory.block_next[block] = -1
        block = memory.block_next[block]
    pump.free_blocks -= count
    return number


def copy_payload(memory: Memory, number: int, place: int) -> None:
    """Copy the payload in a slot to an address."""
    slot = memory.slots[number]
    block, left_bytes = slot.block, slot.size_bytes
    while left_bytes > 0:
        length = min(left_bytes, BLOCK_BYTES)
        memcpy(place, block_address(memory.chunks, block), length)
        place += length
        left_bytes -= length
        block = memory.block_next[block]


def drop(memory: Memory, number: int) -> None:
    """Free a slot and its blocks."""
    pump = memory.pump[0]
    slot = memory.slots[number]
    count = blocks_for(slot.size_bytes)
    last = slot.block
    for _ in range(count - 1):
        last = memory.block_next[last]
    memory.block_next[last] = pump.free_block
    pump.free_block = slot.block
    pump.free_blocks += count
    slot.next = pump.free_slot
    pump.free_slot = number
    pump.free_slots += 1


def push(memory: Memory, release_ns: int, number: int, slot: int) -> None:
    """Push a slot onto the heap."""
    pump, heap = memory.pump[0], memory.heap
    place = pump.heap
    pump.heap += 1
    while place > 0:
        above = (place - 1) >> 1
        other = heap[above]
        if not _before(release_ns, number, other.release_ns, other.number):
            break
        _set(heap, place, other.release_ns, other.number, other.slot)
        place = above
    _set(heap, place, release_ns, number, slot)


def pop(memory: Memory) -> None:
    """Remove the first entry of the heap."""
    pump, heap = memory.pump[0], memory.heap
    pump.heap -= 1
    count = pump.heap
    last = heap[count]
    release_ns, number, slot = last.release_ns, last.number, last.slot
    place = 0
    while True:
        below = 2 * place + 1
        if below >= count:
            break
        if below + 1 < count and _before(
            heap[below + 1].release_ns, heap[below + 1].number,
            heap[below].release_ns, heap[below].number,
        ):  # fmt: skip
            below += 1
        other = heap[below]
        if not _before(other.release_ns, other.number, release_ns, number):
            break
        _set(heap, place, other.release_ns, other.number, other.slot)
        place = below
    _set(heap, place, release_ns, number, slot)


def _before(a_ns: int, a: int, b_ns: int, b: int) -> bool:
    return a_ns < b_ns or (a_ns == b_ns and a < b)


def _set(heap: Array, place: int, release_ns: int, number: int, slot: int) -> None:
    entry = heap[place]
    entry.release_ns = release_ns
    entry.number = number
    entry.slot = slot


def _flip(memory: Memory, address: int, bit: int) -> None:
    byte = array_at(memory.data, address, 1, 1)
    byte[0] ^= 1 << bit
