"""``model.integral``: integral action, as a controller with states of its own.

ξ = ∫ (r − y) dt of outputs y = Cx, whose reference is r, and u = K(x − x_r) + K_i ξ + u_r. The scenario gives
the gain [K, K_i]. Where it is loaded, this becomes ``controller.kind = "state_space"`` with A = 0, B = −C,
C = K_i and D = K; :mod:`.controller_states` says how such a loop runs. So the sensor has ξ from what is
measured, and an update carries it.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from netem.core.errors import CallerError
from netem.core.settings_section import ReadTable
from noack.core.linear_systems import Matrix, Vector
from noack.plants.linear import NAMED_MODELS
from noack.protocol.record_tables import entry_names
from noack.scenario.sections import instability

_HELD = 1e-9
"""A singular value below this share of the largest one is 0."""


def augmented(A: Matrix, B: Matrix, C: Matrix) -> tuple[Matrix, Matrix]:
    """Return the matrices of the states (x, ξ), with dξ/dt = −Cx: (n + k, n + k) and (n + k, m).

    Args:
        A: (n, n).
        B: (n, m).
        C: (k, n).
    """
    (n, m), k = B.shape, len(C)
    return np.block([[A, np.zeros((n, k))], [-C, np.zeros((k, k))]]), np.vstack([B, np.zeros((k, m))])


def require_held(A: Matrix, B: Matrix, rows: Mapping[str, Vector]) -> None:
    """Raise ValueError unless a model can rest at any values of some outputs, by their names, together.

    It can if [A, B; C, 0] has independent rows, whatever the values are.
    """
    for names in (*([name] for name in rows), list(rows) if len(rows) > 1 else []):
        if not names:
            continue
        C = np.array([rows[name] for name in names])
        whole = np.block([[A, B], [C, np.zeros((len(C), B.shape[1]))]])
        size = np.abs(whole).max(axis=1, keepdims=True)
        sizes = np.linalg.svd(whole / np.where(size > 0, size, 1.0), compute_uv=False)
        if sizes[len(whole) - 1 : len(whole)].sum() > _HELD * sizes[0] and len(C) <= B.shape[1]:
            continue
        m = B.shape[1]
        if len(C) > 1:
            raise ValueError(
                f"the model cannot rest at any values of {' and '.join(names)} together; name fewer, at most "
                f"{m} for {m} input{'s' if m > 1 else ''}"
            )
        raise ValueError(
            f"the model rests at {names[0]} = 0 only, so no input can steer its integral; name another output"
        )


def with_integrals(content: ReadTable, source: str) -> ReadTable:
    """Return a scenario's content with a state-space controller in the place of ``model.integral``.

    Invalid content is returned unchanged.

    Raises:
        CallerError: an output is not known, the gain does not fit, or the input cannot hold the output; one
            line, which begins with ``source``.
    """
    converted = _converted(content, content, source)
    if not isinstance(loops := content.get("loops"), list):
        return converted
    entries = [
        _converted(loop, _with_base(content, loop), f"{source}: loops.{index}")
        if isinstance(loop, Mapping)
        else loop
        for index, loop in enumerate(loops)
    ]
    return {**converted, "loops": entries}


def _with_base(content: ReadTable, loop: ReadTable) -> ReadTable:
    """Return the tables of an entry of [[loops]] with those of the scenario, whose keys it replaces."""
    tables = {}
    for part in ("model", "controller"):
        both = [table for table in (content.get(part), loop.get(part)) if isinstance(table, Mapping)]
        tables[part] = {key: value for table in both for key, value in table.items()}
    return {**tables, "outputs": loop.get("outputs", content.get("outputs"))}


def _converted(table: ReadTable, whole: ReadTable, source: str) -> ReadTable:
    """Return a table whose model names integrals with its controller; ``whole`` has what it does not."""
    own, model, controller = table.get("model"), whole.get("model"), whole.get("controller", {})
    if not isinstance(own, Mapping) or "integral" not in own or not isinstance(model, Mapping):
        return table
    if not isinstance(controller, Mapping) or (numbers := _numbers(model)) is None:
        return table
    A, B, states = numbers
    given = own["integral"]
    names = [given] if isinstance(given, str) else given
    if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
        return table

    def refuse(text: str) -> CallerError:
        return CallerError(f"{source}: {text}")

    if not names:
        raise refuse('model.integral = []: give the names of outputs, e.g. "angle", or leave it out')
    if (kind := controller.get("kind", "linear")) != "linear":
        raise refuse(f'model.integral: not with controller.kind = "{kind}", which has states of its own')
    if len({*names}) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise refuse(f'model.integral: "{twice}" occurs twice; name each output once')
    rows = {**dict(zip(states, np.eye(len(A)), strict=True)), **_outputs(whole.get("outputs"), states)}
    for name in names:
        if name not in rows:
            known = ", ".join(rows)
            raise refuse(f'model.integral = "{name}": no output or state of this name; these are {known}')
    chosen = {name: rows[name] for name in names}
    try:
        require_held(A, B, chosen)
    except ValueError as error:
        raise refuse(f"model.integral: {error}") from None
    (n, m), k = B.shape, len(chosen)
    gain = _matrix(model.get("gain"))
    if gain is None or gain.shape != (m, n + k):
        found = "missing" if gain is None else f"{len(gain)} x {len(gain[0])}"
        raise refuse(
            f"model.gain: {found}, expected {m} x {n + k}: with model.integral it has a column for each "
            f"integral, too; noack gain --integral {','.join(names)} computes one"
        )
    whole_loop = (*augmented(A, B, np.array([*chosen.values()])), gain)
    if not model.get("allow_unstable") and (reason := instability(*whole_loop)) is not None:
        raise refuse(
            f"model.gain: with model.integral, {reason}; to run the unstable loop anyway, set "
            "model.allow_unstable = true"
        )
    state_space = {
        "kind": "state_space", "A": np.zeros((k, k)).tolist(),
        "B": [(0.0 - row).tolist() for row in chosen.values()], "C": gain[:, n:].tolist(),
    }  # fmt: skip
    kept = {key: value for key, value in own.items() if key != "integral"}
    return {
        **table,
        "model": {**kept, "gain": gain[:, :n].tolist()},
        "controller": {**table.get("controller", {}), **state_space},  # type: ignore[dict-item]
    }


def _numbers(model: ReadTable) -> tuple[Matrix, Matrix, Sequence[str]] | None:
    """Return A, B and the names of the states; None if the table is not valid."""
    name, given = model.get("name"), model.get("state_names")
    parameters = model.get("parameters", {})
    if isinstance(name, str) and name in NAMED_MODELS and isinstance(parameters, Mapping):
        try:
            named = NAMED_MODELS[name](**parameters)
        except TypeError:
            return None
        return named.A, named.B, _names(given, named.state_names)
    A, B = _matrix(model.get("A")), _matrix(model.get("B"))
    if A is None or B is None or A.shape != (len(B), len(B)):
        return None
    return A, B, _names(given, entry_names("x", len(A)))


def _names(given: object, default: Sequence[str]) -> Sequence[str]:
    """Return the names of the states, or the default if these are no names of as many."""
    if not isinstance(given, list | tuple) or len(given) != len(default):
        return default
    return [str(name) for name in given]


def _outputs(entries: object, states: Sequence[str]) -> dict[str, Vector]:
    """Return the rows of the outputs that are valid, by their names."""
    found = {}
    for entry in entries if isinstance(entries, list | tuple) else ():
        if not isinstance(entry, Mapping) or not isinstance(name := entry.get("name"), str):
            continue
        row = entry.get("row", name)
        if isinstance(row, str) and row in states:
            found[name] = np.eye(len(states))[list(states).index(row)]
        elif (values := _matrix([row])) is not None and values.shape == (1, len(states)):
            found[name] = values[0]
    return found


def _matrix(rows: object) -> Matrix | None:
    """Return a matrix of finite numbers; None if rows are none."""
    try:
        matrix = np.array(rows, dtype=np.float64)
    except (TypeError, ValueError):
        return None
    return matrix if matrix.ndim == 2 and matrix.size and np.isfinite(matrix).all() else None
