"""The errors of the protocol, one tree.

TrackmeshError
├── RefusedMessage      a message from outside that is wrong: reason (a counter's name) and one sentence
├── BusError            the network cannot be reached or used
│   ├── Unavailable     nobody answers a query
│   └── Incomplete      a service ended half-way through its answer
└── QueryFailed         a service answered a query with an error: code and one sentence
"""

from __future__ import annotations

_LONGEST = 299


class TrackmeshError(Exception):
    """Every error of trackmesh that a user may meet; ``str()`` is one clear sentence."""


class RefusedMessage(TrackmeshError, ValueError):
    """A message that is refused whole.

    Attributes:
        reason: short machine-readable reason, used as the name of a counter (``"not_finite"``).
        detail: one sentence for people, in one printable line of at most 300 characters.
    """

    def __init__(self, reason: str, detail: str) -> None:
        # The sentence may quote what came from outside, at any length.
        self.detail = _one_line(detail)
        self.reason = reason
        super().__init__(f"{self.detail} [{reason}]")


def _one_line(text: str) -> str:
    line = " ".join(text[:_LONGEST].split()).rstrip(".")
    return "".join(c if c.isprintable() else "?" for c in line) + "."


class BusError(TrackmeshError):
    """The bus cannot be reached or used."""


class Unavailable(BusError):
    """No service answered a query."""


class Incomplete(BusError):
    """A service ended half-way through its answer.

    Attributes:
        received: how many answers came before.
    """

    def __init__(self, sentence: str, received: int) -> None:
        super().__init__(sentence)
        self.received = received


class QueryFailed(TrackmeshError):
    """A service answered a query with an error.

    Attributes:
        code: short machine-readable code (``"too_large"``).
        detail: one sentence for people.
    """

    def __init__(self, code: str, detail: str) -> None:
        super().__init__(f"{detail} [{code}]")
        self.code = code
        self.detail = detail
