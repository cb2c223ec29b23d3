"""The three files of a mutually authenticated TLS link, looked at before Zenoh reads them, and why a link was refused.

Zenoh itself only times out where a certificate does not fit.
"""

import re
import socket
import ssl
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

if TYPE_CHECKING:
    from cryptography import x509

    # It takes a second to load, which a command line that asks for help does not have.
    from needletrack.config import TlsConfig

_HANDSHAKE_WITHIN_S = 1.0
# Until then a server that refuses our certificate has said so: in TLS 1.3 the client is done before it is judged.
_ALERT_WITHIN_S = 0.5


@dataclass(frozen=True, slots=True)
class TlsFiles:
    """Paths (PEM) of the authority whom both sides trust, and of our own certificate and its private key."""

    authority: Path
    certificate: Path
    key: Path

    @classmethod
    def configured(cls, settings: "TlsConfig") -> Self | None:
        """What a configuration names; None where it names nothing."""
        if settings.authority is None or settings.certificate is None or settings.key is None:
            return None
        return cls(settings.authority, settings.certificate, settings.key)

    def check(self, now: datetime | None = None) -> "x509.Certificate":
        """Our certificate, where these files can be used now; raises PublishError with the file and the remedy."""
        # With cryptography it takes 0.07 s to load, for which a daemon on loopback has no use.
        from needletrack.publish.certificates import checked

        return checked(self, now or datetime.now(UTC))

    def zenoh_settings(self) -> dict[str, Any]:
        """Zenoh's `transport/link/tls`: both sides show a certificate, names are verified, expiry ends a link."""
        return {
            "root_ca_certificate": str(self.authority),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
            **{f"{way}_{what}": str(path) for way in ("listen", "connect") for what, path in self._own().items()},
        }

    def _own(self) -> dict[str, Path]:
        return {"certificate": self.certificate, "private_key": self.key}

    def why_refused(self, endpoint: str) -> str:
        """One sentence on why no link to a `tls/HOST:PORT` comes about, or "" where a handshake shows nothing wrong."""
        match = re.fullmatch(r"tls/\[?([^\]?#]+?)\]?:(\d+)(?:[?#].*)?", endpoint)
        if match is None:
            return ""
        host, port = match[1], int(match[2])
        try:
            context = ssl.create_default_context(cafile=str(self.authority))
            context.load_cert_chain(self.certificate, self.key)
            with (
                socket.create_connection((host, port), _HANDSHAKE_WITHIN_S) as raw,
                context.wrap_socket(raw, server_hostname=host) as link,
            ):
                link.settimeout(_ALERT_WITHIN_S)
                link.recv(1)
        except ssl.SSLCertVerificationError as error:
            return self._of_theirs(host, error)
        except ssl.SSLError as error:
            return self._of_ours(error)
        except TimeoutError:
            return ""  # the handshake was done, and nobody complained
        except OSError as error:
            return f"nothing answers on {host}:{port} ({error.strerror or error})"
        return "the other side closed the link after the handshake: its own log says why"

    def _of_theirs(self, host: str, error: ssl.SSLCertVerificationError) -> str:
        said = error.verify_message or str(error)
        if "mismatch" in said or "not valid for" in said:
            return (
                f"its certificate is not for {host!r} ({said}): connect to a name that it holds, or have it issued "
                "with this one among its subject alternative names"
            )
        if "expired" in said or "not yet valid" in said:
            return f"its certificate is out of date ({said}): renew it there, or set the clock right here"
        return f"its certificate is not of the authority in {self.authority} ({said})"

    def _of_ours(self, error: ssl.SSLError) -> str:
        said = (error.reason or "TLS failed").replace("_", " ").lower()
        if "wrong version" in said or "record layer" in said:
            return "no TLS is spoken there: is the port right, and does the other side listen on tls/?"
        return (
            f"the other side refused {self.certificate} ({said}): is it of the authority that the other side trusts, "
            "and valid by the other side's clock?"
        )
