"""What the settings of links do, for ``--explain``: in words, as loss rate, and as a command of tc."""

import json
import textwrap
from collections.abc import Iterator, Sequence
from itertools import islice
from typing import NamedTuple

import tomli_w
from pydantic import BaseModel
from rich.console import Console
from rich.table import Table
from rich.text import Text

from netem.core.address import address_text
from netem.core.clock import NS_PER_S
from netem.core.console import SafeConsole
from netem.core.errors import shortened
from netem.core.number_format import counted
from netem.impairments.burst_prediction import BurstPrediction, caps_with, chance_text, predict_bursts
from netem.impairments.feature import Impairment
from netem.impairments.link_settings import LinkSettings
from netem.impairments.loss_prediction import order_and_notes
from netem.impairments.markov_chain import NotPredictableError
from netem.impairments.target_loss import expected_loss, loss_process, with_target_loss
from netem.impairments.words import percent_text
from netem.presets.preset import Preset
from netem.presets.preset_text import print_explanation
from netem.relay.relay_links import LinkSpec
from netem.tc_words import words_of
from netem.timetable_file import TimetableFile

_MAX_TOML = 4000
"""Longest settings that are printed, in characters."""
_MOST_LINES = 50
"""Lines of a timetable that are printed."""
_NARROW_WIDTH, _WIDE_WIDTH = 20, 44
"""Minimum and maximum columns for words."""


def explain(
    specs: Sequence[LinkSpec],
    as_written: Sequence[LinkSpec],
    presets: Sequence[Preset] = (),
    timetable: TimetableFile | None = None,
    *,
    as_json: bool,
    as_file: bool,
    packets: int,
) -> None:
    """Print the effect of links' settings on standard output, as tables or as JSON.

    Args:
        specs: the links.
        as_written: the same links, with the names of files instead of their content: what tables show.
        presets: the presets that the words name.
        timetable: the changes of settings.
        as_json: JSON, with the content.
        as_file: tables have the links as a file of links instead of their names.
        packets: how many packets the chance of a long loss burst is for.
    """
    if as_json:
        links = [
            {
                "name": spec.name,
                "listen": address_text(spec.listen),
                "to": address_text(spec.to),
                "seed": spec.seed,
                "forward": _document(spec.forward, packets),
                "reverse": _document(spec.reverse, packets) if spec.return_path else None,
            }
            for spec in specs
        ]
        named = {"presets": [preset.content() for preset in presets]} if presets else {}
        times = {} if timetable is None else {"timetable": _timetable_document(timetable)}
        print(json.dumps(named | {"links": links} | times))
        return
    console = SafeConsole(highlight=False)
    for preset in presets:
        print_explanation(console, preset)
    for number, (spec, written_spec) in enumerate(zip(specs, as_written, strict=True)):
        if number:
            console.print()
        if not as_file:
            seed = f", seed {spec.seed}" if spec.seed else ""
            addresses = f"{address_text(spec.listen)} → {address_text(spec.to)}"
            console.print(Text(f"{spec.name}: {addresses}{seed}", "bold underline"))
        _print_link(console, spec, written_spec, packets)
        if number == len(specs) - 1 and timetable is not None:
            _print_timetable(console, timetable, specs)
        if as_file:
            console.print(Text("\nas a file of links (--links)", "bold"))
            timed = {} if timetable is None else _timetable_keys(timetable)
            toml = tomli_w.dumps(timed | {"link": [_link_table(written_spec)]}).strip()
            console.print(Text(shortened(toml, _MAX_TOML)), soft_wrap=True)  # for copying


def _document(settings: LinkSettings, packets: int) -> dict[str, object]:
    prediction, tc = expected_loss(settings), tc_command(settings)
    return {
        "words": words_of(settings),
        "settings": settings.model_dump(mode="json", exclude_none=True),
        "meaning": [impairment.meaning() for impairment in settings.impairments]
        + [f"{words}: {meaning}" for words, meaning in settings_meaning(settings)],
        "predicted_loss": prediction.rate,
        "predicted_loss_note": prediction.note,
        "predicted_loss_without_cap": expected_loss(_without_guarantee(settings)).rate,
        "predicted_bursts_without_cap": _bursts(settings, packets).to_json(),
        "predicted_mean_burst": _mean_burst(settings),
        "order": order_meaning(settings),
        "tc": tc.words,
        "tc_behind": tc.behind,
        "tc_lacks": list(tc.lacks),
        "tc_notes": list(tc.notes),
    }


def _timetable_document(timetable: TimetableFile) -> dict[str, object]:
    repeat_ns = timetable.repeat_ns
    changes = [
        {
            "time_s": change.at_ns / NS_PER_S,
            "link": change.link,
            "direction": change.direction,
            "words": words_of(change.settings),
            "predicted_loss": expected_loss(change.settings).rate,
        }
        for change in timetable.timetable.changes
    ]
    return {
        "file": str(timetable.path),
        "repeat_s": None if repeat_ns is None else repeat_ns / NS_PER_S,
        "changes": changes,
    }


def _timetable_keys(timetable: TimetableFile) -> dict[str, object]:
    """Return the keys of a timetable in a file of links."""
    repeat_ns = timetable.repeat_ns
    repeat = {} if repeat_ns is None else {"timetable_repeat_s": repeat_ns / NS_PER_S}
    return {"timetable": str(timetable.path), **repeat}


def _print_timetable(console: Console, timetable: TimetableFile, specs: Sequence[LinkSpec]) -> None:
    console.print(Text(f"\ntimetable {timetable.path}: {timetable.summary}", "bold"))
    table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, header_style="dim")
    table.add_column("time", justify="right")
    if len(specs) > 1:
        table.add_column("link")
    table.add_column("direction")
    table.add_column("words", overflow="fold", style="bold")
    table.add_column("expected loss rate")
    for line in timetable.lines[:_MOST_LINES]:
        first = line.changes[0]
        rate = expected_loss(first.settings).rate
        table.add_row(
            f"{first.at_ns / NS_PER_S:g} s",
            *([first.link] if len(specs) > 1 else []),
            first.direction if len(line.changes) == 1 else "both",
            Text(shortened(line.words, 200)),
            "not known" if rate is None else f"{100 * rate:.4g}%",
        )
    console.print(table)
    if (more := len(timetable.lines) - _MOST_LINES) > 0:
        console.print(Text(f"and {counted(more, 'further line')}; --json has all"))
    for note in islice(timetable.notes(specs), 1):
        console.print(Text(note))


def settings_meaning(settings: LinkSettings) -> Iterator[tuple[str, str]]:
    """Yield (words, meaning) of the cap and the other settings."""
    if settings.mansd is not None:
        meaning = f"at most {settings.mansd} consecutive packets of a flow are not delivered"
        yield f"mansd {settings.mansd}", f"the guarantee: {meaning}; the next one is always delivered"
    for constraint in settings.constraints:
        yield constraint.text(), constraint.meaning()
    if settings.first_delivered:
        meaning = "the first packet of each flow is always delivered"
        yield "first", f"{meaning}; mansd limits the losses of later packets"
    if any(impairment.delays for impairment in settings.impairments):
        most = settings.limit
        delayed = f"{most} packet is" if most == 1 else f"{most} packets are"
        yield f"limit {most}", f"at most {delayed} delayed at once; more are dropped"


def _print_link(console: Console, spec: LinkSpec, written: LinkSpec, packets: int) -> None:
    if spec.return_path and spec.forward == spec.reverse:
        _print_direction(console, "both directions, each by itself", spec.forward, written.forward, packets)
        return
    title = "forward, from clients to the server"
    _print_direction(console, title, spec.forward, written.forward, packets)
    console.print()
    if spec.return_path:
        title = "reverse, from the server to clients"
        _print_direction(console, title, spec.reverse, written.reverse, packets)
    else:
        console.print(Text("reverse: not relayed; the server's answers are discarded", "bold"))


def _print_direction(
    console: Console, title: str, settings: LinkSettings, written: LinkSettings, packets: int
) -> None:
    if settings == LinkSettings():
        console.print(Text(f"{title}: no impairment", "bold"))
        return
    console.print(Text(f"{title}, in this order", "bold"))
    console.print(_table(settings, written, console.width))
    console.print(Text(f"\nexpected loss rate: {_rate_text(settings)}"))
    _print_bursts(console, _bursts(settings, packets), _mean_burst(settings))
    if order := order_meaning(settings):
        console.print(Text(f"order: {order}"))
    _print_tc(console, tc_command(settings, written))


def _table(settings: LinkSettings, written: LinkSettings, width: int) -> Table:
    table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, show_header=False)
    table.add_column(justify="right", style="dim")
    most = min(max(2 * width // 5, _NARROW_WIDTH), _WIDE_WIDTH)
    table.add_column(max_width=most, overflow="fold", style="bold")
    table.add_column(overflow="fold")
    pairs = zip(settings.impairments, written.impairments, strict=True)
    for number, (impairment, written_impairment) in enumerate(pairs, 1):
        # As text: a bracket in a file's name is not markup.
        words, meaning = shortened(written_impairment.text(), 200), impairment.meaning()
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
    without = expected_loss(_without_guarantee(settings)).rate
    if without is not None and settings.longest_burst is not None:
        text += f" (without the guarantee {100 * without:.4g}%)"
    return f"{text}, {prediction.note}" if prediction.note else text


def _bursts(settings: LinkSettings, packets: int) -> BurstPrediction:
    """Return the loss bursts without the guarantee."""
    try:
        process = loss_process(settings)
    except NotPredictableError as error:
        return BurstPrediction(packets, None, {}, str(error))
    return predict_bursts(process, caps_with(settings.longest_burst), packets)


def _mean_burst(settings: LinkSettings) -> float | None:
    """Return the mean loss burst under the guarantee; None: it is not known, or there is no guarantee."""
    if not settings.guarantee.rules:
        return None
    try:
        return loss_process(settings).outcomes(settings.guarantee).mean_burst
    except NotPredictableError:
        return None


def order_meaning(settings: LinkSettings) -> str:
    """Return what delays do to the order of packets, and to the guarantee; empty: nothing is delayed."""
    order, _ = order_and_notes(settings)
    if not order.delayed:
        return ""
    if not order.reordered:
        return "each flow leaves in the order of its arrival"
    overtaken = "delays vary, so packets may overtake earlier ones, which are then stale: lost for a receiver"
    if settings.guarantee.rules:
        effect = "the guarantee counts stale packets as lost, and holds packets back that would make too many"
    else:
        effect = "without a guarantee nothing limits how many in a row"
    return f"{overtaken} that uses the newest; {effect}; the word ordered after a delay keeps the order"


def _print_bursts(console: Console, bursts: BurstPrediction, with_cap: float | None) -> None:
    if not bursts.chance:
        console.print(Text(f"loss bursts without a guarantee: not known: {bursts.note}"))
        return
    if not any(bursts.chance.values()):
        return
    mean = f"{bursts.mean_burst:.3g} packets long on average" if bursts.mean_burst else "endless"
    behind = "" if with_cap is None else f"; with the guarantee {with_cap:.3g}"
    console.print(Text(f"loss bursts without a guarantee: {mean}{behind}"))
    chance = f"chance of more than N in a row within {bursts.packets} packets"
    console.print(Text(f"{chance}, without a guarantee:"))
    table = Table(box=None, padding=(0, 1, 0, 0), pad_edge=False, show_header=False)
    table.add_row("  N", *map(str, bursts.chance))
    table.add_row("  chance", *map(chance_text, bursts.chance.values()))
    console.print(table)


def _without_guarantee(settings: LinkSettings) -> LinkSettings:
    """Return settings without the guarantee, which lose with the same probabilities."""
    return with_target_loss(settings).model_copy(update={"mansd": None, "constraints": ()})


def _link_table(spec: LinkSpec) -> dict[str, object]:
    """Return a link's table in a file of links, without default values."""
    table: dict[str, object] = {
        "name": spec.name,
        "listen": address_text(spec.listen),
        "to": address_text(spec.to),
    }
    for key in ("seed", "return_path", "idle_s"):
        if getattr(spec, key) != getattr(LinkSpec, key):
            table[key] = getattr(spec, key)
    sides = {"forward": _set_keys(spec.forward), "reverse": _set_keys(spec.reverse)}
    return table | {name: side for name, side in sides.items() if side}


def _set_keys(section: BaseModel) -> dict[str, object]:
    """Return the keys of a section that differ from their defaults, and its kind."""
    return {
        key: _plain(getattr(section, key))
        for key, field in type(section).model_fields.items()
        if key in ("kind", "model") or getattr(section, key) != field.default
    }


def _plain(value: object) -> object:
    if isinstance(value, BaseModel):
        return _set_keys(value)
    return [_plain(entry) for entry in value] if isinstance(value, tuple) else value


_FIXED_ORDER = ("duplicate", "loss", "corrupt", "delay", "reorder", "rate")
"""tc applies its impairments in this order, whatever the order of the words."""
_LONGEST = 60
"""Words that are left out are cut to this number of characters."""


class TcCommand(NamedTuple):
    """The nearest settings that ``tc`` supports."""

    words: str | None
    """After ``tc qdisc add dev DEVICE root netem``; None if its netem supports none of the settings."""
    behind: str | None
    """Another qdisc of tc, behind netem or alone: its words."""
    lacks: tuple[str, ...]
    """The words that are left out, each with the missing tc feature."""
    notes: tuple[str, ...]
    """Differences in behaviour."""

    @property
    def commands(self) -> Sequence[str]:
        """The commands, for a network device; none if tc supports none of the settings."""
        add = "tc qdisc add dev DEVICE"
        if self.words is not None and self.behind is not None:
            return f"{add} root handle 1: netem {self.words}", f"{add} parent 1:1 handle 2: {self.behind}"
        if self.behind is not None:
            return (f"{add} root {self.behind}",)
        return () if self.words is None else (f"{add} root netem {self.words}",)


def tc_command(settings: LinkSettings, written: LinkSettings | None = None) -> TcCommand:
    """Return the nearest words of tc's own netem, and the settings that they leave out.

    ``written`` are the same settings, with the names of files instead of their content.
    """
    supported: list[Impairment] = []
    lacks: list[str] = []
    pairs = zip(settings.impairments, (written or settings).impairments, strict=True)
    expressible = [(impairment, original.text()) for impairment, original in pairs if impairment.tc_text()]
    for impairment, words in expressible:
        if share := getattr(impairment, "loss_correlation", 0.0):
            lacks.append(f"lossrel {percent_text(share)} (a delay correlated with loss)")
        if getattr(impairment, "ordered", False):
            lacks.append("ordered (that jitter keeps the order)")
        lack = impairment.tc_lacks(supported)
        if any(earlier.kind == impairment.kind for earlier in supported):
            lack = f"a second {impairment.kind}"
        if lack:
            lacks.append(f"{shortened(words, _LONGEST)} ({lack})")
        else:
            supported.append(impairment)
    if settings.mansd is not None:
        lacks.append(f"mansd {settings.mansd} (a cap on consecutive losses)")
    lacks += [f"{constraint.text()} (a constraint on losses)" for constraint in settings.constraints]
    if settings.first_delivered:
        lacks.append("first (that the first packet of each flow is delivered)")
    if expressible and not supported:
        return TcCommand(None, None, tuple(lacks), ())
    by_netem = [impairment.tc_text() for impairment in supported if not impairment.tc_qdisc()]
    behind = next((impairment.tc_qdisc() for impairment in supported if impairment.tc_qdisc()), None)
    text = " ".join([f"limit {settings.limit}", *by_netem]) if by_netem or behind is None else None
    notes = [note for impairment in supported for note in impairment.tc_notes()]
    kinds = [impairment.kind for impairment in supported]
    order = [_FIXED_ORDER.index(kind) for kind in kinds if kind in _FIXED_ORDER]
    if order != sorted(order):
        notes.append(f"its order is fixed: {', '.join(_FIXED_ORDER)}")
    if "duplicate" in kinds and "loss" in kinds:
        notes.append("a packet that it duplicates is never lost: a loss takes only one of the two copies")
    return TcCommand(text, behind, tuple(lacks), tuple(dict.fromkeys(notes)))


def _print_tc(console: Console, tc: TcCommand) -> None:
    lacks = ", ".join(tc.lacks)
    if not tc.commands:
        console.print(Text(f"not possible with tc, which lacks: {lacks}"))
        return
    plural = "s" if len(tc.commands) > 1 else ""
    console.print(Text(f"nearest command{plural} of tc, for a network device:"))
    for command in tc.commands:
        lines = textwrap.wrap(
            command,
            max(console.width - 2, _NARROW_WIDTH),
            initial_indent="  ",
            subsequent_indent="      ",
            break_long_words=False,
            break_on_hyphens=False,
        )
        console.print(Text(" \\\n".join(lines)), soft_wrap=True)
    if lacks:
        console.print(Text(f"tc lacks: {lacks}"))
    for note in tc.notes:
        console.print(Text(f"difference: {note}"))
