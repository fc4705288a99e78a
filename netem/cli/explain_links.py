"""``netem --explain``: what links would do, without doing it."""

import json
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TypedDict

import tomli_w
from pydantic import BaseModel
from rich.console import Console
from rich.table import Table
from rich.text import Text

from netem.engine.relay_interface import LinkSpec
from netem.loss_prediction import LossPrediction, predict
from netem.words.explanation import settings_meaning
from netem.words.tc_command import tc_command
from netem.words.words_to_settings import text_of
from noack.impairments.link_settings import LinkSettings
from noack.runtime.address import text_of as address_text

_NOTHING = LinkSettings()
_FROM_TO = {"forward": "from clients to the server", "back": "from the server to clients"}
_MOST_TOML = 4000
_NARROW_WIDTH, _WIDE_WIDTH = 20, 44
"""Least and most columns for words."""


class DirectionExplanation(TypedDict):
    """What a direction would do."""

    words: str
    settings: Mapping[str, Any]
    meaning: Sequence[str]
    predicted_loss: float | None
    predicted_loss_note: str
    """Why there is none, or what it does not count."""
    predicted_loss_without_cap: float | None
    tc: str | None
    """What comes nearest, after ``tc qdisc add dev DEVICE root netem``."""
    tc_lacks: Sequence[str]
    tc_notes: Sequence[str]


class LinkExplanation(TypedDict):
    """What a link would do."""

    name: str
    listen: str
    to: str
    seed: int
    forward: DirectionExplanation
    back: DirectionExplanation | None
    """None: one way only."""


class Explanation(TypedDict):
    """What a relay would do."""

    links: Sequence[LinkExplanation]


def explain(specs: Sequence[LinkSpec], *, as_json: bool, as_file: bool) -> None:
    """Print what links would do on standard output.

    Args:
        specs: the links.
        as_json: one JSON document instead of tables for people.
        as_file: say what they are in a file of links, too; or they come from one, and say which.
    """
    if as_json:
        links = [_link_document(spec) for spec in specs]
        print(json.dumps(Explanation(links=links), indent=2))
        return
    console = Console(highlight=False)
    for number, spec in enumerate(specs):
        if number:
            console.print()
        if not as_file:
            console.print(Text(_heading(spec), "bold underline"))
        _print_link(console, spec)
        if as_file:
            console.print(Text("\nin a file of links (--links)", "bold"))
            # What is copied must not be broken.
            console.print(Text(_cut("\n".join(_toml(spec)).strip(), _MOST_TOML)), soft_wrap=True)


def _link_document(spec: LinkSpec) -> LinkExplanation:
    return {
        "name": spec.name,
        "listen": address_text(spec.listen),
        "to": address_text(spec.to),
        "seed": spec.seed,
        "forward": _document(spec.forward),
        "back": _document(spec.back) if spec.return_path else None,
    }


def _document(settings: LinkSettings) -> DirectionExplanation:
    prediction, tc = predict(settings), tc_command(settings)
    return {
        "words": text_of(settings),
        "settings": settings.model_dump(mode="json", exclude_none=True),
        "meaning": [one.meaning() for one in settings.impairments]
        + [f"{words}: {meaning}" for words, meaning in settings_meaning(settings)],
        "predicted_loss": prediction.rate,
        "predicted_loss_note": prediction.note,
        "predicted_loss_without_cap": predict(_uncapped(settings)).rate,
        "tc": tc.words,
        "tc_lacks": list(tc.lacks),
        "tc_notes": list(tc.notes),
    }


def _heading(spec: LinkSpec) -> str:
    seed = f", seed {spec.seed}" if spec.seed else ""
    return f"{spec.name}: {address_text(spec.listen)} → {address_text(spec.to)}{seed}"


def _print_link(console: Console, spec: LinkSpec) -> None:
    if spec.return_path and spec.forward == spec.back:
        _print_direction(console, "in both directions, in each by itself", spec.forward)
        return
    _print_direction(console, f"forward, {_FROM_TO['forward']}", spec.forward)
    console.print()
    if spec.return_path:
        _print_direction(console, f"back, {_FROM_TO['back']}", spec.back)
    else:
        console.print(Text("back: one way only, what the server answers is not relayed", "bold"))


def _print_direction(console: Console, title: str, settings: LinkSettings) -> None:
    if settings == _NOTHING:
        console.print(Text(f"{title}: nothing happens", "bold"))
        return
    console.print(Text(f"{title}, in this order", "bold"))
    console.print(_table(settings, console.width))
    console.print(Text(f"\n{_loss_line(settings)}"))
    _print_tc(console, settings)


def _table(settings: LinkSettings, width: int) -> Table:
    table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, show_header=False)
    table.add_column(justify="right", style="dim")
    most = min(max(2 * width // 5, _NARROW_WIDTH), _WIDE_WIDTH)
    table.add_column(max_width=most, overflow="fold", style="bold")
    table.add_column(overflow="fold")
    for number, one in enumerate(settings.impairments, 1):
        # As text: a bracket in a file's name is no markup.
        words, meaning = _cut(one.text(), 200), one.meaning()
        table.add_row(str(number), Text(words), Text(meaning))
    if not settings.impairments:
        table.add_row("", "", "it passes")
    for words, meaning in settings_meaning(settings):
        table.add_row("", words, meaning)
    return table


def _loss_line(settings: LinkSettings) -> str:
    prediction = predict(settings)
    without = None if settings.mansd is None else predict(_uncapped(settings)).rate
    return f"predicted loss in the long run: {_rate_text(prediction, without)}"


def _rate_text(prediction: LossPrediction, without_cap: float | None) -> str:
    if prediction.rate is None:
        return f"not known: {prediction.note}"
    text = f"{100 * prediction.rate:.4g}%"
    if without_cap is not None:
        text += f" (without the cap {100 * without_cap:.4g}%)"
    return f"{text}, {prediction.note}" if prediction.note else text


def _print_tc(console: Console, settings: LinkSettings) -> None:
    tc = tc_command(settings)
    lacks = ", ".join(tc.lacks)
    if tc.words is None:
        console.print(Text(f"tc cannot do it; it lacks: {lacks}"))
        return
    console.print(Text("with tc, on a network device:"))
    command = textwrap.wrap(
        f"tc qdisc add dev DEVICE root netem {tc.words}", max(console.width - 2, _NARROW_WIDTH),
        initial_indent="  ", subsequent_indent="      ",
        break_long_words=False, break_on_hyphens=False,
    )  # fmt: skip
    console.print(Text(" \\\n".join(command)), soft_wrap=True)
    if lacks:
        console.print(Text(f"but tc lacks: {lacks}"))
    for note in tc.notes:
        console.print(Text(f"but {note}"))


def _uncapped(settings: LinkSettings) -> LinkSettings:
    return settings.model_copy(update={"mansd": None})


def _toml(spec: LinkSpec) -> Iterator[str]:
    """Lines of a file with this link; each table has its own, as inline ones are too long."""
    link: dict[str, Any] = {
        "name": spec.name,
        "listen": address_text(spec.listen),
        "to": address_text(spec.to),
    }
    for key in ("seed", "return_path", "idle_s"):
        value = getattr(spec, key)
        if value != getattr(LinkSpec, key):
            link[key] = value
    sides = {"forward": _given(spec.forward), "back": _given(spec.back)}
    yield from _toml_table("[[link]]", "link", link | {k: v for k, v in sides.items() if v})


def _toml_table(header: str, name: str, table: Mapping[str, Any]) -> Iterator[str]:
    deeper: list[tuple[str, str, Mapping[str, Any]]] = []
    own: list[str] = []
    for key, value in table.items():
        inner = f"{name}.{key}"
        if isinstance(value, dict):
            deeper.append((f"[{inner}]", inner, value))
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            deeper += [(f"[[{inner}]]", inner, entry) for entry in value]
        else:
            own.append(tomli_w.dumps({key: value}).rstrip())
    if own:
        yield from ("", header, *own)
    for each in deeper:
        yield from _toml_table(*each)


def _given(section: BaseModel) -> dict[str, Any]:
    """The keys of a section that are not their defaults, and those that name what it is."""
    given: dict[str, Any] = {}
    for key, field in type(section).model_fields.items():
        value = getattr(section, key)
        if key in ("kind", "model") or value != field.default:
            given[key] = _plain(value)
    return given


def _plain(value: Any) -> Any:
    if isinstance(value, BaseModel):
        return _given(value)
    return [_plain(entry) for entry in value] if isinstance(value, tuple) else value


def _cut(text: str, most: int) -> str:
    return text if len(text) <= most else f"{text[: most - 3]}..."
