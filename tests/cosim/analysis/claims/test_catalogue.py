"""The registry of claims: every file of the catalogue is a claim and is documented."""

from pathlib import Path

from cosim.analysis.claims import catalogue
from cosim.analysis.claims.claim_definition import CertifiedClaim, ClaimDefinition
from cosim.analysis.claims.claim_evaluation import definitions

DOCS = Path(__file__).parents[4] / "docs" / "record.md"


def test_every_file_of_the_catalogue_is_a_claim_that_the_docs_list() -> None:
    files = {path.stem for path in Path(catalogue.__path__[0]).glob("*.py")} - {"__init__"}
    rows = {(one.statement, one.source, one.assumes) for one in definitions(ClaimDefinition)}
    rows |= {(one.statement, "certificate", one.assumes) for one in definitions(CertifiedClaim)}
    assert len(rows) == len(files)
    text = DOCS.read_text(encoding="utf-8")
    section = text[text.index("\n## Claims") : text.index("\n## The summary")]
    listed = [line.strip("| ").split(" | ") for line in section.splitlines() if " | " in line]
    assert {tuple(cells) for cells in listed[1:]} == rows
