# SPDX-License-Identifier: Apache-2.0
"""Serve the page of ``lab``: one page drives, and the wheels stop when it becomes silent."""

import asyncio
import concurrent.futures
import json
import math
import os
import re
import secrets
import threading
import time
import webbrowser
from collections.abc import Awaitable, Callable
from typing import Any

from aiohttp import WSMsgType, web

from smp_motor_control.errors import SmpError
from smp_motor_ident.cli import lab_designs
from smp_motor_ident.cli.laboratory import Laboratory
from smp_motor_ident.cli.processes import ProcessError
from smp_motor_ident.errors import ParameterError
from smp_motor_ident.report import templates

MAX_QUEUED = 60  # waiting messages beyond which a slow page misses samples
MAX_MESSAGE = 10_000  # length of a request [bytes]
WATCH_PERIOD_S = 0.03  # period of checking the page that drives
SILENCE_S = 0.3  # silence of that page after which the wheels stop
TAKEOVER_AFTER_S = 2.0  # silence after which another page may take over
HEADERS = {"Referrer-Policy": "no-referrer", "Cache-Control": "no-store"}
POLICY = (
    "default-src 'none'; script-src 'nonce-{0}'; style-src 'nonce-{0}'; connect-src 'self'; "
    "worker-src blob:; frame-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)
REPORT_POLICY = "sandbox allow-scripts; frame-ancestors 'self'"  # no access to this server


class Page:
    """One connected page and its queue of messages."""

    def __init__(self, socket: web.WebSocketResponse) -> None:
        self.socket = socket
        self.queue: asyncio.Queue[str | bytes] = asyncio.Queue()
        self.heard_at = time.monotonic()

    async def write(self) -> None:
        """Send the queued messages."""
        while True:
            message = await self.queue.get()
            if isinstance(message, bytes):
                await self.socket.send_bytes(message)
            else:
                await self.socket.send_str(message)


class Server:
    """The server, in a thread of its own, for a ``with`` block."""

    def __init__(self, laboratory: Laboratory, host: str, port: int, browse: bool) -> None:
        self._laboratory, self._host, self._port, self._browse = laboratory, host, port, browse
        self._pages: list[Page] = []
        self._driver: Page | None = None
        self._session, self._token = secrets.token_urlsafe(32), ""
        self._base = (
            f"/{secrets.token_urlsafe(9)}"  # keeps the cookie from other servers of this host
        )
        self._last: dict[str, str] = {}  # the newest message of each kind, for pages that join
        self._loop = asyncio.new_event_loop()
        self._ended = asyncio.Event()

    def __enter__(self) -> "Server":
        """Start, and print the address."""
        ready: concurrent.futures.Future[None] = concurrent.futures.Future()
        run = self._serve(ready)
        self._thread = threading.Thread(
            target=self._loop.run_until_complete, args=(run,), daemon=True
        )
        self._thread.start()
        ready.result()
        self._laboratory.send = self._send
        if not _is_loopback(self._host):
            print(
                f"WARNING: served on {self._host}, not encrypted: anyone with the address below, "
                "with this machine's network address in it, can drive the robot",
                flush=True,
            )
        self._print_address()
        if self._browse and (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            webbrowser.open(self._address())
        return self

    def __exit__(self, *_: object) -> None:
        """Close all pages."""
        self._loop.call_soon_threadsafe(self._ended.set)
        self._thread.join(5.0)

    async def _serve(self, ready: "concurrent.futures.Future[None]") -> None:
        app = web.Application(middlewares=[self._authorise])
        app.add_routes([
            web.get(f"{self._base}/", self._page), web.get(f"{self._base}/ws", self._on_connection),
            web.get(f"{self._base}/results/{{name:.+}}", self._result),
        ])  # fmt: skip
        runner = web.AppRunner(app, access_log=None, shutdown_timeout=1.0)
        await runner.setup()
        try:
            site = web.TCPSite(runner, self._host, self._port)
            await site.start()
            self._port = runner.addresses[0][1]
            ready.set_result(None)
            await self._watch()
        except (OSError, OverflowError) as error:
            where = f"{self._host}:{self._port}"
            ready.set_exception(ProcessError(f"{where}: {error}; choose another --port"))
        finally:
            for page in list(self._pages):
                await page.socket.close(code=1001, message=b"lab ended")
            await runner.cleanup()

    async def _watch(self) -> None:
        """Stop the wheels when the page that drives becomes silent."""
        link, before, late = self._laboratory.link, time.monotonic(), False
        while not self._ended.is_set():
            await asyncio.sleep(WATCH_PERIOD_S)
            now, driver = time.monotonic(), self._driver
            late, before = not late and now - before > SILENCE_S / 2, now
            # After a pause of this process, messages of the page may still be unread.
            if link.armed and not late and (driver is None or now - driver.heard_at > SILENCE_S):
                link.halt(f"the page was not heard for {SILENCE_S:g} s")
            link.watched_at = now

    def _address(self) -> str:
        host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(self._host, self._host)
        return f"http://{f'[{host}]' if ':' in host else host}:{self._port}/?token={self._token}"

    def _print_address(self) -> None:
        """Print the address of one more page; its token is good for one use."""
        self._token = secrets.token_urlsafe(16)
        print(f"lab: open {self._address()}", flush=True)

    def _is_own_host(self, host: str) -> bool:
        """Return whether a Host header names this server; rejects DNS rebinding."""
        name, _, port = host.rpartition(":")
        address = not _is_loopback(self._host) and re.fullmatch(r"[\d.]+|\[[\da-f:]+\]", name)
        known = name in {self._host, "localhost", "127.0.0.1", "[::1]"}
        return port == str(self._port) and (known or bool(address))

    @web.middleware
    async def _authorise(
        self, request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
    ) -> web.StreamResponse:
        """Reject requests without the host, cookie and, for the stream, origin of this server."""
        if not self._is_own_host(request.host):
            raise web.HTTPForbidden(
                text="lab: unknown host name; open the address that lab printed\n"
            )
        token = request.query.get("token")
        if request.path == "/" and token is not None:
            if not secrets.compare_digest(token.encode(), self._token.encode()):
                raise web.HTTPForbidden(
                    text="lab: invalid or used token; open the last address printed\n"
                )
            self._print_address()
            answer = web.HTTPFound(f"{self._base}/", headers=HEADERS)
            cookie = "lab", self._session
            answer.set_cookie(*cookie, path=self._base, httponly=True, samesite="Strict")
            raise answer
        known = request.cookies.get("lab", "")
        if not secrets.compare_digest(known.encode(), self._session.encode()):
            raise web.HTTPForbidden(text="lab: open the address that lab printed, with its token\n")
        if (
            request.path.endswith("/ws")
            and request.headers.get("Origin") != f"http://{request.host}"
        ):
            raise web.HTTPForbidden(text="lab: rejected a connection from another origin\n")
        return await handler(request)

    async def _page(self, request: web.Request) -> web.Response:
        nonce = secrets.token_urlsafe(16)
        headers = {**HEADERS, "Content-Security-Policy": POLICY.format(nonce)}
        text = templates.lab_page(nonce, self._laboratory.state["wheels"])
        return web.Response(text=text, content_type="text/html", headers=headers)

    async def _result(self, request: web.Request) -> web.StreamResponse:
        """Serve the report, or the parameter file."""
        state, name = self._laboratory.state, request.match_info["name"]
        if name not in (
            f"{state['identified']}/report.html",
            (state["designed"] or {}).get("name"),
        ):
            raise web.HTTPNotFound(text="lab: no such result\n")
        headers = {**HEADERS, "Content-Security-Policy": REPORT_POLICY}
        return web.FileResponse(self._laboratory.folder / name, headers=headers)

    async def _on_connection(self, request: web.Request) -> web.WebSocketResponse:
        socket = web.WebSocketResponse(heartbeat=5.0, max_msg_size=MAX_MESSAGE, compress=False)
        await socket.prepare(request)
        page, candidates = Page(socket), self._laboratory.candidates
        self._pages.append(page)
        if self._pages[1:]:
            self._laboratory.link.halt("another page was opened")
        self._driver = self._driver or page
        shown = {"ms": None, "asked": 0}
        made = [templates.encode(["design", {**one, **shown}]) for one in candidates.values()]
        for last in [*self._last.values(), *made]:
            page.queue.put_nowait(last)
        self._send_roles()
        tasks = {asyncio.ensure_future(page.write())}
        try:
            async for message in socket:
                if message.type is WSMsgType.TEXT:  # a stop must not wait
                    tasks.add(task := asyncio.ensure_future(self._on_message(page, message.data)))
                    task.add_done_callback(tasks.discard)
        finally:
            for task in list(tasks):
                task.cancel()
            self._pages.remove(page)
            if page is self._driver:
                self._driver = None
                self._laboratory.link.halt("the page that drove was closed")
            self._send_roles()
        return socket

    def _send_roles(self) -> None:
        for page in self._pages:
            role = {"drives": page is self._driver, "pages": len(self._pages)}
            page.queue.put_nowait(templates.encode(["role", role]))

    async def _on_message(self, page: Page, text: str) -> None:
        """Perform the request of a page, or answer with the reason of its refusal."""
        page.heard_at = time.monotonic()
        try:
            await self._perform(page, json.loads(text))
        except Exception as error:  # an invalid request must not disturb other pages
            reason = str(error) if isinstance(error, SmpError) else f"invalid request: {error!r}"
            page.queue.put_nowait(templates.encode(["refused", reason]))

    async def _perform(self, page: Page, message: Any) -> None:
        wanted, driver, link = message["do"], self._driver, self._laboratory.link
        if wanted == "stop":  # any page may
            link.halt("stop was pressed")
        elif wanted == "take":
            if driver is not None and time.monotonic() - driver.heard_at < TAKEOVER_AFTER_S:
                raise ParameterError("another page drives; close it first")
            self._driver = page
            link.halt("another page took over")
            self._send_roles()
        elif wanted != "beat" and page is not driver:
            raise ParameterError("this page watches; another one drives")
        elif wanted == "design":
            await self._design(page, message)
        elif wanted != "beat":
            self._laboratory.ask(message)

    async def _design(self, page: Page, message: dict[str, Any]) -> None:
        """Send the design for the values of the sliders."""
        begun, wheel = time.monotonic(), str(message["wheel"])
        if wheel not in self._laboratory.state["wheels"] or not self._laboratory.state["designed"]:
            raise ParameterError(f"{wheel} has no design yet; design first")
        by_hand = "p" in message
        names = ("p", "i", "d") if by_hand else ("share", "phase_margin")
        numbers = [float(message[name]) for name in names]
        if not all(map(math.isfinite, numbers)):
            raise ParameterError(f"{', '.join(names)} must be numbers")
        work: Callable[..., Any] = lab_designs.judge if by_hand else lab_designs.choose
        made = await asyncio.wrap_future(self._laboratory.designs.submit(work, wheel, *numbers))
        self._laboratory.candidates[wheel] = made
        took = round(1e3 * (time.monotonic() - begun))
        page.queue.put_nowait(
            templates.encode(["design", {**made, "ms": took, "asked": message.get("asked")}])
        )

    def _send(self, kind: str, content: Any) -> None:
        """Send to all pages, from any thread."""
        self._loop.call_soon_threadsafe(self._queue_message, kind, content)

    def _queue_message(self, kind: str, content: Any) -> None:
        message = content if kind == "frame" else templates.encode([kind, content])
        if kind in ("state", "designs"):
            self._last[kind] = message
        for page in self._pages:
            if kind != "frame" or page.queue.qsize() < MAX_QUEUED:
                page.queue.put_nowait(message)


def _is_loopback(host: str) -> bool:
    return host in ("localhost", "::1") or host.startswith("127.")
