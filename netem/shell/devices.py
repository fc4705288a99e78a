"""The two TUN devices of a shell: the one inside its network namespace, and the one outside.

The outside is this process's network namespace. If this user may not open devices there, the
process enters a user namespace of its own, and an outside without other networks.

All shells have addresses in 198.18.0.0/16, of the range for the test of network devices (RFC 2544),
and in a unique local prefix of IPv6 (RFC 4193). Each shell has one of 16 parts of the range of the
shell around it. Hence longer prefixes lead to inner shells, and shells need no address translation.
"""

import errno
import fcntl
import os
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from ipaddress import IPv4Address, IPv4Interface, IPv4Network, IPv6Address
from pathlib import Path
from typing import NoReturn

from netem.core.errors import CallerError, MachineError, why
from netem.core.system_processes import exhausted_limit, python_command
from netem.relay.relay_links import DeviceLink, LinkSpec
from netem.shell import process

MTU_BYTES = 1500
_RANGE = IPv4Network("198.18.0.0/16")
_RANGE6, _RANGE6_BITS = IPv6Address("fd6e:6f61:636b::"), 48
_STEP_BITS, _MOST_BITS = 4, 28
"""Each shell divides its range into 2⁴ parts; a range with a prefix of 28 bits is not divided."""
_QUEUE_PACKETS = 4000
"""Maximum number of packets that wait in a device: 0.1 s at 0.48 Gbit/s."""
_DEVICE, _INSIDE = "/dev/net/tun", "noack0"
_SET_INTERFACE, _GET_ADDRESS, _GET_MASK = 0x400454CA, 0x8915, 0x891B
"""Requests of ioctl: TUNSETIFF, SIOCGIFADDR, SIOCGIFNETMASK."""
_TUN, _NO_HEADER, _EXCLUSIVE = 0x1, 0x1000, 0x8000
"""Flags of TUNSETIFF: IFF_TUN, IFF_NO_PI, IFF_TUN_EXCL."""
_ENTERED = "NOACK_SHELL_OUTSIDE"
"""Environment variable of a process that has entered, or could not enter, its own outside."""
_RESTRICTIONS = {
    "kernel/apparmor_restrict_unprivileged_userns": ("1", 0),
    "kernel/unprivileged_userns_clone": ("0", 1),
    "user/max_user_namespaces": ("0", 10000),
}
"""Settings in /proc/sys that forbid user namespaces, and values that permit them."""


def open_devices(spec: LinkSpec) -> DeviceLink:
    """Open and configure the devices of a shell; this may start the program again.

    Args:
        spec: the link; its addresses are replaced.

    Raises:
        CallerError: the system does not permit it or lacks something, or there are too many shells.
    """
    try:
        addresses = _namespace_range()
        number, outer = _first_free(addresses)
        own_namespace = _open_namespace()
        process.call("unshare", process.NEW_NETWORK)
    except PermissionError:
        _enter_outside()
    os.environ.pop(_ENTERED, None)
    network = list(addresses.subnets(_STEP_BITS))[number]
    outside_address, inside_address = network[1], network[2]
    inner = _open_tun(_INSIDE)
    _configure(_INSIDE, inside_address, network.prefixlen)
    has_ipv6 = _ip("route add ::/0 dev noack0", "route add 0.0.0.0/0 dev noack0")
    for setting in ("ipv4/ip_forward", "ipv6/conf/all/forwarding"):
        with suppress(OSError):  # without it, shells in this one reach only this one
            Path("/proc/sys/net", setting).write_text("1")
    namespace, inner_counts = _open_namespace(), _open_counts()
    process.call("setns", own_namespace, process.NEW_NETWORK)
    os.close(own_namespace)
    _configure(f"noack{number}", outside_address, network.prefixlen)
    return DeviceLink(
        replace(spec, listen=(str(inside_address), 0), to=(str(outside_address), 0)),
        (inner, outer),
        (inner_counts, _open_counts()),
        namespace,
        str(_ipv6_address(outside_address)) if has_ipv6 else None,
    )


@contextmanager
def inside(link: DeviceLink) -> Iterator[None]:
    """Let this thread be inside within the context: what it starts then stays there."""
    own_namespace = _open_namespace()
    process.call("setns", link.namespace, process.NEW_NETWORK)
    try:
        yield
    finally:
        process.call("setns", own_namespace, process.NEW_NETWORK)
        os.close(own_namespace)


def _namespace_range() -> IPv4Network:
    """Return the addresses of which a shell in this namespace gets a part."""
    request = struct.pack("16s16x", _INSIDE.encode())
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as endpoint:
        try:
            address, mask = (
                socket.inet_ntoa(fcntl.ioctl(endpoint, query, request)[20:24])
                for query in (_GET_ADDRESS, _GET_MASK)
            )
        except OSError:  # this is not in a shell
            return _RANGE
    addresses = IPv4Interface(f"{address}/{mask}").network
    if addresses.prefixlen >= _MOST_BITS:
        raise CallerError("shells nest three deep; give the words of several to one shell")
    return addresses


def _first_free(addresses: IPv4Network) -> tuple[int, int]:
    """Open the outer device with the first free number; return the number and the device."""
    parts = 1 << _STEP_BITS
    for number in range(1, parts):  # the first part has the addresses of the shell around
        try:
            return number, _open_tun(f"noack{number}")
        except OSError as error:
            if error.errno != errno.EBUSY:
                raise
    raise CallerError(f"{parts - 1} shells run in this network namespace; wait for one to end")


def _open_tun(name: str) -> int:
    try:
        device = os.open(_DEVICE, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        if limit := exhausted_limit(error):
            raise MachineError(limit) from None
        raise CallerError(
            f"a shell needs {_DEVICE} ({error.strerror}); as root: `modprobe tun` or "
            f"`chmod 666 {_DEVICE}`; for a container: `--device {_DEVICE}`"
        ) from None
    flags = _TUN | _NO_HEADER | _EXCLUSIVE
    fcntl.ioctl(device, _SET_INTERFACE, struct.pack("16sH22x", name.encode(), flags))
    return device


def _configure(name: str, address: IPv4Address, prefix_bits: int) -> None:
    """Give a device its addresses, and let packets pass."""
    prefix6_bits = _RANGE6_BITS + prefix_bits - _RANGE.prefixlen
    _ip(
        "link set lo up",
        f"link set {name} mtu {MTU_BYTES} txqueuelen {_QUEUE_PACKETS} up",
        f"address add {_ipv6_address(address)}/{prefix6_bits} dev {name} nodad",
        f"address add {address}/{prefix_bits} dev {name}",
    )


def _ipv6_address(address: IPv4Address) -> IPv6Address:
    """Return the address of IPv6 beside one of IPv4, by the latter's lower 16 bits."""
    return _RANGE6 + ((int(address) & 0xFFFF) << 64)


def _ip(*commands: str) -> bool:
    """Run commands of ``ip``; return whether all succeed. The last one must, without IPv6, too."""
    lines = "\n".join(commands).encode()
    try:
        result = subprocess.run(["ip", "-force", "-batch", "-"], input=lines, capture_output=True)
    except FileNotFoundError:
        raise CallerError("a shell needs `ip` (Debian: apt install iproute2)") from None
    except OSError as error:
        raise MachineError(f"`ip` cannot be started: {exhausted_limit(error) or why(error)}") from None
    errors = result.stderr.decode(errors="replace").splitlines()
    if f"Command failed -:{len(commands)}" in errors:
        raise CallerError(f"ip {commands[-1]}: {errors[-2]}")
    return result.returncode == 0


def _open_namespace() -> int:
    return os.open("/proc/thread-self/ns/net", os.O_RDONLY | os.O_CLOEXEC)


def _open_counts() -> int:
    return os.open("/proc/thread-self/net/dev", os.O_RDONLY | os.O_CLOEXEC)


def _enter_outside() -> NoReturn:
    """Start the program again in a user namespace and an outside of its own."""
    if _ENTERED not in os.environ:
        os.environ[_ENTERED] = "1"
        outside = python_command("-IS", process.__file__, "outside")
        os.execv(outside[0], [*outside, outside[0], *sys.orig_argv[1:]])
    remedy = "run it as root, or in a container with `--cap-add NET_ADMIN --cap-add SYS_ADMIN`"
    for name, (forbids, permits) in _RESTRICTIONS.items():
        with suppress(OSError):
            if Path("/proc/sys", name).read_text().strip() == forbids:
                remedy = f"as root: `sysctl -w {name.replace('/', '.')}={permits}`"
                break
    raise CallerError(f"this system does not permit this user to create namespaces; {remedy}")
