"""Who may open the terminal UI in a browser: whoever knows the token, from a page of this very server.

Loopback alone guards nothing: every user of the machine reaches it, and so does any web page that a browser on it
shows, by a request of its own (the Origin tells) or by a name that it has made to point at 127.0.0.1 (the Host tells;
"DNS rebinding"). All three are checked for every request, files included. Pure.
"""

import hmac
import secrets
from collections.abc import Mapping

from appliance.errors import ConfigError

SHORTEST = 16
"""Characters of a token that somebody gives: 128 bits if it is drawn well."""


def make_token() -> str:
    """Return a token that cannot be guessed: 256 bits."""
    return secrets.token_urlsafe(32)


class Guard:
    """The door of one server.

    Args:
        token: what must be known.
        port: where it listens.

    Raises:
        ConfigError: the token is too short, or has characters that no cookie carries.
    """

    def __init__(self, token: str, port: int) -> None:
        if len(token) < SHORTEST or not token.isascii() or not token.replace("-", "").replace("_", "").isalnum():
            raise ConfigError(
                "the token of the browser version is too short or has other characters than letters, digits, - and _",
                remedy=f"give at least {SHORTEST} of them, or none: then one is made",
            )
        self._token = token.encode()
        self.cookie = f"swiftbot-{port}"
        """Name of the cookie; it has the port, since browsers share cookies between the ports of a host."""
        self.hosts = frozenset({f"127.0.0.1:{port}", f"localhost:{port}", f"[::1]:{port}"})
        self.refused: dict[str, int] = {}
        """Requests that were turned away, by reason."""

    def knows(self, given: str | None) -> bool:
        """Whether that is the token; takes as long for a wrong one."""
        return given is not None and hmac.compare_digest(given.encode(errors="replace"), self._token)

    def refusal(self, headers: Mapping[str, str], *, given: str | None, socket: bool) -> str:
        """Return why a request is turned away, empty when it is let in.

        Args:
            headers: its headers, by any case.
            given: the token it carries, in its cookie or its address.
            socket: whether it opens a WebSocket, which must tell where it comes from.
        """
        found = self._refusal({name.lower(): value for name, value in headers.items()}, given, socket=socket)
        if found:
            self.refused[found] = self.refused.get(found, 0) + 1
        return found

    def _refusal(self, headers: Mapping[str, str], given: str | None, *, socket: bool) -> str:
        host = headers.get("host", "").lower()
        if host not in self.hosts:
            return "it was not asked for by this machine's own name"
        origin = headers.get("origin")
        if origin is None:
            if socket:
                return "it does not tell which page it comes from"
        elif origin.lower() != f"http://{host}":
            return "it comes from another page"
        if headers.get("sec-fetch-site", "same-origin") not in ("same-origin", "none"):
            # The first opening is typed or clicked in a terminal ("none"); all else is asked for by our own page.
            return "it comes from another page"
        return "" if self.knows(given) else "it does not know the token"
