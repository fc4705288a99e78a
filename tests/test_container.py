"""The containers of a run: compose.yaml against the commands, the addresses and the image."""

import ipaddress
import re
from typing import Any

import pytest
import typer
import yaml

from cosim.cli.application import app
from netem.core.command_line import Parser
from noack.protocol.roles import LOOP_ROLES
from noack.runtime.join_run import add_options
from tests.helpers.pages import ROOT

COMPOSE: dict[str, Any] = yaml.safe_load((ROOT / "compose.yaml").read_text())
SERVICES: dict[str, Any] = COMPOSE["services"]


@pytest.mark.parametrize("name", ["recorder", *LOOP_ROLES])
def test_each_process_has_a_container_with_a_command_of_noack(name: str) -> None:
    command, *arguments = SERVICES[name]["command"]
    assert command == {"recorder": "record"}.get(name, name)
    if command == "netem":
        add_options(parser := Parser(allow_abbrev=False))
        assert str(parser.parse_args(arguments).credentials) == "/credentials/run/netem"
        return
    typer_command = typer.main.get_command(app).commands[command]  # type: ignore[attr-defined]
    context = typer_command.make_context(command, arguments)
    folder = "/credentials/run" if command == "record" else f"/credentials/run/{name}"
    assert str(context.params["credentials"]) == folder


def test_the_recorder_listens_on_its_own_address() -> None:
    recorder, (config,) = SERVICES["recorder"], COMPOSE["networks"]["loop"]["ipam"]["config"]
    own = recorder["networks"]["loop"]["ipv4_address"]
    command = recorder["command"]
    assert command[command.index("--listen") + 1].partition(":")[0] == own
    assert ipaddress.ip_address(own) in ipaddress.ip_network(config["subnet"])


def test_volumes_and_folders_are_those_of_the_image() -> None:
    image = (ROOT / "Containerfile").read_text()
    for service in SERVICES.values():
        for volume in service["volumes"]:
            name, _, folder = volume.partition(":")
            assert name in COMPOSE["volumes"]
            assert re.search(rf"mkdir -p.* {folder}\b", image)
    for copied in re.findall(r"^COPY (\S+) ", image, re.MULTILINE):
        assert (ROOT / copied).exists()
    python = re.search(r"^FROM \S+/python:(\d+)\.(\d+)", image, re.MULTILINE)
    assert python is not None
    assert tuple(map(int, python.groups())) >= (3, 11)
