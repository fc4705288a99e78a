"""Divides datagrams that a kernel merged before they were captured.

Linux merges datagrams of one flow on arrival (UDP GRO), and a program can send many in one piece (GSO).
A capture then has one long datagram, of payloads of equal size, of which the last may be shorter.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from netem.traces.captured_flows import Capture, Datagrams, payload_hash

_SMALLEST = 8
"""Smaller datagrams are in longer ones by chance."""
_MOST_SIZES = 64
"""Sizes of datagrams, the most frequent ones, that are tried."""


def pieces_of(payload: bytes, size_bytes: int) -> list[bytes]:
    """Return a payload in pieces of a size; the last may be shorter."""
    return [payload[at : at + size_bytes] for at in range(0, len(payload), size_bytes)]


def divide_merged(
    capture: Capture,
    datagrams: Datagrams,
    unmatched: NDArray[np.bool_],
    single: Datagrams,
    *,
    all_known: bool,
) -> Datagrams:
    """Return datagrams with the merged ones divided.

    Args:
        capture: the capture that they are from.
        datagrams: some of its datagrams.
        unmatched: which of them may be merged.
        single: those at the other end.
        all_known: a merged datagram consists of these only; else some of them may be missing.
    """
    if not len(single.size) or not capture.is_whole:
        return datagrams
    suspect = unmatched & (datagrams.size > max(int(single.size.min()), 1))
    if not suspect.any():
        return datagrams
    sizes = [size for size, _ in Counter(single.size.tolist()).most_common(_MOST_SIZES) if size >= _SMALLEST]
    known = set(single.hashes.tolist())
    rows = set(datagrams.row[suspect].tolist())
    divided: dict[int, list[tuple[int, int]]] = {}
    used: Counter[int] = Counter()
    for row, payload in _payloads(capture, rows):
        best = _best_division(payload, sizes, known)
        if best is None or (all_known and best[1] < len(best[2])):
            continue
        divided[row] = best[2]
        used[best[0]] += 1
    if not all_known and used:
        # All pieces of the rest are missing at the other end.
        usual = used.most_common(1)[0][0]
        for row, payload in _payloads(capture, rows - divided.keys()):
            if len(payload) > usual:
                divided[row] = _hashed(payload, usual)
    if not divided:
        return datagrams
    count = sum(map(len, divided.values()))
    capture.notes.append(f"datagrams that the kernel merged (UDP GRO): {len(divided)}, divided into {count}")
    return _replaced(datagrams, divided)


def _payloads(capture: Capture, rows: set[int]) -> Iterator[tuple[int, bytes]]:
    for row, datagram in enumerate(capture.read() if rows else ()):
        if row in rows:
            yield row, datagram.payload


def _hashed(payload: bytes, size_bytes: int) -> list[tuple[int, int]]:
    """Return the hash and the size of each piece."""
    return [(payload_hash(piece, len(piece)), len(piece)) for piece in pieces_of(payload, size_bytes)]


def _best_division(
    payload: bytes, sizes: Sequence[int], known: set[int]
) -> tuple[int, int, list[tuple[int, int]]] | None:
    """Return the size of which most pieces are known, their number, and the pieces; None: there is none."""
    best = None
    for size_bytes in sizes:
        if size_bytes >= len(payload):
            continue
        pieces = _hashed(payload, size_bytes)
        count = sum(hashed in known for hashed, _ in pieces)
        if count and (best is None or count * len(best[2]) > best[1] * len(pieces)):
            best = size_bytes, count, pieces
            if count == len(pieces):
                break
    return best


def _replaced(datagrams: Datagrams, divided: Mapping[int, list[tuple[int, int]]]) -> Datagrams:
    """Return datagrams with some rows replaced by pieces, given by hash and size."""
    parts = [divided.get(row, [(0, 0)]) for row in datagrams.row.tolist()]
    result = datagrams.where(np.repeat(np.arange(len(parts)), [len(part) for part in parts]))
    is_piece = np.repeat([row in divided for row in datagrams.row.tolist()], [len(part) for part in parts])
    pieces = np.array([piece for part in parts for piece in part], np.int64)
    return result._replace(
        hashes=np.where(is_piece, pieces[:, 0], result.hashes),
        size=np.where(is_piece, pieces[:, 1], result.size),
    )
