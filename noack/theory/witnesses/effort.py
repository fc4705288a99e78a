"""The effort of a search: how far it is, and when it ends. It is counted in problems, not in seconds."""

import math

from noack.core.progress import Progress

MOST_WORK = 20.0
"""A search ends after so many 10⁹ products per step of the solver: some minutes."""
PROBLEMS = 10
"""A usual search has work for at least so many problems. A larger problem takes minutes: those of the F-16
under its schedule need 9 to 17. In eleven shipped scenarios the largest one is 0.5."""
_LAST_SHARE = 0.99
_MANY = 12


class NoWitnessError(ArithmeticError):
    """No witness was found; the message says what fails first."""


class WorkLimitError(NoWitnessError):
    """The search has reached its limit of work."""


class TooLargeError(WorkLimitError):
    """A problem is too large for the solver."""


def too_large(work: float, most: float) -> TooLargeError:
    """Return that a problem needs so many 10⁹ products per step, which are more than ``most``."""
    share = math.ceil(10 * work / most) / 10
    return TooLargeError(
        f"the loop's inequalities are too large for the search, by a factor of {max(share, 1.1):g}"
    )


class Effort:
    """Counts the problems that a search solves.

    Args:
        progress: called with the completed share, which does not fall.
        most_work: the search ends before the problem with which its work would exceed this.
    """

    def __init__(self, progress: Progress, most_work: float = MOST_WORK) -> None:
        self._progress, self._most_work = progress, most_work
        self.most_per_problem = max(most_work, MOST_WORK) / PROBLEMS
        self._problems, self._expected, self._work, self._share = 0, 0, 0.0, 0.0

    def has_room(self, work: float) -> bool:
        """Return whether a search has work for many problems of a size."""
        return self._most_work > _MANY * work

    def expect(self, problems: int) -> None:
        """Add problems to those that are expected."""
        self._expected += problems

    def add(self, output: str, work: float) -> None:
        """Count the next problem.

        Raises:
            WorkLimitError: it is one too many.
            TooLargeError: it is too large.
        """
        if work > self.most_per_problem:
            raise too_large(work, self.most_per_problem)
        if self._work + work > self._most_work:
            raise WorkLimitError(
                f"{output}: the search ended after {self._problems} problems, at its limit of work"
            )
        self._problems, self._work = self._problems + 1, self._work + work
        done = self._problems / max(self._expected, self._problems + 1)
        self._share = max(self._share, min(done, _LAST_SHARE))
        self._progress(self._share)
