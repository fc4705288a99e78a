"""Datagrams at both ends of a live probe: valid ones with changed fields, and any bytes."""

from cosim.measurement.live.probe_ends import ProbePlan, ProbeReceiver, ProbeSender
from noack.core.errors import PeerError
from noack.protocol.probe_format import ProbeDatagram, ProbeKind, encode_probe
from tests.fuzz.choices import Choices
from tests.fuzz.harness import refusal

_PERIOD_NS = 20_000_000
_FIELDS = ("session", "host", "sequence", "sent_ns", "start_ns", "period_ns", "planned", "number",
           "newest", "seen")  # fmt: skip
_SIGNED = ("sent_ns", "start_ns")


def one_input(data: bytes) -> None:
    choices = Choices(data)
    receiver = ProbeReceiver(5, 0, 10**9)
    sender = ProbeSender(ProbePlan(_PERIOD_NS, 20, is_round_trip=True), 1, 5, 0)
    for _ in range(4):
        sender.on_timer(sender.next_deadline_ns())
    now_ns = 0
    while choices.left and now_ns < 200 * _PERIOD_NS:
        datagram = _datagram(choices, now_ns // _PERIOD_NS)
        now_ns += choices.below(256) * _PERIOD_NS // 8
        answer = receiver.handle(datagram, "somewhere", now_ns)
        assert answer is None or len(answer) == len(datagram)  # never amplifies
        sender.handle(datagram, now_ns)
        if answer is not None:
            sender.handle(answer, now_ns)
        receiver.is_over(now_ns)
    with refusal():
        try:
            found = [sender.finish(0), receiver.finish(0)]
        except ValueError as error:
            raise PeerError(str(error)) from None
        for one in found:
            assert one is None or one.trace is None or len(one.trace) < 10**7


def _datagram(choices: Choices, place: int) -> bytes:
    kind = choices.one([ProbeKind.PROBE, *ProbeKind])
    content = ProbeDatagram(
        kind, 1, 5, place % 4, max(place, 4) * _PERIOD_NS, 0, _PERIOD_NS, 20, place, place
    )
    for _ in range(choices.below(3)):
        name = choices.one(_FIELDS)
        value = choices.integer() & (2**63 - 1 if name != "seen" else 2**128 - 1)
        sign = -1 if name in _SIGNED and choices.flag() else 1
        content = content._replace(**{name: sign * value})
    datagram = bytearray(encode_probe(content, 100 + choices.below(20)))
    if choices.below(8) == 1:
        datagram[choices.below(len(datagram))] ^= 1 << choices.below(8)
        del datagram[100 + choices.below(20) :]
    return bytes(datagram)
