"""What the documentation tells to type: its blocks, and how each command of them is tried."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from markdown_it import MarkdownIt
from markdown_it.token import Token

ROOT = Path(__file__).resolve().parents[1]
PAGES = (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md")))


@dataclass(frozen=True)
class Block:
    """A block of code.

    Attributes:
        page: file name.
        line: of its beginning, from 1.
        text: without indentation.
        language: of a fenced block; "" = none told.
    """

    page: str
    line: int
    text: str
    language: str

    def __str__(self) -> str:
        return f"{self.page}:{self.line}"

    @property
    def kind(self) -> str:
        """python, yaml, shell, or text (see TEXTS)."""
        first = self.text.split("\n", 1)[0]
        if self.language in ("python", "yaml"):
            return self.language
        if first.startswith(("from ", "import ")):
            return "python"
        if first.startswith("/**/"):
            return "yaml"
        return "text" if first in TEXTS else "shell"

    @property
    def commands(self) -> list[str]:
        """Of a shell block, one each, without comments."""
        lines = (re.sub(r"\s+#\s.*$", "", line).strip() for line in self.text.splitlines())
        return [part.strip() for line in lines if line for part in line.split(" && ")]


@cache
def parsed(page: Path) -> list[Token]:
    return MarkdownIt().enable("table").parse(page.read_text())


def blocks() -> list[Block]:
    """All blocks of all pages."""
    found = []
    for page in PAGES:
        for token in parsed(page):
            if token.type in ("fence", "code_block"):
                assert token.map is not None
                found.append(Block(page.name, token.map[0] + 1, token.content.rstrip("\n"), token.info.strip()))
    return found


def inline_commands() -> Iterator[tuple[str, str]]:
    """(page, command) of every `./dm ...` within the text."""
    for page in PAGES:
        for token in parsed(page):
            for child in token.children or []:
                if child.type == "code_inline" and child.content.startswith("./dm "):
                    yield page.name, child.content


#: Words on the screen that need no explanation.
PLAIN = frozenset(
    re.findall(
        r"\w+",
        "accurate active adds ago back beforehand beside better budget calibrate cancel changed clock compares "
        "connected could ctrl data done dropped fast fits forgotten go goal if info makes mb min most needs newest "
        "none now present again doctor have long ok own pdf ready real running said several sheets since soon start "
        "status taken terminal config there things took typical "
        "other valid whole write writes written yaml yet",
    )
)
#: Endings of a word, and what its stem has instead.
ENDINGS = (("ies", "y"), ("es", ""), ("s", ""), ("ed", ""), ("ed", "e"), ("ing", ""), ("ing", "e"), ("ly", ""))


def unexplained(text: str) -> set[str]:
    """Words of what was printed that neither are plain nor stand in the glossary; names and numbers are no words."""
    explained = PLAIN | set(re.findall(r"[^\W\d_]+", (ROOT / "docs" / "glossary.md").read_text().lower()))
    tokens = (token.strip("()[],;:.'`\"") for token in text.lower().split())
    words = {
        word for token in tokens if not re.search(r"[/_\d=]", token) for word in re.findall(r"[^\W\d_]{2,}", token)
    }
    return {
        word
        for word in words - explained
        if not any(word.endswith(end) and word[: -len(end)] + stem in explained for end, stem in ENDINGS)
    }


#: Blocks that are nothing to type, by their first line.
TEXTS = {
    "file, reference, part, degrees": "table of maps of flats; test_instrument_errors.py reads one",
    "header | one word per channel | check sum | terminator": "layout of a frame",
    (
        "poke check the maps show the mirror mirrored left to right, "
        "then turned by 35.01 +- 0.02 degrees counter-clockwise"
    ): "what a poke check prints",
}

#: Run to their end on the scene, in this order; they must succeed.
RUN = (
    "./dm status",
    "./dm calibrate",
    "./dm calibrate --dry-run",
    "./dm focus 0.02",
    "./dm check --dry-run",
    "./dm report",
    "./dm degauss",
    "./dm check",
    "./dm check --forget",
    "./dm recipes --list",
)
#: Never end by themselves: started, watched for these words, interrupted.
WATCHED = {
    "./dm up": "Ctrl-C stops them",
    "./dm up --camera": "next: in another terminal: ./dm calibrate",
    "./dm console": "http://127.0.0.1:8037",
    "./dm console --port 9000 --namespace mirror_a": "http://127.0.0.1:9000",
    "./dm record --out runs/monday": "recording",
}
#: The scene itself.
SCENE = "./dm up --config my_bench.yaml"
#: Run behind `./dm record --out runs/monday`, on a domain of their own.
REPLAYED = ("./dm replay runs/monday --rate 10",)

_LONG = "takes minutes; "
#: Only their names, options and values are checked, against the command itself; why, and what runs them.
PARSED = {
    "./dm demo": _LONG + "test_whole_runs.py runs it",
    "./dm demo --camera": _LONG + "its parts run in test_autofocus_node.py",
    "./dm demo --config src/dm_bringup/config/mirror_19.yaml": _LONG + "test_second_mirror.py runs its parts",
    "./dm demo --config src/dm_bringup/config/membrane_37.yaml": _LONG + "test_membrane_mirror.py runs its parts",
    "./dm calibrate --boresight": "needs a camera; test_boresight_command.py runs what it does, test_held_tilt.py how",
    "./dm calibrate --boresight --image-topic /camera/image_raw": "the same, with another topic",
    "./dm exec python examples/camera_focus.py": "test_autofocus_node.py runs it",
    "./dm instrument retrace tilt*.dat": "test_instrument_errors.py runs it on maps of the virtual bench",
    "./dm instrument grid marks.csv any.dat": "test_instrument_errors.py runs it on maps of the virtual bench",
    "./dm measure --reference-sphere -1.5": "no sphere stands there; test_ingest.py checks what it finds",
    "./dm check --without 5": "that actuator is well; test_drift_updates.py checks such updates",
    "./dm test": "would run this test again",
    "./dm test --fast": "would run tests within a test",
    "./dm test src/dm_common/test/test_zernike_terms.py": "would run tests within a test",
    "./dm calibrate --plan full": _LONG + "test_end_to_end.py runs the plan",
    "./dm calibrate --plan pokes": _LONG + "test_doctor.py and others make such a calibration",
    "./dm calibrate --until 2nm": _LONG + "test_calibrate_command.py checks what it asks for",
    "./dm calibrate --fresh": _LONG + "test_end_to_end.py runs the plan",
    "./dm calibrate --hysteresis 200": _LONG + "test_calibration_node.py and the demo run the plan",
    "./dm calibrate --plan surfaces --surfaces p06,p07,pz02": _LONG + "test_calibration_node.py runs the plan",
    "./dm calibrate --plan poke-check": _LONG + "test_whole_runs.py runs the plan",
    "./dm focus 0.02 --conditioned": "needs recipes; test_focus_hysteresis.py asks for it",
    "./dm recipes": _LONG + "test_loop_actions.py runs the action",
    "./dm recipes --curvatures=-0.02,0,0.02": "needs a hysteresis plan first; test_loop_actions.py runs the action",
    "./dm recipes --conic=-1 --curvatures=-0.05:0.05:11": "needs a hysteresis plan first",
    './dm recipes --zernike "coma sin=50" --zernike "astigmatism cos=200"': "needs a hysteresis plan first",
    "./dm report PDM30-37_virtual-1_20261121T112233Z --store ~/.ros/dm_bench/calibrations": "an example of an id",
    "./dm report path/to/calibration.h5 --out reports --json figures.json": "an example of a path",
    "./dm replay runs/monday": "in its own time; run with --rate 10",
    "./dm replay runs/monday --topics image_raw,camera_info,focus_state": "test_autofocus_node.py plays such images",
    "./dm replay runs/monday --recalibrate": "needs a recorded calibration; test_recording.py runs it",
    "./dm replay runs/theirs --recalibrate --config my_bench.yaml": "needs such a recording; test_recording.py runs it",
    "./dm compare --plant preisach --seed 5 --json runs/compare.json": _LONG + "test_compare.py runs its parts",
    "./dm compare --hysteresis --plant all": _LONG + "test_ablation.py runs its parts",
    "./dm compare --hysteresis --plant all --seed 51 --seed 52 --seed 53": _LONG + "test_ablation.py runs its parts",
    "./dm compare --mirrors 30 --seed 7743": _LONG + "test_compare_mirrors.py runs its parts",
    "./dm compare --mirrors 2 --quick": _LONG + "test_compare_mirrors.py runs its parts",
    "./dm bench --json runs/bench.json --plot runs/growth.png": _LONG + "test_benchmark_ratios.py runs its jobs",
    "./dm bench --only focus": _LONG + "test_benchmark_ratios.py runs its jobs",
    "./dm paper --out runs/paper --json runs/paper.json": _LONG + "test_paper.py runs it",
    "./dm doctor --config my_bench.yaml": "test_doctor.py runs it",
    "./dm exec python -m studies.simulation_plot --output simulation.png": "draws for a minute",
    "./dm exec python -m pytest -q src/dm_driver/test/test_electronics_contract.py": "is a test of its own",
}
#: Need another machine, its package manager or the network; what is named in them is checked by hand.
ELSEWHERE = {
    "git clone <this repository>": "placeholder",
    "cd <its folder>": "placeholder",
    "rosdep install --from-paths src --ignore-src -y": "needs apt and root",
    "sudo apt-get install python3-statsmodels": "needs apt and root",
    "colcon build": "needs ROS 2 from apt; ./dm builds with colcon",
    "colcon build --packages-up-to dm_example_cpp": "needs ROS 2 from apt; `test_cpp_example` compiles it",
    "docker build -t deformable-mirror .": "needs a Docker daemon; the hosted checks build it",
    "docker run --rm -it --shm-size 1g deformable-mirror dm demo": "the same",
    "docker run --rm -it --network host --ipc host deformable-mirror": "the same",
    "pip install -r requirements/docs.txt": "needs the network; the hosted checks do it",
    "mkdocs build": "the same",
    "source install/setup.bash": "the same",
    'ln -s "$PWD/dm" ~/.local/bin/dm': "test_completion.py makes such a link and completes through it",
    "dm --install-completion": "test_completion.py runs it",
    './dm exec python -c "import dm_client"': "would set up within the tests",
    "./dm exec pip install pre-commit": "needs the network",
    "./dm exec pre-commit install": "needs what the command before it installs",
    "./dm exec python -m studies.documentation.parameters > docs/parameters.md": "test_repository.py",
    "./dm exec python -m studies.documentation.interfaces > docs/interfaces.md": "test_interface_reference.py",
}
#: What Python blocks take for granted, by page and number of the block on it.
PRELUDES = {
    ("README.md", 2): "",
    ("add-a-drive-unit.md", 1): "",
    ("focus-from-my-node.md", 1): "import rclpy\nfrom rclpy.node import Node\nrclpy.init()\nnode = Node('mine')\n",
    ("focus-from-my-node.md", 2): "",
    ("read-the-report.md", 1): "from pathlib import Path\nfolder = Path('reports')\nfolder.mkdir(exist_ok=True)\n",
}
#: Run by other tests.
PYTHON_ELSEWHERE = {
    ("README.md", 1): "is the middle of examples/camera_focus.py, which test_autofocus_node.py runs",
    ("camera.md", 1): "is examples/camera_focus.py, which test_autofocus_node.py runs",
    ("calibrate.md", 1): "is the beginning of examples/calibrate_folder.py, which test_calibrate.py runs",
    ("calibrate.md", 2): "is the beginning of examples/compare_laws.py, which test_any_measurement.py runs",
    ("recipes.md", 1): "needs recipes; the goal is the one that test_console_operations.py sends",
}


def classified(command: str) -> bool:
    """Whether somebody has said how `command` is tried; commands of ROS 2 always are, by their parts."""
    known = (*RUN, *WATCHED, SCENE, *REPLAYED, *PARSED, *ELSEWHERE)
    return command in known or shlex.split(command)[0] == "ros2"
