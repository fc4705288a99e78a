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

OVERLOADED = {
    "trigger": {"policy": "periodic", "period_s": 0.01},
    "network.impairments": [{"kind": "rate", "rate_bps": 8000}],
}
OVERLOAD = (
    """--set 'trigger={policy="periodic", period_s=0.01}' """
    """--set 'network.impairments=[{kind="rate", rate_bps=8000}]'"""
)
CHANGES = {"changes": [{"at_s": 1.0, "set": {"network.mansd": 2}}]}
CHANGE = """--set 'changes=[{at_s=1.0, set={"network.mansd"=2}}]'"""
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
    "check folder": lambda: noack.load("folder"),
    "check empty": lambda: noack.load("empty"),
    "check campaign.toml": lambda: noack.load("campaign.toml"),
    "check links.toml": lambda: noack.load("links.toml"),
    f"check lane_following {OVERLOAD}": lambda: overloaded("lane_following"),
    f"check lane_following {OVERLOAD} ": lambda: noack.with_settings(
        noack.load("lane_following"), OVERLOADED
    ),
    "check lane_following --set bta=1": lambda: set_to("lane_following", {"bta": 1}),
    "check lane_following --set lss.p=1": lambda: set_to("lane_following", {"lss.p": 1}),
    "check lane_following --set loss.p=2": lambda: set_to("lane_following", {"loss.p": 2}),
    "check lane_following --set mansd=-1": lambda: set_to("lane_following", {"mansd": -1}),
    "check lane_following --set horizon_s=0": lambda: set_to("lane_following", {"horizon_s": 0}),
    "check lane_following --set trigger.beta.x=1": lambda: set_to("lane_following", {"trigger.beta.x": 1}),
    "check lane_following --set trigger.policy=relative": lambda: set_to(
        "lane_following", {"trigger.policy": "relative"}
    ),
    "check lane_following --set network.delay=0.01": lambda: set_to(
        "lane_following", {"network.delay": 0.01}
    ),
    """check lane_following --set 'changes=[{at_s=1.0, set={"plant.rate_hz"=3}}]'""": lambda: set_to(
        "lane_following", {"changes": [{"at_s": 1.0, "set": {"plant.rate_hz": 3}}]}
    ),
}

# --- theory ---------------------------------------------------------------------------------------

THEORY: dict[str, Call] = {
    f"certify lane_periodic {OVERLOAD}": lambda: noack.certify(overloaded()),
    "certify nothing": lambda: noack.certify("nothing"),
    "certify folder": lambda: noack.certify("folder"),
    "certify priority_channel": lambda: noack.certify("priority_channel"),
    "certify lane_following --late -1": lambda: noack.certify("lane_following", late=-1),
    "certify lane_following --late 1001": lambda: noack.certify("lane_following", late=1001),
    "certify lane_following --late soon": lambda: noack.certify("lane_following", late="soon"),  # type: ignore[arg-type]
    "certify lane_following --late 1.5": lambda: noack.certify("lane_following", late=1.5),  # type: ignore[arg-type]
    "certify lane_following --weight best": lambda: noack.certify("lane_following", weight="best"),
    "certify model_predictive": lambda: noack.certify("model_predictive"),
    "certify lane_following --set controller.update_timeout_s=1": lambda: noack.certify(
        set_to("lane_following", {"controller.update_timeout_s": 1})
    ),
    "certify lane_following --no-proofs --tables empty": lambda: noack.save_tables(
        noack.certify("lane_following", proofs=False), "empty"
    ),
    "certify lane_following --no-proofs --tables run/record": lambda: noack.save_tables(
        noack.certify("lane_following", proofs=False), "run/record"
    ),
    f"margin lane_periodic {OVERLOAD}": lambda: noack.margin(overloaded()),
    "margin nothing": lambda: noack.margin("nothing"),
    "margin lane_following": lambda: noack.margin("lane_following"),
    "margin cart_pole": lambda: noack.margin("cart_pole"),
    "margin priority_channel": lambda: noack.margin("priority_channel"),
    f"margin lane_periodic {CHANGE}": lambda: noack.margin(set_to("lane_periodic", CHANGES)),
    "margin lane_periodic --most 0": lambda: noack.margin("lane_periodic", most_m=0),
    "margin lane_periodic --most 1001": lambda: noack.margin("lane_periodic", most_m=1001),
    "margin lane_periodic --most many": lambda: noack.margin("lane_periodic", most_m="many"),  # type: ignore[arg-type]
    "margin lane_periodic --accuracy 2": lambda: noack.margin("lane_periodic", accuracy=2),
    "margin lane_periodic --accuracy fine": lambda: noack.margin("lane_periodic", accuracy="fine"),  # type: ignore[arg-type]
    "margin lane_periodic --effort 0": lambda: noack.margin("lane_periodic", effort=0),
    "margin lane_periodic --guarantee foo": lambda: noack.margin("lane_periodic", guarantees=["foo"]),
    "margin lane_periodic --guarantee 'loss 5%'": lambda: noack.margin("lane_periodic", guarantees="loss 5%"),
    f"cost lane_periodic {OVERLOAD}": lambda: noack.cost(overloaded()),
    "cost nothing": lambda: noack.cost("nothing"),
    "cost lane_following": lambda: noack.cost("lane_following"),
    "cost priority_channel": lambda: noack.cost("priority_channel"),
    f"cost lane_periodic {CHANGE}": lambda: noack.cost(set_to("lane_periodic", CHANGES)),
    "cost lane_periodic --Q '[1]'": lambda: noack.cost("lane_periodic", Q=[1]),
    "cost lane_periodic --Q x": lambda: noack.cost("lane_periodic", Q="x"),
    "cost lane_periodic --R '[-1, 1]'": lambda: noack.cost("lane_periodic", R=[-1, 1]),
    "cost lane_periodic --R '[nan, 1]'": lambda: noack.cost("lane_periodic", R=[NAN, 1]),
    "cost lane_periodic --R '[[1, 2], [0]]'": lambda: noack.cost("lane_periodic", R=[[1, 2], [0]]),
    "cost lane_periodic --R '[[1, 2], [0, 1]]'": lambda: noack.cost("lane_periodic", R=[[1, 2], [0, 1]]),
}

# --- runs -----------------------------------------------------------------------------------------

RUNS: dict[str, Call] = {
    f"simulate lane_periodic {OVERLOAD}": lambda: noack.simulate(overloaded()),
    "simulate nothing": lambda: noack.simulate("nothing"),
    "simulate folder": lambda: noack.simulate("folder"),
    "simulate double_integrator --runs empty": lambda: noack.simulate("double_integrator", runs="empty"),
    "simulate double_integrator --runs run": lambda: noack.simulate("double_integrator", runs="run"),
    "simulate double_integrator --runs run/record": lambda: noack.simulate(
        "double_integrator", runs="run/record"
    ),
    f"simulate lane_periodic {OVERLOAD} {CONTINUOUS}": lambda: noack.simulate_exactly(overloaded()),
    f"simulate nothing {CONTINUOUS}": lambda: noack.simulate_exactly("nothing"),
    f"simulate priority_channel {CONTINUOUS}": lambda: noack.simulate_exactly("priority_channel"),
    f"simulate cart_pole {CONTINUOUS}": lambda: noack.simulate_exactly("cart_pole"),
    f"simulate lane_crosswind {CONTINUOUS}": lambda: noack.simulate_exactly("lane_crosswind"),
    f"simulate lane_actuation_loss {CONTINUOUS}": lambda: noack.simulate_exactly("lane_actuation_loss"),
    f"simulate lane_python_trigger {CONTINUOUS}": lambda: noack.simulate_exactly("lane_python_trigger"),
    f"simulate lane_following {CHANGE} {CONTINUOUS}": lambda: noack.simulate_exactly(
        set_to("lane_following", CHANGES)
    ),
    f"simulate lane_following {DELAY} {CONTINUOUS}": lambda: noack.simulate_exactly(
        set_to("lane_following", DELAYED)
    ),
    f"run lane_periodic {OVERLOAD}": lambda: noack.run(overloaded()),
    "run nothing": lambda: noack.run("nothing"),
    "run folder": lambda: noack.run("folder"),
    "run double_integrator --runs empty": lambda: noack.run("double_integrator", runs="empty"),
    "run double_integrator --runs run": lambda: noack.run("double_integrator", runs="run"),
    "run double_integrator --runs run/record": lambda: noack.run("double_integrator", runs="run/record"),
}

# --- results of runs ------------------------------------------------------------------------------

RESULTS: dict[str, Call] = {
    "summary nothing": lambda: noack.open_run("nothing").summary,
    "summary folder": lambda: noack.open_run("folder").summary,
    "summary empty": lambda: noack.open_run("empty").summary,
    "summary HERE/damaged": lambda: noack.open_run("damaged").summary,
    "summary HERE/no_record": lambda: noack.open_run("no_record").summary,
    "summary several --loop nobody": lambda: noack.open_run("several").loops["nobody"].summary,
    "summary run --tables empty": lambda: noack.open_run("run").save_tables("empty"),
    "summary run --tables run/record": lambda: noack.open_run("run").save_tables("run/record"),
    "summary only_scenario": lambda: noack.open_run("only_scenario").summary,
    "replay only_scenario": lambda: noack.open_run("only_scenario").replay(),
    "report only_scenario": lambda: noack.open_run("only_scenario").report(),
    "replay nothing": lambda: noack.open_run("nothing").replay(),
    "replay campaign.toml": lambda: noack.open_run("campaign.toml").replay(),
    "replay HERE/damaged": lambda: noack.open_run("damaged").replay(),
    "replay HERE/no_record": lambda: noack.open_run("no_record").replay(),
    "replay several --loop nobody": lambda: noack.open_run("several").loops["nobody"].replay(),
    "report nothing": lambda: noack.open_run("nothing").report(),
    "report folder": lambda: noack.open_run("folder").report(),
    "report HERE/damaged": lambda: noack.open_run("damaged").report(),
    "report several --loop nobody": lambda: noack.open_run("several").loops["nobody"].report(),
    "report run --format gif": lambda: noack.open_run("run").save_figures("gif"),
    "report run --format svg --width 99": lambda: noack.open_run("run").save_figures("svg", 99),
    "report run --format svg --width wide": lambda: noack.open_run("run").save_figures("svg", "wide"),
    "export nothing --format csv": lambda: noack.open_run("nothing").export("out"),
    "export folder --format csv": lambda: noack.open_run("folder").export("out"),
    "export HERE/damaged --format csv --out out": lambda: noack.open_run("damaged").export("out"),
    "export several --loop nobody --format csv": lambda: (
        noack.open_run("several").loops["nobody"].export("out")
    ),
    "export run --format csv --out run": lambda: noack.open_run("run").export("run"),
    "export run --format csv --out empty/x": lambda: noack.open_run("run").export("empty/x"),
    "export run --format mat --out run/record/x.mat": lambda: noack.open_run("run").export(
        "run/record/x.mat"
    ),
    "export run --format mat --out empty/x.mat": lambda: noack.open_run("run").export("empty/x.mat"),
    "compare run": lambda: noack.compare("run"),
    f"compare {'run ' * 8}": lambda: noack.compare(*["run"] * 8),
    "compare run nothing": lambda: noack.compare("run", "nothing"),
    "compare run folder": lambda: noack.compare("run", "folder"),
    "compare run ':x'": lambda: noack.compare("run", ":x"),
    "compare run only_scenario": lambda: noack.compare("run", "only_scenario"),
    "compare run empty": lambda: noack.compare("run", "empty"),
    "compare run damaged": lambda: noack.compare("run", "damaged"),
    "compare run several": lambda: noack.compare("run", "several"),
    "compare run several:nobody": lambda: noack.compare("run", "several:nobody"),
    "compare run run --out x.xyz": lambda: noack.compare("run", "run").save("x.xyz"),
    "compare run run --out x.html --width page": lambda: noack.compare("run", "run").save("x.html", "page"),
    "compare run run --out x.svg --width 99": lambda: noack.compare("run", "run").save("x.svg", 99),
    "compare run run --out run/x.html/y.svg": lambda: noack.compare("run", "run").save("run/x.html/y.svg"),
}

# --- campaigns and measurements -------------------------------------------------------------------

STUDIES: dict[str, Call] = {
    "campaign nothing": lambda: noack.campaign("nothing"),
    "campaign folder": lambda: noack.campaign("folder"),
    "campaign run": lambda: noack.campaign("run"),
    "campaign lane_following": lambda: noack.campaign("lane_following"),
    "campaign overloaded.toml": lambda: noack.campaign("overloaded.toml"),
    "campaign campaign.toml --draws 0": lambda: noack.campaign("campaign.toml", draws=0),
    "campaign campaign.toml --draws 2.5": lambda: noack.campaign("campaign.toml", draws=2.5),  # type: ignore[arg-type]
    "campaign campaign.toml --workers 0": lambda: noack.campaign("campaign.toml", workers=0),
    "campaign campaign.toml --workers -1": lambda: noack.campaign("campaign.toml", workers=-1),
    "campaign campaign.toml --workers 100000": lambda: noack.campaign("campaign.toml", workers=100_000),
    "campaign campaign.toml --out run": lambda: noack.campaign("campaign.toml", folder="run", workers=1),
    "campaign campaign.toml --out run/record": lambda: noack.campaign(
        "campaign.toml", folder="run/record", workers=1
    ),
    "campaign campaign.toml --out empty": lambda: noack.campaign("campaign.toml", folder="empty", workers=1),
    "measure missing.csv": lambda: noack.measure("missing.csv"),
    "measure folder": lambda: noack.measure("folder"),
    "measure several": lambda: noack.measure("several"),
    "measure empty": lambda: noack.measure("empty"),
    "measure campaign.toml": lambda: noack.measure("campaign.toml"),
    f"measure {TRACE} {TRACE}": lambda: noack.measure(TRACE, TRACE),
    f"measure {TRACE} --flow 0": lambda: noack.measure(TRACE, flow=0),
    f"measure {TRACE} --flow 2": lambda: noack.measure(TRACE, flow=2),
    f"measure {TRACE} --far-flow 0": lambda: noack.measure(TRACE, far_flow=0),
    f"measure {TRACE} --sequence-at x": lambda: noack.measure(TRACE, sequence_at="x"),
    f"measure {TRACE} --clocks other": lambda: noack.measure(TRACE, clocks="other"),  # type: ignore[arg-type]
    f"measure {TRACE} --rate 20hz": lambda: noack.measure(TRACE, period_s=0.05),
    f"measure {TRACE} --rate 100khz": lambda: noack.measure(TRACE, period_s=1e-5),
    f"measure {TRACE} --deadline 0s": lambda: noack.measure(TRACE, deadline_s=0),
    f"measure {TRACE} --deadline -1s": lambda: noack.measure(TRACE, deadline_s=-1),
    f"measure {TRACE} --outage 0s": lambda: noack.measure(TRACE, outage_s=0),
    f"measure {TRACE} --share 2": lambda: noack.measure(TRACE, shares=[2]),
    f"measure {TRACE} --share nan": lambda: noack.measure(TRACE, shares=[NAN]),
    f"measure {TRACE} --window 0": lambda: noack.measure(TRACE, windows=[0]),
    f"measure {TRACE} --window 2.5": lambda: noack.measure(TRACE, windows=[2.5]),  # type: ignore[list-item]
    f"measure {TRACE} --within x": lambda: noack.measure(TRACE, within="x"),
    f"measure {TRACE} --within 0": lambda: noack.measure(TRACE, within=0),
    f"measure {TRACE} --out page.pdf": lambda: noack.measure(TRACE).save("page.pdf"),
    f"measure {TRACE} --out empty/page.html": lambda: noack.measure(TRACE).save("empty/page.html"),
    f"measure {TRACE} --write n.json": lambda: noack.measure(TRACE).write_network("n.json"),
    f"measure {TRACE} --write run/scenario.toml": lambda: noack.measure(TRACE).write_network(
        "run/scenario.toml"
    ),
    f"measure {TRACE} --for nothing": lambda: noack.measure(TRACE).certificate_time("nothing"),
    f"measure {TRACE} --for priority_channel": lambda: noack.measure(TRACE).certificate_time(
        "priority_channel"
    ),
}

# --- from a plant to a scenario, and networks -----------------------------------------------------

PLANTS: dict[str, Call] = {
    "linearise nothing": lambda: noack.linearise("nothing"),
    "linearise nothing.json": lambda: noack.linearise(Path("nothing.json")),
    "linearise folder": lambda: noack.linearise("folder"),
    "linearise campaign.toml": lambda: noack.linearise("campaign.toml"),
    f"linearise lane_periodic {OVERLOAD}": lambda: noack.linearise("lane_periodic", settings=OVERLOADED),
    "linearise priority_channel": lambda: noack.linearise("priority_channel"),
    "linearise cart_pole --at 0,0": lambda: noack.linearise("cart_pole", at=[0, 0]),
    "linearise cart_pole --at nan,0,0,0": lambda: noack.linearise("cart_pole", at=[NAN, 0, 0, 0]),
    "linearise cart_pole --input 0,0": lambda: noack.linearise("cart_pole", input=[0, 0]),
    "linearise cart_pole --within 0": lambda: noack.linearise("cart_pole", within=0),
    "linearise cart_pole --within x": lambda: noack.linearise("cart_pole", within="x"),  # type: ignore[arg-type]
    "linearise cart_pole --set plant.rate_hz=0": lambda: noack.linearise(
        "cart_pole", settings={"plant.rate_hz": 0}
    ),
    "gain nothing": lambda: noack.gain("nothing"),
    "gain cart_pole --q 1,2": lambda: noack.gain("cart_pole", q=[1, 2]),
    "gain cart_pole --q -1": lambda: noack.gain("cart_pole", q=-1),
    "gain cart_pole --r 0": lambda: noack.gain("cart_pole", r=0),
    "gain cart_pole --poles=-1,-2": lambda: noack.gain("cart_pole", poles=[-1, -2]),
    "gain cart_pole --poles=1,2,3,4": lambda: noack.gain("cart_pole", poles=[1, 2, 3, 4]),
    "gain cart_pole --poles=-1,-2,-3,-4 --q 1": lambda: noack.gain("cart_pole", poles=[-1, -2, -3, -4], q=1),
    "new nothing --out x.toml": lambda: noack.new("nothing", "x.toml"),
    "new cart_pole --out x.json": lambda: noack.new("cart_pole").save("x.json"),
    "new cart_pole --out campaign.toml": lambda: noack.new("cart_pole").save("campaign.toml"),
    "new cart_pole --out none/x.toml": lambda: noack.new("cart_pole").save("none/x.toml"),
    "new cart_pole --out x.toml --x0 1": lambda: noack.new("cart_pole", "x.toml", initial_state=[1]),
    f"new cart_pole --out x.toml {OVERLOAD}": lambda: noack.new("cart_pole", "x.toml", settings=OVERLOADED),
    "netem --explain loss 200%": lambda: relay(":9001", "loss 200%"),
    "netem --explain los 5%": lambda: relay(":9001", "los 5%"),
    "netem --explain replay nothing.csv": lambda: relay(":9001", "replay nothing.csv"),
    "netem --explain loss 5% --seed -1": lambda: relay(":9001", "loss 5%", seed=-1),
    f"netem --explain loss 5% --seed {2**64}": lambda: relay(":9001", "loss 5%", seed=2**64),
    "netem --listen :9000 --to :99999": lambda: relay(":99999"),
    "netem --listen x --to :9001": lambda: relay(":9001", listen="x"),
    "netem --listen :9001 --to :9001": lambda: relay(":9001", listen=":9001"),
    "check lane_following --set network.los=3": lambda: network(los=3),
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
