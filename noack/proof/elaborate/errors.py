"""What the elaborator refuses, and what it rejects."""

_LONGEST_MESSAGE = 300


class RefusedError(ValueError):
    """No statement covers the scenario; the message is one line that names the key."""


class RejectedError(ValueError):
    """A loop or the result of a search has no meaning, or does not prove its bound; one line says which."""

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message[:_LONGEST_MESSAGE].split()))
