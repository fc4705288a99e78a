"""Files that settings name: losses, delays, ``tc`` tables, packet traces, outages, …"""

import json

from noack.impairments.kinds.blackout import Blackout
from noack.impairments.kinds.delay import Delay
from noack.impairments.kinds.loss import LossOf
from noack.impairments.kinds.opportunities import Opportunities
from noack.impairments.kinds.replay import Replay
from noack.impairments.link_settings import LinkSettings
from noack.impairments.loss_models.trace import TraceLoss
from noack.impairments.loss_prediction import read_files
from tests.fuzz.harness import refusal, workspace

SEEDS = [
    b"\x0000 1\n1", b"\x010.01\n12.5ms\n-5ns\n# one", b"\x02-8192 0\n8192 99999", b"\x0301",
    b"\x04sequence,sent_ms,received_us\n3,0,5000\n\n5,1e1,-1\n4,2.5,\n",
    b"\x05sent_s,received_ns\r\n1700000000.123,1600000000000000000\r\n1700000001,\r\n",
    b"\x060\n0\n12\n12\n", b"\x07# outages\n1s 2500ms\n3s 4s\n",
]  # fmt: skip
WORDS = [
    b"1e-3", b"1e400", b"ms", b"us", b"ns", b"#", b"\n", b"\xff", b"-", b"3600.1", b",", b'"',
    b"sequence", b"sent_ms", b"received_s", b"99999999999999999999", b"9223372036854775807",
]  # fmt: skip


def one_input(data: bytes) -> None:
    kind, content = data[:1], data[1:]
    name = "any.dist" if kind == b"\2" else "any.txt"
    (workspace() / name).write_bytes(content)
    impairment = {
        b"\1": Delay(distribution="empirical", file=name),
        b"\2": Delay(jitter_s=0.5, distribution="empirical", file=name),
        b"\4": Replay(file=name, offset_s=0.5),
        b"\5": Replay(file=name, clocks_differ=True),
        b"\6": Opportunities(file=name, offset_s=0.01),
        b"\7": Blackout(file=name, every_s=1e3),
    }.get(kind, LossOf(loss=TraceLoss(file=name, repeat=kind == b"\0")))
    settings = LinkSettings(impairments=(impairment,))
    with refusal("links.toml: forward.impairments.0"):
        read = read_files(settings, workspace(), "links.toml: forward")
        # The loaded settings satisfy the validation of settings.
        assert LinkSettings.model_validate_json(json.dumps(read.model_dump(mode="json"))) == read
