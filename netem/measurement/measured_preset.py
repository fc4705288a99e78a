"""A preset of one's own: a measured network as a file that the word ``like`` names."""

import json
import re
from collections.abc import Mapping
from pathlib import Path

import tomli_w

from netem.core.errors import CallerError, printable
from netem.core.file_access import write_whole
from netem.core.number_format import counted, percent
from netem.impairments.link_settings import LinkSettings
from netem.measurement.fitted_network import fitted_impairments, fitted_loss
from netem.measurement.network_measurement import NetworkMeasurement
from netem.presets.preset import SUFFIX, Preset, PresetSource

_NAME = re.compile("[A-Za-z0-9][A-Za-z0-9_-]{0,63}")


def preset_path(text: str) -> Path:
    """Return the file of ``--preset NAME`` or ``--preset FOLDER/NAME.toml``.

    Raises:
        CallerError: the name cannot be that of a preset.
    """
    path = Path(text if text.endswith(SUFFIX) else f"{text}{SUFFIX}")
    if not _NAME.fullmatch(path.stem):
        raise CallerError(
            f"--preset {printable(text)}: a preset's name has letters, digits, _ and -, and begins with a "
            f"letter or digit"
        )
    return path


def fitted_words(measurement: NetworkMeasurement) -> str:
    """Return the words of a link that behaves as the measured network.

    Raises:
        CallerError: delays, or the number of losses, are not known.
    """
    measurement.require_delays("a preset (--preset)")
    ordered = not measurement.outcomes.out_of_order.any()
    loss = [{"kind": "loss", "loss": fitted_loss(measurement)}] if measurement.models else []
    impairments = _rounded([*loss, *fitted_impairments(measurement, ordered=ordered)])
    # Strict validation accepts lists for tuples only in JSON.
    settings = LinkSettings.model_validate_json(json.dumps({"impairments": impairments}))
    return " ".join(impairment.text() for impairment in settings.impairments)


def _rounded(value: object) -> object:
    """Return a table with six digits of each number, for people to read."""
    if isinstance(value, Mapping):
        return {key: _rounded(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_rounded(entry) for entry in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def measured_preset(measurement: NetworkMeasurement, name: str) -> Preset:
    """Return the preset of a measured network.

    Raises:
        CallerError: as :func:`fitted_words`, or the network has neither losses nor delays.
    """
    words = fitted_words(measurement)
    if not words:
        raise CallerError(f"{measurement.name}: neither losses nor delays; a preset would have no words")
    count, deadline_s = len(measurement.trace), measurement.options.deadline_s
    late = "" if deadline_s is None else f", later than {deadline_s:g} s included"
    lost = percent(measurement.bursts.losses / count)
    model = f"the {measurement.chosen.fit.model} chain of smallest BIC" if measurement.models else "no losses"
    outages = "; outages as a second chain" if measurement.is_outage.any() else ""
    return Preset(
        name=name,
        sentence=f"Measured: {printable(measurement.name)}, {lost} lost{late}",
        forward=words,
        fit=f"measured: {counted(count, 'packet')} in {measurement.observed_s:.1f} s; {model}{outages}; "
        "quantiles of the delays with their correlation. All losses and delays of the measurement are in the "
        "forward direction, those of round trips, too. A model per packet: it assumes the measured rate.",
        source=PresetSource(title=printable(measurement.name)),
    )


def write_preset(measurement: NetworkMeasurement, path: Path) -> Path:
    """Write the preset of a measured network; return the file.

    Raises:
        CallerError: as :func:`measured_preset`.
        MachineError: the file cannot be written.
    """
    preset = measured_preset(measurement, path.stem)
    note = f"# A preset: noack-netem ... like {path if path.is_absolute() else f'./{path}'}\n"
    return write_whole(path, note + preset_toml(preset))


def preset_toml(preset: Preset) -> str:
    """Return a preset as TOML, without default values."""
    return tomli_w.dumps(preset.model_dump(mode="json", exclude_defaults=True))
