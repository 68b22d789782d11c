"""Zenoh settings: ours, each paid for by a failure that was measured, under what a user's file says."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import zenoh

from trackmesh.protocol.bus import DEFAULT_ENDPOINT
from trackmesh.protocol.codec import MAX_BYTES
from trackmesh.protocol.credentials import Credentials
from trackmesh.protocol.errors import BusError

_SHARED: dict[str, object] = {
    # Nothing is found by chance: who talks to whom is written down.
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    # The caches of publishers with history need time stamps.
    "timestamping/enabled": True,
    # A frozen peer is noticed after its lease. Closing a blocked link must take less, or a sender can be cut off
    # for good: connected, alive, and never heard again.
    "transport/link/tx/lease": 2000,
    "transport/link/tx/queue/congestion_control/block/wait_before_close": 500_000,
    # What finds no place for a millisecond is dropped. A precaution for busy machines: the default is 2 batches.
    "transport/link/tx/queue/size/data_high": 16,
    # Else a router that accepts but never answers holds an opening client for 10 s.
    "transport/unicast/open_timeout": 2000,
    # Shared memory walks round the cap on sizes, and differs between containers and hosts.
    "transport/shared_memory/enabled": False,
    "transport/link/rx/max_message_size": MAX_BYTES + 2**20,
}

# No connect/timeout_ms: with it only the first endpoint is tried at the opening.
_CLIENT: dict[str, object] = {
    "mode": "client",
    "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2},
    "queries_default_timeout": 2000,
}

_ROUTER: dict[str, object] = {
    "mode": "router",
    "adminspace/enabled": True,
    # Who does not scout need not wait half a second for answers to it.
    "scouting/delay": 0,
}


def client_config(
    endpoints: Sequence[str], path: Path | None = None, credentials: Credentials | None = None
) -> zenoh.Config:
    """The settings of a client.

    Args:
        endpoints: of the routers, tried in turn; none means those in the file.
        path: a JSON5 file of Zenoh settings (TLS, user and password). What it leaves at Zenoh's default is set as this
            project needs it.
        credentials: for secured links; they win over the file.

    Raises:
        BusError: the file cannot be read, or a setting is wrong.
    """
    config = _layered(path, _SHARED | _CLIENT)
    for key, value in (credentials or Credentials()).settings().items():
        _insert(config, key, value)
    if endpoints:
        _insert(config, "connect/endpoints", list(endpoints))
    elif not endpoints_of(config, "connect"):
        _insert(config, "connect/endpoints", [DEFAULT_ENDPOINT])
    return config


def router_config(listen: Sequence[str], path: Path | None = None) -> zenoh.Config:
    """The settings of a router; arguments as in ``client_config``.

    Raises:
        BusError: the file cannot be read, or a setting is wrong.
    """
    config = _layered(path, _SHARED | _ROUTER)
    if listen:
        _insert(config, "listen/endpoints", list(listen))
    elif _at_default(config, "listen/endpoints"):
        _insert(config, "listen/endpoints", [DEFAULT_ENDPOINT])
    return config


def endpoints_of(config: zenoh.Config, what: str) -> list[str]:
    """The endpoints that a configuration connects or listens at."""
    value = json.loads(config.get_json(f"{what}/endpoints"))
    if isinstance(value, dict):
        value = value.get(json.loads(config.get_json("mode"))) or []
    return [value] if isinstance(value, str) else list(value)


def credentials_of(config: zenoh.Config) -> Credentials:
    """The files of a client's configuration, wherever they were set; not the password."""
    tls = json.loads(config.get_json("transport/link/tls"))
    names = ("root_ca_certificate", "connect_certificate", "connect_private_key")
    ca, certificate, key = (Path(tls[name]) if tls[name] else None for name in names)
    return Credentials(ca, certificate, key)


def _layered(path: Path | None, ours: Mapping[str, object]) -> zenoh.Config:
    config = _read(path) if path else zenoh.Config()
    for key, value in ours.items():
        if _at_default(config, key):
            _insert(config, key, value)
    return config


def _read(path: Path) -> zenoh.Config:
    if not path.is_file():
        raise BusError(f"Cannot read the Zenoh settings {path}: no such file.")
    try:
        return zenoh.Config.from_file(path)
    except zenoh.ZError as error:
        raise BusError(f"The Zenoh settings {path} are wrong: {_first_line(error)}.") from None


def _at_default(config: zenoh.Config, key: str) -> bool:
    return bool(config.get_json(key) == zenoh.Config().get_json(key))


def _insert(config: zenoh.Config, key: str, value: object) -> None:
    try:
        config.insert_json5(key, json.dumps(value))
    except zenoh.ZError as error:
        # A password is nobody's business.
        shown = "" if key.endswith("password") else f" = {value!r}"
        raise BusError(f"The Zenoh setting {key}{shown} is wrong: {_first_line(error)}.") from None


def _first_line(error: zenoh.ZError) -> str:
    # The library appends where in its own sources it gave up.
    text = " ".join(str(error).split()).partition(" at /")[0]
    return text.removeprefix('Json5Err(Message { msg: "').rstrip(".!")[:300]
