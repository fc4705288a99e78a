"""A relay's statistics as lines of text: numbers with units, one line for each direction."""

from collections.abc import Iterator

from netem.control.emulator_statistics import DirectionStatistics, LinkStatistics, Statistics
from netem.core.number_format import counted, with_unit
from netem.relay.relay_reports import DIRECTIONS

_NONE = "–"
_BIT_RATES = ("Gbit/s", "Mbit/s", "kbit/s", "bit/s")
_LOST = ("dropped", "corrupted", "overflowed", "blacked_out")


def rate_text(per_s: float) -> str:
    """Datagrams per second."""
    return f"{per_s:,.0f}/s" if per_s >= 10 or per_s == 0 else f"{per_s:.2g}/s"


def time_text(t_ns: float | None) -> str:
    """A duration, with three digits."""
    return _NONE if t_ns is None else with_unit(t_ns, ("s", "ms", "µs", "ns"))


def percent_text(share: float | None) -> str:
    """A share in percent, to 0.01 % below 10 %."""
    if share is None:
        return _NONE
    percent = 100 * share
    if percent == 0 or percent >= 99.995:
        return f"{percent:.0f} %"
    if percent < 0.0995:
        return f"{percent:.2g} %"
    return f"{percent:.1f} %" if percent >= 9.995 else f"{percent:.2f} %"


def statistics_lines(statistics: Statistics) -> Iterator[str]:
    """Yield a line for each direction that has received datagrams, and one for a link without any."""
    for link in statistics["links"]:
        start = f"{statistics['elapsed_s']:.1f} s  {link['name']}"
        in_use = [name for name in DIRECTIONS if link[name]["received"]]
        for name in in_use:
            yield f"{start} {name}  {'  '.join(_direction_parts(link[name]))}"
        if not in_use:
            yield f"{start}  no datagrams received"
        if problems := list(_client_problems(link)):
            yield f"{start}  {', '.join(problems)}"


def _direction_parts(side: DirectionStatistics) -> Iterator[str]:
    yield f"received {_traffic_text(side, 'received')}"
    yield f"forwarded {_traffic_text(side, 'forwarded')}"
    yield f"loss {_loss_text(side)}"
    yield f"drawn {_drawn_text(side)}"
    yield f"lost {_lost_text(side)}"
    yield f"longest loss burst {_burst_text(side)}"
    yield f"forced {side['fates']['forced']:,}"
    delay_ns = (side["recent"] or side)["delay_ns"]
    yield f"delay p50 {time_text(delay_ns['p50'])}, p99 {time_text(delay_ns['p99'])}"
    yield f"in flight {side['in_flight']:,}"
    for cause, number in side["unintended"].items():
        if number:
            yield f"UNINTENDED {number:,} {cause}"


def _client_problems(link: LinkStatistics) -> Iterator[str]:
    if link["refused"]:
        yield f"{counted(link['refused'], 'datagram')} of further clients refused"
    if link["port_unreachable"]:
        yield f"port unreachable {counted(link['port_unreachable'], 'time')}"
    if link["discarded"]:
        yield f"{counted(link['discarded'], 'answer')} discarded"


def _traffic_text(side: DirectionStatistics, key: str) -> str:
    """Return the number of datagrams, and the recent rates of datagrams and bits if they are known."""
    count = f"{side[key]:,}"  # type: ignore[literal-required]
    if (recent := side["recent"]) is None:
        return count
    bits_per_s = with_unit(recent[f"{key}_bits_per_s"], _BIT_RATES)  # type: ignore[literal-required]
    return f"{count} ({rate_text(recent[f'{key}_per_s'])}, {bits_per_s})"  # type: ignore[literal-required]


def _loss_text(side: DirectionStatistics) -> str:
    lost, realised = side["loss"]["lost"], side["loss"]["realised"]
    stale = f", with stale {percent_text(realised)}" if realised != lost else ""
    new = f"{side['received'] - side['received_before']:,}"
    base = f" of the {new} since the last change" if side["received_before"] else ""
    return percent_text(lost) + stale + base


def _drawn_text(side: DirectionStatistics) -> str:
    drawn, predicted = side["loss"]["drawn"], side["loss"]["predicted"]
    interval = side["loss"]["drawn_interval"]
    if predicted is None or interval is None:
        return percent_text(drawn)
    low, high = map(percent_text, interval)
    return f"{percent_text(drawn)} (95 %: {low} to {high}), predicted {percent_text(predicted)}"


def _lost_text(side: DirectionStatistics) -> str:
    lost = [(fate.replace("_", " "), side["fates"][fate]) for fate in _LOST]
    lost.append(("stale", side["delivered_out_of_order"]))
    return ", ".join(f"{number:,} {cause}" for cause, number in lost if number) or "0"


def _burst_text(side: DirectionStatistics) -> str:
    """Return the longest loss burst beside its cap, and the constraints."""
    cap = side["mansd"]
    limits = ["no cap" if cap is None else f"cap {cap:,}", *side["constraints"]]
    return f"{side['longest_loss_burst']:,}, {', '.join(limits)}"
