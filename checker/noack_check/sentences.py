"""What was proven, in words; decimals are rounded so that the sentences stay true."""

import hashlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from decimal import ROUND_CEILING, ROUND_FLOOR, Context, Decimal
from fractions import Fraction
from math import isfinite

from flint import arb, fmpq

from noack_check.check import RejectedError
from noack_check.document import read_table
from noack_check.equations import equation_lines, formulas
from noack_check.growth import Growth
from noack_check.loop import Loop
from noack_check.proof import Bound, Proof
from noack_check.scenario import most_losses

_SHORT = 7
"""Longest decimal number that is printed as it is, if it stands for exactly that number."""
_LONGEST_EQUATIONS = 600
_PLAIN_NAME = re.compile(r"[\w-]+")
_NAMES = {"x": "‖x‖", "e_s": "‖W e_s‖", "e_c": "‖W e_c‖", "drift": "‖W(ẋ − Hx)‖"}


def assumptions(scenario: Mapping[str, object], loop: Loop) -> str:
    """Return what a statement assumes of a run, in words."""
    times = loop.times
    network = scenario.get("network")
    enforced = not isinstance(network, Mapping) or network.get("enforce_mansd", True)
    parts = [f"at most {loop.losses} consecutive losses{'' if enforced else ', which nothing enforces'}"]
    if isinstance(network, Mapping) and isinstance(direction := network.get("actuation"), Mapping):
        parts.append(f"at most {most_losses(direction, 'network.actuation')} of inputs")
    if times.sampling > 0:
        ms = {name: f"{float(1000 * arb(getattr(times, name)).mid()):.6g} ms" for name in times._fields}
        youngest = f"−{ms['lead']}" if times.lead > 0 else "0"
        parts += [
            f"tests every {ms['sampling']}",
            f"updates act within {ms['delay']}",
            f"inputs {youngest} to {ms['age']} old",
            f"the first within {ms['start']}",
        ]
        if times.period > 0:
            least = f"{ms['least_period']} to " if times.least_period < times.period else ""
            parts.append(f"events every {least}{ms['period']}")
    plant = scenario.get("plant")
    if loop.noise.ncols() or (isinstance(plant, Mapping) and plant.get("disturbances")):
        parts.append("noise and disturbances within the scenario's bounds")
    if _may_accumulate(loop):
        parts.append("as long as events do not accumulate")
    if loop.until is not None:
        parts.append(f"up to {float(arb(loop.until).mid()):g} s, all about the reference")
    if scenario.get("changes"):
        parts.append("until the first change of settings")
    return ", ".join(parts)


def _may_accumulate(loop: Loop) -> bool:
    """Return whether nothing may keep two events apart.

    With tests at all times a threshold does if it is above 0, and above what the noises of two measurements
    add up to: only the rest has to be reached by a flow. An integral begins at 0.
    """
    rule = loop.rule
    if loop.times.least_apart > 0 or not rule.positive.nrows():
        return False
    noise = 2 * loop.plain_noise.sizes[1]
    if noise == 0 or rule.integrates:
        return not (rule.level > 0 or rule.floor > 0)
    return not (rule.floor > noise or (rule.rate == 0 and rule.level > noise))


def meaning(scenario: Mapping[str, object], loop: Loop) -> str:
    """Return from where x and outputs count, and of what the errors are, where it is not plain."""
    parts, controller = [], scenario.get("controller")
    is_moved = isinstance(controller, Mapping) and "reference" in controller
    if loop.loads:
        parts.append("x and outputs count from where the loop rests under its constant loads")
    elif is_moved and loop.until is None:
        parts.append("x and outputs count from the set-point")
    if loop.observer is not None or loop.noise.ncols():
        parts.append("e_s and e_c are x_s − x and x_c − x, not those about what the sensor takes for x")
    return ", and ".join(parts)


def digest_of_equations(document: Mapping[str, object], given: str | None) -> str:
    """Return the SHA-256 of the equations in a document that was accepted, which a statement is about.

    Args:
        document: the statement's document.
        given: the text with the equations, one or more blocks of lines; None: there is none.

    Raises:
        RejectedError: the document's equations are not among them.
    """
    lines = equation_lines(read_table(document, "equations"))
    digest = hashlib.sha256(("\n".join(lines) + "\n").encode()).hexdigest()
    if given is None:
        raise RejectedError(
            f"the statement is about equations with the digest {digest}: give the file that has them with "
            "--equations FILE; `noack certify NAME --witness W --equations FILE` writes it"
        )
    blocks = [[line.rstrip() for line in block.splitlines()] for block in given.split("\n\n")]
    if lines not in ([line for line in block if line] for block in blocks):
        raise RejectedError(f"the statement is about other equations than --equations: digest {digest}")
    return digest


def equations_text(document: Mapping[str, object]) -> str:
    """Return the equations in a document that was accepted, or where they are."""
    rates = formulas(read_table(document, "equations"))
    text = ", ".join(f"dx_{i + 1}/dt = {formula}" for i, formula in enumerate(rates))
    return text if len(text) <= _LONGEST_EQUATIONS else "that of the equations in the file"


def sentences(proof: Proof, outputs: Sequence[str] = ()) -> Iterator[str]:
    """Yield each bound of a proof; of two bounds of the same output the smaller one.

    Args:
        proof: what was proven.
        outputs: the names of the outputs; by default y_1, y_2, ….
    """
    for bound in smallest_bounds(proof):
        from_then = "" if proof.is_quiet or bound.output != "e_c" else ", from the first input on"
        yield f"{norm(bound.output, outputs)} ≤ {formula(bound, proof.rate)}{from_then}"
    if proof.inter_event is not None and proof.inter_event > 0:
        which = "" if proof.is_quiet else " after the first input"
        exception = _exception(proof) if proof.is_quiet else ""
        yield f"two events{which} are at least {at_least(proof.inter_event)} s apart{exception}"


def growth_sentences(growth: Growth) -> Iterator[str]:
    """Yield what is proven of the growth of a time-triggered loop."""
    per = f"per period of {float(arb(growth.period).mid()):.6g} s, in the long run"
    if growth.upper is not None:
        end = ": stable" if growth.upper < 1 else ""
        ties = ", at whichever of two ticks each update acts," if growth.has_ties else ""
        yield (
            f"with at most {growth.losses} consecutive losses no pattern{ties} changes the loop's state by "
            f"more than the factor {at_most(growth.upper)} {per}{end}"
        )
    if growth.lower is not None:
        end = ": unstable" if growth.lower > 1 else ""
        ties = " with each update at one of two ticks" if growth.has_ties else ""
        yield (
            f"with {growth.losses} consecutive losses allowed, {growth.pattern}, repeated{ties}, changes the "
            f"loop's state at least by the factor {at_least(growth.lower)} {per}{end}"
        )


def norm(output: str, outputs: Sequence[str] = ()) -> str:
    """Return the norm of an output as a symbol: |angle| of "y[0]", if its name is known."""
    if output in _NAMES:
        return _NAMES[output]
    kind, index = output[0], int(output[2:].removesuffix("]"))
    if not outputs or kind != "y":
        return f"|{kind}_{index + 1}|"
    name = outputs[index]
    return f"|{name if _PLAIN_NAME.fullmatch(name) else quoted(name)}|"


def quoted(name: str) -> str:
    """Return a name in quotes, in which it cannot end."""
    return json.dumps(name, ensure_ascii=False)


def _exception(proof: Proof) -> str:
    """Return what is proven of the first event, if it is less."""
    first = proof.first_event
    if first is None or proof.inter_event is None or first >= proof.inter_event:
        return ""
    if not first > 0:
        return ", from the second one on"
    return f"; the second one at least {at_least(first)} s after the first, which is at t = 0"


def smallest_bounds(proof: Proof) -> list[Bound]:
    """Return the bounds of a proof; of two bounds of the same output the smaller one.

    Left out is a limit that is not below what the bound from the start on tends to.
    """
    smallest: dict[tuple[str, bool], Bound] = {}
    for bound in proof.bounds:
        key = (bound.output, bound.from_start)
        if key not in smallest or size(bound) < size(smallest[key]):
            smallest[key] = bound
    return [
        bound
        for (output, from_start), bound in smallest.items()
        if from_start or not _limit_is_implied(bound, smallest.get((output, True)), proof.rate)
    ]


def _limit_is_implied(limit: Bound, bound: Bound | None, rate: arb) -> bool:
    return bound is not None and bool(rate > 0 and bound.constant <= limit.constant)


def size(bound: Bound) -> float:
    """Return the bound at t = 0, as it is printed, or what is left of one in the limit."""
    if not bound.from_start:
        return float(bound.constant.mid())
    return float((bound.decaying + bound.constant).mid())


def formula(bound: Bound, rate: arb) -> str:
    """Return D₁ e^{−rt} + D₂ in decimals, or what is left of it in the limit, by quadratic forms."""
    if not bound.from_start:
        return f"{at_most(bound.constant)} in the limit"
    decay = f" e^(−{at_least(rate)} t)" if rate > 0 else ""
    sizes = ((bound.decaying, decay), (bound.constant, ""))
    parts = [f"{at_most(value)}{end}" for value, end in sizes if not _is_zero(value)]
    return " + ".join(parts) or "0"


def at_most(value: arb) -> str:
    """Return four digits of a number that is at least the value."""
    return _rounded(value.upper() if value.rad() != 0 else value, ROUND_CEILING)


def at_least(value: arb | fmpq) -> str:
    """Return four digits of a number that is at most the value."""
    if isinstance(value, fmpq):
        return _rounded(value, ROUND_FLOOR)
    return _rounded(value.lower() if value.rad() != 0 else value, ROUND_FLOOR)


def _is_zero(value: arb) -> bool:
    """Return whether a number is exactly 0; a ball around 0 is not."""
    return bool(value == 0)


def _rounded(value: arb | fmpq, rounding: str) -> str:
    exact, text = value if isinstance(value, fmpq) else value.mid().fmpq(), repr(float(value))
    if len(text) <= _SHORT and isfinite(float(value)):
        is_exact = arb(float(value)).fmpq() == exact or Fraction(text) == Fraction(int(exact.p), int(exact.q))
        if is_exact:
            return text
    context = Context(prec=4, rounding=rounding)
    return f"{context.divide(Decimal(int(exact.p)), Decimal(int(exact.q))):g}"
