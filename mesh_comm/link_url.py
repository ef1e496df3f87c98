"""The URLs of mesh links: who is spoken to, on which port and network interface."""

from __future__ import annotations

from dataclasses import dataclass
from urllib.parse import parse_qsl, unquote, urlsplit

from imagine.core.errors import InputError

FORMS = (
    "udpout://HOST:PORT (a radio modem), udpbcast://ADDRESS:PORT (broadcast or multicast) or "
    "udppeers://HOST:PORT,HOST:PORT,... (each by name), all with ?interface=NAME where it matters"
)
MOST_PEERS = 64


@dataclass(frozen=True)
class LinkUrl:
    """A link's URL, taken apart. `targets` are host and port; `listen` is the own port, None for any."""

    text: str
    scheme: str
    targets: tuple[tuple[str, int], ...]
    interface: str | None = None
    listen: int | None = None


def parse_link_url(text: str) -> LinkUrl:
    """Return the parts of a link's URL. Raises InputError that names the URL, what is wrong, and the valid forms."""
    scheme, separator, rest = text.partition("://")
    if not separator or scheme not in ("udpout", "udpbcast", "udppeers"):
        raise InputError(f"{text}: a mesh link is {FORMS}")
    places, _, query = rest.partition("?")
    options = _parse_options(text, scheme, query)
    hosts = places.split(",")
    if len(hosts) > (MOST_PEERS if scheme == "udppeers" else 1):
        raise InputError(f"{text}: names {len(hosts)} hosts; udppeers:// takes {MOST_PEERS}, the others one")
    targets = tuple(parse_udp_url(f"{scheme}://{host}", scheme, text) for host in hosts)
    listen = _parse_port(text, options["listen"]) if "listen" in options else None
    if scheme != "udpout" and listen is None:
        listen = targets[0][1]
    named = {host.partition("%")[2] for host, _ in targets} | {options.get("interface", "")}  # an address may name it
    named.discard("")
    if len(named) > 1:
        raise InputError(f"{text}: names several interfaces: {', '.join(sorted(named))}")
    targets = tuple((host.partition("%")[0], port) for host, port in targets)
    return LinkUrl(text, scheme, targets, next(iter(named), None), listen)


def parse_udp_url(url: str, scheme: str, named: str | None = None) -> tuple[str, int]:
    """Return host and port of `scheme://host:port`; an IPv6 address stands in brackets.

    Raises InputError naming the URL, or `named`, of which it may be a part.
    """
    named = named or url
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError as error:
        raise InputError(f"{named}: {error}; expected {scheme}://host:port") from error
    if parts.scheme != scheme or not host or not port or parts.path or parts.query or parts.fragment or parts.username:
        raise InputError(f"{named}: expected {scheme}://host:port with a port of 1 to 65535")
    return unquote(host), port  # a zone is written %25 in a URL (RFC 6874)


def _parse_options(text: str, scheme: str, query: str) -> dict[str, str]:
    known = ("interface", "listen") if scheme == "udppeers" else ("interface",)
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=True, max_num_fields=8) if query else []
    except ValueError as error:
        raise InputError(f"{text}: its options are not name=value&name=value") from error
    options = dict(pairs)
    for name, value in pairs:
        if name not in known or not value or len(options) < len(pairs):
            raise InputError(f"{text}: option '{name}': expected each of {', '.join(known)} at most once, with a value")
    return options


def _parse_port(text: str, value: str) -> int:
    if not (value.isascii() and value.isdigit() and 0 < int(value[:6]) <= 65535):
        raise InputError(f"{text}: listen={value[:20]}: expected a port of 1 to 65535")
    return int(value)
