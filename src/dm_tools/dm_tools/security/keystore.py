"""Check that a keystore conforms to the profile: its policies, its permissions, and who may read its private keys."""

import stat
from datetime import UTC, datetime
from pathlib import Path
from xml.etree import ElementTree as xml

from dm_tools.security.policy import Profile, dds_topics, governance_xml, policy_xml

_OTHERS = stat.S_IRWXG | stat.S_IRWXO


def check_keystore(folder: Path, profile: Profile) -> list[str]:
    """What is wrong with a keystore, in words; empty when nothing is. Raises ValueError when there is none."""
    if not folder.is_dir():
        raise ValueError(f"--check {folder}: no such folder")
    found: list[str] = []
    enclaves = profile.enclaves()
    for enclave in enclaves:
        found += _compare_text(profile.policy(folder, enclave), policy_xml(profile, enclave))
    governance = folder / "enclaves" / "governance.xml"
    found += _compare_text(governance, governance_xml(profile))
    # Nodes use the signed file, which sros2 signs once, together with the keystore; enclaves have links to it.
    for signed in sorted({path.resolve() for path in governance.parent.rglob("governance.p7s")}):
        if signed.is_file() and governance.is_file() and _plain(governance) not in _plain(signed):
            cure = "remove it, and create_keystore signs it anew"
            found.append(f"{signed}: holds another governance than {governance.name}: {cure}")
    signed_one = governance.with_suffix(".p7s")
    if not signed_one.is_file() and any(governance.parent.rglob("permissions.xml")):
        found.append(f"{signed_one}: missing; create_keystore signs it")
    expected = {profile.path(enclave).lstrip("/") for enclave in enclaves}
    for path in sorted((folder / "enclaves").rglob("permissions.xml")):
        place = path.parent.relative_to(folder / "enclaves").as_posix()
        if place in expected:
            found += _check_permissions(path, profile, place.rsplit("/", 1)[-1])
        elif place.rpartition("/")[0] == profile.path("").strip("/"):  # other enclaves belong to other mirrors
            found.append(f"{path}: an enclave that no node of this profile has")
    for path in sorted(folder.rglob("*.pem")):
        if path.name.endswith("key.pem") and path.stat().st_mode & _OTHERS:
            found.append(f"{path}: mode {stat.S_IMODE(path.stat().st_mode):04o}: a private key must be 0600")
    return found


def keys_missing(folder: Path, profile: Profile) -> list[str]:
    """The enclaves that have no key and permissions yet."""
    paths = [profile.path(enclave) for enclave in profile.enclaves()]
    files = ("key.pem", "cert.pem", "permissions.p7s", "governance.p7s")
    return [
        path for path in paths if not all((folder / "enclaves" / path.lstrip("/") / name).exists() for name in files)
    ]


def _compare_text(path: Path, wanted: str) -> list[str]:
    if not path.is_file():
        return [f"{path}: missing"]
    written = path.read_text(errors="replace")
    if written == wanted:
        return []
    old, new = (set(map(str.strip, text.splitlines())) for text in (written, wanted))
    more, less = sorted(old - new), sorted(new - old)
    text = [f"more: {' '.join(more[:3])}"] if more else []
    text += [f"missing: {' '.join(less[:3])}"] if less else []
    return [f"{path}: differs from the profile; {'; '.join(text) or 'in its order'}"]


def _check_permissions(path: Path, profile: Profile, enclave: str) -> list[str]:
    """Compare signed permissions with the policy, and look at their dates."""
    try:
        document = xml.parse(path)  # written by sros2 in a folder that its owner alone can write
    except xml.ParseError as error:
        return [f"{path}: not XML: {error}"]
    found = []
    signed = path.with_name("permissions.p7s")
    if not signed.is_file():
        found.append(f"{signed}: missing")
    elif _plain(path) not in _plain(signed):
        found.append(f"{signed}: holds other permissions than {path.name}: sign them again")
    if domains := {str(item.text) for item in document.iter("id")} - {str(profile.domain)}:
        found.append(f"{path}: for the ROS domain {', '.join(sorted(domains))}: must be {profile.domain}")
    if [item.text for item in document.iter("default")] != ["DENY"] * len(list(document.iter("grant"))):
        found.append(f"{path}: the default must be DENY")
    for rule, wanted in dds_topics(profile, enclave).items():
        allowed = {
            str(topic.text)
            for allow in document.iter("allow_rule")
            for part in allow.findall(rule)
            for topic in part.iter("topic")
        }
        for text, names in (("more than the policy", allowed - wanted), ("missing", wanted - allowed)):
            if names:
                found.append(f"{path}: {rule}: {text}: {', '.join(sorted(names)[:5])}")
    now = datetime.now(UTC)
    found += [f"{path}: not valid before {each.text}" for each in document.iter("not_before") if _date(each) > now]
    found += [
        f"{path}: not valid any more since {each.text}" for each in document.iter("not_after") if _date(each) < now
    ]
    return found


def _date(element: xml.Element) -> datetime:
    """The date in an element, of UTC if it names no time zone."""
    date = datetime.fromisoformat(str(element.text))
    return date if date.tzinfo else date.replace(tzinfo=UTC)


def _plain(path: Path) -> str:
    return "".join(path.read_text(errors="replace").split())
