"""A page of this machine alone: who is answered, who is refused, and browsers that leave."""

import http.client
import json
import socket
import threading
from urllib.parse import urlsplit

import pytest

from jaximu.cli import server as page_server
from jaximu.cli.server import PageServer, open_in_browser
from jaximu.ground.errors import InputError


class Counter:
    """A page of one number and one text that stays."""

    script = "let counted;"

    def __init__(self):
        self.count = 0

    def html(self):
        return f"<p>±{self.count}</p>"

    def parts(self):
        return {"count": str(self.count), "title": "counter"}


@pytest.fixture
def page():
    return Counter()


@pytest.fixture
def server(page):
    with PageServer(page) as running:
        yield running


def ask(server, path=None, method="GET", hosts=None):
    """Ask for a path below the port; return the response and its content."""
    address = urlsplit(server.address)
    connection = http.client.HTTPConnection("127.0.0.1", address.port, timeout=5)
    connection.putrequest(method, address.path if path is None else path, skip_host=True)
    for host in [address.netloc] if hosts is None else hosts:
        connection.putheader("Host", host)
    connection.endheaders()
    response = connection.getresponse()
    content = response.read()
    connection.close()
    return response, content.decode()


def raw(server, request):
    """Send bytes and return all that comes back."""
    with socket.create_connection(server.server_address, timeout=5) as connection:
        connection.sendall(request)
        return b"".join(iter(lambda: connection.recv(1 << 16), b""))


def test_the_page_is_given_to_who_has_its_address(server, page):
    page.count = 7
    response, content = ask(server)
    assert (response.status, content) == (200, "<p>±7</p>")
    headers = {name.lower(): value for name, value in response.getheaders()}
    assert headers["content-type"] == "text/html; charset=utf-8" and headers["cache-control"] == "no-store"
    policy = dict(part.split(" ", 1) for part in headers["content-security-policy"].split("; "))
    assert policy["default-src"] == policy["frame-ancestors"] == "'none'" and policy["script-src"] == "'self'"
    assert "access-control-allow-origin" not in headers and headers["referrer-policy"] == "no-referrer"
    assert headers["server"] == "jaximu"  # which Python it is concerns nobody
    script, content = ask(server, urlsplit(server.address).path + "guide.js")
    assert script.status == 200 and content == page.script
    by_name, _ = ask(server, hosts=[f"localhost:{server.server_address[1]}"])
    assert by_name.status == 200


def test_it_listens_on_the_loopback_address_alone_and_its_token_is_long_and_new(server, page):
    assert server.server_address[0] == "127.0.0.1"
    with PageServer(page) as other:
        tokens = {urlsplit(running.address).path for running in (server, other)}
    assert len(tokens) == 2 and min(map(len, tokens)) > 40


@pytest.mark.parametrize("path", ["/", "/x/", "/favicon.ico", "/%00", "/ä", "/../", "//", "*", "events"])
def test_without_the_token_there_is_nothing(server, path):
    request = f"GET {path} HTTP/1.1\r\nHost: {server.hosts[0]}\r\n\r\n"
    assert raw(server, request.encode()).split()[1] == b"404"


def test_a_token_that_is_nearly_right_is_wrong(server):
    root = urlsplit(server.address).path
    for path in (root[:-2] + "/", root.swapcase(), root + "x", root + "events/", root + "../", root.rstrip("/")):
        response, content = ask(server, path)
        assert response.status == 404 and content == "Not Found"


@pytest.mark.parametrize(
    "hosts",
    [["evil.example"], ["127.0.0.1"], ["127.0.0.1:1"], ["localhost"], [], ["0.0.0.0:{port}"], ["{port}.evil.example"],
     ["127.0.0.1:{port}", "evil.example"], ["127.0.0.1:{port}.evil.example"]],
)  # fmt: skip
def test_another_name_for_this_machine_is_refused(server, hosts):
    port = server.server_address[1]
    response, content = ask(server, hosts=[host.format(port=port) for host in hosts])
    assert response.status == 403 and content == "Forbidden"


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "HEAD", "PATCH", "TRACE", "NONSENSE"])
def test_nothing_can_be_sent(server, method):
    response, _ = ask(server, method=method)
    assert response.status == 405 and response.getheader("Allow") == "GET"
    assert response.getheader("Access-Control-Allow-Origin") is None


@pytest.mark.parametrize(
    ("sent", "words"),
    [(b"\r\n", b""), (b"GET\r\n", b"Bad Request"), (b"GET / HTTP/9.9\r\n\r\n", b"HTTP Version Not Supported"),
     (b"\x16\x03\x01\x02\r\n\r\n", b"Bad Request"), (b"GET /" + b"a" * 70000 + b" HTTP/1.1\r\n\r\n", b"Too Long")],
)  # fmt: skip
def test_what_is_no_request_is_refused_and_the_next_is_answered(server, sent, words, capsys):
    assert raw(server, sent).endswith(words)
    assert ask(server)[0].status == 200
    assert capsys.readouterr().err == ""


def follow(server):
    """Open the stream of events; return the connection and its lines."""
    connection = socket.create_connection(server.server_address, timeout=5)
    path = urlsplit(server.address).path
    connection.sendall(f"GET {path}events HTTP/1.1\r\nHost: {server.hosts[0]}\r\n\r\n".encode())
    stream = connection.makefile("rb")
    assert b"200" in stream.readline()
    headers = list(iter(stream.readline, b"\r\n"))
    assert b"Content-Type: text/event-stream; charset=utf-8\r\n" in headers
    return connection, stream


def data(stream):
    """Return the next parts, passing over signs of life."""
    line = next(line for line in stream if line.startswith(b"data: "))
    return json.loads(line[6:])


def test_what_changes_is_sent_and_the_end_is_said(page):
    with PageServer(page) as server:
        connection, stream = follow(server)
        with connection, stream:
            assert data(stream) == {"count": "0", "title": "counter"}
            page.count = 1
            server.changed()
            assert data(stream) == {"count": "1"}
            server.changed()
            page.count = 2
            late = threading.Timer(0.3, lambda: (setattr(page, "count", 3), server.__exit__()))
            late.start()
            rest = stream.read().decode()
            late.join()
    assert '{"count": "3"}' in rest and rest.endswith("event: end\ndata:\n\n")


def test_a_browser_that_leaves_in_the_middle_is_forgotten(server, page, capsys):
    for _ in range(3):
        connection, stream = follow(server)
        data(stream)
        stream.close()
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")  # closes with a reset
        connection.close()
    with socket.create_connection(server.server_address) as half:
        half.sendall(b"GET /")  # and one that does not finish its question
        for page.count in range(1, 50):
            server.changed()
        staying, stream = follow(server)
        with staying, stream:
            assert data(stream)["count"] == "49"
    assert ask(server)[0].status == 200
    assert capsys.readouterr().err == ""


def test_a_page_that_fails_costs_itself_alone(server, page, capsys):
    page.html = lambda: 1 / 0
    with pytest.raises(http.client.RemoteDisconnected):
        ask(server)
    assert capsys.readouterr().err.startswith("note: the page could not be shown (ZeroDivisionError")
    del page.html
    assert ask(server)[0].status == 200


def test_a_port_that_cannot_be_used(server, page):
    taken = server.server_address[1]
    with pytest.raises(InputError, match=rf"page_port={taken} cannot be used \(.+\): name another port"):
        PageServer(page, taken)
    for port in (-1, 65536):
        with pytest.raises(InputError, match="ports are numbers from 1 to 65535"):
            PageServer(page, port)


def test_a_browser_is_opened_where_there_is_a_screen(monkeypatch):
    opened = []
    monkeypatch.setattr(page_server.webbrowser, "open", opened.append)
    monkeypatch.setattr(page_server.sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert open_in_browser("http://127.0.0.1:1/") is None
    monkeypatch.setenv("DISPLAY", ":0")
    open_in_browser("http://127.0.0.1:2/").join()
    assert opened == ["http://127.0.0.1:2/"]
