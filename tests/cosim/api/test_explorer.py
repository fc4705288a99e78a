"""``noack.explore``: without widgets, with widgets driven from Python, and in a real kernel."""

import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from matplotlib.legend import Legend

import noack

NOTEBOOK = """
import ipywidgets
import noack

explorer = noack.explore("lane_following", {"horizon_s": 5.0})
explorer
"""
DRAG = """
slider = explorer.widget().children[0].children[0].children
by_label = {label.value: one for label, one in zip(slider, slider[1:])
            if isinstance(label, ipywidgets.Label)}
by_label["loss probability"].value = 0.0
print(explorer.scenario.network.loss.probability, explorer.numbers["lost"])
"""
LATER = """
import asyncio
facts = explorer.widget().children[1].children[2]
while "draws" not in facts.value:
    await asyncio.sleep(0.05)
print(explorer.certificate.verdict, explorer.ensemble.draws)
"""


def test_results_are_those_of_the_library() -> None:
    explorer = noack.explore("lane_following")
    certificate = noack.certify("lane_following").schedule
    assert certificate.constants is not None
    found = explorer.certificate
    assert found.verdict == "certified"
    np.testing.assert_array_equal(found.e_c, certificate.controller_error(found.t_s))
    assert explorer.ensemble is not None
    assert explorer.ensemble.draws == 200
    assert not explorer.margin.defined  # an event trigger has no longest time between events
    assert noack.explore("lane_periodic").margin.defined


def test_settings_change_the_results_and_wrong_ones_change_nothing() -> None:
    explorer = noack.explore("lane_following", {"network.mansd": 2})
    before = explorer.run
    assert explorer.run is before
    with pytest.raises(noack.NoackError, match=r"network\.mansd = -1"):
        explorer.set({"trigger.beta": 0.1, "network.mansd": -1})
    assert explorer.run is before
    assert explorer.scenario.trigger.beta == 0.5
    explorer.set({"trigger.beta": np.float64(0.1), "network.loss.probability": 0.0})
    assert explorer.numbers["lost"] == "0 (0 %)"
    assert explorer.scenario.network.mansd == 2
    explorer.set({"trigger.floor": 0.01})
    assert explorer.run.threshold is not None
    assert explorer.run.threshold.min() == 0.01
    explorer.set({"trigger.floor": None})
    assert explorer.run.threshold.min() < 0.01


def test_a_loop_that_is_unstable_says_why() -> None:
    explorer = noack.explore("lane_following")
    assert explorer.warning == ""
    A, B = explorer.scenario.plant.uncertainty_A, explorer.scenario.plant.uncertainty_B
    explorer.set({"plant.uncertainty_A": 15 * np.array(A), "plant.uncertainty_B": 15 * np.array(B)})
    assert "Zeno-like behaviour" in explorer.warning
    assert "a mode of the loop grows" in explorer.warning
    assert "warning" in repr(explorer)
    assert explorer.run.t_s[-1] < explorer.scenario.horizon_s
    assert explorer.run.x_norm[-1] > 10 * explorer.run.x_norm[0]


def test_a_nonlinear_plant_runs_in_virtual_time() -> None:
    explorer = noack.explore("lane_vehicle", {"horizon_s": 1.0})
    assert explorer.run.kind == "sampled"
    assert explorer.ensemble is None
    assert explorer.numbers["run"] == "reached the horizon"


def test_several_loops_are_refused() -> None:
    with pytest.raises(noack.NoackError, match=r"only one loop.*noack\.simulate"):
        noack.explore("shared_channel")


def test_a_saved_scenario_has_the_settings_and_the_comments(tmp_path: Path) -> None:
    explorer = noack.explore("lane_following", {"trigger.beta": 0.125})
    path = explorer.save(tmp_path / "mine.toml")
    assert noack.load(path).trigger.beta == 0.125
    assert "# M - 1: at most four consecutive losses" in path.read_text()
    table = noack.load("double_integrator").model_dump(mode="json", exclude_none=True)
    assert noack.load(noack.explore(table).save(path)).name == "double_integrator"


def test_the_figure_has_what_is_known() -> None:
    explorer = noack.explore("lane_following")
    assert len(explorer.figure("V").axes) == 4
    state, errors, *_ = explorer.figure().axes
    assert state.get_title(loc="left") == "Y_g: plant and both models"
    legends = [one for one in errors.get_children() if isinstance(one, Legend)]
    named = [text.get_text() for one in legends for text in one.get_texts()]
    assert named == ["threshold", "‖e_s‖", "‖e_c‖", "certified bound"]
    assert not state.collections
    assert explorer.ensemble is not None
    assert explorer.figure(0).axes[0].collections  # the band
    with pytest.raises(noack.NoackError, match="no such state; there are V, r, psi, Y_g"):
        explorer.figure("z")


def test_sliders_change_the_explorer_and_the_other_way_round() -> None:
    ipywidgets = pytest.importorskip("ipywidgets", reason="the extra `notebook` is not installed")
    explorer = noack.explore("lane_following", {"horizon_s": 4.0})
    controls, figure = explorer.widget().children
    rows = controls.children[0].children
    sliders = {label.value: one for label, one in pairwise(rows)
               if isinstance(label, ipywidgets.Label)}  # fmt: skip
    message, image, facts, margin = figure.children
    first = bytes(image.value)
    assert first.startswith(b"\x89PNG")
    sliders["loss probability"].value = 0.0
    assert explorer.scenario.network.loss.probability == 0.0  # type: ignore[union-attr]
    assert bytes(image.value) != first
    assert ">0 (0 %)</td>" in facts.value
    explorer.set({"trigger.beta": 0.25})
    assert sliders["β, threshold at the start"].value == 0.25
    sliders["model error, as a multiple of the scenario's uncertainty"].value = 18.0
    assert "no certificate" in facts.value
    assert "grows" in message.value
    (choice,) = [one.children[1] for one in rows if isinstance(one, ipywidgets.VBox)
                 and one.children[0].value == "loss model"]  # fmt: skip
    choice.value = "lossless"
    assert explorer.scenario.network.loss.model == "lossless"
    labels = [one.value for one in controls.children[0].children
              if isinstance(one, ipywidgets.Label)]  # fmt: skip
    assert "loss probability" not in labels
    margin.click()
    assert ">margin</th>" in facts.value
    assert explorer.widget() is explorer.widget()


def test_a_wrong_choice_is_said_and_not_taken() -> None:
    ipywidgets = pytest.importorskip("ipywidgets", reason="the extra `notebook` is not installed")
    explorer = noack.explore("lane_following", {"horizon_s": 4.0})
    controls, figure = explorer.widget().children
    (choice,) = [one.children[1] for one in controls.children[0].children
                 if isinstance(one, ipywidgets.VBox)
                 and one.children[0].value.startswith("trigger policy")]  # fmt: skip
    for policy in (value for _, value in choice.options):
        choice.value = policy
        message = figure.children[0].value
        assert explorer.scenario.trigger.policy == policy or message


def test_without_ipywidgets_one_line_says_what_to_install() -> None:
    code = (
        "import sys; sys.modules['ipywidgets'] = None\n"
        "import noack\n"
        "explorer = noack.explore('lane_following')\n"
        "explorer.figure()\n"
        "try: explorer.widget()\n"
        "except noack.NoackError as error: print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    (line,) = done.stdout.splitlines()
    assert "pip install 'noack[notebook]'" in line


def test_a_notebook_in_a_real_kernel_shows_sliders_and_computes_the_rest(tmp_path: Path) -> None:
    pytest.importorskip("ipywidgets", reason="the extra `notebook` is not installed")
    nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed")
    nbformat = pytest.importorskip("nbformat", reason="nbformat is not installed")
    cells = [nbformat.v4.new_code_cell(one.strip()) for one in (NOTEBOOK, DRAG, LATER)]
    notebook = nbformat.v4.new_notebook(cells=cells)
    client = nbclient.NotebookClient(
        notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}
    )
    client.execute()
    shown, dragged, later = (cell.outputs for cell in notebook.cells)
    assert "application/vnd.jupyter.widget-view+json" in shown[0]["data"]
    assert dragged[0]["text"].strip() == "0.0 0 (0 %)"
    expected = noack.explore("lane_following", {"horizon_s": 5.0, "network.loss.probability": 0.0})
    assert later[0]["text"].split() == [expected.certificate.verdict, "200"]
