"""Key expressions, built and parsed here and nowhere else.

A key is ``{realm}/@v1/{family}/...``. The chunk ``@v1`` is verbatim: a wildcard never matches it, so that another
version of the protocol is never heard by accident.
"""

from __future__ import annotations

from dataclasses import dataclass

from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.messages.base import ID_PATTERN, ID_RE

VERSION = "@v1"
DEFAULT_REALM = "trackmesh"


@dataclass(frozen=True)
class Keys:
    """The keys of one realm; an id may be ``*`` where a key expression is wanted.

    Raises:
        TrackmeshError: the realm or an id is no single lower-case chunk.
    """

    realm: str = DEFAULT_REALM

    def __post_init__(self) -> None:
        if self.realm == "*":
            raise TrackmeshError("A realm is named, it cannot be '*'.")
        _chunk(self.realm, "realm")

    def plots(self, sensor_id: str) -> str:
        """Where a sensor publishes its plots."""
        return self._key("plots", sensor_id)

    def ranges(self, network_id: str) -> str:
        """Where a network of readers publishes its ranges."""
        return self._key("ranges", network_id)

    def sensor(self, sensor_id: str) -> str:
        """Where a sensor publishes, and answers, who it is."""
        return self._key("sensors", sensor_id)

    def tracks(self, unit_id: str) -> str:
        """Where a unit publishes its picture."""
        return self._key("tracks", unit_id)

    def refined(self, unit_id: str) -> str:
        """Where a unit publishes states of some plots ago, refined since."""
        return self._key("refined", unit_id)

    def tags(self, unit_id: str) -> str:
        """Where a tag service publishes its picture."""
        return self._key("tags", unit_id)

    def band(self, unit_id: str) -> str:
        """What a unit tells its neighbours about tracks near the border."""
        return self._key("band", unit_id)

    def registration(self, unit_id: str) -> str:
        """A unit's estimate of its sensors' biases."""
        return self._key("registration", unit_id)

    def service(self, service: str, unit_id: str) -> str:
        """Where a service (``tracks``, ``history``, ``emi``) answers queries."""
        return self._key("svc", service, unit_id)

    def live(self, kind: str, ident: str) -> str:
        """Liveliness token of a sensor or service."""
        return self._key("live", kind, ident)

    def asking(self, request_id: str) -> str:
        """Liveliness token of whoever waits for the answer to a long question; with it the question is given up."""
        return self._key("asking", request_id)

    def status(self, kind: str, ident: str) -> str:
        """Where a service publishes how it is."""
        return self._key("status", kind, ident)

    def truth(self, scenario_id: str) -> str:
        """Simulated truth."""
        return self._key("truth", scenario_id)

    def everything(self) -> str:
        """All keys of the realm, as a key expression."""
        return f"{self.realm}/{VERSION}/**"

    def _key(self, *chunks: str) -> str:
        return "/".join((self.realm, VERSION, *(_chunk(c, "id") for c in chunks)))


def last_chunk(key: str) -> str:
    """The id at the end of a key: the sensor of ``.../plots/north``."""
    return key.rsplit("/", 1)[-1]


def kind_and_id(key: str) -> tuple[str, str]:
    """The last two chunks of a liveliness or status key."""
    chunks = key.split("/")
    return chunks[-2], chunks[-1]


def parse_parameters(text: str) -> dict[str, str]:
    """The parameters of a selector: ``fmt=json;x=1`` as a dictionary."""
    pairs = (part.partition("=") for part in text.split(";") if part)
    return {name: value for name, _, value in pairs}


def matches(expression: str, key: str) -> bool:
    """Whether a key expression meets a key: ``*`` is one chunk, ``**`` any; neither meets an ``@`` chunk."""
    return _match(expression.split("/"), key.split("/"))


def _match(pattern: list[str], chunks: list[str]) -> bool:
    if not pattern:
        return not chunks
    head, rest = pattern[0], pattern[1:]
    if head == "**":
        return _match(rest, chunks) or (bool(chunks) and not chunks[0].startswith("@") and _match(pattern, chunks[1:]))
    if not chunks or not (head == chunks[0] or (head == "*" and not chunks[0].startswith("@"))):
        return False
    return _match(rest, chunks[1:])


def _chunk(text: str, what: str) -> str:
    if text != "*" and not ID_RE.fullmatch(text):
        raise TrackmeshError(f"The {what} {text!r} must match {ID_PATTERN}.")
    return text
