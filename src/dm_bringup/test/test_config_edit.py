"""Values change, all else stays."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from dm_bringup.config_edit import edited, values_of
from dm_bringup.sections import ConfigError, values_in

FILE = Path(__file__).parents[1] / "config" / "hardware.yaml"
CHANGES = {
    "interferometer": {"orientation.rotate_deg": -35.02, "orientation.flip_x": True, "aperture.radius": 0.012},
    "pdm_driver": {"mirror.wiring": "custom", "mirror.channels": [3, 1, 2]},
}


def values(text: str) -> dict[str, dict[str, object]]:
    return {key.rsplit("/", 1)[-1]: part["ros__parameters"] for key, part in yaml.safe_load(text).items()}


def sections(text: str) -> dict[str, dict[str, object]]:
    return {key: part["ros__parameters"] for key, part in yaml.safe_load(text).items()}


def test_comments_and_all_other_lines_stay() -> None:
    before = FILE.read_text()
    after = edited(before, CHANGES)
    expected = values(before)
    for node, own in CHANGES.items():
        expected[node] |= own
    assert values(after) == expected
    kept = set(after.splitlines())
    lost = [line for line in before.splitlines() if line not in kept]
    assert [line.split(":")[0].strip() for line in lost] == ["mirror.wiring", "aperture.radius"]
    assert "# trihex | 37ch_30mm" in after and "# m: the working aperture; 0 = the whole valid region" in after
    assert edited(after, CHANGES) == after


@pytest.mark.parametrize(
    "text",
    ["", "pdm_driver:\n  ros__parameters:\n    a: 1\n", "pdm_driver:\n  ros__parameters: {a: 1}\n"],
    ids=["new section", "on lines", "in braces"],
)
def test_new_parameters_come_first_in_the_order_in_which_they_are_told(text: str) -> None:
    added = {"z": 1.0, "b": 2.0, "m": [3, 4]}
    assert list(values(edited(text, {"pdm_driver": added}))["pdm_driver"]) == [*added, *(["a"] if text else [])]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "# nothing yet\n",
        "/**/pdm_driver:\n  ros__parameters: {}\n",
        "/**/pdm_driver: {ros__parameters: {mirror.serial: a, mirror.channels: [1,\n 2]}}\n",
        "pdm_driver:\n  ros__parameters:\n    mirror.channels:  # as wired\n    - 1\n    - 2\n    # that is all\n"
        "    mirror.serial: a\n",
        "pdm_driver:\n  ros__parameters:\n    mirror.wiring: >-\n      trihex\n    mirror.serial: a\n",
    ],
)
def test_files_of_other_forms(text: str) -> None:
    after = values(edited(text, CHANGES))
    assert after["pdm_driver"]["mirror.channels"] == [3, 1, 2]
    assert after["interferometer"]["orientation.flip_x"] is True
    if "serial" in text:
        assert after["pdm_driver"]["mirror.serial"] == "a"
    assert all(comment in edited(text, CHANGES) for comment in ("# as wired", "# that is all") if comment in text)


def test_of_two_mirrors_in_a_file_one_changes() -> None:
    text = "/**/pdm_driver: {ros__parameters: {a: 1}}\n" + "".join(
        f"/{side}/pdm_driver: {{ros__parameters: {{mirror.wiring: trihex}}}}\n" for side in ("left", "right")
    )
    before, after = (yaml.safe_load(each) for each in (text, edited(text, CHANGES, "/right")))
    for node, values in CHANGES.items():
        before.setdefault(f"/right/{node}", {}).setdefault("ros__parameters", {}).update(values)
    assert after == before
    assert values_in(sections(edited(text, CHANGES, "third")), "pdm_driver", "third") == {
        "a": 1,
        **CHANGES["pdm_driver"],
    }
    assert yaml.safe_load(edited(text, CHANGES, "third"))["/**/pdm_driver"]["ros__parameters"]["a"] == 1
    other = "/left/interferometer: {ros__parameters: {b: 1}}\n"
    assert edited(f"{other}/**/pdm_driver: {{ros__parameters: {{a: 1}}}}\n", CHANGES, "third").startswith(other)


@pytest.mark.parametrize("others", ["/left/**/", "/left/*/", "/left/", "/**/left/"])
@pytest.mark.parametrize(
    "of_all",
    ["", *(f"{key}: {{ros__parameters: {{b: 1}}}}\n" for key in ("/**/interferometer", "/left/**", "/interferometer"))],
)
def test_what_is_found_of_one_mirror_does_not_reach_another(others: str, of_all: str) -> None:
    text = of_all + "".join(f"{others}{node}: {{ros__parameters: {{a: 1}}}}\n" for node in CHANGES)
    before, after = sections(text), sections(edited(text, CHANGES, "right"))
    for node, values in CHANGES.items():
        assert values.items() <= values_in(after, node, "right").items()
        for namespace in ("left", "left/upper", "third"):
            assert values_in(after, node, namespace) == values_in(before, node, namespace)


def test_a_change_that_a_later_section_would_overrule_is_refused() -> None:
    text = "/left/pdm_driver: {ros__parameters: {a: 1}}\n/**: {ros__parameters: {mirror.wiring: trihex}}\n"
    with pytest.raises(ConfigError, match=r"mirror\.wiring: 'trihex' overrules 'custom' of /left/pdm_driver"):
        edited(text, CHANGES, "left")


@pytest.mark.parametrize("later", ["/**/pdm_driver", "/pdm_driver"])
def test_a_change_that_a_section_of_as_many_nodes_would_overrule_is_refused(later: str) -> None:
    text = f"pdm_driver: {{ros__parameters: {{a: 1}}}}\n{later}: {{ros__parameters: {{a: 1}}}}\n"
    with pytest.raises(ConfigError, match=r"a later section of this file overrules \{'a': 2\} of pdm_driver"):
        edited(text, {"pdm_driver": {"a": 2}})


@pytest.mark.parametrize("value", ["1e5", ["1e5", "b"], "a", 1e-7, True, "true", "0.5"])
def test_texts_stay_texts(value: Any) -> None:
    found = sections(edited("", {"pdm_driver": {"mirror.serial": value}}))["/**/pdm_driver"]["mirror.serial"]
    assert found == value and type(found) is type(value)


@pytest.mark.parametrize("value", [0.5, "abc", []])
def test_a_list_in_lines_may_become_another_value(value: Any) -> None:
    text = "/**/pdm_driver:\n  ros__parameters:\n    a:\n    - 1\n    - 2  # the last\n    # that is all\n    b: 1\n"
    after = edited(text, {"pdm_driver": {"a": value}})
    assert sections(after)["/**/pdm_driver"] == {"a": value, "b": 1} and "# that is all" in after


def test_what_is_no_parameter_file_is_refused() -> None:
    for text in ("a: [", "- 1\n- 2\n", "/**/pdm_driver: 7\n"):
        with pytest.raises(ConfigError):
            edited(text, CHANGES)


@pytest.mark.parametrize("text", ["/**/pdm_driver: {ros__parameters: {}}\n...\n", '{"a/b": {"ros__parameters": {}}}'])
def test_a_file_to_which_nothing_can_be_added_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match=r"put in by hand: .*orientation\.flip_x"):
        edited(text, CHANGES)


def test_a_value_that_stands_in_a_group_is_never_overruled_by_it() -> None:
    text = "pdm_driver:\n  ros__parameters:\n    mirror:\n      wiring: trihex\n"
    assert values_of(text) == {"pdm_driver": {"mirror.wiring": "trihex"}}
    with pytest.raises(ConfigError, match="put in by hand"):
        edited(text, CHANGES)
