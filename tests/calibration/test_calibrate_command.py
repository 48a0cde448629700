"""What `dm calibrate` makes of its options, without nodes."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import typer
from dm_msgs.action import Calibrate
from dm_msgs.msg import Calibration as CalibrationMsg
from typer.testing import CliRunner

from dm_bringup.sections import ConfigError
from dm_bringup.suite import load_config
from dm_calibration.calibration_messages import hysteresis_message
from dm_calibration.hysteresis.hysteresis_fit import HysteresisFit
from dm_calibration.procedure.forecast import GoodEnough
from dm_client import DeformableMirrorError
from dm_common.errors import ErrorCode
from dm_common.hysteresis.model import CREEP_TIMES, HysteresisModel
from dm_tools import cli
from dm_tools.parameter_changes import source_of, write_parameters
from dm_tools.verbs import calibrate as verb
from dm_tools.verbs.calibrate import REACHED, after_run, figures_of, metres, show_result
from dm_tools.verbs.up import add_camera, shared_config
from example_hysteresis import plays

FOUND = "/**/interferometer:\n  ros__parameters:\n    orientation.rotate_deg: -35.010000\n    orientation.flip_x: true"


@pytest.mark.parametrize(
    ("text", "value"), [("2nm", 2e-9), (" 0.5 nm", 5e-10), ("500pm", 5e-10), (".002um", 2e-9), ("2,5 nm", 2.5e-9)]
)
def test_lengths(text: str, value: float) -> None:
    assert metres(text) == pytest.approx(value)


@pytest.mark.parametrize("text", ["2", "nm", "2mm", "-2nm", "2e-9", "1.2.3nm", "two nm", "0nm", "0.0um"])
def test_what_is_no_length(text: str) -> None:
    with pytest.raises(typer.BadParameter, match="must be a number above 0 with pm, nm or um, such as 2nm"):
        metres(text)


@pytest.mark.parametrize("option", [("--until", "2nm"), ("--hysteresis", "100")])
def test_maps_of_another_plan_are_no_hysteresis_run(option: tuple[str, str]) -> None:
    found = CliRunner().invoke(cli.make_app(), ["calibrate", "--plan", "pokes", *option])
    assert (
        found.exit_code == 2
        and f"--plan pokes and {option[0]}: only the plan hysteresis has this option" in found.output
    )


@pytest.mark.parametrize("plan", [(), ("--plan", "surfaces")])
def test_an_amplitude_of_pokes_is_for_plans_with_pokes(plan: tuple[str, ...]) -> None:
    found = CliRunner().invoke(cli.make_app(), ["calibrate", *plan, "--amplitude", "0.3"])
    assert found.exit_code == 2 and "--amplitude: must be a plan with pokes" in found.output.replace("\n", " ")


@pytest.mark.parametrize(
    "options", [("--plan", "pokes"), ("--settle", "3"), ("--maps-per-state", "2"), ("--no-activate",)]
)
def test_the_axis_of_a_camera_is_no_calibration(options: tuple[str, ...]) -> None:
    refused = CliRunner().invoke(cli.make_app(), ["calibrate", "--boresight", *options])
    assert refused.exit_code == 2 and "--boresight takes no option of a calibration" in refused.output
    refused = CliRunner().invoke(cli.make_app(), ["calibrate", "--region", "0,0,1,1"])
    assert refused.exit_code == 2 and "are for --boresight" in refused.output


def test_a_fresh_start_that_was_interrupted_is_not_left_to_others(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(_client: Any, _goal: Any) -> str:
        raise KeyboardInterrupt

    held: list[bool] = []
    monkeypatch.setattr(verb, "running_suite", lambda _namespace: nullcontext(FakeClient(CalibrationMsg())))
    monkeypatch.setattr(verb, "set_parameter", lambda _client, _node, _name, value: held.append(value))
    monkeypatch.setattr(verb, "expected_run", interrupted)
    CliRunner().invoke(cli.make_app(), ["calibrate", "--fresh"])
    assert held == [True, False]


def test_a_poke_check_that_no_parameter_puts_right_says_so_once_and_what_becomes_of_the_file(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    findings = ["actuator 12 shows no response above the noise", "actuator 3 is weak; it reaches a tenth"]
    message = f"resumed run r with 9 maps; {'; '.join(findings)}; the mirror is not at rest"

    def failed(_client: Any, _goal: Any) -> Any:
        response = Calibrate.Result(poke_findings=[*findings, "set pitch"], message=message)
        raise DeformableMirrorError(ErrorCode.POKE_CHECK_FAILED, message, response)

    client = FakeClient(CalibrationMsg())
    client.mirror_info = SimpleNamespace(serial="virtual-1")  # type: ignore[attr-defined]
    monkeypatch.setattr(verb, "running_suite", lambda _namespace: nullcontext(client))
    monkeypatch.setattr(verb, "nodes_of_suite", lambda _client: ())
    monkeypatch.setattr(verb, "run_calibration", failed)
    target = tmp_path / "found.yaml"
    said = CliRunner().invoke(cli.make_app(), ["calibrate", "--plan", "poke-check", "--write", str(target)])
    assert "found.yaml is not written" in said.output.replace("\n", "") and not target.exists()
    assert "correct" not in said.output  # nobody knows that of a check that failed
    assert all(said.output.count(finding) == 1 for finding in findings)
    assert str(said.exception) == "resumed run r with 9 maps; see the findings above; the mirror is not at rest"
    assert said.exit_code == 1


def test_what_a_poke_check_finds_goes_into_a_copy(tmp_path: Path) -> None:
    target = tmp_path / "my_bench.yaml"
    write_parameters("", target, source_of(target, None, "virtual-1"))
    assert not target.exists()
    write_parameters(FOUND, target, source_of(target, None, "virtual-1"))  # the shipped bench, for there is no other
    found = load_config(target)["interferometer"]
    assert found["orientation.rotate_deg"] == -35.01 and found["orientation.flip_x"] is True
    assert "# m: the whole field of the simulated camera" in target.read_text()
    target.write_text(target.read_text().replace("flip_x: true", "flip_x: false  # of mine"))
    write_parameters(FOUND, target, source_of(target, None, "virtual-1"))  # the file itself, which is kept
    assert "flip_x: true  # of mine" in target.read_text()
    assert "flip_x: false  # of mine" in (tmp_path / "my_bench.yaml.before").read_text()
    write_parameters(FOUND, target, source_of(target, None, "virtual-1"))
    assert "flip_x: false  # of mine" in (tmp_path / "my_bench.yaml.before").read_text()  # the first is not lost
    assert "flip_x: true  # of mine" in (tmp_path / "my_bench.yaml.before2").read_text()


def test_a_bench_that_was_started_with_a_camera_keeps_it(tmp_path: Path) -> None:
    target = tmp_path / "my_bench.yaml"
    write_parameters(FOUND, target, source_of(target, None, "virtual-1"), nodes=("autofocus",))
    written, started = load_config(target), load_config(shared_config("bench.yaml"))
    add_camera(started)
    assert written.pop("interferometer") != started.pop("interferometer")
    assert written == started
    own = target.read_text().replace("camera.rate: 30.0", "camera.rate: 20.0")  # which says itself what it has
    target.write_text(own)
    write_parameters(FOUND, target, source_of(target, None, "virtual-1"), nodes=("autofocus",))
    assert target.read_text() == own != ""


def test_the_file_of_another_mirror_is_refused(tmp_path: Path) -> None:
    source = tmp_path / "other.yaml"
    shutil.copy(shared_config("bench.yaml"), source)
    with pytest.raises(ConfigError, match=r"is for the mirror 'virtual-1', the nodes run 'T-7'"):
        source_of(tmp_path / "new.yaml", source, "T-7")


def test_of_a_file_for_two_mirrors_the_namespace_says_which(tmp_path: Path) -> None:
    file = tmp_path / "both.yaml"
    file.write_text("".join(f"/{side}/pdm_driver: {{ros__parameters: {{mirror.serial: {side}}}}}\n" for side in "AB"))
    with pytest.raises(ConfigError, match=r"/B/pdm_driver: a second section of pdm_driver; .* chosen by --namespace"):
        source_of(file, None, "B")
    write_parameters(FOUND, file, source_of(file, None, "B", "/B"), "/B")
    assert load_config(file, "B")["interferometer"]["orientation.flip_x"] is True
    assert "interferometer" not in load_config(file, "A")


@pytest.mark.parametrize(
    ("model", "law", "promised"),
    [
        ("Preisach, each actuator its own", plays(), "2.8 nm (95 % bound"),
        ("linear", HysteresisModel.linear(), "2.8 nm (95 % bound"),
        ("linear", replace(HysteresisModel.linear(), creep_rate=0.01, creep_time=CREEP_TIMES), "2.8 nm (95 % bound"),
        ("linear", None, "none while it is not in use"),
    ],
)
def test_the_promise_is_what_requests_will_be_told(
    model: str, law: HysteresisModel | None, promised: str, capsys: pytest.CaptureFixture[str]
) -> None:
    found = law and HysteresisFit(model, law, np.full(21, 1e-9), 2e-9, 0.05, 120, ())
    calibration = CalibrationMsg(hysteresis=hysteresis_message(found)) if found else None
    show_result(Calibrate.Result(hysteresis_model=model, hysteresis_held_out_max_zernike=2e-9), calibration)
    assert f"promise: {promised}" in capsys.readouterr().out


def test_a_worse_calibration_is_warned_of(capsys: pytest.CaptureFixture[str]) -> None:
    show_result(Calibrate.Result(id="c2", warning="warning: it promises 338 nm, c1 2.3 nm"))
    assert "warning: it promises 338 nm, c1 2.3 nm" in capsys.readouterr().out


def test_what_a_run_does_not_have_is_no_zero() -> None:
    figures = figures_of(Calibrate.Result(maps=90, held_out_rms=3e-9))
    assert figures["held_out_rms_nm"] == pytest.approx(3.0)
    lacking = {name for name, value in figures.items() if isinstance(value, float) and math.isnan(value)}
    assert lacking == {
        "in_sample_rms_nm",
        "condition_number",
        "hysteresis_held_out_max_zernike_nm",
        "expected_max_zernike_nm",
    }


def test_wrong_wiring_is_put_right_before_the_mirror_is_used() -> None:
    found = Calibrate.Result(id="c1", parameters=FOUND)
    assert after_run(found, Path("found.yaml")) == "start the nodes with found.yaml, and calibrate again"
    assert after_run(found, None) == "start the nodes with these parameters, and calibrate again"
    assert after_run(Calibrate.Result(id="c1"), None) == "./dm focus 0.02"
    assert "load_calibration with calibration: c1" in after_run(Calibrate.Result(id="c1"), None, used=False)
    assert after_run(Calibrate.Result(id="c1"), None, used=False).startswith("./dm console ")  # without knowing ROS
    assert after_run(Calibrate.Result(poke_check_passed=True), None) == "./dm calibrate"


def test_what_was_reached_is_one_part_of_a_result_message() -> None:
    enough = GoodEnough(2e-9)
    assert enough.sentence(1e-9) == "2 nm is reached: 1 nm"  # no part was long enough to say so
    enough.reached = [5e-9, 3e-9]
    for found in (1e-9, 3e-9):
        sentence = enough.sentence(found)
        assert "; " not in sentence and REACHED.search(sentence) and sentence.endswith("(after each part: 5, 3 nm)")


class FakeClient:
    """A suite whose run reaches 3.2 nm after a part, and 1.9 nm at its end."""

    def __init__(self, made: CalibrationMsg) -> None:
        self.messages = {"calibration": made}

    def wait(self, condition: Callable[[], object], _timeout_s: float) -> bool:
        return bool(condition())

    def calibrate(self, goal: Calibrate.Goal, show: Callable[[Any], None] = lambda _feedback: None) -> Calibrate.Result:
        if goal.dry_run:
            return Calibrate.Result(message="110 maps in about 158 s, moves then accurate to 2.7 nm; nothing was moved")
        most, left = {"maps_left": 344, "time_left": 319.0}, {"maps_left": 40, "time_left": 60.0}
        left["expected_max_zernike"] = 2e-9
        for reached, rest in (
            (0.0, {}),
            (11e-9, most),
            (3.2e-9, left),
            (3.2e-9, {**left, "maps_left": 39}),
            (1.9e-9, {}),
        ):
            show(Calibrate.Feedback(phase="hysteresis", step=9, steps=452, reached_max_zernike=reached, **rest))
        for step in range(10, 452):
            show(Calibrate.Feedback(phase="hysteresis", step=step, steps=452, reached_max_zernike=1.9e-9))
        show(Calibrate.Feedback(phase="fit", step=452, steps=452, reached_max_zernike=1.9e-9))
        return Calibrate.Result(id="c1", maps=130, message="2 nm is reached: 1.9 nm", hysteresis_model="Preisach")


def test_a_run_says_what_to_expect_and_then_what_is_reached_and_left(monkeypatch: pytest.MonkeyPatch) -> None:
    made = CalibrationMsg(
        id="c1", wavelength=632.8e-9, held_out_max_zernike=2e-9, instrument_error=5e-9, scale_error=1e-9
    )
    monkeypatch.setattr(verb, "running_suite", lambda _namespace: nullcontext(FakeClient(made)))
    done = CliRunner().invoke(cli.make_app(), ["calibrate", "--until", "2nm"])
    lines = done.output.splitlines()
    assert lines[0] == "expected: 110 maps in about 158 s, moves then accurate to 2.7 nm"
    assert [line for line in lines if "so far" in line] == [
        "calibration: accurate to 11 nm so far, the hysteresis law is hardly found yet (then the error falls) or fits "
        "this mirror worse than most, 344 more maps at most (319 s)",
        "calibration: accurate to 3.2 nm so far, 2 nm expected after 40 more maps (60 s)",
        "calibration: accurate to 1.9 nm so far",
    ]
    said = [line for line in lines if ", step " in line]
    tenths = [9, 46, 91, 136, 181, 226, 272, 317, 362, 407]
    assert said == [
        *(f"calibration: hysteresis, step {step} of 452" for step in tenths),
        "calibration: fit, step 452 of 452",
    ]
    assert (
        "when flat: repeatable to 2 nm (λ/316), absolute to 5.4 nm (λ/118), limited by the instrument's own error"
        in done.output
    )
