"""`./dm compare --autofocus`: rivals on a hill, ours on a few drawn scenes, and what is printed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from studies.autofocus.baselines import BASELINES, Task
from studies.autofocus.photographs import Plate
from studies.autofocus.scenes import PHOTOGRAPH, RANGE, TEXTURES, SceneCamera, draw_scene
from studies.autofocus.trials import OURS, figures_of, run_drawn, run_scene
from studies.verbs.compare_autofocus import show


@pytest.mark.parametrize("name", BASELINES)
@pytest.mark.parametrize("start", [-0.05, -0.01, 0.03])
def test_every_rival_finds_a_wide_hill_without_noise(name: str, start: float) -> None:
    search = BASELINES[name](Task(-RANGE, RANGE, start, 0.008, 0.001))
    place = next(search)
    with pytest.raises(StopIteration) as end:
        while True:
            assert -RANGE <= place <= RANGE
            place = search.send(1 / (1 + ((place - 0.0123) / 0.01) ** 2))
    assert end.value.value == pytest.approx(0.0123, abs=0.001)


@pytest.mark.slow
def test_a_scene_is_the_same_for_the_same_seed_and_sharpest_in_focus() -> None:
    assert {draw_scene(seed).texture for seed in range(60)} == set(TEXTURES)
    scene = draw_scene(3)
    first, again, dull = (
        SceneCamera(scene).expose(place) for place in (scene.object_curvature, scene.object_curvature, RANGE)
    )
    np.testing.assert_array_equal(first, again)
    assert np.abs(np.diff(first.astype(float))).mean() > np.abs(np.diff(dull.astype(float))).mean()


@pytest.mark.slow
def test_few_images_are_enough(capsys: pytest.CaptureFixture[str]) -> None:
    trials = [trial for seed in range(2000, 2006) for trial in run_scene(seed, methods=(OURS,))]
    figures = figures_of(trials)
    assert figures.images[0] <= 10 and figures.seconds[0] <= 0.5
    assert figures.within_half >= 0.5
    # The two by chance look like a place that explains them, the evidence of which is small.
    blank = [trial for seed in (0, 1, 2, 4068, 5789) for trial in run_scene(seed, textured=False, methods=(OURS,))]
    assert [trial.error for trial in blank] == [None] * 5
    show({OURS: vars(figures)}, {OURS: {"scenes": 5, "false_finds": 0}})
    assert "few images" in capsys.readouterr().out


@pytest.mark.slow
def test_a_photograph_is_focused_like_what_is_drawn() -> None:
    scenes = [replace(draw_scene(seed), texture=PHOTOGRAPH, background=None) for seed in range(5000, 5006)]
    figures = figures_of([trial for scene in scenes for trial in run_drawn(scene, (OURS,))])
    assert figures.images[0] <= 10 and figures.found == 1
    assert figures.within_one >= 0.8 and figures.gross == 0


@pytest.mark.slow
def test_a_photograph_is_focused_through_the_true_surface_of_a_calibrated_mirror() -> None:
    plate = Plate(820)
    images, errors = np.array([plate.search(number) for number in range(4)]).T
    assert np.median(images) <= 12 and errors.max() <= 0.5
