"""Whether no event follows the one at t = 0 before the first input acts, as the kernel proves it."""

from flint import arb

from noack.proof.elaborate.loop import Loop
from noack.proof.elaborate.noise import noise_of
from noack.proof.forms_proof import FORMAT, as_text
from noack.proof.loop_document import LoopDocument, Naming, NoDocumentError
from noack.proof.quiet_start import write_quiet_start
from noack.proof.search.results import MOST_LATER, Assumptions
from noack_kernel import RejectedError, prove


def is_quiet(loop: Loop, rate: arb | None = None) -> bool:
    """Return whether the document of a loop without events at the start exists, and the kernel proves it.

    The proof has a lemma for each event that comes too early, and one bound: a unit is at most 1.

    Args:
        loop: the loop; what happens while an update is on its way does not matter.
        rate: r in f1 = e^{−rt}; None: that of the rule.
    """
    rate = loop.rule.rate if rate is None else rate
    assumed = Assumptions(None, MOST_LATER, 0, noise=noise_of(loop, rate))
    try:
        document = LoopDocument(loop, rate, assumed, (), Naming("a loop"))
        document.require_counted()
    except NoDocumentError:
        return False
    places, unit = [place.name for place in document.model.locations], "f2" if document.has("f2") else "f1"
    output = {"name": "a unit", "unit": "", "rows": document.rows[unit], "in": places}
    bound = {
        "output": "a unit", "from": "start", "decay": 0, "matrices": {},
        "levels": [int(unit == each) for each in ("f1", "f2")],
        "forms": {place: {"nodes": [0], "terms": [[]]} for place in places},
        "multipliers": {},
    }  # fmt: skip
    lemmas = [found.lemma for edge in document.dead_edges if (found := write_quiet_start(document, edge))]
    proof = {"format": FORMAT, "lemmas": lemmas, "bounds": [bound]}
    try:
        prove(as_text(document.table | {"outputs": [output]}), as_text(proof))
    except RejectedError as error:
        if "leads nowhere, and is not proven" not in str(error):
            raise
        return False
    return True
