"""What proves who we are to a router, and a router to us: certificates, or a name and a password."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from trackmesh.protocol.errors import BusError


@dataclass(frozen=True)
class Credentials:
    """Files and names for secured links; what is None is not used.

    Attributes:
        ca: certificates (PEM) of who may vouch for a router; needed for ``tls/`` endpoints.
        certificate: our own certificate (PEM), shown to routers that ask for one.
        key: its private key (PEM).
        user: our name, where routers ask for a password.
        password: that goes with it.

    Raises:
        BusError: a file cannot be read, or one of a pair is missing.
    """

    ca: Path | None = None
    certificate: Path | None = None
    key: Path | None = None
    user: str | None = None
    password: str | None = None

    def __post_init__(self) -> None:
        _both("certificate", self.certificate, "key", self.key)
        _both("user", self.user, "password", self.password)
        if self.certificate is not None and self.ca is None:
            raise BusError("A certificate needs a ca as well, for that of the router.")
        for what, path in (("ca", self.ca), ("certificate", self.certificate), ("key", self.key)):
            if path is not None:
                _readable(what, path)

    def settings(self) -> dict[str, object]:
        """As Zenoh settings of a client, by their paths."""
        found: dict[str, object] = {}
        if self.ca is not None:
            found["transport/link/tls/root_ca_certificate"] = str(self.ca)
        if self.certificate is not None:
            found["transport/link/tls/connect_certificate"] = str(self.certificate)
            found["transport/link/tls/connect_private_key"] = str(self.key)
            # Without it a client shows no certificate.
            found["transport/link/tls/enable_mtls"] = True
        if self.user is not None:
            found["transport/auth/usrpwd/user"] = self.user
            found["transport/auth/usrpwd/password"] = self.password
        return found


def _both(first: str, one: object, second: str, other: object) -> None:
    if (one is None) != (other is None):
        given, missing = (first, second) if other is None else (second, first)
        raise BusError(f"A {given} needs a {missing} as well.")


def _readable(what: str, path: Path) -> None:
    try:
        with path.open("rb"):
            pass
    except OSError as error:
        raise BusError(f"Cannot read the {what} {path}: {error.strerror}.") from None
