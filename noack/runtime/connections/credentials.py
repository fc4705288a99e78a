"""What a process on another host needs to reach a run, in a folder of its role.

``run.json`` is the run descriptor, with the address of the recording host. ``ca.pem`` is the
certificate of the run's own authority; ``certificate.pem`` and ``private_key.pem`` are those of the
role, signed by it. zenoh reads them itself: each end of a connection accepts only certificates of
this authority (mutual TLS), and the recording host accepts from each role only what this role
sends. :mod:`cosim.live.coordination.remote_access` makes these folders.
"""

import os
import socket
import stat
from pathlib import Path

from netem.core.address import Address, address_text, family_of
from netem.core.errors import CallerError, NoAnswerError, PeerError, why
from netem.core.file_access import open_regular
from noack.protocol.roles import COORDINATOR, LOOP_ROLES
from noack.runtime.run_descriptor import RunDescriptor, parse_descriptor

RUN_FILE = "run.json"
CA_FILE, CERTIFICATE_FILE, KEY_FILE = "ca.pem", "certificate.pem", "private_key.pem"
_MOST_BYTES = 64 * 2**20
"""Of ``run.json``: more than any scenario needs."""
_LOOK_S = 2.0
_ALL_MESSAGES = (
    "put",
    "delete",
    "query",
    "reply",
    "declare_subscriber",
    "declare_queryable",
    "liveliness_token",
    "liveliness_query",
    "declare_liveliness_subscriber",
)
_SUBSCRIBING = ("declare_subscriber", "liveliness_query", "declare_liveliness_subscriber")


def tls_settings(folder: str, *, listen: bool) -> dict[str, object]:
    """Return zenoh's settings of TLS for the end that listens, or that connects.

    They are described at https://zenoh.io/docs/manual/tls.
    """
    side = "listen" if listen else "connect"
    return {
        "root_ca_certificate": str(Path(folder, CA_FILE)),
        f"{side}_certificate": str(Path(folder, CERTIFICATE_FILE)),
        f"{side}_private_key": str(Path(folder, KEY_FILE)),
        "enable_mtls": True,
        "verify_name_on_connect": True,
    }


def access_control(run_key: str) -> dict[str, object]:
    """Return zenoh's access control on the recording host: each role sends what is its own.

    A role is the common name of a certificate. Processes of this host come by a Unix socket, and may
    send everything. Without it a process with the sensor's certificate could join as the controller,
    or stop the run.
    """
    rules: list[dict[str, object]] = [_rule("local", ["**"], _ALL_MESSAGES, "ingress", "egress")]
    subjects: list[dict[str, object]] = [{"id": "local", "link_protocols": ["unixsock-stream"]}]
    policies: list[dict[str, object]] = [{"rules": ["local"], "subjects": ["local"]}]
    for role in LOOP_ROLES:
        own = [f"{query}/{role}" for query in ("admit", "join", "report", "done")]
        own += [f"telemetry/{role}/**", f"ended/{role}/*", f"alive/{role}/*"]
        received = ["stop", "change", "done/*", f"persisted/{role}", f"alive/{COORDINATOR}/*"]
        own, received = ([f"{run_key}/{key}" for key in keys] for keys in (own, received))
        rules += [
            _rule(f"{role}'s own", own, _ALL_MESSAGES, "ingress", "egress"),
            _rule(f"{role} subscribes", received, _SUBSCRIBING, "ingress"),
            _rule(f"{role} receives", received, _ALL_MESSAGES, "egress"),
        ]
        subjects.append({"id": role, "cert_common_names": [role]})
        names = [f"{role}'s own", f"{role} subscribes", f"{role} receives"]
        policies.append({"rules": names, "subjects": [role]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _rule(name: str, keys: list[str], messages: tuple[str, ...], *flows: str) -> dict[str, object]:
    return {
        "id": name,
        "permission": "allow",
        "messages": list(messages),
        "flows": list(flows),
        "key_exprs": keys,
    }


def read_credentials(folder: Path, role: str, runs: Path) -> RunDescriptor:
    """Return the run descriptor of a folder, as this host uses it.

    Sockets of loop data listen on the address from which this host reaches the recording host. Rows
    that cannot be sent to the recorder stay below ``runs``, in a folder with the run's name. Raise
    CallerError if a file is missing or other users can read it, or the folder is another role's; or
    ``runs`` cannot be written; PeerError if there is no route to the recording host.
    """
    if not (folder / RUN_FILE).exists() and (folder / role).is_dir():
        raise CallerError(f"{folder}: has the credentials of all roles; give {folder / role}")
    files = (RUN_FILE, CA_FILE, CERTIFICATE_FILE, KEY_FILE)
    content, *_ = [_private_content(folder / file) for file in files]
    try:
        descriptor = parse_descriptor(content.decode())
    except (CallerError, UnicodeDecodeError) as error:
        raise CallerError(f"{folder / RUN_FILE}: not of `noack record --listen`: {error}") from None
    if descriptor.remote is None or descriptor.credentials_for != role:
        owner = f"of {descriptor.credentials_for}" if descriptor.credentials_for else "of no role"
        raise CallerError(f"{folder}: these credentials are {owner}, not of {role}")
    name = Path(descriptor.run_dir).name
    if name in ("", "..") or "\0" in name:
        raise CallerError(f"{folder / RUN_FILE}: its run directory has no name")
    _require_writable(runs.resolve())
    changes = {
        "host": own_host(descriptor.remote),
        "run_dir": str(runs.resolve() / name),
        "credentials": str(folder.resolve()),
    }
    return descriptor.model_copy(update=changes)


def _private_content(path: Path) -> bytes:
    """Return the content of a file; raise CallerError unless it is readable for its owner only."""
    try:
        with open_regular(path) as file:
            status = os.fstat(file.fileno())
            if status.st_uid != os.getuid() or stat.S_IMODE(status.st_mode) & 0o077:
                raise CallerError(
                    f"{path}: it is secret, but other users can read or change it; "
                    f"make it yours alone: chmod 600 {path}"
                )
            content = file.read(_MOST_BYTES + 1)
    except (OSError, ValueError) as error:
        raise CallerError(f"{path}: cannot be read: {why(error)}; copy the whole folder") from None
    if len(content) > _MOST_BYTES:
        raise CallerError(f"{path}: larger than {_MOST_BYTES // 2**20} MiB")
    return content


def _require_writable(folder: Path) -> None:
    """Raise CallerError unless a folder can be made or written: rows may have to be kept there."""
    nearest = folder
    while not os.access(nearest, os.F_OK) and nearest != nearest.parent:
        nearest = nearest.parent
    if not nearest.is_dir():
        raise CallerError(f"{folder}: rows could not be kept there: {nearest} is not a folder")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise CallerError(f"{folder}: rows could not be kept there: {nearest} is not writable")


def own_host(address: Address) -> str:
    """Return the numeric address from which this host sends to another one.

    Raise PeerError without a route.
    """
    with socket.socket(family_of(address), socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(address)  # sends nothing
        except OSError as error:
            raise PeerError(f"cannot reach {address_text(address)}: {why(error)}") from None
        return str(probe.getsockname()[0])


def no_connection(address: Address) -> NoAnswerError:
    """Return why zenoh could not connect with a run: it reports a timeout, whatever the reason is."""
    try:
        with socket.create_connection(address, _LOOK_S):
            reason = (
                "a program listens there, but it is busy, or did not accept these credentials; each run "
                "has new ones: copy those of the open run"
            )
    except TimeoutError:
        reason = "no answer; is it the recording host's address? Do firewalls pass TCP to this port?"
    except ConnectionRefusedError:
        reason = "nothing listens there; has `noack record` ended? Each run has new credentials"
    except OSError as error:
        reason = why(error)
    return NoAnswerError(f"cannot reach the run at {address_text(address)}: {reason}")
