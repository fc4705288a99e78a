"""``netem --explain``: explains the effect of links' settings, and relays nothing."""

import json
import textwrap
from collections.abc import Sequence
from typing import Any

import tomli_w
from pydantic import BaseModel
from rich.console import Console
from rich.table import Table
from rich.text import Text

from netem.engine.relay_interface import LinkSpec
from netem.words.tc_command import TcCommand, tc_command
from netem.words.words_to_settings import text_of
from noack.core.errors import shortened
from noack.impairments.link_settings import LinkSettings
from noack.impairments.loss_prediction import expected_loss, with_kept_loss
from noack.runtime.address import text_of as address_text

_MAX_TOML = 4000
_NARROW_WIDTH, _WIDE_WIDTH = 20, 44
"""Minimum and maximum columns for words."""


def explain(
    specs: Sequence[LinkSpec], written: Sequence[LinkSpec], *, as_json: bool, as_file: bool
) -> None:
    """Print the effect of links' settings on standard output, as tables or as JSON.

    Args:
        specs: the links.
        written: the same links, with the names of files instead of their content: what tables show.
        as_json: JSON, with the content.
        as_file: tables have the links as a file of links instead of their names.
    """
    if as_json:
        links = [
            {
                "name": spec.name, "listen": address_text(spec.listen),
                "to": address_text(spec.to), "seed": spec.seed, "forward": _document(spec.forward),
                "reverse": _document(spec.reverse) if spec.return_path else None,
            }
            for spec in specs
        ]  # fmt: skip
        print(json.dumps({"links": links}, indent=2))
        return
    console = Console(highlight=False)
    for number, (spec, named) in enumerate(zip(specs, written, strict=True)):
        if number:
            console.print()
        if not as_file:
            seed = f", seed {spec.seed}" if spec.seed else ""
            addresses = f"{address_text(spec.listen)} → {address_text(spec.to)}"
            console.print(Text(f"{spec.name}: {addresses}{seed}", "bold underline"))
        _print_link(console, spec, named)
        if as_file:
            console.print(Text("\nas a file of links (--links)", "bold"))
            toml = tomli_w.dumps({"link": [_link_table(named)]}).strip()
            console.print(Text(shortened(toml, _MAX_TOML)), soft_wrap=True)  # for copying


def _document(settings: LinkSettings) -> dict[str, Any]:
    prediction, tc = expected_loss(settings), tc_command(settings)
    return {
        "words": text_of(settings),
        "settings": settings.model_dump(mode="json", exclude_none=True),
        "meaning": [one.meaning() for one in settings.impairments]
        + [f"{words}: {meaning}" for words, meaning in settings_meaning(settings)],
        "predicted_loss": prediction.rate,
        "predicted_loss_note": prediction.note,
        "predicted_loss_without_cap": expected_loss(_uncapped(settings)).rate,
        "tc": tc.words,
        "tc_lacks": list(tc.lacks),
        "tc_notes": list(tc.notes),
    }


def settings_meaning(settings: LinkSettings) -> list[tuple[str, str]]:
    """Return (words, meaning) of the cap and the other settings."""
    found = []
    if settings.mansd is not None:
        found.append((
            f"mansd {settings.mansd}",
            f"the cap (M − 1): at most {settings.mansd} consecutive packets of a flow are not "
            "delivered; the next one is always delivered",
        ))  # fmt: skip
    found += [(one.text(), one.meaning()) for one in settings.constraints]
    if settings.first_delivered:
        found.append((
            "first",
            "the first packet of each flow is always delivered; the cap for later packets is mansd",
        ))  # fmt: skip
    if any(one.delays for one in settings.impairments):
        found.append((
            f"limit {settings.limit}",
            f"at most {settings.limit} packets are delayed at once; more are dropped",
        ))  # fmt: skip
    return found


def _print_link(console: Console, spec: LinkSpec, named: LinkSpec) -> None:
    if spec.return_path and spec.forward == spec.reverse:
        _print_direction(console, "both directions, each by itself", spec.forward, named.forward)
        return
    _print_direction(console, "forward, from clients to the server", spec.forward, named.forward)
    console.print()
    if spec.return_path:
        title = "reverse, from the server to clients"
        _print_direction(console, title, spec.reverse, named.reverse)
    else:
        console.print(Text("reverse: not relayed; the server's answers are discarded", "bold"))


def _print_direction(
    console: Console, title: str, settings: LinkSettings, named: LinkSettings
) -> None:
    if settings == LinkSettings():
        console.print(Text(f"{title}: no impairment", "bold"))
        return
    console.print(Text(f"{title}, in this order", "bold"))
    console.print(_table(settings, named, console.width))
    console.print(Text(f"\nexpected loss rate: {_rate_text(settings)}"))
    _print_tc(console, tc_command(settings, named))


def _table(settings: LinkSettings, named: LinkSettings, width: int) -> Table:
    table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, show_header=False)
    table.add_column(justify="right", style="dim")
    most = min(max(2 * width // 5, _NARROW_WIDTH), _WIDE_WIDTH)
    table.add_column(max_width=most, overflow="fold", style="bold")
    table.add_column(overflow="fold")
    pairs = zip(settings.impairments, named.impairments, strict=True)
    for number, (one, other) in enumerate(pairs, 1):
        # As text: a bracket in a file's name is not markup.
        words, meaning = shortened(other.text(), 200), one.meaning()
        table.add_row(str(number), Text(words), Text(meaning))
    if not settings.impairments:
        table.add_row("", "", "no impairment")
    for words, meaning in settings_meaning(settings):
        table.add_row("", words, meaning)
    return table


def _rate_text(settings: LinkSettings) -> str:
    prediction = expected_loss(settings)
    if prediction.rate is None:
        return f"not known: {prediction.note}"
    text = f"{100 * prediction.rate:.4g}%"
    without = expected_loss(_uncapped(settings)).rate
    if without is not None and settings.longest_burst is not None:
        text += f" (without the guarantee {100 * without:.4g}%)"
    return f"{text}, {prediction.note}" if prediction.note else text


def _print_tc(console: Console, tc: TcCommand) -> None:
    lacks = ", ".join(tc.lacks)
    if tc.words is None:
        console.print(Text(f"not possible with tc, which lacks: {lacks}"))
        return
    console.print(Text("nearest command of tc, for a network device:"))
    command = textwrap.wrap(
        f"tc qdisc add dev DEVICE root netem {tc.words}", max(console.width - 2, _NARROW_WIDTH),
        initial_indent="  ", subsequent_indent="      ",
        break_long_words=False, break_on_hyphens=False,
    )  # fmt: skip
    console.print(Text(" \\\n".join(command)), soft_wrap=True)
    if lacks:
        console.print(Text(f"tc lacks: {lacks}"))
    for note in tc.notes:
        console.print(Text(f"difference: {note}"))


def _uncapped(settings: LinkSettings) -> LinkSettings:
    """Return settings without the guarantee, which lose with the same probabilities."""
    return with_kept_loss(settings).model_copy(update={"mansd": None, "constraints": ()})


def _link_table(spec: LinkSpec) -> dict[str, Any]:
    """Return a link's table in a file of links, without default values."""
    table: dict[str, Any] = {
        "name": spec.name, "listen": address_text(spec.listen), "to": address_text(spec.to),
    }  # fmt: skip
    for key in ("seed", "return_path", "idle_s"):
        if getattr(spec, key) != getattr(LinkSpec, key):
            table[key] = getattr(spec, key)
    sides = {"forward": _given(spec.forward), "reverse": _given(spec.reverse)}
    return table | {name: side for name, side in sides.items() if side}


def _given(section: BaseModel) -> dict[str, Any]:
    """Return the keys of a section that differ from their defaults, and its kind."""
    return {
        key: _plain(getattr(section, key))
        for key, field in type(section).model_fields.items()
        if key in ("kind", "model") or getattr(section, key) != field.default
    }


def _plain(value: Any) -> Any:
    if isinstance(value, BaseModel):
        return _given(value)
    return [_plain(entry) for entry in value] if isinstance(value, tuple) else value
