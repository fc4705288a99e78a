"""A short scenario whose states, inputs and outputs have any names."""

from typing import Any

from hypothesis import strategies as st

CHARACTERS = st.characters(exclude_categories=["C", "Z"], exclude_characters="$")
NAMES = st.one_of(
    st.sampled_from([
        "lateral offset [m]", "[/]", "[bold]x", "{}", "{0}", "{x!r}", "<b>", "&amp;", "%s", "\\", "a\\",
        "'", '"', "_x", "a/b", "..", "-", "^_^", "x_{2}", "‖e‖", "שלום", "e\u0301", "#", ",", ";", "=1+1",
        "|", "`a`", "*", "x" * 64, "a, b", "error norms", "norm of the state", "input", "x plant",
        "delivered", "output a", "state input",
    ]),
    st.text(CHARACTERS, min_size=1, max_size=64),
)  # fmt: skip


def named_content(states: list[str], inputs: list[str], outputs: list[str]) -> dict[str, Any]:
    return {
        "name": "named",
        "horizon_s": 0.05,
        "model": {
            "A": [[0.0, 1.0], [0.0, 0.0]], "B": [[0.0], [1.0]], "gain": [[-1.0, -2.0]],
            "state_names": states, "input_names": inputs,
        },
        "plant": {"initial_state": [1.0, 0.0], "rate_hz": 200.0},
        "controller": {"rate_hz": 200.0},
        "outputs": [{"name": name, "row": [1.0, i]} for i, name in enumerate(outputs)],
        "trigger": {"beta": 0.05, "alpha_per_s": 0.2},
        "network": {"mansd": 1, "loss": {"model": "bernoulli", "probability": 0.3}},
    }  # fmt: skip
