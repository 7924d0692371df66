# SPDX-License-Identifier: Apache-2.0
"""A fake client of a connected robot with one reporting wheel, for tests of commissioning."""

import contextlib


class Client:
    def __init__(self, wheel: str, rate: float) -> None:
        self.wheel, self.rate = wheel, rate

    def __enter__(self):
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def find_wheels(self) -> tuple[str, ...]:
        return (self.wheel,)

    def wait_for_wheels(self, wheels, timeout) -> dict[str, float]:
        return dict.fromkeys(wheels, self.rate)

    def paused(self, wheels) -> contextlib.AbstractContextManager[None]:
        return contextlib.nullcontext()

    def until(self, condition, timeout) -> bool:
        return condition()

    def runs_controller(self, wheel) -> bool:
        return True
