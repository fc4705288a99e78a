"""What noack-check has proven of the growth of a time-triggered loop under every pattern of losses."""

import json
from collections.abc import Sequence
from typing import NamedTuple

from cosim.analysis.witnesses import resolved_content
from noack.scenario.scenario import Scenario
from noack.theory.witnesses.loss_margin import Stability
from noack_check.growth import prove_growth, read_periodic_loop
from noack_check.sentences import growth_sentences

_PLACE = {"statement": "growth", "plants": "own", "conditions": "schedule"}


class GrowthProof(NamedTuple):
    """Sentences that noack-check has proven, and their witnesses."""

    scenario: dict[str, object]
    """As `noack check --resolved` prints it."""
    proven: Sequence[str]
    documents: Sequence[dict[str, object]]

    @property
    def lines(self) -> list[str]:
        """What is proven, a line each."""
        return [f"proved by noack-check: {sentence}" for sentence in self.proven]

    def file_text(self) -> str:
        """Return the file that ``noack-check`` reads."""
        return json.dumps({"scenario": self.scenario, "statements": self.documents}, allow_nan=False)


def growth_proof(resolved: Scenario, found: Sequence[Stability]) -> GrowthProof:
    """Return the proofs for the most losses with which the loop is stable, and the one that destabilises it.

    Args:
        resolved: the scenario.
        found: what is known for 0, 1, … consecutive losses.
    """
    content = resolved_content(resolved)
    loop, proven, documents = read_periodic_loop(content), list[str](), list[dict[str, object]]()
    stable = [growth.documents["stable"] for growth in found if growth.verdict == "stable"][-1:]
    unstable = [growth.documents["unstable"] for growth in found if growth.verdict == "destabilised"][:1]
    for document in (*stable, *unstable):
        documents.append({**_PLACE, **document})
        proven += growth_sentences(prove_growth(loop, document))
    return GrowthProof(content, proven, documents)
