"""A parser with a mistake, by which it is seen that the fuzzer finds one."""

SEEDS = (b"",)


def one_input(data: bytes) -> None:
    for at, byte in enumerate(b"odd!"):
        if data[at : at + 1] != bytes([byte]):
            return
    raise KeyError("planted")
