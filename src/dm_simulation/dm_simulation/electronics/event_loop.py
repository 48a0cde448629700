"""One thread that waits on all sockets of the bench and owns everything their data changes."""

import selectors
import socket
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, TypeVar

T = TypeVar("T")


class EventLoop:
    """Calls handlers when their socket or descriptor is readable.

    Args:
        on_error: told when a handler raised; the loop goes on.
    """

    def __init__(self, name: str, on_error: Callable[[Exception], None]) -> None:
        self._on_error = on_error
        self._selector = selectors.DefaultSelector()
        self._tasks: deque[tuple[Callable[[], Any], Future[Any]]] = deque()
        self._handing_in = threading.Lock()
        self._stop = False
        self._wake_reader, self._wake_writer = socket.socketpair()
        self._wake_reader.setblocking(False)
        self._selector.register(self._wake_reader, selectors.EVENT_READ, self._run_task)
        self._thread = threading.Thread(target=self._serve, name=name, daemon=True)
        self._thread.start()

    def watch(self, endpoint: socket.socket | int, handler: Callable[[], None]) -> None:
        """Call `handler` whenever `endpoint` is readable."""
        self._selector.register(endpoint, selectors.EVENT_READ, handler)

    def forget(self, endpoint: socket.socket | int) -> None:
        """Stop watching, if it was watched; to be called before closing."""
        try:
            self._selector.unregister(endpoint)
        except (KeyError, ValueError):
            pass

    def run(self, task: Callable[[], T]) -> T:
        """Run `task` in the loop's thread, after the data that had arrived by now, and return its value.

        Raises:
            OSError: the loop is closed.
        """
        if threading.current_thread() is self._thread:
            return task()
        if self._stop:
            raise OSError("the virtual electronics are closed")
        future: Future[T] = Future()
        with self._handing_in:  # tasks and bytes in the same order
            self._tasks.append((task, future))
            self._wake_writer.send(b"!")
        return future.result(timeout=30)

    def close(self) -> None:
        """End the thread."""
        self._stop = True
        self._wake_writer.send(b"!")
        self._thread.join(5)
        self._selector.close()
        self._wake_reader.close()
        self._wake_writer.close()

    def _serve(self) -> None:
        while not self._stop:
            ready = self._selector.select()
            # Tasks last: they must see the data that was readable when they were handed in.
            for key, _ in sorted(ready, key=lambda item: item[0].fileobj is self._wake_reader):
                if self._selector.get_map().get(key.fd) is not key:
                    continue  # a handler before this one closed it
                try:
                    key.data()
                except Exception as error:
                    self._on_error(error)

    def _run_task(self) -> None:
        # One byte, one task: its byte was there when select looked, hence so was all data sent before it. A later task
        # may come with data that this round has not seen, and waits for the next.
        self._wake_reader.recv(1)
        if not self._tasks:
            return  # woken to stop
        task, future = self._tasks.popleft()
        try:
            future.set_result(task())
        except Exception as error:
            future.set_exception(error)
