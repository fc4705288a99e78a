"""Delay: a constant, and a random part, drawn as the quantile of a uniform number.

Random parts have mean 0: uniform within ± jitter; normal, Pareto (shape 3) and their mixture with
the jitter as standard deviation. Empirical ones are interpolated between the observed values, which
a file may hold: delays, or a distribution table of ``tc``.
"""

import math
import re
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, Self, get_args

from pydantic import BaseModel, Field, FiniteFloat, model_validator

from netem.core.clock import NS_PER_S
from netem.core.core_library import core, ffi
from netem.core.named_file import NamedFile
from netem.core.periods import whole_ns
from netem.core.settings_section import Correlation, Table
from netem.impairments.clauses import Clause, Part, Word, flag
from netem.impairments.feature import (
    TC_CORRELATION,
    FileFeature,
    Impairment,
    PacketOrder,
    Stage,
    StageTables,
    add_numbers,
)
from netem.impairments.words import (
    CORRELATION,
    OWN_TIME_S,
    SIGNED_PERCENT,
    TIME_S,
    WordReader,
    brief_percent,
    list_of,
    percent_text,
    time_text,
)

Distribution = Literal["uniform", "normal", "pareto", "paretonormal", "empirical"]
SHAPES = tuple(shape for shape in get_args(Distribution) if shape != "empirical")
"""Names of distributions; any other word after ``distribution`` is a file's name."""
MOST_DELAY_S = 3600.0
"""Maximum of a setting: the sum of a few Pareto delays must fit into 64 bits of ns."""
MAX_SAMPLES = 1_000_000
_NOTEWORTHY = 1e-4
"""Minimum share of delays cut at 0 that is reported; a normal distribution always has some."""
TABLE_SUFFIX = ".dist"
"""Suffix of tc's distribution tables."""
_TABLE_SCALE = 8192
"""The number that represents 1 in a table of tc."""
_UNITS_S = {"": 1.0, "s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_DELAY = re.compile(r"([+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)\s*([a-z]*)")


@dataclass(frozen=True)
class _JitterPart(Part):
    """The jitter, which a distribution other than the uniform one needs."""

    def is_default(self, settings: BaseModel) -> bool:
        assert isinstance(settings, Delay)
        return super().is_default(settings) and settings.distribution in ("uniform", "empirical")

    def list_words(self, preceding: str) -> Iterator[Word]:
        yield Word("jitter", "delay 10ms 2ms", preceding)


@dataclass(frozen=True)
class _DistributionPart(Part):
    """The name of a distribution, or of a file."""

    def read(self, reader: WordReader, table: Table) -> None:
        name = reader.file(f"one of {', '.join(SHAPES)}, or a file")
        if name not in SHAPES:
            table |= {"distribution": "empirical", "file": name}
            return
        table["distribution"] = name
        if "jitter_s" not in table:
            reader.wrong("has no effect without jitter; write delay TIME JITTER distribution NAME")

    def is_default(self, settings: BaseModel) -> bool:
        assert isinstance(settings, Delay)
        return settings.distribution == "uniform" or settings.samples_s is not None

    def text(self, settings: BaseModel) -> str:
        assert isinstance(settings, Delay)
        name = settings.file
        if name is None:
            return f"distribution {settings.distribution}"
        return f"distribution {shlex.quote(f'./{name}' if name in SHAPES else name)}"


_SAMPLES = list_of(OWN_TIME_S, "delays in s, ms, us or ns, e.g. 1ms,2ms,10ms")
_DelayS = Annotated[FiniteFloat, Field(ge=0, le=MOST_DELAY_S)]
_Samples = Annotated[
    tuple[Annotated[FiniteFloat, Field(ge=-MOST_DELAY_S, le=MOST_DELAY_S)], ...],
    Field(min_length=2, max_length=MAX_SAMPLES),
]


class Delay(FileFeature, Impairment):
    """Delays a packet by a constant time plus a random time; negative sums count as 0."""

    kind: Literal["delay"] = "delay"
    delay_s: _DelayS = 0.0
    """The constant part; the mean delay, unless negative delays are cut."""
    jitter_s: _DelayS = 0.0
    """Half-width of the random part if it is uniform, else its standard deviation."""
    distribution: Distribution = "uniform"
    """Distribution of the random part; paretonormal is a quarter normal, three quarters Pareto;
    empirical draws from samples_s or file."""
    samples_s: _Samples | None = None
    """Observed delays, which are added to delay_s and may be negative; drawn values are
    interpolated between their quantiles."""
    file: Annotated[str, Field(min_length=1)] | None = None
    """A text file of observed delays, one per line, in seconds unless it says ms or us; or a
    distribution table of tc (*.dist), which is scaled by jitter_s."""
    correlation: Correlation = 0.0
    """Between the random parts of successive packets of a flow."""
    loss_correlation: Annotated[FiniteFloat, Field(ge=-1, le=1)] = 0.0
    """Correlation with the preceding loss model: positive values delay packets in its bad state
    more."""
    ordered: bool = False
    """true: no packet of a flow passes before an earlier one; it waits for it."""

    clauses: ClassVar = (
        Clause(
            "delay",
            "delay 10ms",
            Part("delay_s", TIME_S, "TIME"),
            _JitterPart("jitter_s", TIME_S, "JITTER"),
            Part("correlation", CORRELATION, "CORR"),
            _DistributionPart(
                "distribution",
                None,
                f"{'|'.join(SHAPES)}|FILE",
                "distribution",
                "delay 10ms 2ms distribution normal",
            ),
            Part(
                "samples_s",
                _SAMPLES,
                "T,T,...",
                "samples",
                "delay 0s samples 1ms,2ms,10ms",
                {"distribution": "empirical"},
            ),
            Part("loss_correlation", SIGNED_PERCENT, "P", "lossrel", "loss 5% delay 10ms 2ms lossrel 50%"),
            flag("ordered", "delay 10ms 2ms ordered", "ordered", True),
            synonyms=("latency",),
        ),
    )
    delays: ClassVar = True

    @model_validator(mode="after")
    def _check(self) -> Self:
        sources = (self.samples_s is not None) + (self.file is not None)
        if self.distribution == "empirical" and sources != 1:
            raise ValueError("samples_s: an empirical distribution needs samples_s, or a file")
        if self.distribution != "empirical" and sources:
            raise ValueError('samples_s: goes with distribution = "empirical"')
        return self

    @property
    def longest_s(self) -> float:
        if self.samples_s is not None:
            return max(self.delay_s + max(self.samples_s), 0.0)
        return self.delay_s + self.jitter_s * (1 if self.distribution == "uniform" else 4)

    @property
    def is_constant(self) -> bool:
        """Whether it delays all packets by the same time."""
        return not (self.jitter_s or self.samples_s or self.file)

    @property
    def is_bounded(self) -> bool:
        return not self.jitter_s or self.distribution in ("uniform", "empirical")

    def order_after(self, before: PacketOrder) -> PacketOrder:
        delayed = before.delayed or not self.is_constant or self.delay_s > 0
        return PacketOrder(delayed, not self.ordered and (before.reordered or not self.is_constant))

    def meaning(self) -> str:
        text = f"delays each packet by {time_text(self.delay_s)}"
        if self.file is not None:
            text += f" and by what is in {self.file}"
        elif self.samples_s is not None:
            low, high = min(self.samples_s), max(self.samples_s)
            text += (
                f" and between {time_text(low)} and {time_text(high)} more, as "
                f"{len(self.samples_s)} observed delays are distributed"
            )
        elif self.jitter_s and self.distribution == "uniform":
            text += f" ± {time_text(self.jitter_s)}, uniformly distributed"
        elif self.jitter_s:
            text += f", with a standard deviation of {time_text(self.jitter_s)} ({self.distribution})"
        share_below = self._share_below_zero()
        if share_below >= _NOTEWORTHY:
            share = percent_text(float(f"{share_below:.2g}"))
            text += f"; negative delays become 0 ({share} of the draws)"
        if self.correlation:
            text += f"; correlation {brief_percent(self.correlation)}"
        if self.loss_correlation:
            text += f"; correlation {brief_percent(self.loss_correlation)} with the loss before it"
        if self.ordered:
            text += "; keeps the order of each flow"
        return text

    def _share_below_zero(self) -> float:
        """Return the share of drawn delays that would be below 0."""
        if self.file is not None:
            return 0.0
        tables = StageTables()
        delay = ffi.new("noack_delay *", dict(self.stage(tables).numbers))
        reals = ffi.new("double[]", tables.reals)
        low, high = 0.0, 1.0
        for _ in range(50):  # quantiles ascend
            middle = (low + high) / 2
            if delay.constant_ns + core.noack_delay_quantile_ns(delay, reals, middle) < 0:
                low = middle
            else:
                high = middle
        return low

    @property
    def constant_ns(self) -> int:
        """delay_s in whole nanoseconds, rounded down (:mod:`netem.core.periods`)."""
        return whole_ns(self.delay_s)

    def stage(self, tables: StageTables) -> Stage:
        self.require_content()
        begin, end = add_numbers(tables.reals, sorted(t_s * NS_PER_S for t_s in self.samples_s or ()))
        numbers = {
            "constant_ns": self.constant_ns,
            "jitter_ns": self.jitter_s * NS_PER_S,
            "shape": getattr(core, f"NOACK_{self.distribution.upper()}"),
            "begin": begin,
            "end": end,
            "correlation": self.correlation,
            "innovation": math.sqrt(1 - self.correlation**2),
            "loss_correlation": self.loss_correlation,
            "loss_innovation": math.sqrt(1 - self.loss_correlation**2),
            "ordered": int(self.ordered),
        }
        return Stage(self.kind, numbers)

    def read_file(self, file: NamedFile) -> Self:
        samples_s = _read_samples(file, self.jitter_s)
        return self.model_copy(update={"samples_s": samples_s, "file": None, "jitter_s": 0.0})

    def tc_text(self) -> str:
        without = self.model_copy(update={"loss_correlation": 0.0, "ordered": False})
        if self.distribution == "uniform" and not self.jitter_s:
            return f"delay {time_text(self.delay_s)}"
        return without.text()

    def tc_lacks(self, earlier: Sequence[Impairment]) -> str:
        if self.distribution not in SHAPES:
            return "such a table of delays"
        if self.distribution != "uniform" and not (self.delay_s and self.jitter_s):
            return "a distribution without a delay and a jitter"
        return ""

    def tc_notes(self) -> Sequence[str]:
        notes = [TC_CORRELATION] if self.correlation else []
        if "pareto" in self.distribution:
            notes.append("its table of the Pareto distribution ends at four times the jitter")
        return notes


def _read_samples(file: NamedFile, jitter_s: float) -> tuple[float, ...]:
    """Return the delays in a file, in seconds; the jitter scales a distribution table."""
    if file.path.suffix == TABLE_SUFFIX:
        if jitter_s == 0:
            file.wrong("a distribution table is scaled by the jitter, which is 0; give a jitter")
        samples_s = [jitter_s * entry / _TABLE_SCALE for entry in _read_table(file)]
    else:
        if jitter_s != 0:
            file.wrong(
                "observed delays are taken as they are, and have no jitter beside them; "
                f"a distribution table of tc is named *{TABLE_SUFFIX}"
            )
        samples_s = list(_read_delays_s(file))
    if not 2 <= len(samples_s) <= MAX_SAMPLES:
        file.wrong(f"has {len(samples_s)} delays; expected 2 to {MAX_SAMPLES}")
    if max(map(abs, samples_s)) > MOST_DELAY_S:
        file.wrong(f"has a delay beyond {MOST_DELAY_S:g} s")
    return tuple(samples_s)


def _read_table(file: NamedFile) -> Iterator[int]:
    for number, line in file.lines():
        for word in line.split():
            if not re.fullmatch("-?[0-9]{1,5}", word):
                file.wrong(f"line {number}: {word[:20]}: expected whole numbers, 8192 for 1")
            yield int(word)


def _read_delays_s(file: NamedFile) -> Iterator[float]:
    for number, line in file.lines():
        match = _DELAY.fullmatch(line)
        scale = _UNITS_S.get(match[2]) if match else None
        if match is None or scale is None:
            file.wrong(f"line {number}: {line[:20]}: expected one delay, e.g. 0.0125 or 12.5ms")
        yield float(match[1]) * scale
