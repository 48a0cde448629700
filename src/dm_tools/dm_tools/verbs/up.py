"""`dm up`: the nodes on this terminal, against hardware or the virtual bench."""

import contextlib
import copy
import fcntl
import itertools
import os
import signal
import tempfile
import threading
import time
from collections.abc import Generator, Iterator, Mapping
from pathlib import Path
from shlex import quote
from typing import Annotated, Any

import typer

from dm_bringup.suite import Config, Suite, load_config
from dm_common.state_files import ros_home
from dm_tools.output import checked_namespace, console, next_step
from dm_tools.running_suite import calibration_refused, unknown_history

#: A suite that is not ready after this time is reported as late, s.
LATE_S = 30.0
#: Format of the lines of a node's log, unless the user has set one: with the time of the wall clock.
LOG_FORMAT = "{date_time_with_ms} {severity} {name}: {message}"
#: Distance between the port numbers of two virtual benches.
PORTS_APART = 10

#: Of the virtual camera: distances of the objects from left to right [m]; distance in focus with the flat mirror [m],
#: so that +-0.05 1/m reach from 5 m to infinity; images per second.
DISTANCES = (6.0, 15.0, 100.0)
REST_DISTANCE = 10.0
RATE = 30.0
CAMERA: Config = {
    "virtual_bench": {
        "camera.rate": RATE,
        "camera.rest_distance": REST_DISTANCE,
        "camera.distances": list(DISTANCES),
    },
    "autofocus": {"optics.rest_distance": REST_DISTANCE},
}


def shared_config(name: str) -> Path:
    """A file of the package's config folder."""
    from ament_index_python.packages import get_package_share_directory

    return Path(get_package_share_directory("dm_bringup")) / "config" / name


def up(
    config: Annotated[
        list[Path] | None,
        typer.Option(
            help="Parameter file of your bench, see config/hardware.yaml; none = virtual bench. With several mirrors "
            "one per --namespace, in that order."
        ),
    ] = None,
    namespace: Annotated[
        list[str] | None,
        typer.Option(
            help="Namespace of the mirror; several times for as many mirrors.",
            callback=lambda names: [checked_namespace(name) for name in names] if names else names,
        ),
    ] = None,
    camera: Annotated[
        bool,
        typer.Option("--camera", help="With a virtual camera behind the mirror of the virtual bench, and autofocus."),
    ] = False,
    remap: Annotated[
        list[str] | None,
        typer.Option(help="Another name of a topic: image_raw:=/camera/image_raw; several times."),
    ] = None,
    logs: Annotated[Path | None, typer.Option(help="Write the nodes' output to files in this folder instead.")] = None,
) -> None:
    """Start the nodes and keep them running until Ctrl-C or SIGTERM; the mirror is then ramped to its safe shape.

    A node that dies is started again, after a pause that grows while it dies again.
    """
    # A flag instead of an exception: nodes that are just being started must be stopped too. Set here in any case,
    # because a shell starts commands in the background with SIGINT ignored.
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:  # nohup ignores it
            signal.signal(number, lambda _number, _frame: stop.set())
    from dm_tools.doctor.bench import effective, taken_ports

    os.environ.setdefault("RCUTILS_CONSOLE_OUTPUT_FORMAT", LOG_FORMAT)
    mirrors = configurations(config or [], namespace or [""], camera)
    with tempfile.TemporaryDirectory(prefix="dm-up-") as temporary, contextlib.ExitStack() as stack:
        for name, configuration in mirrors.items():
            stack.enter_context(only_suite(name))
            # Otherwise a driver would take the mirror of another bench for its own.
            if "virtual_bench" in configuration and (taken := taken_ports(configuration)):
                raise RuntimeError(f"virtual_bench: {taken.problem}: {taken.cure}")
        # Closed after the suites, which make the mirrors safe first.
        watches = [
            stack.enter_context(
                contextlib.closing(say_when_ready(name, None if "virtual_bench" in mirrors[name] else file))
            )
            for name, file in itertools.zip_longest(mirrors, config or [])
        ]
        folder = logs if logs is not None else Path(temporary)
        suites = []
        for name, configuration in mirrors.items():
            suite = Suite(configuration, folder / name, namespace=name, echo=logs is None, remap=remap or [])
            suites.append(stack.enter_context(suite))
            kind = "virtual bench" if "virtual_bench" in configuration else "hardware"
            console.print(f"the nodes {f'of {name} ' if name else ''}are starting ({kind})")
            if kind == "virtual bench":
                bench = effective(configuration, "virtual_bench")
                console.print(
                    f"it keeps its last {bench['output_limit'] / 1e6:.0f} MB of maps in {bench['output_folder']}"
                )
        console.print("Ctrl-C stops them and makes every mirror safe")
        while not stop.wait(0.2):
            for suite in suites:
                suite.revive(lambda text: console.print(f"[yellow]{text}[/]"))
            for watch in watches:
                next(watch, None)
        console.print("\nstopping")


@contextlib.contextmanager
def only_suite(namespace: str) -> Iterator[None]:
    """Lock this ROS domain and namespace for one suite. Raises RuntimeError when another suite has the lock."""
    domain = os.environ.get("ROS_DOMAIN_ID") or "0"
    folder = ros_home()
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / f"dm_up.{domain}.{namespace.replace('/', '.')}").open("a+") as place:
        try:
            fcntl.flock(place, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            place.seek(0)
            raise RuntimeError(
                f"a suite runs already in the ROS domain {domain}, namespace /{namespace} ({place.read()}): ./dm "
                "status shows its state; Ctrl-C where it was started ends it. For several mirrors at once give one "
                "./dm up several --namespace"
            ) from None
        place.truncate(0)
        place.write(f"./dm up, process {os.getpid()}, since {time.strftime('%H:%M:%S')}")
        place.flush()
        yield


def lacks(messages: Mapping[str, Any]) -> str:
    """Why a suite does not take requests yet, by its latest `messages` (by topic); "" = it takes them."""
    from dm_client.connection import RESTING
    from dm_common.messages import driver_refusal

    capabilities = messages.get("capabilities")
    if (refusal := driver_refusal(messages.get("actuator_state"))) is not None:
        return str(refusal)
    if capabilities is not None and capabilities.error_code in RESTING:
        return str(capabilities.message or "focus_controller takes no requests yet")
    if capabilities is None or {"mirror_info", "calibration"} - messages.keys():
        return "calibration and focus_controller have not said yet what the mirror can do"
    if messages["calibration"].id and not (capabilities.calibration_id or calibration_refused(capabilities)):
        return "focus_controller has not loaded the calibration yet"
    return ""


def say_when_ready(namespace: str, file: Path | None) -> Generator[None, None, None]:
    """Yield until the suite of this namespace, configured by `file`, takes requests; say so and what to do next."""
    from dm_client import DeformableMirrorClient

    started, late = time.monotonic(), False
    with DeformableMirrorClient(namespace) as client:
        while lacking := lacks(client.messages):
            if not late and time.monotonic() - started > LATE_S:
                late = True
                console.print(f"not ready after {LATE_S:.0f} s: {lacking}; ./dm doctor says more")
            yield
        capabilities, mirror = client.capabilities, client.mirror_info
    in_use = f"calibration {capabilities.calibration_id}" if capabilities.calibration_id else "not calibrated yet"
    if calibration_refused(capabilities):
        in_use = f"its calibration is not used: {capabilities.message}"
    console.print(
        f"[bold green]ready[/] after {time.monotonic() - started:.0f} s: {mirror.name} {mirror.serial}, {in_use}"
    )
    first = first_command(capabilities, file)
    next_step(f"in another terminal: ./dm {first}; ./dm status shows the state", namespace)


def first_command(capabilities: Any, file: Path | None) -> str:
    """First command for a suite that `file` configures; None = a virtual bench, whose wiring its own file says."""
    if capabilities.calibration_id:
        return "degauss" if unknown_history(capabilities) else "focus 0.02"
    if file is None or calibration_refused(capabilities):
        return "calibrate"
    return poke_check(file)


def poke_check(file: Path) -> str:
    """Command that checks the wiring of the bench that `file` configures, and writes what differs to another file."""
    found = "found_again.yaml" if file.name == "found.yaml" else "found.yaml"
    return f"calibrate --plan poke-check --config {quote(str(file))} --write {found}"


def configurations(files: list[Path], namespaces: list[str], camera: bool = False) -> dict[str, Config]:
    """The configuration of the mirror in each namespace.

    Several mirrors on virtual benches get ports and folders of their own; with `camera` each has one behind it.

    Raises:
        ConfigError: a file cannot be used.
        ValueError: the numbers do not match, a namespace occurs twice, a section is missing, mirrors share a resource
            that each needs for itself, or `camera` is given with a file, which decides that itself.
    """
    from dm_tools.doctor.bench import own_values

    if camera and files:
        raise ValueError(
            "--camera is for the shipped virtual bench only; your own file says itself which camera it has"
        )
    names = [namespace.strip("/") for namespace in namespaces]
    if len(set(names)) < len(names):
        raise ValueError(f"--namespace {', '.join(namespaces)}: each mirror needs one of its own")
    if len(files) not in (0, len(names)):
        raise ValueError(f"--config: {len(files)} files for {len(names)} mirrors; give one for each --namespace")
    result = {}
    for number, name in enumerate(names):
        configuration = load_config(files[number] if files else shared_config("bench.yaml"), name)
        if "pdm_driver" not in configuration:
            raise ValueError(f"{files[number]}: no section for pdm_driver: its required parameters must be given")
        if (unset := own_values(configuration)) is not None:
            raise ValueError(f"{files[number]}: {unset.problem}: {unset.cure}")
        if camera:
            add_camera(configuration)
        result[name] = configuration if files or len(names) == 1 else virtual_mirror(configuration, name, number)
    if len(result) > 1:
        check_apart(result)
    return result


def check_apart(mirrors: Mapping[str, Config]) -> None:
    """Raise ValueError if two mirrors share a drive unit, folder of maps, store of calibrations or port of a bench."""
    users: dict[tuple[str, Any], str] = {}
    for mirror, config in mirrors.items():
        for thing in _own(config):
            if (other := users.setdefault(thing, mirror)) != mirror:
                text = f"{thing[0]} = {thing[1]} in the parameter files of {other} and {mirror}"
                raise ValueError(f"{text}: each mirror needs one of its own")


def _own(config: Config) -> Iterator[tuple[str, Any]]:
    """Resources that no two mirrors may share, with the names of their parameters."""
    from dm_driver.electronics import BACK_ENDS
    from dm_tools.doctor.bench import BENCH_PORTS, effective

    driver, folder = effective(config, "pdm_driver"), effective(config, "calibration")["calibration_folder"]
    yield (
        "mirror.serial, calibration_folder",
        f"{config['pdm_driver'].get('mirror.serial')}, {Path(folder).expanduser()}",
    )
    kind = driver["electronics.kind"]
    if kind in BACK_ENDS and (place := driver[name := f"electronics.{BACK_ENDS[kind].needs[0]}"]):
        yield name, f"{place}:{driver['electronics.port']}" if kind.startswith("edac40") else Path(place).expanduser()
    if watched := effective(config, "interferometer")["watch_folder"]:
        yield "watch_folder", Path(watched).expanduser()
    bench = effective(config, "virtual_bench")
    for name, protocol in BENCH_PORTS.items() if "virtual_bench" in config else ():
        if bench[name] > 0:  # 0 = any that is free
            yield f"{protocol} port of virtual_bench", bench[name]


def virtual_mirror(configuration: Config, name: str, number: int) -> Config:
    """The shipped virtual bench for mirror `number` of several: ports, folders, serial and seed of its own."""
    own = copy.deepcopy(configuration)
    simulation, driver = own["virtual_bench"], own["pdm_driver"]
    shift = PORTS_APART * number
    move_trigger(own, simulation["trigger.port"] + shift)
    for key in ("electronics.tcp_port", "electronics.udp_port", "electronics.discovery_port"):
        simulation[key] += shift
    driver["electronics.port"] += shift
    simulation["seed"] += number
    driver["mirror.serial"] = f"virtual-{name}-{simulation['seed']}"  # another seed means another mirror
    folder = f"~/.ros/dm_bench/{name}"
    simulation["output_folder"] = own["interferometer"]["watch_folder"] = f"{folder}/maps"
    own["calibration"]["calibration_folder"] = f"{folder}/calibrations"
    return own


def move_trigger(config: Config, port: int) -> None:
    """Put the trigger of the virtual bench on another port, in the interferometer's command too."""
    bench, interferometer = config["virtual_bench"], config["interferometer"]
    old = str(bench.get("trigger.port", ""))
    bench["trigger.port"] = port
    command = interferometer.get("trigger_command", [])
    interferometer["trigger_command"] = [str(port) if part == old else part for part in command]


def add_camera(config: Config) -> None:
    """Put a camera behind the mirror of a virtual bench, and the node `autofocus`."""
    for node, values in copy.deepcopy(CAMERA).items():
        config[node] = config.get(node, {}) | values
