"""Figures as a person reads them: numbers with units, small charts of blocks."""

from collections.abc import Sequence

_BLOCKS = "▁▂▃▄▅▆▇█"
NONE = "–"


def rate_text(per_s: float) -> str:
    """Datagrams per second."""
    return f"{per_s:,.0f}/s" if per_s >= 10 or per_s == 0 else f"{per_s:.2g}/s"


def bits_text(bits_per_s: float) -> str:
    """Bits per second, with three digits."""
    for unit, size in (("Gbit/s", 1e9), ("Mbit/s", 1e6), ("kbit/s", 1e3)):
        if bits_per_s >= 0.9995 * size:
            return f"{_three_digits(bits_per_s / size)} {unit}"
    return f"{bits_per_s:.0f} bit/s"


def time_text(t_ns: float | None) -> str:
    """A duration, with three digits."""
    if t_ns is None:
        return NONE
    for unit, size in (("s", 1e9), ("ms", 1e6), ("µs", 1e3)):
        if t_ns >= 0.9995 * size:
            return f"{_three_digits(t_ns / size)} {unit}"
    return f"{t_ns:.0f} ns"


def percent_text(share: float | None) -> str:
    """A share in percent, to 0.01 % below 10 %."""
    if share is None:
        return NONE
    percent = 100 * share
    if percent == 0 or percent >= 99.995:
        return f"{percent:.0f} %"
    return f"{percent:.1f} %" if percent >= 9.995 else f"{percent:.2g} %" if (
        percent < 0.0995
    ) else f"{percent:.2f} %"  # fmt: skip


def elapsed_text(elapsed_s: float) -> str:
    """Hours, minutes and seconds."""
    minutes, seconds = divmod(int(elapsed_s), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"


def sparkline(values: Sequence[float | None], top: float) -> str:
    """Return one block for each value: of full height at ``top``, none where there is no value."""
    if top <= 0:
        top = 1.0
    last = len(_BLOCKS) - 1
    return "".join(
        " " if value is None else _BLOCKS[min(max(round(value / top * last), 0), last)]
        for value in values
    )


def bar(share: float, width: int) -> tuple[str, str]:
    """Return the filled part and the rest of a bar of ``width`` characters."""
    filled = round(min(max(share, 0.0), 1.0) * width)
    return "━" * filled, "─" * (width - filled)


def _three_digits(value: float) -> str:
    return (
        f"{value:.0f}" if value >= 99.95 else f"{value:.1f}" if value >= 9.995 else f"{value:.2f}"
    )
