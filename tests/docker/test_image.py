"""The image at work, without a Docker daemon: run by ``make docker-check``, which builds it with buildah.

Router, radars, fusion and viewer run in it as the user of the image, over mutual TLS.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.network.processes import free_port, wait_until
from tests.network.secured import Deployment

from trackmesh.services.deployment.plan import Plan, RouterPlan
from trackmesh.services.deployment.router_file import router_file

IMAGE = os.environ.get("TRACKMESH_IMAGE")
pytestmark = pytest.mark.skipif(IMAGE is None, reason="no image is given; `make docker-check` builds one")

FILES = "/etc/trackmesh"
PLAN = Plan(
    folder=FILES,
    routers={"main": RouterPlan(listen=[f"tls/127.0.0.1:{free_port()}"], hosts=["127.0.0.1"])},
    participants={"sensor": ["north", "east"], "fusion": ["main"], "viewer": ["ops"]},
)


class Container:
    """Commands in one container of the image; buildah starts no entry point, so commands are whole."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.name = _buildah("from", "--pull-never", str(IMAGE)).strip()
        self._running: list[subprocess.Popen[bytes]] = []

    def run(self, *command: str) -> str:
        return _buildah(*self._within, *command)

    def tells(self, *command: str) -> int:
        """The exit code."""
        return subprocess.run(["buildah", *self._within, *command], capture_output=True, check=False).returncode

    def start(self, log: str, *command: str) -> None:
        with (self.folder / log).open("wb") as out:
            self._running.append(
                subprocess.Popen(
                    ["buildah", *self._within, *command], stdout=out, stderr=subprocess.STDOUT, start_new_session=True
                )
            )

    def close(self) -> None:
        for process in reversed(self._running):
            os.killpg(process.pid, signal.SIGTERM)
            try:
                process.wait(15.0)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
        _buildah("rm", self.name)

    @property
    def _within(self) -> list[str]:
        return ["run", "--isolation", "chroot", "--volume", f"{self.folder}/certs:{FILES}:ro", self.name, "--"]


def _buildah(*arguments: str) -> str:
    done = subprocess.run(["buildah", *arguments], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def container(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Container]:
    folder = tmp_path_factory.mktemp("image")
    # A folder of the tests is nobody else's to enter.
    for parent in (folder, *folder.parents[:2]):
        parent.chmod(0o755)
    made = Deployment(PLAN, folder / "certs")
    (made.folder / "router.json5").write_text(router_file(PLAN))
    for path in [made.folder, *made.folder.iterdir()]:
        os.chown(path, 10001, 10001)
    container = Container(folder)
    yield container
    container.close()


def settings(who: str) -> list[str]:
    files = {"CA": "ca.pem", "CERTIFICATE": f"{who}.pem", "KEY": f"{who}.key"}
    return [
        "env",
        f"TRACKMESH_CONNECT={PLAN.router()[1].listen[0]}",
        f"TRACKMESH_HEARTBEAT_FILE=/tmp/{who}",
        *(f"TRACKMESH_TLS__{name}={FILES}/{file}" for name, file in files.items()),
    ]


def test_it_is_not_root_and_cannot_change_itself(container: Container) -> None:
    assert container.run("id", "-u").strip() == "10001"
    assert container.tells("test", "-w", "/opt/trackmesh/bin/trackmesh") == 1
    assert container.tells("test", "-w", "/var/cache/trackmesh") == 0
    assert container.run("trackmesh", "--version").startswith("trackmesh ")


def test_it_says_how_it_is_run(container: Container) -> None:
    config = json.loads(_buildah("inspect", "--type", "image", str(IMAGE)))["Docker"]["config"]
    assert config["User"] == "10001:10001"
    assert config["Entrypoint"] == ["trackmesh"]
    assert config["Healthcheck"]["Test"] == ["CMD", "python3", "-m", "trackmesh.services.heartbeat"]


def test_there_are_no_leftovers_of_the_build(container: Container) -> None:
    assert container.tells("test", "-e", "/build") == 1
    assert container.tells("test", "-e", "/opt/trackmesh/bin/gcc") == 1
    assert container.tells("python3", "-c", "import pip") == 1


def test_the_fusion_of_the_demo_runs_in_it(container: Container) -> None:
    assert container.tells(*settings("fusion.main"), "python3", "-m", "trackmesh.services.heartbeat") == 1
    container.start("router.log", "trackmesh", "router", "--config", f"{FILES}/router.json5")
    wait_until(lambda: "ready after" in (container.folder / "router.log").read_text(), "the router is ready", 30.0)
    container.start("fusion.log", *settings("fusion.main"), "trackmesh", "fusion")
    for radar in ("north", "east"):
        command = ("trackmesh", "sim", "radar", "--radar", radar)
        container.start(f"{radar}.log", *settings(f"sensor.{radar}"), *command)

    def ready() -> bool:
        return (
            container.tells(*settings("fusion.main"), "python3", "-m", "trackmesh.services.heartbeat", "--ready") == 0
        )

    # On another kind of processor than that of the build it compiles again.
    wait_until(ready, "the unit is ready", 280.0)

    def confirmed() -> int:
        told = subprocess.run(
            ["buildah", *container._within, *settings("viewer.ops"), "trackmesh", "tracks", "--json"],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        frames = [json.loads(line) for line in told.stdout.splitlines() if line.startswith("{")]
        return sum(frame["status"].count(1) for frame in frames)

    wait_until(lambda: confirmed() >= 30, "30 confirmed tracks", 90.0)
