"""The error of the set-up."""

from __future__ import annotations

USAGE_ERROR = 2
FAILED = 1


class SetupError(Exception):
    """Raised when set-up cannot continue.

    Args:
        message: what is wrong and what to do about it, for a person.
        exit_code: 2 where the machine or the call has to change, 1 where a step failed.
    """

    def __init__(self, message: str, exit_code: int = USAGE_ERROR) -> None:
        super().__init__(message)
        self.exit_code = exit_code
