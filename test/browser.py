# SPDX-License-Identifier: Apache-2.0
"""Headless Chromium as a test drives it: over a pipe, by its own protocol, without a network."""

import base64
import itertools
import json
import os
import select
import shutil
import subprocess
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), ""
)
AXE = find_spec("axe_core_python")


class Browser:
    """One page of a browser, whose files are in ``profile``, with its requests and errors."""

    def __init__(self, profile: Path) -> None:
        mine, its = os.pipe(), os.pipe()  # commands go out, answers come in
        self._out, self._in = mine[1], its[0]
        arguments = [
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-sync",
            "--no-first-run",
            "--remote-debugging-pipe",
            "--host-resolver-rules=MAP * 0.0.0.0",
        ]
        self._process = subprocess.Popen(
            ["bash", "-c", f'exec "$@" 3<&{mine[0]} 4>&{its[1]}', "bash", CHROMIUM, *arguments,
             f"--user-data-dir={profile}", "about:blank"],
            pass_fds=(mine[0], its[1]), stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL, start_new_session=True,
        )  # fmt: skip
        os.close(mine[0])
        os.close(its[1])
        self._numbers = itertools.count(1)
        self._rest = b""
        self._session = ""
        self.complaints: list[str] = []
        self.requests: list[str] = []

    def __enter__(self):
        target = self._page()
        attached = self.ask("Target.attachToTarget", targetId=target, flatten=True)
        self._session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.ask(f"{domain}.enable")
        return self

    def __exit__(self, kind, error, trace):
        self._process.kill()
        self._process.wait()
        os.close(self._out)
        os.close(self._in)

    def _page(self) -> str:
        """Return the first page, which may need a moment to appear."""
        for _ in range(200):
            for one in self.ask("Target.getTargets")["targetInfos"]:
                if one["type"] == "page":
                    return str(one["targetId"])
        raise AssertionError("the browser opened no page")

    def ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send one command and return its result."""
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._read()
            if answer.get("id") == number:
                assert "error" not in answer, answer
                return dict(answer["result"])

    def _read(self, patience: float = 60.0) -> dict[str, Any]:
        deadline = time.monotonic() + patience
        while b"\0" not in self._rest:
            ready, _, _ = select.select([self._in], [], [], deadline - time.monotonic())
            assert ready, "the browser does not answer"
            self._rest += os.read(self._in, 1 << 20)
        line, _, self._rest = self._rest.partition(b"\0")
        message: dict[str, Any] = json.loads(line)
        self._note(message)
        return message

    def _note(self, message: dict[str, Any]) -> None:
        given = message.get("params", {})
        if message.get("method") == "Network.requestWillBeSent":
            self.requests.append(given["request"]["url"])
        elif message.get("method") == "Runtime.exceptionThrown":
            self.complaints.append(str(given["exceptionDetails"]))
        elif message.get("method") == "Log.entryAdded":
            self.complaints.append(given["entry"]["text"])
        elif message.get("method") == "Runtime.consoleAPICalled" and given["type"] == "error":
            self.complaints.append(str(given["args"]))

    def resize(self, width: int, *, dark: bool = False, height: int = 900) -> None:
        """Show the page at a width, in light or dark."""
        self.ask(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=1, mobile=width < 500,
        )  # fmt: skip
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.ask("Emulation.setEmulatedMedia", features=[scheme])

    def open(self, page: Path | str, width: int, *, dark: bool = False, height: int = 900) -> None:
        """Show a file or an address at a width, and wait until it is loaded."""
        self.resize(width, dark=dark, height=height)
        self.ask("Page.navigate", url=page if isinstance(page, str) else page.as_uri())
        while self._read().get("method") != "Page.loadEventFired":
            pass

    def value(self, expression: str) -> Any:
        """Return the value of a JavaScript expression."""
        answer = self.ask("Runtime.evaluate", expression=expression, returnByValue=True)
        return answer["result"].get("value")

    def drawn(self) -> None:
        """Wait until changes are drawn: a chart follows in the next frame."""
        frames = "done => requestAnimationFrame(() => requestAnimationFrame(done))"
        self.ask("Runtime.evaluate", awaitPromise=True, expression=f"new Promise({frames})")

    def unfold(self) -> None:
        """Open everything that is folded, and wait until it is drawn."""
        self.value("document.querySelectorAll('details').forEach(one => { one.open = true; })")
        self.drawn()

    def picture(self, path: Path, *selectors: str, margin: int = 12) -> None:
        """Write the page as PNG, or the part with the elements of the selectors."""
        size = self.ask("Page.getLayoutMetrics")["cssContentSize"]
        left, top, right, bottom = size["x"], size["y"], size["width"], size["height"]
        if selectors:
            rect = "document.querySelector({!r}).getBoundingClientRect().toJSON()"
            rects = [self.value(rect.format(selector)) for selector in selectors]
            scrolled = self.value("scrollY")
            left = max(left, min(r["left"] for r in rects) - margin)
            right = min(right, max(r["right"] for r in rects) + margin)
            top = max(top, min(r["top"] for r in rects) + scrolled - margin)
            bottom = min(bottom, max(r["bottom"] for r in rects) + scrolled + margin)
        clip = {"x": left, "y": top, "width": right - left, "height": bottom - top, "scale": 1}
        shot = self.ask("Page.captureScreenshot", clip=clip, captureBeyondViewport=True)
        path.write_bytes(base64.b64decode(shot["data"]))


def violations(browser: Browser) -> list[str]:
    """Return serious and critical violations found by axe-core, with their elements."""
    browser.value(Path(AXE.origin).with_name("axe.min.js").read_text("utf-8") + ";0")
    said = browser.ask(
        "Runtime.evaluate", awaitPromise=True, returnByValue=True,
        expression="axe.run(document, {resultTypes: ['violations']})"
        ".then(r => JSON.stringify(r.violations))",
    )  # fmt: skip
    found: list[dict[str, Any]] = json.loads(said["result"]["value"])
    return [
        f"{one['id']}: {node['html'][:120]}: {node.get('failureSummary', '')}"
        for one in found
        if one["impact"] in ("serious", "critical")
        for node in one["nodes"]
    ]


class Clicks:
    """A page in a browser, as a person uses it."""

    def __init__(self, browser: Browser) -> None:
        self.browser = browser

    def value(self, expression: str):
        return self.browser.value(expression)

    def text(self, name: str) -> str:
        return str(self.value(f"document.getElementById('{name}').innerText"))

    def until(self, expression: str, seconds: float = 90.0) -> None:
        end = time.monotonic() + seconds
        while not self.value(f"Boolean({expression})"):
            assert time.monotonic() < end, (expression, self.text("job"), self.text("messages"))
            time.sleep(0.1)

    def click(self, name: str) -> None:
        """Press a button as soon as it is enabled."""
        self.until(f"!document.getElementById('{name}').disabled")
        self.value(f"document.getElementById('{name}').click()")

    def set(self, name: str, value: object, event: str = "input") -> None:
        self.value(
            f"(() => {{ const one = document.getElementById('{name}'); one.value = {value!r}; "
            f"one.dispatchEvent(new Event('{event}')); }})()"
        )

    def arm(self) -> None:
        """Arm, and repeat if a busy machine was silent for too long."""
        if self.text("arm") != "Armed":
            self.click("arm")
        self.until(
            "document.getElementById('arm').innerText === 'Armed' && "
            "document.getElementById('job').innerText.startsWith('Armed')"
        )

    def press(self, kind: str, key: str) -> None:
        self.browser.ask("Input.dispatchKeyEvent", type=kind, key=key, code=key)
