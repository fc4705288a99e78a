"""The settings of the loop: choices and sliders, the form of all keys, and the scenario's text.

The browser makes the sliders itself, see ``lab.js``. Groups of the form are built when they are
opened; mistakes are shown at their fields.
"""

from collections.abc import Awaitable, Callable

from nicegui import ui
from nicegui.events import ValueChangeEventArguments

from cosim.interactive.controls import (
    Controls,
    Field,
    FieldKind,
    Group,
    by_field,
    filled,
    form_of,
)
from cosim.interactive.draft import Draft, DraftError, Mistake
from noack.core.number_format import number

Apply = Callable[[Callable[[Draft], Draft], str], Awaitable[None] | None]
"""Applies a change of the draft; the second argument is the key."""


class SettingsPanel:
    """The form and the text; both show a draft and pass on each change."""

    def __init__(self, draft: Draft, apply: Apply) -> None:
        self._draft, self._apply = draft, apply
        self._quiet = False
        self._form = FormPanel(draft, apply)
        with ui.expansion("all settings (TOML)").classes("w-full").props("dense") as whole:
            self._mistakes = ui.column().classes("gap-0 w-full").props("role=status")
            self._editor = ui.codemirror(
                draft.text, language="TOML", line_wrapping=False, on_change=self._edited
            ).classes("w-full h-96")
        whole.on("after-show", js_handler="labNameEditor")

    def show(self, draft: Draft) -> None:
        """Show another draft; what is being typed stays."""
        self._draft, self._quiet = draft, True
        try:
            self._form.show(draft)
            if self._editor.value != draft.text:
                self._editor.set_value(draft.text)
        finally:
            self._quiet = False

    def show_dark(self, *, dark: bool) -> None:
        """Choose the colours of the editor."""
        self._editor.set_theme("vscodeDark" if dark else "vscodeLight")

    def show_mistakes(self, mistakes: list[Mistake]) -> None:
        """Show mistakes at their fields and above the editor."""
        self._form.show_mistakes(mistakes)
        self._mistakes.clear()
        with self._mistakes:
            for one in mistakes:
                ui.label(one.text).classes("text-negative")

    def _edited(self, event: ValueChangeEventArguments[str]) -> Awaitable[None] | None:
        if self._quiet or event.value == self._draft.text:
            return None
        self._draft = self._draft.with_text(event.value)
        return self._apply(lambda draft: draft.with_text(event.value), "scenario")


def controls_part(controls: Controls, wrong: set[str], *, live: bool) -> dict[str, object]:
    """Return choices and sliders for the browser.

    Args:
        controls: they.
        wrong: keys with mistakes.
        live: whether a loop is running, which some sliders change.
    """
    return {
        "choices": [
            {"key": one.key, "label": one.label, "value": one.value,
             "options": [*one.options.items()]}
            for one in controls.choices
        ],
        "sliders": [
            {"key": one.key, "label": one.label + " · also live" * (live and one.live),
             "min": one.ends[0], "max": one.ends[1], "step": one.step, "place": one.position,
             "text": value_text(one.value), "wrong": one.key in wrong}
            for one in controls.sliders
        ],
    }  # fmt: skip


def value_text(value: float) -> str:
    """Return the value of a slider as text."""
    return f"{value:g}" if isinstance(value, int) else number(value, 3)


_REST_MS = 400
"""So long after the last key press, a text is taken."""
_Input = ui.input | ui.select


class FormPanel:
    """The form; it shows a draft and passes on each change."""

    def __init__(self, draft: Draft, apply: Apply) -> None:
        self._draft, self._apply = draft, apply
        self._form = form_of(draft)
        self._mistakes: dict[str, str] = {}
        self._quiet = False
        self._open: dict[str, tuple[ui.expansion, ui.column]] = {}
        """The groups that are on the page, by key, with the column of their fields."""
        self._inputs: dict[str, tuple[Field, _Input]] = {}
        with ui.column().classes("w-full gap-1") as self._whole:
            self._add_group(self._form)

    def show(self, draft: Draft) -> None:
        """Show another draft; what is typed in a field stays if it means the same."""
        try:
            form = form_of(draft)
        except DraftError:
            return  # the mistake is shown at the text
        self._draft = draft
        changed, self._form = _shape(form) != _shape(self._form), form
        if changed:
            self._rebuild()
            return
        self._quiet = True
        try:
            for field, element in self._inputs.values():
                _show_value(field, element, draft)
        finally:
            self._quiet = False

    def show_mistakes(self, mistakes: list[Mistake]) -> None:
        """Show mistakes at their fields, and mark the groups that have some."""
        self._mistakes = by_field(self._form, mistakes)
        for field, element in self._inputs.values():
            element.error = self._mistakes.get(field.key)
        self._mark()

    def _rebuild(self) -> None:
        """Build the form anew with the same groups opened: another kind has other fields."""
        opened = {key for key, (expansion, _) in self._open.items() if expansion.value}
        self._open, self._inputs = {}, {}
        self._whole.clear()
        with self._whole:
            self._add_group(self._form)
        for key in sorted(opened, key=len):  # a group before those in it
            if key in self._open:
                self._open[key][0].set_value(True)
        self._mark()

    def _mark(self) -> None:
        wrong = {key for key, text in self._mistakes.items() if text}
        for key, (expansion, _) in self._open.items():
            has = any(one.startswith(f"{key}." if key else "") for one in wrong)
            expansion.props["header-class"] = "text-negative" if has else ""

    def _build(self, group: Group) -> None:
        for field in group.fields:
            self._add(field)
        for inner in group.groups:
            self._add_group(inner)

    def _add_group(self, group: Group) -> None:
        def opened() -> None:
            expansion, column = self._open[group.key]
            if expansion.value and not column.default_slot.children:
                found = next(one for one in self._form.all_groups() if one.key == group.key)
                with column:
                    self._build(found)
                self._mark()

        title = group.key.rpartition(".")[2] or "all settings (form)"
        with ui.expansion(title, on_value_change=opened).classes("w-full") as expansion:
            expansion.props("dense")
            if group.help:
                ui.label(group.help)
            column = ui.column().classes("w-full gap-1")
        self._open[group.key] = expansion, column

    def _add(self, field: Field) -> None:
        def entered() -> Awaitable[None] | None:
            text = str(element.value or "").strip()
            if self._quiet or text == field.text(self._draft):
                return None
            return self._apply(lambda draft: filled(draft, field, text), field.key)

        element: _Input
        if field.kind is FieldKind.CHOICE:
            options = {"": f"default: {field.default}" if field.default else "not given"}
            options |= {one: one for one in field.options}
            shown = field.text(self._draft)
            element = ui.select(options | {shown: options.get(shown, shown)}, value=shown,
                                label=field.label, on_change=entered)  # fmt: skip
            element.props("dense options-dense")
        else:
            element = ui.input(field.label, placeholder=field.default, on_change=entered,
                               value=field.text(self._draft))  # fmt: skip
            element.props(f"dense debounce={_REST_MS} autocomplete=off stack-label")
        element.classes("w-full").props("hide-bottom-space").props["title"] = field.help
        self._inputs[field.key] = field, element
        element.error = self._mistakes.get(field.key)


def _show_value(field: Field, element: _Input, draft: Draft) -> None:
    typed, text = str(element.value or ""), field.text(draft)
    if typed == text or (typed.strip() and field.value(typed.strip()) == draft.value(field.key)):
        return
    if isinstance(element, ui.select) and text not in element.options:
        element.options = dict(element.options) | {text: text}
    element.set_value(text)


def _shape(group: Group) -> tuple[object, ...]:
    """Return what decides which fields are on the page."""
    return (group.key, tuple(one.key for one in group.fields), tuple(map(_shape, group.groups)))
