"""Plain text as LaTeX; it compiles with pdfLaTeX, too."""

import re
import unicodedata

_SYMBOLS = {
    "−": "-", "‖": r"\|", "±": r"\pm", "×": r"\times", "·": r"\cdot", "≤": r"\le", "≥": r"\ge",
    "≈": r"\approx", "≠": r"\ne", "→": r"\rightarrow", "∞": r"\infty", "∈": r"\in", "√": r"\surd",
    "⟨": r"\langle", "⟩": r"\rangle", "∫": r"\int", "′": "'", "°": r"^{\circ}", "∑": r"\Sigma",
    "α": r"\alpha", "β": r"\beta", "γ": r"\gamma", "δ": r"\delta", "ε": r"\varepsilon",
    "ζ": r"\zeta", "η": r"\eta", "θ": r"\theta", "κ": r"\kappa", "λ": r"\lambda", "μ": r"\mu",
    "ν": r"\nu", "ξ": r"\xi", "π": r"\pi", "ρ": r"\rho", "σ": r"\sigma", "τ": r"\tau",
    "φ": r"\varphi", "χ": r"\chi", "ψ": r"\psi", "ω": r"\omega", "Γ": r"\Gamma", "Δ": r"\Delta",
    "Θ": r"\Theta", "Λ": r"\Lambda", "Ξ": r"\Xi", "Π": r"\Pi", "Σ": r"\Sigma", "Φ": r"\Phi",
    "Ψ": r"\Psi", "Ω": r"\Omega",
    **{digit: f"_{{{value}}}" for value, digit in enumerate("₀₁₂₃₄₅₆₇₈₉")},
    **{digit: f"^{{{value}}}" for value, digit in enumerate("⁰¹²³⁴⁵⁶⁷⁸⁹")},
    "⁻": "^{-}", "⁺": "^{+}", "ᵀ": r"^{\mathsf{T}}",
}  # fmt: skip
"""Characters that are mathematics in LaTeX."""
_WORDS = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "#": r"\#", "$": r"\$", "%": r"\%",
    "&": r"\&", "_": r"\_", "^": r"\textasciicircum{}", "~": r"\textasciitilde{}",
    "<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}", '"': "''", "-": "{-}",
    "–": "--", "—": "---", "…": r"\ldots{}", "’": "'", "‘": "`", "“": "``", "”": "''",
    "µ": r"\textmu{}", "\u00a0": "~", "\u202f": r"\,", "\n": " ",
}  # fmt: skip
_ACCENTS = {"\u0302": r"\hat", "\u0304": r"\bar", "\u0332": r"\underline", "\u0303": r"\tilde",
            "\u0307": r"\dot"}  # fmt: skip
_LATIN = range(0xC0, 0x180)  # letters that LaTeX's own UTF-8 input knows
_TYPESET = re.compile(
    r"(?<![\w.])(?P<mantissa>[-−]?\d+(?:\.\d+)?)e(?P<power>[-+]?\d{1,3})(?!\w)"
    r"|(?<=\w)[_^]\("
    r"|(?<=(?<![A-Za-z0-9_])[A-Za-z])_(?P<letter>[A-Za-z0-9])(?!\w)"
)
_DEEPEST, _LONGEST_SCRIPT = 4, 200


def latex_text(text: str, depth: int = 0) -> str:
    """Return a text for LaTeX: special characters escaped, symbols as mathematics.

    A number with an exponent, as 1.2e-05, becomes 1.2 × 10⁻⁵; e_c gets a subscript, e^(−αt) a
    superscript. A character that pdfLaTeX does not have becomes a question mark.
    """
    parts, end = [], 0
    for found in _TYPESET.finditer(text):
        if found.start() < end:  # inside a superscript
            continue
        begin, until = found.span("letter")
        rest = until
        if found["power"]:
            mantissa = found["mantissa"].replace("−", "-")
            power = found["power"].removeprefix("+")
            typeset, rest = rf"\ensuremath{{{mantissa}\times10^{{{int(power)}}}}}", found.end()
        else:
            if found["letter"] is None:
                begin = found.end()
                if depth == _DEEPEST or (until := _closing(text, begin)) < 0:
                    continue
                rest = until + 1
            command = "superscript" if text[found.start()] == "^" else "subscript"
            typeset = rf"\text{command}{{{latex_text(text[begin:until], depth + 1)}}}"
        parts += [_plain(text[end : found.start()]), typeset]
        end = rest
    return "".join(parts) + _plain(text[end:])


def _closing(text: str, begin: int) -> int:
    """Return the place of the parenthesis that closes the one before ``begin``, or −1."""
    depth = 1
    for place in range(begin, min(len(text), begin + _LONGEST_SCRIPT)):
        depth += {"(": 1, ")": -1}.get(text[place], 0)
        if not depth:
            return place
    return -1


def _plain(text: str) -> str:
    return "".join(map(_character, _with_accents(text)))


def _with_accents(text: str) -> list[str]:
    """Return the characters, each with the combining one that follows it."""
    found: list[str] = []
    for one in text:
        if found and unicodedata.combining(one):
            found[-1] += one
        else:
            found.append(one)
    return found


def _character(one: str) -> str:
    base, accents = one[0], one[1:]
    if accents:
        text = _SYMBOLS.get(base, base if base.isascii() and base.isalnum() else "")
        known = all(accent in _ACCENTS for accent in accents)
        if not (known and text):
            return _character(unicodedata.normalize("NFC", one)[0])
        for accent in accents:
            text = f"{_ACCENTS[accent]}{{{text}}}"
        return rf"\ensuremath{{{text}}}"
    if base in _SYMBOLS:
        return rf"\ensuremath{{{_SYMBOLS[base]}}}"
    if base in _WORDS:
        return _WORDS[base]
    if ord(base) > _LATIN.stop and len(parts := unicodedata.normalize("NFD", base)) > 1:
        return _character(parts)
    if (base.isascii() and base.isprintable()) or ord(base) in _LATIN:
        return base
    return "?"
