# SPDX-License-Identifier: Apache-2.0
"""Inject random faults into real processes: no forbidden motion, no dead node.

    python benchmarks/faults.py                         # one hour, seed of the day
    python benchmarks/faults.py --minutes 2 --seed 7
    python benchmarks/faults.py --parameters 5000       # sets through the service of a live wheel

Faults come singly or in pairs, at random set-points.  The allowed outcomes are in
docs/decisions/when-a-wheel-stops.md: a fault that stops must have done so in its time, with half
a second for a busy machine; after that the motor gets nothing, or the small voltage of at most
three tries; once it has passed, and a person has called ~/reset, the wheel drives again.
Exit code 1 where that does not hold; the seed and the draw are printed.
"""

from __future__ import annotations

import argparse
import math
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import yaml
from parameter_sets import GAINS, random_parameters, usual

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "test"), str(ROOT / "test" / "control")]
WHEEL = "front_left"
NODE = f"{WHEEL}/wheel_pid"
SUPPLY, SLACK = 12.0, 0.5
FASTEST = 5.0
"""Speed of this wheel at its supply [rad/s], with a margin for a coarse mean."""
TRY_VOLTAGE = 1.05 * 4.0 + 0.02  # and a step of the PWM


@dataclass(frozen=True)
class Fault:
    """A fault: its start, and the time by which the wheel must have stopped, if at all."""

    name: str
    begin: Callable[[Campaign], None]
    within: float = math.inf  # infinite: the wheel drives on
    of_the_relay: bool = True
    tried: bool = False  # the wheel may be tried again meanwhile


class Campaign:
    """Plant, relay and wheel, with their commands."""

    def __init__(self, domain: int, through_relay: bool) -> None:
        from wheel_robot import Relay, WheelRobot

        self.robot = WheelRobot(domain)
        self.draw = random.Random(0)
        self.relay = Relay(self.robot, WHEEL)
        self.seen = self.robot.states["raw" if through_relay else WHEEL]
        self.speed = 1.0
        self.robot.spin_for(2.0)
        if self.robot.node.count_publishers(f"/{WHEEL}/motor_description"):
            sys.exit(f"another robot runs in domain {domain}; choose another ROS_DOMAIN_ID")
        motors = Path(tempfile.mkdtemp()) / "motors.yaml"
        text = (ROOT / "config" / "motors_paper.yaml").read_text()
        motors.write_text(yaml.safe_dump(_only(yaml.safe_load(text))))
        self.plant = subprocess.Popen(
            ["motor_plant", "--ros-args", "-p", "rate:=100.0", "-p", f"motors_file:={motors}",
             *(["-r", f"{WHEEL}/motor_state:={WHEEL}/raw_state"] if through_relay else [])],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        self.start_wheel()
        self.spin_until(lambda: self.robot.commands[WHEEL], 40.0)

    def start_wheel(self) -> None:
        given = [part for k, v in GAINS.items() for part in ("-p", f"{k}:={v}")]
        self.wheel = subprocess.Popen(
            ["wheel_pid", "--ros-args", "-r", f"__ns:=/{WHEEL}", *given],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            # A campaign under nohup would hand on that a closed terminal is to be survived.
            preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),
        )  # fmt: skip

    def close(self) -> None:
        for process in (self.wheel, self.plant):
            process.kill()  # which needs nothing of a busy processor
            process.wait(60.0)
        self.robot.close()

    def spin_until(self, condition: Callable[[], object], within: float) -> bool:
        end = time.monotonic() + within
        while not condition():
            if time.monotonic() > end:
                return False
            self.robot.spin()
            del self.seen[:-200], self.robot.diagnoses[:-200]
        return True

    def true_speed(self) -> float:
        last = self.seen[-6:]
        if len(last) < 6:
            return math.nan
        stamps = [m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for m in last]
        return (last[-1].position - last[0].position) / max(stamps[-1] - stamps[0], 1e-3)

    def stamp(self) -> float:
        last = self.seen
        return last[-1].header.stamp.sec + 1e-9 * last[-1].header.stamp.nanosec if last else 0.0

    def voltage(self) -> float:
        last = self.seen
        # What acts at the instant; the mean voltage of a late sample holds the time before too.
        return SUPPLY * float(last[-1].duty_cycle) if last else 0.0

    def drives(self) -> bool:
        return abs(self.true_speed() - self.speed) < 0.15 * abs(self.speed) + 0.05

    def drives_within(self, seconds: float) -> bool:
        """Wait until the wheel drives; time in which this relay is late itself does not count."""
        left = seconds
        for _ in range(round(10.0 * seconds)):
            if self.spin_until(self.drives, 1.0):
                return True
            left -= 1.0 if time.time() - self.stamp() < BEHIND else 0.0
            if left <= 0.0:
                return False
        return False

    def heal(self) -> None:
        """Remove every fault and call ~/reset."""
        self.relay.passes()
        self.robot.setpoint = self.speed
        if self.wheel.poll() is not None:
            self.start_wheel()
        else:
            self.wheel.send_signal(signal.SIGCONT)
            self.robot.trigger(NODE, "reset")

    def renew(self) -> None:
        """Start the wheel's process anew, so that one failure is not counted twice."""
        self.ends(signal.SIGKILL)
        self.heal()
        self.drives_within(STARTS)

    def ends(self, number: int) -> None:
        self.wheel.send_signal(number)
        self.wheel.wait(60.0)


def _only(motors: Any) -> Any:
    """Return a motor file with the one wheel of the campaign."""
    if not isinstance(motors, dict):
        return motors
    if WHEEL in motors:
        return {WHEEL: motors[WHEEL]}
    return {key: _only(value) for key, value in motors.items()}


def _rival(campaign: Campaign) -> None:
    """Command the full voltage under another name, again and again, with every sample."""
    from smp_interfaces.msg import MotorCommand

    publisher = campaign.robot.node.create_publisher(MotorCommand, f"/{WHEEL}/motor_command", 10)
    inner = campaign.relay.fault

    def meddle(message: Any) -> Any:
        publisher.publish(MotorCommand(voltage=SUPPLY))
        return inner(message)

    campaign.relay.fault = meddle


def _asks(value: float | None) -> Callable[[Campaign], None]:
    return lambda campaign: setattr(campaign.robot, "setpoint", value)


def _parameters(campaign: Campaign) -> None:
    draw = campaign.draw
    values = random_parameters(draw)
    campaign.robot.set(NODE, **values)
    campaign.robot.set(NODE, **usual(values))


BRAKES = 0.5 + 1.2
BEHIND = 0.15
"""Age of relayed messages [s] above which this process is late."""
AGAIN, STARTS = 20.0, 90.0
"""Time to drive again [s]; to start a process takes three seconds of a processor that others may
use, too."""
FAULTS = [
    Fault("feedback lost", lambda c: setattr(c.relay, "fault", lambda m: []), 0.3),
    Fault("feedback late", lambda c: c.relay.delays(0.6), 0.7),
    Fault("velocity nan", lambda c: c.relay.changes(velocity=math.nan), 0.3),
    Fault("velocity inf", lambda c: c.relay.changes(velocity=math.inf), 0.3),
    Fault("encoder dead", lambda c: c.relay.freezes(), 1.2, tried=True),
    Fault("leads swapped", lambda c: c.relay.changes(
        velocity=lambda v: -v, encoder_count=lambda n: -n, position=lambda p: -p), 0.7,
        tried=True),
    Fault("duplicated", lambda c: setattr(c.relay, "fault", lambda m: [m, m])),
    Fault("clock back", lambda c: c.relay.shifts_stamps(-10.0)),
    Fault("voltage nan", lambda c: c.relay.changes(voltage=math.nan, current=math.inf)),
    Fault("set-points cease", _asks(None), BRAKES, of_the_relay=False),
    Fault("set-point nan", _asks(math.nan), BRAKES, of_the_relay=False),
    Fault("set-point inf", _asks(math.inf), BRAKES, of_the_relay=False),
    Fault("killed", lambda c: c.ends(signal.SIGKILL), 0.3, of_the_relay=False),
    Fault("hung up", lambda c: c.ends(signal.SIGHUP), 0.3, of_the_relay=False),
    Fault("quit", lambda c: c.ends(signal.SIGQUIT), 0.3, of_the_relay=False),
    Fault("frozen process", lambda c: c.wheel.send_signal(signal.SIGSTOP), 0.3,
          of_the_relay=False),
    Fault("another writer", _rival, of_the_relay=False),
    Fault("parameters", _parameters, of_the_relay=False),
]  # fmt: skip


def unsampled(commands: list[Any]) -> float:
    """Return the total time without a sample at the controller [s].

    A gap between samples counts as at most 0.1 s of evidence, so on a busy processor a fault is
    found later.
    """
    stamps = [c.header.stamp.sec + 1e-9 * c.header.stamp.nanosec for c in commands]
    gaps = [b - a - 0.1 for a, b in pairwise(t for t in stamps if t)]
    return sum(gap for gap in gaps if gap > 0.0)


def trial(campaign: Campaign, faults: list[Fault], duration: float) -> str:
    """Inject faults for a time; return the forbidden outcome, empty if none."""
    for fault in sorted(faults, key=lambda fault: not fault.of_the_relay):
        fault.begin(campaign)
    begin, begun = time.monotonic(), time.time()
    stopping = [fault.within for fault in faults if fault.within < math.inf]
    # One fault may keep the other from being seen before it has passed on to zero itself.
    deadline = begin + (max(stopping) if stopping else math.inf) + SLACK
    tried = any(fault.tried for fault in faults)
    wrong: list[str] = []
    commands = campaign.robot.commands[WHEEL]
    commands.clear()

    def look() -> bool:
        # By the stamps of the plant: this process may be behind on a busy machine.
        late = campaign.stamp() - begun > deadline - begin + (unsampled(commands) if tried else 0.0)
        most = TRY_VOLTAGE if tried else 0.05
        if late and abs(campaign.voltage()) > most:
            wrong.append(f"{campaign.voltage():+.2f} V")
        elif abs(campaign.true_speed()) > FASTEST:
            wrong.append(f"{campaign.true_speed():+.2f} rad/s")
        return bool(wrong)

    campaign.spin_until(look, max(duration, deadline - begin + 0.5) if stopping else duration)
    if wrong:
        return f"{wrong[0]} {time.monotonic() - begin:.2f} s after"
    if campaign.plant.poll() is not None:
        return "the plant is dead"
    ends = {"killed", "hung up", "quit"}
    if campaign.wheel.poll() is not None and not ends & {fault.name for fault in faults}:
        return f"wheel_pid is dead, exit code {campaign.wheel.returncode}"
    again = AGAIN if campaign.wheel.poll() is None else STARTS
    campaign.heal()
    if not campaign.drives_within(again):
        return f"does not drive again: {campaign.robot.last_diagnosis(NODE)}"
    return ""


def run(minutes: float, seed: int, campaign: Campaign) -> bool:
    """Run the campaign; return whether nothing forbidden happened."""
    draw = campaign.draw = random.Random(seed)
    counts: Counter[str] = Counter()
    failures = []
    campaign.robot.setpoint = campaign.speed
    campaign.spin_until(campaign.drives, STARTS)
    end = time.monotonic() + 60.0 * minutes
    relay = [fault for fault in FAULTS if fault.of_the_relay]
    other = [f for f in FAULTS if not f.of_the_relay and f.begin is not _rival]
    while time.monotonic() < end and len(failures) < 20:
        faults = [draw.choice(FAULTS)]
        if draw.random() < 0.4:
            # While a wheel at fault is at rest it is free for another writer.
            faults = [draw.choice(relay), draw.choice(other)]
        campaign.speed = campaign.robot.setpoint = draw.choice([-1, 1]) * draw.uniform(0.6, 1.8)
        if not campaign.drives_within(STARTS):
            failures.append("before any fault: does not drive")
            break
        name, duration = " + ".join(fault.name for fault in faults), draw.uniform(0.3, 3.0)
        counts.update([fault.name for fault in faults])
        try:
            wrong = trial(campaign, faults, duration)
        except pytest.fail.Exception as error:  # a service that does not answer
            wrong = str(error)
        if wrong:
            failures.append(f"{name} at {campaign.speed:+.2f} rad/s for {duration:.1f} s: {wrong}")
            load = os.getloadavg()[0]
            print(
                f"FAILED (draw {sum(counts.values())}, load {load:.1f}) {failures[-1]}", flush=True
            )
            campaign.renew()
    for name, number in sorted(counts.items()):
        print(f"  {number:5d} x {name}")
    print(f"seed {seed}: {sum(counts.values())} faults, {len(failures)} forbidden")
    return not failures


def _driven_with(campaign: Campaign, values: dict[str, Any]) -> tuple[bool, float]:
    """Set parameters; return whether they are accepted, and the fastest that they drive."""
    ok, _ = campaign.robot.set(NODE, **values)
    fastest = 0.0
    end = time.monotonic() + 0.4
    while ok and time.monotonic() < end:
        campaign.robot.spin()
        fastest = max(fastest, abs(campaign.true_speed()))
    return ok, fastest


def parameters(count: int, seed: int, campaign: Campaign) -> bool:
    """Set parameters of a live wheel through its service; return whether it lives and follows."""
    draw = random.Random(seed)
    campaign.robot.setpoint = campaign.speed
    campaign.spin_until(campaign.drives, 20.0)
    accepted = wrong = once = 0
    for k in range(count):
        values = random_parameters(draw)
        # A processor that answers late drives a wheel off, too, but hardly three times in a row.
        for attempt in range(3):
            ok, fastest = _driven_with(campaign, values)
            accepted += ok and not attempt
            # Who says that the motor is another one is believed.
            known = not any(name.startswith("model__") for name in values)
            away = ok and known and fastest > 2.5 * campaign.speed
            alive = campaign.wheel.poll() is None
            if not alive:
                campaign.start_wheel()
            if ok:
                campaign.heal()
                if not campaign.robot.set(NODE, **usual(values))[0]:
                    print(f"FAILED set {k}: the usual parameters are refused")
                    wrong += 1
                campaign.spin_until(campaign.drives, 5.0)
            if not (away and alive):
                break
        once += alive and not away and attempt > 0
        if away or not alive:
            wrong += 1
            print(f"FAILED set {k}: {fastest:.2f} rad/s, alive {alive}, {values}", flush=True)
    print(f"too fast once or twice, and not again: {once}, load {os.getloadavg()[0]:.1f}")
    print(f"seed {seed}: {count} sets, {accepted} accepted, {wrong} wrong")
    return not wrong


def main() -> int:
    """Run the campaign; exit code 1 after a forbidden outcome."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=int(time.time()) // 86400)
    parser.add_argument("--parameters", type=int, metavar="N", help="sets through the service")
    arguments = parser.parse_args()
    domain = int(os.environ.setdefault("ROS_DOMAIN_ID", "105"))
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    print(f"seed {arguments.seed}", flush=True)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # not without its processes
    campaign = Campaign(domain, through_relay=not arguments.parameters)
    try:
        if arguments.parameters:
            held = parameters(arguments.parameters, arguments.seed, campaign)
        else:
            held = run(arguments.minutes, arguments.seed, campaign)
    finally:
        campaign.close()
    return 0 if held else 1


if __name__ == "__main__":
    sys.exit(main())
