"""Explains the cap and the other settings of a link; each impairment explains itself."""

from noack.impairments.link_settings import LinkSettings


def settings_meaning(settings: LinkSettings) -> list[tuple[str, str]]:
    """Return (words, meaning) of the cap and the other settings."""
    found = []
    if settings.mansd is not None:
        found.append((
            f"mansd {settings.mansd}",
            f"the cap (M − 1): at most {settings.mansd} consecutive packets of a flow are not "
            "delivered; the next one passes, whatever the impairments say",
        ))  # fmt: skip
    if settings.first_delivered:
        found.append((
            "first",
            "the first packet of each flow is delivered, whatever the impairments say; the cap "
            "for later packets is mansd",
        ))  # fmt: skip
    if any(one.delays for one in settings.impairments):
        found.append((
            f"limit {settings.limit}",
            f"at most {settings.limit} packets are delayed at once; more are dropped",
        ))  # fmt: skip
    return found
