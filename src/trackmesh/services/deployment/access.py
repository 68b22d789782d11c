"""Rights as rules of Zenoh's access control.

What has to be known of it (eclipse-zenoh 1.10, tried out one by one; a mistake here is silence, never an error):

* A rule holds for a declaration or question only if its key expression includes all of that of the message. So a rule
  for ``plots/*`` serves who subscribes to ``plots/*`` or ``plots/north``, and not who subscribes to ``**``.
* A publisher sends nothing until it sees that somebody subscribes. So what others subscribe to, and ask, may always be
  told; who may subscribe and ask is decided where the declaration comes in.
* ``**`` does not meet chunks that begin with ``@``. The library's means for a publisher's history live below such a
  chunk and need rules of their own.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from trackmesh.protocol.keys import Keys
from trackmesh.services.deployment.plan import ROUTER, Participant, Plan
from trackmesh.services.deployment.rights import RIGHTS, Rights

Json = dict[str, object]

_HISTORY = "@adv/**"


def access_control(plan: Plan) -> Json:
    """The setting ``access_control`` of a router: what is not allowed here is refused."""
    keys = Keys(plan.realm)
    told = _told(keys)
    rules: dict[str, Json] = {str(told["id"]): told}
    subjects, policies = [], []
    for participant in _all(plan):
        ids = plan.ids(participant.name) if participant.role == "sensor" else [participant.name]
        own = {str(rule["id"]): rule for rule in _rules(participant, RIGHTS[participant.role](keys, ids))}
        rules |= own
        subjects.append({"id": participant.common_name, _named_by(plan): [participant.common_name]})
        policies.append({"rules": [told["id"], *own], "subjects": [participant.common_name]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": list(rules.values()),
        "subjects": subjects,
        "policies": policies,
    }


def _all(plan: Plan) -> Iterator[Participant]:
    yield from plan.everybody()
    for name in plan.routers:
        yield Participant(ROUTER, name)


def _named_by(plan: Plan) -> str:
    return "usernames" if plan.security == "passwords" else "cert_common_names"


def _told(keys: Keys) -> Json:
    messages = ["declare_subscriber", "declare_queryable", "query", "liveliness_query", "declare_liveliness_subscriber"]
    return _rule("told", messages, ["egress"], _with_history([keys.everything()]))


def _rules(who: Participant, rights: Rights) -> Iterator[Json]:
    # What is said is one's own; what may be heard is the same for all of a role.
    name, role = who.common_name, who.role
    says, hears = _with_history(rights.says), _with_history(rights.hears)
    cached, caches = _history(rights.says), _history(rights.hears)
    # A cache answers with samples under the key at which they were published.
    watching = ["liveliness_query", "declare_liveliness_subscriber"]
    rows: list[tuple[str, list[str], str, list[str]]] = [
        (f"{name} says", ["put", "delete"], "ingress", list(rights.says)),
        (f"{name} lives", ["liveliness_token"], "ingress", [*rights.lives, *cached]),
        (f"{name} answers", ["declare_queryable"], "ingress", [*rights.answers, *cached]),
        (f"{name} replies", ["reply"], "ingress", [*rights.answers, *says]),
        (f"{role} subscribes", ["declare_subscriber"], "ingress", list(rights.hears)),
        (f"{role} hears", ["put", "delete"], "egress", list(rights.hears)),
        (f"{role} asks", ["query"], "ingress", [*rights.asks, *caches]),
        (f"{role} learns", ["reply"], "egress", [*rights.asks, *hears]),
        (f"{role} watches", watching, "ingress", [*rights.watches, *caches]),
        (f"{role} sees", ["liveliness_token"], "egress", [*rights.watches, *caches]),
    ]
    for ident, messages, flow, expressions in rows:
        if expressions:
            yield _rule(ident, messages, [flow], expressions)


def _rule(ident: str, messages: list[str], flows: list[str], expressions: Iterable[str]) -> Json:
    return {
        "id": ident,
        "permission": "allow",
        "flows": flows,
        "messages": messages,
        "key_exprs": list(dict.fromkeys(expressions)),
    }


def _history(expressions: Sequence[str]) -> list[str]:
    return [f"{expression}/{_HISTORY}" for expression in expressions]


def _with_history(expressions: Sequence[str]) -> list[str]:
    return [*expressions, *_history(expressions)]
