"""What a check of the doctor finds."""

from collections.abc import Callable
from typing import NamedTuple


class Finding(NamedTuple):
    """Something a person should know.

    Attributes:
        problem: what is wrong, in words.
        cure: what to do about it; "" = nothing, all is well.
        note: True = worth knowing, but nothing is broken.
    """

    problem: str
    cure: str
    note: bool = False


#: A name and what finds out; None when all is well.
Check = tuple[str, Callable[[], Finding | None]]
