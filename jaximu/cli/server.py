"""A page for the user of this machine alone: on the loopback address, behind a token that cannot be guessed."""

from __future__ import annotations

import json
import os
import secrets
import sys
import threading
import webbrowser
from collections.abc import Callable, Iterator
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from socketserver import ThreadingTCPServer
from typing import TYPE_CHECKING

from jaximu.cli.messages import say
from jaximu.ground.errors import InputError

if TYPE_CHECKING:
    from jaximu.report.guide import LivePage


_HOST = "127.0.0.1"
_WAIT = 1.0  # s after which a browser that waits for a change is sent what there is, or a sign of life
_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; connect-src 'self'; style-src 'unsafe-inline'; img-src data:; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",  # the address holds the token
    "X-Content-Type-Options": "nosniff",
}


class PageServer(ThreadingTCPServer):
    """Serves one page to browsers of this machine, from entering a `with` to its end.

    **Arguments:** `page`: of which one thread at a time asks for something; `port`: 0 for any that is free.

    A request is answered if its address holds the token, its Host is this server (no other site's name leads here), and
    it is a GET. `events` gives the parts of the page, and those that changed whenever `changed` is called. A browser
    that leaves is forgotten. Raises `InputError` where the port cannot be used.
    """

    allow_reuse_address = os.name == "posix"  # on Windows it would let two servers share a port
    daemon_threads = True

    def __init__(self, page: LivePage, port: int = 0) -> None:
        self._page, self._drawing, self._news = page, threading.Lock(), threading.Condition()
        self._version, self._following, self._over = 0, 0, False
        if not 0 <= port < 1 << 16:
            raise InputError(f"--page-port {port}: ports are numbers from 1 to 65535.")
        try:
            super().__init__((_HOST, port), _Request)
        except OSError as error:
            raise InputError(
                f"--page-port {port} cannot be used ({error.strerror}): name another port, or leave the option out."
            ) from error
        port, token = self.server_address[1], secrets.token_urlsafe()
        self.hosts = (f"{_HOST}:{port}", f"localhost:{port}")
        self.root = f"/{token}/"
        self.address = f"http://{_HOST}:{port}{self.root}"

    def changed(self) -> None:
        """Have browsers shown what has changed."""
        with self._news:
            self._version += 1
            self._news.notify_all()

    def content(self, name: str) -> tuple[str, str] | None:
        """Return the type and content of a file of the page, None where there is none of this name."""
        if name == "guide.js":
            return "text/javascript", self._page.script
        with self._drawing:
            return None if name else ("text/html", self._page.html())

    def follow(self) -> Iterator[dict[str, str]]:
        """Yield the parts that changed, at least every second; end with the server."""
        with self._news:
            self._following += 1
        try:
            shown: dict[str, str] = {}
            over = False
            while not over:
                with self._news:
                    version, over = self._version, self._over
                with self._drawing:
                    parts = self._page.parts()
                yield {name: text for name, text in parts.items() if shown.get(name) != text}
                shown = parts
                self._wait(lambda known=version: self._over or self._version != known)
        finally:
            with self._news:
                self._following -= 1
                self._news.notify_all()

    def _wait(self, until: Callable[[], bool]) -> None:
        with self._news:
            self._news.wait_for(until, _WAIT)

    def handle_error(self, request: object, client_address: object) -> None:
        """Forget a browser that left; anything else costs the page, not the recording."""
        error = sys.exception()
        if not isinstance(error, OSError):
            say(f"note: the page could not be shown ({type(error).__name__}: {error}). Please report this.")

    def __enter__(self) -> PageServer:
        threading.Thread(target=self.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        with self._news:
            self._over = True
            self._news.notify_all()
        self._wait(lambda: not self._following)
        self.shutdown()
        self.server_close()


class _Request(BaseHTTPRequestHandler):
    server: PageServer
    timeout = 5.0  # s in which a browser must ask, and take what it is sent

    def do_GET(self) -> None:
        """Answer, or refuse."""
        server, root = self.server, self.server.root.encode()
        path = self.path.encode("latin-1", "replace")
        if self.headers.get_all("Host") not in [[host] for host in server.hosts]:
            self.send_error(HTTPStatus.FORBIDDEN)
            return
        name = path[len(root) :].decode("latin-1")
        if not secrets.compare_digest(path[: len(root)], root):
            self.send_error(HTTPStatus.NOT_FOUND)
        elif name == "events":
            self._send(HTTPStatus.OK, "text/event-stream", "")
            for parts in server.follow():
                self.wfile.write(f"data: {json.dumps(parts)}\n\n".encode() if parts else b": waiting\n\n")
            self.wfile.write(b"event: end\ndata:\n\n")
        elif content := server.content(name):
            self._send(HTTPStatus.OK, *content)
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Refuse in one word; a method that there is not is one that is not allowed."""
        code = HTTPStatus.METHOD_NOT_ALLOWED if code == HTTPStatus.NOT_IMPLEMENTED else code
        self._send(code, "text/plain", HTTPStatus(code).phrase)

    def _send(self, status: int, kind: str, text: str) -> None:
        content = text.encode()
        self.send_response(status)
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        self.send_header("Content-Type", f"{kind}; charset=utf-8")
        if content:
            self.send_header("Content-Length", str(len(content)))
        if status == HTTPStatus.METHOD_NOT_ALLOWED:
            self.send_header("Allow", "GET")
        self.end_headers()
        self.wfile.write(content)

    def version_string(self) -> str:
        """Keep to ourselves which Python this is."""
        return "jaximu"

    def log_message(self, *_: object) -> None:
        """Leave the terminal to the recording."""


def open_in_browser(address: str) -> threading.Thread | None:
    """Have the user's browser open an address, where there is a screen: one in the terminal would be in the way.

    **Returns:** the thread that waits for it, as it may take seconds.
    """
    if sys.platform in ("win32", "darwin") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        opening = threading.Thread(target=webbrowser.open, args=(address,), daemon=True)
        opening.start()
        return opening
    return None
