"""End-to-end tests: control real emulators while they run."""

import json
from pathlib import Path

import pytest

from netem import stand_alone
from netem.control import emulator_commands
from netem.control.control_server import running
from netem.fates import FateRecorder
from netem.tc_words import settings_of
from noack.core.errors import ExitStatus
from tests.netem.conftest import Emulate
from tests.netem.engine.relays import endpoints
from tests.netem.fates.links import spec_of


def test_a_cap_set_at_runtime_is_kept(emulate: Emulate, capsys: pytest.CaptureFixture[str]) -> None:
    sent = [number.to_bytes(2) for number in range(320)]
    with endpoints(*["127.0.0.1"] * 2) as (server, client):
        for endpoint in (server, client):
            endpoint.settimeout(60)
        emulator = emulate("{}:{}".format(*server.getsockname()), "--control", "lab")
        client.connect((emulator.host, emulator.port))
        assert running() == ["lab"]
        for payload in sent[:20]:
            client.send(payload)
        assert [server.recv(10) for _ in range(20)] == sent[:20]

        assert emulator_commands.main(["set", "loss", "100%", "mansd 2"]) == ExitStatus.OK
        assert "forward: loss 100% mansd 2\n" in capsys.readouterr().out
        for payload in sent[20:]:
            client.send(payload)
        received = [int.from_bytes(server.recv(10)) for _ in range(100)]
        assert received == list(range(22, 320, 3))

        assert emulator_commands.main(["show", "--json"]) == ExitStatus.OK
        found = json.loads(capsys.readouterr().out)["links"][0]["forward"]
        assert (found["received"], found["forwarded"]) == (320, 120)
        assert (found["fates"]["dropped"], found["fates"]["forced"]) == (200, 100)
        assert (found["longest_loss_burst"], found["mansd"]) == (2, 2)
        assert found["loss"]["realised"] == pytest.approx(2 / 3)
        assert found["loss"]["predicted"] == pytest.approx(2 / 3)
        assert sum(found["unintended"].values()) == 0
        assert [flow["packets"] for flow in found["flows"]] == [320]

        assert emulator_commands.main(["set", "lab", "loss 5%"]) == ExitStatus.OK
        assert capsys.readouterr().err == (
            "noack netem set: relay forward no longer has mansd 2; the words replaced "
            "all settings\n"
        )
        emulator.finish()
    assert running() == []


def test_a_replay_uses_the_cap_of_its_trace_by_default(tmp_path: Path) -> None:
    path = tmp_path / "fates.parquet"
    with FateRecorder(path, [spec_of(settings_of("loss 60% mansd 2"), "relay")]):
        pass
    for words, cap in (("loss 100%", 2), ("loss 100% mansd 4", 4)):
        (spec,) = stand_alone._replaying([spec_of(settings_of(words), "relay")], path)
        assert (spec.forward.mansd, spec.reverse.mansd) == (cap, None)
        assert spec.decisions == {"forward": [], "reverse": []}
