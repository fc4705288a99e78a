"""The file of links: several links of one relay, as TOML; see :class:`LinksFile`."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Self

from pydantic import BeforeValidator, Field, FiniteFloat, ValidationInfo, model_validator
from pydantic_core import to_json

from netem.core import toml_file
from netem.core.address import parse_address, parse_destination
from netem.core.clock import NS_PER_S
from netem.core.errors import CallerError
from netem.core.settings_section import FolderName, ReadTable, ScenarioSection, Seed, Table
from netem.impairments.link_settings import LinkSettings
from netem.impairments.target_loss import read_files
from netem.presets.preset import Direction, Preset, find_preset
from netem.relay.relay_links import STREAM, LinkSpec
from netem.tc_words import preset_names, reverse_words, settings_of
from netem.timetable_file import SHORTEST_NS, TimetableFile, read_timetable


def _settings(value: object, info: ValidationInfo) -> LinkSettings:
    if isinstance(value, LinkSettings):
        return value
    if not isinstance(value, str):
        # Strict validation accepts lists for tuples only in JSON, so that this goes through JSON.
        return LinkSettings.model_validate_json(to_json(value))
    try:
        direction: Direction = "reverse" if info.field_name == "reverse" else "forward"
        return settings_of(value, direction=direction, folder=_folder(info))
    except CallerError as error:
        raise ValueError(str(error)) from None


def _folder(info: ValidationInfo) -> Path:
    """Return the folder of the file of links."""
    return info.context if isinstance(info.context, Path) else Path()


Side = Annotated[LinkSettings, BeforeValidator(_settings, json_schema_input_type=str | LinkSettings)]


def presets_of_table(table: ReadTable) -> tuple[str, ...]:
    """Return the presets that a link's table names in its words, each once."""
    words = (table.get(key) for key in ("words", "forward", "reverse"))
    names = (name for text in words if isinstance(text, str) for name in preset_names(text))
    return tuple(dict.fromkeys(names))


class LinkTable(ScenarioSection):
    """One link of a relay: its addresses, and its settings in each direction."""

    name: FolderName
    """Names the link in reports: letters, digits, _ and -."""
    listen: str
    """Where clients send to: HOST:PORT; port 0 takes a free one."""
    to: str
    """The server: HOST:PORT."""
    forward: Side = LinkSettings()
    """From clients to the server: words, e.g. "delay 10ms loss 5%", or a table."""
    reverse: Side = LinkSettings()
    """From the server to the clients: words or a table, as for forward. Without this key: nothing, or
    the words of the presets that forward names (like NAME)."""
    words: Side | None = None
    """Another name for forward."""
    seed: Seed | None = None
    """Seed of the link's random streams; by default 0, with other random numbers for each link."""
    return_path: bool = True
    """false: forward direction only; the server's answers are discarded."""
    idle_s: Annotated[FiniteFloat, Field(gt=0, le=1e6)] = LinkSpec.idle_s
    """A client without a datagram in either direction for this time, in seconds, is removed."""
    most_clients: Annotated[int, Field(ge=1, le=1_000_000)] = LinkSpec.most_clients
    """Maximum number of clients; datagrams of further clients are refused and counted."""

    @model_validator(mode="before")
    @classmethod
    def _with_reverse(cls, table: object, info: ValidationInfo) -> object:
        """Give the reverse direction the words of the presets that the forward direction names."""
        if not isinstance(table, dict) or "reverse" in table or table.get("return_path") is False:
            return table
        presets = presets_of_table(table)
        with suppress(CallerError):  # that of the forward direction is reported
            for name in presets:
                find_preset(name, _folder(info))
            return table | {"reverse": reverse_words(presets)} if presets else table
        return table

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.words is not None and "forward" in self.model_fields_set:
            raise ValueError("words: is short for forward; give one of them")
        return self

    def spec(self, folder: Path, place: str, number: int, *, read: bool = True) -> LinkSpec:
        """Return the link for a relay; resolves its addresses, and reads its files in a folder.

        Raises:
            CallerError: the table has a mistake; one line, which begins with ``place``.
        """
        listen = parse_address(self.listen, f"{place}.listen")
        forward, reverse = self.words or self.forward, self.reverse
        if read:
            forward = read_files(forward, folder, f"{place}.forward")
            reverse = read_files(reverse, folder, f"{place}.reverse")
        return LinkSpec(
            listen=listen,
            to=parse_destination(self.to, f"{place}.to", listen),
            forward=forward,
            reverse=reverse,
            seed=self.seed or 0,
            stream=f"{STREAM} {number + 1}" if number and self.seed is None else STREAM,
            **self.model_dump(include={"name", "return_path", "idle_s", "most_clients"}),
        )


class LinksFile(ScenarioSection):
    """Links of one relay."""

    link: Annotated[tuple[LinkTable, ...], Field(min_length=1)]
    """The links, [[link]] each."""
    timetable: Annotated[str, Field(min_length=1)] | None = None
    """A CSV file with changes of settings: when, which link, and words."""
    timetable_repeat_s: Annotated[FiniteFloat, Field(ge=SHORTEST_NS / NS_PER_S, le=1e6)] | None = None
    """The timetable repeats after this time, in seconds."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        names: set[str] = set()
        for number, link in enumerate(self.link):
            if link.name in names:
                raise ValueError(f"link.{number}.name: another link has this name already")
            names.add(link.name)
        if self.timetable_repeat_s is not None and self.timetable is None:
            raise ValueError('timetable_repeat_s: there is no timetable; add timetable = "FILE.csv"')
        return self


def load_links(path: Path, *, read: bool = True) -> tuple[LinkSpec, ...]:
    """Read a links file; ``read`` also the files that it names.

    Raises:
        CallerError: one line per mistake, each with file, key, value and remedy.
    """
    content = toml_file.read(path, LinksFile)
    if "link" not in content and not content.keys().isdisjoint(("model", "axes")):
        kind = "scenario" if "model" in content else "campaign"
        raise CallerError(f"{path}: a {kind}, not a file of links; it has no [[link]]")
    links = toml_file.validated(LinksFile, content, str(path), path.parent).link
    specs = tuple(
        link.spec(path.parent, f"{path}: link.{number}", number, read=read)
        for number, link in enumerate(links)
    )
    listening: dict[object, str] = {}
    for number, spec in enumerate(specs):
        if spec.listen[1] and spec.listen in listening:
            raise CallerError(
                f'{path}: link.{number}.listen = "{links[number].listen}": '
                f"link {listening[spec.listen]} listens there already; take another port, or 0"
            )
        listening[spec.listen] = spec.name
    return specs


def load_timetable(path: Path, specs: Sequence[LinkSpec]) -> TimetableFile | None:
    """Read the timetable that a file of links names, which has been read without a mistake.

    Raises:
        CallerError: as :func:`netem.timetable_file.read_timetable`.
    """
    content = toml_file.read(path, LinksFile)
    name, repeat_s = content.get("timetable"), content.get("timetable_repeat_s")
    if not isinstance(name, str):
        return None
    repeat_ns = round(repeat_s * NS_PER_S) if isinstance(repeat_s, int | float) else None
    return read_timetable(path.parent / name, specs, repeat_ns)


def load_presets(path: Path) -> tuple[Preset, ...]:
    """Return the presets that a file of links names, which has been read without a mistake."""
    tables = toml_file.read(path, LinksFile)["link"]
    assert isinstance(tables, list)
    names = dict.fromkeys(name for table in tables for name in presets_of_table(table))
    return tuple(find_preset(name, path.parent) for name in names)


def json_schema() -> Table:
    """Return the JSON Schema of links files, for editors."""
    return toml_file.json_schema(LinksFile)
