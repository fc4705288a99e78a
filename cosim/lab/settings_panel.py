"""The settings of the loop: choices and sliders, the form of all keys, and the scenario's text.

The browser makes controls and form itself from the parts that are described here, see ``lab.js``.
"""

from collections.abc import Awaitable, Callable

from nicegui import ui
from nicegui.events import ValueChangeEventArguments

from cosim.interactive.controls import Controls, Field, FieldKind, Group
from cosim.interactive.draft import Draft, Mistake
from noack.core.number_format import number

Apply = Callable[[Callable[[Draft], Draft], str], Awaitable[None]]
"""Applies a change of the draft; the second argument is the key."""
Json = dict[str, object]


class TextPanel:
    """The text of the scenario, in an editor; it passes on each change."""

    def __init__(self, draft: Draft, apply: Apply) -> None:
        self._draft, self._apply, self._quiet = draft, apply, False
        with ui.expansion("all settings (TOML)").classes("w-full").props("dense") as whole:
            self._mistakes = ui.column().classes("gap-0 w-full").props("role=status")
            self._editor = ui.codemirror(
                draft.text, language="TOML", line_wrapping=False, on_change=self._edited
            ).classes("w-full h-96")
        whole.on("after-show", js_handler="labNameEditor")

    def show(self, draft: Draft, mistakes: list[Mistake]) -> None:
        """Show another draft, with its mistakes above the editor."""
        self._draft, self._quiet = draft, True
        if self._editor.value != draft.text:
            self._editor.set_value(draft.text)
        self._quiet = False
        self._mistakes.clear()
        with self._mistakes:
            for one in mistakes:
                ui.label(one.text).classes("text-negative")

    def show_dark(self, *, dark: bool) -> None:
        """Choose the colours of the editor."""
        self._editor.set_theme("vscodeDark" if dark else "vscodeLight")

    def _edited(self, event: ValueChangeEventArguments[str]) -> Awaitable[None] | None:
        if self._quiet or event.value == self._draft.text:
            return None
        return self._apply(lambda draft: draft.with_text(event.value), "scenario")


def controls_part(controls: Controls, wrong: set[str], *, live: bool) -> Json:
    """Return choices and sliders for the browser.

    Args:
        controls: they.
        wrong: keys with mistakes.
        live: whether a loop is running, which some sliders change.
    """
    return {
        "choices": [
            {"key": one.key, "label": one.label, "value": one.value, "options": [*one.options.items()]}
            for one in controls.choices
        ],
        "sliders": [
            {
                "key": one.key,
                "label": one.label + " · also live" * (live and one.live),
                "min": one.ends[0],
                "max": one.ends[1],
                "step": one.step,
                "place": one.position,
                "text": value_text(one.value),
                "wrong": one.key in wrong,
            }
            for one in controls.sliders
        ],
    }


def value_text(value: float) -> str:
    """Return the value of a slider as text."""
    return f"{value:g}" if isinstance(value, int) else number(value, 3)


def form_part(group: Group, draft: Draft, mistakes: dict[str, str]) -> Json:
    """Return a group of the form for the browser, with the mistakes by key."""
    return {
        "key": group.key,
        "title": group.key.rpartition(".")[2] or "all settings (form)",
        "help": group.help,
        "fields": [
            {
                "key": one.key,
                "label": one.label,
                "help": one.help,
                "default": one.default,
                "options": _options(one),
                "text": one.text(draft),
                "error": mistakes.get(one.key, ""),
            }
            for one in group.fields
        ],
        "groups": [form_part(one, draft, mistakes) for one in group.groups],
    }


def _options(field: Field) -> list[tuple[str, str]] | None:
    """Return the values of a choice with their texts; None for a field with any text."""
    if field.kind is not FieldKind.CHOICE:
        return None
    nothing = f"default: {field.default}" if field.default else "not given"
    return [("", nothing), *((one, one) for one in field.options)]
