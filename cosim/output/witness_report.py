"""What the checker has proven of a scenario, as a table."""

from collections.abc import Sequence

from flint import arb
from rich.console import Console
from rich.markup import escape

from cosim.analysis.witnesses import Witnesses
from cosim.output.result_tables import ResultTable, terminal_table
from noack.core.number_format import NONE
from noack_check.proof import Bound, Proof
from noack_check.sentences import at_least, at_most, norm, smallest_bounds

_ROWS = {"x": "‖x‖", "e_s": "‖e_s‖", "e_c": "‖e_c‖"}
_HEADINGS = {"own": "plant", "box": "box", "ideal": "paper", "schedule": "schedule"}


def print_witnesses(console: Console, witnesses: Witnesses) -> None:
    """Print the bounds that were proven, and why there are no others."""
    if (table := witness_table(witnesses)) is not None:
        console.print(terminal_table(table))
        limit = " In the limit: for t → ∞, from any start." if _limits(_proofs(witnesses)) else ""
        console.print(
            "[dim]noack-check has derived the loop from the scenario, and verified these bounds in ball "
            f"arithmetic. The bounds are multiplied by e^(−rate·t); those without decay are added.{limit}[/]"
        )
    for statement in witnesses.statements:
        if statement.proof is None:
            where = f"{_HEADINGS[statement.conditions]}, {_HEADINGS[statement.plants]}"
            console.print(f"[yellow]nothing is proven[/] ({where}): {escape(statement.reason)}")


def witness_table(witnesses: Witnesses) -> ResultTable | None:
    """Return a row for each part of a bound, a column for each statement; None if nothing is proven."""
    proven = [(s, s.proof) for s in witnesses.statements if s.proof is not None]
    if not proven:
        return None
    headings = ["", *(f"{_HEADINGS[s.conditions]},\n{_HEADINGS[s.plants]}" for s, _ in proven)]
    rows = [["decay rate, 1/s", *(at_least(proof.rate) for _, proof in proven)]]
    for name, symbol in _ROWS.items():
        bounds = [_bound(proof, name) for _, proof in proven]
        rows.append([f"bound of {symbol}", *(NONE if b is None else at_most(b.decaying) for b in bounds)])
        if any(b is not None and b.constant != 0 for b in bounds):
            rows.append(["+ without decay", *(NONE if b is None else at_most(b.constant) for b in bounds)])
    rows += _limits(_proofs(witnesses))
    rows.append(["inter-event time, s", *(_time(proof.inter_event) for _, proof in proven)])
    if any(proof.first_event != proof.inter_event for _, proof in proven):
        rows.append(["the first one, s", *(_time(proof.first_event) for _, proof in proven)])
    return ResultTable("proven", f"{witnesses.scenario['name']}: proven bounds", headings, rows)


def _proofs(witnesses: Witnesses) -> list[Proof]:
    return [statement.proof for statement in witnesses.statements if statement.proof is not None]


def _limits(proofs: Sequence[Proof]) -> list[list[str]]:
    """Return a row for each output that has a bound in the limit t → ∞."""
    limits = [{b.output: b.constant for b in proof.bounds if not b.from_start} for proof in proofs]
    return [
        [
            f"bound of {norm(output)} in the limit",
            *(at_most(each[output]) if output in each else NONE for each in limits),
        ]
        for output in dict.fromkeys(name for each in limits for name in each)
    ]


def _time(least: arb | None) -> str:
    return at_least(least) if least is not None and least > 0 else NONE


def _bound(proof: Proof, output: str) -> Bound | None:
    bounds = smallest_bounds(proof)
    return next((bound for bound in bounds if bound.output == output and bound.from_start), None)
