"""Loss, by one of the loss models."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import ClassVar, Literal, Self

from netem.core.settings_section import Table
from netem.impairments.clauses import Clause, Word
from netem.impairments.feature import Impairment, Stage, StageTables
from netem.impairments.loss_models import LOSS_MODELS, Loss
from netem.impairments.markov_chain import Chain, PeriodicLosses
from netem.impairments.words import WordReader

_MODELS = {clause.word: (model, clause) for model in LOSS_MODELS for clause in model.clauses}
LOSS_WORDS = tuple(_MODELS)
"""Words after ``loss`` that select a model."""


class _LossClause(Clause):
    """The clauses of the loss models, after ``loss``; a percentage begins that of random loss."""

    def read(self, reader: WordReader) -> Table:
        if reader.number_follows():
            name = "random"
        else:
            name = reader.word(f"a percentage, e.g. 5%, or one of {', '.join(LOSS_WORDS)}")
        if name not in _MODELS:
            for model in LOSS_MODELS:
                model_name = model.model_fields["model"].default
                if name.startswith(model_name.partition("_")[0]):
                    reader.wrong(f"no such word; here it is {model.clauses[0].example}")
            reader.unknown(name, LOSS_WORDS)
        model, clause = _MODELS[name]
        loss = {"model": model.model_fields["model"].default, **clause.read(reader)}
        if reader.accept("keep"):
            reader.wrong(
                "goes with loss P only: the guarantee shortens bursts, so that no chain has a given rate and "
                "a given burst behind it; --explain shows both"
            )
        if reader.accept("ecn"):
            reader.wrong("this emulator cannot mark packets: it sees payloads, not IP headers")
        return {"loss": loss}

    def list_words(self, preceding: str = "") -> Iterator[Word]:
        yield from (Word(name, self.example, preceding) for name in (self.word, *self.synonyms))
        for _, clause in _MODELS.values():
            yield from clause.list_words(self.word)


class LossOf(Impairment):
    """Loss by a model."""

    kind: Literal["loss"] = "loss"
    loss: Loss
    """The loss model."""

    clauses: ClassVar = (_LossClause("loss", "loss 30%", synonyms=("drop",)),)

    def text(self) -> str:
        return f"loss {self.loss.text()}"

    def meaning(self) -> str:
        return self.loss.meaning()

    def stage(self, tables: StageTables) -> Stage | None:
        return self.loss.stage(tables)

    def chains(self) -> Sequence[Chain | PeriodicLosses]:
        return self.loss.chains()

    def without_files(self, folder: Path, place: str) -> Self:
        place = f"{place}.loss" if place else ""
        return self.model_copy(update={"loss": self.loss.without_files(folder, place)})

    def tc_text(self) -> str:
        words = self.loss.tc_text()
        return f"loss {words}" if words else ""

    def tc_lacks(self, earlier: Sequence[Impairment]) -> str:
        return self.loss.tc_lacks(earlier)

    def tc_notes(self) -> Sequence[str]:
        return self.loss.tc_notes()
