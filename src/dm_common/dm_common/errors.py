"""A request that is not carried out."""

from __future__ import annotations


class Refusal(Exception):
    """An ErrorCode and a sentence that a person can act on."""

    def __init__(self, error_code: int, message: str) -> None:
        super().__init__(message)
        self.error_code = error_code
