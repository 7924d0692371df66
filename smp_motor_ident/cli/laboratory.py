# SPDX-License-Identifier: Apache-2.0
"""Run ``lab``: perform the requests of its page on a robot, one after another.

The main thread waits for the robot and works; the server of the page has a thread of its own.
"""

import argparse
import itertools
import math
import multiprocessing
import queue
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, closing, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from smp_motor_control import WHEELS, check_wheel_names, get_controller_name
from smp_motor_control.arrays import Array
from smp_motor_control.errors import SmpError
from smp_motor_control.excitation import SIGNALS
from smp_motor_control.motor import Motor, MotorParameters
from smp_motor_ident.cli import demonstration, interruption, lab, lab_designs, steps
from smp_motor_ident.cli.processes import ProcessError, Processes, connect, isolate
from smp_motor_ident.errors import ParameterError
from smp_motor_ident.report import words
from smp_motor_ident.report.document import read_identification
from smp_motor_ident.result import UNITS, Quantity

MOVING_JOBS = ("arming", "exciting", "trying gains", "stepping")  # jobs that need the wheels
TRIAL_S = 2.5  # duration of a trial of gains
STEP_BEGIN_S, STEP_LENGTH_S = 0.3, 1.2  # begin and length of the step of a trial
STATE_PERIOD_S = 0.1  # shortest time between two messages about the state
BACKGROUND_PRIORITY = -10  # priority of computations while the robot runs
MAX_MESSAGES = 3  # that a page shows of a kind
SPAWN = multiprocessing.get_context("spawn")
COMBINATIONS = ("dc_gain", "time_constant", "time_constant_product", "static_voltage")


def work(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    from smp_motor_ident.cli.lab_server import Server

    folder = Path(arguments.output)
    if folder.exists():
        raise ParameterError(f"{folder}: exists already; choose another --output")
    if arguments.demo:
        isolate(arguments.domain)
    ros = tuple(arguments.ros_arguments)
    bounds = {"max_speed": arguments.max_speed, "max_current": arguments.max_current}
    with (
        connect(lab.NAME, ros) as client,
        Processes(folder / "logs") as processes,
        ProcessPoolExecutor(1, SPAWN, initializer=lab_designs.begin) as designs,
    ):
        designs.submit(int)  # start the process, which loads its modules
        if arguments.demo:
            robot = steps.Robot(processes, client, WHEELS, folder, ros, bounds)
            demonstration.start(robot)
        else:
            print("looking for the wheels that report, which takes some 5 s", flush=True)
            check_wheel_names(tuple(arguments.wheel or WHEELS))
            wheels = tuple(arguments.wheel or ()) or client.find_wheels()
            robot = steps.Robot(processes, client, wheels or WHEELS, folder, ros, bounds)
            client.wait_for_wheels(robot.wheels, timeout=15.0)
        served = arguments.host, arguments.port, not arguments.no_browser
        laboratory = Laboratory(robot, designs)
        with Server(laboratory, *served), closing(laboratory):
            laboratory.run()
    return 0


class Laboratory:
    """One robot, the job under way, and the state that the pages show."""

    def __init__(self, robot: steps.Robot, designs: ProcessPoolExecutor) -> None:
        from smp_motor_control.nodes.live_link import COLUMNS, SLOT_S, LiveLink

        self.robot, self.designs = robot, designs
        self.folder = robot.folder.resolve()
        self.send: Callable[[str, Any], None] = lambda kind, content: None  # to all pages
        self.state: dict[str, Any] = {
            "wheels": robot.wheels, "columns": COLUMNS, "slot": SLOT_S, "signals": [*SIGNALS],
            "armed": False, "job": "", "progress": "", "messages": [], "supply": {},
            "recordings": [], "motors": {}, "identified": "", "designed": None, "trial": None,
            "diagnostics": [], "drives": False,
        }  # fmt: skip
        self._slot_s, self._speed = SLOT_S, COLUMNS.index("speed")
        self._prediction = COLUMNS.index("prediction")
        self.link = LiveLink(robot.client, robot.wheels, self)
        self._jobs: queue.SimpleQueue[tuple[str, Callable[[], None]]] = queue.SimpleQueue()
        self._numbers = itertools.count(1)
        self._models: dict[str, Prediction] = {}
        self._recorded: dict[str, list[str]] = {}  # the wheels that each recording excites
        self._before: dict[str, dict[str, Any]] = {}  # parameters of wheels with gains on trial
        self._tried: dict[str, dict[str, Any]] = {}  # designs that are on trial
        self._designs: dict[str, dict[str, Any]] = {}  # those of ``tune``, or kept after a trial
        self.candidates: dict[str, dict[str, Any]] = {}  # the design that a page shows, by wheel
        self._told: tuple[float, str] = (0.0, "")
        self._reason = ""
        self.interrupt = partial(robot.processes.interrupt, "excite")  # ends an excitation at once
        self._stack = ExitStack()
        self._holds_controllers = False  # whether their former state is to be restored

    def close(self) -> None:
        """Stop the wheels and restore the controllers."""
        self.link.halt("lab ends")
        with self._stack:  # restores the controllers in any case
            self.robot.client.spin(2 * STATE_PERIOD_S)
            self.robot.processes.stop("excite", "record", "identifier", "identify")
            if self._holds_controllers:
                self._activate(False)
                if self._before:
                    self._end_trial(keep=False)
                self._holds_controllers = False
                self._store_pending_restore()

    def run(self) -> None:
        """Perform the requests of the pages until Ctrl-C."""
        while True:
            interruption.check()
            self.robot.client.until(lambda: not self._jobs.empty(), 0.5)
            if self._jobs.empty():
                continue
            name, work = self._jobs.get()
            self.state["job"] = name
            try:
                work()
            except Exception as error:  # keep running, to watch and stop the wheels
                known = isinstance(error, SmpError)
                self.tell(str(error) if known else f"the request failed: {error!r}", "error")
                if name in MOVING_JOBS:
                    self.link.halt(f"{name} failed")
            finally:
                self.state["job"] = self.state["progress"] = ""
                self.link.end_plans()

    def tell(self, text: str, kind: str = "note") -> None:
        """Show a message on all pages."""
        shown = [*self.state["messages"], [next(self._numbers), kind, text]]
        self.state["messages"] = shown[-MAX_MESSAGES:]

    def on_frame(self, slots: Array, rows: Array) -> None:
        """Send a batch of samples as rows of float32: slot, then the columns of every wheel."""
        for wheel, model in list(self._models.items()):
            k = self.robot.wheels.index(wheel)
            voltage, speed = rows[:, k, 0], rows[:, k, self._speed]
            rows[:, k, self._prediction] = model.follow(slots * self._slot_s, voltage, speed)
        table = np.column_stack([slots - self.link.history.origin, rows.reshape(slots.size, -1)])
        self.send("frame", table.astype("<f4").tobytes())

    def on_learned(self, wheel: str, message: Any) -> None:
        """Show an estimate of the node identifier, and follow its model from now on."""
        found = {
            name: Quantity(value, std, unit=UNITS[name], status="estimated")
            for name, value, std in zip(message.names, message.values, message.std_devs)
            if name in UNITS and math.isfinite(value + std)  # any node may publish it
        }
        self.state["motors"][wheel] = {
            "state": message.status, "findings": [],
            "fit": None if math.isnan(message.fit_percent) else message.fit_percent,
            "values": {words.label(name): [words.state(one)] for name, one in found.items()},
        }  # fmt: skip
        hardware = self.link.hardware.get(wheel)
        model = {n: float(found[n].value or 0.0) for n in COMBINATIONS if n in found}
        if hardware is not None and {"dc_gain", "time_constant"} <= set(model):
            with suppress(SmpError):
                self._models[wheel] = Prediction(model, hardware.gear_ratio)

    def on_halt(self, reason: str) -> None:
        """Verify that the controllers are inactive."""
        self._reason = reason
        self.tell(f"Stopped: {reason}.", "stop")
        if self._holds_controllers:
            self._jobs.put(("stopping", lambda: self._activate(False)))

    def on_tick(self) -> None:
        """Send the state to the pages when it has changed."""
        state, link, now = self.state, self.link, time.monotonic()
        if now - self._told[0] < STATE_PERIOD_S:
            return
        state["armed"] = link.armed
        state["drives"] = bool(link.twists.get_subscription_count())
        state["recordings"] = [*self._recorded]
        state["supply"] = {w: one.supply_voltage for w, one in link.hardware.items()}
        space = str(self.robot.client.node.get_namespace()).strip("/")
        state["diagnostics"] = sorted(
            [name, level, text]
            for name, (_, level, text) in link.diagnostics.items()
            if name.startswith(space)
        )
        text = repr(state)
        if text != self._told[1]:
            self.send("state", state)
        self._told = now, text

    def ask(self, message: Mapping[str, Any]) -> None:
        """Take a request of the page that drives."""
        jobs: dict[str, tuple[str, Callable[[], None]]] = {
            "arm": ("arming", partial(self._arm, self.link.halts)),
            "excite": ("exciting", lambda: self._excite(message)),
            "discard": ("discarding recordings", self._recorded.clear),
            "identify": ("identifying", self._identify),
            "tune": ("designing", lambda: self._tune(bool(message.get("accept")))),
            "apply": ("trying gains", lambda: self._apply(str(message["wheel"]))),
            "step": ("stepping", lambda: self._step(str(message["wheel"]))),
            "keep": ("keeping gains", lambda: self._end_trial(keep=True)),
            "back": ("taking gains back", lambda: self._end_trial(keep=False)),
        }
        wanted = str(message["do"])
        if wanted == "drive":
            if self.state["job"] not in MOVING_JOBS:  # which the joystick would disturb
                self.link.drive(float(message["linear"]), float(message["angular"]))
            return
        if wanted not in jobs:
            raise ParameterError(f"the request {wanted!r} is not known")
        if wanted in ("excite", "apply", "step") and not self.link.armed:
            raise ParameterError("press Arm first; no wheel moves before")
        if self.state["job"]:
            raise ParameterError(f"busy with {self.state['job']}; wait, or stop it")
        self._jobs.put(jobs[wanted])

    def _wait(self, done: Callable[[], bool], moving: bool = False, name: str = "") -> None:
        """Wait for a condition and serve the streams; raise if the wheels are stopped."""
        while True:
            interruption.check()
            if moving and not self.link.armed:
                raise ProcessError(f"{self.state['job']} was stopped: {self._reason}")
            if done():
                return
            if name:
                self.state["progress"] = self.robot.processes.last_line(name)
            self.robot.client.until(done, 0.1)

    def _arm(self, halts: int) -> None:
        client, link = self.robot.client, self.link
        if not self._holds_controllers:
            if missing := self.robot.uncontrolled():
                wheels = ", ".join(missing)
                self.tell(f"No wheel_pid runs for {wheels}; lab starts one and ends it again.")
                self.robot.start_controllers(missing)
            self._stack.enter_context(client.paused(self.robot.wheels))
            self._holds_controllers = True
            node, name = client.node, get_controller_name(self.robot.wheels[-1])
            service = node.resolve_service_name(f"{name}/change_state")
            before = node.count_clients(service)
            self._store_pending_restore()  # and wait until the controllers know the guard
            client.until(lambda: node.count_clients(service) > before, steps.TIMEOUT_S)
        if link.halts != halts:
            raise ProcessError("stopped while arming")
        link.watched_at, link.armed = time.monotonic(), True
        self._activate(True)

    def _activate(self, active: bool) -> None:
        if active and not self.link.armed:
            raise ProcessError(f"stopped: {self._reason}")
        self.link.controlled = self.link.controlled or active
        self.robot.switch("activate" if active else "deactivate")
        self.link.controlled = active
        if active and not self.link.armed:  # stopped during the activation
            self._activate(False)

    def _excite(self, asked: Mapping[str, Any]) -> None:
        wheels = [w for w in self.robot.wheels if w in asked["wheels"]]
        amplitude, duration = float(asked["amplitude"]), float(asked["seconds"])
        if not wheels:
            raise ParameterError("no wheel is chosen; choose one")
        supply = min(self.state["supply"].values(), default=12.0)
        bounds = {**self.robot.bounds, "max_voltage": supply}
        self._activate(False)
        processes = self.robot.processes
        processes.stop("identifier")
        self._models.clear()
        self.state["motors"] = {}
        listed = f"wheels:=[{', '.join(wheels)}]"
        window = min(max(duration, 5.0), 60.0)
        processes.start(
            "identifier", "identifier", *self.robot.ros_arguments, "--ros-args", "-p", listed,
            "-p", "period:=1.0", "-p", "share:=0.2", "-p", f"window:={window}",
            priority=BACKGROUND_PRIORITY,
        )  # fmt: skip
        name = f"recording_{next(self._numbers)}"

        def has_ended() -> bool:
            since = time.monotonic() - begun
            self.state["progress"] = f"{min(since, duration):.0f} of {duration:g} s"
            return bool(processes.has_ended("excite"))

        try:
            steps.record(self.robot, name)
            self._wait(lambda: True, moving=True)
            begun = time.monotonic()
            signal = steps.Excitation(str(asked["signal"]), duration, amplitude)
            moved = replace(self.robot, wheels=tuple(wheels), bounds=bounds)
            steps.excite(moved, signal, lambda: self._wait(has_ended, moving=True))
        finally:
            processes.stop("excite", "record")
        self._recorded[name] = wheels
        self._activate(True)
        self.tell(f"Recorded {name}: {asked['signal']}, {amplitude:g} V, {duration:g} s.")

    def _identify(self) -> None:
        bags = [str(self.folder / name) for name in self._recorded]
        if not bags:
            raise ParameterError("there is no recording; excite the wheels first")
        self.robot.processes.stop("identifier")
        output = self.folder / f"identification_{next(self._numbers)}"
        excited = sorted({wheel for some in self._recorded.values() for wheel in some})
        wheels = [a for wheel in excited for a in ("--wheel", wheel)]
        given = [*bags, "--output", str(output), *wheels]
        self.robot.processes.start("identify", "identify", *given, priority=BACKGROUND_PRIORITY)
        self._wait(lambda: self.robot.processes.has_ended("identify"), name="identify")
        last = self.robot.processes.last_line("identify")
        self.robot.processes.stop("identify")
        if not (output / "identification.json").is_file():
            raise ParameterError(last)
        found = read_identification(output)
        self.state["motors"] = {wheel: _describe_motor(one) for wheel, one in found.items()}
        self.state["identified"], self.state["designed"] = output.name, None
        self.tell(f"Identified {', '.join(found)}.")

    def _tune(self, accept: bool) -> None:
        if not self.state["identified"]:
            raise ParameterError("no motor is identified yet; identify the motors first")
        name = self.state["identified"]
        gains = self.folder / f"gains_{next(self._numbers)}.yaml"
        asked = self.designs.submit(lab_designs.design_all, self.folder / name, gains, accept)
        self._wait(asked.done)
        found = asked.result()
        self._designs, self.candidates = dict(found["designs"]), dict(found["designs"])
        self.send("designs", found)
        self.state["designed"] = {"name": gains.name, "reason": found["reason"]}
        self.tell(f"{gains.name} holds designed gains for {', '.join(found['designs'])}.")

    def _apply(self, wheel: str) -> None:
        """Set the gains that the page shows, and restore the old ones if the wheel misbehaves."""
        from smp_motor_control.nodes.gain_trial import try_gains

        made = self._prepare_step(wheel)
        client, new, node = self.robot.client, made["parameters"], get_controller_name(wheel)
        old = client.get_parameters({node: list(new)})[node]
        self.link.follow({wheel: [(0.0, 0.0)]})
        first = wheel not in self._before
        self._before.setdefault(wheel, old)
        self._store_pending_restore()
        outcome = try_gains(
            client, {wheel: {n: v for n, v in new.items() if n in old}}, TRIAL_S,
            self.state["supply"].get(wheel, 12.0), self.tell, lambda: self._begin_step(wheel, made),
        )  # fmt: skip
        if outcome.reason:
            if first and not outcome.missing:
                del self._before[wheel]
                self._store_pending_restore()
            raise ProcessError(f"the previous gains were restored: {outcome.reason}")
        self._tried[wheel] = made
        self._show_step(wheel, made)

    def _step(self, wheel: str) -> None:
        made = self._prepare_step(wheel)
        self._begin_step(wheel, made)
        end = time.monotonic() + STEP_BEGIN_S + STEP_LENGTH_S
        self._wait(lambda: time.monotonic() > end, moving=True)
        self._show_step(wheel, made)

    def _prepare_step(self, wheel: str) -> dict[str, Any]:
        """Return the design that the page shows now, and make the wheels ready for it."""
        made = self.candidates.get(wheel, {})
        if "parameters" not in made:
            raise ParameterError(f"{wheel or 'no wheel'} has no design; design one first")
        self._wait(self.link.is_body_idle, moving=True)
        self._activate(True)
        return made

    def _begin_step(self, wheel: str, made: Mapping[str, Any]) -> None:
        self._stepped_at = self.link.history.newest
        plan = [(0.0, 0.0), (STEP_BEGIN_S, made["change"]), (STEP_BEGIN_S + STEP_LENGTH_S, 0.0)]
        self.link.follow({wheel: plan})

    def _show_step(self, wheel: str, made: Mapping[str, Any]) -> None:
        """Send the measured answer to the step, from the instant of its set-point [s]."""
        slots, rows = self.link.history.since(self._stepped_at)
        mine, change = rows[:, self.robot.wheels.index(wheel)], made["change"]
        asked = np.flatnonzero(np.abs(mine[:, 3] - change) < 1e-6 * abs(change))
        if asked.size == 0:
            raise ProcessError(f"{wheel} reported no set-point of {change:.3g} rad/s")
        shown = np.arange(asked[0], asked[-1] + 1)
        shown = shown[np.isfinite(mine[shown, self._speed])]
        milliseconds = 1e3 * self._slot_s * (slots[shown] - slots[asked[0]])
        on = made["charts"]["tuning-step"][0]
        speed = np.interp(on, milliseconds, mine[shown, self._speed], right=np.nan)
        self.send("step", {"wheel": wheel, "speed": speed})

    def _end_trial(self, keep: bool) -> None:
        if not self._before:
            raise ParameterError("no gains are on trial")
        if not keep:
            self.robot.client.set_parameters(
                {get_controller_name(wheel): old for wheel, old in self._before.items()}
            )
        done = ", ".join(sorted(self._before))
        self.tell(f"{done}: {'gains kept' if keep else 'old gains restored'}.")
        self._before.clear()
        self._store_pending_restore()
        if keep:  # write the parameters of all wheels
            self._designs.update(self._tried)
            path = self.folder / f"gains_{next(self._numbers)}.yaml"
            path.write_text("\n".join(one["yaml"] for one in self._designs.values()), "utf-8")
            self.state["designed"] = {**self.state["designed"], "name": path.name}
        self._tried.clear()

    def _store_pending_restore(self) -> None:
        """Let the guard halt the wheels and restore the old gains if this process dies."""
        pending = {"active": self.robot.client.pending_restore.get("active", ())}
        pending["halt"] = [
            get_controller_name(w) for w in self.robot.wheels if self._holds_controllers
        ]
        pending["gains"] = {get_controller_name(w): old for w, old in self._before.items()}
        self.robot.client.set_pending_restore(**pending)
        self.state["trial"] = {"wheels": sorted(self._before)} if self._before else None


class Prediction:
    """Speed of an estimated motor under the recorded voltage."""

    def __init__(self, model: Mapping[str, float], gear_ratio: float) -> None:
        self._ratio = gear_ratio
        self._motor = Motor(MotorParameters.from_combinations(**model))
        self._time = math.nan

    def follow(self, time: Array, voltage: Array, speed: Array) -> list[float]:
        """Return speeds [rad/s] at instants [s] under a voltage [V], from ``speed`` on."""
        speeds = []
        for instant, volts, measured in zip(time.tolist(), voltage.tolist(), speed.tolist()):
            if math.isnan(self._time) and math.isfinite(measured):
                self._motor.speed, self._time = measured * self._ratio, instant
            if math.isfinite(volts) and instant > self._time:
                self._motor.step(volts, min(instant - self._time, 1.0))
                self._time = instant
            speeds.append(self._motor.speed / self._ratio)
        return speeds


def _describe_motor(estimate: Any) -> dict[str, Any]:
    """Return an identified motor in the form that the page shows."""
    held = {**estimate.combinations, **estimate.parameters}
    grave = [one for one in estimate.findings if one.severity != "note"][:MAX_MESSAGES]
    unreliable = any(one.severity in ("unreliable", "refused") for one in grave)
    return {
        "state": "unreliable" if unreliable else "identified",
        "fit": estimate.fit_percent.validation or estimate.fit_percent.estimation,
        "values": {words.label(n): [words.state(q), words.systematic(q)] for n, q in held.items()},
        "findings": [[f.severity, f"{words.to_sentence(f.message)} {f.advice}"] for f in grave],
    }
