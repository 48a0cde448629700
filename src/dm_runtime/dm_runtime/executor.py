"""The one executor of the suite, and the life of a node process.

`rclpy.experimental.EventsExecutor` has half the latency and a quarter of the CPU use of the others, but must be driven
with care (measured with rclpy 7.1.6):

* `spin()` without a time limit never dispatches in the PyPI wheels; `spin_once(timeout_sec=...)` in a loop does.
* An exception in a callback leaves `spin_once`; it must not end a process that holds a mirror.
* `async def` service callbacks are not run, and a pending `await` in an action callback is polled at 100 % CPU. Work
  that waits therefore runs in worker threads (see :mod:`dm_runtime.worker`), and callbacks stay short.
* It installs its own SIGINT/SIGTERM handler, which shuts the ROS context down and ends the loop.
"""

from __future__ import annotations

import signal
import sys
import traceback
from collections.abc import Callable, Sequence

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import Executor, ExternalShutdownException
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

#: Longest time the loop sleeps without an event; only bounds the reaction to a shutdown from another thread.
WAKE_PERIOD_S = 1.0


def make_executor(*nodes: Node) -> Executor:
    """Return the suite's executor with `nodes` added."""
    executor = EventsExecutor()
    for node in nodes:
        executor.add_node(node)
    return executor


def spin(executor: Executor, until: Callable[[], bool] | None = None) -> None:
    """Dispatch events until the ROS context is shut down or `until()` is true.

    A callback that raises is logged with its traceback and the loop goes on.
    """
    while rclpy.ok() and not (until is not None and until()):
        try:
            executor.spin_once(timeout_sec=WAKE_PERIOD_S)
        except (KeyboardInterrupt, ExternalShutdownException):
            return
        except Exception:
            if not rclpy.ok():
                return
            rclpy.logging.get_logger("dm_runtime").error(f"a callback raised:\n{traceback.format_exc()}")


def run_node(make_node: Callable[[], Node], args: Sequence[str] | None = None) -> int:
    """Run one node as a process: `main()` of every node calls this.

    The node's `make_safe()`, if it has one, runs after the loop has ended and before anything is destroyed, with SIGINT
    and SIGTERM ignored, so that a second Ctrl-C cannot interrupt the way to the safe shape.

    Returns the exit status: 0, or 1 when the node could not be made (the reason is on standard error).
    """
    rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    node: Node | None = None
    try:
        node = make_node()
        spin(make_executor(node))
        return 0
    except (ParameterException, ValueError, OSError) as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr, flush=True)
        return 1
    except KeyboardInterrupt:
        return 0
    finally:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
        if node is not None:
            make_safe = getattr(node, "make_safe", None)
            if make_safe is not None:
                make_safe()
            node.destroy_node()
        rclpy.try_shutdown()
