"""Equations as text: lines that ``noack_equations`` reads, and formulas for messages."""

from collections.abc import Mapping, Sequence

from noack_equations.enclosure import FUNCTIONS, SHAPES


def equation_lines(equations: Mapping[str, object]) -> list[str]:
    """Return equations, as ``noack_equations`` accepts them, as text: a line for each step and each rate."""
    steps, rates, names, lines = equations["steps"], equations["rates"], list[str](), list[str]()
    assert isinstance(steps, list)
    assert isinstance(rates, list)
    for name, *rest in steps:
        formula = _formula(name, rest, names)
        if name in ("positive", "nonnegative"):
            lines.append(f"{formula} {'>' if name == 'positive' else '≥'} 0")
        elif name not in ("state", "input", "time", "number"):
            plain = formula[1:-1] if formula.startswith("(") else formula
            lines.append(f"s_{len(names) + 1} = {plain}")
            formula = f"s_{len(names) + 1}"
        names.append(formula)
    return lines + [f"dx_{i + 1}/dt = {names[index]}" for i, index in enumerate(rates)]


_INFIX = {"add": " + ", "times": " · "}


def formulas(equations: Mapping[str, object]) -> list[str]:
    """Return the rates of equations, as ``noack_equations`` accepts them, in words of mathematics."""
    steps, texts = equations["steps"], list[str]()
    assert isinstance(steps, list)
    for name, *rest in steps:
        texts.append(_formula(name, rest, texts)[:_LONGEST_FORMULA])
    rates = equations["rates"]
    assert isinstance(rates, list)
    return [texts[index] for index in rates]


_LONGEST_FORMULA = 2000


def _formula(name: str, rest: Sequence[object], texts: Sequence[str]) -> str:
    count = 1 if name in FUNCTIONS else SHAPES[name][0]
    operands = [texts[index] for index in rest[:count] if isinstance(index, int)]
    if name in ("state", "input"):
        return f"{'x' if name == 'state' else 'u'}_{int(str(rest[0])) + 1}"
    if name == "number":
        return repr(rest[0])
    if name == "time":
        return "t"
    if name in _INFIX:
        return f"({_INFIX[name].join(operands)})"
    if name == "negative":
        return f"(−{operands[0]})"
    if name in ("positive", "nonnegative"):
        return operands[0]
    if name == "root":
        return f"sqrt({operands[0]})"
    return f"{name}({', '.join([*operands, *map(str, rest[count:])])})"
