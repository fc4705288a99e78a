"""A relay's statistics as text for Prometheus (exposition format 0.0.4).

Counters count from the relay's start. A histogram has no sum, which the relay does not measure. Its
limits are powers of two in ns, because there the relay's own buckets end.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Literal, NamedTuple

from netem.control.emulator_statistics import DirectionStatistics, LinkStatistics, Statistics
from netem.core.clock import NS_PER_S
from netem.relay.relay_reports import DIRECTIONS

METRICS_TYPE = "text/plain; version=0.0.4; charset=utf-8"
_PREFIX = "noack_netem_"
_DELAY_BITS, _LATENESS_BITS = range(16, 36), range(10, 30)
"""Limits of the histograms, as powers of two in ns: 66 µs to 34 s, and 1 µs to 0.5 s."""

Labels = Mapping[str, str]
Values = Sequence[tuple[Labels, float]]
"""Values by further labels."""


class _Family(NamedTuple):
    """A metric of each link, or of each direction of each link."""

    name: str
    kind: Literal["counter", "gauge"]
    meaning: str


class _LinkFamily(NamedTuple):
    family: _Family
    value: Callable[[LinkStatistics], int]


class _DirectionFamily(NamedTuple):
    family: _Family
    values: Callable[[DirectionStatistics], Values]


def _one(value: float | None) -> Values:
    return [] if value is None else [({}, value)]


def _each(label: str, values: Mapping[str, int]) -> Values:
    return [({label: name}, value) for name, value in values.items()]


_OF_LINKS = (
    _LinkFamily(_Family("clients", "gauge", "Present clients."), lambda link: link["clients"]),
    _LinkFamily(
        _Family("clients_total", "counter", "Clients since the start."), lambda link: link["clients_ever"]
    ),
    _LinkFamily(
        _Family("refused_packets_total", "counter", "Packets of clients beyond the maximum number."),
        lambda link: link["refused"],
    ),
    _LinkFamily(
        _Family("discarded_packets_total", "counter", "Answers to a link without a reverse direction."),
        lambda link: link["discarded"],
    ),
    _LinkFamily(
        _Family("port_unreachable_total", "counter", "ICMP messages that nothing listens at the server."),
        lambda link: link["port_unreachable"],
    ),
)
_OF_DIRECTIONS = (
    _DirectionFamily(
        _Family("received_packets_total", "counter", "Received packets."),
        lambda side: _one(side["received"]),
    ),
    _DirectionFamily(
        _Family("received_bytes_total", "counter", "Bytes of the payload of received packets."),
        lambda side: _one(side["received_bytes"]),
    ),
    _DirectionFamily(
        _Family("forwarded_packets_total", "counter", "Forwarded packets and copies."),
        lambda side: _one(side["forwarded"]),
    ),
    _DirectionFamily(
        _Family("forwarded_bytes_total", "counter", "Bytes of the payload of forwarded packets."),
        lambda side: _one(side["forwarded_bytes"]),
    ),
    _DirectionFamily(
        _Family("packets_total", "counter", "Packets by what the emulator decided."),
        lambda side: _each("fate", side["fates"]),
    ),
    _DirectionFamily(
        _Family("duplicated_packets_total", "counter", "Copies."), lambda side: _one(side["duplicated"])
    ),
    _DirectionFamily(
        _Family("out_of_order_packets_total", "counter", "Packets forwarded after a newer one (stale)."),
        lambda side: _one(side["delivered_out_of_order"]),
    ),
    _DirectionFamily(
        _Family("held_back_packets_total", "counter", "Packets held back for the guarantee."),
        lambda side: _one(side["held_back"]),
    ),
    _DirectionFamily(
        _Family("unintended_losses_total", "counter", "Host drops; any of them voids the guarantee."),
        lambda side: _each("cause", side["unintended"]),
    ),
    _DirectionFamily(
        _Family("in_flight_packets", "gauge", "Packets that are delayed or queued now."),
        lambda side: _one(side["in_flight"]),
    ),
    _DirectionFamily(
        _Family("longest_loss_burst_packets", "gauge", "Longest loss burst since the settings applied."),
        lambda side: _one(side["longest_loss_burst"]),
    ),
    _DirectionFamily(
        _Family("mansd_packets", "gauge", "Most losses in a row that the guarantee allows."),
        lambda side: _one(side["mansd"]),
    ),
    _DirectionFamily(
        _Family("predicted_loss_ratio", "gauge", "Expected share of dropped or corrupted packets."),
        lambda side: _one(side["loss"]["predicted"]),
    ),
)


def metrics_text(statistics: Statistics) -> str:
    """Return the text that Prometheus reads."""
    return "\n".join(_lines(statistics)) + "\n"


def _lines(statistics: Statistics) -> Iterator[str]:
    links = statistics["links"]
    yield from _head(_Family("uptime_seconds", "gauge", "Time since the relay started."))
    yield _sample("uptime_seconds", {}, statistics["elapsed_s"])
    for family, value in _OF_LINKS:
        yield from _head(family)
        for link in links:
            yield _sample(family.name, {"link": link["name"]}, value(link))
    sides = [({"link": link["name"], "direction": name}, link[name]) for link in links for name in DIRECTIONS]
    for family, values in _OF_DIRECTIONS:
        yield from _head(family)
        for labels, side in sides:
            for further, number in values(side):
                yield _sample(family.name, {**labels, **further}, number)
    yield from _heading("delay_seconds", "histogram", "Time from arrival to departure.")
    for labels, side in sides:
        yield from _histogram("delay_seconds", labels, side["delay_histogram"], _DELAY_BITS)
    yield from _heading("lateness_seconds", "histogram", "Time by which delayed packets departed late.")
    for labels, side in sides:
        yield from _histogram("lateness_seconds", labels, side["lateness_histogram"], _LATENESS_BITS)


def _head(family: _Family) -> Iterator[str]:
    return _heading(family.name, family.kind, family.meaning)


def _heading(name: str, kind: str, meaning: str) -> Iterator[str]:
    yield f"# HELP {_PREFIX}{name} {meaning}"
    yield f"# TYPE {_PREFIX}{name} {kind}"


def _sample(name: str, labels: Labels, value: float) -> str:
    inside = ",".join(f'{label}="{_escaped(text)}"' for label, text in labels.items())
    return f"{_PREFIX}{name}{f'{{{inside}}}' if inside else ''} {value!r}"


def _escaped(text: str) -> str:
    return text.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")


def _histogram(name: str, labels: Labels, counts: Sequence[Sequence[int]], bits: range) -> Iterator[str]:
    """Yield the samples of a histogram of pairs of a bucket's lower limit in ns and its count."""
    for bit in bits:
        below = sum(count for start_ns, count in counts if start_ns < 1 << bit)
        limit_s = ((1 << bit) - 1) / NS_PER_S  # times are whole ns: at most this is below the power
        yield _sample(f"{name}_bucket", {**labels, "le": repr(limit_s)}, below)
    total = sum(count for _, count in counts)
    yield _sample(f"{name}_bucket", {**labels, "le": "+Inf"}, total)
    yield _sample(f"{name}_count", labels, total)
