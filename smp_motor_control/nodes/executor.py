# SPDX-License-Identifier: Apache-2.0
"""Single-threaded executor for control loops that takes a third of the stock executor's time.

The stock executor rebuilds its wait set and wraps every callback in a task for each message.
This one rebuilds the wait set only when an entity is created or destroyed and calls the callbacks
of subscriptions and timers directly; other entities, and coroutines, are left to the stock
executor.  While messages arrive in quick succession it waits for messages, timers and
guard conditions only, and checks the other entities every :data:`SERVICE_PERIOD_NS`.
"""

import inspect
import time
from contextlib import ExitStack
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.subscription import Subscription
from rclpy.waitable import NumberOfEntities

_NO_TIMEOUT = -1

SERVICE_PERIOD_NS = 20_000_000
"""Maximum wait of services, clients, events and actions during a stream of messages."""


class _WaitSet:
    """Wait set of a collection of entities, which it keeps alive."""

    def __init__(self, executor: "LeanExecutor", key: tuple[tuple[Any, ...], ...]) -> None:
        self.key = key
        self._stack = ExitStack()
        subscriptions, timers, clients, services, guards, waitables = key
        self.waitables = [w for w in waitables if self._hold(w)]
        total = NumberOfEntities()
        for waitable in self.waitables:
            total += waitable.get_num_entities()
        self.by_pointer: dict[int, Any] = {}
        self._adders: list[tuple[Any, Any]] = []
        own = (executor._guard, executor._sigint_gc)
        self._stack.enter_context(executor.context.handle)
        self._waits = _rclpy.WaitSet(
            total.num_subscriptions + len(subscriptions),
            total.num_guard_conditions + len(guards) + len(own),
            total.num_timers + len(timers),
            total.num_clients + len(clients),
            total.num_services + len(services),
            total.num_events,
            executor.context.handle,
        )
        waits = self._waits
        for add, entities in (
            (waits.add_subscription, subscriptions),
            (waits.add_timer, timers),
            (waits.add_client, clients),
            (waits.add_service, services),
            (waits.add_guard_condition, (*guards, *own)),
        ):
            for entity in entities:
                if self._hold(entity.handle):
                    self._adders.append((add, entity.handle))
                    self.by_pointer[entity.handle.pointer] = entity

    def _hold(self, handle: Any) -> bool:
        try:
            self._stack.enter_context(handle)
        except InvalidHandle:
            return False
        return True

    def release(self) -> None:
        """Release the entities, so that they can be destroyed."""
        self._stack.close()

    def wait(self, timeout: int) -> None:
        """Wait until an entity is ready or the time-out expires [ns]."""
        waits = self._waits
        waits.clear_entities()
        for add, handle in self._adders:
            add(handle)
        for waitable in self.waitables:
            waitable.add_to_wait_set(waits)
        waits.wait(timeout)

    def ready(self, kind: str) -> list[Any]:
        find = self.by_pointer
        return [find[p] for p in self._waits.get_ready_entities(kind) if p in find]

    def ready_waitables(self) -> list[Any]:
        return [w for w in self.waitables if w.is_ready(self._waits)]


class PolledSubscriptions(CallbackGroup):
    """Subscriptions whose owner reads them in batches; the executor ignores them."""

    def can_execute(self, entity: Any) -> bool:
        """Return False."""
        return False

    beginning_execution = ending_execution = can_execute


class LeanExecutor(SingleThreadedExecutor):
    """Executor of one or more nodes; a time-out selects the stock implementation."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._waits: tuple[_WaitSet, _WaitSet] | None = None
        self._stream_until = self._last_message_at = 0

    def entities(self) -> tuple[tuple[Any, ...], ...]:
        nodes = self.get_nodes()
        kinds = ("subscriptions", "timers", "clients", "services", "guards", "waitables")
        return tuple(
            # Neither polled subscriptions nor their events, which data also trigger, wake it.
            tuple(
                e
                for node in nodes
                for e in getattr(node, kind)
                if not isinstance(getattr(e, "callback_group", None), PolledSubscriptions)
            )
            for kind in kinds
        )

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Wait for ready entities and execute them."""
        if timeout_sec is not None:
            super().spin_once(timeout_sec)
            return
        everything, stream = self._waits or self._gather()
        left = self._stream_until - time.monotonic_ns()
        waits, longest = (stream, left) if left > 0 else (everything, _NO_TIMEOUT)
        try:
            waits.wait(longest)
        except InvalidHandle:  # event of a destroyed entity
            self._release()
            return
        if not self.context.ok():
            raise ExternalShutdownException()
        # First the events of entities that later callbacks may destroy
        for waitable in waits.ready_waitables():
            self._do_stock(waitable, self._take_living)
        for timer in waits.ready("timer"):
            self._do_timer(timer)
        messages = waits.ready("subscription")
        for subscription in messages:
            self._do_subscription(subscription)
        for guard in waits.ready("guard_condition"):
            self._do_guard(guard)
        if waits is everything:
            for kind, take in (("client", self._take_client), ("service", self._take_service)):
                for entity in waits.ready(kind):
                    self._do_stock(entity, take)
        self._schedule_services(bool(messages), waits is everything)
        if self._tasks:
            super().spin_once(0.0)

    def _take_living(self, waitable: Any) -> Any:
        try:
            return self._take_waitable(waitable)
        except InvalidHandle:  # destroyed by a callback of this round
            return None

    def _schedule_services(self, heard: bool, looked: bool) -> None:
        """Set until when to wait for messages only."""
        now = time.monotonic_ns()
        if looked:
            in_succession = heard and now - self._last_message_at < SERVICE_PERIOD_NS
            self._stream_until = now + SERVICE_PERIOD_NS if in_succession else 0
        if heard:
            self._last_message_at = now

    def _do_guard(self, guard: Any) -> None:
        if guard is self._guard:
            if self._waits is not None and self._waits[0].key != self.entities():
                self._release()
        elif guard is not self._sigint_gc:
            guard._executor_triggered = True
            self._do_stock(guard, self._take_guard_condition)

    def _gather(self) -> tuple[_WaitSet, _WaitSet]:
        key = self.entities()
        subscriptions, timers, _, _, guards, _ = key
        stream = (subscriptions, timers, (), (), guards, ())
        self._waits = waits = (_WaitSet(self, key), _WaitSet(self, stream))
        return waits

    def _release(self) -> None:
        for waits in self._waits or ():
            waits.release()
        self._waits = None

    def _call(self, callback: Any, *given: Any) -> None:
        result = callback(*given)
        if inspect.iscoroutine(result):
            self.create_task(result)

    def _do_timer(self, timer: Any) -> None:
        try:
            with timer.handle:
                if not timer.handle.is_timer_ready():
                    return
                timer.handle.call_timer()
        except InvalidHandle:
            return
        self._call(timer.callback)

    def _do_subscription(self, subscription: Any) -> None:
        try:
            with subscription.handle:
                taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
        except InvalidHandle:
            return
        if taken is None:
            return
        if subscription._callback_type is Subscription.CallbackType.MessageOnly:
            self._call(subscription.callback, taken[0])
        else:
            self._call(subscription.callback, *taken)

    def _do_stock(self, entity: Any, take: Any) -> None:
        if not entity.callback_group.can_execute(entity):
            return
        handler = self._make_handler(entity, None, take)
        handler()
        if handler.done():
            self._tasks = [t for t in self._tasks if t[0] is not handler]
            handler.result()

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """Shut down and release all entities."""
        self._release()
        return bool(super().shutdown(timeout_sec))
