"""One thread that waits on all sockets of the bench and owns everything that their data change."""

import asyncio
import threading
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")


class EventLoop:
    """Calls handlers when their socket or descriptor is readable.

    Args:
        on_error: called when a handler raised an exception; the loop continues.

    Attributes:
        watch: calls a handler whenever a socket or descriptor is readable.
        forget: stops watching it, if it was watched; to be called before closing.
    """

    def __init__(self, name: str, on_error: Callable[[Exception], None]) -> None:
        self._loop = asyncio.new_event_loop()
        self._loop.set_exception_handler(lambda _, context: on_error(context["exception"]))
        self.watch, self.forget = self._loop.add_reader, self._loop.remove_reader
        self._closed = False
        self._thread = threading.Thread(target=self._loop.run_forever, name=name, daemon=True)
        self._thread.start()

    def run(self, task: Callable[[], T]) -> T:
        """Run `task` in the loop's thread, after all data that have arrived by now, and return its value.

        Raises:
            OSError: the loop is closed.
        """
        if threading.current_thread() is self._thread:
            return task()
        if self._closed:
            raise OSError("the virtual electronics are closed")

        async def after_what_arrived() -> T:
            # The loop has polled the sockets since this was submitted; their handlers are queued next and run first.
            await asyncio.sleep(0)
            return task()

        return asyncio.run_coroutine_threadsafe(after_what_arrived(), self._loop).result(timeout=30)

    def close(self) -> None:
        """End the thread."""
        self._closed = True
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(5)
        self._loop.close()
