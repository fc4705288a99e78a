"""The form of all settings: groups are built when they are opened, mistakes are at their fields."""

from collections.abc import Awaitable, Callable

from nicegui import ui

from cosim.interactive.draft import Draft, DraftError, Mistake
from cosim.interactive.form_fields import Field, FieldKind, Group, by_field, filled, form_of

Apply = Callable[[Callable[[Draft], Draft], str], Awaitable[None] | None]
"""Applies a change of the draft; the second argument is the key."""
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
