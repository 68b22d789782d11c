"""The Kubernetes manifests: by the schemas of Kubernetes, and by what they mean."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
from tests.docker.files import BASE, DEMO, certificate_files, read_yaml, unknown_settings, who_runs, workloads

from trackmesh.services.deployment.authority import create_authority, issue
from trackmesh.services.deployment.plan import ROUTER, Participant, load_plan
from trackmesh.services.deployment.router_file import router_file

PLAN = load_plan(BASE / "deployment.toml")
(BASE_SETTINGS,) = read_yaml(BASE / "kustomization.yaml")
(DEMO_SETTINGS,) = read_yaml(DEMO / "kustomization.yaml")
MANIFESTS = [folder / name for folder, settings in ((BASE, BASE_SETTINGS), (DEMO, DEMO_SETTINGS))
             for name in settings["resources"] if name.endswith(".yaml")]  # fmt: skip
PODS = dict(workloads(MANIFESTS))
SERVICES = {name: pod for name, pod in PODS.items() if name != "router"}
SECRETS = {one["name"]: one["files"] for one in BASE_SETTINGS["secretGenerator"]}


def generated(generator: str) -> set[str]:
    return {one["name"] for one in BASE_SETTINGS[generator]}


@pytest.mark.parametrize("path", MANIFESTS, ids=lambda path: path.name)
@pytest.mark.parametrize("version", ["1.28", "1.37"])
def test_the_schemas_of_kubernetes(path: Path, version: str) -> None:
    check = pytest.importorskip("kubernetes_validate")
    for document in read_yaml(path):
        check.validate(document, version, strict=True)


def test_every_manifest_is_used() -> None:
    files = {path for folder in (BASE, DEMO) for path in folder.glob("*.yaml")}
    assert files == {*MANIFESTS, BASE / "kustomization.yaml", DEMO / "kustomization.yaml"}


def test_the_router_has_the_settings_of_the_plan() -> None:
    assert (BASE / "router.json5").read_text() == router_file(PLAN)
    pod = PODS["router"]
    mounts = {one["name"]: one["mountPath"] for one in pod["containers"][0]["volumeMounts"]}
    assert pod["containers"][0]["args"][:2] == ["-c", f"{mounts['settings']}/router.json5"]
    assert "--rest-http-port=none" in pod["containers"][0]["args"]
    assert mounts["certificate"] == PLAN.folder
    assert {Path(file).name for file in SECRETS["router-certificate"]} == {
        "ca.pem",
        "router.main.pem",
        "router.main.key",
    }


def test_the_router_is_reached_by_a_name_that_its_certificate_has() -> None:
    (service,) = (one for one in read_yaml(BASE / "router.yaml") if one["kind"] == "Service")
    (connection,) = (one for one in BASE_SETTINGS["configMapGenerator"] if one["name"] == "connection")
    endpoint = dict(line.split("=") for line in connection["literals"])["TRACKMESH_CONNECT"]
    host, port = endpoint.removeprefix("tls/").split(":")
    assert host == service["metadata"]["name"]
    assert host in PLAN.router()[1].hosts
    assert PLAN.router()[1].listen == [f"tls/0.0.0.0:{port}"]
    assert service["spec"]["ports"][0]["port"] == int(port)
    assert service["spec"]["ports"][0]["targetPort"] == PODS["router"]["containers"][0]["ports"][0]["name"]
    assert PODS["router"]["containers"][0]["ports"][0]["containerPort"] == int(port)


@pytest.mark.parametrize("name", SERVICES)
def test_every_command_is_one_of_ours_and_shows_its_own_certificate(name: str) -> None:
    pod = SERVICES[name]
    (container,) = pod["containers"]
    who = who_runs(container["args"])
    assert who in set(PLAN.everybody())
    (secret,) = (one["secret"]["secretName"] for one in pod["volumes"] if "secret" in one)
    assert SECRETS[secret] == [
        "certs/ca.pem",
        f"certificate.pem=certs/{who.common_name}.pem",
        f"key.pem=certs/{who.common_name}.key",
    ]
    (connection,) = (one for one in BASE_SETTINGS["configMapGenerator"] if one["name"] == "connection")
    settings = dict(line.split("=") for line in connection["literals"])
    assert unknown_settings(list(settings)) == []
    (mount,) = (one["mountPath"] for one in container["volumeMounts"] if one["name"] == "certificate")
    assert {settings[f"TRACKMESH_TLS__{what}"] for what in ("CA", "CERTIFICATE", "KEY")} == {
        f"{mount}/{file}" for file in ("ca.pem", "certificate.pem", "key.pem")
    }
    assert container["envFrom"] == [{"configMapRef": {"name": "connection"}}]


@pytest.mark.parametrize("name", PODS)
def test_what_is_mounted_is_there(name: str) -> None:
    pod = PODS[name]
    volumes = {one["name"] for one in pod["volumes"]}
    for container in [*pod["containers"], *pod.get("initContainers", [])]:
        assert {one["name"] for one in container["volumeMounts"]} <= volumes
    for volume in pod["volumes"]:
        assert volume.get("secret", {}).get("secretName") in {None, *SECRETS}
        assert volume.get("configMap", {}).get("name") in {None, *generated("configMapGenerator")}


@pytest.mark.parametrize("name", PODS)
def test_pods_may_little_and_are_limited(name: str) -> None:
    pod = PODS[name]
    assert pod["securityContext"]["runAsNonRoot"]
    assert not pod["automountServiceAccountToken"]
    for container in [*pod["containers"], *pod.get("initContainers", [])]:
        assert container["securityContext"] == {
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"]},
        }
        assert set(container["resources"]["limits"]) == {"cpu", "memory"}


@pytest.mark.parametrize("name", PODS)
def test_probes(name: str) -> None:
    container: dict[str, Any] = PODS[name]["containers"][0]
    for kind in ("startupProbe", "livenessProbe"):
        probe = container[kind]
        if name == "router":
            assert probe["tcpSocket"]["port"] == "zenoh"
            continue
        python, flag, module, *rest = probe["exec"]["command"]
        assert (python, flag) == ("python3", "-m")
        assert importlib.util.find_spec(module) is not None
        assert rest == (["--ready"] if kind == "startupProbe" else [])


def test_secrets_are_of_certificates_that_are_issued() -> None:
    files = {Path(one.partition("=")[2] or one).name for files in SECRETS.values() for one in files}
    assert files == certificate_files(PLAN) - {"viewer.ops.pem", "viewer.ops.key"}


def test_kustomize_builds_both(tmp_path: Path) -> None:
    if shutil.which("kubectl") is None:
        pytest.skip("kubectl is not installed")
    shutil.copytree(BASE.parent, tmp_path / "kubernetes", ignore=shutil.ignore_patterns("certs"))
    certs = tmp_path / "kubernetes" / "base" / "certs"
    create_authority(certs)
    issue(certs, Participant(ROUTER, "main"), ["router"])
    for who in PLAN.everybody():
        issue(certs, who)
    for folder, radars in ((BASE, 0), (DEMO, 2)):
        command = ["kubectl", "kustomize", str(tmp_path / "kubernetes" / folder.name)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 0, done.stderr
        assert done.stdout.count("kind: Deployment") == 4 + radars
        assert "image: trackmesh:0.1.0" in done.stdout
        # References follow the names that kustomize gives to what it generates.
        assert "secretName: fusion-certificate-" in done.stdout
