"""native/noack.h and the names that Python has for the same things."""

from pathlib import Path

from noack.core.core_library import core, dtype_of, ffi
from noack.impairments.feature import Stage, StageTables
from noack.impairments.link_settings import Counters, RecordedDecision
from noack.protocol.record_tables import Fate
from tests.netem.feature_examples import IMPAIRED, names_file

ROOT = Path(__file__).parents[2]


def constants(name: str) -> dict[str, int]:
    """Return the constants of an enumeration."""
    return {word: number for number, word in ffi.typeof(f"enum {name}").elements.items()}


def test_fates_have_the_same_numbers() -> None:
    assert constants("noack_fate") == {f"NOACK_{fate.name}": fate.value for fate in Fate}


def test_records_have_the_same_fields_in_the_same_order() -> None:
    assert dtype_of("noack_counters").names == tuple(Counters.__dataclass_fields__)
    assert dtype_of("noack_recorded").names == RecordedDecision._fields


def test_each_stage_kind_has_a_file_in_c_and_a_feature_in_python() -> None:
    kinds = [
        name.removeprefix("NOACK_").lower()
        for name, number in constants("noack_stage_kind").items()
        if number != core.NOACK_STAGE_KINDS
    ]
    assert {path.stem for path in (ROOT / "native" / "impairments").glob("*.c")} == set(kinds)
    made = {stage.kind for stage in stages()}
    assert made == set(kinds)


def stages() -> list[Stage]:
    """Return the stages of all examples of the features."""
    made = (one.stage(StageTables()) for one in IMPAIRED if not names_file(one))
    return [stage for stage in made if stage is not None]
