"""The viewer's page and WebSocket answer who was given its address, and nobody else."""

from __future__ import annotations

import http.client
import socket
from urllib.parse import urlsplit

import pytest

from svu_mi.errors import SvuEnvironmentError
from svu_mi.output.viewer.access_control import Guard, is_closed, serve, stop

pytest.importorskip("viser")
client = pytest.importorskip("websockets.sync.client")
FORBIDDEN, OK, SWITCHING = 403, 200, 101


@pytest.fixture(scope="module")
def address():
    server, url = serve(0)
    server.scene.add_icosphere("/secret", 1.0)
    yield urlsplit(url)
    stop(server)


def fetched(address, path, host=None, origin=None):
    """Status, headers and content of a page."""
    headers = {"Host": host or address.netloc} | ({"Origin": origin} if origin else {})
    connection = http.client.HTTPConnection(address.hostname, address.port, timeout=10)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    status, content = answer.status, answer.read()
    connection.close()
    return status, dict(answer.getheaders()), content


def connected(address, path, host=None, origin=None):
    """Status of a WebSocket's handshake; 101 only if the server then sends its scene."""
    import viser
    from websockets.exceptions import InvalidStatus

    line = socket.create_connection((address.hostname, address.port))  # whatever host says
    try:
        with client.connect(
            f"ws://{host or address.netloc}{path}", sock=line, origin=origin, compression=None,
            subprotocols=[f"viser-v{viser.__version__}"],
        ) as connection:  # fmt: skip
            assert connection.recv(10)
    except InvalidStatus as error:
        return error.response.status_code
    return SWITCHING


def test_the_printed_address_works_for_page_and_websocket(address):
    status, headers, content = fetched(address, address.path)
    assert status == OK and b"<html" in content
    assert headers["Referrer-Policy"] == "no-referrer"
    own = f"http://{address.netloc}"
    # viser's page asks for its own address without query and last slash.
    assert connected(address, address.path.rstrip("/"), origin=own) == SWITCHING
    assert connected(address, address.path, origin=own) == SWITCHING
    assert connected(address, address.path) == SWITCHING  # a program, which has no origin


def test_another_port_through_ssh_works(address):
    status, _, _ = fetched(address, address.path, host="localhost:9999")
    assert status == OK
    host = "localhost:9999"
    assert connected(address, address.path, host=host, origin=f"http://{host}") == SWITCHING


WRONG_PATHS = ("/", "", "/index.html", "/?token={secret}", "/x{secret}/", "/{secret}x/",
               "/{short}/", "//{secret}/", "/index.html/../{secret}/", "/%FF/")  # fmt: skip


@pytest.mark.parametrize("path", WRONG_PATHS)
def test_without_the_secret_nothing_is_answered(address, path):
    secret = address.path.strip("/")
    path = path.format(secret=secret, short=secret[:-1])
    status, _, content = fetched(address, path or "/")
    assert status == FORBIDDEN and b"<html" not in content and secret.encode() not in content
    assert connected(address, path, origin=f"http://{address.netloc}") == FORBIDDEN


ORIGINS = ("http://evil.example", "https://{here}", "http://{here}.evil.example", "null",
           "http://127.0.0.1:1", "http://localhost:{port}", "file://")  # fmt: skip


@pytest.mark.parametrize("origin", ORIGINS)
def test_other_pages_are_refused_even_with_the_secret(address, origin):
    origin = origin.format(here=address.netloc, port=address.port)
    assert connected(address, address.path, origin=origin) == FORBIDDEN
    assert fetched(address, address.path, origin=origin)[0] == FORBIDDEN


HOSTS = ("evil.example", "evil.example:{port}", "127.0.0.1.evil.example:{port}",
         "localhost.evil.example", "0.0.0.0:{port}", "user@127.0.0.1:{port}")  # fmt: skip


@pytest.mark.parametrize("host", HOSTS)
def test_a_name_that_was_rebound_is_refused(address, host):
    """The page of evil.example:8080, whose name now means 127.0.0.1, has that very origin."""
    host = host.format(port=address.port)
    assert fetched(address, address.path, host=host)[0] == FORBIDDEN
    if "@" not in host:  # the client takes that for a login
        where = {"host": host, "origin": f"http://{host}"}
        assert connected(address, address.path, **where) == FORBIDDEN


@pytest.mark.parametrize("hosts", [[], ["127.0.0.1", "127.0.0.1"], ["127.0.0.1:x"], [""]])
def test_a_malformed_host_is_refused(hosts):
    guard = Guard()
    assert guard.allows(f"/{guard.secret}/", ["127.0.0.1:8080"], [])
    assert not guard.allows(f"/{guard.secret}/", hosts, [])
    assert guard.secret != Guard().secret and len(guard.secret) >= 32
    assert guard.secret not in repr(guard)


def test_one_good_origin_among_several_is_refused():
    guard, good = Guard(), "http://127.0.0.1:8080"
    for origins in ([good, "http://evil.example"], ["http://evil.example", good]):
        assert not guard.allows(f"/{guard.secret}/", ["127.0.0.1:8080"], origins)
    assert guard.allows(f"/{guard.secret}/", ["127.0.0.1:8080"], [good, good])


def test_a_server_that_cannot_be_guarded_is_not_left_open(monkeypatch):
    """If a viser of the future starts its server in another way, ``svu view`` must say so."""
    import viser

    ports = []
    start = viser.ViserServer.__init__

    def watched(self, *words, **options):
        start(self, *words, **options)
        ports.append(self.get_port())
        assert not is_closed(ports[0])

    monkeypatch.setattr(viser.ViserServer, "__init__", watched)
    monkeypatch.setattr(Guard, "process_request", lambda _, then: then)
    with pytest.raises(SvuEnvironmentError, match="cannot be protected"):
        serve(0)
    with pytest.raises(ConnectionRefusedError):
        http.client.HTTPConnection("127.0.0.1", ports[0], timeout=5).request("GET", "/")


@pytest.mark.slow
def test_websockets_is_left_as_it_was():
    from websockets.asyncio import server

    before = server.serve
    with Guard().installed():
        assert server.serve is not before
    assert server.serve is before
