"""Encrypted and authenticated links, by nothing but Zenoh settings in a file."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path

import pytest
from tests.network.processes import Processes, free_port

from trackmesh.protocol.errors import BusError
from trackmesh.protocol.zenoh_bus import ZenohBus

pytestmark = pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed")

_KEY = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-days", "2"]


def openssl(directory: Path, *arguments: str) -> None:
    subprocess.run(["openssl", *arguments], cwd=directory, check=True, capture_output=True)


def certify(directory: Path, name: str, extension: str) -> None:
    """A key and a certificate of our authority: ``name.key``, ``name.pem``."""
    (directory / "ext").write_text(extension)
    openssl(directory, "req", *_KEY, "-keyout", f"{name}.key", "-out", f"{name}.csr", "-subj", f"/CN={name}")
    signed = ["-CA", "ca.pem", "-CAkey", "ca.key", "-CAcreateserial", "-days", "2", "-extfile", "ext"]
    openssl(directory, "x509", "-req", "-in", f"{name}.csr", *signed, "-out", f"{name}.pem")


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("keys")
    openssl(directory, "req", "-x509", *_KEY, "-keyout", "ca.key", "-out", "ca.pem", "-subj", "/CN=test")
    certify(directory, "router", "subjectAltName=IP:127.0.0.1\nextendedKeyUsage=serverAuth")
    certify(directory, "sensor", "extendedKeyUsage=clientAuth")
    return directory


def settings(path: Path, tls: Mapping[str, object], **top: object) -> Path:
    path.write_text(json.dumps({"transport": {"link": {"tls": tls}}, **top}))
    return path


def test_both_sides_show_certificates(processes: Processes, keys: Path, tmp_path: Path) -> None:
    endpoint = f"tls/127.0.0.1:{free_port()}"
    authority = {"root_ca_certificate": str(keys / "ca.pem")}
    listening = {"listen_private_key": str(keys / "router.key"), "listen_certificate": str(keys / "router.pem")}
    connecting = {"connect_private_key": str(keys / "sensor.key"), "connect_certificate": str(keys / "sensor.pem")}
    of_router = settings(
        tmp_path / "router.json5",
        authority | listening | {"enable_mtls": True},
        mode="router",
        listen={"endpoints": [endpoint]},
    )
    good = settings(tmp_path / "good.json5", authority | connecting | {"enable_mtls": True})
    nameless = settings(tmp_path / "nameless.json5", authority)
    processes.start("-m", "trackmesh.services.router", "--config", str(of_router)).wait_for("ready after")

    with ZenohBus.open([endpoint], config_path=good, timeout_s=10.0) as bus:
        token = bus.declare_alive("secure/@v1/live/sensor/a")
        assert bus.watch_alive("secure/@v1/live/**").receive(5.0)
        token.close()
    for refused in (nameless, None):
        with pytest.raises(BusError, match="No router"):
            ZenohBus.open([endpoint], config_path=refused, timeout_s=0.5)


def test_the_endpoint_may_stand_in_the_file(processes: Processes, tmp_path: Path) -> None:
    router = processes.router()
    path = settings(tmp_path / "client.json5", {}, connect={"endpoints": [router.endpoint]})
    with ZenohBus.open([], config_path=path, timeout_s=5.0) as bus:
        assert bus.alive("none/@v1/**") == []


def test_a_user_without_the_password_is_refused(processes: Processes, tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    (tmp_path / "users.txt").write_text("north:secret\n")
    of_router = tmp_path / "router.json5"
    auth = {"usrpwd": {"user": "router", "password": "x", "dictionary_file": str(tmp_path / "users.txt")}}
    of_router.write_text(json.dumps({"transport": {"auth": auth}}))
    processes.start("-m", "trackmesh.services.router", "--config", str(of_router), "--listen", endpoint).wait_for(
        "ready after"
    )
    for password, welcome in (("secret", True), ("guess", False)):
        path = tmp_path / f"{password}.json5"
        path.write_text(json.dumps({"transport": {"auth": {"usrpwd": {"user": "north", "password": password}}}}))
        if welcome:
            ZenohBus.open([endpoint], config_path=path, timeout_s=5.0).close()
        else:
            with pytest.raises(BusError, match="accepts this client"):
                ZenohBus.open([endpoint], config_path=path, timeout_s=0.5)
