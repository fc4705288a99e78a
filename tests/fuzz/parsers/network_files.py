"""Files of the network part: logs of ping and fping, reports of iperf3, timetables, presets."""

from itertools import pairwise

import tomli_w

from netem.core.clock import NS_PER_S
from netem.core.toml_file import json_schema
from netem.impairments.link_settings import LinkSettings
from netem.measurement.iperf3_table import iperf3_document
from netem.measurement.trace_sources import SourceOptions, read_files, read_flows
from netem.presets.preset import Preset, shipped_presets
from netem.relay.relay_links import LinkSpec
from netem.relay.relay_reports import DIRECTIONS
from netem.tc_words import settings_of
from netem.timetable_file import read_timetable
from tests.fuzz.edits import Choices, edited, quoted, vocabulary
from tests.fuzz.harness import FOLDER, refusal, workspace

_EXAMPLES = FOLDER.parent / "netem" / "traces"
LOGS_SEEDS = [
    (_EXAMPLES / "ping.txt").read_bytes(),
    b"PING ::1(::1) 56 data bytes\n[1700000000.123456] 64 bytes from ::1: icmp_seq=1 ttl=64 time=0.05 ms\n"
    b"no answer yet for icmp_seq=2\nFrom 192.0.2.1 icmp_seq=3 Destination Host Unreachable\n\n"
    b"--- ::1 ping statistics ---\n4 packets transmitted, 1 received, 75% packet loss, time 3012ms\n",
    b"64 bytes from 192.0.2.1: icmp_seq=65535 ttl=64 time=1 ms\n"
    b"64 bytes from 192.0.2.1: icmp_seq=0 ttl=64 time=2e0 ms\nRequest timeout for icmp_seq 1\n",
    b"[1700000000.1] host : [0], 64 bytes, 0.05 ms (0.05 avg, 0% loss)\n"
    b"[1700000001.1] host : [1], timed out (NaN avg, 50% loss)\n"
    b"[1700000001.2] other : [0], 64 bytes, 1.25 ms (1.25 avg, 0% loss)\n",
    b"host : 0.05 0.06 - 0.04\nother : - - 1.5 -\n",
]  # fmt: skip
LOGS_WORDS = [
    b"icmp_seq=", b"seq=4294967296", b"time=", b"-1", b"1e400", b"NaN", b"PING ", b"[", b"]", b"\n", b"\xff",
    b"99999999999999999999 packets transmitted, 0 received, time 0ms", b", time 999999999999999ms", b" : ",
]  # fmt: skip
REPORTS_SEEDS = [(_EXAMPLES / f"iperf3_{end}.json").read_bytes() for end in ("sender", "receiver")]
REPORTS_WORDS = [b'"packets":', b'"lost_packets":', b"-1", b"1e999", b"null", b"{}", b"[]", b'"udp"', b"true"]
TIMETABLES_SEEDS = [
    b'time_s,words\n0,delay 20ms\n10,loss burst 30% 5 delay 80ms 20ms\n12.5,"blackout 0s-1s,2s-3s"\n',
    b"\xef\xbb\xbftime_s, link, direction, words\n0,one,both,like dsl\n.5,two,forward,loss none\n",
    b"words,time_s\r\nrate 1mbit queue 5ms burst 3kb,1e3\r\n",
]  # fmt: skip
TIMETABLES_WORDS = [
    b",", b'"', b"\n", b"time_s", b"1e9", b"1000000001", b"-1", b"nan", b"both", b"reverse", b"two", b"like ",
    b"mansd 3", b"loss trace any.txt", b"loss 30% keep",
]  # fmt: skip
PRESETS_KNOWN = vocabulary(json_schema(Preset), dates=True)
PRESETS_BASES = [preset.model_dump(exclude_none=True) for preset in shipped_presets().values()]
PRESETS_SEEDS = [b'name = "any"\nsentence = "x"\nforward = "loss 5%"\nfit = "by eye"\nis_guess = true\n']


def logs_input(choices: Choices) -> None:
    """In a trace from a log, no packet is received before it was sent."""
    path = workspace() / "log.txt"
    path.write_bytes(choices.near(LOGS_SEEDS, LOGS_WORDS))
    with refusal(str(path)):
        trace = read_files([path], SourceOptions())
        received = trace.received_ns[~trace.lost]
        assert (received >= trace.sent_ns[~trace.lost]).all()
    with refusal((str(path), "--flows: ")):
        assert all(flow.trace is not None and len(flow.trace) for flow in read_flows([path])[0])


def reports_input(choices: Choices) -> None:
    """A report that is read can be printed."""
    path = workspace() / "report.json"
    path.write_bytes(choices.near(REPORTS_SEEDS, REPORTS_WORDS))
    with refusal(str(path)):
        assert iperf3_document(path).blocks


def timetables_input(choices: Choices) -> None:
    """The times of a timetable do not descend, and end before it repeats."""
    path = workspace() / "timetable.csv"
    path.write_bytes(choices.near(TIMETABLES_SEEDS, TIMETABLES_WORDS))
    here, there = ("127.0.0.1", 0), ("127.0.0.1", 9)
    names = choices.choose([("one",), ("one", "two")])
    specs = [LinkSpec(name, here, there, LinkSettings(), LinkSettings()) for name in names]
    repeat_ns = choices.choose([None, 20 * NS_PER_S])
    with refusal(str(path), lines=True):
        changes = read_timetable(path, specs, repeat_ns).timetable.changes
        assert all(earlier.at_ns <= later.at_ns for earlier, later in pairwise(changes))
        assert {change.link for change in changes} <= {*names}
        assert repeat_ns is None or changes[-1].at_ns < repeat_ns


def presets_input(choices: Choices) -> None:
    """The words of a preset that is read are settings."""
    path = workspace() / "any.toml"
    if choices.below(4):
        base = choices.choose(PRESETS_BASES) | {"name": "any"}
        path.write_text(tomli_w.dumps(edited(choices, base, PRESETS_KNOWN)))
    else:
        path.write_bytes(choices.near(PRESETS_SEEDS, quoted(PRESETS_KNOWN)))
    with refusal(("like ./any.toml: ", str(path)), lines=True):
        for direction in DIRECTIONS:
            settings_of("like ./any.toml", direction=direction, folder=workspace())


PARSERS = {
    "logs": logs_input,
    "reports": reports_input,
    "timetables": timetables_input,
    "presets": presets_input,
}
