"""Files that settings name: loss traces, observed delays, ``tc`` tables."""

import json

from noack.impairments.kinds.delay import Delay
from noack.impairments.kinds.loss import LossOf
from noack.impairments.link_settings import LinkSettings, read_files
from noack.impairments.loss_models.trace import TraceLoss
from tests.fuzz.harness import refusal, workspace

SEEDS = [
    b"\x0000 1\n1", b"\x010.01\n12.5ms\n-5ns\n# one", b"\x02-8192 0\n8192 99999", b"\x0301",
]  # fmt: skip
WORDS = [b"1e-3", b"1e400", b"ms", b"us", b"ns", b"#", b"\n", b"\xff", b"-", b"3600.1"]


def one_input(data: bytes) -> None:
    kind, content = data[:1], data[1:]
    name = "any.dist" if kind == b"\2" else "any.txt"
    (workspace() / name).write_bytes(content)
    impairment = {
        b"\1": Delay(distribution="empirical", file=name),
        b"\2": Delay(jitter_s=0.5, distribution="empirical", file=name),
    }.get(kind, LossOf(loss=TraceLoss(file=name, repeat=kind == b"\0")))
    settings = LinkSettings(impairments=(impairment,))
    with refusal("links.toml: forward.impairments.0"):
        read = read_files(settings, workspace(), "links.toml: forward")
        # The loaded settings satisfy the validation of settings.
        assert LinkSettings.model_validate_json(json.dumps(read.model_dump(mode="json"))) == read
