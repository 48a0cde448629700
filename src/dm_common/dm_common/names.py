"""Names that nobody knows, answered with those that come near."""

import difflib
from collections.abc import Iterable

from dm_common.errors import CodedError, ErrorCode


class UnknownNameError(CodedError, ValueError):
    """No such name; the message lists the near ones, or says where it was looked for."""

    error_code = ErrorCode.UNKNOWN_NAME


def unknown_name(what: str, name: str, known: Iterable[str]) -> UnknownNameError:
    """The error for `name`, listing the known names nearest to it, or all of them when there are few."""
    names = list(known)
    near = difflib.get_close_matches(name, names, n=4, cutoff=0.5) or (names if len(names) <= 12 else [])
    hint = f"; did you mean {', '.join(near)}?" if near else f"; known are {', '.join(names[:3])} to {names[-1]}"
    return UnknownNameError(f"{what} {name!r} is unknown" + (hint if names else ""))
