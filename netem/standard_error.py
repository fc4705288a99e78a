"""Lines on standard error, for whoever runs the emulator."""

from noack.runtime.command_line import print_to_stderr


def say(line: str) -> None:
    """Say something; the emulator goes on if nobody can hear it any more."""
    print_to_stderr(f"noack netem: {line}")
