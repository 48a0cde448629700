"""The command `dm` itself: arguments, standard output, exit codes, words; nothing runs but what is asked for."""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any, Union, get_origin, get_type_hints

import pytest
import typer
from dm_msgs.msg import ActuatorState, Calibration, Capabilities, FocusRequest, FocusState, MirrorInfo
from dm_msgs.srv import SetFocus, UpdateCalibration
from typer.testing import CliRunner

from console_stand_in import EXECUTING, FakeNode, Goal
from dm_client import DeformableMirrorError
from dm_common.errors import HISTORY_UNKNOWN, ErrorCode
from dm_common.ros.domains import own_domain
from dm_tools import cli, output, running_suite
from dm_tools.console.view_models import prediction_text
from dm_tools.output import NotRunningError, write_json
from dm_tools.running_suite import REPORT_S, SettledShape, holder, naming_holder, settled_shape, verdict
from dm_tools.verbs import check
from dm_tools.verbs import status as verb_status
from dm_tools.verbs.console import console
from dm_tools.verbs.focus import _show
from dm_tools.verbs.replay import replay
from dm_tools.verbs.report import folder_with
from dm_tools.verbs.up import first_command, lacks, only_suite, shared_config

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def screen() -> Any:
    """The console writes to standard output again after each test."""
    yield
    output.console.file = None  # type: ignore[assignment]


def parsed(verb: str, *words: str) -> dict[str, Any]:
    group: Any = typer.main.get_command(cli.make_app())
    params: dict[str, Any] = group.commands[verb].make_context(verb, list(words)).params
    return params


def test_only_the_verb_that_is_asked_for_is_imported() -> None:
    code = (
        "import sys; from dm_tools import cli; app = cli.make_app('status'); "
        "print(len(app.registered_commands), 'dm_tools.verbs.calibrate' in sys.modules)"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True).split() == ["1", "False"]


@pytest.mark.parametrize(
    ("library", "module", "use", "text"),
    [
        ("nicegui", "dm_tools.console.page", console, "the console needs NiceGUI: `pip install nicegui`"),
        (
            "rosbags",
            "dm_tools.recording.bag",
            partial(replay, Path()),
            "recordings need rosbags: `pip install ",
        ),
    ],
)
def test_what_rosdep_has_no_key_for_is_named(
    monkeypatch: pytest.MonkeyPatch, library: str, module: str, use: Callable[[], None], text: str
) -> None:
    monkeypatch.delitem(sys.modules, module, raising=False)
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(RuntimeError, match=text):
        use()


@pytest.mark.parametrize("words", [("-0.02",), ("-0.02", "--dry-run"), ("--conic", "-1", "-2e-2"), ("--", "-.02")])
def test_a_negative_curvature_is_a_number(words: tuple[str, ...]) -> None:
    assert parsed("focus", *words)["curvature"] == -0.02
    assert parsed("focus", *words)["conic"] == (-1.0 if "--conic" in words else 0.0)


@pytest.mark.parametrize(
    ("verb", "words", "values"),
    [
        ("focus", ("0,03",), {"curvature": 0.03}),
        ("focus", ("-0,02", "--conic", "-0,5"), {"curvature": -0.02, "conic": -0.5}),
        ("focus", ("--conic=−,5", "--", "−1e-2"), {"curvature": -0.01, "conic": -0.5}),
        ("focus", ("0,03", "--conditioned"), {"curvature": 0.03, "conditioned": True}),
        ("measure", ("--reference-sphere", "1,25"), {"reference_sphere": 1.25}),
        ("recipes", ("--curvatures", "0,03", "--conic", "0,5"), {"curvatures": "0,03", "conic": 0.5}),
        ("report", ("--operator", "1,5"), {"operator": "1,5"}),
    ],
)
def test_a_decimal_comma_is_understood_where_a_number_is_wanted(
    verb: str, words: tuple[str, ...], values: dict[str, Any]
) -> None:
    assert parsed(verb, *words).items() >= values.items()


def test_what_is_mistyped_is_guessed_and_wrong_usage_is_2() -> None:
    wrong_verb, wrong_option = (
        CliRunner().invoke(cli.make_app(), words) for words in (["focuss", "1"], ["focus", "--dry-rn"])
    )
    assert wrong_verb.exit_code == wrong_option.exit_code == 2
    assert "Did you mean 'focus'" in wrong_verb.output and "--dry-run" in wrong_option.output
    assert "╭" not in wrong_verb.output, "frames are for screens"


def test_options_have_types_that_an_older_typer_knows() -> None:
    """That of Ubuntu 24.04 refuses `X | None`, and the whole command with it."""

    def example(folder: Annotated[Path | None, typer.Option()] = None, number: float = 0.0) -> None: ...

    hints = get_type_hints(cli.verb(example), include_extras=True)
    assert hints["number"] is float
    assert get_origin(hints["folder"].__origin__) is Union
    assert not isinstance(cli._options.__annotations__["version"], str), "it reads annotations as they stand"


def test_a_sourced_workspace_has_it_on_its_path() -> None:
    assert Path(str(shutil.which("dm"))).parts[-3:] == ("dm_tools", "bin", "dm")


def test_the_bare_command_helps() -> None:
    done = subprocess.run([ROOT / "dm"], capture_output=True, text=True, check=True)
    listed = {line.split()[0] for line in done.stdout.splitlines() if line.startswith("  ")}
    assert {"up", "calibrate", "focus", "status", "check"} <= listed
    assert "Exit codes" in done.stdout
    assert all(verb in done.stdout for verb in cli.VERBS)


def test_the_version_is_said() -> None:
    said = CliRunner().invoke(cli.make_app(), ["--version"])
    assert said.exit_code == 0 and said.output.startswith("dm 0.")


def test_figures_on_standard_output_stand_alone(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = parsed("status", "--json", "-")["json"]
    output.console.print("for a person")
    write_json(path, {"length": math.nan, "ends": (-math.inf, 0.1), "rows": [{"rms": math.inf}]})
    said = capsys.readouterr()
    assert json.loads(said.out) == {"length": None, "ends": [None, 0.1], "rows": [{"rms": None}]}
    assert said.err == "for a person\n"
    assert parsed("status", "--json", str(tmp_path / "f"))["json"] == tmp_path / "f"
    output.console.print("again")
    assert capsys.readouterr().out == "again\n"
    assert parsed("status", "--json", "/dev/stdout")["json"] == output.STANDARD_OUTPUT


def test_where_no_file_can_be_written_nothing_begins(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for path in (tmp_path, tmp_path / "file" / "below" / "f"):
        for words in (["status", "--json"], ["calibrate", "--write"], ["instrument", "flats", "t.csv", "--write"]):
            refused = CliRunner().invoke(cli.make_app(), [*words, str(path)])
            assert refused.exit_code == 2 and f"{words[-1]}': {path}: must be a file" in refused.output.replace(
                "\n", ""
            )
    assert parsed("status", "--json", str(tmp_path / "new" / "f"))["json"] == tmp_path / "new" / "f", "it is made"


def test_a_name_in_square_brackets_is_no_markup(capsys: pytest.CaptureFixture[str]) -> None:
    said = r"[p01] of /maps[/tmp]\[night]:warning:"
    output.console.print(f"[yellow]dropped[/] {said}")
    output.next_step(said)
    assert capsys.readouterr().out == f"dropped {said}\nnext: {said}\n"


def test_what_is_next_is_said_for_the_mirror_that_was_asked(capsys: pytest.CaptureFixture[str]) -> None:
    said = "./dm check --forget, ./dm focus 0.02; if not, ./dm up --config f.yaml"
    output.next_step(said)
    output.next_step(said, "lab/left")
    alone, left = capsys.readouterr().out.splitlines()
    assert alone == f"next: {said}"
    there = "--namespace lab/left"
    assert left == f"next: ./dm check {there} --forget, ./dm focus {there} 0.02; if not, ./dm up --config f.yaml"
    parsed(*left.split("./dm ")[2].split(";")[0].split())
    there = "ros2 lifecycle set /left/pdm_driver activate, then ./dm doctor --namespace left again; ./dm exec true"
    for namespace in ("left", "/left", "left/"):
        assert output.in_namespace(there.replace("/left", "").replace(" --namespace left", ""), namespace) == there
    assert (
        output.in_namespace("lifecycle set /left/pdm_driver activate", "left")
        == "lifecycle set /left/pdm_driver activate"
    )


def test_a_device_or_pipe_for_figures_stays_one(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    reader = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    write_json(tmp_path / "pipe", {"length": 1})
    assert (tmp_path / "pipe").is_fifo() and json.loads(os.read(reader, 100)) == {"length": 1}
    os.close(reader)


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (NotRunningError("none"), 3, "error: none"),
        (ValueError("[no] markup"), 1, "error: [no] markup"),
        (DeformableMirrorError(ErrorCode.BUSY, "held"), 1, "error: BUSY: held"),
        (KeyboardInterrupt(), 130, "error: interrupted"),
        (KeyboardInterrupt("calibrate: 7 maps are kept"), 130, "error: interrupted; calibrate: 7 maps are kept"),
    ],
)
def test_exit_codes(
    error: BaseException, code: int, said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(*_words: Any, **_keywords: Any) -> None:
        raise error

    monkeypatch.setattr(cli, "make_app", fails)
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == code
    assert capsys.readouterr().err == f"{said}\n"


@pytest.mark.parametrize("error", [KeyboardInterrupt(), typer.Abort()])
def test_a_verb_that_is_interrupted_ends_with_130(error: BaseException, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also while it asks, and with a typer that knows no such status."""

    def fails(_namespace: str) -> None:
        raise error

    monkeypatch.setattr(verb_status, "running_suite", fails)
    done = CliRunner().invoke(cli.make_app(), ["status"])
    assert (done.exit_code, "error: interrupted" in done.output) == (130, True)


@pytest.mark.slow
def test_with_nothing_running_the_way_out_is_named_at_once(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    assert running_suite.FIND_S <= 1.2
    monkeypatch.setattr(running_suite, "BUSY_S", running_suite.FIND_S + 0.2)
    with own_domain() as domain:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        with pytest.raises(NotRunningError, match=r"\./dm up"), running_suite.running_suite(""):
            pass
    assert "./dm up" in capfd.readouterr().err


class FakeClient:
    """A client while a calibration runs, or nothing does."""

    def __init__(self, busy: bool) -> None:
        self.node: Any = FakeNode()
        self._busy = busy
        state = (
            ActuatorState(holder="calibration", holding="calibration has held the mirror for 12 s: cancel it")
            if busy
            else None
        )
        self.messages = {"actuator_state": state or ActuatorState()}

    def wait(self, condition: Any, _timeout_s: float) -> bool:
        if self._busy and "calibrate/_action/status" in self.node.callbacks:
            goal = Goal(self.node, 1)
            goal.publish_status(EXECUTING)
            feedback = SimpleNamespace(step=12, steps=86, residual_rms=0.0)
            self.node.callbacks["calibrate/_action/feedback"](SimpleNamespace(goal_id=goal.identity, feedback=feedback))
        return bool(condition())


def test_who_holds_the_mirror_is_named() -> None:
    client: Any = FakeClient(busy=True)
    busy = DeformableMirrorError(ErrorCode.BUSY, "refused")
    with pytest.raises(DeformableMirrorError, match=r"has held the mirror for 12 s \(step 12 of 86\): wait"):
        with naming_holder(client):
            raise busy
    answered = DeformableMirrorError(ErrorCode.BUSY, "refused", SetFocus.Response())
    with pytest.raises(DeformableMirrorError, match="or end it with --take-over"), naming_holder(client):
        raise answered
    refusal = DeformableMirrorError(ErrorCode.UNREACHABLE, "reachable: ")
    with pytest.raises(DeformableMirrorError, match="reachable"), naming_holder(client):
        raise refusal
    uncalibrated = DeformableMirrorError(ErrorCode.NOT_CALIBRATED, "no calibration is in use", SetFocus.Response())
    with pytest.raises(DeformableMirrorError, match=r"for 12 s \(.*Ctrl-C[^-]*$"), naming_holder(client):
        raise uncalibrated
    idle: Any = FakeClient(busy=False)
    assert not holder(idle)
    with pytest.raises(DeformableMirrorError, match="no calibration is in use"), naming_holder(idle):
        raise uncalibrated


def test_the_status_says_what_the_controller_remarks_on_its_promise() -> None:
    able = Capabilities(curvature_min=-0.04, curvature_max=0.05, error_bound=2e-9, message="-0.04 to +0.05 1/m")
    assert verb_status._promise(able).endswith("each move states its own")
    able.message += "; without actuator 5; calibrated 40 days ago"
    assert "each move states its own; [yellow]without actuator 5; calibrated 40 days ago[/]" in verb_status._promise(
        able
    )


def test_promise_and_measurement_are_put_in_one_way(capsys: pytest.CaptureFixture[str]) -> None:
    assert "promised 97 nm (95 % bound), measured 1.3 nm: " in verdict(97e-9, 1.3e-9)
    assert "inside" in verdict(97e-9, 1.3e-9) and "outside" in verdict(1e-9, 1.3e-9)
    assert "promised 153 nm (95 % bound), measured 100 nm: " in verdict(153.2e-9, 99.7e-9)
    assert "1266 nm (95 % bound), " in verdict(1265.6e-9, 1e-9)
    assert "measured 1.32 nm: [red]outside" in verdict(1.27e-9, 1.32e-9)
    assert verdict(0.0, 1e-9) == "promised not known, measured 1 nm"
    state = FocusState(curvature=0.02, power=0.04, predicted_max_zernike_upper=1.3e-9, history_known=True)
    state.message = "accurate to 1.3 nm; most of that for creep"
    made = Calibration(wavelength=632.8e-9, instrument_error=4e-9, scale_error=1e-9, aperture_radius=0.011)
    _show(Heard(calibration=made, mirror_info=MirrorInfo()), state)
    said = capsys.readouterr().out
    assert "promised 1.3 nm (95 % bound)" in said and "0.00 nm" not in said
    assert "\nmost of that for creep\n" in said
    assert "repeatable to 1.3 nm (λ/487), absolute to 4.2 nm (λ/150), limited by the instrument's own error" in said


class Heard:
    """A client that has heard the latest message on these topics."""

    def __init__(self, **messages: Any) -> None:
        self.messages = messages

    def wait(self, condition: Callable[[], object], _timeout_s: float) -> bool:
        return bool(condition())


def test_of_signals_at_a_limit_it_is_said_at_which(capsys: pytest.CaptureFixture[str]) -> None:
    """The end of the range counts where a signal is at both."""
    state = FocusState(signals=[0.8, 0.2, -0.3, 0.1, -0.8], saturated=True, saturated_actuators=[1, 2, 3, 5])
    mirror = MirrorInfo(signal_min=-0.8, signal_max=0.8)
    saturated = "actuators 1, 5 at an end of the range, actuators 2, 3 at the limit between neighbours"
    _show(Heard(mirror_info=mirror), state)
    assert f"saturated: {saturated}\n" in capsys.readouterr().out
    assert f"Saturated: {saturated}." in prediction_text(state, mirror)
    state.saturated_actuators = [3]
    assert "Saturated: actuator 3 at the limit between neighbours." in prediction_text(state, mirror)
    assert "Saturated: actuator 3 at a limit." in prediction_text(state)


def test_what_stands_is_read_from_the_controllers_health() -> None:
    values = {"curvature": 0.02, "age": "40.0", "predicted": 1e-10, "bound": 1.3e-9, "held": True}
    values |= {"conditioned": False}
    pairs = [SimpleNamespace(key=key, value=str(value)) for key, value in values.items()]
    shape = SettledShape(0.02, 40.0, 1.3e-9, True, 1e-10, False)
    assert settled_shape({"focus_controller": SimpleNamespace(values=pairs)}) == shape
    assert settled_shape({"focus_controller": SimpleNamespace(values=pairs[3:])}) is None
    assert settled_shape({}) is None


@pytest.mark.parametrize(
    ("measured", "conditioned", "model", "promised", "code"),
    [
        (4e-9, False, 12e-9, 5.0, 0),
        (10e-9, False, 12e-9, 5.0, 1),
        (10e-9, True, 12e-9, 12.0, 0),
        (13e-9, True, 12e-9, 12.0, 1),
        (4e-9, True, 3e-9, 5.0, 0),
    ],
)
def test_a_map_is_held_against_what_is_promised_beyond_the_prediction(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    measured: float,
    conditioned: bool,
    model: float,
    promised: float,
    code: int,
) -> None:
    """At an end of the range, where 20 nm are predicted; what is measured is by how much the map differs from that.

    The model does not predict what a recipe corrects: such a shape is held against the bound of the model, which holds
    no creep, or its own, if that is larger, as after a restart.
    """
    values = {"curvature": 0.06, "age": "4.0", "predicted": 20e-9, "bound": 25e-9, "held": True}
    values |= {"conditioned": conditioned}
    pairs = [SimpleNamespace(key=key, value=str(value)) for key, value in values.items()]
    calibration, answer = Calibration(id="c1"), UpdateCalibration.Response(accepted=True, max_zernike=measured)
    client = SimpleNamespace(
        update_calibration=lambda **_options: answer,
        latest=lambda _name: calibration,
        messages={"capabilities": Capabilities(error_bound=model)},
        wait=lambda _condition, _timeout_s: True,
    )
    monkeypatch.setattr(check, "running_suite", lambda _namespace: nullcontext(client))
    monkeypatch.setattr(check, "nodes_of_suite", lambda _client: {"focus_controller": 1})
    monkeypatch.setattr(check, "receive_health", lambda _client: {"focus_controller": SimpleNamespace(values=pairs)})
    said = CliRunner().invoke(cli.make_app(), ["check", "--json", str(tmp_path / "figures")])
    assert said.exit_code == code, said.output
    assert f"largest coefficient beyond what is predicted: promised {promised:g} nm (95 % bound" in said.output
    assert json.loads((tmp_path / "figures").read_text())["check"]["promised_nm"] == pytest.approx(promised)


def test_a_controller_that_is_found_late_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its nodes are found one by one; with the bound of the calibration a good map may be called outside."""
    values = {"curvature": 0.03, "age": "4.0", "predicted": 0.0, "bound": 30e-9, "held": True, "conditioned": False}
    pairs = [SimpleNamespace(key=key, value=str(value)) for key, value in values.items()]
    waited: list[float] = []
    health: dict[str, Any] = {}

    def wait(condition: Callable[[], object], timeout_s: float) -> bool:
        waited.append(timeout_s)
        if sum(waited) > REPORT_S:
            health["focus_controller"] = SimpleNamespace(values=pairs)
        return bool(condition())

    client = SimpleNamespace(
        update_calibration=lambda **_options: UpdateCalibration.Response(accepted=True, max_zernike=20e-9),
        latest=lambda _name: Calibration(id="c1"),
        messages={"capabilities": Capabilities(error_bound=18e-9)},
        wait=wait,
    )
    monkeypatch.setattr(check, "running_suite", lambda _namespace: nullcontext(client))
    monkeypatch.setattr(check, "nodes_of_suite", lambda _client: {"focus_controller": len(waited)})
    monkeypatch.setattr(check, "receive_health", lambda _client: health)
    said = CliRunner().invoke(cli.make_app(), ["check"])
    assert said.exit_code == 0 and "promised 30 nm (95 % bound), measured 20 nm: inside" in said.output


@pytest.mark.parametrize(("flat", "promised"), [(9e-9, 6), (4e-9, 3), (None, 3)])
def test_after_a_degauss_a_map_is_held_against_a_bound_that_includes_creep(
    monkeypatch: pytest.MonkeyPatch, flat: float | None, promised: int
) -> None:
    """What was held before creeps on, and the bound of the calibration holds no creep."""

    def focus(curvature: float, dry_run: bool, mode: int) -> FocusState:
        assert dry_run and (curvature, mode) == (0.0, FocusRequest.MODE_DIRECT)
        if flat is None:
            raise DeformableMirrorError(ErrorCode.OUT_OF_RANGE, "beyond the range")
        return FocusState(predicted_max_zernike=3e-9, predicted_max_zernike_upper=flat)

    client = SimpleNamespace(
        focus=focus,
        update_calibration=lambda **_options: UpdateCalibration.Response(accepted=True, max_zernike=5e-9),
        latest=lambda _name: Calibration(id="c1"),
        messages={"capabilities": Capabilities(error_bound=3e-9)},
        wait=lambda _condition, _timeout_s: True,
    )
    monkeypatch.setattr(check, "running_suite", lambda _namespace: nullcontext(client))
    monkeypatch.setattr(check, "nodes_of_suite", lambda _client: {"focus_controller": 1})
    monkeypatch.setattr(check, "receive_health", lambda _client: {"focus_controller": SimpleNamespace(values=[])})
    said = CliRunner().invoke(cli.make_app(), ["check"])
    assert f"promised {promised} nm (95 % bound), measured 5 nm" in said.output
    assert said.exit_code == (0 if promised > 5 else 1)


def test_the_store_with_the_youngest_calibration_is_taken(tmp_path: Path) -> None:
    older, newer = tmp_path / "a", tmp_path / "b"
    assert folder_with("", (older, newer)) == older
    newer.mkdir()
    (newer / "c.h5").touch()
    assert folder_with("", (older, newer)) == newer
    older.mkdir()
    (older / "b.h5").touch()
    os.utime(older / "b.h5", (0, 0))
    assert folder_with("b", (newer, older)) == older
    assert folder_with("", (older, newer)) == folder_with("d", (older, newer)) == newer


@pytest.mark.parametrize("words", [("--hysteresis-maps", "10"), ("--camera", "--hysteresis-maps", "0")])
def test_maps_that_a_demo_cannot_take_are_refused_before_it_begins(words: tuple[str, ...]) -> None:
    refused = CliRunner().invoke(cli.make_app(), ["demo", *words])
    assert refused.exit_code == 2 and "--hysteresis-maps" in refused.output


def test_a_demo_of_a_file_without_a_settle_time_takes_the_nodes_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It has calibrated for minutes when it needs it."""
    from dm_tools.demo import demo

    file, waited = tmp_path / "bench.yaml", []
    lines = shared_config("bench.yaml").read_text().splitlines()
    file.write_text("\n".join(line for line in lines if "settle_time" not in line))

    def sweep(_client: Any, settle: float) -> Any:
        waited.append(settle)
        raise RuntimeError("the rest is not tried")

    made = SimpleNamespace(id="", duration=0.0, capabilities=SimpleNamespace(message=""), mirror_info=None)
    monkeypatch.setattr(demo, "running_bench", lambda *_: nullcontext(made))
    monkeypatch.setattr(demo, "sweep", sweep)
    for name in ("run_calibration", "show_result", "wait_for_calibration"):
        monkeypatch.setattr(demo, name, lambda *_: made)
    done = CliRunner().invoke(cli.make_app(), ["demo", "--config", str(file), "--out", str(tmp_path / "out")])
    assert waited == [0.5], done.exception


def test_its_nodes_run_as_those_of_launch_files(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("FASTRTPS_DEFAULT_PROFILES_FILE", raising=False)
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")
    with pytest.raises(SystemExit):
        cli.run(["--version"], "dm")
    assert Path(os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"]).is_file()
    assert os.environ["OPENBLAS_NUM_THREADS"] == "2", "what the user has set stays"


def test_a_suite_that_is_started_twice_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_HOME", str(tmp_path))
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    with only_suite("left"), only_suite("right"):
        with pytest.raises(RuntimeError, match=rf"domain 7, namespace /left \(.*{os.getpid()}.*Ctrl-C where"):
            with only_suite("left"):
                pass
    with only_suite("left"):
        pass
    monkeypatch.setenv("ROS_DOMAIN_ID", "")  # to ROS the same as 0
    with only_suite("left"):
        monkeypatch.setenv("ROS_DOMAIN_ID", "0")
        with pytest.raises(RuntimeError, match="domain 0, namespace /left"), only_suite("left"):
            pass


@pytest.mark.parametrize("verb", ["status", "security"])
def test_without_a_standard_output_it_does_its_work_all_the_same(verb: str, tmp_path: Path) -> None:
    """As started by a program that has closed its own."""
    words = {"status": ["--help"], "security": ["--out", str(tmp_path), "--json", "-"]}[verb]
    command = [sys.executable, "-m", "dm_tools", verb, *words]
    done = subprocess.run(["bash", "-c", '"$@" >&-', "bash", *command], stderr=subprocess.PIPE, text=True)
    assert (done.returncode, "Traceback" in done.stderr) == (0, False), done.stderr


@pytest.mark.slow
def test_a_command_that_is_interrupted_at_once_says_so() -> None:
    """As `./dm` starts it: the signal waits until the command can answer it."""
    # A job in the background of a shell, which tests may be, ignores the signal and so would what it starts.
    answered = signal.signal(signal.SIGINT, signal.default_int_handler)
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    started = subprocess.Popen([sys.executable, "-m", "dm_tools", "up"], stderr=subprocess.PIPE, text=True)
    signal.pthread_sigmask(signal.SIG_SETMASK, before)
    signal.signal(signal.SIGINT, answered)
    started.send_signal(signal.SIGINT)
    said = started.communicate(timeout=300)[1]
    assert (started.returncode, "Traceback" in said) == (130, False), said
    assert said.endswith("error: interrupted\n")


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_command_that_is_told_to_end_ends_in_order(number: signal.Signals, tmp_path: Path) -> None:
    """By `timeout`, systemd, or a terminal that is closed: a run is cancelled as by Ctrl-C."""
    before = signal.signal(number, signal.SIG_DFL)  # what nohup ignores, the command would ignore as well
    command = [sys.executable, "-m", "dm_tools", "record", "--out", str(tmp_path / "recording")]
    with own_domain() as domain:
        environment = os.environ | {"ROS_DOMAIN_ID": str(domain)}
        started = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment
        )
        signal.signal(number, before)
        assert started.stdout is not None
        said = next(line for line in started.stdout if "recording into" in line)
        started.send_signal(number)
        said += started.communicate(timeout=300)[0]
    assert "stopping" in said and "nothing was recorded" in said and started.returncode == cli.NOT_RUNNING, said


def test_a_command_that_is_interrupted_while_its_words_are_read_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    read = cli.Group.parse_args

    def interrupted(group: cli.Group, ctx: Any, words: list[str]) -> list[str]:
        signal.pthread_kill(threading.get_ident(), signal.SIGINT)
        return read(group, ctx, words)

    monkeypatch.setattr(cli.Group, "parse_args", interrupted)
    answered = signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        with pytest.raises(SystemExit) as ended:
            cli.run(["status"], "dm")
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        signal.signal(signal.SIGINT, answered)
    assert (ended.value.code, capsys.readouterr().err) == (130, "error: interrupted\n")


def test_a_calibration_that_was_not_heard_is_not_called_none() -> None:
    assert verb_status._calibration(None) == "not heard"
    assert verb_status._calibration(Calibration()) == "none in use"


def test_the_age_of_a_calibration_is_of_the_time_of_the_bench() -> None:
    """In a simulation time begins at 0."""
    made = Calibration(id="c")
    made.header.stamp.sec = 40
    assert "maps 60 s ago" in verb_status._calibration(made, 100)


def test_status_says_where_only_of_what_is_absolute() -> None:
    able = Capabilities(curvature_min=-0.05, curvature_max=0.04, error_bound=2e-9)
    used = Calibration(id="a", wavelength=632.8e-9, aperture_radius=0.011)
    assert verb_status._absolute(able, used).endswith("of the interferometer not given)")
    used.instrument_error, used.scale_error = 1e-9, 1e-3
    assert verb_status._absolute(able, used).endswith(", limited by the lateral scale, at -0.0500 1/m")


def test_a_node_that_was_not_heard_does_not_count_as_well() -> None:
    well = SimpleNamespace(level=b"\0", message="ready")
    doubtful = SimpleNamespace(level=b"\1", message="./dm calibrate")
    health = dict.fromkeys(("pdm_driver", "interferometer", "focus_controller"), well)
    found = Counter((*health, "calibration"))
    silent = verb_status._silent(found, health)
    assert verb_status._health(health, silent) == "calibration: not heard"
    assert not verb_status._silent(Counter(health), health), "a node that does not run is in another row"
    assert verb_status._health(health, []) == "ok"
    said = verb_status._health(health | {"calibration": doubtful}, [], "b")
    assert said == "calibration: ./dm calibrate --namespace b"


def test_status_knows_no_negative_zero() -> None:
    """Mid range is a step of the converter beside 0."""
    said = verb_status._now("", None, ActuatorState(applied=[-6e-6, -4e-6]))
    assert said == "signals +0.00 to +0.00, no requested curvature and so without a bound"


def test_a_suite_is_ready_when_the_controller_has_taken_the_calibration() -> None:
    said: dict[str, Any] = {"actuator_state": ActuatorState(driver_state=ActuatorState.STATE_ACTIVE)}
    said |= {"mirror_info": MirrorInfo(), "calibration": Calibration(id="c1")}
    assert "have not said yet" in lacks(said)
    for code, id_in_use, ready in (
        (ErrorCode.NOT_CALIBRATED, "", False),
        (ErrorCode.DRIVER_UNAVAILABLE, "", False),
        (ErrorCode.ELECTRONICS_UNREACHABLE, "c1", False),  # what is known of the history is not heard yet
        (ErrorCode.CALIBRATION_MISMATCH, "", True),  # it will not be taken, and the log says why
        (ErrorCode.OK, "c1", True),
    ):
        said["capabilities"] = Capabilities(error_code=code, calibration_id=id_in_use)
        assert (lacks(said) == "") == ready
    said |= {"calibration": Calibration(), "capabilities": Capabilities(error_code=ErrorCode.NOT_CALIBRATED)}
    assert lacks(said) == ""


def test_of_another_bench_the_wiring_comes_first() -> None:
    """As docs/my-own-bench.md has it: four minutes of calibration on wrong wiring are lost."""
    none, able, file = Capabilities(), Capabilities(calibration_id="c1"), Path("my bench.yaml")
    check = parsed("calibrate", *shlex.split(first_command(none, file))[1:])
    assert check["plan"] == "poke-check" and check["config"] == file and check["write"] is not None
    assert first_command(able, file) == "focus 0.02" and first_command(none, None) == "calibrate"
    again = parsed("calibrate", *shlex.split(first_command(none, Path("found.yaml")))[1:])
    assert again["config"] == Path("found.yaml") != again["write"]  # nothing is written over the file that is read
    # As ./dm status has it then.
    able.message = f"-0.05 to +0.05 1/m; {HISTORY_UNKNOWN}restarted"
    assert first_command(able, file) == "degauss"
    refused = Capabilities(error_code=ErrorCode.CALIBRATION_UNREADABLE)
    used = Calibration()
    used.hysteresis.play_radius = [0.0]
    active = ActuatorState(driver_state=ActuatorState.STATE_ACTIVE)
    assert first_command(refused, file) == "calibrate"
    assert verb_status._next([], "", active, used, None, refused) == "./dm calibrate"
    assert verb_status._next([], "", active, None, None, none).startswith("./dm calibrate --plan poke-check --config ")
    assert verb_status._next([], "", active, None, None, none, simulated=True) == "./dm calibrate"
    lost = ActuatorState(driver_state=ActuatorState.STATE_LINK_LOST)
    for simulated, doctor in ((False, ": ./dm doctor --config FILE says"), (True, ": ./dm doctor says")):
        told = verb_status._next([], "", lost, used, None, refused, simulated)
        assert "must reach the electronics first" in told and doctor in told


@pytest.mark.parametrize(("predicted", "next_step"), [(19e-9, "./dm check"), (21e-9, "ask for the shape again: ")])
def test_a_shape_of_before_the_calibration_changed_is_asked_for_again(predicted: float, next_step: str) -> None:
    """As ./dm check has it after --without: a map would show the error that the present command makes."""
    active, used = ActuatorState(driver_state=ActuatorState.STATE_ACTIVE), Calibration(id="c1")
    used.hysteresis.play_radius = [0.0]
    able = Capabilities(calibration_id="c1", residual_tolerance=20e-9)
    shape = SettledShape(0.02, 60.0, 30e-9, True, predicted, False)
    assert verb_status._next([], "", active, used, shape, able).startswith(next_step)


@pytest.mark.parametrize(
    ("words", "status", "said"),
    [
        (["dm", "--help"], 0, r"Usage: ros2 dm .*calibrate.*flatten"),
        (["dm", "focus", "--help"], 0, r"Usage: ros2 dm focus .*--take-over"),
        (["dm", "focus", "-0.02", "--dry-rn"], 2, "No such option: --dry-rn"),
    ],
)
def test_it_is_a_command_of_ros2_too(
    words: list[str], status: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (entry_point,) = entry_points(group="ros2cli.command", name="dm")
    command = entry_point.load()()
    parser = argparse.ArgumentParser(prog="ros2")  # as ros2cli has it
    own = parser.add_subparsers().add_parser("dm")
    own.set_defaults(command=command)
    command.add_arguments(own, "ros2 dm")
    with pytest.raises(SystemExit) as ended:
        arguments = parser.parse_args(words)
        arguments.command.main(parser=parser, args=arguments)
    shown = capsys.readouterr()
    assert ended.value.code == status
    assert re.search(said, shown.out + shown.err, re.DOTALL)
