"""Shell completion: names of shipped files, run directories, keys of a scenario."""

from cosim.lazy_modules import lazy_modules
from cosim.record.run_directory import DEFAULT_RUNS, LATEST, SCENARIO_FILE
from cosim.shipped_files import shipped_names

with lazy_modules():
    from cosim.studies.paper import results
    from noack.scenario import runtime_parameters as parameters
    from noack.scenario import scenario, toml_file


def scenarios(incomplete: str) -> list[str]:
    """Return matching names of shipped scenarios; the shell completes file names itself."""
    return _matching(incomplete, shipped_names("scenarios"))


def campaigns(incomplete: str) -> list[str]:
    """Return matching names of shipped campaigns."""
    return _matching(incomplete, shipped_names("campaigns"))


def shipped(incomplete: str) -> list[str]:
    """Return matching names of shipped scenarios and campaigns."""
    return scenarios(incomplete) + campaigns(incomplete)


def papers(incomplete: str) -> list[str]:
    """Return matching names of published results."""
    return _matching(incomplete, list(results.NAMES))


def run_directories(incomplete: str) -> list[str]:
    """Return matching run directories below ``runs``, the newest first."""
    found = [path.parent for path in DEFAULT_RUNS.glob(f"*/{SCENARIO_FILE}")]
    by_name = sorted(found, key=lambda path: (path.name == LATEST, path.name), reverse=True)
    return _matching(incomplete, [str(path) for path in by_name])


def settings(incomplete: str) -> list[str]:
    """Return matching keys for ``--set``, each with its =."""
    known = (*parameters.SHORT, *toml_file.keys(scenario.Scenario))
    return _matching(incomplete, [f"{key}=" for key in known])


def runtime_parameters(incomplete: str) -> list[str]:
    """Return matching names of the runtime parameters, short and full."""
    short = parameters.SHORT
    return _matching(incomplete, [*short, *short.values()])


def _matching(incomplete: str, words: list[str]) -> list[str]:
    return [word for word in words if word.startswith(incomplete)]
