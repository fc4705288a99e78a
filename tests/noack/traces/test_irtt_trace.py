"""Round trips of IRTT, in the format that its manual page describes."""

import gzip
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from noack.traces.irtt_trace import read_irtt
from noack.traces.packet_trace import MAX_PACKETS
from noack.traces.trace_formats import read_trace

COUNT = 700


def document(count: int = COUNT) -> dict[str, Any]:
    lost = {3: True, 5: "true_up", 6: "true_down", 7: "true_down"}
    trips = []
    for k in range(count):
        send = {"wall": 1508180723502727340 + k, "monotonic": 1000 + k * 20_000_000}
        receive = {} if k in lost else {"wall": 1, "monotonic": send["monotonic"] + 30_000_000 + k}
        trips.append({
            "seqno": k, "lost": lost.get(k, "false" if k % 2 else False),
            "timestamps": {
                "client": {"receive": receive, "send": send},
                "server": {"receive": {}, "send": {}}, "late": False,
            },
            "delay": {}, "ipdv": {},
        })  # fmt: skip
    return {
        "version": {"irtt": "0.9.0"}, "system_info": {"hostname": 'a "round_trips\\" host é'},
        "stats": {"rtt": {"n": 1}}, "round_trips": trips,
    }  # fmt: skip


@pytest.mark.parametrize("indent", [None, 4])
@pytest.mark.parametrize("compress", [False, True])
def test_round_trips_are_read(indent: int | None, compress: bool, tmp_path: Path) -> None:
    data = json.dumps(document(), indent=indent, ensure_ascii=False).encode()
    path = tmp_path / "irtt.json"
    path.write_bytes(gzip.compress(data) if compress else data)
    trace = read_trace(path)
    assert np.flatnonzero(trace.lost).tolist() == [3, 5, 6, 7]
    assert trace.sent_ns.tolist() == [k * 20_000_000 for k in range(COUNT)]
    kept = [k for k in range(COUNT) if k not in (3, 5, 6, 7)]
    assert trace.delay_ns[kept].tolist() == [30_000_000 + k for k in kept]
    assert trace.notes[1:] == ("lost forward: 1", "lost in reverse: 2", "lost on an unknown way: 1")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.pop("round_trips"), 'has no list "round_trips"'),
        (lambda d: d.update(round_trips=5), 'has no list "round_trips"'),
        (lambda d: d["round_trips"][4].pop("seqno"), "round trip 5: expected seqno, lost"),
        (lambda d: d["round_trips"][4].update(lost="maybe"), "round trip 5: expected"),
        (lambda d: d["round_trips"].insert(9, 7), "round trip 10: expected"),
        (lambda d: d["round_trips"][8].update(seqno=7), "round trip 9: has a sequence number that"),
        (lambda d: d["round_trips"][8].update(seqno=2**62), "round trip 9: has a number"),
        (lambda d: d["round_trips"][0].update(ipdv="x" * 200_000), "more than 65536 characters"),
    ],
)
def test_wrong_documents(change: Any, message: str) -> None:
    content = document(20)
    content["system_info"] = {}
    change(content)
    with pytest.raises(ValueError, match=message):
        read_irtt(io.BytesIO(json.dumps(content).encode()), MAX_PACKETS)
