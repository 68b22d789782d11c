"""The settings of a router, as a file that ``trackmesh router --config`` and ``zenohd -c`` read alike."""

from __future__ import annotations

import json
from collections.abc import Iterator

from trackmesh.protocol.codec import MAX_BYTES
from trackmesh.protocol.keys import Keys
from trackmesh.services.deployment.access import access_control
from trackmesh.services.deployment.plan import ROUTER, Limits, Participant, Plan, RouterPlan

USERS_FILE = "users.txt"
CA_FILE = "ca.pem"

_LINE_MOST = 200
_HEAD = """\
// The router {router} of the realm {realm}. Made by `trackmesh router-config`: change the deployment file instead.
// Read by `trackmesh router --config` and by `zenohd -c` alike.
"""


# As our own processes set it: see protocol/zenoh_config.py.
_QUEUE = {"size": {"data_high": 16}, "congestion_control": {"block": {"wait_before_close": 500_000}}}


def router_file(plan: Plan, name: str | None = None, *, password: str | None = None) -> str:
    """The JSON5 text for a router of a deployment.

    Args:
        plan: the deployment.
        name: of the router; may be left out if there is only one.
        password: of the router itself, to join others; only with ``security = "passwords"``.

    Raises:
        PlanError: there is no such router.
    """
    name, router = plan.router(name)
    settings = router_settings(plan, name, router, password)
    return _HEAD.format(router=name, realm=plan.realm) + _layout(settings) + "\n"


def router_settings(plan: Plan, name: str, router: RouterPlan, password: str | None = None) -> dict[str, object]:
    """The same as a dictionary. The constants are those of ``protocol.zenoh_config``, which says why."""
    settings: dict[str, object] = {
        "mode": "router",
        "listen": {"endpoints": router.listen},
        "connect": {
            "endpoints": router.connect,
            # A site goes on without the other one, and finds it when it is back.
            "exit_on_failure": False,
            "timeout_ms": -1,
            "retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2},
        },
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "timestamping": {"enabled": True},
        "adminspace": {"enabled": True, "permissions": {"read": True, "write": False}},
        "transport": {
            "link": _link(plan, name),
            "unicast": {"open_timeout": 2000, "accept_timeout": 2000, "max_sessions": plan.limits.links},
            "shared_memory": {"enabled": False},
            "auth": _auth(plan, name, password),
        },
        "low_pass_filter": list(_sizes(plan)),
        "downsampling": list(_rates(plan)),
    }
    if plan.security != "open":
        settings["access_control"] = access_control(plan)
    return settings


def _link(plan: Plan, name: str) -> dict[str, object]:
    link: dict[str, object] = {
        "tx": {"lease": 2000, "queue": _QUEUE},
        "rx": {"max_message_size": MAX_BYTES + 2**20},
    }
    if any(endpoint.startswith(("tls/", "quic/")) for r in plan.routers.values() for endpoint in r.listen + r.connect):
        link["tls"] = _tls(plan, name)
    if plan.security == "certificates":
        link["protocols"] = ["tls", "quic"]
    return link


def _tls(plan: Plan, name: str) -> dict[str, object]:
    own = f"{plan.folder}/{Participant(ROUTER, name).common_name}"
    return {
        "root_ca_certificate": f"{plan.folder}/{CA_FILE}",
        "listen_certificate": f"{own}.pem",
        "listen_private_key": f"{own}.key",
        "connect_certificate": f"{own}.pem",
        "connect_private_key": f"{own}.key",
        "enable_mtls": plan.security == "certificates",
        "verify_name_on_connect": True,
        # Who is connected when its certificate ends is not trusted any longer than others.
        "close_link_on_expiration": True,
    }


def _auth(plan: Plan, name: str, password: str | None) -> dict[str, object]:
    if plan.security != "passwords":
        return {}
    users = {"dictionary_file": f"{plan.folder}/{USERS_FILE}"}
    if password is None:
        return {"usrpwd": users}
    return {"usrpwd": {"user": Participant(ROUTER, name).common_name, "password": password, **users}}


def _plots(plan: Plan) -> list[str]:
    keys = Keys(plan.realm)
    return [keys.plots("*"), keys.ranges("*")]


def _sizes(plan: Plan) -> Iterator[dict[str, object]]:
    everything = Keys(plan.realm).everything()
    yield {
        "id": "messages",
        "flows": ["ingress"],
        "messages": ["put", "delete", "query", "reply"],
        "key_exprs": [everything, f"{everything}/@adv/**"],
        "size_limit": plan.limits.message_bytes,
    }
    yield {
        "id": "plots",
        "flows": ["ingress"],
        "messages": ["put", "reply"],
        "key_exprs": _plots(plan),
        "size_limit": plan.limits.plots_bytes,
    }


def _rates(plan: Plan) -> Iterator[dict[str, object]]:
    limits: Limits = plan.limits
    if limits.plots_per_s is not None:
        rules = [{"key_expr": expression, "freq": limits.plots_per_s} for expression in _plots(plan)]
        yield {"id": "plots", "flows": ["ingress"], "messages": ["put"], "rules": rules}


def _layout(value: object, indent: str = "") -> str:
    """JSON in which whatever fits on a line is on one."""
    line = json.dumps(value)
    if len(indent) + len(line) <= _LINE_MOST or not isinstance(value, dict | list):
        return line
    inner = indent + "  "
    if isinstance(value, dict):
        parts = [f"{json.dumps(name)}: {_layout(one, inner)}" for name, one in value.items()]
    else:
        parts = [_layout(one, inner) for one in value]
    brackets = "{}" if isinstance(value, dict) else "[]"
    return f"{brackets[0]}\n{inner}" + f",\n{inner}".join(parts) + f"\n{indent}{brackets[1]}"
