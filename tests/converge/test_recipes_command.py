"""What `dm recipes` takes as curvatures and added terms."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import pytest
import typer
from dm_msgs.action import BuildRecipes
from dm_msgs.msg import Capabilities, Recipe, RecipeBook
from typer.testing import CliRunner

from dm_client import DeformableMirrorError
from dm_common.errors import ErrorCode
from dm_common.optics.zernike import SPOKEN
from dm_common.recipes import terms_of
from dm_tools import cli
from dm_tools.long_actions import recipe_step
from dm_tools.running_suite import usual_spheres
from dm_tools.verbs import recipes
from dm_tools.verbs.recipes import curvatures_of, next_of


def test_a_list_or_a_range() -> None:
    assert curvatures_of("-0.02, 0,0.02") == [-0.02, 0.0, 0.02]
    assert curvatures_of("−0.02,0,0.02") == [-0.02, 0.0, 0.02]
    assert curvatures_of("-0.05:0.05:11") == pytest.approx([-0.05 + 0.01 * k for k in range(11)])
    assert 0.0 in curvatures_of("-0.05:0.05:11")
    assert curvatures_of("-0,05:0,05:11") == curvatures_of("-0.05:0.05:11")


@pytest.mark.parametrize(
    ("low", "high", "first", "last"),
    [
        (-0.07, 0.06, -0.05, 0.05),
        (-0.07, 0.01, -0.0684, 0.0084),
        (0.0, 1.0, 0.02, 0.98),
        (-3.7e-4, 3.7e-4, -3.552e-4, 3.552e-4),  # 0.2 m wide, with 2 um of stroke
    ],
)
def test_usual_spheres_are_in_reach(low: float, high: float, first: float, last: float) -> None:
    spheres = usual_spheres(Capabilities(curvature_min=low, curvature_max=high))
    assert len(set(spheres)) == 11 and (spheres[0], spheres[-1]) == (first, last)


def test_without_a_range_there_is_the_reason() -> None:
    nan = float("nan")
    with pytest.raises(RuntimeError, match="no curvature is reachable"):
        usual_spheres(Capabilities(curvature_min=nan, curvature_max=nan, message="no curvature is reachable"))


@pytest.mark.parametrize("text", ["a", "0:1", "0:1:1", "0:1:x", "0:1:3:4", "0,02", ",", "nan", "nan:1:3", "0:inf:3"])
def test_anything_else_is_refused(text: str) -> None:
    with pytest.raises(typer.BadParameter, match=f"curvatures = {text!r}"):
        curvatures_of(text)


def test_progress_names_the_shape_being_worked_on() -> None:
    terms = [*terms_of("coma sin=50"), *terms_of("astigmatism cos=200")]
    at = BuildRecipes.Feedback(step=3, recipes=1, curvature=0.02, max_zernike=4e-9)
    assert recipe_step(at, terms) == "2: +0.0200 1/m with astigmatism cos +200 nm, map 3: largest coefficient 4.0 nm"
    assert "with coma sin +50 nm, " in recipe_step(at, terms_of("coma sin=50")), "one set for all"
    assert recipe_step(at) == "2: +0.0200 1/m, map 3: largest coefficient 4.0 nm"


def test_without_a_terminal_each_map_is_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    """No bar is drawn into a file: a run of minutes would say nothing until its end."""
    told = [BuildRecipes.Feedback(step=step, curvature=0.02, max_zernike=4e-9) for step in (1, 1, 2)]

    def build_recipes(*_goal: Any, on_feedback: Callable[[Any], None]) -> BuildRecipes.Result:
        for feedback in told:
            on_feedback(feedback)
        return BuildRecipes.Result()

    recipes._build(SimpleNamespace(build_recipes=build_recipes), [0.02], 0.0, [])
    lines = [line for line in capsys.readouterr().out.splitlines() if line]
    assert lines == [f"recipe 1: +0.0200 1/m, map {step}: largest coefficient 4.0 nm" for step in (1, 2)]


def test_the_duration_is_told_beforehand(monkeypatch: pytest.MonkeyPatch) -> None:
    told = {"converge.settle_time": 0.5, "recipes.average": 8, "map_time": 0.3}
    monkeypatch.setattr(recipes, "get_parameter", lambda _client, _node, name: told[name])
    client = SimpleNamespace(capabilities=Capabilities(condition_time=4.4))
    assert recipes.expected_run(client, 4) == "4 recipes in about 58 s if a map takes 0.3 s"


def test_recipes_are_built_without_a_forecast_too(monkeypatch: pytest.MonkeyPatch) -> None:
    def silent(*_of: object) -> float:
        raise DeformableMirrorError(ErrorCode.TIMEOUT, "the node `calibration` does not answer")

    client = SimpleNamespace(
        subscribe=lambda *_topic: True,
        build_recipes=lambda *_goal, **_options: BuildRecipes.Result(message="1 of 1 recipes stored"),
        wait=lambda *_until: True,
        latest=lambda _topic: RecipeBook(calibration_id="a", recipes=[Recipe()]),
    )
    monkeypatch.setattr(recipes, "get_parameter", silent)
    monkeypatch.setattr(recipes, "running_suite", lambda _namespace: nullcontext(client))
    built = CliRunner().invoke(cli.make_app(), ["recipes", "--curvatures", "0.02"])
    assert built.exit_code == 0 and "1 of 1 recipes stored" in built.output, built.output


def test_added_terms_go_by_the_names_that_measure_prints() -> None:
    terms = dict(zip(SPOKEN, terms_of("astigmatism cos=200, coma sin=−50"), strict=True))
    assert {name: value for name, value in terms.items() if value} == pytest.approx(
        {"astigmatism cos": 2e-7, "coma sin": -5e-8}
    )


@pytest.mark.parametrize("text", ["coma=5", "coma sin", "coma sin=x", "", "coma sin=5, coma sin=-5"])
def test_terms_that_are_none_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match=f"zernike = {text!r}"):
        terms_of(text)


@pytest.mark.parametrize("words", [("--curvatures", "0.02"), ("--zernike", "coma sin=5"), ("--take-over",)])
def test_a_list_builds_nothing(words: tuple[str, ...]) -> None:
    refused = CliRunner().invoke(cli.make_app(), ["recipes", "--list", *words])
    assert refused.exit_code == 2 and f"--list and {words[0]}: only one of them" in refused.output


@pytest.mark.parametrize(
    ("book", "advice"),
    [
        (RecipeBook(), "./dm calibrate"),
        (RecipeBook(calibration_id="a"), "./dm recipes"),
        (RecipeBook(calibration_id="a", degauss_steps=100), "./dm check"),
        (RecipeBook(calibration_id="a", degauss_steps=100, recipes=[Recipe()]), "mode: conditioned"),
        (
            RecipeBook(calibration_id="a", degauss_steps=100, recipes=[Recipe(curvature=-0.02)]),
            "./dm focus -0.02 --conditioned",
        ),
        (
            RecipeBook(
                calibration_id="a",
                degauss_steps=100,
                recipes=[Recipe(conic_constant=-1.0), Recipe(zernike=[0.0, 1e-7]), Recipe(curvature=0.03)],
            ),
            "./dm focus 0.03 --conditioned",
        ),
        (
            RecipeBook(calibration_id="a", degauss_steps=100, recipes=[Recipe(curvature=0.02, conic_constant=-1.0)]),
            "requests of these shapes with `mode: conditioned`",
        ),
    ],
)
def test_what_to_do_next_goes_by_what_there_is(book: RecipeBook, advice: str) -> None:
    assert advice in next_of(book)
