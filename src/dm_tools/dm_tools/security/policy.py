"""SROS 2 policy and governance files from the table of interfaces, and the DDS topics that a policy allows."""

import shlex
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as xml

from dm_tools.security.interfaces import NodeInterface, interfaces

#: Version of the policy format (sros2, policy.xsd).
POLICY_VERSION = "0.2.0"
#: Parent of the suite's enclaves.
ROOT = "/dm"
_RULES = {"topic": ("publish", "subscribe"), "service": ("reply", "request"), "action": ("execute", "call")}
_ACTION_SERVICES = ("cancel_goal", "get_result", "send_goal")
_ACTION_TOPICS = ("feedback", "status")
GOVERNANCE_SCHEMA = "http://www.omg.org/spec/DDS-SECURITY/20170901/omg_shared_ca_governance.xsd"
GOVERNANCE = """\
<?xml version="1.0" encoding="UTF-8"?>
<dds xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" xsi:noNamespaceSchemaLocation="{schema}">
  <domain_access_rules>
    <domain_rule>
      <domains>
        <id>{domain}</id>
      </domains>
      <allow_unauthenticated_participants>false</allow_unauthenticated_participants>
      <enable_join_access_control>true</enable_join_access_control>
      <discovery_protection_kind>ENCRYPT</discovery_protection_kind>
      <liveliness_protection_kind>ENCRYPT</liveliness_protection_kind>
      <rtps_protection_kind>SIGN</rtps_protection_kind>
      <topic_access_rules>
        <topic_rule>
          <topic_expression>*</topic_expression>
          <enable_discovery_protection>true</enable_discovery_protection>
          <enable_liveliness_protection>true</enable_liveliness_protection>
          <enable_read_access_control>true</enable_read_access_control>
          <enable_write_access_control>true</enable_write_access_control>
          <metadata_protection_kind>ENCRYPT</metadata_protection_kind>
          <data_protection_kind>ENCRYPT</data_protection_kind>
        </topic_rule>
      </topic_access_rules>
    </domain_rule>
  </domain_access_rules>
</dds>
"""


@dataclass(frozen=True)
class Profile:
    """What to generate.

    Attributes:
        namespace: of the mirror, "" for none.
        domain: ROS domain.
        simulation: with the virtual bench and its clock.
        sensor: topic that the interferometer takes coefficients from, "" for none.
    """

    namespace: str = ""
    domain: int = 0
    simulation: bool = False
    sensor: str = ""

    @property
    def ns(self) -> str:
        """The namespace as ROS writes it."""
        return f"/{self.namespace.strip('/')}"

    def path(self, enclave: str) -> str:
        """Path of an enclave."""
        return f"{ROOT}{self.ns.rstrip('/')}/{enclave}"

    def folder(self, keystore: Path) -> Path:
        """Folder in the keystore with the files of this mirror alone, except for its enclaves."""
        return keystore / self.ns.strip("/")

    def policy(self, keystore: Path, enclave: str) -> Path:
        """Path of the policy file of an enclave."""
        return self.folder(keystore / "policies") / f"{enclave}.policy.xml"

    def enclaves(self) -> dict[str, list[NodeInterface]]:
        """The nodes of each enclave, by its last part."""
        found: dict[str, list[NodeInterface]] = {}
        for node in interfaces(self.simulation, self.sensor):
            found.setdefault(node.enclave, []).append(node)
        return found


def full_name(name: str, ns: str, node: str) -> str:
    """A name as it appears in the ROS graph."""
    prefix = ns.rstrip("/")
    if name.startswith("~"):
        return f"{prefix}/{node}{name[1:]}"
    return name if name.startswith("/") else f"{prefix}/{name}"


def policy_xml(profile: Profile, enclave: str) -> str:
    """The policy file of one enclave."""
    policy = xml.Element("policy", version=POLICY_VERSION)
    place = xml.SubElement(xml.SubElement(policy, "enclaves"), "enclave", path=profile.path(enclave))
    profiles = xml.SubElement(place, "profiles")
    for node in profile.enclaves()[enclave]:
        one = xml.SubElement(profiles, "profile", ns=profile.ns, node=node.name)
        for element, rules in _RULES.items():
            for rule in rules:
                if names := getattr(node, rule):
                    listed = xml.SubElement(one, f"{element}s", {rule: "ALLOW"})
                    for name in sorted(set(names)):
                        xml.SubElement(listed, element).text = name
    xml.indent(policy)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{xml.tostring(policy, encoding="unicode")}\n'


def governance_xml(profile: Profile) -> str:
    """The governance file of the domain: authenticated participants only, access control, everything encrypted."""
    return GOVERNANCE.format(domain=profile.domain, schema=GOVERNANCE_SCHEMA)


def dds_topics(profile: Profile, enclave: str) -> dict[str, set[str]]:
    """The DDS topics that an enclave may "publish" and "subscribe", as sros2 writes them into its permissions."""
    publish, subscribe = {"ros_discovery_info"}, {"ros_discovery_info"}
    for node in profile.enclaves()[enclave]:
        full = {
            rule: [full_name(name, profile.ns, node.name) for name in getattr(node, rule)]
            for rules in _RULES.values()
            for rule in rules
        }
        offered = full["reply"] + [f"{name}/_action/{part}" for name in full["execute"] for part in _ACTION_SERVICES]
        called = full["request"] + [f"{name}/_action/{part}" for name in full["call"] for part in _ACTION_SERVICES]
        publish |= {f"rt{name}" for name in full["publish"]}
        publish |= {f"rr{name}Reply" for name in offered} | {f"rq{name}Request" for name in called}
        publish |= {f"rt{name}/_action/{part}" for name in full["execute"] for part in _ACTION_TOPICS}
        subscribe |= {f"rt{name}" for name in full["subscribe"]}
        subscribe |= {f"rq{name}Request" for name in offered} | {f"rr{name}Reply" for name in called}
        subscribe |= {f"rt{name}/_action/{part}" for name in full["call"] for part in _ACTION_TOPICS}
    return {"publish": publish, "subscribe": subscribe}


def environment(profile: Profile, keystore: Path) -> str:
    """A shell script that sets the environment of every process; as comments, how to make the keys with sros2."""
    store = shlex.quote(str(keystore))
    lines = [
        "# Sourced by whoever starts the nodes. Without the keys nothing starts: that is what Enforce means.",
        f"export ROS_SECURITY_KEYSTORE={store}",
        "export ROS_SECURITY_ENABLE=true",
        "export ROS_SECURITY_STRATEGY=Enforce",
        f"export ROS_DOMAIN_ID={profile.domain}",
        "",
        "# Make the keys, once, on a machine with `ros2 security` (apt: ros-jazzy-sros2); again after each",
        "# `dm security --out`, for governance and permissions. sros2 writes keys as the umask lets it, signs a",
        "# governance only where none is signed, and permissions for the ROS_DOMAIN_ID of the shell:",
        "#   umask 077",
        f"#   rm -f {shlex.quote(str(keystore / 'enclaves' / 'governance.p7s'))}",
        f"#   ros2 security create_keystore {store}",
    ]
    for enclave in profile.enclaves():
        path, file = profile.path(enclave), profile.policy(keystore, enclave)
        lines.append(f"#   ros2 security create_enclave {store} {path}")
        lines.append(f"#   ros2 security create_permission {store} {path} {shlex.quote(str(file))}")
    lines += ["", "# Each process its own enclave, by the environment: all its nodes belong to it then."]
    lines += [f"#   ROS_SECURITY_ENCLAVE_OVERRIDE={profile.path(enclave)}" for enclave in profile.enclaves()]
    return "\n".join(lines) + "\n"


def write_profile(profile: Profile, folder: Path) -> list[Path]:
    """Write policies, governance and environment into a keystore's folder; returns the files. Raises OSError.

    Files of mirrors in other namespaces are left alone; the governance is common to all.
    """
    folder = folder.absolute()
    files = {profile.policy(folder, enclave): policy_xml(profile, enclave) for enclave in profile.enclaves()}
    files[folder / "enclaves" / "governance.xml"] = governance_xml(profile)
    files[profile.folder(folder) / "environment.sh"] = environment(profile, folder)
    private = folder / "private"
    private.mkdir(mode=0o700, parents=True, exist_ok=True)
    for path, content in files.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content)
    return list(files)
