"""A folder for each role with all that it needs, and nothing of another's."""

import json
import stat
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import zenoh
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID
from typer.testing import CliRunner

from needletrack.authority import init_security
from needletrack.cli import app
from needletrack.config import load_config
from needletrack.errors import ConfigError, PublishError
from needletrack.publish.access import access_control
from needletrack.publish.certificates import name_of
from needletrack.publish.keys import RigKeys
from needletrack.publish.tls import TlsFiles

ROLES = ("publisher", "controller", "operator")


def certificate(folder: Path) -> x509.Certificate:
    return x509.load_pem_x509_certificate((folder / "certificate.pem").read_bytes())


@pytest.fixture(scope="module")
def pki(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pki")
    init_security(folder, "bench-2", hosts=["tracker.local", "10.0.4.20", "fd00::2"], key_prefix="ward/3", port=7600)
    return folder


@pytest.mark.parametrize("role", ROLES)
def test_a_roles_configuration_is_whole(pki: Path, role: str) -> None:
    folder = pki / "bench-2" / role
    config = load_config(folder / "needletrack.toml")
    table = config.publishing if role == "publisher" else config.subscribing
    tls = TlsFiles.configured(table.tls)
    assert tls is not None
    assert tls.key == folder / "key.pem"
    assert name_of(tls.check()) == f"bench-2.{role}"
    assert table.key_prefix == "ward/3"
    if role == "publisher":
        assert config.publishing.listen == ("tls/tracker.local:7600",)
        assert config.publishing.overlay.listen == ("tls/tracker.local:7601",)
    else:
        assert config.subscribing.connect == ("tls/tracker.local:7600",)


def test_every_key_is_its_owners_alone_and_no_two_are_alike(pki: Path) -> None:
    keys = sorted(pki.rglob("key.pem"))
    assert len(keys) == len(ROLES) + 2
    assert {stat.S_IMODE(key.stat().st_mode) for key in keys} == {0o600}
    assert {stat.S_IMODE(key.parent.stat().st_mode) for key in keys} == {0o700}
    assert len({key.read_bytes() for key in keys}) == len(keys)


def test_only_who_is_connected_to_may_be_a_server(pki: Path) -> None:
    for folder, serves in ((pki / "router", True), *((pki / "bench-2" / role, role == "publisher") for role in ROLES)):
        extensions = certificate(folder).extensions
        uses = extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
        assert (ExtendedKeyUsageOID.SERVER_AUTH in uses) is serves
        assert ExtendedKeyUsageOID.CLIENT_AUTH in uses
        assert extensions.get_extension_for_class(x509.BasicConstraints).value.ca is False
        if serves:
            names = extensions.get_extension_for_class(x509.SubjectAlternativeName).value
            assert names.get_values_for_type(x509.DNSName) == ["tracker.local"]
            assert [str(one) for one in names.get_values_for_type(x509.IPAddress)] == ["10.0.4.20", "fd00::2"]


def test_a_second_rig_shares_the_authority_and_joins_the_routers_rules(tmp_path: Path) -> None:
    init_security(tmp_path, "a")
    authority, of_a = certificate_bytes(tmp_path / "authority"), certificate(tmp_path / "a" / "operator")
    init_security(tmp_path, "b", key_prefix="ward")
    assert certificate_bytes(tmp_path / "authority") == authority
    assert certificate(tmp_path / "a" / "operator") == of_a
    rules = zenoh.Config.from_file(tmp_path / "router" / "router.json5").get_json("access_control")
    wanted = access_control([RigKeys("a"), RigKeys("b", "ward")])
    assert subjects(json.loads(rules)) == subjects(wanted)
    assert {"a.publisher", "b.operator", "needletrack.router"} <= subjects(wanted)
    assert json.loads(rules)["default_permission"] == "deny"


def certificate_bytes(folder: Path) -> bytes:
    return (folder / "authority.pem").read_bytes()


def subjects(access: dict[str, list[dict[str, list[str]]]]) -> set[str]:
    return {name for subject in access["subjects"] for name in subject["cert_common_names"]}


def test_a_rig_is_not_overwritten_but_renewed(tmp_path: Path) -> None:
    old = datetime.now(UTC) - timedelta(days=200)
    init_security(tmp_path, "a", now=old)
    with pytest.raises(PublishError, match=r"a is there already: .*--renew"):
        init_security(tmp_path, "a")
    init_security(tmp_path, "a", renew=True)
    assert certificate(tmp_path / "a" / "publisher").not_valid_after_utc > datetime.now(UTC)
    assert certificate(tmp_path / "router").not_valid_after_utc > datetime.now(UTC)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"rig": "a/b"}, "rig name 'a/b' cannot be part"),
        ({"rig": "x" * 60}, "is too long for a certificate"),
        ({"rig": "router"}, "is the name of a folder that is made here"),
        ({"rig": "a", "hosts": []}, "no host"),
        ({"rig": "a", "hosts": ["höst"]}, "host 'höst': no name or address"),
    ],
)
def test_what_cannot_be_issued_is_told(tmp_path: Path, arguments: dict[str, str], message: str) -> None:
    with pytest.raises(PublishError, match=message):
        init_security(tmp_path / "pki", **arguments)  # type: ignore[arg-type]
    assert not (tmp_path / "pki").exists()


def test_a_foreign_authority_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "authority").mkdir()
    (tmp_path / "authority" / "key.pem").write_text("theirs")
    with pytest.raises(PublishError, match="no authority of this command's"):
        init_security(tmp_path, "a")
    assert (tmp_path / "authority" / "key.pem").read_text() == "theirs"


def test_the_commands_say_what_a_hospital_must_do_instead(tmp_path: Path) -> None:
    made = CliRunner().invoke(app, ["security", "init", str(tmp_path / "pki"), "--rig", "a"])
    assert made.exit_code == 0
    assert "This is a TEST authority" in made.output
    assert "A hospital must instead" in made.output
    assert "BEGIN" not in made.output
    listed = CliRunner().invoke(app, ["security", "list", str(tmp_path / "pki")])
    assert listed.exit_code == 0
    assert "a.controller" in listed.output
    assert "89 days left" in listed.output
    init_security(tmp_path / "old", "b", now=datetime.now(UTC) - timedelta(days=91))
    listed = CliRunner().invoke(app, ["security", "list", str(tmp_path / "old")])
    assert listed.exit_code == 1
    assert "EXPIRED" in listed.output


def test_half_a_tls_table_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "half.toml"
    path.write_text('[publishing.tls]\nauthority = "a.pem"\nkey = "k.pem"\n')
    with pytest.raises(ConfigError, match=r"publishing\.tls.*certificate is missing: authority, certificate and key"):
        load_config(path)
