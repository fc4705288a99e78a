"""What noack-check proves of the growth of a time-triggered loop under every pattern of losses."""

import json
from collections.abc import Sequence
from typing import NamedTuple

from cosim.analysis.witnesses import resolved_content
from noack.scenario.scenario import Scenario
from noack.theory.margins.loss_margin import Stability
from noack.theory.witnesses.effort import NoWitnessError
from noack.theory.witnesses.growth import stable_document, unstable_document
from noack_check.growth import read_periodic_loop
from noack_check.keys import RefusedError
from noack_check.sentences import growth_sentences

_PLACE = {"statement": "growth", "plants": "own", "conditions": "schedule"}


class GrowthProof(NamedTuple):
    """Sentences that noack-check has proven, and their witnesses."""

    scenario: dict[str, object]
    """As `noack check --resolved` prints it."""
    proven: Sequence[str]
    documents: Sequence[dict[str, object]]
    reason: str
    """Why something is computed only; empty: all is proven."""

    @property
    def lines(self) -> list[str]:
        """What is proven, and what is not, a line each."""
        lines = [f"proved by noack-check: {sentence}" for sentence in self.proven]
        return [*lines, *([f"computed, not checked by noack-check: {self.reason}"] if self.reason else [])]

    def file_text(self) -> str:
        """Return the file that ``noack-check`` reads."""
        return json.dumps({"scenario": self.scenario, "statements": self.documents}, allow_nan=False)


def prove_growths(resolved: Scenario, found: Sequence[tuple[int, Stability]]) -> GrowthProof:
    """Prove the growth for the most losses with which the loop is stable, and the one that destabilises it.

    Args:
        resolved: the scenario.
        found: numbers of consecutive losses, in order, with what was computed for them.
    """
    content = resolved_content(resolved, resolved.certificate.late_periods)
    proven: list[str] = []
    documents: list[dict[str, object]] = []
    reasons: list[str] = []
    try:
        loop = read_periodic_loop(content)
    except RefusedError as error:
        return GrowthProof(content, (), (), str(error))
    stable = [(losses, growth) for losses, growth in found if growth.verdict == "stable"][-1:]
    unstable = [(losses, growth) for losses, growth in found if growth.verdict == "destabilised"][:1]
    for losses, growth in (*stable, *unstable):
        limited = loop._replace(losses=losses)
        try:
            if growth.verdict == "stable":
                document, what = stable_document(limited, growth.lower)
            else:
                document, what = unstable_document(limited, growth.pattern)
        except NoWitnessError as error:
            reasons.append(f"at most {losses} consecutive losses: {error}")
        else:
            documents.append({**_PLACE, **document})
            proven += growth_sentences(what)
    return GrowthProof(content, proven, documents, "; ".join(reasons))
