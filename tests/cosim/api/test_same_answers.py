"""A command and its function in ``import noack`` refuse the same mistake with the same line.

Two things differ, and nothing else: what a command names ``--set`` is the function's argument
``settings``; and what cannot be read from the words at all, such as ``--late soon``, typer refuses
with a hint to ``--help``.
"""

import re
import shlex
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

import noack
from tests.helpers.command_line import invoke

pytestmark = [pytest.mark.usefixtures("no_searches")]
OVERLOADED = {
    "trigger": {"policy": "periodic", "period_s": 0.01},
    "network.impairments": [{"kind": "rate", "rate_bps": 8000}],
}
OVERLOAD = (
    """--set 'trigger={policy="periodic", period_s=0.01}' """
    """--set 'network.impairments=[{kind="rate", rate_bps=8000}]'"""
)
DELAYED = {"network.impairments": [{"kind": "delay", "delay_s": 0.01}]}
DELAY = """--set 'network.impairments=[{kind="delay", delay_s=0.01}]'"""
CONTINUOUS = "--trigger continuous"
TRACE = "rural_n8_10kmh"
NAN = float("nan")

Call = Callable[[], object]


def set_to(name: str, settings: Mapping[str, object]) -> noack.Scenario:
    return noack.load(name, settings)


def overloaded(name: str = "lane_periodic") -> noack.Scenario:
    return noack.load(name, OVERLOADED)


def relay(*arguments: Any, **options: Any) -> object:
    with noack.LossyUdp(*arguments, **options) as link:
        return link


def network(**table: object) -> object:
    return noack.VirtualNetwork({"mansd": 3, "loss": {"model": "lossless"}} | table)


# --- scenarios: check, and what each command does with a wrong one --------------------------------

SCENARIOS: dict[str, Call] = {
    "check nothing": lambda: noack.load("nothing"),
    f"check lane_following {OVERLOAD} ": lambda: noack.with_settings(
        noack.load("lane_following"), OVERLOADED
    ),
    "check lane_following --set horizon_s=0": lambda: set_to("lane_following", {"horizon_s": 0}),
}

# --- theory ---------------------------------------------------------------------------------------

THEORY: dict[str, Call] = {
    f"certify lane_periodic {OVERLOAD}": lambda: noack.certify(overloaded()),
    "certify lane_following --late -1": lambda: noack.certify("lane_following", late=-1),
    "certify lane_following --no-search --tables run/record": lambda: noack.save_tables(
        noack.certify("lane_following", search=False), "run/record"
    ),
    f"margin lane_periodic {OVERLOAD}": lambda: noack.margin(overloaded()),
    "margin priority_channel": lambda: noack.margin("priority_channel"),
    "margin lane_periodic --accuracy 2": lambda: noack.margin("lane_periodic", accuracy=2),
    "margin lane_periodic --guarantee 'loss 5%'": lambda: noack.margin("lane_periodic", guarantees="loss 5%"),
    f"cost lane_periodic {OVERLOAD}": lambda: noack.cost(overloaded()),
    "cost priority_channel": lambda: noack.cost("priority_channel"),
    "cost lane_periodic --R '[-1, 1]'": lambda: noack.cost("lane_periodic", R=[-1, 1]),
    "cost lane_periodic --R '[[1, 2], [0, 1]]'": lambda: noack.cost("lane_periodic", R=[[1, 2], [0, 1]]),
}

# --- runs -----------------------------------------------------------------------------------------

RUNS: dict[str, Call] = {
    f"simulate lane_periodic {OVERLOAD}": lambda: noack.simulate(overloaded()),
    "simulate double_integrator --runs run/record": lambda: noack.simulate(
        "double_integrator", runs="run/record"
    ),
    f"simulate cart_pole {CONTINUOUS}": lambda: noack.simulate_exactly("cart_pole"),
    f"simulate lane_following {DELAY} {CONTINUOUS}": lambda: noack.simulate_exactly(
        set_to("lane_following", DELAYED)
    ),
    f"run lane_periodic {OVERLOAD}": lambda: noack.run(overloaded()),
    "run folder": lambda: noack.run("folder"),
    "run double_integrator --runs empty": lambda: noack.run("double_integrator", runs="empty"),
    "run double_integrator --runs run/record": lambda: noack.run("double_integrator", runs="run/record"),
}

# --- results of runs ------------------------------------------------------------------------------

RESULTS: dict[str, Call] = {
    "summary nothing": lambda: noack.open_run("nothing").summary,
    "summary HERE/damaged": lambda: noack.open_run("damaged").summary,
    "summary several --loop nobody": lambda: noack.open_run("several").loops["nobody"].summary,
    "summary only_scenario": lambda: noack.open_run("only_scenario").summary,
    "replay only_scenario": lambda: noack.open_run("only_scenario").replay(),
    "report only_scenario": lambda: noack.open_run("only_scenario").report(),
    "replay campaign.toml": lambda: noack.open_run("campaign.toml").replay(),
    "summary HERE/no_record": lambda: noack.open_run("no_record").summary,
    "replay HERE/no_record": lambda: noack.open_run("no_record").replay(),
    "replay HERE/damaged": lambda: noack.open_run("damaged").replay(),
    "replay several --loop nobody": lambda: noack.open_run("several").loops["nobody"].replay(),
    "report folder": lambda: noack.open_run("folder").report(),
    "report run --format gif": lambda: noack.open_run("run").save_figures("gif"),
    "report run --format svg --width wide": lambda: noack.open_run("run").save_figures("svg", "wide"),
    "export nothing --format csv": lambda: noack.open_run("nothing").export("out"),
    "export HERE/damaged --format csv --out out": lambda: noack.open_run("damaged").export("out"),
    "export run --format csv --out empty/x": lambda: noack.open_run("run").export("empty/x"),
    "export run --format mat --out empty/x.mat": lambda: noack.open_run("run").export("empty/x.mat"),
    "compare run": lambda: noack.compare("run"),
    "compare run ':x'": lambda: noack.compare("run", ":x"),
    "compare run several:nobody": lambda: noack.compare("run", "several:nobody"),
    "compare run run --out run/x.html/y.svg": lambda: noack.compare("run", "run").save("run/x.html/y.svg"),
}

# --- campaigns and measurements -------------------------------------------------------------------

STUDIES: dict[str, Call] = {
    "campaign nothing": lambda: noack.campaign("nothing"),
    "campaign overloaded.toml": lambda: noack.campaign("overloaded.toml"),
    "campaign campaign.toml --workers -1": lambda: noack.campaign("campaign.toml", workers=-1),
    "campaign campaign.toml --out empty": lambda: noack.campaign("campaign.toml", folder="empty", workers=1),
    "measure missing.csv": lambda: noack.measure("missing.csv"),
    f"measure {TRACE} --sequence-at x": lambda: noack.measure(TRACE, sequence_at="x"),
    f"measure {TRACE} --window 0": lambda: noack.measure(TRACE, windows=[0]),
    f"measure {TRACE} --for priority_channel": lambda: noack.measure(TRACE).certificate_time(
        "priority_channel"
    ),
}

# --- from a plant to a scenario, and networks -----------------------------------------------------

PLANTS: dict[str, Call] = {
    "linearise nothing": lambda: noack.linearise("nothing"),
    f"linearise lane_periodic {OVERLOAD}": lambda: noack.linearise("lane_periodic", settings=OVERLOADED),
    "linearise cart_pole --at nan,0,0,0": lambda: noack.linearise("cart_pole", at=[NAN, 0, 0, 0]),
    "linearise cart_pole --set plant.rate_hz=0": lambda: noack.linearise(
        "cart_pole", settings={"plant.rate_hz": 0}
    ),
    "gain nothing": lambda: noack.gain("nothing"),
    "gain cart_pole --q -1": lambda: noack.gain("cart_pole", q=-1),
    "gain cart_pole --poles=-1,-2": lambda: noack.gain("cart_pole", poles=[-1, -2]),
    "gain cart_pole --poles=-1,-2,-3,-4 --q 1": lambda: noack.gain("cart_pole", poles=[-1, -2, -3, -4], q=1),
    "new nothing --out x.toml": lambda: noack.new("nothing", "x.toml"),
    "new cart_pole --out campaign.toml": lambda: noack.new("cart_pole").save("campaign.toml"),
    "new cart_pole --out none/x.toml": lambda: noack.new("cart_pole").save("none/x.toml"),
    f"new cart_pole --out x.toml {OVERLOAD}": lambda: noack.new("cart_pole", "x.toml", settings=OVERLOADED),
    "netem --explain loss 200%": lambda: relay(":9001", "loss 200%"),
    "netem --explain replay nothing.csv": lambda: relay(":9001", "replay nothing.csv"),
    "netem --listen :9000 --to :99999": lambda: relay(":99999"),
    "netem --listen :9001 --to :9001": lambda: relay(":9001", listen=":9001"),
    "check lane_following --set 'network.loss={model=\"bernoulli\", probability=3}'": lambda: network(
        loss={"model": "bernoulli", "probability": 3}
    ),
}

MISTAKES = SCENARIOS | THEORY | RUNS | RESULTS | STUDIES | PLANTS


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run, one of several loops, one with a damaged record, one without; other folders and files."""
    here = tmp_path_factory.mktemp("files")
    for name, scenario in (("run", "double_integrator"), ("several", "priority_channel")):
        made = noack.simulate(noack.load(scenario, {"horizon_s": 0.3}), runs=here / "runs").directory
        shutil.move(made, here / name)
    shutil.rmtree(here / "runs")
    shutil.copytree(here / "run", here / "damaged")
    (here / "damaged/record/plant_step.parquet").write_bytes(b"x")
    shutil.copytree(here / "run", here / "no_record")
    shutil.rmtree(here / "no_record/record")
    (here / "folder").mkdir()
    (here / "only_scenario").mkdir()
    shutil.copy(here / "run/scenario.toml", here / "only_scenario")
    (here / "empty").touch()
    (here / "run/x.html").touch()
    (here / "links.toml").write_text('[[link]]\nname = "a"\nlisten = ":0"\nto = ":9"\n')
    campaign = (
        'name = "c"\nscenario = "lane_periodic"\ndraws = 2\n'
        '[[axes]]\nname = "cap"\nkey = "network.mansd"\nvalues = [1, 2]\n'
    )
    (here / "campaign.toml").write_text(campaign)
    overload = (
        '[settings]\n"network.impairments" = [{kind = "rate", rate_bps = 100}]\n'
        'trigger = {policy = "periodic", period_s = 0.01}\n'
    )
    (here / "overloaded.toml").write_text(campaign + overload)
    return here


def plain(line: str) -> str:
    """A line without what says which of the two was called; see the top of this file."""
    line = re.sub(r"^noack( netem)?: ", "", line.strip())
    line = re.sub(r"; see `noack \w+ --help`$", "", re.sub(r"^\w+: (?=--)", "", line))
    return re.sub(r"--set |settings: ", "", line).removeprefix("--")


@pytest.mark.parametrize("command", MISTAKES)
def test_command_and_library_refuse_with_the_same_line(
    command: str, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))  # other runs would be warned of
    before = sorted(folder.rglob("*"))
    result = invoke(*shlex.split(command.replace("HERE", str(folder))))
    with pytest.raises(noack.NoackError) as error:
        MISTAKES[command]()
    assert plain(str(error.value)) == plain(result.stderr)
    assert result.stderr.count("\n") == 1
    assert result.exit_code == error.value.exit_status
    if not command.startswith("summary HERE"):  # shows the summary of a run whose record is damaged
        assert result.stdout == ""
    assert sorted(folder.rglob("*")) == before


def test_the_library_takes_what_the_commands_take(folder: Path, tmp_path: Path) -> None:
    """The directory of a run as a scenario, the diagonal of a weight, paths as text or as ``Path``."""
    assert noack.load(folder / "run").name == "double_integrator"
    by_diagonal = noack.cost("lane_periodic", Q=[1, 2, 3, 4])
    by_rows = noack.cost("lane_periodic", Q=[[1, 0, 0, 0], [0, 2, 0, 0], [0, 0, 3, 0], [0, 0, 0, 4]])
    assert by_diagonal == by_rows
    noack.compare(folder / "run", folder / "run").save(str(tmp_path / "overlay.svg"))
    noack.new(noack.linearise("cart_pole")).save(str(tmp_path / "new.toml"))
    assert {path.name for path in tmp_path.iterdir()} == {"overlay.svg", "new.toml"}
