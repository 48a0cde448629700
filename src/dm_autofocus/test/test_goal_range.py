"""What a goal is refused for before anything moves."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any, cast

import pytest
from dm_msgs.msg import Capabilities

from dm_autofocus.probe_action import ready_capabilities
from dm_common.errors import ErrorCode, Refusal


def test_a_mirror_that_reaches_nothing_is_not_focused() -> None:
    nothing = Capabilities(
        quality=Capabilities.CALIBRATED,
        curvature_min=math.nan,
        curvature_max=math.nan,
        error_code=ErrorCode.UNREACHABLE,
        message="no curvature is reachable",
    )
    probe = SimpleNamespace(controller=SimpleNamespace(missing=lambda: False), capabilities=nothing)
    with pytest.raises(Refusal, match="no curvature is reachable") as refused:
        ready_capabilities(cast(Any, probe))
    assert refused.value.error_code == ErrorCode.UNREACHABLE
