"""The emulator as a shell: a command all of whose IP packets pass a link."""
