"""`needletrack security`: a test authority, a certificate for each role of a rig, and the rules made from its name.

A folder a role: what one machine needs, and nothing of another's. The authority's own key stays in its folder.
"""

import ipaddress
import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, load_pem_private_key
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from needletrack.errors import PublishError
from needletrack.publish.access import ROUTER_NAME, Role, access_control, common_name
from needletrack.publish.certificates import name_of
from needletrack.publish.keys import DEFAULT_PREFIX, RigKeys
from needletrack.publish.session import LEASE_MS

AUTHORITY_DAYS = 3650
# X.520's upper bound of a common name.
_LONGEST_NAME = 64
# Hosts whose clocks differ a little must not find a fresh certificate not valid yet.
_BACKDATED = timedelta(hours=1)

_AUTHORITY, _CERTIFICATE, _KEY, _RIG = "authority.pem", "certificate.pem", "key.pem", "rig.json"

NOT_FOR_A_HOSPITAL = """\
This is a TEST authority. Whoever reads authority/key.pem can be anybody on your network: publish poses, move robots.
It is good for a laboratory bench and for trying things out. A hospital must instead:
  - have its own PKI issue the certificates, with the common names and uses that these have (docs/security.md);
  - make each private key on the machine that uses it, and send a request for a signature there, never a key;
  - keep the authority's key off line or in a hardware module, and log what it signs;
  - issue for days or weeks and renew by itself: Zenoh looks at no revocation list, so that a stolen certificate is
    good until it expires, or until its name is taken out of the rules and every daemon and router was restarted;
  - keep the network of the rigs apart (VLAN, firewall): certificates do not stop whoever floods a link."""


@dataclass(frozen=True, slots=True)
class Issued:
    """One role's folder, and the common name of the certificate in it."""

    folder: Path
    name: str


def init_security(
    folder: Path,
    rig: str,
    *,
    hosts: Sequence[str] = ("127.0.0.1", "localhost"),
    key_prefix: str = DEFAULT_PREFIX,
    days: int = 90,
    port: int = 7447,
    renew: bool = False,
    now: datetime | None = None,
) -> list[Issued]:
    """Make, or go on with, a test authority in `folder`, and issue the certificates of one rig's roles and the router.

    hosts: names and addresses by which others reach the daemon and the router; the first is put into the
    configurations. renew: replace a rig's certificates. The router's rules cover every rig of the folder. Raises
    PublishError for a name that cannot be used, a rig that is there already, and a folder that cannot be written.
    """
    keys, now = RigKeys(rig, key_prefix), now or datetime.now(UTC)
    if len(longest := max((common_name(rig, role) for role in Role), key=len)) > _LONGEST_NAME:
        raise PublishError(f"rig name {rig!r} is too long for a certificate: {longest} has more than 64 characters")
    if rig in ("authority", "router"):
        raise PublishError(f"rig name {rig!r} is the name of a folder that is made here: take another")
    if (folder / rig).exists() and not renew:
        raise PublishError(f"{folder / rig} is there already: replace its certificates with --renew")
    names = [_general_name(host) for host in hosts]
    if not names:
        raise PublishError("no host: name at least one by which the daemon is reached")
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        authority = _Authority.opened(folder / "authority", now)
        issued = []
        for role in Role:
            where, name = folder / rig / role.value, common_name(rig, role)
            serves = names if role is Role.PUBLISHER else []
            authority.issue(where, name, serves, now, days)
            _write(where / "needletrack.toml", _configuration(role, keys, hosts[0], port))
            issued.append(Issued(where, name))
        described = {"key_prefix": key_prefix, "hosts": list(hosts), "port": port}
        _write(folder / rig / _RIG, json.dumps(described, indent=2) + "\n")
        router = folder / "router"
        if renew or not router.exists():
            authority.issue(router, ROUTER_NAME, names, now, days)
        _write(router / "router.json5", _router(_rigs(folder), hosts[0], port))
        issued.append(Issued(router, ROUTER_NAME))
        _write(folder / "README.txt", NOT_FOR_A_HOSPITAL + "\n")
    except OSError as error:
        raise PublishError(f"{error.filename}: cannot write: {error.strerror or error}") from error
    return issued


@dataclass(frozen=True, slots=True)
class _Authority:
    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey

    @classmethod
    def opened(cls, folder: Path, now: datetime) -> "_Authority":
        """The authority of a folder, made where there is none."""
        if not (folder / _KEY).exists():
            return cls._made(folder, now)
        try:
            key = load_pem_private_key((folder / _KEY).read_bytes(), password=None)
            certificate = x509.load_pem_x509_certificate((folder / _AUTHORITY).read_bytes())
        except ValueError as error:
            raise PublishError(f"{folder}: no authority of this command's: start anew in another folder") from error
        if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != certificate.public_key():
            raise PublishError(f"{folder}: key and certificate do not belong together: start anew in another folder")
        return cls(certificate, key)

    @classmethod
    def _made(cls, folder: Path, now: datetime) -> "_Authority":
        key = ec.generate_private_key(ec.SECP256R1())
        name = _name("needletrack test authority")
        certificate = (
            _begun(name, name, key, now, AUTHORITY_DAYS)
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(_usage(signs_certificates=True), critical=True)
            .sign(key, hashes.SHA256())
        )
        _write_key(folder, key)
        _write(folder / _AUTHORITY, _pem(certificate))
        return cls(certificate, key)

    def issue(self, folder: Path, name: str, serves: Sequence[x509.GeneralName], now: datetime, days: int) -> None:
        """Write authority, certificate and key for a name; only who `serves` may be connected to, under these names."""
        key = ec.generate_private_key(ec.SECP256R1())
        uses = [ExtendedKeyUsageOID.CLIENT_AUTH, *([ExtendedKeyUsageOID.SERVER_AUTH] if serves else [])]
        begun = (
            _begun(_name(name), self.certificate.subject, key, now, days)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_usage(signs_certificates=False), critical=True)
            .add_extension(x509.ExtendedKeyUsage(uses), critical=False)
            .add_extension(
                x509.AuthorityKeyIdentifier.from_issuer_public_key(self.key.public_key()),
                critical=False,
            )
        )
        if serves:
            begun = begun.add_extension(x509.SubjectAlternativeName(serves), critical=False)
        _write_key(folder, key)
        _write(folder / _CERTIFICATE, _pem(begun.sign(self.key, hashes.SHA256())))
        _write(folder / _AUTHORITY, _pem(self.certificate))


def expiries(folder: Path) -> Iterator[tuple[Path, str, datetime]]:
    """Path, common name and last moment of every certificate of a folder that `init_security` made."""
    for path in sorted(folder.rglob(_CERTIFICATE)):
        certificate = x509.load_pem_x509_certificate(path.read_bytes())
        yield path, name_of(certificate), certificate.not_valid_after_utc


def _begun(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePrivateKey, now: datetime, days: int
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _BACKDATED)
        .not_valid_after(now + timedelta(days=days))
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )


def _usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _name(common: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common)])


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        pass
    try:
        return x509.DNSName(host)
    except ValueError as error:
        raise PublishError(f"host {host!r}: no name or address ({error})") from error


def _pem(certificate: x509.Certificate) -> str:
    return certificate.public_bytes(Encoding.PEM).decode()


def _write_key(folder: Path, key: ec.EllipticCurvePrivateKey) -> None:
    """For its owner alone from the first byte on."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    path = folder / _KEY
    path.unlink(missing_ok=True)
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "wb") as file:
        file.write(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def _rigs(folder: Path) -> list[RigKeys]:
    """Every rig of the folder, for the router's rules."""
    described = ((path.parent.name, json.loads(path.read_text("utf-8"))) for path in sorted(folder.glob(f"*/{_RIG}")))
    return [RigKeys(rig, about["key_prefix"]) for rig, about in described]


def _configuration(role: Role, keys: RigKeys, host: str, port: int) -> str:
    table = "publishing" if role is Role.PUBLISHER else "subscribing"
    endpoint, pictures = (json.dumps([f"tls/{_bracketed(host)}:{number}"]) for number in (port, port + 1))
    lines = [f"# {common_name(keys.rig, role)}", f"[{table}]", f"key_prefix = {json.dumps(keys.prefix)}"]
    if role is Role.PUBLISHER:
        lines += [f"listen = {endpoint}", "", "[publishing.overlay]", f"listen = {pictures}"]
    else:
        lines += [f"connect = {endpoint}"]
    lines += ["", f"[{table}.tls]"]
    lines += [f'{key} = "{file}"' for key, file in (("authority", _AUTHORITY), ("certificate", _CERTIFICATE))]
    return "\n".join([*lines, f'key = "{_KEY}"', ""])


def _router(rigs: Sequence[RigKeys], host: str, port: int) -> str:
    settings = {
        "mode": "router",
        "listen": {"endpoints": [f"tls/{_bracketed(host)}:{port}"]},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {
            "link": {
                "protocols": ["tls"],
                "tx": {"lease": LEASE_MS},
                "tls": {
                    "root_ca_certificate": _AUTHORITY,
                    "enable_mtls": True,
                    "verify_name_on_connect": True,
                    "close_link_on_expiration": True,
                    "listen_certificate": _CERTIFICATE,
                    "listen_private_key": _KEY,
                    "connect_certificate": _CERTIFICATE,
                    "connect_private_key": _KEY,
                },
            },
            "shared_memory": {"enabled": False},
        },
        "access_control": access_control(rigs),
    }
    head = "// For `needletrack router`, or zenohd started in this folder. Made anew by `needletrack security init`.\n"
    return head + json.dumps(settings, indent=2) + "\n"


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host
