"""Reading TOML that nobody vouches for, with limits of size and depth.

:mod:`tomllib` needs memory for n² parts for a key of n parts. So keys with too many parts are refused
before the text is parsed.
"""

import re
import tomllib

MOST_LEVELS = 32
"""Most parts of a dotted key, and levels of nested tables and lists."""
TOO_DEEP = f"tables and lists lie within each other more than {MOST_LEVELS} levels deep"

_STRING = re.compile(
    r"""
      (?P<comment> \# [^\n]*+ )
    | \"{3} (?: [^"\\] | \\.? | "(?!"") )*+ (?: \"{3,5} )?
    | '{3} (?: [^'] | '(?!'') )*+ (?: '{3,5} )?
    | " (?: [^"\\\n] | \\[^\n]? )*+ "?
    | ' [^'\n]*+ '?
    """,
    re.VERBOSE | re.DOTALL,
)
"""Strings and comments of TOML; an unterminated one ends at the last possible place."""
_LONG_KEY = re.compile(rf"(?<![\w-])(?:[\w-]++[ \t]*+\.[ \t]*+){{{MOST_LEVELS}}}")


class TooLargeTextError(ValueError):
    """A text has too large numbers, too long keys, or is nested too deeply; the message says which."""


def parse_toml(text: str) -> dict[str, object]:
    """Return the tables of a TOML text.

    Raises:
        TooLargeTextError: it exceeds a limit.
        tomllib.TOMLDecodeError: it is no TOML.
    """
    masked = _STRING.sub(lambda match: "" if match["comment"] else "_", text)
    if _LONG_KEY.search(masked):
        raise TooLargeTextError(f"a key has more than {MOST_LEVELS} parts")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise TooLargeTextError(TOO_DEEP) from None
    except tomllib.TOMLDecodeError:
        raise
    except ValueError:  # an integer has thousands of digits
        raise TooLargeTextError("an integer is too large") from None
