"""The hardened profile beside the real nodes, and keystores that do not keep to it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree as xml

import pytest
from dm_msgs.msg import RecipeBook
from typer.testing import CliRunner

from dm_client import DeformableMirrorClient
from dm_common.ros import qos
from dm_common.ros.domains import own_domain
from dm_tools.cli import make_app
from dm_tools.console.console_node import ConsoleNode
from dm_tools.demo.demo_bench import bench_config
from dm_tools.running_suite import receive_health
from dm_tools.security.interfaces import interfaces
from dm_tools.security.keystore import check_keystore, keys_missing
from dm_tools.security.policy import Profile, dds_topics, write_profile
from fault_injection.rigs.forked_node import ForkedSuite
from running_interfaces import declaration_of, differences
from support import wait_until

pytestmark = pytest.mark.processes

PROFILE = Profile(simulation=True)
#: Nodes that live for a moment only.
SHORT_LIVED = {"calibration_exit"}
#: What a node hears with other parameters than here: `image_transport: compressed`.
OTHERWISE = {"subscribe /image_raw/compressed"}


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DeformableMirrorClient]:
    """All nodes, a client and a console."""
    folder = tmp_path_factory.mktemp("bench")
    config = bench_config(folder, "off", 0.0, 1, speed=20.0)
    config["virtual_bench"] |= {"interferometer.pixels": 236, "clock.period": 0.01}
    config["virtual_bench"]["camera.rate"] = 1.0
    config["autofocus"] = {"use_sim_time": True}
    with (
        own_domain() as domain,
        ForkedSuite(config, folder, domain),
        DeformableMirrorClient(domain=domain, timeout_s=60.0) as client,
    ):
        side = ConsoleNode(domain=domain)
        try:
            client.wait_until_active(60.0)
            wait_until(lambda: client.node.count_publishers("surface_map"), 60.0)
            client.measure_map()  # its subscriptions are made when they are needed
            receive_health(client)  # as `dm status` and `dm check` do
            client.subscribe("recipes", RecipeBook, qos.LATCHED)  # as `dm recipes` does
            yield client
        finally:
            side.close()


DECLARED = [node for node in interfaces(simulation=True) if node.name not in SHORT_LIVED]


@pytest.mark.parametrize("declared", DECLARED, ids=[node.name for node in DECLARED])
def test_the_policy_is_what_the_node_uses_and_nothing_more(bench: DeformableMirrorClient, declared: object) -> None:
    def running() -> str:
        names = bench.node.get_node_names()
        return next((name for name in names if declaration_of(name, PROFILE) == declared), "")

    name = wait_until(running, 60.0, f"a node {declared}")
    found: dict[str, list[str]] = {}

    def agrees() -> bool:
        found.update(differences(bench.node, name, PROFILE, declared))  # type: ignore[arg-type]
        return not found["more"] and set(found["less"]) <= OTHERWISE

    try:
        wait_until(agrees, 60)
    except AssertionError:
        raise AssertionError(f"{name}: {found}") from None


def test_only_the_interferometer_hears_a_sensor_and_only_where_there_is_one() -> None:
    profile = Profile("left", sensor="wavefront/zernike")
    subscribers = [
        name for name in profile.enclaves() if "rt/left/wavefront/zernike" in dds_topics(profile, name)["subscribe"]
    ]
    assert subscribers == ["interferometer"]
    assert "rt/left/wavefront/zernike" not in dds_topics(Profile("left"), "interferometer")["subscribe"]


def test_nobody_but_the_simulation_may_set_the_time() -> None:
    for profile in (Profile(), PROFILE):
        may = [enclave for enclave in profile.enclaves() if "rt/clock" in dds_topics(profile, enclave)["publish"]]
        assert may == (["virtual_bench"] if profile.simulation else [])


def test_only_the_controller_may_publish_commands_and_nobody_may_set_parameters() -> None:
    profile = Profile()
    topics = {enclave: dds_topics(profile, enclave)["publish"] for enclave in profile.enclaves()}
    assert [enclave for enclave in topics if "rt/actuator_command" in topics[enclave]] == ["focus_controller"]
    assert not [topic for names in topics.values() for topic in names if "set_parameters" in topic and "rq" in topic]


def test_names_carry_the_namespace() -> None:
    topics = dds_topics(Profile("left", 5), "pdm_driver")
    assert {"rt/left/actuator_state", "rt/diagnostics", "rr/left/pdm_driver/get_stateReply"} <= topics["publish"]


def signed(folder: Path, profile: Profile, enclave: str) -> Path:
    """Permissions as sros2 writes them, a key, and the texts alone in place of what is signed."""
    place = folder / "enclaves" / profile.path(enclave).lstrip("/")
    place.mkdir(parents=True)
    dates = "<not_before>2024-01-01T00:00:00</not_before><not_after>2099-01-01T00:00:00</not_after>"
    grant = f"<validity>{dates}</validity><allow_rule>"
    grant += f"<domains><id>{profile.domain}</id></domains>"
    for rule, topics in dds_topics(profile, enclave).items():
        listed = "".join(f"<topic>{topic}</topic>" for topic in sorted(topics))
        grant += f"<{rule}><topics>{listed}</topics></{rule}>"
    text = f"<dds><permissions><grant>{grant}</allow_rule><default>DENY</default></grant></permissions></dds>"
    (place / "permissions.xml").write_text(text)
    for name in ("permissions.p7s", "cert.pem"):
        (place / name).write_text(text)
    governance = folder / "enclaves" / "governance.p7s"
    governance.write_text(governance.with_suffix(".xml").read_text())
    (place / governance.name).symlink_to(governance)
    key = place / "key.pem"
    key.touch(0o600)
    return place


def test_a_keystore_that_keeps_to_the_profile(tmp_path: Path) -> None:
    profile = Profile()
    write_profile(profile, tmp_path)
    assert check_keystore(tmp_path, profile) == []
    assert len(keys_missing(tmp_path, profile)) == len(profile.enclaves())
    for enclave in profile.enclaves():
        signed(tmp_path, profile, enclave)
    assert check_keystore(tmp_path, profile) == []
    assert keys_missing(tmp_path, profile) == []


@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        ("permissions.xml", "rt/actuator_state", "rt/actuator_command", "publish: more than the policy: rt/actuator"),
        ("permissions.xml", "rt/actuator_state", "rt/actuator_command", "publish: missing: rt/actuator_state"),
        ("permissions.xml", "DENY", "ALLOW", "the default must be DENY"),
        ("permissions.xml", "2099", "2019", "not valid any more since 2019-01-01"),
        ("permissions.xml", "2024", "2098", "not valid before 2098-01-01"),
        ("permissions.p7s", "rt/mirror_info", "rt/others", "holds other permissions"),
        ("permissions.xml", "<id>0<", "<id>7<", "for the ROS domain 7: must be 0"),
        ("governance.p7s", "<id>0<", "<id>7<", "enclaves/governance.p7s: holds another governance than governance.xml"),
    ],
)
def test_permissions_that_do_not_keep_to_it(tmp_path: Path, file: str, old: str, new: str, words: str) -> None:
    profile = Profile()
    write_profile(profile, tmp_path)
    path = signed(tmp_path, profile, "pdm_driver") / file
    path.write_text(path.read_text().replace(old, new))
    assert words in " ".join(check_keystore(tmp_path, profile))


def test_a_private_key_that_others_may_read_and_a_policy_that_was_changed(tmp_path: Path) -> None:
    folder = tmp_path / "keystore"
    assert CliRunner().invoke(make_app(), ["security", "--out", str(folder)]).exit_code == 0
    assert CliRunner().invoke(make_app(), ["security", "--check", str(folder)]).exit_code == 0
    key = folder / "private" / "ca.key.pem"
    key.touch(0o640)
    policy = folder / "policies" / "cli.policy.xml"
    policy.write_text(policy.read_text().replace("mirror_info", "actuator_command"))
    found = check_keystore(folder, Profile())
    assert any("0640: a private key must be 0600" in line for line in found)
    assert any("cli.policy.xml: differs" in line and "actuator_command" in line for line in found)
    assert CliRunner().invoke(make_app(), ["security", "--check", str(folder)]).exit_code == 1


def test_two_mirrors_share_a_keystore(tmp_path: Path) -> None:
    profiles = [Profile(), Profile("left"), Profile("left/upper"), Profile("right")]
    files = [write_profile(profile, tmp_path) for profile in profiles]
    shared = {tmp_path / "enclaves" / "governance.xml"}
    for profile, own in zip(profiles, files, strict=True):
        assert not ({*own} - shared) & {path for others in files if others is not own for path in others}
        for enclave in profile.enclaves():
            signed(tmp_path, profile, enclave)
    for profile in profiles:
        assert check_keystore(tmp_path, profile) == [] and keys_missing(tmp_path, profile) == []
    assert "/policies/left/cli.policy.xml" in (tmp_path / "left" / "environment.sh").read_text()
    cli = tmp_path / "enclaves" / "dm" / "left" / "cli"
    cli.rename(cli.with_name("nobody"))
    found = [check_keystore(tmp_path, profile) for profile in profiles]
    assert [len(each) for each in found] == [0, 1, 0, 0] and "an enclave that no node of this" in found[1][0]


def test_policies_have_the_form_that_sros2_reads(tmp_path: Path) -> None:
    """The rules of sros2's policy.xsd (version 0.2.0) that a generated file could break."""
    for path in write_profile(PROFILE, tmp_path):
        if not path.name.endswith(".policy.xml"):
            continue
        policy = xml.parse(path).getroot()
        assert (policy.tag, policy.attrib) == ("policy", {"version": "0.2.0"})
        profiles = policy.findall("enclaves/enclave[@path]/profiles/profile")
        assert profiles and all(set(profile.attrib) == {"ns", "node"} for profile in profiles)
        for group in (group for profile in profiles for group in profile):
            assert group.tag in ("topics", "services", "actions") and set(group.attrib.values()) == {"ALLOW"}
            assert len(group) and {entry.tag for entry in group} == {group.tag[:-1]}
