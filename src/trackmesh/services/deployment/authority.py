"""A certificate authority for one deployment: a key that vouches for routers and participants, and nobody else.

Keys are on the curve P-256, certificates X.509 (RFC 5280). The role and the name of a participant are the common name,
``sensor.north``, which is what routers grant rights to.
"""

from __future__ import annotations

import datetime as dt
import ipaddress
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from trackmesh.protocol.errors import TrackmeshError
from trackmesh.services.deployment.plan import ROUTER, Participant
from trackmesh.services.deployment.router_file import CA_FILE

CA_KEY_FILE = "ca.key"
CA_DAYS, DAYS = 3650, 365

_COMMON_NAME_MOST = 64
# The clocks of sensors are not all right.
_BACKDATED = dt.timedelta(hours=1)


class CertificateError(TrackmeshError):
    """A certificate cannot be made or read; ``str()`` says why."""


@dataclass(frozen=True)
class Certificate:
    """What a certificate says.

    Attributes:
        path: its file.
        common_name: whose it is.
        hosts: for which it may be shown by a server.
        begins, ends: when it holds, UTC.
        vouched: it was signed by the authority beside it.
    """

    path: Path
    common_name: str
    hosts: list[str]
    begins: dt.datetime
    ends: dt.datetime
    vouched: bool

    def days_left(self, now: dt.datetime | None = None) -> float:
        """Until it ends; negative when it has ended."""
        return (self.ends - (now or _now())).total_seconds() / 86_400


def create_authority(folder: Path, name: str = "trackmesh", days: float = CA_DAYS) -> Certificate:
    """A new authority: ``ca.pem``, to be given to everybody, and ``ca.key``, to nobody.

    Raises:
        CertificateError: the folder has one already.
        OSError: it cannot be written.
    """
    for file in (CA_FILE, CA_KEY_FILE):
        if (folder / file).exists():
            raise CertificateError(f"{folder / file} is there already; a new authority wants a new folder.")
    key = ec.generate_private_key(ec.SECP256R1())
    subject = _name(f"{name} authority")
    usage = _key_usage(authority=True)
    certificate = (
        _builder(subject, subject, key.public_key(), days)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(usage, critical=True)
        .sign(key, hashes.SHA256())
    )
    folder.mkdir(parents=True, exist_ok=True)
    _write(folder / CA_KEY_FILE, _private(key), secret=True)
    _write(folder / CA_FILE, certificate.public_bytes(Encoding.PEM))
    return read_certificate(folder / CA_FILE)


def issue(
    folder: Path, who: Participant, hosts: Sequence[str] = (), days: float = DAYS, *, renew: bool = False
) -> Certificate:
    """A key and a certificate, ``sensor.north.key`` and ``sensor.north.pem``, vouched for by the folder's authority.

    Args:
        folder: of the authority; the files are written beside it.
        who: for whom.
        hosts: names and addresses of a router.
        days: how long it holds; never longer than the authority.
        renew: replace files that are there.

    Raises:
        CertificateError: there is no authority, it has ended, or files are there already.
        OSError: they cannot be written.
    """
    authority, ca_key = _authority(folder)
    if len(who.common_name) > _COMMON_NAME_MOST:
        raise CertificateError(f"{who.common_name} is longer than the {_COMMON_NAME_MOST} letters of a certificate.")
    if who.role == ROUTER and not hosts:
        raise CertificateError(f"The router {who.name} needs the hosts under which it is reached.")
    pem, key_file = folder / f"{who.common_name}.pem", folder / f"{who.common_name}.key"
    for file in (pem, key_file):
        if file.exists() and not renew:
            raise CertificateError(f"{file} is there already; --renew replaces it.")
    key = ec.generate_private_key(ec.SECP256R1())
    certificate = _leaf(authority, who, hosts, key.public_key(), days).sign(ca_key, hashes.SHA256())
    _write(key_file, _private(key), secret=True, replace=renew)
    _write(pem, certificate.public_bytes(Encoding.PEM), replace=renew)
    return read_certificate(pem)


def read_certificate(path: Path) -> Certificate:
    """What the first certificate of a file says.

    Raises:
        CertificateError: it is none.
        OSError: it cannot be read.
    """
    certificate = _load(path)
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return Certificate(
        path=path,
        common_name=str(names[0].value) if names else "",
        hosts=_hosts(certificate),
        begins=certificate.not_valid_before_utc,
        ends=certificate.not_valid_after_utc,
        vouched=_vouched(certificate, path.parent / CA_FILE),
    )


def read_folder(folder: Path) -> list[Certificate]:
    """All certificates in a folder, the authority's first, then by name.

    Raises:
        CertificateError: there are none, or one cannot be read.
        OSError: the folder or a file cannot be read.
    """
    files = sorted(folder.glob("*.pem"), key=lambda path: (path.name != CA_FILE, path.name))
    if not files:
        raise CertificateError(f"There are no certificates in {folder}; `trackmesh certs init` begins.")
    return [read_certificate(path) for path in files]


def _leaf(
    authority: x509.Certificate, who: Participant, hosts: Sequence[str], key: ec.EllipticCurvePublicKey, days: float
) -> x509.CertificateBuilder:
    # Routers also connect to each other, and show their certificate then.
    usages = [ExtendedKeyUsageOID.CLIENT_AUTH] + [ExtendedKeyUsageOID.SERVER_AUTH] * (who.role == ROUTER)
    builder = (
        _builder(_name(who.common_name), authority.subject, key, days, at_most=authority.not_valid_after_utc)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_key_usage(authority=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage(usages), critical=False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_subject_key_identifier(
                authority.extensions.get_extension_for_class(x509.SubjectKeyIdentifier).value
            ),
            critical=False,
        )
    )
    if hosts:
        builder = builder.add_extension(x509.SubjectAlternativeName([_host(h) for h in hosts]), critical=False)
    return builder


def _builder(
    subject: x509.Name,
    issuer: x509.Name,
    key: ec.EllipticCurvePublicKey,
    days: float,
    at_most: dt.datetime | None = None,
) -> x509.CertificateBuilder:
    now = _now()
    try:
        ends = now + dt.timedelta(days=days)
    except OverflowError:
        raise CertificateError(f"{days:g} days are more than a certificate can say.") from None
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _BACKDATED)
        .not_valid_after(min(ends, at_most) if at_most else ends)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
    )


def _key_usage(*, authority: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not authority,
        key_cert_sign=authority,
        crl_sign=authority,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _host(text: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(text))
    except ValueError:
        pass
    try:
        return x509.DNSName(text)
    except ValueError:
        raise CertificateError(f"{text!r} is no name of a host.") from None


def _hosts(certificate: x509.Certificate) -> list[str]:
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return []
    return [*names.get_values_for_type(x509.DNSName), *map(str, names.get_values_for_type(x509.IPAddress))]


def _authority(folder: Path) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
    for file in (CA_FILE, CA_KEY_FILE):
        if not (folder / file).is_file():
            raise CertificateError(f"There is no {file} in {folder}; `trackmesh certs init` makes an authority.")
    certificate = _load(folder / CA_FILE)
    try:
        key = load_pem_private_key((folder / CA_KEY_FILE).read_bytes(), None)
    except (ValueError, TypeError, UnsupportedAlgorithm):
        raise CertificateError(f"{folder / CA_KEY_FILE} is no private key.") from None
    if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != certificate.public_key():
        raise CertificateError(f"{folder / CA_KEY_FILE} is not the key of {folder / CA_FILE}.")
    if certificate.not_valid_after_utc <= _now():
        raise CertificateError(
            f"The authority in {folder} has ended; `trackmesh certs init` makes a new one elsewhere."
        )
    return certificate, key


def _load(path: Path) -> x509.Certificate:
    try:
        return x509.load_pem_x509_certificate(path.read_bytes())
    except ValueError:
        raise CertificateError(f"{path} is no certificate.") from None


def _vouched(certificate: x509.Certificate, authority: Path) -> bool:
    try:
        known = x509.load_pem_x509_certificates(authority.read_bytes())
    except (OSError, ValueError):
        return False
    return any(_signed_by(certificate, one) for one in known)


def _signed_by(certificate: x509.Certificate, authority: x509.Certificate) -> bool:
    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature):
        return False
    return True


def _private(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())


def _write(path: Path, content: bytes, *, secret: bool = False, replace: bool = False) -> None:
    # Made with its mode, so that a key is at no time anybody's to read.
    fresh = path.with_name(f".{path.name}.{os.getpid()}") if replace else path
    with os.fdopen(os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600 if secret else 0o644), "wb") as file:
        file.write(content)
    if replace:
        fresh.replace(path)


def _now() -> dt.datetime:
    return dt.datetime.now(dt.UTC)
