# SPDX-License-Identifier: Apache-2.0
"""lab with a simulated robot: the procedure by clicks in a browser, and access to driving."""

import asyncio
import contextlib
import itertools
import json
import re
import signal
import subprocess
import time
from collections.abc import Iterator

import pytest
import yaml
from browser import AXE, Clicks, violations
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from wheel_robot import DomainNode, spinning, two_wheeled

from smp_interfaces.msg import MotorState
from smp_motor_control import WHEELS
from smp_motor_ident.report import words
from smp_motor_ident.report.document import read_identification

aiohttp = pytest.importorskip("aiohttp")

STANDSTILL = 0.05  # [rad/s]
WITHIN_S = 0.5  # from the event to standstill
LOST_S = 0.3  # silence of a page that counts as a lost connection


class Watcher(DomainNode):
    """Listens to the wheels."""

    def __init__(self, domain: int, wheels: tuple[str, ...]) -> None:
        super().__init__(domain, "watcher")
        self.samples: dict[str, list[tuple[float, float]]] = {wheel: [] for wheel in wheels}
        for wheel in wheels:
            topic = f"/{wheel}/motor_state"
            self.node.create_subscription(
                MotorState, topic, lambda m, wheel=wheel: self._take(wheel, m), 100
            )
        self.reports = self.node.create_publisher(DiagnosticArray, "/diagnostics", 10)

    def _take(self, wheel: str, message: MotorState) -> None:
        stamp = message.header.stamp
        self.samples[wheel].append((stamp.sec + 1e-9 * stamp.nanosec, message.velocity))

    def speeds(self) -> list[float]:
        return [one[-1][1] if one else 0.0 for one in self.samples.values()]

    def stood_after(self, instant: float) -> float:
        """Return the time from an instant to the last sample in motion, of any wheel."""
        moving = [t for one in self.samples.values() for t, v in one if abs(v) > STANDSTILL]
        return max([t - instant for t in moving if t > instant], default=0.0)


@pytest.fixture
def watcher(ros_domain):
    with contextlib.ExitStack() as stack:

        def make(*wheels):
            made = Watcher(ros_domain, wheels)
            stack.callback(made.close)
            stack.enter_context(spinning(lambda: made.executor.spin_once(timeout_sec=0.05)))
            return made

        yield make


def address(lab, eventually, after: int = 0) -> str:
    """Return the newest address that lab printed, once there are more than ``after``."""
    found = lambda: re.findall(r"http://\S+", lab.output)  # noqa: E731
    eventually(lambda: len(found()) > after or lab.returncode is not None, deadline=60.0)
    assert lab.returncode is None, lab.output
    return found()[-1]


class Client:
    """A page without a browser: it sends heartbeats, drives and reads the state."""

    def __init__(self, url: str) -> None:
        self.origin = url.partition("/?")[0]
        self.url, self.state, self.role, self.refusals = url, {}, {}, []
        self.drive: tuple[float, float] | None = None
        self.frames = 0

    async def __aenter__(self):
        self.session = aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True))
        async with self.session.get(self.url) as answer:
            assert answer.status == 200, await answer.text()
            address = str(answer.url).replace("http", "ws") + "ws"
        self.socket = await self.session.ws_connect(address, origin=self.origin)
        self.tasks = [asyncio.ensure_future(one()) for one in (self._read, self._beat)]
        return self

    async def __aexit__(self, *_):
        self.silence()
        await self.socket.close()
        await self.session.close()

    def silence(self) -> None:
        for task in self.tasks:
            task.cancel()

    async def send(self, what: str, **more) -> None:
        await self.socket.send_str(json.dumps({"do": what, **more}))

    async def _beat(self) -> None:
        while True:
            if self.drive is None:
                await self.send("beat")
            else:
                await self.send("drive", linear=self.drive[0], angular=self.drive[1])
            await asyncio.sleep(0.05)

    async def _read(self) -> None:
        async for message in self.socket:
            if message.type is aiohttp.WSMsgType.BINARY:
                self.frames += 1
                continue
            kind, content = json.loads(message.data)
            if kind in ("state", "role"):
                setattr(self, kind, content)
            elif kind == "refused":
                self.refusals.append(content)

    async def arm(self) -> None:
        """Arm, and repeat while another job is running."""
        while not self.state.get("armed"):
            if not self.state["job"]:
                await self.send("arm")
            with contextlib.suppress(AssertionError):
                await self.until(lambda: self.state["armed"], 3.0)
        await self.until(lambda: not self.state["job"])

    async def until(self, condition, seconds: float = 60.0) -> None:
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, (self.state, self.refusals)
            await asyncio.sleep(0.02)


@pytest.fixture
def two_wheels(process, watcher, eventually, tmp_path):
    """A robot of two wheels that drives, with its own controllers, and lab."""
    motors, gains = two_wheeled(tmp_path)
    rate = ("-p", "rate:=100.0")  # half of the usual one suits a small machine
    process("motor_plant", "--ros-args", "-p", f"motors_file:={motors}", *rate)
    for wheel in ("left", "right"):
        process("wheel_pid", "--ros-args", "-r", f"__ns:=/{wheel}", "--params-file", str(gains))
    names = ("-p", "left_wheel_names:=[left]", "-p", "right_wheel_names:=[right]")
    process("skid_steer", "--ros-args", *names, "-p", "linear.x.max_acceleration:=1.0")
    watching = watcher("left", "right")
    eventually(lambda: all(watching.samples.values()), 30.0)
    return process("lab", "--no-browser"), watching


async def drive_and_cut(lab, watching, moved: str, cut: str, pages: Iterator[str]) -> float:
    """Move the wheels by a new page; return the time of the interruption."""
    async with contextlib.AsyncExitStack() as stack:
        page = await stack.enter_async_context(Client(next(pages)))
        await page.until(lambda: page.role.get("drives") and page.state.get("wheels"))
        await page.send("drive", linear=0.2, angular=0.0)  # before it is armed
        await page.arm()
        assert max(map(abs, watching.speeds())) < STANDSTILL
        if moved == "excited":
            given = dict(signal="square", amplitude=8.0, seconds=30.0)
            await page.send("excite", wheels=["left", "right"], **given)
        else:
            page.drive = 0.2, 0.0
        await page.until(lambda: min(map(abs, watching.speeds())) > 1.5)
        other = Client(next(pages)) if cut == "second page" else None
        cut_at = time.time()
        if other:
            await stack.enter_async_context(other)
        elif cut == "stop":
            await page.send("stop")
        elif cut in ("killed", "suspended"):
            lab.send_signal(signal.SIGKILL if cut == "killed" else signal.SIGTSTP)
        else:
            page.silence()
            if cut == "closed":
                await page.socket.close()
        await asyncio.sleep(2.0)
        if cut in ("stop", "second page"):
            assert not page.state["armed"] and page.state["messages"]
            assert page.frames > 20
        return cut_at


@pytest.mark.parametrize(
    ("moved", "cuts"),
    [
        ("by the joystick", ("stop", "second page", "closed", "silent", "killed")),
        ("excited", ("closed", "killed")),
        ("excited", ("suspended",)),
    ],
)
def test_wheels_stop_within_half_a_second_of_any_interruption(two_wheels, eventually, moved, cuts):
    lab, watching = two_wheels
    pages = (address(lab, eventually, opened) for opened in itertools.count())
    for cut in cuts:
        cut_at = asyncio.run(drive_and_cut(lab, watching, moved, cut, pages))
        longest = WITHIN_S + (LOST_S if cut == "silent" else 0.0)
        assert watching.stood_after(cut_at) < longest, cut


def test_access_needs_a_token_and_only_one_page_drives(two_wheels, eventually):
    lab, watching = two_wheels
    url = address(lab, eventually)
    origin, _, token = url.partition("/?token=")

    async def knock() -> None:
        async with aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True)) as session:

            async def status(path: str = "/", **headers: str) -> int:
                async with session.get(origin + path, headers=headers) as answer:
                    return int(answer.status)

            upgrade = {"Upgrade": "websocket", "Connection": "Upgrade"}
            assert await status() == 403
            assert await status("/?token=wrong") == 403
            assert await status(f"/?token={token}", Host="evil.example") == 403
            async with session.get(url) as answer:
                assert answer.status == 200
                base = answer.url.path
            assert await status() == 403  # other servers of this host get no cookie
            assert await status(base) == 200
            assert await status(f"{base}ws", Origin="http://evil.example", **upgrade) == 403
            assert await status(f"{base}ws", **upgrade) == 403
            assert await status(f"{base}results/..%2F..%2Fetc/passwd") == 404
            assert await status(f"{base}results/logs/lab.log") == 404
            session.cookie_jar.clear()
            assert await status(f"{base}ws", Origin=origin, **upgrade) == 403
        async with aiohttp.ClientSession() as session, session.get(url) as answer:
            assert answer.status == 403  # a token opens one page
        async with Client(address(lab, eventually, 1)) as first:
            await first.until(lambda: first.role.get("drives"))
            async with Client(address(lab, eventually, 2)) as second:
                await second.until(lambda: second.role.get("pages") == 2)
                assert not second.role["drives"]
                for asked in ("arm", "excite", "identify", "drive"):
                    await second.send(asked, linear=0.2, angular=0.0)
                await second.until(lambda: len(second.refusals) == 4)
                await second.send("take")
                await second.until(lambda: len(second.refusals) == 5)
                assert "another page drives" in second.refusals[-1]
            for wrong in ("{", "[]", '{"do": 7}', '{"do": "fly"}', '{"do": "excite"}', '"x" * 9'):
                await first.socket.send_str(wrong)
            await first.until(lambda: len(first.refusals) == 6)
            assert not first.state["armed"]
            await first.send("arm")
            await first.send("stop")  # a stop while arming, which takes seconds, is not forgotten
            await first.until(lambda: any("arming" in t for *_, t in first.state["messages"]))
            await first.until(lambda: not first.state["job"])
            assert not first.state["armed"]
            for amplitude, seconds in ((99.0, 1.0), (float("nan"), 1.0), (1.0, 9e9)):
                await first.arm()
                given = dict(wheels=["left"], signal="sine", amplitude=amplitude, seconds=seconds)
                told = max((number for number, *_ in first.state["messages"]), default=0)
                await first.send("excite", **given)
                await first.until(
                    lambda told=told: (
                        "error"
                        in [kind for number, kind, _ in first.state["messages"] if number > told]
                    )
                )
                await first.until(lambda: not first.state["armed"] and not first.state["job"])

    asyncio.run(knock())
    assert max(map(abs, watching.speeds())) < STANDSTILL
    lab.interrupt()
    lab.wait(30.0)
    eventually(lambda: all(abs(v) < STANDSTILL for v in watching.speeds()))


@pytest.mark.parametrize(
    ("host", "own"), [("0.0.0.0", "http://127.0.0.1:"), ("::", "http://[::1]:")]
)
def test_server_on_all_interfaces_warns_and_prints_a_working_address(
    process, eventually, ros_domain, host, own
):
    demo = ("--demo", "--domain", str(ros_domain))
    lab = process("lab", "--no-browser", "--host", host, *demo)
    url = address(lab, eventually)
    assert f"WARNING: served on {host}" in lab.output
    assert url.startswith(own)

    async def watch() -> None:
        async with Client(url) as page:
            await page.until(lambda: page.role.get("drives") and page.frames > 5)
            assert page.state["wheels"] == list(WHEELS)

    asyncio.run(watch())


def test_wheel_name_with_html_is_refused(process):
    lab = process("lab", "--no-browser", "--wheel", "<img src=x onerror=alert(1)>")
    assert lab.wait(30.0) == 2
    assert "<img" in lab.output and "Traceback" not in lab.output


def test_whole_procedure_works_by_clicks(two_wheels, eventually, tmp_path, browser):
    lab, watching = two_wheels
    url = address(lab, eventually)
    results = tmp_path / "lab_output"
    page = Clicks(browser)
    browser.open(url, 1280)
    page.until("Number(document.body.dataset.frames) >= 10")
    for name in ("excite", "identify", "tune", "apply", "step", "keep", "back"):
        assert page.value(f"document.getElementById('{name}').disabled"), name
    assert max(map(abs, watching.speeds())) < STANDSTILL
    # A message is shown as text even if it contains HTML.
    evil = "<img src=x onerror=window.broken=1>"
    status = DiagnosticStatus(name="left/wheel_pid", message=evil, level=b"\1")
    shown = f"document.querySelector('#diagnostics').textContent.includes({evil!r})"

    def is_shown() -> bool:  # wheel_pid reports itself every second
        watching.reports.publish(DiagnosticArray(status=[status]))
        return bool(page.value(shown))

    eventually(is_shown, 30.0)
    assert page.value("document.images.length + (window.broken || 0)") == 0

    page.set("seconds", 8)
    recorded = "document.getElementById('recordings').innerText.includes('recording_')"
    stopped = "document.getElementById('messages').innerText.includes('exciting was stopped')"
    for _ in range(4):  # a busy machine may not hear the page for 0.3 s, which stops the wheels
        page.arm()
        page.click("excite")
        page.until("document.getElementById('job').innerText.startsWith('Exciting')")
        page.until(f"{recorded} || {stopped}")
        if page.value(recorded):
            break
    page.click("identify")
    page.until("document.getElementById('motors').innerText.includes('identified')", 240.0)
    folder = next(results.glob("identification_*"))
    shown = page.text("motors")
    for estimate in read_identification(folder).values():
        for quantity in estimate.combinations.values():
            assert words.state(quantity) in shown
    page.value("document.getElementById('report').parentElement.open = true")
    page.until(f"document.getElementById('report').src.endsWith('{folder.name}/report.html')")

    page.click("tune")
    page.until("document.querySelectorAll('#rows tr').length > 5", 240.0)
    (gains,) = results.glob("gains_*.yaml")
    own = tmp_path / "own.yaml"
    done = subprocess.run(["tune", folder, "--output", own], capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    assert yaml.safe_load(gains.read_text()) == yaml.safe_load(own.read_text())
    page.set("share", 0.6)
    page.until("document.getElementById('yaml').dataset.ms !== ''")
    slower = float(page.text("share-shown").split()[0])
    page.set("i", 1e6)
    page.until("document.getElementById('reason').innerText.includes('unstable')")
    page.set("share", 1.0)
    page.until(f"parseFloat(document.getElementById('share-shown').innerText) > {slower}")

    for wheel in ("left", "right"):
        page.set("wheel", wheel, "change")
        page.arm()
        page.click("apply")
        page.until("document.getElementById('trial').innerText.startsWith('On trial')")
        page.click("keep")
        page.until("document.getElementById('trial').innerText === ''")
    page.arm()
    page.value("document.getElementById('pad').focus()")
    page.press("keyDown", "ArrowUp")
    eventually(lambda: min(watching.speeds()) > 1.9, 10.0)
    time.sleep(0.5)
    assert all(abs(v - 2.0) < 0.1 for v in watching.speeds())  # 0.2 m/s on wheels of 0.1 m
    stopped = time.time()
    page.press("keyDown", " ")
    page.press("keyUp", "ArrowUp")
    time.sleep(1.0)
    assert watching.stood_after(stopped) < WITHIN_S
    assert page.text("arm") == "Arm"
    for width, dark in ((390, True), (1280, False), (1920, True), (390, False)):
        browser.resize(width, dark=dark)
        browser.drawn()
        top = "document.getElementById('identify-title').getBoundingClientRect().top"
        before = page.value(top)
        page.until("Number(document.body.dataset.frames) > 0")
        assert page.value(top) == before  # nothing jumps while data stream
        assert page.value("document.documentElement.scrollWidth") <= width
        assert AXE is None or violations(browser) == []
    assert browser.complaints == []
    lab.interrupt()
    lab.wait(30.0)
