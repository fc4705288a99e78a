"""The settings of the loop: choices and sliders, the form of all keys, and the scenario's text.

Groups of the form are built when they are opened; mistakes are shown at their fields.
"""

from collections.abc import Awaitable, Callable

from nicegui import ui
from nicegui.elements.mixins.value_element import ValueElement
from nicegui.events import ValueChangeEventArguments

from cosim.interactive.controls import (
    Choice,
    Field,
    FieldKind,
    Group,
    Slider,
    by_field,
    chosen,
    controls_of,
    dragged,
    filled,
    form_of,
)
from cosim.interactive.draft import Draft, DraftError, Mistake
from noack.core.errors import NoackError
from noack.core.number_format import number

Changed = Callable[[Draft, str], Awaitable[None]]
"""Called with the new draft and the key that changed; an empty key: the whole text."""


class FastSlider(ValueElement[float]):
    """A slider that sends its place up to 60 times a second while it is dragged."""

    LOOPBACK = False  # a late answer of the server would move it back

    def __init__(
        self, slider: Slider, on_change: Callable[[ValueChangeEventArguments[float]], object]
    ) -> None:
        low, high = slider.ends
        super().__init__(
            tag="q-slider", value=slider.position, on_value_change=on_change, throttle=1 / 60
        )
        self.props["min"], self.props["max"], self.props["step"] = low, high, slider.step
        self.props["aria-label"] = slider.label


class SettingsPanel:
    """The panel; it shows a draft and passes on each change."""

    def __init__(self, draft: Draft, changed: Changed) -> None:
        self._draft, self._changed = draft, changed
        self._quiet = False
        self._shape: tuple[object, ...] = ()
        self._sliders: dict[str, tuple[Slider, FastSlider, ui.label]] = {}
        self._controls = ui.column().classes("w-full gap-1")
        self._form = FormPanel(draft, self._apply)
        with ui.expansion("all settings (TOML)").classes("w-full").props("dense") as whole:
            self._mistakes = ui.column().classes("gap-0 w-full").props("role=status")
            self._editor = ui.codemirror(
                draft.text, language="TOML", line_wrapping=False, on_change=self._edited
            ).classes("w-full h-96")
        whole.on("after-show", js_handler="labNameEditor")
        self._build()

    def show(self, draft: Draft, *, text: bool = True) -> None:
        """Show another draft; with ``text`` also in the editor."""
        self._draft = draft
        self._quiet = True
        try:
            self._build()
            self._form.show(draft)
            if text and self._editor.value != draft.text:
                self._editor.set_value(draft.text)
        finally:
            self._quiet = False

    def begin(self) -> None:
        """Name in the browser what can only be named there."""
        ui.run_javascript("labSpeakSliders()")

    def show_dark(self, *, dark: bool) -> None:
        """Choose the colours of the editor."""
        self._editor.set_theme("vscodeDark" if dark else "vscodeLight")

    def show_mistakes(self, mistakes: list[Mistake]) -> None:
        """Show mistakes at their fields and above the editor, and mark their sliders."""
        self._form.show_mistakes(mistakes)
        self._mistakes.clear()
        with self._mistakes:
            for one in mistakes:
                ui.label(one.text).classes("text-negative")
        wrong = {one.key for one in mistakes}
        for key, (_, _, shown) in self._sliders.items():
            change = "add" if key in wrong else "remove"
            shown.classes(**{change: "text-negative"})

    def _build(self) -> None:
        try:
            controls = controls_of(self._draft)
        except DraftError:
            return  # the mistakes are shown; the sliders stay
        if controls.shape == self._shape:
            for slider in controls.sliders:
                _, element, shown = self._sliders[slider.key]
                self._sliders[slider.key] = (slider, element, shown)
                shown.set_text(_text(slider.value))
                if abs(element.value - slider.position) > slider.step / 2:
                    element.set_value(slider.position)
            return
        self._shape, self._sliders = controls.shape, {}
        self._controls.clear()
        with self._controls:
            for choice in controls.choices:
                self._add_choice(choice)
            for slider in controls.sliders:
                self._add_slider(slider)

    def _add_choice(self, choice: Choice) -> None:
        def select(event: ValueChangeEventArguments[str]) -> Awaitable[None] | None:
            if self._quiet or event.value == choice.value:
                return None
            return self._apply(lambda draft: chosen(draft, choice.key, event.value), "")

        ui.select(
            dict(choice.options), value=choice.value, label=choice.label, on_change=select
        ).classes("w-full").props("dense options-dense")

    def _add_slider(self, slider: Slider) -> None:
        key = slider.key

        def moved(event: ValueChangeEventArguments[float]) -> Awaitable[None] | None:
            current = self._sliders[key][0]
            value = current.value_at(float(event.value))
            self._sliders[key][2].set_text(_text(value))
            if self._quiet or value == current.value:
                return None
            return self._apply(lambda draft: dragged(draft, current, value), key)

        with ui.row().classes("w-full no-wrap justify-between gap-2 mt-1"):
            ui.label(slider.label)
            shown = ui.label(_text(slider.value)).classes("font-mono")
        element = FastSlider(slider, moved).classes("w-full")
        element.props("dense")
        self._sliders[key] = (slider, element, shown)

    def _apply(self, change: Callable[[Draft], Draft], key: str) -> Awaitable[None] | None:
        """Show a change at once, before the next event is handled; return what follows from it."""
        try:
            draft = change(self._draft)
        except NoackError as error:
            ui.notify(str(error), type="negative")
            return None
        self.show(draft)
        return self._changed(draft, key)

    def _edited(self, event: ValueChangeEventArguments[str]) -> Awaitable[None] | None:
        if self._quiet or event.value == self._draft.text:
            return None
        self.show(self._draft.with_text(event.value), text=False)
        return self._changed(self._draft, "")


def _text(value: float) -> str:
    return f"{value:g}" if isinstance(value, int) else number(value, 3)


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
