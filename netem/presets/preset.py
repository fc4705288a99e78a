"""A preset: its file, and how one is found by its name; see :class:`Preset`."""

import difflib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from netem.core import toml_file
from netem.core.command_line import netem_program
from netem.core.errors import CallerError, printable, shortened
from netem.core.settings_section import FolderName, NonNegative, Positive, Probability, ScenarioSection

Direction = Literal["forward", "reverse"]
SUFFIX = ".toml"
"""Suffix of a preset's file; a name with it is that of a file."""
_SHIPPED = Path(__file__).parent / "shipped"
_Text = Annotated[str, Field(min_length=1)]


class PresetSource(ScenarioSection):
    """Where the numbers of a preset are from."""

    title: _Text
    """Title of the publication, or the name of the measured files."""
    authors: str = ""
    year: int | None = None
    place: str = ""
    """Where it is found: a DOI, an RFC, an address, a repository with its commit."""
    trace: str = ""
    """Name of the shipped trace to which the words were fitted."""

    @property
    def text(self) -> str:
        """The source in one line."""
        when = "" if self.year is None else str(self.year)
        trace = self.trace and f"trace {self.trace}"
        return ", ".join(filter(None, (self.authors, self.title, when, self.place, trace)))


class PublishedNumbers(ScenarioSection):
    """Numbers of the source which the words reproduce."""

    of: Literal["forward", "reverse", "round_trip"]
    """A direction, or the sum of both directions' delays."""
    delay_s: dict[str, NonNegative] = Field(default_factory=dict)
    """Delays by the share of packets that have at most this delay, such as 0.5 for the median."""
    within_s: NonNegative = 0.001
    """Largest difference between these delays and those of the words."""
    loss_rate: Probability | None = None
    mean_burst: Annotated[Positive, Field(ge=1)] | None = None
    """Mean number of packets lost in a row."""
    rate_bps: Annotated[int, Field(ge=1)] | None = None
    """Rate of the bottleneck."""


class Preset(ScenarioSection):
    """A network with a name, the words that it stands for, and the source of its numbers."""

    name: FolderName
    """Name of the preset: letters, digits, _ and -."""
    sentence: _Text
    """What network it is."""
    forward: str = ""
    """Words of ``noack netem`` for the direction from clients to the server."""
    reverse: str = ""
    """Words for the direction from the server to clients."""
    fit: _Text
    """How the words follow from the source, and what they leave out."""
    is_guess: bool = False
    """true: nobody has published these numbers."""
    source: PresetSource | None = None
    """Publication or trace that the numbers are from."""
    published: tuple[PublishedNumbers, ...] = ()
    """Numbers of the source; a test compares the words with them."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not (self.forward or self.reverse):
            raise ValueError("forward: a preset needs words in one direction at least")
        if self.source is None and not self.is_guess:
            raise ValueError("source: missing; name the source of the numbers, or write is_guess = true")
        return self

    def words(self, direction: Direction) -> str:
        """Return the words of a direction."""
        return self.forward if direction == "forward" else self.reverse

    @property
    def source_text(self) -> str:
        """The source in one line."""
        guess = "a guess: nobody has published these numbers" if self.is_guess else ""
        cited = "" if self.source is None else self.source.text
        return "; ".join(filter(None, (guess, cited)))


def load_preset(path: Path) -> Preset:
    """Read a preset's file.

    Raises:
        CallerError: one line per mistake, each with file, key, value and remedy.
    """
    return toml_file.validated(Preset, toml_file.read(path, Preset), str(path))


@cache
def shipped_presets() -> Mapping[str, Preset]:
    """Return the presets that come with the emulator by their names, sorted."""
    return {path.stem: load_preset(path) for path in sorted(_SHIPPED.glob(f"*{SUFFIX}"))}


def find_preset(name: str, folder: Path = Path()) -> Preset:
    """Return the preset with a name, or the one in a file ``*.toml``.

    Args:
        name: as the user gave it.
        folder: a relative path of a file is relative to it.

    Raises:
        CallerError: there is no such preset, or its file has a mistake.
    """
    if name.endswith(SUFFIX):
        return load_preset(folder / name)
    shipped = shipped_presets()
    if name in shipped:
        return shipped[name]
    near = [known for known in shipped if name and (known.startswith(name) or name in known)]
    near = near or difflib.get_close_matches(name, shipped, n=3, cutoff=0.5)
    hint = f"did you mean {' or '.join(near[:3])}?" if near else f"{netem_program()} --presets lists them"
    if "/" in name:
        hint = f"the name of a preset's file ends in {SUFFIX}"
    raise CallerError(f"no preset {shortened(printable(name))}; {hint}")
