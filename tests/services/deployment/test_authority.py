"""Certificates: what they say, who vouches, what is refused; openssl's view is Python's own ``ssl``."""

from __future__ import annotations

import datetime as dt
import socket
import ssl
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec

from trackmesh.services.deployment.authority import (
    Certificate,
    CertificateError,
    create_authority,
    issue,
    read_certificate,
    read_folder,
)
from trackmesh.services.deployment.plan import Participant

ROUTER = Participant("router", "main")
SENSOR = Participant("sensor", "north")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    create_authority(tmp_path / "certs")
    return tmp_path / "certs"


def loaded(made: Certificate) -> x509.Certificate:
    return x509.load_pem_x509_certificate(made.path.read_bytes())


def test_an_authority_vouches_for_itself(folder: Path) -> None:
    made = read_certificate(folder / "ca.pem")
    assert made.vouched
    assert made.common_name == "trackmesh authority"
    assert 3649 < made.days_left() <= 3650


def test_keys_are_readable_by_their_owner_only(folder: Path) -> None:
    issue(folder, SENSOR)
    assert {path.stat().st_mode & 0o777 for path in folder.glob("*.key")} == {0o600}
    assert {path.stat().st_mode & 0o777 for path in folder.glob("*.pem")} == {0o644}


def test_a_participant_is_named_with_its_role(folder: Path) -> None:
    made = issue(folder, SENSOR, days=2)
    assert (made.path, made.common_name, made.hosts, made.vouched) == (
        folder / "sensor.north.pem",
        "sensor.north",
        [],
        True,
    )
    assert 1.99 < made.days_left() <= 2
    certificate = loaded(made)
    key = certificate.public_key()
    assert isinstance(key, ec.EllipticCurvePublicKey)
    assert key.curve.name == "secp256r1"
    usages = certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    assert list(usages) == [x509.OID_CLIENT_AUTH]
    assert not certificate.extensions.get_extension_for_class(x509.BasicConstraints).value.ca


def test_a_router_is_for_its_hosts(folder: Path) -> None:
    made = issue(folder, ROUTER, ["router.example", "10.0.0.5", "::1"])
    assert made.hosts == ["router.example", "10.0.0.5", "::1"]
    usages = loaded(made).extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    assert set(usages) == {x509.OID_CLIENT_AUTH, x509.OID_SERVER_AUTH}


def test_a_certificate_does_not_outlive_its_authority(tmp_path: Path) -> None:
    authority = create_authority(tmp_path, days=1)
    assert issue(tmp_path, SENSOR, days=365).ends == authority.ends


def test_of_another_authority_is_not_vouched_for(folder: Path, tmp_path: Path) -> None:
    create_authority(tmp_path / "other")
    strange = issue(tmp_path / "other", SENSOR).path.rename(folder / "strange.pem")
    assert not read_certificate(strange).vouched


def test_both_authorities_of_a_change_vouch(folder: Path, tmp_path: Path) -> None:
    old = issue(folder, SENSOR)
    create_authority(tmp_path / "next")
    bundle = tmp_path / "next" / "ca.pem"
    bundle.write_text(bundle.read_text() + (folder / "ca.pem").read_text())
    assert read_certificate(old.path.rename(tmp_path / "next" / "old.pem")).vouched
    assert issue(tmp_path / "next", SENSOR).vouched


def test_nothing_is_overwritten_unless_renewed(folder: Path) -> None:
    first = loaded(issue(folder, SENSOR))
    with pytest.raises(CertificateError, match=r"sensor\.north\.pem is there already; --renew replaces it"):
        issue(folder, SENSOR)
    with pytest.raises(CertificateError, match="is there already"):
        create_authority(folder)
    second = loaded(issue(folder, SENSOR, renew=True))
    assert second.serial_number != first.serial_number
    assert (folder / "sensor.north.key").stat().st_mode & 0o777 == 0o600
    assert sorted(path.name for path in folder.iterdir()) == [
        "ca.key",
        "ca.pem",
        "sensor.north.key",
        "sensor.north.pem",
    ]


def test_what_a_user_reads(folder: Path, tmp_path: Path) -> None:
    cases: dict[str, Callable[[], object]] = {
        "The router main needs the hosts": lambda: issue(folder, ROUTER),
        "longer than the 64 letters": lambda: issue(folder, Participant("sensor", "n" * 60)),
        "There is no ca.pem": lambda: issue(tmp_path / "none", SENSOR),
        "more than a certificate can say": lambda: issue(folder, SENSOR, days=1e12),
        "There are no certificates": lambda: read_folder(tmp_path),
        "is no certificate": lambda: read_certificate(folder / "ca.key"),
    }
    for sentence, mistake in cases.items():
        with pytest.raises(CertificateError, match=sentence):
            mistake()


def test_an_authority_that_ended_or_has_another_key_issues_nothing(folder: Path, tmp_path: Path) -> None:
    create_authority(tmp_path / "short", days=0)
    with pytest.raises(CertificateError, match="has ended"):
        issue(tmp_path / "short", SENSOR)
    (folder / "ca.key").write_bytes((tmp_path / "short" / "ca.key").read_bytes())
    with pytest.raises(CertificateError, match="is not the key of"):
        issue(folder, SENSOR)


def test_a_clock_that_is_late_by_minutes_still_trusts(folder: Path) -> None:
    made = issue(folder, SENSOR)
    assert made.begins < dt.datetime.now(dt.UTC) - dt.timedelta(minutes=30)


def test_a_folder_is_listed_the_authority_first(folder: Path) -> None:
    issue(folder, SENSOR)
    issue(folder, ROUTER, ["localhost"])
    assert [one.common_name for one in read_folder(folder)] == ["trackmesh authority", "router.main", "sensor.north"]


@pytest.fixture
def pair() -> Iterator[tuple[socket.socket, socket.socket]]:
    one, other = socket.socketpair()
    yield one, other
    one.close()
    other.close()


def test_tls_of_another_maker_accepts_them(folder: Path, pair: tuple[socket.socket, socket.socket]) -> None:
    issue(folder, ROUTER, ["router.example"])
    issue(folder, SENSOR)
    server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    server.load_cert_chain(folder / "router.main.pem", folder / "router.main.key")
    server.load_verify_locations(folder / "ca.pem")
    server.verify_mode = ssl.CERT_REQUIRED
    server.verify_flags |= ssl.VERIFY_X509_STRICT
    client = ssl.create_default_context(cafile=str(folder / "ca.pem"))
    client.verify_flags |= ssl.VERIFY_X509_STRICT
    client.load_cert_chain(folder / "sensor.north.pem", folder / "sensor.north.key")
    seen: list[object] = []

    def serve() -> None:
        with server.wrap_socket(pair[0], server_side=True) as sealed:
            seen.append(sealed.getpeercert())
            sealed.send(b"x")

    thread = threading.Thread(target=serve)
    thread.start()
    with client.wrap_socket(pair[1], server_hostname="router.example") as sealed:
        assert sealed.recv(1) == b"x"
    thread.join(5.0)
    assert "sensor.north" in str(seen)
