# SPDX-License-Identifier: Apache-2.0
"""Common code of nodes: the lean executor, settings and their refusal, start and end."""

import signal
import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import pytest
import rclpy
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from std_msgs.msg import Float64, String
from std_srvs.srv import Trigger

from smp_motor_control.errors import ParameterError
from smp_motor_control.fields import described
from smp_motor_control.nodes import excite, serial_driver
from smp_motor_control.nodes.executor import LeanExecutor, PolledSubscriptions, _WaitSet
from smp_motor_control.nodes.runtime import STREAM_PUBLISHER, STREAM_SUBSCRIBER, steady_timer
from smp_motor_control.nodes.settings import Parameters

PROGRAM = """
import sys
from rclpy.node import Node
from std_msgs.msg import String
from smp_motor_control.nodes import runtime

class Busy(Node):
    def __init__(self):
        super().__init__("busy")
        self.last = self.create_publisher(String, "last", 10)
        runtime.steady_timer(self, 0.05, self.work)
        print("ready", flush=True)
    def work(self):
        {work}
    def on_stop(self):
        print("stopped", flush=True)
        runtime.send_last(self.last, String(data="zero"))

sys.exit(runtime.run("busy", Busy, []))
"""


@pytest.fixture
def executor(ros_domain: int) -> Iterator[LeanExecutor]:
    context = rclpy.Context()
    rclpy.init(args=[], context=context, domain_id=ros_domain)
    executor = LeanExecutor(context=context)
    yield executor
    executor.shutdown()
    rclpy.shutdown(context=context)


@pytest.fixture
def node(executor) -> Node:
    node = rclpy.create_node("tester", context=executor.context)
    executor.add_node(node)
    return node


def spin_until(executor: LeanExecutor, node: Node, condition, seconds: float = 10.0) -> None:
    ticking = steady_timer(node, 0.01, lambda: None)
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "not in time"
        executor.spin_once()
    node.destroy_timer(ticking)


def test_lean_executor_serves_topics_timers_services_clients_and_coroutines(node, executor):
    heard: list[float] = []
    awaited: list[float] = []

    async def coroutine(message: Float64) -> None:
        awaited.append(message.data)

    node.create_subscription(Float64, "x", lambda m: heard.append(m.data), STREAM_SUBSCRIBER)
    node.create_subscription(Float64, "x", coroutine, STREAM_SUBSCRIBER)
    node.create_service(Trigger, "ask", lambda _, r: Trigger.Response(success=True, message="yes"))
    client = node.create_client(Trigger, "ask")
    publisher = node.create_publisher(Float64, "x", STREAM_PUBLISHER)
    sent = iter(range(10_000))
    timer = steady_timer(node, 0.005, lambda: publisher.publish(Float64(data=float(next(sent)))))
    spin_until(executor, node, lambda: len(heard) > 20 and len(awaited) > 20)
    assert heard == sorted(heard)
    spin_until(executor, node, client.service_is_ready)
    future = client.call_async(Trigger.Request())
    spin_until(executor, node, future.done)
    assert future.result().message == "yes"
    node.destroy_timer(timer)


def test_lean_executor_survives_entities_created_and_destroyed_in_callbacks(node, executor):
    publisher = node.create_publisher(String, "y", STREAM_PUBLISHER)
    heard: list[str] = []
    made: list[object] = []

    def renew() -> None:
        if made:
            node.destroy_subscription(made.pop())
            node.destroy_publisher(made.pop())
        made.append(node.create_publisher(String, "z", STREAM_PUBLISHER))
        made.append(
            node.create_subscription(String, "y", lambda m: heard.append(m.data), STREAM_SUBSCRIBER)
        )

    renewing = steady_timer(node, 0.05, renew)
    steady_timer(node, 0.005, lambda: publisher.publish(String(data="here")))
    spin_until(executor, node, lambda: len(heard) > 50)
    node.destroy_timer(renewing)
    before = len(heard)
    spin_until(executor, node, lambda: len(heard) > before + 10)


@pytest.fixture
def waits(monkeypatch) -> Counter[str]:
    """Count the executor's waits: for messages alone, or for everything."""
    counted: Counter[str] = Counter()
    wait = _WaitSet.wait

    def counting(self: _WaitSet, timeout: int) -> None:
        services = self.key[3]
        counted["everything" if services else "messages"] += 1
        wait(self, timeout)

    monkeypatch.setattr(_WaitSet, "wait", counting)
    return counted


def test_waiting_for_a_stream_delays_other_callbacks_only_briefly(node, executor, waits):
    node.create_service(Trigger, "ask", lambda _, r: Trigger.Response(success=True))
    client = node.create_client(Trigger, "ask")
    heard: list[float] = []
    node.create_subscription(Float64, "x", lambda m: heard.append(m.data), STREAM_SUBSCRIBER)
    publisher = node.create_publisher(Float64, "x", STREAM_PUBLISHER)
    timer = steady_timer(node, 0.002, lambda: publisher.publish(Float64(data=1.0)))
    spin_until(executor, node, lambda: client.service_is_ready() and len(heard) > 20)
    waits.clear()
    heard.clear()
    spin_until(executor, node, lambda: len(heard) > 200)
    assert waits["messages"] > 2 * waits["everything"] > 0

    def call() -> None:
        future = client.call_async(Trigger.Request())
        spin_until(executor, node, future.done)

    begin = time.monotonic()
    for _ in range(20):
        call()
    assert time.monotonic() - begin < 10.0  # for a busy machine; usually a fiftieth

    refused: list[object] = []
    node.create_subscription(
        Float64, "x", lambda _: None,
        QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL),
        event_callbacks=SubscriptionEventCallbacks(incompatible_qos=refused.append),
    )  # fmt: skip
    spin_until(executor, node, lambda: refused)
    node.destroy_timer(timer)
    call()


def test_polled_subscription_does_not_wake_the_executor(node, executor):
    kept = node.create_subscription(
        Float64, "batch", lambda _: None, STREAM_SUBSCRIBER, callback_group=PolledSubscriptions()
    )
    publisher = node.create_publisher(Float64, "batch", STREAM_PUBLISHER)
    spin_until(executor, node, lambda: publisher.get_subscription_count() == 1)
    publisher.publish(Float64(data=7.0))
    steady_timer(node, 0.1, lambda: None)
    begun, rounds = time.monotonic(), 0
    while time.monotonic() < begun + 1.0:
        executor.spin_once()
        rounds += 1
    assert rounds < 30  # of the timer and the node's start
    with kept.handle:
        message, _ = kept.handle.take_message(Float64, False)
    assert message.data == 7.0


def test_an_event_of_a_destroyed_entity_does_not_end_the_spin(node, executor):
    reliable = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)
    named: list[str] = []
    found: dict[str, Subscription] = {}

    def destroy_the_other(name: str, other: str) -> None:
        named.append(name)
        node.destroy_subscription(found[other])

    for name, other in (("one", "two"), ("two", "one")):
        events = SubscriptionEventCallbacks(
            incompatible_qos=lambda _, name=name, other=other: destroy_the_other(name, other)
        )
        found[name] = node.create_subscription(
            Float64, "x", lambda _: None, reliable, event_callbacks=events
        )
    third = node.create_subscription(Float64, "x", lambda _: None, reliable)
    executor.spin_once()  # gathers all of it

    # Both are ready in one round, and so is the timer, which destroys a third with an event.
    node.create_publisher(Float64, "x", STREAM_SUBSCRIBER)
    everything, _ = executor._waits
    end = time.monotonic() + 10.0
    while len(everything.ready_waitables()) < 3:
        assert time.monotonic() < end, "no event of the three"
        everything.wait(10_000_000)
    destroying = steady_timer(node, 0.01, lambda: node.destroy_subscription(third))
    spin_until(executor, node, lambda: named)
    node.destroy_timer(destroying)
    for _ in range(20):
        spin_until(executor, node, lambda: True)
    assert named in (["one"], ["two"])


def test_exception_in_a_callback_propagates_from_spin(node, executor):
    steady_timer(node, 0.01, lambda: [][0])
    with pytest.raises(IndexError):
        spin_until(executor, node, lambda: False, 5.0)


@dataclass(frozen=True, kw_only=True)
class Settings:
    low: float = described(1.0, "Lower.", minimum=0.0)
    high: float = described(2.0, "Upper.")
    fixed: str = described("a", "Set at the start.", read_only=True)
    names: tuple[str, ...] = described(("x",), "Names.")

    def __post_init__(self) -> None:
        if self.low >= self.high:
            raise ParameterError(f"low is {self.low}; it must be below high, {self.high}")


def test_settings_change_atomically(node):
    changes: list[Settings] = []
    parameters = Parameters(node, Settings, changes.append)
    first = parameters.settings

    def set_both(**values: object) -> tuple[bool, str]:
        given = [Parameter(name, value=value) for name, value in values.items()]
        result = node.set_parameters_atomically(given)
        return result.successful, result.reason

    for refused, words in (
        (dict(low=3.0), "below high"),
        (dict(low=3.0, high=2.5), "below high"),
        (dict(low=-1.0), "low"),
        (dict(low="much"), "must be a number"),
        (dict(low=float("nan")), "nan"),
        (dict(fixed="b"), "read-only"),
        (dict(names="x"), "must be a list"),
    ):
        accepted, reason = set_both(**refused)
        assert not accepted and words in reason
    assert parameters.settings is first and not changes
    assert set_both(low=3, high=4.0) == (True, "")
    assert (parameters.settings.low, parameters.settings.high) == (3.0, 4.0)
    assert changes == [parameters.settings]


@pytest.mark.parametrize("number", ["SIGINT", "SIGTERM", "SIGQUIT", "SIGHUP", "SIGTSTP"])
def test_signal_ends_a_node_cleanly_within_two_seconds(process, eventually, number):
    node = process(sys.executable, "-c", PROGRAM.format(work="pass"))
    eventually(lambda: "ready" in node.output, 20.0)
    node.send_signal(getattr(signal, number))
    assert node.wait(2.0) == 0
    assert "stopped" in node.output


def test_repeated_signals_do_not_prevent_the_clean_end_of_a_node(process, eventually):
    """A terminal, launch and systemd each send one."""
    node = process(sys.executable, "-c", PROGRAM.format(work="pass"))
    eventually(lambda: "ready" in node.output, 20.0)

    def signal_until_end() -> bool:
        node.send_signal(signal.SIGINT)
        return node.returncode is not None

    eventually(signal_until_end, 2.0)
    assert node.wait(2.0) == 0
    assert "stopped" in node.output


def test_a_node_that_raises_stops_its_motors_and_reports_the_error(process):
    node = process(sys.executable, "-c", PROGRAM.format(work="raise ValueError('too bad')"))
    assert node.wait(20.0) == 1
    assert "stopped" in node.output
    assert "busy: stopped by ValueError: too bad" in node.output


def test_stream_publisher_offers_no_liveliness_lease():
    # The renewal of a lease can deadlock when another process ends.
    assert (
        STREAM_PUBLISHER.liveliness_lease_duration == QoSProfile(depth=1).liveliness_lease_duration
    )


WHEEL = "-r __ns:=/front_left"
REFUSED = [
    ("excite", "-p amplitude:=20.0", "must not exceed max_voltage"),
    ("excite", "-p signal:=noise", "known are sine"),
    ("excite", "-p wheels:=[left] -p wait:=0.2", "no subscriber on /left/motor_command"),
    ("excite", "-p duration:=-1.0", "duration is -1.0"),
    ("identifier", "-p window:=3.0", "window is 3"),
    ("motor_plant", "-p rate:=fast", "rate is 'fast'"),
    ("motor_plant", "-p motors_file:=/nowhere.yaml", "/nowhere.yaml: cannot be read"),
    ("motor_plant", "--params-file /nowhere.yaml", "/nowhere.yaml"),
    ("serial_driver", "-p wheel_names:=[left,left]", "serial_driver: a wheel is named twice"),
    ("serial_driver", "-p supply_voltage:=-12.0", "serial_driver: supply_voltage is -12"),
    ("skid_steer", "-p wheel_radius:=-0.1", "wheel_radius"),
    ("skid_steer", "-p angular.z.max_velocity:=1.0 -p angular.z.min_velocity:=2.0", "angular.z"),
    ("skid_steer", "-p use_stamped_vel:=3", "use_stamped_vel"),
    ("skid_steer", "-p left_wheel_names:=[a,front_right]", "named twice"),
    ("teleop_wheels", "", "not a terminal"),
    ("wheel_pid", "", "joint_name is empty"),
    ("wheel_pid", f"-p i:=-100.0 {WHEEL}", "i is -100; it must be in [0,"),
    ("wheel_pid", f"-p i_clamp_max:=-1.0 {WHEEL}", "i_clamp_m"),
]


@pytest.mark.parametrize(("node", "given", "words"), REFUSED)
def test_node_refuses_invalid_settings_in_one_line(process, node, given, words):
    started = process(node, "--ros-args", *given.split())
    assert started.wait(20.0) == 2
    (line,) = started.output.strip().splitlines()
    assert words in line


@pytest.mark.parametrize(
    ("node", "given", "words"),
    [
        (excite, {"wheel_names": ("left", "left")}, "named twice: left"),
        (excite, {"wheels": ("left", "left")}, "named twice: left"),
        (excite, {"wheels": ("front left",)}, "wheel name 'front left'"),
        (excite, {"wheels": ("",)}, "wheel name ''"),
        (excite, {"wheel_names": ("all/", "b")}, "wheel name 'all/'"),
        (serial_driver, {"wheel_names": ("left", "left")}, "a wheel is named twice: left"),
        (serial_driver, {"wheel_names": ()}, "wheel_names is empty"),
        (serial_driver, {"wheel_names": ("",)}, "wheel name ''"),
        (serial_driver, {"wheel_names": ("front left",)}, "wheel name 'front left'"),
        (serial_driver, {"wheel_names": ("1st",)}, "wheel name '1st'"),
        (serial_driver, {"wheel_names": ("a/../b",)}, "wheel name"),
        (serial_driver, {"wheel_names": ("a" * 300,)}, "at most 100"),
        (serial_driver, {"baud": 0}, "baud is 0"),
        (serial_driver, {"baud": -9600}, "baud is -9600"),
        (serial_driver, {"gear_ratio": -1.0}, "gear ratio is -1.0"),
        (serial_driver, {"gear_ratio": 0.0}, "gear ratio is 0.0"),
        (serial_driver, {"encoder_bits": 1}, "encoder_bits is 1"),
    ],
)
def test_invalid_wheel_names_and_hardware_settings_are_refused(node, given, words):
    with pytest.raises(ParameterError, match=words):
        node.Settings(**given)
