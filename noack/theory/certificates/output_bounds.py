"""What a certificate says about each output, in its own unit.

From |y(t)| ≤ D₁e^{−rt} + D₂ follows from when on an output stays within its allowed error a: from
t = ln(D₁/(a − D₂))/r on, if D₂ < a. With a set-point, y is the output's distance from it; with loads, from
where the loop rests under them.
"""

from collections.abc import Sequence
from typing import NamedTuple

from netem.core.number_format import at_most
from noack.scenario.outputs import LoopOutput
from noack.theory.certificates.certified_bounds import ScenarioCertificate

_DIGITS = 3
"""Of numbers in sentences; they are rounded so that the sentences stay true."""


class OutputBound(NamedTuple):
    """The bound of an output by a certificate."""

    output: LoopOutput
    certificate: ScenarioCertificate
    """With the bound of the output in the place of that of ‖x‖."""
    is_deviation: bool = False
    """Whether the output has a set-point or rest other than 0, or a reference."""
    target: str = "set-point"
    """What the output is to follow."""

    @property
    def symbol(self) -> str:
        """What is bounded: |angle|, or |angle − r| with a set-point r other than 0."""
        return f"|{self.output.name}{' − r' if self.is_deviation else ''}|"

    @property
    def formula(self) -> str:
        """The bound over time, with the unit, e.g. "|angle| ≤ 0.31 e^(−0.8t) + 0.004 rad"."""
        return self.pattern.format(at_most(self.certificate.first("x")))

    @property
    def pattern(self) -> str:
        """The same; ``{}`` stands for the first constant."""
        bound = self.certificate.pattern("", "x")
        return f"{escaped(self.symbol)}{bound} {escaped(self.output.unit)}".rstrip()

    @property
    def ultimate(self) -> float:
        """What the bound tends to as t → ∞."""
        return self.certificate.ultimate_state

    @property
    def settles_s(self) -> float | None:
        """From when on the output stays within its allowed error; None: not certified, or not asked."""
        return None if self.output.allowed is None else self.certificate.settles_s(self.output.allowed)

    @property
    def is_met(self) -> bool:
        """Whether the allowed error, if there is one, is certified: from some time on, or in the end."""
        return self.output.allowed is None or self.ultimate <= self.output.allowed

    @property
    def statement(self) -> str:
        """What is certified, in words."""
        output, settles_s = self.output, self.settles_s
        if output.allowed is None:
            least = output.quantity(at_most(self.ultimate, _DIGITS))
            in_the_end = f", in the end ≤ {least}" if self.certificate.is_smaller_in_limit else ""
            return f"{self.formula}{in_the_end}"
        allowed = output.quantity(f"{output.allowed:g}")
        if settles_s is not None:
            when = f"from {at_most(settles_s, _DIGITS)} s on" if settles_s else "at all times"
            return f"{output.name} stays within {allowed} of its {self.target} {when}"
        if self.is_met:
            return f"{output.name} stays within {allowed} of its {self.target} in the end"
        least = output.quantity(at_most(self.ultimate, _DIGITS))
        return f"{output.name} stays within {least} of its {self.target} in the end, not within {allowed}"

    def to_json(self) -> dict[str, object]:
        """Return the bound for JSON."""
        return {
            "name": self.output.name,
            "unit": self.output.unit,
            "allowed": self.output.allowed,
            "bound": self.formula,
            "in_the_limit": self.ultimate,
            "settles_s": self.settles_s,
        }


def escaped(text: str) -> str:
    """Return a text that ``format`` leaves as it is."""
    return text.replace("{", "{{").replace("}", "}}")


def output_bounds(
    certificate: ScenarioCertificate,
    outputs: Sequence[LoopOutput],
    setpoint: Sequence[float] | None = None,
    *,
    follows: bool = False,
    rest: Sequence[float] = (),
) -> list[OutputBound]:
    """Return the bound of each output; none without a bound of ‖x‖.

    Args:
        certificate: of the loop.
        outputs: its p outputs.
        setpoint: x_r, n entries; None is 0.
        follows: the loop follows a reference that changes over time instead.
        rest: where it rests under its constant loads, n entries; without loads 0 or none.
    """
    if not certificate.has("x"):
        return []
    bounds = []
    for index, output in enumerate(outputs):
        moved, rests = (
            any(c * x for c, x in zip(output.row, point, strict=False)) for point in (setpoint or (), rest)
        )
        target = "reference" if follows else "rest under the load" if rests else "set-point"
        of_output = certificate.of_output(index, output.row)
        bounds.append(OutputBound(output, of_output, follows or moved or rests, target))
    return bounds
