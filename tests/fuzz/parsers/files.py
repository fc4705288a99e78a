"""Files of users and of others: scenarios, campaigns, matrices, traces, captures."""

import io
import json
import struct
import tomllib
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import numpy as np
import tomli_w

from cosim.measurement.run_trace import read_source
from cosim.studies.campaign import campaign_file
from cosim.studies.campaign.campaign_grid import grid
from netem.core.errors import NoackError
from netem.core.named_file import NamedFile
from netem.core.toml_file import json_schema
from netem.impairments.kinds.blackout import Blackout
from netem.impairments.kinds.delay import Delay
from netem.impairments.kinds.loss import LossOf
from netem.impairments.kinds.opportunities import Opportunities
from netem.impairments.kinds.replay import Replay
from netem.impairments.link_settings import LinkSettings
from netem.impairments.loss_models.trace import TraceLoss
from netem.impairments.target_loss import read_files
from netem.measurement.trace_sources import SourceOptions
from noack.scenario.matrix_files import read_matrices
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import dumps, load, validate
from tests.fuzz.edits import Choices, Vocabulary, bases, edited, key, quoted, value, vocabulary, write_named
from tests.fuzz.harness import FOLDER, refusal, workspace
from tests.oracles.capture_files import (
    ETHERNET,
    LINKS,
    Sent,
    fragments_of,
    pcap_of,
    pcap_of_packets,
    pcapng_of,
)

SCENARIO_KNOWN = vocabulary(json_schema(Scenario), dates=True)
SCENARIO_SEEDS = [path.read_bytes() for path in sorted((FOLDER.parents[1] / "scenarios").glob("*.toml"))]
SCENARIO_WORDS = quoted(SCENARIO_KNOWN)
SCENARIO_BASES = bases(
    "scenarios",
    {
        "name": "all",
        "horizon_s": 1.0,
        "model": {"A": [[0.0, 1.0], [0.0, 0.0]], "B": [[0.0], [1.0]], "gain": [[-1.0, -1.5]]},
        "plant": {
            "initial_state": [1.0, 0.0], "initial_state_halfwidth": [0.1, 0.0], "draw": "vertex",
            "uncertainty_A": [[0.1, 0.0], [0.0, 0.1]],
        },
        "trigger": {"policy": "dynamic", "sigma": 0.1, "decay_per_s": 1.0, "theta": 1.0},
        "network": {
            "mansd": 2,
            "loss": {"model": "trace", "file": "trace.txt"},
            "impairments": [
                {"kind": "delay", "distribution": "empirical", "file": "delays.txt"},
                {"kind": "reorder", "probability": 0.1},
                {"kind": "rate", "rate_bps": 1_000_000},
                {"kind": "blackout", "intervals_s": [[0.1, 0.2]]},
            ],
        },
    },
)  # fmt: skip


def scenario_input(choices: Choices) -> None:
    """A scenario is refused with all mistakes, or reads back the same, also when resolved."""
    overrides: list[str] = []
    if choices.below(4):
        base = choices.choose(SCENARIO_BASES)
        for _ in range(choices.below(3)):
            name = ".".join(key(choices, SCENARIO_KNOWN) for _ in range(1 + choices.below(3)))
            overrides.append(f"{name}={_written(choices)}" if choices.below(8) else name)
        data = tomli_w.dumps(edited(choices, base, SCENARIO_KNOWN)).encode()
    else:
        data = choices.near(SCENARIO_SEEDS, SCENARIO_WORDS)
    path = write_named(workspace(), "scenario.toml", data)
    with refusal((str(path), "--set"), lines=True):
        scenario = load(path, overrides)
        _assert_reads_back(scenario)
        with refusal():
            resolved = resolve(scenario)
            _assert_reads_back(resolved)
            assert resolve(resolved) == resolved


def _written(choices: Choices) -> str:
    """Return a value of ``--set``, as TOML or as any text."""
    if choices.below(4) == 0:
        return choices.text()
    content: dict[str, Any] = {"x": value(choices, SCENARIO_KNOWN)}
    return tomli_w.dumps(content).partition("=")[2].strip()


def _assert_reads_back(scenario: Scenario) -> None:
    text = dumps(scenario)
    assert validate(tomllib.loads(text), "again") == scenario
    assert dumps(validate(tomllib.loads(text), "again")) == text


_SCHEMA = vocabulary(campaign_file.json_schema(), dates=True)
CAMPAIGN_KNOWN = Vocabulary(
    (*_SCHEMA.keys, "network.mansd", "trigger.beta", "trigger", "network.loss", "plant.rate_hz"),
    (*_SCHEMA.words, "lane_following", "decaying", "network.mansd", "beta", "policy"),
    dates=True,
)
CAMPAIGN_SEEDS = [path.read_bytes() for path in sorted((FOLDER.parents[1] / "campaigns").glob("*.toml"))]
CAMPAIGN_WORDS = quoted(CAMPAIGN_KNOWN)
CAMPAIGN_BASES = bases("campaigns")
_MOST_POINTS = 8
"""Grid points for which scenarios are made; more points would add no coverage."""


def campaign_input(choices: Choices) -> None:
    """A campaign is refused, or its grid can be made."""
    if choices.below(4):
        data = tomli_w.dumps(edited(choices, choices.choose(CAMPAIGN_BASES), CAMPAIGN_KNOWN)).encode()
    else:
        data = choices.near(CAMPAIGN_SEEDS, CAMPAIGN_WORDS)
    path = write_named(workspace(), "campaign.toml", data)
    with refusal(str(path), lines=True):
        campaign = campaign_file.load(path)
        chosen = list(campaign.selected({}))[:_MOST_POINTS]
        shorter = campaign.model_copy()
        # Skip the computation of each point's guarantee: it is not part of parsing.
        with (
            patch("cosim.studies.campaign.campaign_grid.certified_error", return_value=None),
            patch.object(type(campaign), "selected", lambda *_: iter(chosen)),
        ):
            try:
                grid(shorter, path)
            except NoackError as error:
                # Mistakes in the scenario itself are in another file.
                if not str(error).startswith(str(path)):
                    with refusal(lines=True):
                        raise
                    return
                raise


def _saved(**arrays: object) -> bytes:
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **{key: np.array(array) for key, array in arrays.items()})
    return file.getvalue()


MATRICES_SEEDS = [
    _saved(A=[[0.0, 1.0], [2.0, 3.0]], B=[[0.0], [1.0]], gain=[[1.0, 2.0]]),
    _saved(A=[[1]], B=[[1]], K=[[1]], C=[[1]], D=[[0]], dt=0.0),
    _saved(A=[[1.0]], B="text"),
    b"PK\x05\x06" + bytes(18),
]
MATRICES_WORDS = [
    b"'descr': '<f8'",
    b"(99999, 99999)",
    b"'|O'",
    b"PK\x01\x02",
    b"\x93NUMPY\x02\x00",
    b".npy",
]


def matrices_input(choices: Choices) -> None:
    """Matrices that are read are finite and two-dimensional."""
    (workspace() / "any.npz").write_bytes(choices.near(MATRICES_SEEDS, MATRICES_WORDS))
    with refusal('run.toml: model.file = "any.npz"'):
        matrices = read_matrices(NamedFile("any.npz", workspace(), "run.toml: model"))
        assert matrices.keys() <= {"A", "B", "gain"}
        assert all(matrix.ndim == 2 and np.isfinite(matrix).all() for matrix in matrices.values())


TRACES_SEEDS = [
    b"\x0000 1\n1", b"\x010.01\n12.5ms\n-5ns\n# one", b"\x02-8192 0\n8192 99999", b"\x0301",
    b"\x04sequence,sent_ms,received_us\n3,0,5000\n\n5,1e1,-1\n4,2.5,\n",
    b"\x05sent_s,received_ns\r\n1700000000.123,1600000000000000000\r\n1700000001,\r\n",
    b"\x060\n0\n12\n12\n", b"\x07# outages\n1s 2500ms\n3s 4s\n",
]  # fmt: skip
TRACES_WORDS = [
    b"1e-3", b"1e400", b"ms", b"us", b"ns", b"#", b"\n", b"\xff", b"-", b"3600.1", b",", b'"',
    b"sequence", b"sent_ms", b"received_s", b"99999999999999999999", b"9223372036854775807",
]  # fmt: skip


def traces_input(choices: Choices) -> None:
    """A trace that is read satisfies the validation of settings."""
    data = choices.near(TRACES_SEEDS, TRACES_WORDS)
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


_PERIOD_NS = 20_000_000
_SENT = [Sent(10**18 + k * _PERIOD_NS, struct.pack(">I", k)) for k in range(6)]
_ARRIVED = [packet._replace(t_ns=packet.t_ns + 5_000_000, interface=1, source_port=7) for packet in _SENT[1:]]
_V6 = [packet._replace(source="2001:db8::1", destination="2001:db8::2") for packet in _SENT]
_LONG = [packet._replace(payload=packet.payload * 9) for packet in _SENT]
_IRTT = json.dumps({
    "version": {"irtt": "0.9.0"},
    "round_trips": [
        {"seqno": k, "lost": k == 2, "timestamps": {"client": {
            "send": {"monotonic": k * _PERIOD_NS}, "receive": {"monotonic": k * _PERIOD_NS + 9},
        }}}
        for k in range(5)
    ],
}).encode()  # fmt: skip
_CAPTURES = [
    pcapng_of(*_SENT, *_ARRIVED),
    pcap_of(*(packet._replace(vlans=(7,)) for packet in _SENT), link_type=ETHERNET),
    pcap_of_packets([(packet.t_ns, part) for packet in _LONG for part in fragments_of(packet, most=16)]),
    pcap_of(*_LONG, snap_bytes=40),
    pcapng_of(*_SENT, dropped=1, dropped_before=1),
    pcap_of(*(_SENT[k] for k in (0, 1, 3, 2, 5)), order=">", nano=False),
    pcapng_of(*_V6, order=">", link_type=ETHERNET),
    *(pcap_of(*_SENT, link_type=link) for link in LINKS),
    _IRTT,
    b"0\n1\n1\n20\n",
]
_SEQUENCE_FIELDS = [None, "0:4", "2:2:little", "0:8", "9999:1", "x"]


def captures_input(choices: Choices) -> None:
    """In a trace from captures, no packet is received before it was sent."""
    path, other = workspace() / "one.pcap", workspace() / "other.pcap"
    options = SourceOptions(
        clocks_differ=choices.choose([None, False, True]),
        flow=choices.choose([1, 2, 3]),
        far_flow=choices.choose([None, 1, 2]),
        sequence_at=choices.choose(_SEQUENCE_FIELDS),
    )
    if options.sequence_at is not None:
        bits, numbers = choices.choose([None, 2, 14]), choices.choose([None, "1..15", "x"])
        options = replace(options, bits=bits, numbers=numbers)
    path.write_bytes(_damaged(choices, choices.choose(_CAPTURES)))
    paths = [path]
    if choices.flag():
        other.write_bytes(pcapng_of(*_ARRIVED) if choices.flag() else path.read_bytes())
        paths.append(other)
    with refusal(
        (
            str(path),
            str(other),
            "expected one file",
            "--sequence-at",
            "--bits",
            "--numbers",
            "--flow",
            "--far-flow",
            "--clocks",
        )
    ):
        trace = read_source(paths, options)
        received = trace.received_ns[~trace.lost]
        assert (received >= trace.sent_ns[~trace.lost]).all()


def _damaged(choices: Choices, content: bytes) -> bytes:
    changed = bytearray(content)
    for _ in range(choices.below(6)):
        at = choices.below(len(changed))
        match choices.below(4):
            case 0:
                changed[at] = choices.below(256)
            case 1:
                changed[at : at + 4] = struct.pack("<I", choices.integer() & 0xFFFF_FFFF)
            case 2:
                del changed[at : at + choices.below(64)]
            case _:
                changed[at:at] = choices.take(choices.below(16))
        if not changed:
            return b""
    return bytes(changed)


PARSERS = {
    "scenario": scenario_input,
    "campaign": campaign_input,
    "matrices": matrices_input,
    "traces": traces_input,
    "captures": captures_input,
}
