"""Loss, by one of the loss models."""

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, Literal, Self

from noack.impairments.feature import Impairment, Stage, StageTables, Table, Word
from noack.impairments.loss_models import LOSS_MODELS, Loss
from noack.impairments.markov_chain import Chain, Pattern
from noack.impairments.words import WordReader

_MODELS = {
    word.name: (model, word) for model in LOSS_MODELS for word in model.words if word.read
}  # fmt: skip
LOSS_WORDS = tuple(_MODELS)
"""Words after ``loss`` that select a model."""


def _read(reader: WordReader) -> Table:
    if reader.number_follows():
        name = "random"
    else:
        name = reader.word(f"a percentage, e.g. 5%, or one of {', '.join(LOSS_WORDS)}")
    if name not in _MODELS:
        for model in LOSS_MODELS:
            called = model.model_fields["model"].default
            if name.startswith(called.partition("_")[0]):
                reader.wrong(f"no such word; here it is {model.words[0].example}")
        reader.unknown(name, LOSS_WORDS)
    model, word = _MODELS[name]
    assert word.read is not None
    loss = {"model": model.model_fields["model"].default, **word.read(reader)}
    if reader.accept("ecn"):
        reader.wrong("this emulator cannot mark packets: it sees payloads, not IP headers")
    return {"loss": loss}


class LossOf(Impairment):
    """Loss by a model."""

    kind: Literal["loss"] = "loss"
    loss: Loss
    """The loss model."""

    words: ClassVar = (
        Word("loss", "loss 30%", _read),
        Word("drop", "loss 30%", _read),
        *(
            word._replace(
                read=None, after=word.after or "loss",
                grammar=word.grammar and f"loss {word.grammar}",
            )
            for model in LOSS_MODELS for word in model.words
        ),
    )  # fmt: skip

    @classmethod
    def examples(cls) -> Sequence[Self]:
        return [cls(loss=loss) for model in LOSS_MODELS for loss in model.examples()]

    def text(self) -> str:
        return f"loss {self.loss.text()}"

    def meaning(self) -> str:
        return self.loss.meaning()

    def stage(self, tables: StageTables) -> Stage | None:
        return self.loss.stage(tables)

    def chains(self) -> Sequence[Chain | Pattern]:
        return self.loss.chains()

    def without_files(self, folder: Path, place: str) -> Self:
        place = f"{place}.loss" if place else ""
        return self.model_copy(update={"loss": self.loss.without_files(folder, place)})

    def tc_text(self) -> str:
        words = self.loss.tc_text()
        return f"loss {words}" if words else ""

    def tc_lacks(self, before: Sequence[Impairment]) -> str:
        return self.loss.tc_lacks(before)

    def tc_notes(self) -> Sequence[str]:
        return self.loss.tc_notes()
