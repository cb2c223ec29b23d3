"""The certificates and the key of a TLS link, looked at before anybody uses them."""

import stat
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives.serialization import load_pem_private_key
from cryptography.x509.oid import NameOID

from needletrack.errors import PublishError
from needletrack.publish.tls import TlsFiles


def checked(files: TlsFiles, now: datetime) -> x509.Certificate:
    """Our certificate, where these files can be used now; raises PublishError with the file and the remedy."""
    authorities, (certificate, *between) = _certificates(files.authority), _certificates(files.certificate)
    _check_private(files.key)
    try:
        key = load_pem_private_key(files.key.read_bytes(), password=None)
    except (ValueError, TypeError, UnsupportedAlgorithm) as error:
        # Not the parser's own words: nothing of a key belongs into a message.
        raise PublishError(f"{files.key}: no private key in PEM without a passphrase") from error
    if key.public_key() != certificate.public_key():
        raise PublishError(f"{files.key} is not the key of {files.certificate}: take both from one issue")
    if not _leads_to(certificate, between, authorities):
        raise PublishError(
            f"{files.certificate} was not issued by an authority in {files.authority} "
            f"({' or '.join(one.subject.rfc4514_string() for one in authorities)}), but by "
            f"{certificate.issuer.rfc4514_string()}: take both from one authority, and put certificates in between "
            "behind ours, into its file"
        )
    for path, one in ((files.authority, authorities[0]), (files.certificate, certificate)):
        if now > one.not_valid_after_utc:
            raise PublishError(f"{path} expired on {one.not_valid_after_utc:%Y-%m-%d %H:%M} UTC: have it renewed")
        if now < one.not_valid_before_utc:
            raise PublishError(
                f"{path} is valid from {one.not_valid_before_utc:%Y-%m-%d %H:%M} UTC only: is the clock right?"
            )
    return certificate


def name_of(certificate: x509.Certificate) -> str:
    """The common name, by which access rules know its holder."""
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if names else ""


def _leads_to(
    certificate: x509.Certificate, between: Sequence[x509.Certificate], authorities: Sequence[x509.Certificate]
) -> bool:
    """Whether signatures lead from the certificate, through those in between, to one of the authorities."""
    if any(_issued(certificate, authority) for authority in authorities):
        return True
    for index, issuer in enumerate(between):
        rest = [*between[:index], *between[index + 1 :]]
        if _issued(certificate, issuer) and _leads_to(issuer, rest, authorities):
            return True
    return False


def _issued(certificate: x509.Certificate, issuer: x509.Certificate) -> bool:
    try:
        certificate.verify_directly_issued_by(issuer)
    except (ValueError, TypeError, InvalidSignature):
        return False
    return True


def _certificates(path: Path) -> list[x509.Certificate]:
    try:
        return x509.load_pem_x509_certificates(path.read_bytes())
    except OSError as error:
        raise PublishError(f"{path}: cannot read the certificate: {error.strerror or error}") from error
    except ValueError as error:
        raise PublishError(f"{path}: no X.509 certificate in PEM") from error


def _check_private(path: Path) -> None:
    try:
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode):
            raise PublishError(f"{path}: no file")
        if mode & (stat.S_IRWXG | stat.S_IRWXO):
            raise PublishError(
                f"{path} may be used by others than its owner (mode {stat.S_IMODE(mode):04o}): a private key is its "
                f"owner's alone: chmod 600 {path}; where others may have read it, have a new one issued"
            )
        path.read_bytes()
    except OSError as error:
        raise PublishError(f"{path}: cannot read the private key: {error.strerror or error}") from error
