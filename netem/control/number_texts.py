"""Numbers with units, and small charts of block characters, as the terminal shows them."""

from collections.abc import Sequence

_BLOCKS = "▁▂▃▄▅▆▇█"
NONE = "–"


def rate_text(per_s: float) -> str:
    """Datagrams per second."""
    return f"{per_s:,.0f}/s" if per_s >= 10 or per_s == 0 else f"{per_s:.2g}/s"


def bits_text(bits_per_s: float) -> str:
    """Bits per second, with three digits."""
    return _with_unit(bits_per_s, ("Gbit/s", "Mbit/s", "kbit/s", "bit/s"))


def time_text(t_ns: float | None) -> str:
    """A duration, with three digits."""
    return NONE if t_ns is None else _with_unit(t_ns, ("s", "ms", "µs", "ns"))


def percent_text(share: float | None) -> str:
    """A share in percent, to 0.01 % below 10 %."""
    if share is None:
        return NONE
    percent = 100 * share
    if percent == 0 or percent >= 99.995:
        return f"{percent:.0f} %"
    if percent < 0.0995:
        return f"{percent:.2g} %"
    return f"{percent:.1f} %" if percent >= 9.995 else f"{percent:.2f} %"


def elapsed_text(elapsed_s: float) -> str:
    """Hours, minutes and seconds."""
    minutes, seconds = divmod(int(elapsed_s), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"


def sparkline(values: Sequence[float | None], top: float) -> str:
    """Return one block per value: full height at ``top``, a blank for None."""
    last = len(_BLOCKS) - 1
    return "".join(
        " " if value is None else _BLOCKS[min(max(round(value / (top or 1.0) * last), 0), last)]
        for value in values
    )


def bar(share: float, width: int) -> tuple[str, str]:
    """Return the filled part and the rest of a bar of ``width`` characters."""
    filled = round(min(max(share, 0.0), 1.0) * width)
    return "━" * filled, "─" * (width - filled)


def _with_unit(value: float, units: tuple[str, str, str, str]) -> str:
    """Write a value with three digits in units of 10⁹, 10⁶, 10³ or 1."""
    for unit, size in zip(units, (1e9, 1e6, 1e3), strict=False):
        if value >= 0.9995 * size:
            part = value / size
            digits = 0 if part >= 99.95 else 1 if part >= 9.995 else 2
            return f"{part:.{digits}f} {unit}"
    return f"{value:.0f} {units[-1]}"
