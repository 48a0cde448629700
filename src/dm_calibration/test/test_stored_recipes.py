"""Recipes kept with a calibration: its file changes whole or not at all, the raw data never."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from dm_calibration.calibration import Calibration
from dm_calibration.calibration_manager import CalibrationManager
from dm_calibration.calibrator import Provenance, calibrate
from dm_calibration.influence.fit import FitOptions
from dm_calibration.procedure.plan import PlanKind, make_plan
from dm_calibration.procedure.procedure import Procedure
from dm_calibration.store.calibration_store import CalibrationStore
from dm_common.atomic_write import StoreError
from dm_common.errors import ErrorCode, Refusal, UnknownNameError, error_code
from dm_common.recipes import NO_RECIPES, Recipe, RecipeBook, RecipeError
from hysteretic_mirror import MIRROR, lagging_bench
from linear_mirror import make_mirror

ACTUATORS = MIRROR.actuators


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    outcome = Procedure(make_plan(PlanKind.POKES, MIRROR), MIRROR, lagging_bench()).run()
    return calibrate(outcome, mirror=MIRROR, options=FitOptions(), provenance=Provenance("known", 10**18))


class Rig:
    """A manager with one stored calibration in use."""

    def __init__(self, folder: Path, calibration: Calibration) -> None:
        self.published: list[Calibration | None] = []
        self.store = CalibrationStore(folder)
        self.file = self.store.save(calibration)
        self.resting = ""
        self.manager = CalibrationManager(
            self.store, lambda: 0.01, lambda: 0, lambda one, _file: self.published.append(one), lambda: self.resting
        )
        self.manager.set_mirror(MIRROR)
        self.manager.load("known")


@pytest.fixture
def rig(tmp_path: Path, calibration: Calibration) -> Rig:
    return Rig(tmp_path, calibration)


def book(*curvatures: float, actuators: int = ACTUATORS, steps: int = 100, maps: int = 20) -> RecipeBook:
    def recipe(curvature: float) -> Recipe:
        values = np.linspace(-1.0, 1.0, actuators)
        return Recipe(curvature, 0.0, values, values, 3e-10, 1e-9, maps)

    return RecipeBook(tuple(recipe(curvature) for curvature in curvatures), steps, 1e-10)


def raw_data(file: Path) -> dict[str, bytes]:
    """Datasets of what was measured, as they lie in the file."""
    found: dict[str, Any] = {}
    with h5py.File(file) as content:
        for group in ("maps", "points", "mirror"):
            content[group].visititems(lambda name, item, group=group: found.update({f"{group}/{name}": item[()]}))
    return {name: value.tobytes() if value.dtype != object else b"|".join(value) for name, value in found.items()}


def test_the_next_start_uses_what_was_in_use_last(rig: Rig, calibration: Calibration) -> None:
    """Not one that was stored later without being used; the newest where the last is gone, which is said."""
    newer = rig.store.save(replace(calibration, id="newer", created_ns=calibration.created_ns + 1))
    used, reason = rig.manager.load_last()
    assert (used.id, reason) == ("known", "")
    rig.file.unlink()
    used, reason = rig.manager.load_last()
    assert used.id == "newer" == rig.store.last_in_use(calibration.mirror_serial)
    assert reason.startswith("the calibration last in use, known, cannot be loaded: calibration 'known': no such file")
    for content in (b"newer\n", b"~nobody", b"../newer", b"\xff"):
        (rig.store.folder / "in_use_T-1.txt").write_bytes(content)
        assert rig.manager.load_last()[0].id == "newer"
    newer.unlink()
    with pytest.raises(Refusal, match="no calibration in"):
        rig.manager.load_last()


def test_a_disk_that_takes_no_note_is_a_warning(rig: Rig, calibration: Calibration) -> None:
    (rig.store.folder / "in_use_T-1.txt").unlink()
    (rig.store.folder / "in_use_T-1.txt").mkdir()
    assert "warning: known is in use, but could not be noted for the next start: " in rig.manager.use(calibration)
    assert rig.published[-1] is calibration
    assert "could not be noted for the next start: " in rig.manager.load("known")[1]


def test_recipes_join_the_calibration_and_its_file(rig: Rig) -> None:
    before = raw_data(rig.file)
    rig.manager.add_recipes("known", book(-0.01, 0.02))
    rig.manager.add_recipes("known", book(0.0, 0.02, maps=33))
    loaded = rig.store.load("known")
    assert [(r.curvature, r.maps) for r in loaded.recipes.recipes] == [(-0.01, 20), (0.0, 33), (0.02, 33)]
    assert len(before) > 10
    assert raw_data(rig.file) == before
    assert sorted(file.name for file in rig.file.parent.iterdir()) == ["in_use_T-1.txt", "known.h5"]
    assert rig.published[-1] is rig.manager.in_use
    assert rig.published[-1] is not None
    assert len(rig.published[-1].recipes.recipes) == 3


def test_recipes_that_another_node_has_added_to_the_file_stay(rig: Rig) -> None:
    other = CalibrationManager(CalibrationStore(rig.store.folder), lambda: 0.01, lambda: 0, lambda _one, _file: None)
    other.set_mirror(MIRROR)
    other.load("known")
    other.add_recipes("known", book(0.01))
    rig.manager.add_recipes("known", book(0.02))
    assert [recipe.curvature for recipe in rig.store.load("known").recipes.recipes] == [0.01, 0.02]


def test_what_comes_after_a_cleanup_is_not_used(rig: Rig) -> None:
    rig.resting = "calibration is not active"
    rig.manager.use(None)
    with pytest.raises(Refusal, match="known is stored, but not used: calibration is not active") as caught:
        rig.manager.load("known")
    assert caught.value.error_code == ErrorCode.NODE_INACTIVE
    assert rig.manager.in_use is None and rig.published[-1] is None


def test_one_that_promises_clearly_less_is_used_with_a_warning(rig: Rig, calibration: Calibration) -> None:
    def promising(share: float) -> Calibration:
        fit = replace(calibration.fit, held_out_max_zernike=share * calibration.promise)
        made = replace(calibration, id=f"of_{share:g}", fit=fit)
        rig.store.save(made)
        return made

    assert rig.manager.use(promising(1.9)) == ""
    assert (
        "warning: it promises" in (said := rig.manager.use(promising(40.0))) and "of of_1.9, which it replaces" in said
    )
    assert rig.manager.in_use is not None and rig.manager.in_use.id == "of_40"
    assert rig.manager.use(calibration) == ""


def test_a_write_that_fails_leaves_everything_as_it_was(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    before, published = rig.file.read_bytes(), len(rig.published)

    def full(*_arguments: object) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(StoreError, match=r"known was not stored in .*: No space left on device") as caught:
        rig.manager.add_recipes("known", book(0.01))
    monkeypatch.undo()
    assert error_code(caught.value) == ErrorCode.STORAGE_FAILED
    assert rig.file.read_bytes() == before
    assert sorted(file.name for file in rig.file.parent.iterdir()) == ["in_use_T-1.txt", "known.h5"]
    assert rig.manager.in_use is not None
    assert rig.manager.in_use.recipes is NO_RECIPES
    assert len(rig.published) == published


@pytest.mark.parametrize(
    ("calibration_id", "recipes", "code", "words"),
    [
        (
            "other",
            lambda: book(0.01),
            ErrorCode.CALIBRATION_MISMATCH,
            "calibration_id = 'other': the calibration in use",
        ),
        ("known", lambda: book(0.01, actuators=19), ErrorCode.INVALID_LENGTH, "effective has 19 values"),
        ("known", lambda: NO_RECIPES, ErrorCode.INVALID_ARGUMENT, "must hold at least one"),
        ("known", lambda: book(0.02, steps=50), ErrorCode.INVALID_ARGUMENT, "degauss_steps = 50: must be"),
    ],
)
def test_recipes_that_do_not_belong_are_refused(
    rig: Rig, calibration_id: str, recipes: Callable[[], RecipeBook], code: int, words: str
) -> None:
    rig.manager.add_recipes("known", book(0.01))
    before = rig.file.read_bytes()
    with pytest.raises((Refusal, RecipeError), match=words) as caught:
        rig.manager.add_recipes(calibration_id, recipes())
    assert error_code(caught.value) == code
    assert rig.file.read_bytes() == before


def test_without_a_calibration_in_use_there_is_nothing_to_join(rig: Rig) -> None:
    rig.manager.set_mirror(make_mirror(serial="T-2"))
    with pytest.raises(Refusal, match="no calibration is in use") as caught:
        rig.manager.add_recipes("known", book(0.01))
    assert caught.value.error_code == ErrorCode.NOT_CALIBRATED


def test_other_raw_data_never_replace_those_of_the_file(rig: Rig, calibration: Calibration) -> None:
    before = rig.file.read_bytes()
    other = replace(calibration, maps=replace(calibration.maps, sag=calibration.maps.sag + 1e-9))
    with pytest.raises(StoreError, match="raw data differ"):
        rig.store.replace(other)
    with pytest.raises(UnknownNameError):
        rig.store.replace(replace(calibration, id="never-stored"))
    assert rig.file.read_bytes() == before
