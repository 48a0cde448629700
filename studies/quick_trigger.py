"""A trigger of the virtual interferometer that starts ten times as fast as the shipped program."""

from __future__ import annotations

#: The same as dm_simulation.interferometer.trigger: ask the virtual bench on port $0 for a map in the file $1.
_TRIGGER = """
exec 3<>"/dev/tcp/127.0.0.1/$0" && echo "MEASURE $1" >&3 && read -r answer <&3 && echo "$answer" && [[ $answer = OK* ]]
"""


def quick_trigger(port: int | str) -> list[str]:
    """Value of the parameter `trigger_command`; the shipped program has tests of its own."""
    return ["bash", "-c", _TRIGGER, str(port), "{path}"]
