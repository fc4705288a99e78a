"""What ``noack check`` prints: the scenario with its defaults, and what is worth knowing of it."""

from collections.abc import Iterator

from rich.console import Console

from controller_node.controller import law_of
from cosim.analysis.loop_files import files_of_widest
from cosim.analysis.summary.plant_linearisation import linearisation, linearisation_rows
from cosim.analysis.witnesses import find_witnesses
from cosim.cli.printing import console as standard_console
from cosim.cli.printing import print_json
from cosim.live.launcher import DEFAULT_START_S
from cosim.output.run_document import assumption_table
from netem.core.clock import NS_PER_S
from netem.output.terminal_writer import terminal_table
from noack.scenario.resolution import ResolvedRun, policy_of, resolve
from noack.scenario.scenario import Scenario, loop_names
from noack.scenario.scenario_file import dumps
from noack.scenario.uneven_periods import uneven_periods
from noack.theory.certificates.assumptions import assumptions
from noack.theory.certificates.conditions import with_stated_numbers
from noack.trigger_policies.trigger_rule import CodedPolicy
from plant_server.plant import system_of

_COMMENT = "# "


def check_scenario(loaded: Scenario, *, json: bool) -> None:
    """Check a scenario, and print it; raise CallerError if something is wrong."""
    if len(loop_names(loaded)) > 1:
        _check_loops(loaded, json=json)
        return
    resolved = resolve(loaded)
    _make_trigger(resolved)
    console = standard_console()
    console.width -= len(_COMMENT)
    with console.capture() as captured:  # printed last: the plant may be rejected
        console.print("assumptions about this scenario:")
        console.print(terminal_table(assumption_table(assumptions(resolved))))
        _print_plant(console, resolved)
    if json:
        print_json(resolved.model_dump(mode="json"))
        return
    print(dumps(resolved))
    for line in captured.get().splitlines():
        print(f"{_COMMENT}{line}".rstrip())


def print_resolved(loaded: Scenario, *, json: bool) -> None:
    """Print a scenario of one loop with numbers only: what a statement about it depends on."""
    stated = with_stated_numbers(resolve(loaded))
    if json:
        print_json(stated.model_dump(mode="json"))
    else:
        print(dumps(stated), end="")


def print_document(loaded: Scenario, *, json: bool) -> None:
    """Print the loop document of a proof that is known, in words; raise CallerError if none is."""
    resolved = resolve(loaded)
    known = find_witnesses(resolved, most_work=0.0, conditions=("schedule",))
    files = files_of_widest(resolved, known)
    print(files.document if json else files.words, end="" if json else "\n")


def _make_trigger(resolved: Scenario) -> None:
    """Make the trigger: some policies need a stable loop, others a user's class."""
    policy = policy_of(resolved)
    if isinstance(policy, CodedPolicy):
        policy.new_trigger()


def _check_loops(loaded: Scenario, *, json: bool) -> None:
    """Check each loop; print the scenario, which is not resolved."""
    run = ResolvedRun(loaded)
    for loop in run.loops:
        _make_trigger(loop)
    if json:
        print_json(loaded.model_dump(mode="json"))
        return
    print(dumps(loaded))
    for loop, phase_ns in zip(run.loops, run.phases_ns, strict=True):
        x0 = ", ".join(f"{value:.4g}" for value in loop.plant.initial_state)
        print(f"{_COMMENT}{loop.name}: begins at {phase_ns / NS_PER_S:.6f} s, x(0) = ({x0})")
        for line in _period_lines(loop):
            print(f"{_COMMENT}{loop.name}: {line}")


def _period_lines(resolved: Scenario) -> Iterator[str]:
    """Yield the periods that do not divide each other."""
    yield from uneven_periods(resolved)


def _print_plant(console: Console, resolved: Scenario) -> None:
    """Print a nonlinear plant's linearisation, and the defaults that depend on other keys."""
    if not resolved.coverage.is_linear:
        about = getattr(system_of(resolved), "about", resolved.plant.system.kind)
        console.print(f"the plant: {about}", highlight=False, markup=False)
    if (law := getattr(law_of(resolved), "about", None)) is not None:
        console.print(f"the controller: {law}", highlight=False, markup=False)
    if (near := linearisation(resolved)) is not None:
        for label, value in linearisation_rows(near):
            console.print(f"{label}: {value}", highlight=False, markup=False)
    for line in _dependent_defaults(resolved):
        console.print(line, highlight=False, markup=False)


def _dependent_defaults(resolved: Scenario) -> Iterator[str]:
    """Yield the keys without a value whose default depends on other keys, and what has no effect."""
    if resolved.network.mansd == 0 and resolved.network.loss.model != "lossless":
        yield "network.loss: no effect, since network.mansd = 0 lets every update pass"
    if resolved.controller.timeout_input == "hold" and resolved.controller.update_timeout_s is None:
        yield "controller.timeout_input: no effect without controller.update_timeout_s"
    yield from _period_lines(resolved)
    watchdog, timeout_s = resolved.plant.watchdog, resolved.timing.actuation_timeout_ns / NS_PER_S
    if watchdog.timeout_s is None:
        yield (f"plant.watchdog: policy {watchdog.policy}, after {timeout_s:g} s without an actuation")
    if resolved.controller.safe_input is None:
        yield "controller.safe_input: 0, the input before the first update"
    if resolved.start_within_s is None:
        yield (
            f"start_within_s: {DEFAULT_START_S:g}, longer on a busy machine; with `noack record`: unlimited"
        )
