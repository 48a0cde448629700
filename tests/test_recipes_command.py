"""What `dm recipes` takes as curvatures."""

from __future__ import annotations

import pytest
import typer

from dm_tools.verbs.recipes import curvatures_of


def test_a_list_or_a_range() -> None:
    assert curvatures_of("-0.02, 0,0.02") == [-0.02, 0.0, 0.02]
    assert curvatures_of("-0.05:0.05:11") == pytest.approx([-0.05 + 0.01 * k for k in range(11)])
    assert 0.0 in curvatures_of("-0.05:0.05:11")


@pytest.mark.parametrize("text", ["a", "0:1", "0:1:1", "0:1:x", "0:1:3:4"])
def test_anything_else_is_refused(text: str) -> None:
    with pytest.raises(typer.BadParameter, match=f"curvatures = {text!r}"):
        curvatures_of(text)
