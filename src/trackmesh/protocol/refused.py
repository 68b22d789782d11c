"""Why a router does not let a client in: the library says nothing but that it could not connect."""

from __future__ import annotations

import socket
import ssl

from trackmesh.protocol.credentials import Credentials

_TRY_S = 1.0

_OURS = {
    "CERTIFICATE_REQUIRED": "it asks for a certificate",
    "UNKNOWN_CA": "our certificate is of an authority that it does not know",
    "CERTIFICATE_UNKNOWN": "it does not accept our certificate",
    "BAD_CERTIFICATE": "it does not accept our certificate",
    "DECRYPT_ERROR": "our certificate is of an authority that it does not know",
    "CERTIFICATE_EXPIRED": "our certificate has ended",
}


def why_refused(endpoint: str, credentials: Credentials) -> str:
    """What a plain connection to a router tells, as the rest of a sentence; empty if nobody is there, or it is well.

    Args:
        endpoint: ``tls/host:port`` or ``tcp/host:port``; of others nothing is known.
        credentials: the client's.
    """
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.partition("#")[0].partition("?")[0].rpartition(":")
    if protocol not in {"tcp", "tls"} or not port.isdigit():
        return ""
    host = host.strip("[]")
    try:
        with socket.create_connection((host, int(port)), _TRY_S) as plain:
            if protocol == "tcp":
                return "it may want tls/, or a user and password"
            return _handshake(plain, host, credentials)
    except OSError:
        return ""


def _handshake(plain: socket.socket, host: str, credentials: Credentials) -> str:
    if credentials.ca is None:
        return "for tls/ a ca must be set"
    try:
        context = ssl.create_default_context(cafile=str(credentials.ca))
        # As the library does; a later Python looks more closely.
        context.verify_flags &= ~ssl.VERIFY_X509_STRICT
        if credentials.certificate is not None and credentials.key is not None:
            context.load_cert_chain(credentials.certificate, credentials.key)
    except ssl.SSLError as error:
        return f"our own files cannot be used ({error.reason or error})"
    try:
        with context.wrap_socket(plain, server_hostname=host) as sealed:
            # What a router thinks of our certificate comes only after the handshake.
            sealed.recv(1)
    except ssl.SSLCertVerificationError as error:
        return f"its certificate does not convince us ({error.verify_message.rstrip('.')})"
    except ssl.SSLError as error:
        return _alert(error.reason or "")
    return ""


def _alert(reason: str) -> str:
    if reason in {"WRONG_VERSION_NUMBER", "RECORD_LAYER_FAILURE", "UNEXPECTED_EOF_WHILE_READING"}:
        return "it does not speak TLS"
    for name, sentence in _OURS.items():
        if reason.endswith(name):
            return sentence
    return f"TLS fails ({reason or 'no reason given'})"
