"""Guarantees beside the scenario's own one: their growth, and which of them imply others."""

from collections.abc import Callable, Sequence
from itertools import combinations, permutations
from typing import NamedTuple

from netem.tc_words import guarantee_words, settings_of
from noack.core.errors import CallerError
from noack.impairments.constraints import join_guarantee
from noack.impairments.guarantee_inclusion import Pattern, find_pattern_beyond
from noack.impairments.link_settings import LinkSettings
from noack.impairments.loss_guarantee import LossGuarantee, outcome_letters
from noack.theory.margins.loss_margin import Stability


class ComparedGuarantee(NamedTuple):
    """A guarantee, and what is known about the loop with it."""

    meaning: str
    """The guarantee in words."""
    found: Stability


class GuaranteeComparison(NamedTuple):
    """Some guarantees, the scenario's own one first."""

    guarantees: tuple[ComparedGuarantee, ...] = ()
    relations: tuple[str, ...] = ()
    """Sentences; for each two guarantees, which one implies the other."""


def read_guarantee(words: str) -> LossGuarantee:
    """Read a guarantee from words, such as ``mansd 4 atmost 3 in 10``.

    Raises:
        CallerError: the words are wrong, have other parts, or do not limit consecutive losses.
    """
    settings = settings_of(words)
    if settings != LinkSettings(mansd=settings.mansd, constraints=settings.constraints):
        raise CallerError(
            f'guarantee "{words}": expected only mansd, atmost and recover, e.g. '
            f'"{" ".join(guarantee_words(settings)) or "mansd 4 atmost 3 in 10"}"'
        )
    guarantee = join_guarantee(settings.mansd, settings.constraints)
    if guarantee.longest_burst is None:
        raise CallerError(f'guarantee "{words}": needs a maximum of losses: mansd or atmost')
    return guarantee


def compare_guarantees(
    guarantees: Sequence[LossGuarantee], examine: Callable[[LossGuarantee], Stability]
) -> GuaranteeComparison:
    """Examine guarantees. One that implies another does not grow faster.

    Raises:
        CallerError: a guarantee has too many states to be compared.
    """
    beyond = {
        (i, j): find_pattern_beyond(guarantees[i], guarantees[j])
        for i, j in permutations(range(len(guarantees)), 2)
    }
    found = [examine(guarantee) for guarantee in guarantees]
    for (i, j), pattern in beyond.items():
        if pattern is None:
            found[i] = found[i].with_upper_of(found[j])
            found[j] = found[j].with_lower_of(found[i])
    meanings = [guarantee.meaning for guarantee in guarantees]
    relations = tuple(
        _relation((meanings[i], beyond[i, j]), (meanings[j], beyond[j, i]))
        for i, j in combinations(range(len(guarantees)), 2)
    )
    return GuaranteeComparison(tuple(map(ComparedGuarantee, meanings, found)), relations)


def _relation(one: tuple[str, Pattern | None], other: tuple[str, Pattern | None]) -> str:
    """Return the relation of two guarantees, each with a pattern that the other one forbids."""
    (meaning, pattern), (other_meaning, other_pattern) = one, other
    if pattern is None and other_pattern is None:
        return f"“{meaning}” and “{other_meaning}” allow the same patterns"
    if pattern is None:
        return _implication(meaning, other_meaning, other_pattern or ())
    if other_pattern is None:
        return _implication(other_meaning, meaning, pattern)
    return (
        f"neither of “{meaning}” and “{other_meaning}” implies the other: only the first allows "
        f"{outcome_letters(pattern)}, only the second {outcome_letters(other_pattern)}"
    )


def _implication(meaning: str, implied: str, beyond: Pattern) -> str:
    return f"“{meaning}” implies “{implied}”, which also allows {outcome_letters(beyond)}"
