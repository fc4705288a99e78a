"""The error of what has no document."""


class NoDocumentError(ValueError):
    """A loop that no document describes; the message says why."""
