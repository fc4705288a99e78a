"""The file of a new scenario: its settings with comments."""

import textwrap
from collections.abc import Mapping, Sequence

from cosim.studies.new_loop.linear_model import eigenvalue_text
from cosim.studies.new_loop.trials import LoopTrial
from netem.core.settings_section import ReadTable
from noack.scenario.scenario_file import toml_text

_COMMENTS = {
    "horizon_s": "Length of the run in simulated time.",
    "speed": "Simulated time per wall time of a live run.",
    "model": "What sensor and controller know of the plant: ẋ = A x + B u, per second.",
    "plant": "The true plant.",
    "plant.initial_state": "x(0), one number per state.",
    "plant.rate_hz": "Steps of the plant per second of simulated time.",
    "plant.measure_every": "Steps per measurement.",
    "controller.rate_hz": "Inputs per second of simulated time.",
    "trigger": "The sensor transmits when the error of its model exceeds the threshold "
    "max(beta e^(−alpha_per_s t), floor).",
    "trigger.beta": "The first threshold. Larger: fewer transmissions, larger errors.",
    "trigger.floor": "The last threshold. With 0, x converges to 0.",
    "trigger.weight": "W of the norm ‖W e‖ of errors, chosen for the certificate.",
    "network.mansd": "At most this number of packets is lost in a row. The network delivers the next one.",
    "network.loss": "Losses, before this limit is applied.",
    "seeds": "Another number: other losses.",
    "outputs": "What you want to know, in its own unit, and how far it may be from its set-point.",
}
"""Comments of the file, by table and key."""
_REASONS = {
    "horizon_s": " Until its end e^(−alpha_per_s t) falls to a hundredth, and what is guaranteed has begun.",
    "trigger.beta": " It is a tenth of the norm of x(0).",
}
"""How values are chosen that are not given."""


def file_text(content: ReadTable, notes: Sequence[str], trial: LoopTrial, fixed_settings: ReadTable) -> str:
    """Return the file: the content with comments."""
    poles, decay = eigenvalue_text(trial.gain.eigenvalues), trial.gain.decay_per_s
    comments = _COMMENTS | {
        "model.gain": f"u = gain x_c. {trial.gain.method}; eigenvalues of A + B gain: {poles} /s.",
        "trigger.alpha_per_s": f"Must be below the decay rate of A + B gain, {decay:.4g} /s.",
    }
    comments |= {key: comments[key] + reason for key, reason in _REASONS.items() if key not in fixed_settings}
    lines = [f"# A scenario for {trial.gain.model.plant.label}, written by `noack new`."]
    lines += [line for note in notes for line in _comment_lines(note)]
    return "\n".join([*lines, *_section_lines("", content, comments), ""])


def _section_lines(name: str, table: ReadTable, comments: Mapping[str, str]) -> list[str]:
    lines = _comment_lines(comments.get(name, ""))
    lines = ["", *lines, f"[{name}]"] if name else lines
    inner: list[str] = []
    for key, value in table.items():
        path = f"{name}.{key}" if name else key
        if isinstance(value, dict):
            inner += _section_lines(path, value, comments)
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            inner += ["", *_comment_lines(comments.get(path, ""))]
            for entry in value:
                inner += [f"[[{path}]]", *toml_text(entry).splitlines()]
        else:
            lines += _comment_lines(comments.get(path, "")) + toml_text({key: value}).splitlines()
    return lines + inner


def _comment_lines(text: str) -> list[str]:
    return textwrap.wrap(text, 98, initial_indent="# ", subsequent_indent="# ")
