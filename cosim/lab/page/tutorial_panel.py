"""Five guided steps, from an event to a loop that loses four in five packets."""

from collections.abc import Awaitable, Callable
from typing import Any, NamedTuple

from nicegui import ui


class Step(NamedTuple):
    """A step: what to read, which settings it begins with, what to drag."""

    title: str
    text: str
    scenario: str
    settings: dict[str, Any]
    drag: str


STEPS = (
    Step(
        "What is an event?",
        "The sensor runs a model x_s of the plant and knows the plant's state x. It transmits only "
        "when its error ‖x_s − x‖ exceeds the threshold βe^(−αt). Each point in the lowest panel "
        "of the figure is a transmission.",
        "lane_following", {"network.loss": {"model": "lossless"}},
        "Drag β: a larger threshold gives fewer events and larger errors.",
    ),
    Step(
        "What does a loss do?",
        "The controller runs the same model x_c, but it learns only from packets that arrive. "
        "Nobody acknowledges anything, so the sensor does not know what was lost. A cross is a "
        "lost packet; after it ‖e_c‖ stays large until the next packet arrives.",
        "lane_following", {"network.loss": {"model": "bernoulli", "probability": 0.5}},
        "Drag the loss probability from 0 to 1.",
    ),
    Step(
        "What is guaranteed?",
        "The network loses at most M − 1 packets in a row. Then the certificate bounds every run: "
        "‖e_c‖ ≤ Δβe^(−αt), and no two events are closer than δ. The green curves are these "
        "bounds; they hold for every loss pattern, not only for this one.",
        "lane_weighted", {},
        "Drag M − 1: the bound grows, the run changes little.",
    ),
    Step(
        "What can go wrong?",
        "An event trigger answers losses with more transmissions, so it is hard to break. A clock "
        "does not: here the sensor transmits every 0.1 s, whatever happens, and the controller "
        "holds what it received. The margin below the figure is the largest M for which no loss "
        "pattern makes the loop unstable.",
        "unstable_pendulum",
        {
            "mode": "zoh", "trigger": {"policy": "periodic", "period_s": 0.1},
            "network.loss": {"model": "worst_case"}, "network.mansd": 0,
        },
        "Drag M − 1 upwards until the loop diverges; then change the mode to model-based.",
    ),
    Step(
        "Your own plant under 80 % loss",
        "Replace the matrices under “all settings (TOML)” with those of your plant: [model] has A, "
        "B and the gain. Then run it live: five processes exchange real UDP packets, and the "
        "claims are judged while they run.",
        "double_integrator",
        {"network.loss": {"model": "bernoulli", "probability": 0.8}},
        "Drag M − 1, then press “run live”.",
    ),
)  # fmt: skip

Begin = Callable[[Step], Awaitable[None]]


class TutorialPanel:
    """The text of one step at a time; the figure is beside it."""

    def __init__(self, begin: Begin) -> None:
        self._begin, self._place = begin, 0
        with ui.card().classes("w-full"):
            self._title = ui.label().classes("text-h6").props("role=heading aria-level=2")
            self._text = ui.label()
            self._drag = ui.label().classes("font-bold")
            with ui.row():
                ui.button("show it", on_click=self._start)
                self._back = ui.button("back", on_click=lambda: self._go(-1)).props("flat")
                self._next = ui.button("next", on_click=lambda: self._go(1)).props("flat")
            ui.label("“show it”, “next” and “back” replace the settings by those of the step.")
        self._show()

    def _show(self) -> None:
        step = STEPS[self._place]
        self._title.set_text(f"{self._place + 1} of {len(STEPS)}: {step.title}")
        self._text.set_text(step.text)
        self._drag.set_text(step.drag)
        self._back.set_visibility(self._place > 0)
        self._next.set_visibility(self._place < len(STEPS) - 1)

    async def _go(self, by: int) -> None:
        self._place += by
        self._show()
        await self._start()

    async def _start(self) -> None:
        await self._begin(STEPS[self._place])
